"""A whole round in memory, with a small convolutional model and with a complete but tiny WorldMirror."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.expansion import (
    LoadedModel,
    ModelConfig,
    PriorsUse,
    RoundInputs,
    captured_prediction,
    initial_state,
    joint_reconstruction,
    load_model,
)
from sceneexpander.frontend.prior import FrontendConfig, SettledCameras
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.photometric.warmup import held_out_cells, warm_up
from tests.support.methods import make_procedure
from tests.support.tiny_model import TinyReconstructor, tiny_images
from tests.worlds.artifacts import make_views

CONFIG = AdaptConfig(steps=4, learning_rate=1e-3)


def _tiny() -> LoadedModel:
    model = TinyReconstructor()
    return LoadedModel(
        model=model,
        base={k: v.clone() for k, v in model.state_dict().items()},
        weights_sha256="0",
        licence="none",
        device=torch.device("cpu"),
    )


def _scene(captured: int = 3) -> Scene:
    return Scene(name="s", views=make_views(captured), rounds=(RoundSpec(prompt="a bench"),))


def _inserted(number: int = 1) -> InsertedView:
    provenance = Provenance(backend="replay", prompt="p", source="x.png", sha256="0")
    view = make_views(1, generated=True, start=10 * number)
    return InsertedView(round=number, view=view, chosen=0, provenance=(provenance,))


def _round(loaded: LoadedModel, config: AdaptConfig = CONFIG) -> tuple[RoundInputs, object, object]:
    state, captured, _, _ = initial_state(_scene(), loaded, FrontendConfig(), WarmupConfig(), seed=0)
    anchors, again = captured_prediction(state, loaded)
    assert torch.equal(captured.depth, again.depth)
    inserted = _inserted()
    priors, backbone, _ = joint_reconstruction(state, inserted, loaded, FrontendConfig(), seed=0)
    inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    expanded = make_procedure(config).run(inputs, loaded, seed=0).scene
    return inputs, backbone, expanded


def test_zero_steps_give_the_unadapted_backbone_bit_for_bit() -> None:
    _, backbone, expanded = _round(_tiny(), replace(CONFIG, steps=0))
    for name in ("camera_vector", "depth", "normals"):
        assert torch.equal(getattr(backbone, name), getattr(expanded, name))
    assert torch.equal(backbone.gaussians.means, expanded.gaussians.means)
    assert backbone.weights_sha256 == expanded.weights_sha256


def test_an_adapted_round_differs_and_marks_what_was_generated() -> None:
    _, backbone, expanded = _round(_tiny())
    assert not torch.equal(backbone.depth, expanded.depth)
    assert backbone.weights_sha256 != expanded.weights_sha256
    assert expanded.generated.tolist() == [False, False, False, True]
    assert expanded.gaussians.generated.float().mean() == 0.25
    assert (expanded.gaussians.source_view[expanded.gaussians.generated] == 3).all()


def test_the_second_round_starts_from_the_first(tmp_path: Path) -> None:
    loaded = _tiny()
    inputs, _, _ = _round(loaded)
    made = make_procedure(CONFIG).run(inputs, loaded, seed=0)
    first, reconstruction = made.state, made.scene
    first.save(tmp_path / "state")
    state = type(first).load(tmp_path / "state")
    anchors, captured = captured_prediction(state, loaded)
    torch.testing.assert_close(captured.depth, reconstruction.depth)
    assert captured.generated.tolist() == [False, False, False, True]
    inserted = _inserted(2)
    priors, _, _ = joint_reconstruction(state, inserted, loaded, FrontendConfig(), seed=0)
    second = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    again = make_procedure(CONFIG).run(second, loaded, seed=0)
    after, expanded = again.state, again.scene
    assert len(after.views) == 5
    assert expanded.generated.tolist() == [False, False, False, True, True]


def test_what_earlier_rounds_inserted_keeps_its_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[SettledCameras | None] = []

    def note(views: ViewSet, *_: object, settled: SettledCameras | None, **__: object) -> tuple[Priors, None]:
        told.append(settled)
        return Priors(), None

    monkeypatch.setattr("sceneexpander.reconstruction.views.views_priors", note)
    loaded = _tiny()
    inputs, _, _ = _round(loaded)
    state = make_procedure(CONFIG).run(inputs, loaded, seed=0).state
    known = Priors(
        world_from_cam=torch.eye(4).repeat(4, 1, 1),
        intrinsics_px=torch.eye(3).repeat(4, 1, 1),
        posed=torch.tensor([True, True, False, True]),
    )
    joint_reconstruction(replace(state, priors=known), _inserted(2), loaded, FrontendConfig(), seed=0)
    *first_round, settled = told
    assert first_round == [None]  # photos are found again, with the new picture among them
    assert settled is not None
    assert settled.kept.tolist() == [False, False, False, True]
    assert settled.posed.tolist() == [True, True, False, True]
    assert settled.world_from_cam is known.world_from_cam


def test_worldmirror_runs_a_round_with_strictly_loaded_weights(tmp_path: Path) -> None:
    model = WorldMirror.create(WorldMirrorConfig.tiny(), generator=torch.Generator().manual_seed(0))
    with torch.no_grad():  # four refinement steps add up to an upright camera with a field of view of about 1 rad
        model.cam_head.param_predictor.fc2.bias.copy_(torch.tensor([0, 0, 0, 0, 0, 0, 1, 1, 1]) / 4)
    path = tmp_path / "wm.safetensors"
    save_file(model.state_dict(), str(path))
    loaded = load_model(ModelConfig(name="worldmirror", variant="tiny", weights=str(path)))
    scene = _scene()
    images = tiny_images(3, 28, 42)
    views = replace(scene.views, images=images, detail_images=images)
    state, captured, sparse, report = initial_state(
        replace(scene, views=views), loaded, FrontendConfig(), WarmupConfig(), seed=0
    )
    assert sparse is None
    assert report is None
    assert captured.model == "worldmirror"
    inserted = _inserted()
    picture = tiny_images(1, 28, 42, seed=5)
    inserted = replace(inserted, view=replace(inserted.view, images=picture, detail_images=picture))
    anchors, _ = captured_prediction(state, loaded)
    priors, backbone, _ = joint_reconstruction(state, inserted, loaded, FrontendConfig(), seed=0)
    inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    made = make_procedure(replace(CONFIG, insertion_probability=1.0)).run(inputs, loaded, seed=0)
    after, expanded, result = made.state, made.scene, made.adaptation
    assert not torch.equal(backbone.depth, expanded.depth)
    untouched = [name for name in loaded.base if name.startswith(("gs_head.", "gs_renderer.", "pts_head."))]
    assert untouched
    assert not set(untouched) & set(after.weights.change), "no loss reaches these heads"
    assert len(result.records) == CONFIG.steps


def test_omnivggt_as_the_reconstructor_is_told_what_the_front_end_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``model.priors=front_end``, through a whole round with adaptation."""
    model = OmniVGGT.create(OmniVGGTConfig.tiny(), generator=torch.Generator().manual_seed(0))
    save_file({k: v.clone() for k, v in model.state_dict().items()}, tmp_path / "weights.safetensors")
    asked: list[int] = []

    def found(images: torch.Tensor, *_: object, **__: object) -> tuple[Priors, None]:
        views, _, height, width = images.shape
        asked.append(views)
        poses = torch.eye(4).repeat(views, 1, 1)
        poses[:, 0, 3] = 0.3 * torch.arange(views)
        intrinsics = torch.tensor([[20.0, 0, width / 2], [0, 20.0, height / 2], [0, 0, 1]]).repeat(views, 1, 1)
        depth = torch.full((views, height, width), 2.0)
        return Priors(world_from_cam=poses, intrinsics_px=intrinsics, depth=depth), None

    small = make_views

    def views(count: int, *, generated: bool = False, start: int = 0) -> ViewSet:
        images = tiny_images(count, 28, 42, seed=start + 1)
        return replace(small(count, generated=generated, start=start), images=images, detail_images=images)

    monkeypatch.setattr("sceneexpander.reconstruction.views.build_priors", found)
    monkeypatch.setattr("tests.unit.expansion.test_rounds.make_views", views)
    results = {}
    for use in PriorsUse:
        config = ModelConfig(name="omnivggt", variant="tiny", weights=str(tmp_path / "weights.safetensors"), priors=use)
        _, backbone, expanded = _round(load_model(config), replace(CONFIG, steps=2))
        assert isinstance(expanded, Reconstruction)
        expanded.save(tmp_path / use.value)
        results[use] = backbone
    assert asked == [3, 4], "only when asked for: the captured views, then all"
    assert not torch.equal(results[PriorsUse.AUTO].depth, results[PriorsUse.FRONT_END].depth)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ModelConfig(name="wordmirror"), "did you mean 'worldmirror'"),
        (ModelConfig(name="worldmirror", weights="nowhere.safetensors"), "nowhere.safetensors: does not exist"),
        (ModelConfig(name="worldmirror"), "no built-in weights for worldmirror"),
    ],
)
def test_models_that_cannot_be_loaded_say_so_in_one_line(config: ModelConfig, message: str) -> None:
    with pytest.raises(UserError) as caught:
        load_model(config)
    assert message in caught.value.line()
    assert "\n" not in caught.value.line()


