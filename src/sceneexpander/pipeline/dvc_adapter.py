"""All that is used of DVC's Python code, private functions included, but for what `dvc_memory` makes it remember.

DVC is pinned in the lock; ``test_dvc_adapter.py``, ``test_dvc_memory.py`` and ``test_forkserver.py`` in ``tests/unit/pipeline`` state what
each of these has to do, so that another version can be judged by three test files.
Everything else speaks to DVC through its files and its command line.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.dvc_memory import LOCK_HEAD, MEMORY_FILE, Memory, remembering, split_lock
from sceneexpander.pipeline.forkserver import ForkServer, read_order
from sceneexpander.pipeline.unasked import answer_unasked


def reproduce(arguments: Sequence[str]) -> int:
    """``dvc repro ARGUMENTS`` in the current folder. Returns its exit code."""
    from dvc.cli import main

    _take_any_path()
    _write_locks_by_stage()
    _start_stages()
    with _remembering():
        return int(main(["repro", *arguments]))


def report_status(arguments: Sequence[str]) -> int:
    """``dvc status ARGUMENTS`` in the current folder. Returns its exit code."""
    from dvc.cli import main

    _take_any_path()
    with _remembering(still=True), _without_stage_locks():
        return int(main(["status", *arguments]))


@dataclass(slots=True)
class Unfinished:
    """Stages of a run that failed, and those that were left out because of them."""

    failed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


@contextlib.contextmanager
def noting_failures() -> Iterator[Unfinished]:
    """What fails within the block although the run goes on (``--keep-going``)."""
    from dvc.repo import reproduce as module

    found = Unfinished()
    original = module.handle_error

    def handle_error(graph: Any, on_error: str, exc: Exception, stage: Any) -> Any:
        skipped = original(graph, on_error, exc, stage)
        found.failed.append(stage.addressing)
        found.left_out += sorted(one.addressing for one in skipped if one.addressing not in found.left_out)
        return skipped

    module.handle_error = handle_error
    try:
        yield found
    finally:
        module.handle_error = original


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

    _write_locks_by_stage()
    _start_stages()
    with _remembering():
        Repo().reproduce(targets=[address], single_item=True)


@contextlib.contextmanager
def _without_stage_locks() -> Iterator[None]:
    """Let DVC only look: it would write a file of locks twice for every stage, and refuse to look while a stage runs."""
    from dvc import rwlock

    original, module = rwlock.rwlock, vars(rwlock)
    module["rwlock"] = lambda *_, **__: contextlib.nullcontext()
    try:
        yield
    finally:
        module["rwlock"] = original


@contextlib.contextmanager
def _remembering(*, still: bool = False) -> Iterator[None]:
    ignored = Path(".dvcignore")
    with remembering(
        Memory(MEMORY_FILE, still=still), ignored.read_text(encoding="utf-8") if ignored.is_file() else ""
    ):
        yield


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


@functools.cache
def _fork_server() -> ForkServer:
    server = ForkServer()
    atexit.register(server.close)
    return server


def _start_stages() -> None:
    """Let DVC fork its stages from a process that has loaded what they share, and start none where a stage has nothing to do.

    Does nothing with a version of DVC that runs commands in another place: then every stage is an interpreter of its own.
    """
    from dvc.stage import run

    if hasattr(run, "_starts_stages") or not (hasattr(run, "cmd_run") and hasattr(run, "_run")):
        return
    original, original_run, module = run.cmd_run, run._run, vars(run)

    def cmd_run(stage: Any, dry: bool = False, run_env: Any = None) -> None:
        parameters = {Path(file.fs_path): list(file.params) for file in stage.params}
        if dry or not answer_unasked(parameters, [Path(out.fs_path) for out in stage.outs]):
            original(stage, dry=dry, run_env=run_env)

    def run_command(executable: Any, cmd: str, **kwargs: Any) -> None:
        more = {name: value for name, value in kwargs["env"].items() if os.environ.get(name) != value}
        order = read_order(cmd, more)
        if order is None or not _is_own_python() or not Path.cwd().samefile(kwargs["cwd"]):
            original_run(executable, cmd, **kwargs)
            return
        with _uninterrupted():
            code = _fork_server().run(order)
        if code:
            raise run.StageCmdFailedError(cmd, code)

    module["cmd_run"], module["_run"], module["_starts_stages"] = cmd_run, run_command, True


def _is_own_python() -> bool:
    found = shutil.which("python")
    return found is not None and Path(found).parent == Path(sys.executable).parent


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """As DVC does while a command runs: an interrupt is for the command to end by."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _write_locks_by_stage() -> None:
    """Let DVC replace one stage's lines of ``dvc.lock`` instead of reading and writing all of it after every stage.

    The bytes are the same. With fifty scenes the file has sixty thousand lines, which take DVC half a minute, after each of 1400 stages.
    Does nothing for a file, or with a version of DVC, that looks otherwise.
    """
    from dvc.dvcfile import Lockfile

    if hasattr(Lockfile, "_writes_by_stage"):
        return
    original = Lockfile.dump_stages

    def dump_stages(self: Any, stages: Any, **kwargs: Any) -> None:
        from dvc.stage import serialize

        path = Path(self.path)
        parts = split_lock(path)
        new = {name: text for stage in stages for name, text in _lock_texts(serialize.to_lockfile(stage, **kwargs))}
        if parts is None or any(name.startswith("?") for name in new):
            original(self, stages, **kwargs)
            return
        if all(parts.get(name) == text for name, text in new.items()):
            return
        write_bytes_atomic(path, (LOCK_HEAD + "".join((parts | new).values())).encode())
        self.repo.scm_context.track_file(self.relpath)

    Lockfile.dump_stages, Lockfile._writes_by_stage = dump_stages, True


def _lock_texts(content: dict[str, Any]) -> Iterator[tuple[str, str]]:
    from dvc.utils.serialize import dumps_yaml

    for name, data in content.items():
        text = dumps_yaml({"stages": {name: data}}).removeprefix("stages:\n")
        yield text[2:].partition(":\n")[0], text
