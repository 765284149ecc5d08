"""Check params.yaml, conf/, the scenes' photos and the weights, and run nothing. The first problem is one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import entry_point
from sceneexpander.pipeline.project import find_project


def make_parser() -> CommandParser:
    """There are no arguments: params.yaml says what is to run."""
    return CommandParser("check", __doc__, examples=[""])


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Check the project that the current folder is in."""
    make_parser().parse_args(arguments)
    project = find_project()
    os.chdir(project)  # params.yaml and conf/ are looked for in the current folder
    sys.path.insert(0, str(project))  # stages/ lies beside the package, not in it
    import_module("stages.check").main()
    print("checked: configuration, photos and weights are in order")
