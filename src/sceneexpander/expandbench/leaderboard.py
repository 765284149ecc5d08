"""Any list of methods on the same cases: rows of our own, and results that others hand in. One table per split and grade.

Means are over cases that every method with that number has; how many these are stands in the table. What a method lacks is named.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sceneexpander.artifacts.store import read_json, to_plain, write_json_atomic
from sceneexpander.catalogue import Metric, Table
from sceneexpander.catalogue.metrics import DASH
from sceneexpander.errors import UserError
from sceneexpander.expandbench.dataset import (
    PICTURED,
    VERSION,
    Manifest,
    TrueScene,
    check_scene,
    load_truth,
    read_manifest,
    split_of,
)
from sceneexpander.expandbench.entries import Entry, entry_of, read_entry
from sceneexpander.expandbench.run import BASELINE, CAPTURED, Settings, make_scenes
from sceneexpander.expandbench.scenes import VIEWS
from sceneexpander.expandbench.score import GEOMETRY, METRICS, RENDERING, align_entry, score
from sceneexpander.expansion import MethodConfig
from sceneexpander.files import write_bytes_atomic
from sceneexpander.plainfiles import require_folder

SCHEMA = "leaderboard/1"
GRADES_BY_DEFAULT = ("clean", "mixed_2")
PLACED = "evaluation_cameras.json"
NOT_HANDED_IN = "not handed in"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Rows of our own by name (the configuration is None for `CAPTURED` and `BASELINE`), and what they share."""

    rows: Mapping[str, MethodConfig | None]
    settings: Settings
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseScore:
    """One method on one scene with one grade. ``problem`` says why there are no numbers, and is empty where there are."""

    method: str
    scene: str
    grade: str
    values: Mapping[str, float] = field(default_factory=dict)
    problem: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """All scores, and what they were measured on. ``methods`` in the order of the tables."""

    version: str
    content: str
    complete: bool
    shrink: int
    methods: tuple[str, ...]
    scenes: tuple[str, ...]
    grades: tuple[str, ...]
    cases: tuple[CaseScore, ...]
    about: Mapping[str, str] = field(default_factory=dict)  # by method: where it comes from

    def part(self, split: str, grade: str) -> tuple[CaseScore, ...]:
        """The cases of a split and a grade."""
        return tuple(case for case in self.cases if case.grade == grade and split_of(case.scene) == split)

    def save(self, folder: Path) -> None:
        """Write ``leaderboard.md`` (the tables), ``leaderboard.csv`` (every case, unrounded) and ``leaderboard.json`` (both)."""
        facts = {"schema": SCHEMA, **to_plain(self), "means": to_plain(list(_summaries(self)))}
        write_json_atomic(folder / "leaderboard.json", facts)
        write_bytes_atomic(folder / "leaderboard.csv", _csv(self).encode())
        write_bytes_atomic(folder / "leaderboard.md", document(self).encode())


@dataclass(frozen=True, slots=True, kw_only=True)
class Mean:
    """A number's mean over the cases that are common to all methods that have it."""

    split: str
    grade: str
    method: str
    metric: str
    mean: float
    cases: int


def measure_methods(
    folder: Path,
    scenes: Sequence[str],
    grades: Sequence[str],
    results: Mapping[str, Path],
    rows: Rows | None = None,
    *,
    on_case: Callable[[CaseScore], None] | None = None,
) -> Board:
    """Score every method on every scene with every grade.

    Args:
        folder: of the benchmark.
        scenes, grades: that are in it.
        results: folders that others hand in, by the method's name.
        rows: of our own.
        on_case: called as each score becomes known.

    Raises:
        UserError: the benchmark lacks a scene or grade, or a result is not as it must be. A case that a method did not hand in, or whose
            cameras determine no similarity, is a `CaseScore` with a problem.
    """
    manifest = read_manifest(folder)
    shrink = _check_cases(folder, manifest, scenes, grades)
    for name, place in results.items():
        require_folder(place, where=f"{name}={place}", expected="a folder SCENE/GRADE of results")
        if not any((place / scene).is_dir() for scene in scenes):
            raise UserError(
                "holds none of the scenes", where=place, fix=f"expected {place / scenes[0] / grades[0]} ..."
            )
    cases: list[CaseScore] = []
    for scene in scenes:
        truth = load_truth(folder, scene)
        for case in (
            *_own_cases(rows, truth, grades, manifest.scenes[scene]),
            *_handed_in(results, truth, grades),
        ):
            cases.append(case)
            if on_case is not None:
                on_case(case)
    return Board(
        version=VERSION,
        content=manifest.content,
        complete=manifest.complete,
        shrink=shrink,
        methods=(*(rows.rows if rows is not None else ()), *results),
        scenes=tuple(scenes),
        grades=tuple(grades),
        cases=tuple(cases),
        about=dict.fromkeys(results, "handed in") | ({} if rows is None else _about(rows)),
    )


