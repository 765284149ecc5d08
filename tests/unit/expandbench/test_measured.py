"""Cells measured for real, on small pictures: what a method is given, what a row is made of, and that rows of a pair are alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sceneexpander.adaptation.consistency import pixel_trust
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.expandbench import run as bench
from sceneexpander.expandbench import scenes
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.prepared import PreparedScene, prepare_case, prepare_scene
from sceneexpander.expandbench.run import BASELINE, CAPTURED, Settings
from sceneexpander.expandbench.scenes import BenchScene
from sceneexpander.expansion import adapt_round, correct_round, refined, refined_round
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.optimisation.config import RefineConfig
from sceneexpander.reconstruction import fitting

ROOT = Path(__file__).parents[3]
GRADE = "mixed_2"
QUICK = ("frontend.sfm.learned=never", "warmup.steps=0", "refine.visits=1")


def config(row: str) -> ProjectConfig:
    steps = [] if row == "corrected" else ["adapt.steps=1"]
    values = compose(ROOT / "conf", ["experiment=expandbench", f"ablation={row}", *QUICK, *steps])
    return parse_dataclass(ProjectConfig, values)


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[bench._Worker]:
    """A scene's worker at a quarter of the benchmark's pixels, with its case prepared."""
    shared = config("none")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "HEIGHT", 84)
        patch.setattr(scenes, "WIDTH", 112)
        settings = Settings(
            model=shared.model,
            frontend=shared.frontend,
            warmup=shared.warmup,
            refine=shared.refine,
            cache=tmp_path_factory.mktemp("cache"),
        )
        made = bench._Worker("corridor_2", settings)
        assert bool(made.case(GRADE).inputs.joint_priors.posed[-1]), "the inserted view takes part"
        yield made


def kept(worker: bench._Worker, monkeypatch: pytest.MonkeyPatch, grade: str, row: str, seed: int) -> Reconstruction:
    """The reconstruction that a cell is measured on."""
    seen: list[Reconstruction] = []

    def numbers(_: bench._Worker, reconstruction: Reconstruction, case: object) -> Any:
        seen.append(reconstruction)

    monkeypatch.setattr(bench._Worker, "_numbers", numbers)
    adapt = None if row in (CAPTURED, BASELINE) else config(row).adapt
    worker._measured(grade, row, seed, adapt)
    return seen[-1]


def same(one: Reconstruction, other: Reconstruction) -> bool:
    names = ("means", "scales", "opacities", "sh")
    return len(one.gaussians) == len(other.gaussians) and all(
        torch.equal(getattr(one.gaussians, name), getattr(other.gaussians, name)) for name in names
    )


def test_a_row_is_what_the_pipeline_makes_of_the_same_inputs(
    worker: bench._Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the stages adapt and correct do it: the fit with the doubts that the row asks for, at the row's seed."""
    inputs, fit = worker.case(GRADE).inputs, worker.settings.refine
    adapt = config("none").adapt
    assert adapt.trust
    state, reconstruction, _ = adapt_round(inputs, worker.loaded, adapt, seed=1)
    wanted, _ = refined_round(reconstruction, state, adapt, fit, seed=1)
    found = kept(worker, monkeypatch, GRADE, "none", 1)
    assert same(found, wanted)
    trustful, _ = refined(reconstruction, state.toned_views, fit, doubt_generated=False, seed=1)
    assert not same(found, trustful), "doubt changes something here"
    assert not same(found, kept(worker, monkeypatch, GRADE, "none", 2)), "the seed is the fit's, too"

    state, reconstruction, _ = correct_round(inputs, worker.loaded, adapt, seed=1)
    wanted, _ = refined_round(reconstruction, state, adapt, fit, seed=1)
    assert same(kept(worker, monkeypatch, GRADE, "corrected", 1), wanted)


