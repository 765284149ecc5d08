"""Rasterisation cases: a ``.safetensors`` file, or a folder of ``case_*.safetensors`` files."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open

from sceneexpander.conformance.registry import CaseRunner, KeyFamily
from sceneexpander.geometry.checks import OutputCheck
from sceneexpander.models.weights import check_safetensors

PATTERN = "case_*.safetensors"


def _is_case_file(path: Path) -> bool:
    if path.suffix != ".safetensors" or not path.is_file():
        return False
    try:
        with safe_open(path, "pt") as file:
            names = set(file.keys())
    except (SafetensorError, OSError):
        # Damaged: say so when it runs, rather than pretend that it is of another kind.
        return path.match(PATTERN)
    return {"in.means", "in.viewmats", "out.rgb"} <= names


def _run(path: Path) -> list[OutputCheck]:
    from sceneexpander.splatting.conformance import run_case

    check_safetensors(path)
    return run_case(path)


CASES = [CaseRunner(name="rasterisation", matches=_is_case_file, run=_run)]
KEYS: list[KeyFamily] = []
