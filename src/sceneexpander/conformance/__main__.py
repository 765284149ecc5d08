"""``sceneexpander conformance CASE [CASE...]`` and ``--keys FILE.keys.json``.

Prints one line per output with its largest error, in units of its tolerance. Exit code 0: everything agrees; 1: something does
not; 2: a case is unknown, missing or damaged.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point

if TYPE_CHECKING:
    from sceneexpander.geometry.checks import OutputCheck

EXIT_DISAGREES = 1


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "conformance",
        "Compare this implementation with recorded outputs of reference implementations. Exit code 1: something disagrees.",
        examples=["cases/worldmirror cases/ttt3r", "--keys worldmirror.keys.json"],
    )
    parser.add_argument(
        "cases", nargs="*", type=Path, help="case folders, folders of cases, or rasterisation case files"
    )
    parser.add_argument(
        "--keys", type=Path, action="append", default=[], help="list of a released model's tensor names"
    )
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases and return the exit code."""
    from sceneexpander.conformance.keys import check_keys
    from sceneexpander.conformance.registry import find_cases

    options = make_parser().parse_args(arguments)
    if not options.cases and not options.keys:
        raise UserError("nothing to check", fix="give case folders, or --keys FILE.keys.json")
    # Everything is found before anything runs, so that a typo does not cost the time of the cases before it.
    found = [case for path in options.cases for case in find_cases(path)]
    bad = total = 0
    for path in options.keys:
        failed, count = _report(path.name, check_keys(path))
        bad, total = bad + failed, total + count
    for path, runner in found:
        failed, count = _report(path.name, runner.run(path))
        bad, total = bad + failed, total + count
    verdict = "all agree" if not bad else f"{bad} disagree"
    print(f"{total} outputs compared: {verdict}")
    return EXIT_DISAGREES if bad or not total else 0


def _report(case: str, checks: Iterable[OutputCheck]) -> tuple[int, int]:
    bad = count = 0
    for check in checks:
        count += 1
        bad += not check.ok
        verdict = "ok  " if check.ok else "FAIL"
        tolerance = check.detail if check.tolerance == 1 else f"{check.tolerance:g} {check.detail}".strip()
        print(f"{verdict} {case}/{check.name}: error/tolerance {check.ratio:.3g} [tolerance {tolerance}]")
    return bad, count


if __name__ == "__main__":
    sys.exit(main())
