"""Photos that give geometry little or nothing: what is made of them is usable, and says what it is not sure of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sceneexpander.expansion import LoadedModel, ModelConfig, initial_state, load_model
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.frontend.sfm_types import SfmConfig, SfmReport
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.ingest import IngestConfig, load_scene
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.splatting import render
from sceneexpander.synthetic import make_views

SIZE = (168, 224)
FRONTEND = FrontendConfig(sfm=SfmConfig(focal_starts=(0.7, 1.0)))  # the focal is not what is asked here
CONFIDENT = EVIDENCE_CHANNELS.index("confident")


@pytest.fixture(scope="module")
def mini() -> LoadedModel:
    config = ModelConfig(name="mini", variant="default", weights="builtin", allow_download=False, priors="auto")
    return load_model(config, "cpu")


def place(seed: int, views: int) -> list[np.ndarray]:
    """Photos of one procedural place, 8-bit BGR."""
    images = make_views(seed, views=views, height=SIZE[0], width=SIZE[1], split="test").images
    return [np.rint(image.permute(1, 2, 0).numpy()[..., ::-1] * 255).astype(np.uint8) for image in images]


def turned(photo: np.ndarray, degrees: Sequence[float]) -> list[np.ndarray]:
    """Crops of one photo as a camera sees them that only turns."""
    height, width = photo.shape[:2]
    focal, share = 0.7 * width, 0.6
    whole = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    part = np.array([[focal, 0, width * share / 2], [0, focal, height * share / 2], [0, 0, 1]])
    size = round(width * share), round(height * share)
    photos = []
    for angle in np.radians(degrees):
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        photos.append(cv2.warpPerspective(photo, part @ rotation @ np.linalg.inv(whole), size))
    return photos


def plain_walls(count: int) -> list[np.ndarray]:
    """Brightness that falls off to one side, and noise."""
    rng = np.random.default_rng(0)
    ramp = np.linspace(180, 150, SIZE[1])[None, :, None]
    return [np.clip(ramp + 4 * k + rng.normal(0, 2, (*SIZE, 3)), 0, 255).astype(np.uint8) for k in range(count)]


class Reconstructed:
    """What `reconstruct` makes of some photos."""

    def __init__(
        self, folder: Path, photos: Sequence[np.ndarray], mini: LoadedModel, frontend: FrontendConfig = FRONTEND
    ) -> None:
        captured = folder / "captured"
        captured.mkdir()
        for index, photo in enumerate(photos):
            cv2.imwrite(str(captured / f"{index:02d}.png"), photo)
        (folder / "scene.yaml").write_text("rounds:\n- prompt: A cat.\n")
        scene = load_scene(folder, IngestConfig(allow_single_view=len(photos) == 1))
        warmup = WarmupConfig(steps=2, learning_rate=3e-5)
        state, found, sparse, _ = initial_state(scene, mini, frontend, warmup, seed=0)
        assert state.priors is not None
        assert state.priors.posed is not None
        assert state.priors.evidence is not None
        assert sparse is not None
        self.posed = state.priors.posed
        self.report: SfmReport = sparse.report
        self.confident = state.priors.evidence[:, CONFIDENT].mean((1, 2))
        self.world_from_cam = found.world_from_cam
        images = scene.views.images
        drawn = render(
            found.gaussians, Cameras(found.world_from_cam, found.intrinsics_px, *images.shape[-2:])
        ).rgb.clamp(0, 1)
        self.psnr = -10 * (drawn - images).square().mean((1, 2, 3)).log10()
        self.finite = bool(torch.isfinite(found.gaussians.means).all() & torch.isfinite(found.world_from_cam).all())


def test_one_photo_is_shown_and_not_called_sure(tmp_path: Path, mini: LoadedModel) -> None:
    made = Reconstructed(tmp_path, place(5, 1), mini)
    assert made.finite
    assert made.confident.max() == 0
    assert made.psnr.min() > 20


def test_two_places_are_kept_apart(tmp_path: Path, mini: LoadedModel) -> None:
    made = Reconstructed(tmp_path, [*place(5, 2)[:1], *place(9, 2)[:1]], mini)
    assert made.finite
    assert made.posed.sum() <= 1
    assert made.confident.max() == 0, "no depth can be known"
    assert all(view.reason for view in made.report.views if not view.registered)
    assert made.psnr[0] > 20


def test_a_stranger_among_photos_is_named_and_the_rest_are_posed(tmp_path: Path, mini: LoadedModel) -> None:
    made = Reconstructed(tmp_path, [*place(1, 3), *place(9, 2)[:1]], mini)
    assert made.finite
    assert made.posed.tolist() == [True, True, True, False]
    assert not made.report.views[3].registered
    assert made.report.views[3].reason
    assert made.report.views[3].placed_like is not None
    assert made.confident[:3].min() > 0.1
    assert made.confident[3] == 0
    assert made.psnr[:3].min() > 18


def test_a_camera_that_only_turns_gives_no_depth_but_its_turn(tmp_path: Path, mini: LoadedModel) -> None:
    photo = cv2.resize(place(3, 2)[0], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    made = Reconstructed(tmp_path, turned(photo, (-7.0, 0.0, 7.0)), mini)
    assert made.finite
    assert made.confident.max() < 0.02, "without parallax there is no depth"
    assert made.report.notes
    angle = rotation_angle_deg(made.world_from_cam[:1, :3, :3], made.world_from_cam[2:, :3, :3])
    assert float(angle) == pytest.approx(14, abs=2)
    assert made.psnr.min() > 18


def test_plain_walls_are_flagged(tmp_path: Path, mini: LoadedModel) -> None:
    made = Reconstructed(tmp_path, plain_walls(3), mini)
    assert made.finite
    assert made.posed.sum() <= 1
    assert made.confident.max() == 0
    assert made.report.notes
    assert made.psnr[0] > 25


@pytest.mark.slow
def test_many_photos_of_several_places_do_not_mix(tmp_path: Path, mini: LoadedModel) -> None:
    """As for sets too large to choose among models: the largest part that hangs together is posed, the rest is named."""
    many = replace(FRONTEND, sfm=replace(FRONTEND.sfm, choose_most_views=2))
    made = Reconstructed(tmp_path, [*place(1, 3), *place(5, 2)[:1], *place(9, 2)[:2]], mini, many)
    assert made.finite
    assert made.posed[:3].all()
    assert not made.posed[3:].any()
    assert all(view.reason for view in made.report.views[3:])
    assert made.confident[3:].max() == 0
