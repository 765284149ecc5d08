"""All that is used of DVC's Python code, private functions included.

DVC is pinned in the lock; ``tests/unit/pipeline/test_dvc_adapter.py`` states what each of these has to do, so that another version can be
judged by one test file. Everything else speaks to DVC through its files and its command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any


def reproduce(arguments: Sequence[str]) -> int:
    """``dvc repro ARGUMENTS`` in the current folder. Returns its exit code."""
    from dvc.cli import main

    _take_any_path()
    return int(main(["repro", *arguments]))


def ordered_addresses() -> list[str]:
    """The stages of the pipeline in the current folder, each after all that it depends on, e.g. ``adapt@courtyard-round0``."""
    import networkx
    from dvc.repo import Repo

    _take_any_path()
    return [stage.addressing for stage in reversed(list(networkx.topological_sort(Repo().index.graph)))]


def identify_result(address: str) -> str | None:
    """What determines the result of a stage of the current folder: equal for equal commands, dependencies and parameters.

    Its dependencies must exist. None: DVC keeps no result of it to be found again.
    """
    from dvc.repo import Repo
    from dvc.stage.cache import _can_hash, _get_stage_hash

    stage = Repo().stage.collect(address)[0]
    stage.save_deps()
    return str(_get_stage_hash(stage)) if _can_hash(stage) else None


def reproduce_stage(address: str) -> None:
    """Run one stage of the current folder, or take its result from the cache. Raises DVC's own errors."""
    from dvc.repo import Repo

    Repo().reproduce(targets=[address], single_item=True)


def can_use_repository(folder: Path) -> bool:
    """Whether DVC can work with the git repository that ``folder`` is in."""
    from dvc.exceptions import DvcException
    from dvc.scm import SCM

    try:
        SCM(str(folder)).close()
    except (DvcException, OSError, ValueError):
        return False
    return True


def _take_any_path() -> None:
    """Let DVC work in folders with braces in their names: one of its progress bars takes the cache's path for a format.

    Does nothing where a later version of DVC has no such bar.
    """
    try:
        from dvc_data.hashfile._progress import QueryingProgress
    except ImportError:
        return
    bar: Any = QueryingProgress
    if hasattr(bar, "_takes_any_path"):
        return
    original = bar.__init__

    def escaped(self: Any, iterable: Any = None, total: Any = None, name: Any = None, phase: str = "Querying") -> None:
        shown = name.replace("{", "{{").replace("}", "}}") if isinstance(name, str) else name
        original(self, iterable, total=total, name=shown, phase=phase)

    bar.__init__, bar._takes_any_path = escaped, True
