"""``sceneexpander``: find the command, and hand the rest of the line to it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from sceneexpander import __version__
from sceneexpander.cli.commands import COMMANDS
from sceneexpander.commandline import PROGRAM
from sceneexpander.errors import UserError, did_you_mean, entry_point


def describe_commands() -> str:
    """The list of commands, one line each."""
    width = max(len(command.name) for command in COMMANDS)
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND [arguments]",
            "",
            "Expand a 3D scene of photos by what a sentence says.",
            "",
            *(f"  {command.name:{width}}  {command.summary}" for command in COMMANDS),
            "",
            f"{PROGRAM} COMMAND --help shows arguments and examples; {PROGRAM} --version the version.",
        ]
    )


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command.

    Args:
        arguments: the command line after the program's name; None: this process's own.

    Raises:
        SystemExit: with the command's exit code.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given:
        names = ", ".join(command.name for command in COMMANDS)
        raise UserError(
            "a command is missing", where=PROGRAM, fix=f"give one of {names}; {PROGRAM} --help explains them"
        )
    name, *rest = given
    if name in ("-h", "--help"):
        print(describe_commands())
        return
    if name == "--version":
        print(f"{PROGRAM} {__version__}")
        return
    modules = {command.name: command.module for command in COMMANDS}
    if name not in modules:
        raise UserError("unknown command", where=name, fix=did_you_mean(name, modules))
    raise SystemExit(import_module(modules[name]).main(rest))