@pytest.mark.parametrize("row", [CAPTURED, BASELINE])
def test_fixed_rows_are_fitted_with_the_seed_of_their_pair_and_doubt_nothing(
    worker: bench._Worker, monkeypatch: pytest.MonkeyPatch, row: str
) -> None:
    found = {seed: kept(worker, monkeypatch, "" if row == CAPTURED else GRADE, row, seed) for seed in (0, 3)}
    inputs, fit = worker.case(GRADE).inputs, worker.settings.refine
    views = inputs.state.views
    start = worker.prepared.captured
    if row == BASELINE:
        views, start = views.append(inputs.inserted.view), worker.case(GRADE).backbone
    for seed, reconstruction in found.items():
        wanted, _ = refined(start, views, fit, doubt_generated=False, seed=seed)
        assert same(reconstruction, wanted)
    assert not same(found[0], found[3])
    assert not same(found[0], start), "a fit, and a kept one"


def test_every_row_of_a_pair_is_fitted_as_long_per_view(worker: bench._Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: dict[int, set[float]] = {}
    whole = fitting.refine

    def counted(start: Reconstruction, images: Any, settings: RefineConfig, **more: Any) -> Any:
        result, report = whole(start, images, settings, **more)
        assert report is not None
        steps.setdefault(len(start.view_ids), set()).add(report.steps / int(start.posed.sum()))
        return result, report

    monkeypatch.setattr(fitting, "refine", counted)
    for row in (CAPTURED, BASELINE, "corrected"):
        kept(worker, monkeypatch, "" if row == CAPTURED else GRADE, row, 0)
    assert steps == {5: {1.0}, 6: {1.0}}


def astray(scene: BenchScene) -> BenchScene:
    """The scene with everything that is known about it wrong, its pictures excepted."""
    turn = torch.eye(4)
    turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, 0.0], [-0.4, 0.0, 0.0]]))
    intended = replace(scene.intended, world_from_cam=scene.intended.world_from_cam @ turn)
    truth = {
        digest: replace(view, depth=None if view.depth is None else view.depth.flip(0) * 1.7)
        for digest, view in scene.captured_truth.items()
    }
    return replace(scene, intended=intended, captured_truth=truth)


@pytest.fixture(scope="module")
def misled(worker: bench._Worker, tmp_path_factory: pytest.TempPathFactory) -> tuple[BenchScene, PreparedScene]:
    """The scene with wrong truth, and what a method makes of its captured views."""
    s, wrong = worker.settings, astray(worker.scene)
    prepared = prepare_scene(wrong, worker.loaded, s.frontend, s.warmup, tmp_path_factory.mktemp("wrong"))
    assert torch.equal(prepared.captured.depth, worker.prepared.captured.depth)
    return wrong, prepared


@pytest.mark.parametrize(("grade", "told"), [(GRADE, False), ("told_clean", True)])
def test_nothing_of_the_truth_reaches_a_method_unless_the_grade_says_so(
    worker: bench._Worker, misled: tuple[BenchScene, PreparedScene], tmp_path: Path, grade: str, told: bool
) -> None:
    s, (wrong, prepared) = worker.settings, misled
    case = prepare_case(wrong, prepared, grade_named(grade), worker.loaded, s.frontend, tmp_path)
    right = worker.case(grade)
    moved = rotation_angle_deg(case.backbone.world_from_cam[-1, :3, :3], right.backbone.world_from_cam[-1, :3, :3])
    assert (float(moved) > 5) is told
    assert torch.equal(case.backbone.world_from_cam, right.backbone.world_from_cam) is not told
    assert torch.equal(case.inputs.joint_priors.depth, right.inputs.joint_priors.depth) is not told  # type: ignore[arg-type]


def test_the_inserted_picture_that_a_method_gets_is_the_one_that_was_drawn_wrongly(worker: bench._Worker) -> None:
    view = worker.case(GRADE).inputs.inserted.view
    assert bool(view.generated.all())
    drawn, _ = worker.scene.insert(grade_named(GRADE).misalignment)
    assert torch.equal(view.images, drawn.images)
    assert not torch.equal(view.images[0], worker.scene.intended.image)


def test_pixel_doubt_is_about_the_generated_picture_alone(worker: bench._Worker) -> None:
    """Else the test of the pipeline's fit above would not tell it from the baseline's."""
    case = worker.case(GRADE)
    views = case.inputs.state.views.append(case.inputs.inserted.view)
    trust = pixel_trust(case.backbone, views.images)
    assert bool((trust[:-1] == 1).all())
    assert float(trust[-1].min()) < 0.5
