"""What a round does beyond the paper's steps, and in which order: on a world whose cameras, depths and light are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from sceneexpander.adaptation.config import AdaptConfig, Spend
from sceneexpander.adaptation.loop import AdaptationInputs
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.expansion import (
    LoadedModel,
    RoundInputs,
    captured_prediction,
    joint_reconstruction,
    judge_round,
)
from sceneexpander.expansion import procedure as procedure_module
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.geometry.gaussians import rgb_from_sh
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.insertion import camera as camera_module
from sceneexpander.insertion.camera import realign_priors
from sceneexpander.insertion.colour import Colour
from sceneexpander.insertion.contradiction import Contradiction, pixel_trust
from sceneexpander.insertion.gap_filling import GapFilling
from sceneexpander.insertion.head import GaussianHead
from sceneexpander.insertion.realign import Realign
from sceneexpander.insertion.report import Estimate
from sceneexpander.photometric import fitting as fitting_module
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.reconstruction import views as views_module
from sceneexpander.reconstruction.views import reconstruct
from sceneexpander.synthetic import make_views
from tests.support.gauged_model import GaugedReconstructor
from tests.support.methods import make_procedure
from tests.worlds.view_sets import view_set

VIEWS, H, W = 3, 84, 112
BRIGHT = 1.25
PLAIN = AdaptConfig(steps=2, learning_rate=1e-4, observe_every=0, checkpoint_every=0)
STILL = replace(PLAIN, steps=0)
PAINTED = (slice(30, 60), slice(40, 80))  # of the inserted picture: something that no photo shows there


@pytest.fixture(scope="module")
def truth() -> tuple[torch.Tensor, Priors]:
    made = make_views(11, views=VIEWS + 1, height=H, width=W, kind="room", degrade=False, split="test")
    depth = torch.where(made.valid, made.depth, made.depth[made.valid].max())
    priors = Priors(
        world_from_cam=made.world_from_cam,
        intrinsics_px=made.intrinsics_px,
        depth=depth,
        evidence=torch.zeros(VIEWS + 1, len(EVIDENCE_CHANNELS), H, W),
        posed=torch.ones(VIEWS + 1, dtype=torch.bool),
    )
    return made.images, priors


def loaded_model() -> LoadedModel:
    model = GaugedReconstructor()
    return LoadedModel(
        model=model,
        base={name: value.clone() for name, value in model.state_dict().items()},
        weights_sha256="0",
        licence="none",
        device=torch.device("cpu"),
    )


def inserted_view(picture: torch.Tensor, number: int = 1) -> InsertedView:
    view = view_set(picture[None], generated=True)
    record = replace(view.records[0], view_id=f"inserted_{number}", sha256=f"{number:064x}", round=number)
    source = Provenance(backend="replay", prompt="", source="x", sha256="0")
    return InsertedView(round=number, view=replace(view, records=(record,)), chosen=0, provenance=(source,))


def start(truth: tuple[torch.Tensor, Priors], loaded: LoadedModel, *, paint: bool = False) -> RoundInputs:
    """A round whose inserted picture is brighter than the photos, and has a green patch where they show none."""
    images, priors = truth
    picture = (images[VIEWS] * BRIGHT).clamp(0, 1)
    if paint:
        picture[:, PAINTED[0], PAINTED[1]] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]
    state = ExpansionState(
        views=view_set(images[:VIEWS], generated=False),
        priors=priors.select(range(VIEWS)),
        weights=WeightsChange.between(loaded.base, loaded.base),
    )
    anchors, _ = captured_prediction(state, loaded)
    return RoundInputs(state=state, inserted=inserted_view(picture), anchors=anchors, joint_priors=priors)


def new_gaussians(reconstruction: Reconstruction, name: str) -> torch.Tensor:
    values: torch.Tensor = getattr(reconstruction.gaussians, name)[reconstruction.gaussians.generated]
    return values


@pytest.mark.parametrize("tone", [False, True])
def test_tone_decides_which_picture_is_adapted_to(
    truth: tuple[torch.Tensor, Priors], monkeypatch: pytest.MonkeyPatch, tone: bool
) -> None:
    loaded, taken = loaded_model(), []
    inputs = start(truth, loaded)
    original: Callable[..., object] = procedure_module.adapt

    def spy(model: object, given: AdaptationInputs, *more: object, **named: object) -> object:
        taken.append(given.inserted)
        return original(model, given, *more, **named)

    monkeypatch.setattr(procedure_module, "adapt", spy)
    made = make_procedure(PLAIN, colour=Colour(match=tone)).run(inputs, loaded, seed=0)
    state, reconstruction = made.state, made.scene
    given = inputs.inserted.view.images[0]
    seen = (given > 0.2) & (given < 0.85)
    ratio = float((taken[0] / given)[seen].median())
    assert ratio == pytest.approx(1 / BRIGHT if tone else 1.0, rel=0.04)
    # The scene is made of the picture that was adapted to ...
    assert torch.equal(state.toned_views.images[VIEWS], taken[0])
    painted = rgb_from_sh(new_gaussians(reconstruction, "sh")[:, 0]).T.view(3, H, W)
    torch.testing.assert_close(painted, taken[0], atol=1e-5, rtol=0)
    # ... and what was given stays what others are given, under its own name and hash.
    assert torch.equal(state.views.images[VIEWS], given)
    assert state.views.records[VIEWS] == inputs.inserted.view.records[0]
    assert (state.toned is not None) == tone
    assert (made.corrections.gains is not None) == tone
    hashes = {state.views.records[VIEWS].sha256, state.toned_views.records[VIEWS].sha256}
    assert len(hashes) == 1 + tone, "a hash belongs to one picture"
    assert state.toned_views.records[:VIEWS] == state.views.records[:VIEWS]


def test_a_view_without_a_camera_keeps_its_tone(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded = loaded_model()
    inputs = start(truth, loaded)
    lost = replace(truth[1], posed=torch.tensor([True] * VIEWS + [False]))
    procedure = make_procedure(STILL, colour=Colour(match=True))
    found = procedure.correct_inputs(replace(inputs, joint_priors=lost), loaded, seed=0)
    assert found.toned is None
    assert found.report.gains is None


@pytest.mark.parametrize("trust", [False, True])
def test_trust_fades_what_the_photos_contradict(truth: tuple[torch.Tensor, Priors], trust: bool) -> None:
    loaded = loaded_model()
    procedure = make_procedure(STILL, colour=Colour(match=True), contradiction=Contradiction(fade=trust))
    reconstruction = procedure.run(start(truth, loaded, paint=True), loaded, seed=0).scene
    kept = (new_gaussians(reconstruction, "opacities") / 0.9).view(H, W)
    assert torch.allclose(reconstruction.gaussians.opacities[~reconstruction.gaussians.generated], torch.tensor(0.9))
    assert (float(kept[PAINTED].mean()) < 0.6) == trust
    assert (float(kept.min()) > 0.999) == (not trust)


@pytest.mark.parametrize("reach", [0.0, 0.7, 2.0])
def test_close_gaps_widens_gaussians_of_new_space(truth: tuple[torch.Tensor, Priors], reach: float) -> None:
    loaded = loaded_model()
    inputs = start(truth, loaded)
    plain = reconstruct(inputs.views, inputs.joint_priors, loaded, inputs.state.weights, method="plain")
    made = make_procedure(STILL, gaps=GapFilling(reach=reach)).run(inputs, loaded, seed=0).scene
    wider = new_gaussians(made, "scales").amax(1) > 1.01 * new_gaussians(plain, "scales").amax(1)
    assert (int(wider.sum()) > 100) == (reach > 0.6)
    old = ~made.gaussians.generated
    assert torch.equal(made.gaussians.scales[old], plain.gaussians.scales[old])


def test_without_corrections_and_steps_the_round_is_the_unadapted_model(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded = loaded_model()
    inputs = start(truth, loaded, paint=True)
    made = make_procedure(STILL).run(inputs, loaded, seed=0).scene
    plain = reconstruct(inputs.views, inputs.joint_priors, loaded, inputs.state.weights, method="plain")
    for part in fields(plain.gaussians):
        a, b = (getattr(own.gaussians, part.name) for own in (made, plain))
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_corrections_alone_are_the_round_without_a_step(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded = loaded_model()
    inputs = start(truth, loaded, paint=True)
    config = replace(PLAIN, steps=6, learning_rate=1e-2)
    around = {
        "colour": Colour(match=True),
        "gaps": GapFilling(reach=0.7),
        "contradiction": Contradiction(fade=True),
    }
    whole = make_procedure(config, head=GaussianHead(steps=2), **around)
    corrected = whole.without_steps().run(inputs, loaded, seed=0)
    state, made = corrected.state, corrected.scene
    unmoved = make_procedure(replace(config, steps=0), **around).run(inputs, loaded, seed=0)
    still, same = unmoved.state, unmoved.scene
    adapted = make_procedure(config, **around).run(inputs, loaded, seed=0).scene
    assert made.method == "corrected"
    assert corrected.corrections == unmoved.corrections
    assert corrected.corrections.gains is not None
    for part in fields(made.gaussians):
        a, b = (getattr(own.gaussians, part.name) for own in (made, same))
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    assert not torch.equal(made.depth, adapted.depth), "with steps it is another scene"
    assert state.weights.change == {} == still.weights.change
    assert float((new_gaussians(made, "opacities") / 0.9).view(H, W)[PAINTED].mean()) < 0.6


def test_the_next_round_starts_from_the_weights_of_the_last(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded = loaded_model()
    strong = replace(PLAIN, steps=8, learning_rate=1e-2, insertion_probability=1.0)
    round_one = make_procedure(strong).run(start(truth, loaded), loaded, seed=0)
    first, made = round_one.state, round_one.scene
    assert first.weights.change
    anchors, before = captured_prediction(first, loaded)
    torch.testing.assert_close(before.depth, made.depth)
    priors = first.priors
    joint = priors.select([*range(VIEWS + 1), 1])
    second = RoundInputs(state=first, inserted=inserted_view(truth[0][1], 2), anchors=anchors, joint_priors=joint)
    hardly = replace(PLAIN, steps=1, learning_rate=1e-12, restore_interval=0)
    after = make_procedure(hardly).run(second, loaded, seed=0).state
    start_of_second, end = first.weights.applied_to(loaded.base), after.weights.applied_to(loaded.base)
    for name, value in end.items():
        torch.testing.assert_close(value, start_of_second[name], atol=1e-7, rtol=0)
    assert max(float((end[n] - loaded.base[n]).abs().max()) for n in end) > 1e-3
    assert after.unadapted.change == {}


def test_in_every_round_others_see_the_given_pictures_and_the_baseline_is_unadapted(
    truth: tuple[torch.Tensor, Priors], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loaded = loaded_model()
    procedure = make_procedure(replace(PLAIN, steps=8, learning_rate=1e-2), colour=Colour(match=True))
    inputs = start(truth, loaded)
    first = procedure.run(inputs, loaded, seed=0).state
    first.save(tmp_path / "state")
    state = ExpansionState.load(tmp_path / "state")
    assert state.toned is not None
    pictures: list[torch.Tensor] = []

    def found(images: torch.Tensor, *_: object, **__: object) -> tuple[Priors, None]:
        pictures.append(images)
        return truth[1].select([*range(VIEWS + 1), 1]), None

    monkeypatch.setattr(views_module, "build_priors", found)
    priors, baseline, _ = joint_reconstruction(state, inserted_view(truth[0][1], 2), loaded, FrontendConfig(), seed=0)
    given = inputs.inserted.view.images[0]
    torch.testing.assert_close(pictures[0][VIEWS], given, atol=0.6 / 255, rtol=0)
    assert baseline.weights_sha256 == loaded.fingerprint(inputs.state.weights)
    assert baseline.weights_sha256 != loaded.fingerprint(state.weights)
    plain = reconstruct(
        state.views.append(inserted_view(truth[0][1], 2).view), priors, loaded, inputs.state.weights, method="backbone"
    )
    assert torch.equal(baseline.gaussians.sh, plain.gaussians.sh)
    assert torch.equal(baseline.depth, plain.depth)


def test_the_joint_estimate_comes_in_the_gauge_of_what_was_known(
    truth: tuple[torch.Tensor, Priors], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = loaded_model()
    inputs, priors = start(truth, loaded), truth[1]
    assert priors.world_from_cam is not None
    assert priors.depth is not None
    poses = priors.world_from_cam.clone()
    poses[:, :3, 3] *= 1.1
    other = replace(priors, world_from_cam=poses, depth=priors.depth * 1.1)
    monkeypatch.setattr(views_module, "build_priors", lambda *_, **__: (other, None))
    joint, baseline, _ = joint_reconstruction(inputs.state, inputs.inserted, loaded, FrontendConfig(), seed=0)
    torch.testing.assert_close(joint.world_from_cam, priors.world_from_cam, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(joint.depth, priors.depth, rtol=1e-5, atol=0)
    torch.testing.assert_close(baseline.depth[:VIEWS], inputs.anchors.depth, rtol=1e-5, atol=0)


def test_photos_are_never_doubted(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded = loaded_model()
    inputs = start(truth, loaded, paint=True)
    made = reconstruct(inputs.views, inputs.joint_priors, loaded, inputs.state.weights, method="backbone")
    trust = pixel_trust(made, inputs.views.images)
    assert bool((trust[:VIEWS] == 1).all())
    assert float(trust[VIEWS][PAINTED].mean()) < 0.5


def test_which_estimate_was_taken_is_written_down(truth: tuple[torch.Tensor, Priors]) -> None:
    loaded, (_, priors) = loaded_model(), truth
    inputs = start(truth, loaded)
    assert priors.depth is not None
    bent = priors.depth.clone()
    bent[1] *= 0.7
    worse = replace(inputs, joint_priors=replace(priors, depth=bent))
    for given, estimate in ((worse, Estimate.HELD), (inputs, Estimate.JOINT)):
        taken, corrections = realign_priors(given, loaded, Realign.CHOOSE, seed=0)
        assert corrections.estimate is estimate
        assert corrections.joint_error is not None
        assert corrections.held_error is not None
        assert (corrections.held_error < corrections.joint_error) == (estimate is Estimate.HELD)
        assert (taken is given.joint_priors) == (estimate is Estimate.JOINT)
    _, corrections = realign_priors(inputs, loaded, Realign.REFINE, seed=0)
    assert corrections.estimate is Estimate.HELD
    assert corrections.refinement is not None
    assert realign_priors(inputs, loaded, Realign.NONE, seed=0)[1].estimate is Estimate.JOINT


def test_a_photo_without_a_camera_has_no_say_in_the_choice(
    truth: tuple[torch.Tensor, Priors], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What its placeholder shows says nothing about an estimate."""
    loaded, compared = loaded_model(), []

    def spy(prediction: object, views: object, photos: torch.Tensor) -> float:
        compared.append(photos.tolist())
        return 0.0

    monkeypatch.setattr(camera_module, "_photo_error", spy)
    inputs = start(truth, loaded)
    for before, after, expected in (
        ([True, True, False], [True, True, True, True], [True, True, False, False]),
        ([True, True, True], [False, True, True, True], [False, True, True, False]),
        ([True, False, False], [False, True, True, True], [True, True, True, False]),  # none on both sides: all photos
    ):
        state = replace(inputs.state, priors=replace(inputs.state.priors, posed=torch.tensor(before)))
        joint = replace(inputs.joint_priors, posed=torch.tensor(after))
        realign_priors(replace(inputs, state=state, joint_priors=joint), loaded, Realign.CHOOSE, seed=0)
        assert compared[-2:] == [expected, expected]


