"""What every stage shares: its arguments, its sections of the configuration, its bookkeeping, and how it fails."""

from __future__ import annotations

import argparse
import contextlib
import functools
import hashlib
import logging
import os
import platform
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from sceneexpander.artifacts.store import keep_newest, read_json, write_json_atomic
from sceneexpander.config.files import read_settings
from sceneexpander.errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, UserError, disk_full, interruptible
from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.packages import installed_packages
from sceneexpander.pipeline.processes import end_with_parent
from sceneexpander.pipeline.project import ERROR_FILE_ENV, LIVE_FOLDER, ROOT_ENV, STAGE_ENV
from sceneexpander.pipeline.unasked import write_unasked
from stages import layout

UNFINISHED_KEPT = 20  # interrupted works whose resume points stay, the latest first
LIVE_KEPT = 20  # adaptations whose logs and pictures stay, the latest first

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """Which part of the fan-out a stage run works on."""

    scene: str = ""
    round: int = 0
    previous: int = 0
    method: str = ""


def project_root() -> Path:
    """The main project folder, which all workspaces share for checkpoints and tracking."""
    return Path(os.environ.get(ROOT_ENV, ".")).resolve()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunIdentity:
    """What a run belongs to. Another run never finds its resume points."""

    work: str  # hash of configuration and input bytes
    code: str  # hash of the stage's code and environment

    @property
    def key(self) -> str:
        """Of both."""
        return hashlib.sha256(f"{self.work}\n{self.code}".encode()).hexdigest()[:32]


def checkpoint_folder(run: RunIdentity) -> Path:
    """Where unfinished work of this identity keeps its resume points. What other code left of the same work is said and deleted."""
    folder = project_root() / ".cache" / "ckpt" / run.work
    own = folder / run.code[:32]
    keep_newest(folder.parent, UNFINISHED_KEPT - 1, beside=folder)
    for other in sorted(folder.iterdir()) if folder.is_dir() else ():
        if other != own:
            _log.warning(
                "a resume point of other code or another environment is not continued: the work starts again (%s)",
                other,
            )
            remove_folder(other)
    return own


def remove_checkpoints(run: RunIdentity) -> None:
    """Once the result is safe."""
    remove_folder(project_root() / ".cache" / "ckpt" / run.work)


def run_identity(stage_name: str, sections: object, inputs: Sequence[Path]) -> RunIdentity:
    """The identity of a stage's work with these sections and these artefacts."""
    digest = hashlib.sha256(repr(sections).encode())
    for folder in inputs:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            digest.update(f"{path.as_posix()}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return RunIdentity(work=digest.hexdigest()[:32], code=read_json(layout.CODE)[stage_name])


def live_folder(run: RunIdentity) -> Path:
    """Where a running adaptation of this identity keeps its log and pictures; see `sceneexpander.artifacts.live`.

    The newest `LIVE_KEPT` folders stay; older ones are deleted.
    """
    own = project_root() / LIVE_FOLDER / run.key
    keep_newest(own.parent, LIVE_KEPT - 1, beside=own)
    return own


def stage(*axes: str) -> Callable[[Callable[[Cell], None]], Callable[[], None]]:
    """Make a stage's body its command line: positional arguments for ``axes``, statistics, one-line errors.

    Args:
        axes: of ``scene``, ``round``, ``previous``, ``method``, in command-line order.
    """

    def decorate(body: Callable[[Cell], None]) -> Callable[[], None]:
        name = body.__module__ if body.__module__ != "__main__" else Path(sys.argv[0]).stem
        name = name.rpartition(".")[2]

        @functools.wraps(body)
        def main() -> None:
            interruptible()
            if STAGE_ENV in os.environ:
                end_with_parent()  # an orphan would write into folders that the next run writes to as well
            cell = _parse(name, axes)
            logging.basicConfig(level=logging.INFO, format=f"%(levelname)s {name}: %(message)s")
            statistics = _statistics_path(name, axes, cell)
            try:
                if statistics is not None:
                    installed_packages(Path())
                with _measured(statistics):
                    body(cell)
            except UserError as error:
                _refuse(error)
            except KeyboardInterrupt:
                raise SystemExit(EXIT_INTERRUPTED) from None  # who started the pipeline says so
            except Exception as error:
                full = disk_full(error)
                if full is None:
                    raise
                _refuse(full)

        return main

    return decorate


def _refuse(error: UserError) -> NoReturn:
    print(f"error: {error.line()}", file=sys.stderr, flush=True)
    if ERROR_FILE_ENV in os.environ:
        with contextlib.suppress(OSError):  # the disk may be full: that is what there is to say then
            write_bytes_atomic(Path(os.environ[ERROR_FILE_ENV]), f"{error.line()}\n".encode())
    raise SystemExit(EXIT_BAD_INPUT) from None


def _parse(name: str, axes: tuple[str, ...]) -> Cell:
    parser = argparse.ArgumentParser(prog=f"python -m stages.{name}")
    for axis in axes:
        parser.add_argument(axis, type=int if axis in ("round", "previous") else str)
    values: dict[str, Any] = vars(parser.parse_args())
    return Cell(**values)


# `resolve` is over before it could be measured; `collect` depends on the folder that statistics are in, and a stage that changes its
# own dependency is never restored from the cache.
_UNMEASURED = frozenset({"resolve", "collect"})


def _statistics_path(name: str, axes: tuple[str, ...], cell: Cell) -> Path | None:
    if not axes or name in _UNMEASURED:
        return None
    return layout.statistics(name, cell.scene, cell.round if "round" in axes else None, cell.method or None)


@contextlib.contextmanager
def _measured(path: Path | None) -> Iterator[None]:
    started, wall = time.time(), time.perf_counter()
    yield
    if path is None:
        return
    record: dict[str, Any] = {
        "started": round(started, 3),
        "wall_s": round(time.perf_counter() - wall, 3),
        "cpu_s": round(time.process_time() + sum(os.times()[2:4]), 3),  # with helpers; without what a fork found loaded
        "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "host": {"machine": platform.machine(), "cpus": os.cpu_count(), "torch": "not used"},
    }
    torch = sys.modules.get("torch")
    if torch is not None:
        record["host"]["torch"] = torch.__version__
        record["threads"] = torch.get_num_threads()
        if torch.cuda.is_available():
            record["host"]["gpu"] = torch.cuda.get_device_name()
            record["peak_gpu_mb"] = round(torch.cuda.max_memory_allocated() / 2**20, 1)
    write_json_atomic(path, record)


def left_out(cell: Cell) -> bool:
    """Whether params.yaml does not ask for the cell's method; then that is written down in place of its result.

    `sceneexpander.pipeline.unasked` does the same without a process; this is for stages that something else starts, e.g. ``dvc repro``.
    """
    if read_settings(layout.selection(cell.scene))[cell.method]:
        return False
    write_unasked(cell.method, layout.reconstruction(cell.scene, cell.round, cell.method).parent)
    return True


def use_threads(count: int) -> None:
    """Work with exactly ``count`` threads, whatever the shell says; numpy's matrix products with one.

    Theirs would spin while they wait for each other, and the matrices are small: see `sceneexpander.frontend.threads`.
    """
    import threadpoolctl
    import torch

    threadpoolctl.threadpool_limits({"openmp": count, "blas": 1})
    torch.set_num_threads(count)


def remove_folder(path: Path) -> None:
    """Delete a folder that may not exist. Raises `OSError` if it is there and stays."""
    if path.exists():
        shutil.rmtree(path)
