"""What the steps of Algorithm 1 bring, and whether it is told before: python scripts/steps_study.py SCENE ... --out F.json [key=value ...]

Per scene of the benchmark: the verdict that ``adapt.spend=where_moved`` goes by, and the corrected scene without a step, with the steps,
and with steps that count contradicted pixels of the inserted picture less (``adapt.inserted_weights=supported``). Rows of a scene differ in
nothing else. What is measured already is read from the file: an interrupted run continues.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from sceneexpander.adaptation.config import InsertedWeights, Spend
from sceneexpander.artifacts.store import read_json, read_typed, write_json_atomic
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import entry_point
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.expandbench import BenchScene, measure, prepare_case
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.prepared import prepare_scene
from sceneexpander.expandbench.scenes import bench_scene, draw_scene
from sceneexpander.expansion import LoadedModel, MethodConfig, Procedure, RoundInputs, compose_procedure, load_model
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.misalignment import report_misalignment
from sceneexpander.ingest.fit import fit_picture
from sceneexpander.insertion.acceptance import captured_moved
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.pipeline.project import find_project
from sceneexpander.reconstruction.views import predict

OUTCOMES = (
    "psnr_captured_db",
    "depth_abs_rel",
    "psnr_new_region_db",
    "new_region_drawn_abs_rel",
    "psnr_half_way_db",
    "psnr_inserted_seen_db",
)
CHEAP = EvaluateConfig(flip=False, st_lpips=False)
WITHOUT = "no step"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A scene's rows, by name. ``moved``: the verdict; ``contradicted``: share of the inserted picture, None: it has no camera."""

    scene: str
    grade: str
    moved: float
    contradicted: float | None
    rows: dict[str, dict[str, float | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """All that is measured. ``settings``: what it was measured with."""

    settings: str
    scenes: tuple[Measured, ...] = ()


def moved_by(inputs: RoundInputs, loaded: LoadedModel) -> float:
    """The verdict, see `Spend`."""
    seen = predict(inputs.views, inputs.joint_priors, loaded, inputs.state.weights)
    assert seen.depth is not None  # noqa: S101 - the embedded model has the head
    count, posed = len(inputs.state.views), inputs.joint_priors.posed
    return captured_moved(inputs.anchors, seen.depth[:count].cpu(), None if posed is None else posed[:count])


def measure_scene(scene: BenchScene, grade: str, config: ProjectConfig, loaded: LoadedModel, cache: Path) -> Measured:
    """All rows of a scene."""
    before = prepare_scene(scene, loaded, config.frontend, config.warmup, cache)
    case = prepare_case(scene, before, grade_named(grade), loaded, config.frontend, cache)
    views, view = before.state.views, case.inputs.inserted.view
    fitted, _ = fit_to_views(before.captured, views, config.refine, seed=config.seed)
    picture = fit_picture(to_uint8(view.detail_images[0]), frame_of(views), "crop")
    found = report_misalignment(picture, SceneSoFar(views=views, reconstruction=fitted), seed=config.seed)
    inputs = replace(case.inputs, inserted=replace(case.inputs.inserted, support=found.support))
    adapt = replace(config.adapt, spend=Spend.ALWAYS)
    procedures: dict[str, Procedure] = {}
    for weights in (InsertedWeights.UNIFORM, InsertedWeights.SUPPORTED):
        method = MethodConfig(adapt=replace(adapt, inserted_weights=weights), corrections=config.corrections)
        procedures[weights.value] = compose_procedure(method, config.refine)
    procedures = {WITHOUT: procedures["uniform"].without_steps(), **procedures}
    rows = {}
    for row, procedure in procedures.items():
        made = procedure.run(inputs, loaded, seed=config.seed).scene
        numbers = measure(made, views.append(view), case.truth, scene, CHEAP)
        rows[row] = {outcome: numbers.value(outcome) for outcome in OUTCOMES}
    moved = moved_by(procedures[WITHOUT].correct_inputs(inputs, loaded, seed=config.seed), loaded)
    return Measured(scene=scene.name, grade=grade, moved=moved, contradicted=found.report.contradicted, rows=rows)


def lines(scenes: Sequence[Measured]) -> Iterator[str]:
    """Per scene the verdict and every row's difference to the one without a step."""
    for item in scenes:
        share = "-" if item.contradicted is None else f"{item.contradicted:.3f}"
        yield f"{item.scene} {item.grade}: moved {item.moved:.4f}, contradicted {share}"
        for row, numbers in item.rows.items():
            shown = []
            for outcome, value in numbers.items():
                first = item.rows[WITHOUT][outcome]
                difference = None if value is None or first is None else value - first
                told = value if row == WITHOUT else difference
                shown.append(f"{outcome} {'-' if told is None else format(told, '+.4f')}")
            yield f"  {row:10s} {'  '.join(shown)}"


@entry_point
def main() -> None:
    """Measure what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="scene of the benchmark, or key=value")
    parser.add_argument("--grade", default="mixed_2")
    parser.add_argument("--shrink", type=int, default=1, help="scenes have that many times fewer pixels per side")
    parser.add_argument("--cache", type=Path, required=True, help="prepared scenes, reused")
    parser.add_argument("--out", type=Path, required=True, help="results, continued if they are there")
    options = parser.parse_intermixed_args()
    overrides = [word for word in options.scenes if "=" in word]
    config = parse_dataclass(ProjectConfig, compose(find_project() / "conf", ["experiment=expandbench", *overrides]))
    torch.set_num_threads(config.threads or 1)
    settings = f"shrink={options.shrink} {' '.join(overrides)}".strip()
    study = Study(settings=settings)
    if options.out.exists():
        study = read_typed(Study, read_json(options.out), options.out)
        if study.settings != settings:
            parser.error(f"{options.out} was measured with other settings ({study.settings})")
    loaded = load_model(config.model)
    for name in (word for word in options.scenes if "=" not in word):
        if any((item.scene, item.grade) == (name, options.grade) for item in study.scenes):
            continue
        cache = options.cache / name
        cache.mkdir(parents=True, exist_ok=True)
        scene = bench_scene(draw_scene(name, shrink=options.shrink))
        new = measure_scene(scene, options.grade, config, loaded, cache)
        study = Study(settings=settings, scenes=(*study.scenes, new))
        write_json_atomic(options.out, asdict(study))
    print(*lines(study.scenes), sep="\n")


if __name__ == "__main__":
    main()
