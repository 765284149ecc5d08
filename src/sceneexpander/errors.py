"""The one error family that users see: a line that says what, where and what to do, and exit code 2."""

from __future__ import annotations

import difflib
import functools
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

EXIT_BAD_INPUT = 2


class UserError(Exception):
    """Something the user can mend. Printed as one line, without a traceback; the process exits with code 2.

    Args:
        problem: what is wrong, e.g. ``"is truncated (expected 31204 bytes, found 512)"``.
        where: the file, config key or argument the problem is in.
        fix: what to do about it.
    """

    def __init__(self, problem: str, *, where: str | Path | None = None, fix: str | None = None) -> None:
        self.problem = problem
        self.where = None if where is None else str(where)
        self.fix = fix
        super().__init__(self.line())

    def line(self) -> str:
        """The message as one line: ``where: problem; fix``."""
        text = self.problem if self.where is None else f"{self.where}: {self.problem}"
        if self.fix:
            text = f"{text}; {self.fix}"
        return " ".join(text.split())


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """What to do about an unknown word: the nearest known one, or all of them. Meant for `UserError.fix`."""
    choices = sorted(known)
    close = difflib.get_close_matches(word, choices, n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(choices)}"


def entry_point(main: Callable[..., Result]) -> Callable[..., Result]:
    """Wrap a ``main`` so that a `UserError` ends as one line on stderr and exit code 2."""

    @functools.wraps(main)
    def wrapped(*args: object, **kwargs: object) -> Result:
        try:
            return main(*args, **kwargs)
        except UserError as error:
            print(f"error: {error.line()}", file=sys.stderr)
            raise SystemExit(EXIT_BAD_INPUT) from None

    return wrapped
