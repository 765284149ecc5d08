"""Do measures rank methods as people do? Kendall's tau within scenes, between human scores and metrics or a judge's scores."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneexpander.artifacts.metrics import MetricsRow, load_row
from sceneexpander.artifacts.store import to_plain, write_json_atomic
from sceneexpander.catalogue import Table
from sceneexpander.catalogue.metrics import MEASURED
from sceneexpander.errors import UserError
from sceneexpander.files import write_bytes_atomic
from sceneexpander.plainfiles import read_plain_file
from sceneexpander.study.design import make_numpy_generator
from sceneexpander.study.results import RankedStudy
from sceneexpander.study.spec import Criterion
from sceneexpander.study.statistics import RESAMPLES, Interval, kendall_tau, percentile_interval

SCHEMA = "study agreement/1"
COLUMNS = ("scene", "method", "measure", "better", "value")
_CSV_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """One value of a measure; None: missing. ``better`` is "higher" or "lower"."""

    scene: str
    method: str
    measure: str
    better: str
    value: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """A measure against people under one criterion.

    Attributes:
        measure: its name, or ``one participant`` against the mean of the others: how far people agree among themselves.
        criterion: of the people.
        tau: mean over scenes of Kendall's tau-b between the measure and the mean human score of the methods; None: no scene to compare.
        interval: of that mean, by bootstrap over scenes; None with one scene.
        tau_of_means: tau-b between means over the same scenes, one value per method.
        scenes: behind ``tau``: those with values of all methods, not all of them equal.
        missing: values that are missing, of scenes and methods of the study.
    """

    measure: str
    criterion: Criterion
    tau: float | None
    interval: Interval | None
    tau_of_means: float | None
    scenes: int
    missing: int


def read_measures(path: Path) -> list[Measured]:
    """Values of measures.

    Args:
        path: a CSV file with the columns scene, method, measure, better ("higher" or "lower") and value (empty: missing), or
            a folder of the pipeline's outputs, whose ``metrics`` rows are read.

    Raises:
        UserError: it is neither, or a line is not as it should be; names the line.
    """
    if path.is_dir():
        return _read_rows(path)
    try:
        text = read_plain_file(path, limit_bytes=_CSV_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError("is not UTF-8 text", where=path) from None
    lines = csv.DictReader(io.StringIO(text))
    if set(lines.fieldnames or ()) != set(COLUMNS):
        raise UserError(
            f"has the columns {', '.join(lines.fieldnames or ())}", where=path, fix=f"must have {', '.join(COLUMNS)}"
        )
    found = [_read_line(line, f"{path}:{lines.line_num}") for line in lines]
    _refuse_doubles(found, path)
    return found


def _read_line(line: dict[str, str], where: str) -> Measured:
    if None in line or None in line.values():
        raise UserError("has more or fewer columns than the header", where=where)
    if line["better"] not in ("higher", "lower"):
        raise UserError(f"better is {line['better']!r}", where=where, fix="higher or lower")
    value = None
    if line["value"].strip():
        try:
            value = float(line["value"])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise UserError(
                f"value is {line['value']!r}", where=where, fix="a finite number, or nothing where it is missing"
            )
    return Measured(
        scene=line["scene"], method=line["method"], measure=line["measure"], better=line["better"], value=value
    )


def _read_rows(folder: Path) -> list[Measured]:
    paths = sorted(folder.rglob("metrics/*.json"))
    rows = [row for path in paths if isinstance(row := load_row(path), MetricsRow)]
    if not rows:
        raise UserError("holds no metrics", where=folder, fix="run the pipeline, or give a CSV file")
    found = [
        Measured(scene=row.scene, method=row.method, measure=item.name, better=item.better, value=row.value(item.name))
        for row in rows
        for item in MEASURED
        if item.better in ("higher", "lower")
    ]
    _refuse_doubles(found, folder)
    return found


def _refuse_doubles(measured: Sequence[Measured], where: Path) -> None:
    seen: dict[tuple[str, str, str], str] = {}
    directions: dict[str, str] = {}
    for item in measured:
        key = item.scene, item.method, item.measure
        if key in seen:
            raise UserError(
                f"has {item.measure!r} of {item.method!r} in scene {item.scene!r} twice",
                where=where,
                fix="give one round and seed of each scene",
            )
        seen[key] = item.better
        if directions.setdefault(item.measure, item.better) != item.better:
            raise UserError(f"says both higher and lower are better for {item.measure!r}", where=where)


def compute_agreement(ranked: RankedStudy, measured: Sequence[Measured], *, seed: int = 0) -> tuple[Agreement, ...]:
    """Each measure against each criterion; the first line of a criterion is how far people agree among themselves.

    Raises:
        UserError: no measure has a value for a scene and a method of the study, or something is measured twice.
    """
    _refuse_doubles(measured, Path("--measures"))
    values = {(item.measure, item.scene, item.method): item for item in measured if item.value is not None}
    names = list(dict.fromkeys(item.measure for item in measured))
    known = {(scene, method) for scene in ranked.scenes for method in ranked.methods}
    if not any((scene, method) in known for _, scene, method in values):
        raise UserError(
            f"no measure is of a scene and a method of the study ({', '.join(ranked.scenes)}; {', '.join(ranked.methods)})",
            where="--measures",
            fix="names must be those of the study",
        )
    found = []
    for criterion, scores in ranked.scores.items():
        found.append(_agreement_of_people(ranked, criterion, seed))
        human = scores.mean(0)
        for name in names:
            table = np.full(human.shape, np.nan)
            for row, scene in enumerate(ranked.scenes):
                for column, method in enumerate(ranked.methods):
                    item = values.get((name, scene, method))
                    if item is not None and item.value is not None:
                        table[row, column] = item.value if item.better == "higher" else -item.value
            whole = [row for row in range(len(human)) if np.isfinite(table[row]).all()]
            taus = [kendall_tau(table[row].tolist(), human[row].tolist()) for row in whole]
            means = kendall_tau(table[whole].mean(0).tolist(), human[whole].mean(0).tolist()) if whole else None
            missing = int(np.isnan(table).sum())
            found.append(_summary(name, criterion, [tau for tau in taus if tau is not None], means, missing, seed))
    return tuple(found)


def _agreement_of_people(ranked: RankedStudy, criterion: Criterion, seed: int) -> Agreement:
    """Each participant against the mean of the others, averaged over participants within a scene."""
    scores = ranked.scores[criterion]
    people = len(scores)
    by_scene, of_means = [], []
    if people > 1:
        others = (scores.sum(0) - scores) / (people - 1)
        for scene in range(scores.shape[1]):
            taus = [kendall_tau(scores[one, scene].tolist(), others[one, scene].tolist()) for one in range(people)]
            told = [tau for tau in taus if tau is not None]
            by_scene += [float(np.mean(told))] if told else []
        pairs = zip(scores.mean(1).tolist(), others.mean(1).tolist(), strict=True)
        of_means = [tau for mine, theirs in pairs if (tau := kendall_tau(mine, theirs)) is not None]
    return _summary("one participant", criterion, by_scene, float(np.mean(of_means)) if of_means else None, 0, seed)


def _summary(
    measure: str, criterion: Criterion, taus: Sequence[float], of_means: float | None, missing: int, seed: int
) -> Agreement:
    interval = None
    if len(taus) > 1:
        rng = make_numpy_generator(seed, "study/agreement")
        drawn = rng.integers(len(taus), size=(RESAMPLES, len(taus)))
        interval = percentile_interval(np.asarray(taus)[drawn].mean(1))
    return Agreement(
        measure=measure,
        criterion=criterion,
        tau=float(np.mean(taus)) if taus else None,
        interval=interval,
        tau_of_means=of_means,
        scenes=len(taus),
        missing=missing,
    )


def agreement_table(found: Sequence[Agreement], scenes: int) -> Table:
    """One line per measure and criterion."""

    def number(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    lines = tuple(
        (
            item.measure,
            item.criterion.column,
            number(item.tau),
            "–" if item.interval is None else f"{item.interval.low:.2f} to {item.interval.high:.2f}",
            number(item.tau_of_means),
            str(item.scenes),
            str(item.missing),
        )
        for item in found
    )
    header = ("measure", "people", "τ in scenes ↑", "95 %", "τ of means ↑", f"scenes of {scenes}", "values missing")
    return Table(header=header, lines=lines)


def save_agreement(found: Sequence[Agreement], ranked: RankedStudy, folder: Path) -> None:
    """Write ``agreement.json``, ``agreement.md`` and ``agreement.csv``."""
    table = agreement_table(found, len(ranked.scenes))
    content = {"schema": SCHEMA, "participants": len(ranked.participants), "agreement": to_plain(tuple(found))}
    write_json_atomic(folder / "agreement.json", content)
    write_bytes_atomic(folder / "agreement.md", table.markdown().encode())
    write_bytes_atomic(folder / "agreement.csv", table.csv().encode())
