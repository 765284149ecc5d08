"""What is known of cameras reaches the front-end in both estimates: of the photos alone, and of the photos with the inserted view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.expansion import (
    LoadedModel,
    PriorsUse,
    RoundInputs,
    captured_prediction,
    initial_state,
    joint_reconstruction,
)
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.reconstruction import views
from sceneexpander.reconstruction.optics import known_of
from tests.support.methods import make_procedure
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.told_cameras import PHOTOS, known_cameras, read, scene_folder

FRONT_END = FrontendConfig(sfm=SfmConfig(learned=LearnedUse.NEVER))


def told_model() -> LoadedModel:
    model = TinyReconstructor()
    return LoadedModel(
        model=model,
        base={k: v.clone() for k, v in model.state_dict().items()},
        weights_sha256="0",
        licence="none",
        device=torch.device("cpu"),
        priors=PriorsUse.FRONT_END,
    )


class Seen(Exception):
    """Ends a run where the front-end would begin."""


def test_focal_lengths_of_files_are_told_in_both_estimates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 35  # FocalLengthIn35mmFilm
    scene, inserted = read(scene_folder(tmp_path / "s", exif=exif))
    loaded, told = told_model(), []

    def front_end(*_: object, **given: Any) -> None:
        told.append(given["optics"])
        raise Seen

    monkeypatch.setattr(views, "build_priors", front_end)
    with pytest.raises(Seen):
        initial_state(scene, loaded, FRONT_END, WarmupConfig(steps=0), seed=0)
    monkeypatch.undo()
    without = replace(loaded, priors=PriorsUse.AUTO)  # what the state is made of does not matter here
    state, *_ = initial_state(scene, without, FRONT_END, WarmupConfig(steps=0), seed=0)
    monkeypatch.setattr(views, "build_priors", front_end)
    with pytest.raises(Seen):
        joint_reconstruction(state, inserted, loaded, FRONT_END, seed=0)
    alone, joint = told
    focals = [view.focal_px for view in alone]
    assert all(focal is not None and focal > 0 for focal in focals)
    assert [view.focal_px for view in joint] == [*focals, None], "the photos', and nothing of the generated picture"
    assert [view.generated for view in joint] == [False] * PHOTOS + [True]


def test_known_cameras_hold_in_both_estimates_and_in_later_rounds(tmp_path: Path) -> None:
    """One frame and one scale, and intrinsics as they were given, whatever the inserted picture does to the matches."""
    scene, inserted = read(scene_folder(tmp_path / "s"))
    known = known_cameras(scene)
    scene = replace(scene, known=known)
    loaded = told_model()
    state, *_ = initial_state(scene, loaded, FRONT_END, WarmupConfig(steps=0), seed=0)
    state.save(tmp_path / "state")
    state = ExpansionState.load(tmp_path / "state")
    anchors, _ = captured_prediction(state, loaded)
    priors, _, _ = joint_reconstruction(state, inserted, loaded, FRONT_END, seed=0)
    assert known.world_from_cam is not None
    expected = rigid_inverse(known.world_from_cam[:1]) @ known.world_from_cam
    for found in (state.priors, priors):
        assert found.world_from_cam is not None
        assert found.intrinsics_px is not None
        assert found.posed is not None
        assert bool(found.posed[:PHOTOS].all())
        poses = found.world_from_cam[:PHOTOS]
        assert float(rotation_angle_deg(poses[:, :3, :3], expected[:, :3, :3]).max()) < 0.01
        ratio = poses[1:, :3, 3].norm(dim=-1) / expected[1:, :3, 3].norm(dim=-1)
        torch.testing.assert_close(poses[:, :3, 3], ratio.mean() * expected[:, :3, 3], atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(found.intrinsics_px[:PHOTOS], known.intrinsics_px)
    assert state.priors.world_from_cam is not None
    assert priors.world_from_cam is not None
    # Each estimate has its own unit, the depth of the first view: the two are nearly one.
    torch.testing.assert_close(priors.world_from_cam[:PHOTOS], state.priors.world_from_cam, atol=0.02, rtol=0.05)
    inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    after = make_procedure(AdaptConfig(steps=0)).run(inputs, loaded, seed=0).state
    assert after.known is not None
    torch.testing.assert_close(after.known.intrinsics_px, known.intrinsics_px)


def test_a_view_that_came_later_has_no_known_pose_and_the_photos_focal(tmp_path: Path) -> None:
    scene, inserted = read(scene_folder(tmp_path / "s"))
    known = known_cameras(scene)
    assert known_of(scene.views, None) is None
    told = known_of(scene.views.append(inserted.view), known)
    assert told is not None
    assert told.world_from_cam is not None
    assert told.intrinsics_px is not None
    assert known.intrinsics_px is not None
    assert bool(told.world_from_cam[:PHOTOS].isfinite().all())
    assert not bool(told.world_from_cam[PHOTOS].isfinite().any())
    height, width = scene.views.images.shape[-2:]
    new = told.intrinsics_px[PHOTOS]
    torch.testing.assert_close(new[[0, 1], [0, 1]], known.intrinsics_px[0, [0, 1], [0, 1]])
    torch.testing.assert_close(new[:2, 2], torch.tensor([width / 2, height / 2]), atol=0.5, rtol=0)
    assert new[2].tolist() == [0, 0, 1]
