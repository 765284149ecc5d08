"""How every command reads its arguments: examples at the end of the help, and one line about what is wrong."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NoReturn

from sceneexpander.errors import UserError, did_you_mean, printable

PROGRAM = "sceneexpander"
_UNKNOWN = "unrecognized arguments: "


class CommandParser(argparse.ArgumentParser):
    """The arguments of ``sceneexpander NAME``.

    Args:
        name: of the command.
        description: what it does; shown as it is written.
        examples: arguments of uses that work, the command's own name left out.
    """

    def __init__(self, name: str, description: str, *, examples: Sequence[str]) -> None:
        self.examples = tuple(examples)
        super().__init__(
            prog=f"{PROGRAM} {name}",
            description=description.strip(),
            epilog="\n".join(["examples:", *(f"  {PROGRAM} {name} {example}".rstrip() for example in examples)]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    def error(self, message: str) -> NoReturn:
        """Raise `UserError`, which `entry_point` prints as one line with exit code 2."""
        if message.startswith(_UNKNOWN):
            word = message.removeprefix(_UNKNOWN).split()[0]
            if word.startswith("-"):
                known = [option for option in self._option_string_actions if option.startswith("--")]
                raise UserError(
                    "unknown option", where=printable(word), fix=did_you_mean(word.partition("=")[0], known)
                )
        raise UserError(message, where=self.prog, fix=f"e.g. {self.prog} {self.examples[0]}".rstrip())
