"""The known kinds of conformance cases and the known released models."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck
from sceneexpander.typed import shorten

# Modules with `CASES` (a list of CaseRunner) and `KEYS` (a list of KeyFamily); imported when the command runs.
FAMILIES = (
    "sceneexpander.conformance.worldmirror",
    "sceneexpander.conformance.omnivggt",
    "sceneexpander.conformance.ttt3r",
    "sceneexpander.conformance.gaussians",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseRunner:
    """One kind of case."""

    name: str
    matches: Callable[[Path], bool]  # is this folder (or file) such a case? Must not raise on other folders.
    run: Callable[[Path], list[OutputCheck]]


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFamily:
    """One released model."""

    name: str
    matches: Callable[[Collection[str]], bool]  # are these the names of its tensors?
    build: Callable[[], nn.Module]  # the released configuration; called under the meta device


def case_runners() -> list[CaseRunner]:
    """All registered kinds of cases."""
    return [runner for module in FAMILIES for runner in importlib.import_module(module).CASES]


def key_families() -> list[KeyFamily]:
    """All registered released models."""
    return [family for module in FAMILIES for family in importlib.import_module(module).KEYS]


def find_cases(path: Path) -> list[tuple[Path, CaseRunner]]:
    """The case at ``path``, or the cases directly inside it.

    Raises:
        UserError: if the path does not exist or holds no case that a registered runner knows.
    """
    if not os.path.exists(path):
        raise UserError("does not exist", where=shorten(str(path), 300), fix="give a conformance case folder")
    runners = case_runners()

    def runner_of(candidate: Path) -> CaseRunner | None:
        return next((runner for runner in runners if runner.matches(candidate)), None)

    own = runner_of(path)
    if own is not None:
        return [(path, own)]
    children = sorted(path.iterdir()) if path.is_dir() else []
    found = [(child, runner) for child in children if (runner := runner_of(child)) is not None]
    if not found:
        known = ", ".join(runner.name for runner in runners)
        raise UserError(_why_unknown(path), where=path, fix=f"known kinds of cases: {known}")
    return found


def _why_unknown(path: Path) -> str:
    if path.is_dir() and not (path / "config.json").is_file():
        return "holds no config.json, cases.json, expected.json or case_*.safetensors"
    model = read_config(path / "config.json").get("model") if path.is_dir() else None
    return f"names an unknown model {model!r}" if isinstance(model, str) else "is not a case of any known kind"


def read_config(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        UserError: if the file is missing or is not a JSON object.
    """
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            raise UserError("is not a file", where=path, fix="fetch the case again")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError("does not exist", where=path, fix="the case is incomplete: fetch it again") from None
    except RecursionError:
        raise UserError("is nested too deeply", where=path, fix="fetch the case again") from None
    except (OSError, ValueError) as error:
        reason = shorten(str(error), 200)
        raise UserError(
            f"is not readable JSON ({reason})", where=shorten(str(path), 300), fix="fetch the case again"
        ) from None
    if not isinstance(content, dict):
        raise UserError(f"holds a {type(content).__name__}, expected an object", where=path, fix="fetch the case again")
    return content


def has_config(path: Path, test: Callable[[dict[str, Any]], bool], name: str = "config.json") -> bool:
    """Is ``path`` a folder whose JSON file ``name`` passes the test? False, never an error, for anything else."""
    if not (path / name).is_file():
        return False
    try:
        return test(read_config(path / name))
    except UserError:
        return False
