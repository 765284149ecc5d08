"""One table in three notations."""

from __future__ import annotations

import csv
import io

import pytest

from sceneexpander.catalogue import Table

TABLE = Table(
    header=("method", "PSNR, dB \u2191", "open, % \u2193"),
    lines=(("a|b & c_d", "20.00 \u00b1 1.00", "5.0"), ("{model}", "\u2013", "100 %")),
)


def test_markdown_aligns_words_left_and_escapes_bars() -> None:
    assert TABLE.markdown().splitlines() == [
        "| method | PSNR, dB \u2191 | open, % \u2193 |",
        "| :-- | --: | --: |",
        "| a\\|b & c_d | 20.00 \u00b1 1.00 | 5.0 |",
        "| {model} | \u2013 | 100 % |",
    ]


def test_csv_holds_the_same_cells() -> None:
    assert list(csv.reader(io.StringIO(TABLE.csv()))) == [list(TABLE.header), *map(list, TABLE.lines)]


def test_latex_is_a_tabular_without_a_bare_special_character() -> None:
    assert TABLE.latex().splitlines() == [
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"method & PSNR, dB $\uparrow$ & open, \% $\downarrow$ \\",
        r"\midrule",
        r"a\textbar{}b \& c\_d & 20.00 $\pm$ 1.00 & 5.0 \\",
        r"\{model\} & -- & 100 \% \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_lines_are_as_long_as_the_header() -> None:
    with pytest.raises(ValueError, match="every line"):
        Table(header=("a", "b"), lines=(("1",),))
