"""The paper's two tables with what was measured here above what the paper says.

Numbers of photos that a method was given and of photos that it never saw are in columns of their own. A mean is over the cases that all
lines of its column have: lines of one column are always over the same cases, whose number is the table's first line. What no line has says
so; what some lack counts as missing for them.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sceneexpander.catalogue.metrics import ARROWS, DASH, Better
from sceneexpander.catalogue.paper import QUOTED, QuotedRow
from sceneexpander.catalogue.table import Table

NOT_MEASURED = "not measured"
NO_COMMON_CASE = "no common case"
HERE = "here"
Values = Mapping[str, Mapping[Any, float]]  # by line, by case (of any kind that can be a key)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column.

    Attributes:
        name: of the metric, as in `sceneexpander.catalogue.paper`.
        title: its heading without the arrow.
        better: which way.
        digits: printed behind the point.
        values: what was measured. A line without an entry was not measured in this column and does not narrow it.
    """

    name: str
    title: str
    digits: int
    better: Better = "higher"
    values: Values = field(default_factory=dict)

    @property
    def cases(self) -> frozenset[Any]:
        """Those that all measured lines have."""
        of_lines = [set(values) for values in self.values.values() if values]
        return frozenset(set.intersection(*of_lines)) if of_lines else frozenset()

    def text(self, line: str) -> str:
        """The line's mean over `cases`."""
        if not self.values.get(line):
            return NOT_MEASURED
        if not self.cases:
            return NO_COMMON_CASE
        return f"{statistics.fmean(self.values[line][case] for case in self.cases):.{self.digits}f}"

    def quoted(self, row: QuotedRow) -> str:
        """What the paper says."""
        return row.figures.get(self.name, DASH)


def paper_table(
    rows: Sequence[QuotedRow],
    columns: Sequence[Column],
    *,
    titles: Mapping[str, str],
    cases: Mapping[str, int],
    of: int,
    seeds: Mapping[str, Sequence[int]],
) -> Table:
    """Two lines for each of the paper's: what was measured here, and what it says.

    Args:
        rows: the paper's lines.
        columns: with what was measured.
        titles: of our lines, by name; without one the paper's.
        cases: how many cases each line has been run in.
        of: how many there are.
        seeds: that each line was run with.
    """
    header = (
        "method",
        "measured by",
        *(f"{column.title} {ARROWS[column.better]}" for column in columns),
        "cases missing",
        "seeds",
    )
    counts = tuple(str(len(column.cases)) if column.values else DASH for column in columns)
    lines = [("cases of the means", HERE, *counts, str(of) if of else DASH, DASH)]
    for row in rows:
        done = cases.get(row.name, 0)
        own = ", ".join(map(str, sorted(set(seeds.get(row.name, ()))))) or DASH
        lines += [
            (
                titles.get(row.name, row.title),
                HERE,
                *(column.text(row.name) for column in columns),
                f"{of - done}/{of}" if of else DASH,
                own,
            ),
            (row.title, f"{QUOTED}, quoted", *(column.quoted(row) for column in columns), DASH, DASH),
        ]
    return Table(header=header, lines=tuple(lines), left=2)