@pytest.mark.parametrize(
    ("spend", "factor", "above", "steps"),
    [
        (Spend.ALWAYS, 1.0, 0.02, True),
        (Spend.ALWAYS, 1.2, 0.02, True),
        (Spend.WHERE_MOVED, 1.0, 0.02, False),
        (Spend.WHERE_MOVED, 1.2, 0.02, True),
        (Spend.WHERE_MOVED, 1.2, 0.5, False),
    ],
)
def test_steps_are_spent_where_there_is_something_to_repair(
    truth: tuple[torch.Tensor, Priors], spend: Spend, factor: float, above: float, steps: bool
) -> None:
    """The insertion gives one of the captured views another depth, or it does not."""
    loaded, (_, priors) = loaded_model(), truth
    assert priors.depth is not None
    moved = priors.depth.clone()
    moved[1] *= factor
    inputs = replace(start(truth, loaded), joint_priors=replace(priors, depth=moved))
    config = replace(PLAIN, spend=spend, spend_above=above)
    made = make_procedure(config).run(inputs, loaded, seed=0)
    assert len(made.adaptation.records) == (PLAIN.steps if steps else 0)
    assert bool(made.state.weights.change) == steps
    if not steps:
        still = make_procedure(replace(config, steps=0)).run(inputs, loaded, seed=0)
        assert torch.equal(made.scene.depth, still.scene.depth)