def test_warm_up_is_accepted_only_if_the_held_out_error_falls() -> None:
    images = tiny_images(3, 24, 32)
    model = TinyReconstructor()
    before = sha256_of_tensors(model.state_dict())
    config = WarmupConfig(steps=6, learning_rate=2e-3, cell_px=4)
    report = warm_up(model, images, None, config, seed=0)
    assert report is not None
    changed = sha256_of_tensors(model.state_dict()) != before
    assert changed == report.accepted == (report.after < report.before)
    assert report.accepted, "a model of random weights has room to improve"


def test_a_harmful_warm_up_is_taken_back_bit_for_bit() -> None:
    images = tiny_images(2, 24, 32)
    model = TinyReconstructor()
    before = sha256_of_tensors(model.state_dict())
    report = warm_up(model, images, None, WarmupConfig(steps=6, learning_rate=1.0, cell_px=4), seed=0)
    assert report is not None
    assert not report.accepted
    assert sha256_of_tensors(model.state_dict()) == before


def test_held_out_cells_are_whole_cells_of_the_asked_share() -> None:
    config = WarmupConfig(held_out=0.25, cell_px=8)
    cells = held_out_cells(4, 80, 120, config, seed=0)
    blocks = cells.reshape(4, 10, 8, 15, 8)
    assert (blocks.all(-1).all(2) == blocks.any(-1).any(2)).all()
    # 600 cells: 3 sigma of the share is 0.053
    assert abs(float(cells.float().mean()) - 0.25) < 0.055