def _about(rows: Rows) -> dict[str, str]:
    fit = f"{rows.settings.refine.visits} visits per view in the fit"
    told = f"this program, model {rows.settings.model.name}, {fit}, seed {rows.seed}, code {rows.settings.code[:12]}"
    return {
        name: told + (f", {config.adapt.steps} steps" if config is not None else "")
        for name, config in rows.rows.items()
    }


def _check_cases(folder: Path, manifest: Manifest, scenes: Sequence[str], grades: Sequence[str]) -> int:
    """How much the scenes are shrunk: all alike."""
    shrinks = set()
    for scene in scenes:
        if scene not in manifest.scenes:
            fix = f"make it: sceneexpander expandbench generate {folder} --scenes {scene}"
            raise UserError(f"holds no scene {scene}", where=folder, fix=fix)
        facts = check_scene(folder, scene)
        shrinks.add(facts.shrink)
        for grade in grades:
            if grade not in facts.grades:
                raise UserError(f"holds no picture of grade {grade!r}", where=folder / scene)
    if len(shrinks) != 1:
        raise UserError("holds scenes at several sizes", where=folder, fix="generate them with one --shrink")
    return shrinks.pop()


def _scored(method: str, entry: Entry, truth: TrueScene, grade: str) -> CaseScore:
    try:
        return CaseScore(method=method, scene=truth.name, grade=grade, values=score(entry, truth))
    except ValueError as error:
        return CaseScore(method=method, scene=truth.name, grade=grade, problem=str(error))


def _handed_in(results: Mapping[str, Path], truth: TrueScene, grades: Sequence[str]) -> Iterator[CaseScore]:
    height, width = truth.views[VIEWS[0]].depth.shape
    for name, place in results.items():
        for grade in grades:
            folder = place / truth.name / grade
            if folder.is_dir():
                yield _scored(name, read_entry(folder, height, width), truth, grade)
            else:
                yield CaseScore(method=name, scene=truth.name, grade=grade, problem=NOT_HANDED_IN)


def _own_cases(rows: Rows | None, truth: TrueScene, grades: Sequence[str], content: str) -> Iterator[CaseScore]:
    """Scores of our rows, from the cache where the same code and data made them before."""
    if rows is None:
        return
    keys = {(grade, row): _key(rows, truth.name, grade, row, content) for grade in grades for row in rows.rows}
    places = {cell: rows.settings.cache / "scores" / f"{key}.json" for cell, key in keys.items()}
    missing = [cell for cell, place in places.items() if not place.exists()]
    made = make_scenes(truth.name, [(*cell, rows.rows[cell[1]]) for cell in missing], rows.seed, rows.settings)
    for (grade, row), reconstruction in zip(missing, made, strict=True):
        scored = _scored(row, entry_of(reconstruction), truth, grade)
        write_json_atomic(places[grade, row], {"values": scored.values, "problem": scored.problem})
    for (grade, row), place in places.items():
        yield CaseScore(method=row, scene=truth.name, grade=grade, **read_json(place))


def _key(rows: Rows, scene: str, grade: str, row: str, content: str) -> str:
    settings, config = rows.settings, rows.rows[row]
    identity = {
        "shared": [to_plain(getattr(settings, name)) for name in ("model", "frontend", "warmup", "refine", "shrink")],
        "code": settings.code,
        "content": content,
        "scene": scene,
        # No grade changes the scene before the insertion.
        "grade": "" if row == CAPTURED else grade,
        "row": row if config is None else to_plain(config),
        "seed": rows.seed,
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]


def own_rows(names: Sequence[str], configured: Mapping[str, MethodConfig]) -> dict[str, MethodConfig | None]:
    """Rows by name, in the order asked for; the two fixed ones have no configuration."""
    return {name: None if name in (CAPTURED, BASELINE) else configured[name] for name in names}


def place_cameras(folder: Path, results: Path) -> list[Path]:
    """Write the true cameras in the world of each case that is handed in, as ``evaluation_cameras.json`` beside its own cameras.

    They are placed by the same similarity that scores are taken with: from there a method renders what it hands in.

    Raises:
        UserError: no case is there, or its cameras determine no similarity.
    """
    manifest = read_manifest(folder)
    written = []
    for scene in manifest.scenes:
        found = [results / scene / grade for grade in PICTURED if (results / scene / grade).is_dir()]
        if not found:
            continue
        truth = load_truth(folder, scene)
        height, width = truth.views[VIEWS[0]].depth.shape
        for case in found:
            entry = read_entry(case, height, width)
            try:
                entry_from_truth = align_entry(entry, truth).inverse()
            except ValueError as error:
                raise UserError(f"cannot be placed: {error}", where=case) from None
            cameras = [
                {
                    "name": name,
                    "height": height,
                    "width": width,
                    "world_from_cam": entry_from_truth.poses(view.world_from_cam[None])[0].tolist(),
                    "intrinsics_px": view.intrinsics_px.tolist(),
                }
                for name, view in truth.views.items()
            ]
            write_json_atomic(case / PLACED, {"convention": "opencv", "cameras": cameras})
            written.append(case / PLACED)
    if not written:
        raise UserError(
            "holds no case of the benchmark", where=results, fix="expected folders SCENE/GRADE with cameras"
        )
    return written


