"""Does ``choose: auto`` pick candidates that end in better expansions? python scripts/choice_study.py CASE ... --out F.json [key=value ...]

A case is a scene of the benchmark, or a scene folder whose first round names a picture. A scene's candidates are drawn with graded errors;
a folder's are its picture as given and with what editors do to whole pictures. All candidates are ranked and all are expanded, with every
correction and without a step of adaptation. Printed: the picked one against the mean, worst and best of its case, in what the truth says of
a scene, and in what can be measured without truth in a folder. What is in the file is not measured again.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.artifacts.candidates import Candidate
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import read_json, read_typed, sha256_of_bytes, write_json_atomic
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, entry_point
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.expandbench import BenchScene, measure, prepare_case
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.prepared import prepare_scene
from sceneexpander.expandbench.scenes import bench_scene, draw_scene
from sceneexpander.expansion import (
    LoadedModel,
    MethodConfig,
    RoundInputs,
    captured_prediction,
    compose_procedure,
    initial_state,
    joint_reconstruction,
    load_model,
)
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import assess, frame_of
from sceneexpander.generation.rank import rank_candidates
from sceneexpander.ingest import load_scene
from sceneexpander.ingest.decode import read_picture
from sceneexpander.ingest.fit import FittedPicture, fit_picture
from sceneexpander.ingest.load import view_from_fitted
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.pipeline.project import find_project

GRADES = "mixed_1,mixed_2,mixed_4,stretch_8"
EDITS = "given,stretch_8,zoom_20,blurred"
# What an expansion is judged by, and whether more of it is better. The first group needs the truth.
KNOWN = {
    "psnr_new_region_db": True,
    "new_region_drawn_abs_rel": False,
    "psnr_half_way_db": True,
    "psnr_captured_db": True,
}
MEASURED = {
    "psnr_captured_db": True,
    "psnr_from_others_db": True,
    "structure_ghosted": False,
    "inserted_structure_ghosted": False,
    "psnr_inserted_db": True,
}
CHEAP = EvaluateConfig(flip=False, st_lpips=False)
ORDERS: Mapping[str, Callable[[Tried], float]] = {
    "auto": lambda item: item.score.total,
    # As if every stretch were told and outweighed all else: what counting it could bring at most.
    "auto, unstretched": lambda item: item.score.total - item.name.startswith("stretch"),
    "registration": lambda item: item.score.registration,
    "appearance": lambda item: item.score.appearance or 0.0,
    "novelty": lambda item: item.score.novelty or 0.0,
    "sharpness": lambda item: item.score.sharpness,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate: how it was ranked, and what the expansion with it got right."""

    case: str
    name: str
    score: CandidateScore
    outcomes: dict[str, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """All candidates that are measured. ``settings``: what they were measured with."""

    settings: str
    tried: tuple[Tried, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A candidate before it is tried. ``truth``: of all views, where it is known."""

    name: str
    picture: FittedPicture
    inputs: RoundInputs
    truth: SceneTruth | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Candidates for one scene. ``bench``: the scene of the benchmark, if it is one."""

    so_far: SceneSoFar
    options: tuple[Option, ...]
    bench: BenchScene | None

    def outcomes(self, option: Option, made: Reconstruction) -> dict[str, float | None]:
        """What of an expansion with an option can be told."""
        views = option.inputs.state.views.append(option.inputs.inserted.view)
        if self.bench is not None and option.truth is not None:
            numbers = measure(made, views, option.truth, self.bench, CHEAP)
            return {outcome: numbers.value(outcome) for outcome in KNOWN}
        row = evaluate(made, views, CHEAP, scene="-", round_number=1, seed=0)
        return {outcome: row.value(outcome) for outcome in MEASURED}


def drawn_wrong(
    bench: BenchScene, grades: Sequence[str], config: ProjectConfig, loaded: LoadedModel, cache: Path
) -> Case:
    """A scene of the benchmark, with one candidate for each grade."""
    before = prepare_scene(bench, loaded, config.frontend, config.warmup, cache)
    frame, options = frame_of(before.state.views), []
    for grade in grades:
        case = prepare_case(bench, before, grade_named(grade), loaded, config.frontend, cache)
        picture = fit_picture(to_uint8(case.inputs.inserted.view.detail_images[0]), frame, "crop")
        options.append(Option(name=grade, picture=picture, inputs=case.inputs, truth=case.truth))
    fitted, _ = fit_to_views(before.captured, before.state.views, config.refine, seed=config.seed)
    return Case(so_far=SceneSoFar(views=before.state.views, reconstruction=fitted), options=tuple(options), bench=bench)


def edited(pixels: np.ndarray) -> dict[str, np.ndarray]:
    """A picture (height, width, 3) as given, and with what editors do to the whole of it; sizes stay."""
    height, width = pixels.shape[:2]

    def scaled(across: float, down: float) -> np.ndarray:
        middle = np.array([[across, 0, (1 - across) * width / 2], [0, down, (1 - down) * height / 2]])
        return np.asarray(cv2.warpAffine(pixels, middle, (width, height), flags=cv2.INTER_AREA))

    linear = (pixels / 255.0) ** 2.2 * 2**0.6 * np.array([1.12, 1.0, 1 / 1.12])
    return {
        "given": pixels,
        "stretch_8": scaled(1.08, 1.0),
        "zoom_20": scaled(1.2, 1.2),
        "exposure_6": (255 * np.clip(linear, 0, 1) ** (1 / 2.2)).round().astype(np.uint8),
        "blurred": np.asarray(cv2.GaussianBlur(pixels, (0, 0), width / 300)),
    }


def edited_picture(folder: Path, edits: Sequence[str], config: ProjectConfig, loaded: LoadedModel) -> Case:
    """A scene folder, with its first round's picture as given and as editors would have made it: ``edits`` of `edited`."""
    scene = load_scene(folder, config.scene)
    recorded = scene.round_spec(1).inserted
    if recorded is None:
        raise UserError("has no picture for round 1", where=folder, fix="record one in its scene.yaml")
    state, _, _, _ = initial_state(scene, loaded, config.frontend, config.warmup, seed=config.seed)
    anchors, captured = captured_prediction(state, loaded)
    options = []
    made = edited(read_picture(folder / recorded).pixels)
    for name in edits:
        data = io.BytesIO()
        Image.fromarray(made[name]).save(data, format="PNG")
        source = Provenance(backend="file", prompt="", source=name, sha256=sha256_of_bytes(data.getvalue()))
        found = assess(Candidate(data=data.getvalue(), name=name, provenance=source), state.views, "crop")
        if found.picture is None or found.fitted is None:
            raise UserError(found.provenance.refusal or "no picture", where=folder / recorded)
        view = view_from_fitted(found.picture.facts, found.fitted, view_id="inserted", generated=True, round_number=1)
        inserted = InsertedView(round=1, view=view, chosen=0, provenance=(found.provenance,))
        priors, _, _ = joint_reconstruction(state, inserted, loaded, config.frontend, seed=config.seed)
        inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
        options.append(Option(name=name, picture=found.fitted, inputs=inputs, truth=None))
    fitted, _ = fit_to_views(captured, state.views, config.refine, seed=config.seed)
    return Case(so_far=SceneSoFar(views=state.views, reconstruction=fitted), options=tuple(options), bench=None)


def tried(name: str, case: Case, config: ProjectConfig, loaded: LoadedModel) -> Iterator[Tried]:
    """Rank and expand all candidates of a case."""
    pictures = [option.picture for option in case.options]
    scores = {score.candidate: score for score in rank_candidates(pictures, case.so_far, seed=config.seed)}
    method = MethodConfig(adapt=config.adapt, corrections=config.corrections)
    procedure = compose_procedure(method, config.refine).without_steps()
    for index, option in enumerate(case.options):
        made = procedure.run(option.inputs, loaded, seed=config.seed).scene
        yield Tried(case=name, name=option.name, score=scores[index], outcomes=case.outcomes(option, made))


def compared(candidates: Sequence[Tried], outcome: str, order: Callable[[Tried], float]) -> np.ndarray:
    """(case, 4): by the outcome, the picked candidate, and the mean, worst and best of the case; cases without numbers are left out."""
    better = {**KNOWN, **MEASURED}[outcome]
    rows = []
    for case in dict.fromkeys(item.case for item in candidates):
        mine = [item for item in candidates if item.case == case]
        known = [item.outcomes.get(outcome) for item in mine]
        values = np.array([value for value in known if value is not None])
        picked = known[max(range(len(mine)), key=lambda index: order(mine[index]))]
        if picked is not None and len(values) > 1:
            worst, best = (values.min(), values.max()) if better else (values.max(), values.min())
            rows.append((picked, values.mean(), worst, best))
    return np.array(rows).reshape(-1, 4)


def lines(candidates: Sequence[Tried], outcomes: Mapping[str, bool]) -> Iterator[str]:
    """For every outcome and every order: picked against mean, worst and best, with a 95 % interval over cases of the gain."""
    for outcome, better in outcomes.items():
        for name, order in ORDERS.items():
            rows = compared(candidates, outcome, order)
            if len(rows):
                gains = (rows[:, 0] - rows[:, 1]) * (1 if better else -1)
                draws = np.random.default_rng(0).choice(gains, size=(2000, len(gains))).mean(1)
                low, high = np.quantile(draws, [0.025, 0.975])
                picked, mean, worst, best = rows.mean(0)
                yield (
                    f"{outcome:27s} by {name:17s} {picked:.3f}; mean {mean:.3f}, worst {worst:.3f}, best {best:.3f}; "
                    f"gain {gains.mean():+.3f} [{low:+.3f}, {high:+.3f}], better in {int((gains > 0).sum())} of {len(gains)}"
                )


@entry_point
def main() -> None:
    """Measure what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("cases", nargs="+", metavar="CASE", help="scene of the benchmark, scene folder, or key=value")
    parser.add_argument("--grades", default=GRADES, help="of a scene's candidates")
    parser.add_argument("--edits", default=EDITS, help="that make a folder's candidates; exposure_6 is another one")
    parser.add_argument("--shrink", type=int, default=1, help="scenes have that many times fewer pixels per side")
    parser.add_argument("--out", type=Path, required=True, help="results, continued if they are there")
    options = parser.parse_intermixed_args()
    overrides = [word for word in options.cases if "=" in word]
    cases = [word for word in options.cases if "=" not in word]
    config = parse_dataclass(ProjectConfig, compose(find_project() / "conf", ["experiment=expandbench", *overrides]))
    torch.set_num_threads(config.threads or 1)
    settings = f"{options.grades} {options.edits} shrink={options.shrink} {' '.join(overrides)}".strip()
    study = Study(settings=settings)
    if options.out.exists():
        study = read_typed(Study, read_json(options.out), options.out)
        if study.settings != settings:
            parser.error(f"{options.out} was measured with other settings ({study.settings})")
    loaded = load_model(config.model)
    for word in cases:
        name = Path(word).name
        if any(item.case == name for item in study.tried):
            continue
        cache = options.out.with_suffix("") / name
        cache.mkdir(parents=True, exist_ok=True)
        if Path(word).is_dir():
            case = edited_picture(Path(word), options.edits.split(","), config, loaded)
        else:
            bench = bench_scene(draw_scene(name, shrink=options.shrink))
            case = drawn_wrong(bench, options.grades.split(","), config, loaded, cache)
        new = tuple(tried(name, case, config, loaded))
        study = Study(settings=settings, tried=(*study.tried, *new))
        write_json_atomic(options.out, asdict(study))
        for item in new:
            numbers = {outcome: None if value is None else round(value, 3) for outcome, value in item.outcomes.items()}
            print(name, item.name, f"{item.score.total:.3f}", item.score.reason, numbers, flush=True)
    wanted = {Path(word).name for word in cases}
    shown = [item for item in study.tried if item.case in wanted]
    for outcomes in (KNOWN, MEASURED):
        own = [item for item in shown if item.outcomes.keys() == outcomes.keys()]
        print(*lines(own, outcomes), sep="\n")


if __name__ == "__main__":
    main()
