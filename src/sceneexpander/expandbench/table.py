"""From cells to tables: the paper's shape with spread over seeds, paired differences, and gain against misalignment."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sceneexpander.catalogue import Metric, Table
from sceneexpander.catalogue.metrics import DASH, metrics_named
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult
from sceneexpander.insertion.acceptance import Acceptance

COLUMNS = metrics_named(
    "psnr_at_photo_size_db",
    "seen_through_at_photo_size",
    "psnr_captured_db",
    "ssim_captured",
    "st_lpips_captured",
    "psnr_from_others_db",
    "camera_rotation_deg",
    "depth_abs_rel",
    "psnr_inserted_db",
    "psnr_new_region_db",
    "new_region_drawn",
    "new_region_drawn_abs_rel",
    "psnr_half_way_db",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """Differences of a row to another in the same scene, grade and seed, one per scene (mean over grades and seeds)."""

    row: str
    mean: float
    lowest: float
    seed_spread: float | None  # standard deviation over seeds of the mean over scenes and grades
    better: int
    scenes: int


def row_names(cells: Sequence[CellResult]) -> list[str]:
    """Rows in order of appearance, the two fixed ones first."""
    found = dict.fromkeys(cell.row for cell in cells)
    return [name for name in (CAPTURED, BASELINE) if name in found] + [
        name for name in found if name not in (CAPTURED, BASELINE)
    ]


def mean_of(cells: Iterable[CellResult], column: Metric, *, alone: bool = False) -> float | None:
    """Mean over the cells; None as soon as one of them has no value, or there is none."""
    holders = [cell.alone if alone else cell.numbers for cell in cells]
    values = [None if holder is None else holder.value(column.name) for holder in holders]
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def seed_spread(cells: Sequence[CellResult], column: Metric) -> float | None:
    """Standard deviation over seeds of the mean over scenes and grades; None for fewer than two seeds."""
    means = [
        mean_of([cell for cell in cells if cell.seed == seed], column) for seed in sorted({cell.seed for cell in cells})
    ]
    known = [value for value in means if value is not None]
    return statistics.stdev(known) if len(known) > 1 and len(known) == len(means) else None


def compare_rows(cells: Sequence[CellResult], row: str, column: Metric, *, against: str = BASELINE) -> Paired | None:
    """A row against another; None if they share no scene, grade and seed with a value. `CAPTURED` is the same for every grade."""
    base = {_pair(c, against): c.numbers.value(column.name) for c in cells if c.row == against}
    own = [c for c in cells if c.row == row]
    differences: dict[str, list[float]] = {}
    by_seed: dict[int, list[float]] = {}
    for cell in own:
        value, reference = cell.numbers.value(column.name), base.get(_pair(cell, against))
        if value is None or reference is None:
            continue
        differences.setdefault(cell.scene, []).append(value - reference)
        by_seed.setdefault(cell.seed, []).append(value - reference)
    if not differences:
        return None
    means = [sum(values) / len(values) for values in differences.values()]
    seeds = [sum(values) / len(values) for values in by_seed.values()]
    return Paired(
        row=row,
        mean=sum(means) / len(means),
        lowest=min(means) if column.better == "higher" else max(means),
        seed_spread=statistics.stdev(seeds) if len(seeds) > 1 else None,
        better=sum((value > 0) == (column.better == "higher") and value != 0 for value in means),
        scenes=len(means),
    )


def _pair(cell: CellResult, against: str) -> tuple[str, str, int]:
    return cell.scene, "" if against == CAPTURED else cell.grade, cell.seed


def main_table(cells: Sequence[CellResult], columns: Sequence[Metric] = COLUMNS) -> str:
    """One line per row: means over scenes and grades, ± over seeds."""
    lines = []
    for row in row_names(cells):
        own = [cell for cell in cells if cell.row == row]
        texts = []
        for column in columns:
            value = None if column.scope.of_insertion and row == CAPTURED else mean_of(own, column)
            spread = seed_spread(own, column)
            text = DASH if value is None else column.bare(value)
            texts.append(text if spread is None or value is None else f"{text} ± {column.bare(spread)}")
        lines.append([row, str(len(own)), *texts])
    return _markdown(["row", "cells", *(column.column for column in columns)], lines)


def paired_table(cells: Sequence[CellResult], columns: Sequence[Metric] = COLUMNS) -> str:
    """One line per row: mean difference to the baseline, its spread over seeds, the worst scene's, and how many scenes are better."""
    lines = [
        [row, *(_difference(compare_rows(cells, row, column), column) for column in columns)]
        for row in row_names(cells)
        if row not in (CAPTURED, BASELINE)
    ]
    return _markdown(["row", *(column.column for column in columns)], lines)


def components_table(
    cells: Sequence[CellResult], references: Mapping[str, str], powerless: Mapping[str, str], columns: Sequence[Metric]
) -> str:
    """One line per row against the row that lacks one component (or has one more), so that the component's own effect shows.

    Args:
        cells: of all rows.
        references: the other row, by row.
        powerless: rows that cannot differ from theirs in so few steps, and why: this stands in the numbers' place.
        columns: what is compared.
    """
    lines = []
    for row, reference in references.items():
        found = [compare_rows(cells, row, column, against=reference) for column in columns]
        if all(item is None for item in found):
            continue
        texts = [_difference(item, column) for item, column in zip(found, columns, strict=True)]
        if row in powerless:
            texts = [powerless[row], *[DASH] * (len(columns) - 1)]
        lines.append([row, reference, *texts])
    return _markdown(["row", "against", *(column.column for column in columns)], lines)


