"""Print a script that makes a shell complete commands, options and file names."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import shtab

from sceneexpander.cli.commands import COMMANDS
from sceneexpander.commandline import PROGRAM, CommandParser
from sceneexpander.errors import UserError, did_you_mean, entry_point

SHELLS = tuple(shtab.SUPPORTED_SHELLS)


def make_parser() -> CommandParser:
    """One argument: the shell."""
    parser = CommandParser(
        "completion", __doc__, examples=["bash > ~/.local/share/bash-completion/completions/sceneexpander"]
    )
    parser.add_argument("shell", help=", ".join(SHELLS))
    return parser


def make_script(shell: str) -> str:
    """The script for one of `SHELLS`."""
    everything = argparse.ArgumentParser(prog=PROGRAM)
    commands = everything.add_subparsers()
    for command in COMMANDS:
        own: CommandParser = import_module(command.module).make_parser()
        for action in own._actions:
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined] # how shtab is told
        commands.add_parser(command.name, help=command.summary, parents=[own], add_help=False)
    return shtab.complete(everything, shell=shell)


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Print the script."""
    shell = make_parser().parse_args(arguments).shell
    if shell not in SHELLS:
        raise UserError("unknown shell", where=shell, fix=did_you_mean(shell, SHELLS))
    print(make_script(shell))
