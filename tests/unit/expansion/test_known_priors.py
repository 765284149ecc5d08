"""What came with the pictures changes what models make of them, unless the pictures contradict it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.artifacts.scene import KnownCameras, Scene
from sceneexpander.artifacts.state import WeightsChange
from sceneexpander.frontend.known_depth import merge_known_depth
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.reconstruction.loaded import LoadedModel, ModelConfig, load_model
from sceneexpander.reconstruction.views import predict, views_priors
from tests.support.tiny_worldmirror import tiny_worldmirror
from tests.worlds.told_cameras import known_cameras, read, scene_folder

pytestmark = pytest.mark.timeout(300)
FRONT_END = FrontendConfig(sfm=SfmConfig(learned=LearnedUse.NEVER))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return read(scene_folder(tmp_path_factory.mktemp("known") / "s"))[0]


@pytest.fixture(scope="module")
def truth(scene: Scene) -> KnownCameras:
    return known_cameras(scene)


def worldmirror() -> LoadedModel:
    model = tiny_worldmirror()
    base = {name: value.clone() for name, value in model.state_dict().items()}
    return LoadedModel(model=model, base=base, weights_sha256="0", licence="none", device=torch.device("cpu"))


def test_mini_takes_known_cameras_as_they_are(scene: Scene, truth: KnownCameras) -> None:
    loaded = load_model(ModelConfig())
    told, sparse = views_priors(scene.views, loaded, FRONT_END, seed=0, known=truth)
    alone, _ = views_priors(scene.views, loaded, FRONT_END, seed=0)
    assert sparse is not None
    assert not any("contradict" in note for note in sparse.report.notes)
    assert told.world_from_cam is not None
    assert alone.world_from_cam is not None
    assert truth.world_from_cam is not None
    relative = torch.linalg.inv(truth.world_from_cam[0]) @ truth.world_from_cam
    assert float(rotation_angle_deg(told.world_from_cam[:, :3, :3], relative[:, :3, :3]).max()) < 0.05
    assert float(rotation_angle_deg(alone.world_from_cam[:, :3, :3], relative[:, :3, :3]).max()) > 0.05
    none = WeightsChange.between(loaded.base, loaded.base)
    depths = [predict(scene.views, priors, loaded, none).depth for priors in (told, alone)]
    assert depths[0] is not None
    assert depths[1] is not None
    assert float(((depths[0] - depths[1]).abs() / depths[1]).median()) > 1e-3


@pytest.mark.parametrize("kind", ["world_from_cam", "intrinsics_px", "depth"])
def test_a_worldmirror_takes_each_kind(scene: Scene, truth: KnownCameras, kind: str) -> None:
    loaded = worldmirror()
    if kind == "depth":
        ramp = torch.linspace(1, 3, scene.views.height)[:, None].expand(len(scene.views), -1, scene.views.width)
        known = KnownCameras(depth=ramp.contiguous())
    else:
        known = KnownCameras(**{kind: getattr(truth, kind)})
    none = WeightsChange.between(loaded.base, loaded.base)
    priors, _ = views_priors(scene.views, loaded, FRONT_END, seed=0, known=known)
    alone, _ = views_priors(scene.views, loaded, FRONT_END, seed=0)
    told, without = (predict(scene.views, p, loaded, none).camera_vector for p in (priors, alone))
    assert float((told - without).abs().max()) > 1e-5


def test_a_pose_that_contradicts_the_pictures_is_named_and_the_rest_is_used(scene: Scene, truth: KnownCameras) -> None:
    assert truth.world_from_cam is not None
    poses = truth.world_from_cam.clone()
    turn = torch.tensor([[0.9, 0, 0.436, 0], [0, 1, 0, 0], [-0.436, 0, 0.9, 0], [0, 0, 0, 1]])
    poses[1] = poses[1] @ turn
    priors, _ = views_priors(scene.views, worldmirror(), FRONT_END, seed=0, known=replace(truth, world_from_cam=poses))
    assert priors.posed is not None
    assert priors.posed.tolist() == [True, False, True]


def test_axes_of_another_habit_are_recognised(
    scene: Scene, truth: KnownCameras, caplog: pytest.LogCaptureFixture
) -> None:
    assert truth.world_from_cam is not None
    flipped = truth.world_from_cam @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
    known = replace(truth, world_from_cam=flipped)
    priors, _ = views_priors(scene.views, worldmirror(), FRONT_END, seed=0, known=known)
    assert priors.world_from_cam is None
    assert "other habit of camera axes" in caplog.text


def test_intrinsics_of_some_views_serve_the_others(scene: Scene, truth: KnownCameras) -> None:
    assert truth.intrinsics_px is not None
    some = truth.intrinsics_px.clone()
    some[1:] = float("nan")
    priors, _ = views_priors(scene.views, worldmirror(), FRONT_END, seed=0, known=KnownCameras(intrinsics_px=some))
    assert priors.intrinsics_px is not None
    torch.testing.assert_close(priors.intrinsics_px, truth.intrinsics_px, atol=0.5, rtol=0)


@pytest.mark.parametrize("wrong", [False, True])
def test_measured_depth_takes_the_place_of_matched_depth_where_it_agrees(wrong: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    matched = 1 + torch.rand(2, 20, 30, generator=generator)
    evidence = torch.full((2, len(EVIDENCE_CHANNELS), 20, 30), 0.5)
    evidence[:, EVIDENCE_CHANNELS.index("confident")] = 1
    known = matched * 4 * (1 + 0.02 * torch.rand(2, 20, 30, generator=generator))
    if wrong:
        known = known.flip(-1)
    known[:, :, :5] = 0
    depth, told, note = merge_known_depth(matched, evidence, known, unit=0.25)
    if wrong:
        assert "contradicts" in note
        assert torch.equal(depth, matched)
    else:
        assert note == ""
        assert torch.equal(depth[:, :, :5], matched[:, :, :5])
        torch.testing.assert_close(depth[:, :, 5:], known[:, :, 5:] / 4)
        assert not told[:, EVIDENCE_CHANNELS.index("cost"), :, 5:].any()