def scenes_table(cells: Sequence[CellResult], rows: Sequence[str], column: Metric = COLUMNS[0]) -> str:
    """Scene by scene: the value before the insertion, what the insertion costs, and each row's difference to the baseline."""
    scenes = list(dict.fromkeys(cell.scene for cell in cells))
    shown = [("before", None, None), ("baseline", BASELINE, CAPTURED), *((row, row, BASELINE) for row in rows)]
    lines = []
    for title, row, against in shown:
        texts = []
        for scene in scenes:
            here = [cell for cell in cells if cell.scene == scene]
            if row is None or against is None:
                value = mean_of([cell for cell in here if cell.row == CAPTURED], column)
                texts.append(DASH if value is None else column.bare(value))
            else:
                found = compare_rows(here, row, column, against=against)
                texts.append(DASH if found is None else column.bare(found.mean, sign=True))
        lines.append([title, *texts])
    return _markdown([column.column, *scenes], lines)


def _difference(found: Paired | None, column: Metric) -> str:
    if found is None:
        return DASH
    spread = "" if found.seed_spread is None else f" ± {column.bare(found.seed_spread)}"
    worst = f"worst {column.bare(found.lowest, sign=True)}; {found.better}/{found.scenes}"
    return f"{column.bare(found.mean, sign=True)}{spread} ({worst})"


def alone_table(cells: Sequence[CellResult]) -> str:
    """The adapted weights on the captured views alone: what a row gains without any insertion to repair."""
    lines = []
    for row in row_names(cells):
        own = [cell for cell in cells if cell.row == row and cell.alone is not None]
        if own:
            values = [mean_of(own, column, alone=True) for column in COLUMNS[:5]]
            lines.append(
                [
                    row,
                    *(
                        DASH if value is None else column.bare(value)
                        for value, column in zip(values, COLUMNS[:5], strict=True)
                    ),
                ]
            )
    return _markdown(["row", *(column.column for column in COLUMNS[:5])], lines)


def curve_table(cells: Sequence[CellResult], rows: Sequence[str], column: Metric = COLUMNS[0]) -> str:
    """Per grade: what the insertion costs against the scene before it, and each row's gain over the baseline."""
    lines = []
    before = [cell for cell in cells if cell.row == CAPTURED]
    for grade in dict.fromkeys(cell.grade for cell in cells if cell.grade):
        here = [cell for cell in cells if cell.grade == grade]
        texts = [_difference(compare_rows([*before, *here], BASELINE, column, against=CAPTURED), column)]
        texts += [_difference(compare_rows(here, row, column), column) for row in rows]
        lines.append([grade, *texts])
    return _markdown(["grade", f"insertion's effect on {column.column}", *(f"{row} − baseline" for row in rows)], lines)


HARM_DB = 0.5  # loss of captured PSNR by the insertion from which on a candidate should have been refused


def acceptance_table(cells: Sequence[CellResult]) -> str:
    """How well each measure of a candidate tells harmful insertions from others, and what the decision would have done.

    "Tells apart" is the probability that a harmful candidate has the larger value (the smaller for the overlap): 0.5 is chance.
    """
    before = {
        (cell.scene, cell.seed): cell.numbers.values["psnr_captured_db"] for cell in cells if cell.row == CAPTURED
    }
    candidates: dict[tuple[str, str], Acceptance] = {}
    costs: dict[tuple[str, str], list[float]] = {}
    for cell in cells:
        if cell.row == BASELINE and cell.candidate is not None and (cell.scene, cell.seed) in before:
            # A candidate is judged once, whatever the seed.
            candidates[cell.scene, cell.grade] = cell.candidate
            costs.setdefault((cell.scene, cell.grade), []).append(
                before[cell.scene, cell.seed] - cell.numbers.values["psnr_captured_db"]
            )
    judged = [(candidate, statistics.fmean(costs[key])) for key, candidate in candidates.items()]
    if not judged:
        return "No candidate was judged.\n"
    harmful = [harm > HARM_DB for _, harm in judged]
    lines = []
    for name in ("overlap", "depth_conflict", "colour_conflict", "cameras_moved_deg"):
        values = [getattr(candidate, name) for candidate, _ in judged]
        known = [(-v if name == "overlap" else v, bad) for v, bad in zip(values, harmful, strict=True) if v is not None]
        told = _separation(known)
        lines.append([name, str(len(known)), DASH if told is None else f"{told:.2f}"])
    lines.append(["refused", f"{sum(not c.accepted for c, _ in judged)} of {len(judged)}", DASH])
    for accepted, title in ((True, "mean loss of the accepted, dB"), (False, "mean loss of the refused, dB")):
        losses = [harm for candidate, harm in judged if candidate.accepted == accepted]
        lines.append([title, str(len(losses)), f"{sum(losses) / len(losses):.2f}" if losses else DASH])
    title = f"tells apart ({sum(harmful)} cost more than {HARM_DB} dB)"
    return _markdown(["measure", "candidates", title], lines)


def _separation(values: Sequence[tuple[float, bool]]) -> float | None:
    """Area under the ROC curve; None if all are of one kind."""
    bad, good = [v for v, harmful in values if harmful], [v for v, harmful in values if not harmful]
    if not bad or not good:
        return None
    return sum((b > g) + 0.5 * (b == g) for b in bad for g in good) / (len(bad) * len(good))


def _markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return Table(header=tuple(header), lines=tuple(map(tuple, lines))).markdown()
