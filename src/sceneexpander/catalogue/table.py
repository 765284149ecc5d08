"""A table of texts as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\u00b1": r"$\pm$",
    "\u2191": r"$\uparrow$",
    "\u2193": r"$\downarrow$",
    "\u2212": "$-$",
    "\u00b0": r"$^\circ$",
    "\u2013": "--",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A header and lines of text, equally long. The first ``left`` columns hold words, the others numbers."""

    header: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    left: int = 1

    def __post_init__(self) -> None:
        if any(len(line) != len(self.header) for line in self.lines):
            raise ValueError("every line needs a cell for every column of the header")

    def markdown(self) -> str:
        """As a Markdown table; columns of words are left-aligned."""
        rule = tuple(":--" if index < self.left else "--:" for index in range(len(self.header)))
        rows = (self.header, rule, *self.lines)
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows) + "\n"

    def csv(self) -> str:
        """As CSV (RFC 4180)."""
        buffer = io.StringIO()
        csv.writer(buffer).writerows([self.header, *self.lines])
        return buffer.getvalue()

    def latex(self) -> str:
        """As a ``tabular`` with the rules of the package booktabs."""
        columns = "".join("l" if index < self.left else "r" for index in range(len(self.header)))
        rows = [" & ".join(_latex_text(cell) for cell in row) + r" \\" for row in (self.header, *self.lines)]
        parts = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", rows[0], r"\midrule", *rows[1:], r"\bottomrule"]
        return "\n".join([*parts, r"\end{tabular}"]) + "\n"


def _latex_text(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)