def test_a_placeholder_hardly_moves_the_inserted_camera(truth: tuple[torch.Tensor, Priors]) -> None:
    """A photo without a camera before the insertion borrows another's pose; with the inserted view it is found."""
    loaded, (_, priors) = loaded_model(), truth
    assert priors.world_from_cam is not None
    poses = priors.world_from_cam[:VIEWS].clone()
    poses[2] = poses[0]
    posed = torch.tensor([True, True, False])
    inputs = start(truth, loaded)
    captured = replace(inputs.state.priors, world_from_cam=poses, posed=posed)
    inputs = replace(inputs, state=replace(inputs.state, priors=captured))
    held, _ = realign_priors(inputs, loaded, Realign.HOLD, seed=0)
    torch.testing.assert_close(held.world_from_cam[-1], priors.world_from_cam[-1], atol=1e-4, rtol=0)
    torch.testing.assert_close(held.depth[-1], priors.depth[-1], rtol=1e-4, atol=0)
    verdict = judge_round(inputs)
    assert verdict is not None
    assert verdict.cameras_moved_deg < 0.01
    assert verdict.depth_conflict is not None
    assert verdict.depth_conflict < 0.02


@pytest.mark.parametrize("trust", [False, True])
def test_the_fit_of_a_round_sees_what_the_round_worked_with(
    truth: tuple[torch.Tensor, Priors], monkeypatch: pytest.MonkeyPatch, trust: bool
) -> None:
    loaded = loaded_model()
    told: list[tuple[torch.Tensor, torch.Tensor | None]] = []

    def spy(start: Reconstruction, images: torch.Tensor, config: RefineConfig, **more: torch.Tensor | None) -> object:
        told.append((images, more["weights"]))
        return start, None

    monkeypatch.setattr(fitting_module, "refine", spy)
    sections = {"colour": Colour(match=True), "contradiction": Contradiction(fade=trust)}
    procedure = make_procedure(STILL, RefineConfig(visits=1), **sections)
    state = procedure.run(start(truth, loaded, paint=True), loaded, seed=0).state
    images, weights = told[0]
    assert torch.equal(images, state.toned_views.images)
    assert not torch.equal(images, state.views.images)
    assert (weights is not None) == trust
    assert weights is None or float(weights[VIEWS][PAINTED].mean()) < 0.5