def _common(cases: Sequence[CaseScore], methods: Sequence[str], metric: Metric) -> dict[str, dict[str, float]]:
    """Values by method and scene, of the scenes that all methods with this number have; methods without it are left out."""
    held = {
        method: {
            case.scene: case.values[metric.name]
            for case in cases
            if case.method == method and metric.name in case.values
        }
        for method in methods
    }
    held = {method: values for method, values in held.items() if values}
    shared = set.intersection(*(set(values) for values in held.values())) if held else set()
    return {method: {scene: values[scene] for scene in sorted(shared)} for method, values in held.items()}


def _summaries(board: Board) -> Iterator[Mean]:
    for split, grade in _tables(board):
        cases = board.part(split, grade)
        for metric in METRICS:
            for method, values in _common(cases, board.methods, metric).items():
                if values:
                    mean = sum(values.values()) / len(values)
                    yield Mean(
                        split=split, grade=grade, method=method, metric=metric.name, mean=mean, cases=len(values)
                    )


def _tables(board: Board) -> list[tuple[str, str]]:
    splits = dict.fromkeys(split_of(scene) for scene in board.scenes)
    return [(split, grade) for split in splits for grade in board.grades]


def table(board: Board, split: str, grade: str, metrics: Sequence[Metric]) -> Table:
    """Methods as lines, the number of common cases as the last one."""
    cases = board.part(split, grade)
    common = {metric.name: _common(cases, board.methods, metric) for metric in metrics}
    lines = []
    for method in board.methods:
        own = [case for case in cases if case.method == method]
        texts = [method, f"{sum(not case.problem for case in own)}/{len(own)}"]
        for metric in metrics:
            values = common[metric.name].get(method, {})
            texts.append(metric.bare(sum(values.values()) / len(values)) if values else DASH)
        lines.append(tuple(texts))
    counts = [str(max((len(values) for values in common[metric.name].values()), default=0)) for metric in metrics]
    header = ("method", "cases", *(metric.column for metric in metrics))
    return Table(header=header, lines=(*lines, ("cases in common", "", *counts)))


def missing_lines(board: Board) -> list[str]:
    """A line for every case without numbers, for numbers that a method has in some of its cases only, and for those it has nowhere."""
    lines = [f"{case.method}: {case.scene}, {case.grade}: {case.problem}" for case in board.cases if case.problem]
    for method in board.methods:
        scored = [case for case in board.cases if case.method == method and not case.problem]
        nowhere = []
        for metric in METRICS:
            without = [f"{case.scene}, {case.grade}" for case in scored if metric.name not in case.values]
            if without and len(without) < len(scored):
                lines.append(f"{method}: no {metric.title} in {'; '.join(without)}")
            elif without:
                nowhere.append(metric.title)
        if nowhere:
            lines.append(f"{method}: nowhere {'; '.join(nowhere)}")
    return lines


def document(board: Board) -> str:
    """The leaderboard as one Markdown text."""
    size = "" if board.shrink == 1 else f" **Pictures of 1/{board.shrink} of the size: for trying things out only.**"
    whole = "" if board.complete else " Not all scenes of the version are in the folder."
    parts = [
        "# expandbench: leaderboard",
        f"Version {board.version}, content `{board.content[:16]}`.{size}{whole} Every method is brought into the truth's frame by one "
        "similarity, that of its captured cameras. Means are over the cases that all methods with a number have (last line); centres and "
        f"chamfer distances in percent of a scene's median depth. What is measured how: docs/expandbench.md.",
        "\n".join(f"- {name}: {board.about.get(name, '')}" for name in board.methods),
    ]
    for split, grade in _tables(board):
        count = len({case.scene for case in board.part(split, grade)})
        parts.append(f"## {split.capitalize()} scenes ({count}), inserted picture `{grade}`")
        parts += [table(board, split, grade, metrics).markdown().rstrip() for metrics in (GEOMETRY, RENDERING)]
    missing = missing_lines(board)
    parts.append("## Missing\n\n" + ("\n".join(f"- {line}" for line in missing) if missing else "Nothing."))
    return "\n\n".join(parts) + "\n"


def _csv(board: Board) -> str:
    """One line per method and case with unrounded numbers; ``problem`` where there are none."""
    header = ("method", "split", "scene", "grade", "problem", *(metric.name for metric in METRICS))
    lines = tuple(
        (
            case.method,
            split_of(case.scene),
            case.scene,
            case.grade,
            case.problem,
            *("" if (value := case.values.get(metric.name)) is None else repr(value) for metric in METRICS),
        )
        for case in board.cases
    )
    return Table(header=header, lines=lines).csv()
