"""The one error family that users see: a line that says what, where and what to do, and exit code 2."""

from __future__ import annotations

import difflib
import errno
import functools
import os
import signal
import sys
import unicodedata
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_CLOSED_PIPE = 141  # what a shell says of a program that SIGPIPE ended
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_FULL_TEXTS = (
    "no space left on device",
    "disk quota exceeded",
    "database or disk is full",
)  # of libraries with errors of their own
_TURNING = frozenset("\u200e\u200f\u061c\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


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
        """The message as one line: ``where: problem; fix``, without anything that a terminal would obey."""
        text = self.problem if not self.fix else f"{self.problem}; {self.fix}"
        line = printable(" ".join(text.split()))
        return line if self.where is None else f"{printable(self.where)}: {line}"


def printable(text: str) -> str:
    """``text`` on one line, with everything escaped that a terminal would obey or could not show (``a\\nb``, ``\\x1b``, ``\\xff``).

    Control characters, line breaks, marks that turn the direction of writing, and bytes of names that are not valid text.
    """
    return "".join(letter if _is_plain(letter) else _escaped(letter) for letter in text)


def _is_plain(letter: str) -> bool:
    return letter not in _TURNING and unicodedata.category(letter) not in ("Cc", "Cs", "Zl", "Zp")


def _escaped(letter: str) -> str:
    code = ord(letter)
    if 0xDC80 <= code <= 0xDCFF:
        return f"\\x{code - 0xDC00:02x}"  # how Python keeps a byte of a file name that is not UTF-8
    return repr(letter)[1:-1]


_MOST_NAMED = 100


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """What to do about an unknown word: the nearest known one, or all of them unless there are very many. Meant for `UserError.fix`."""
    choices = sorted(known)
    # Another case is the nearest of all, although letter by letter it may have nothing in common.
    same = [choice for choice in choices if choice.casefold() == word.casefold()]
    close = same or difflib.get_close_matches(word, choices, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    more = f" and {len(choices) - _MOST_NAMED} more" if len(choices) > _MOST_NAMED else ""
    return f"known: {', '.join(choices[:_MOST_NAMED])}{more}"


def disk_full(error: BaseException) -> UserError | None:
    """What to say if ``error``, or an error that it came from, means that a disk is full; None for everything else."""
    chain: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in chain:
        chain.append(current)
        current = current.__cause__ or current.__context__
    for one in chain:
        number = one.errno if isinstance(one, OSError) else None
        if number in _FULL or any(text in str(one).casefold() for text in _FULL_TEXTS):
            # The second name, where there are two, is what was written to.
            name = (one.filename2 or one.filename) if isinstance(one, OSError) else None
            where = Path(os.fsdecode(name)).parent if isinstance(name, (str, bytes)) else Path.cwd()
            what = "the quota of this disk is used up" if number == errno.EDQUOT else "No space left on device"
            fix = "make room and start the same command again, it goes on with what is missing"
            return UserError(what, where=where, fix=fix)
    return None


def quiet_start() -> None:
    """Until `interruptible` an interrupt is one line and the end: imports take seconds, and nothing has been begun."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # neither ignored nor somebody else's
        signal.signal(signal.SIGINT, _leave)


def interruptible() -> None:
    """From here on an interrupt is a `KeyboardInterrupt` again."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(*_: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(EXIT_INTERRUPTED)


def entry_point(main: Callable[..., Result]) -> Callable[..., Result]:
    """Wrap a ``main`` so that what the user can mend ends as one line on stderr: a `UserError` or a full disk, with exit code 2.

    An interrupt (Ctrl-C) is one line too, with the exit code that shells give it.
    """

    @functools.wraps(main)
    def wrapped(*args: object, **kwargs: object) -> Result:
        interruptible()
        # A terminal that cannot show a letter gets its number: a message must not fail for the name that it is about.
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
        try:
            return main(*args, **kwargs)
        except UserError as error:
            print(f"error: {error.line()}", file=sys.stderr)
            raise SystemExit(EXIT_BAD_INPUT) from None
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            raise SystemExit(EXIT_INTERRUPTED) from None
        except BrokenPipeError:
            # Whoever read the output has had enough (`| head`). What is still buffered has nowhere to go.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(EXIT_CLOSED_PIPE) from None
        except Exception as error:
            full = disk_full(error)
            if full is None:
                raise
            print(f"error: {full.line()}", file=sys.stderr)
            raise SystemExit(EXIT_BAD_INPUT) from None

    return wrapped
