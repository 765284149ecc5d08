"""Cells measured for real, on small pictures: what a method is given, what a row is made of, and that rows of a pair are alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import save_priors
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.compose import compose
from sceneexpander.config.files import write_settings
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.expandbench import run as bench
from sceneexpander.expandbench import scenes
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.prepared import PreparedScene, prepare_case, prepare_scene
from sceneexpander.expandbench.run import BASELINE, CAPTURED, Settings
from sceneexpander.expandbench.scenes import BenchScene
from sceneexpander.expansion import MethodConfig, compose_procedure
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.insertion.config import ENTRY_POINTS
from sceneexpander.insertion.contradiction import pixel_trust
from sceneexpander.photometric import fitting
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.pipeline.packages import LOCKS
from sceneexpander.splatting.kernel_backend import kernel_build
from stages import adapt, correct, layout

ROOT = Path(__file__).parents[3]
GRADE = "mixed_2"
QUICK = ("frontend.sfm.learned=never", "frontend.sfm.max_features=1500", "warmup.steps=0", "refine.visits=1")


def config(row: str) -> ProjectConfig:
    steps = [] if row == "corrected" else ["adapt.steps=1"]
    values = compose(ROOT / "conf", ["experiment=expandbench", f"ablation={row}", *QUICK, *steps])
    return parse_dataclass(ProjectConfig, values)


def method(row: str) -> MethodConfig:
    chosen = config(row)
    return MethodConfig(adapt=chosen.adapt, corrections=chosen.corrections)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums round as threads divide them, and a stage that runs in this process sets their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[bench._Worker]:
    """A scene's worker at a quarter of the benchmark's pixels, with its case prepared."""
    shared = config("default")
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
        made = bench._Worker("courtyard_1", settings)
        assert bool(made.case(GRADE).inputs.joint_priors.posed[-1]), "the inserted view takes part"
        yield made


def kept(worker: bench._Worker, monkeypatch: pytest.MonkeyPatch, grade: str, row: str, seed: int) -> Reconstruction:
    """The reconstruction that a cell is measured on."""
    seen: list[Reconstruction] = []

    def numbers(_: bench._Worker, reconstruction: Reconstruction, case: object) -> Any:
        seen.append(reconstruction)

    monkeypatch.setattr(bench._Worker, "_numbers", numbers)
    worker._measured(grade, row, seed, None if row in (CAPTURED, BASELINE) else method(row))
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
    procedure = compose_procedure(method("default"), fit)
    assert procedure.doubted
    found = kept(worker, monkeypatch, GRADE, "default", 1)
    assert same(found, procedure.run(inputs, worker.loaded, seed=1).scene)
    trustful = replace(procedure, doubted=False).run(inputs, worker.loaded, seed=1).scene
    assert not same(found, trustful), "doubt changes something here"
    assert not same(found, kept(worker, monkeypatch, GRADE, "default", 2)), "the seed is the fit's, too"

    wanted = procedure.without_steps().run(inputs, worker.loaded, seed=1).scene
    assert same(kept(worker, monkeypatch, GRADE, "corrected", 1), wanted)


TOY = """
from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Dim:
    share: float = 1.0

    def correct_scene(self, scene, inputs, context):
        gaussians = scene.gaussians
        return replace(scene, gaussians=replace(gaussians, opacities=gaussians.opacities * self.share))
"""


def test_a_correction_of_another_package_runs_in_stages_and_benchmark(
    worker: bench._Worker, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Installed with an entry point and given settings: nothing of this package names it."""
    packages = tmp_path / "packages"
    (packages / "toy-1.0.dist-info").mkdir(parents=True)
    (packages / "toy.py").write_text(TOY)
    (packages / "toy-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    (packages / "toy-1.0.dist-info" / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\ndim = toy:Dim\n")
    monkeypatch.syspath_prepend(str(packages))
    overrides = ["+corrections.others.dim.share=0.5", "refine.visits=0", "adapt.steps=0", "threads=1"]
    values = compose(ROOT / "conf", ["experiment=expandbench", *overrides])
    chosen = parse_dataclass(ProjectConfig, values)
    with pytest.raises(ConfigError, match="did you mean 'dim'"):
        compose(ROOT / "conf", ["+corrections.others.dimm.share=0.5"])
    with pytest.raises(ConfigError, match="share"):
        compose(ROOT / "conf", ["+corrections.others.dim.share=half"])

    monkeypatch.setattr(worker, "settings", replace(worker.settings, refine=chosen.refine))
    plain = MethodConfig(adapt=chosen.adapt, corrections=replace(chosen.corrections, others={}))
    measured: list[Reconstruction] = []
    monkeypatch.setattr(bench._Worker, "_numbers", lambda _, scene, case: measured.append(scene))
    for row in (plain, MethodConfig(adapt=chosen.adapt, corrections=chosen.corrections)):
        worker._measured(GRADE, "toy", chosen.seed, row)
    without, found = measured[1], measured[3]  # before each: the same weights alone
    torch.testing.assert_close(found.gaussians.opacities, 0.5 * without.gaussians.opacities)

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DVC_STAGE", raising=False)
    inputs = worker.case(GRADE).inputs
    inputs.state.save(layout.state("s", 0))
    inputs.inserted.save(layout.inserted("s", 1))
    inputs.anchors.save(layout.anchors("s", 1))
    save_priors(layout.joint_priors("s", 1), inputs.joint_priors)
    write_settings(layout.config("s"), values)
    write_json_atomic(layout.ENVIRONMENT, {"kernel": kernel_build()})
    for lock in LOCKS:
        (tmp_path / lock).symlink_to(ROOT / lock)
    write_json_atomic(layout.CODE, {"adapt": "0" * 64, "correct": "0" * 64})
    write_settings(layout.selection("s"), {"corrected": True})
    for stage, method in ((adapt, "sceneexpander"), (correct, "corrected")):
        more = [method] if stage is correct else []
        monkeypatch.setattr("sys.argv", [stage.__name__, "s", "1", "0", *more])
        stage.main()
        assert same(Reconstruction.load(layout.reconstruction("s", 1, method)), found), stage.__name__


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
        wanted, _ = fitting.fit_to_views(start, views, fit, seed=seed)
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
    # The wrong camera that is told is noticed to contradict the pictures, and an estimate takes its place.
    assert (float(moved) > 0.1) is told
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
