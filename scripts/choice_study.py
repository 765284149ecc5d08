"""Does ``choose: auto`` pick candidates that end in better expansions? python scripts/choice_study.py --scenes room_2,open_1 --out F.json

Every scene of the benchmark gets several candidates, drawn with graded errors; all are ranked and all are expanded (with every correction
and the fit, without a step of adaptation). Printed: the chosen one against the mean of all, scene by scene, in what the truth says of the
expansion. What is measured already is read from the file, so an interrupted run continues.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.artifacts.store import read_json, read_typed, write_json_atomic
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import entry_point
from sceneexpander.expandbench import build_scene, measure, prepare_case
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.prepared import prepare_scene
from sceneexpander.expansion import MethodConfig, compose_procedure, load_model
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.rank import rank_candidates
from sceneexpander.ingest.fit import fit_picture
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.pipeline.project import find_project

GRADES = "mixed_1,mixed_2,mixed_4,stretch_8,zoom_10,hallucinate"
# What an expansion is judged by, and whether more of it is better.
OUTCOMES = {
    "psnr_new_region_db": True,
    "psnr_half_way_db": True,
    "psnr_captured_db": True,
    "new_region_drawn_abs_rel": False,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One candidate: how it was ranked, and what the expansion with it got right."""

    scene: str
    grade: str
    score: CandidateScore
    outcomes: dict[str, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """All candidates that are measured. ``settings``: what they were measured with."""

    settings: str
    candidates: tuple[Candidate, ...] = ()


def measure_scene(name: str, grades: Sequence[str], config: ProjectConfig, cache: Path) -> list[Candidate]:
    """Rank and expand all candidates of a scene."""
    scene, loaded = build_scene(name), load_model(config.model)
    before = prepare_scene(scene, loaded, config.frontend, config.warmup, cache)
    fitted, _ = fit_to_views(before.captured, before.state.views, config.refine, seed=config.seed)
    so_far = SceneSoFar(views=before.state.views, reconstruction=fitted)
    cases = [prepare_case(scene, before, grade_named(grade), loaded, config.frontend, cache) for grade in grades]
    frame = frame_of(before.state.views)
    pictures = [fit_picture(to_uint8(case.inputs.inserted.view.detail_images[0]), frame, "crop") for case in cases]
    scores = {score.candidate: score for score in rank_candidates(pictures, so_far, seed=config.seed)}
    method = MethodConfig(adapt=config.adapt, corrections=config.corrections)
    procedure = compose_procedure(method, config.refine).without_steps()
    measured = []
    for index, (grade, case) in enumerate(zip(grades, cases, strict=True)):
        made = procedure.run(case.inputs, loaded, seed=config.seed).scene
        numbers = measure(made, case.inputs.state.views.append(case.inputs.inserted.view), case.truth, scene).values
        outcomes = {outcome: numbers.get(outcome) for outcome in OUTCOMES}
        measured.append(Candidate(scene=name, grade=grade, score=scores[index], outcomes=outcomes))
    return measured


def gains(
    candidates: Sequence[Candidate], outcome: str, order: Callable[[CandidateScore], float]
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """(scenes, of each: the first candidate by ``order`` minus the mean, the best there is minus the mean), better is positive."""
    sign = 1.0 if OUTCOMES[outcome] else -1.0
    scenes = list(dict.fromkeys(item.scene for item in candidates))
    taken, best = [], []
    for scene in scenes:
        mine = [item for item in candidates if item.scene == scene and item.outcomes[outcome] is not None]
        values = sign * np.array([item.outcomes[outcome] for item in mine], dtype=float)
        first = max(range(len(mine)), key=lambda index: order(mine[index].score))
        taken.append(values[first] - values.mean())
        best.append(values.max() - values.mean())
    return scenes, np.array(taken), np.array(best)


def lines(candidates: Sequence[Candidate]) -> list[str]:
    """The table: for every outcome, mean gain over the mean candidate with a 95 % interval over scenes, and scenes with a gain."""
    orders: dict[str, Callable[[CandidateScore], float]] = {"total": lambda score: score.total}
    for part in ("registration", "appearance", "novelty", "sharpness"):
        orders[part] = lambda score, part=part: getattr(score, part) or 0.0  # type: ignore[misc]
    made = []
    for outcome in OUTCOMES:
        for name, order in orders.items():
            scenes, taken, best = gains(candidates, outcome, order)
            draws = np.random.default_rng(0).choice(taken, size=(2000, len(taken))).mean(1)
            low, high = np.quantile(draws, [0.025, 0.975])
            made.append(
                f"{outcome:24s} by {name:13s} {taken.mean():+.3f} [{low:+.3f}, {high:+.3f}] "
                f"better in {int((taken > 0).sum())} of {len(scenes)}; best possible {best.mean():+.3f}"
            )
    return made


@entry_point
def main() -> None:
    """Measure what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scenes", required=True, help="comma-separated names of the benchmark's scenes")
    parser.add_argument("--grades", default=GRADES)
    parser.add_argument("--out", type=Path, required=True, help="results, continued if they are there")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    options = parser.parse_args()
    values = compose(find_project() / "conf", ["experiment=expandbench", *options.overrides])
    config = parse_dataclass(ProjectConfig, values)
    torch.set_num_threads(config.threads or 1)
    settings = f"{options.grades} {' '.join(options.overrides)}".strip()
    study = Study(settings=settings)
    if options.out.exists():
        study = read_typed(Study, read_json(options.out), options.out)
        if study.settings != settings:
            parser.error(f"{options.out} was measured with other settings ({study.settings})")
    done = {item.scene for item in study.candidates}
    grades = options.grades.split(",")
    for name in options.scenes.split(","):
        if name in done:
            continue
        cache = options.out.with_suffix("") / name
        cache.mkdir(parents=True, exist_ok=True)
        new = measure_scene(name, grades, config, cache)
        study = Study(settings=settings, candidates=(*study.candidates, *new))
        write_json_atomic(options.out, asdict(study))
        for item in new:
            print(name, item.grade, f"{item.score.total:.3f}", item.score.reason, item.outcomes, flush=True)
    wanted = options.scenes.split(",")
    print(*lines([item for item in study.candidates if item.scene in wanted]), sep="\n")


if __name__ == "__main__":
    main()
