"""``sceneexpander run``: the stages of ``dvc.yaml`` without DVC.

The same commands in the same order with the same rule: a stage runs when its command, the bytes that it depends on, the parameters that it
reads, or what it made last time have changed. What was is in ``.cache/run/state.json``. There is no cache of earlier results, no remote
and no experiment queue: that is what DVC is for.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import shlex
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.store import read_json, read_typed, sha256_of_file, to_plain, write_json_atomic
from sceneexpander.commandline import CommandParser
from sceneexpander.config.files import read_settings
from sceneexpander.errors import EXIT_BAD_INPUT, UserError, entry_point, printable
from sceneexpander.pipeline.declared import (
    DeclaredStage,
    find_predecessors,
    find_stale,
    read_pipeline,
    select_stages,
)
from sceneexpander.pipeline.disk import remove_tree, require_room
from sceneexpander.pipeline.forkserver import ForkServer, read_order
from sceneexpander.pipeline.locks import run_lock
from sceneexpander.pipeline.processes import ended_by_signals, kept
from sceneexpander.pipeline.project import STAGE_ENV, find_project
from sceneexpander.pipeline.recording import ask_for_recording
from sceneexpander.pipeline.surroundings import pipeline_environment
from sceneexpander.pipeline.unasked import answer_unasked

STATE = Path(".cache") / "run" / "state.json"
_SCHEMA = "run/1"
_IGNORED = ("__pycache__", ".venv")
_IGNORED_ENDS = (".pyc", ".so", ".part", ".old")
_ABSENT = "absent"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fingerprint:
    """What a stage saw and made: hashes by path, parameters' values by file and key."""

    command: str
    dependencies: dict[str, str]
    parameters: dict[str, dict[str, Any]]
    outputs: dict[str, str]


@dataclass(slots=True)
class Hasher:
    """Hashes of files and folders. A file is read again only when its size, time or inode changed."""

    known: dict[str, tuple[int, int, int, str]] = field(default_factory=dict)

    def hash_path(self, path: Path) -> str:
        """Of a file's bytes, or of names and bytes of all files in a folder; links count as what they lead to."""
        if path.is_dir():
            return self._hash_folder(path)
        return self._hash_file(path) if path.is_file() else _ABSENT

    def _hash_folder(self, folder: Path) -> str:
        digest = hashlib.sha256(b"folder")
        for parent, folders, files in os.walk(folder, followlinks=True):
            folders[:] = sorted(name for name in folders if name not in _IGNORED)
            for name in sorted(files):
                path = Path(parent) / name
                if not name.endswith(_IGNORED_ENDS) and path.is_file():
                    relative = path.relative_to(folder).as_posix()
                    digest.update(f"\0{relative}\0{self._hash_file(path)}".encode(errors="surrogateescape"))
        return digest.hexdigest()

    def _hash_file(self, path: Path) -> str:
        stat = path.stat()
        mark = (stat.st_size, stat.st_mtime_ns, stat.st_ino)
        found = self.known.get(str(path))
        if found is not None and tuple(found[:3]) == mark:
            return found[3]
        digest = sha256_of_file(path)
        self.known[str(path)] = (*mark, digest)
        return digest


@dataclass(frozen=True, slots=True, kw_only=True)
class _Saved:
    stages: dict[str, Fingerprint]
    files: dict[str, tuple[int, int, int, str]]
    schema: str = _SCHEMA


class PlainRunner:
    """Brings a pipeline folder up to date.

    Args:
        folder: the project, which is also the current folder.
        keep_going: after a failed stage go on with all that does not need it.
        jobs: how many stages may run at once.
        force: run every stage, changed or not.
        held: descriptors of lock files that stay locked until the last process of a stage is gone.
    """

    def __init__(
        self, folder: Path, *, keep_going: bool = True, jobs: int = 1, force: bool = False, held: Sequence[int] = ()
    ) -> None:
        self.folder, self.keep_going, self.jobs, self.force, self.held = folder, keep_going, jobs, force, tuple(held)
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._forks = ForkServer(self._start_forks)
        self._books = threading.Lock()  # stages run in threads of their own and share what is known of files
        saved = self._load()
        self.fingerprints, self.hasher = dict(saved.stages), Hasher(dict(saved.files))
        self.failed: dict[str, int] = {}
        self.left_out: list[str] = []
        self.ran: list[str] = []
        self._stages: Sequence[DeclaredStage] = ()
        self._parameter_files: dict[tuple[str, str], Any] = {}

    def run(self, stages: Sequence[DeclaredStage]) -> None:
        """Run what has changed. What failed, and what was left out because of it, is in `failed` and `left_out`."""
        self._stages = stages
        before = {address: set(found) for address, found in find_predecessors(stages).items()}
        waiting = {stage.address: stage for stage in stages}
        done: set[str] = set()
        running: dict[Future[int | None], DeclaredStage] = {}
        with ThreadPoolExecutor(self.jobs) as pool, self._ending_what_runs():
            while waiting or running:
                for stage in [*waiting.values()]:
                    if before[stage.address] <= done and len(running) < self.jobs and self._may_start():
                        del waiting[stage.address]
                        if self._can_run(stage, before[stage.address]):
                            running[pool.submit(self._bring_up_to_date, stage)] = stage
                        else:
                            self._leave_out(stage)
                            done.add(stage.address)
                if not running:
                    if not self._may_start():
                        self.left_out.extend(waiting)
                        break
                    continue
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    stage = running.pop(future)
                    code = future.result()
                    if code:
                        self.failed[stage.address] = code
                        self._remove_stale(stage)
                    done.add(stage.address)
                    self._save()

    @contextlib.contextmanager
    def _ending_what_runs(self) -> Iterator[None]:
        with ended_by_signals():
            try:
                yield
            except BaseException:
                for process in [*self._processes]:
                    process.terminate()
                raise
            finally:
                self._forks.close()

    def _start_forks(self, command: Sequence[str], door: socket.socket) -> AbstractContextManager[object]:
        environment = pipeline_environment(self.folder, self.folder)
        return kept(command, cwd=self.folder, env=environment, held=self.held, stdin=door)

    def is_up_to_date(self, stage: DeclaredStage) -> bool:
        """Whether nothing that the stage depends on, and nothing that it made, has changed since it ran."""
        return not self.force and self.fingerprints.get(stage.address) == self._fingerprint(stage)

    def _may_start(self) -> bool:
        return self.keep_going or not self.failed

    def _can_run(self, stage: DeclaredStage, before: set[str]) -> bool:
        """Not without what failed stages should have made. What gathers all scenes goes on with those that are there."""
        lost = before & {*self.failed, *self.left_out}
        if not lost:
            return True
        return stage.gathers and all((self.folder / path).exists() for path in stage.reads)

    def _leave_out(self, stage: DeclaredStage) -> None:
        self.left_out.append(stage.address)
        self._remove_stale(stage)

    def _remove_stale(self, stage: DeclaredStage) -> None:
        for path in find_stale(self._stages, {stage.address}):
            remove_tree(self.folder / path)

    def _bring_up_to_date(self, stage: DeclaredStage) -> int | None:
        if self.is_up_to_date(stage):
            return None
        print(f"running {printable(stage.address)}", flush=True)
        self.fingerprints.pop(stage.address, None)
        self._save()  # killed now, it counts as never run
        for output in stage.outputs:
            path = self.folder / output.path
            if not output.persist:
                remove_tree(path)
            path.parent.mkdir(parents=True, exist_ok=True)
        # What it reads is noted before it runs: an edit while it runs makes it run again.
        seen = self._fingerprint(stage)
        started = time.monotonic()
        code = 0
        made = [self.folder / output.path for output in stage.outputs]
        if not answer_unasked({self.folder / file: keys for file, keys in stage.parameters.items()}, made):
            code = self._run_command(stage)
        missing = [output.path for output in stage.outputs if not (self.folder / output.path).exists()]
        if code or missing:
            return code or 1
        self.fingerprints[stage.address] = replace(seen, outputs=self._fingerprint(stage).outputs)
        self.ran.append(stage.address)
        print(f"done    {printable(stage.address)} ({time.monotonic() - started:.0f} s)", flush=True)
        return None

    def _run_command(self, stage: DeclaredStage) -> int:
        named = {STAGE_ENV: stage.address}
        order = read_order(stage.command, named)
        if order is not None:
            return self._forks.run(order)
        program, *arguments = shlex.split(stage.command)
        command = [sys.executable if program == "python" else program, *arguments]
        environment = pipeline_environment(self.folder, self.folder) | named
        with kept(command, cwd=self.folder, env=environment, held=self.held) as process:
            self._processes.add(process)
            code = process.wait()
            self._processes.discard(process)
        return code

    def _fingerprint(self, stage: DeclaredStage) -> Fingerprint:
        with self._books:
            return Fingerprint(
                command=stage.command,
                dependencies={path: self.hasher.hash_path(self.folder / path) for path in stage.dependencies},
                parameters={
                    file: {key: self._parameter(file, key) for key in keys} for file, keys in stage.parameters.items()
                },
                outputs={output.path: self.hasher.hash_path(self.folder / output.path) for output in stage.outputs},
            )

    def _parameter(self, file: str, key: str) -> Any:
        """The value under a dotted key; None where there is none."""
        path = self.folder / file
        mark = self.hasher.hash_path(path)
        if mark == _ABSENT:
            return None
        if (file, mark) not in self._parameter_files:
            # As JSON has it, so that what is saved compares equal with what is read again.
            self._parameter_files[file, mark] = json.loads(json.dumps(read_settings(path)))
        node = self._parameter_files[file, mark]
        for part in key.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
        return node

    def _load(self) -> _Saved:
        path = self.folder / STATE
        if path.is_file():
            try:
                return read_typed(_Saved, read_json(path), path)
            except UserError:
                print(f"note: {STATE} is of another version; every stage runs", file=sys.stderr)
        return _Saved(stages={}, files={})

    def _save(self) -> None:
        with self._books:
            write_json_atomic(self.folder / STATE, to_plain(_Saved(stages=self.fingerprints, files=self.hasher.known)))


def make_parser() -> argparse.ArgumentParser:
    """The arguments of ``sceneexpander run``."""
    parser = CommandParser(
        "run",
        "Bring the project's pipeline up to date without DVC: stages whose inputs have not changed are left out.",
        examples=EXAMPLES,
    )
    parser.add_argument(
        "targets", nargs="*", metavar="STAGE", help="only these (adapt, adapt@courtyard-round0) and what they need"
    )
    parser.add_argument("--jobs", type=int, default=1, help="stages at the same time (default: 1)")
    parser.add_argument("--force", action="store_true", help="run every stage, changed or not")
    parser.add_argument("--stop", action="store_true", help="stop at the first stage that fails")
    parser.add_argument(
        "--list", action="store_true", help="print the stages that would be looked at, in order; run nothing"
    )
    return parser


EXAMPLES = ("", "--list", "evaluate", "--jobs 2")


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Exit code 0: all is up to date; 2: a stage refused its input; 1: a stage failed in another way."""
    options = make_parser().parse_args(arguments)
    if options.jobs < 1:
        raise UserError("must be at least 1", where=f"--jobs {options.jobs}")
    project = find_project()
    stages = select_stages(read_pipeline(project), options.targets)
    if options.list:
        print("\n".join(stage.address for stage in stages))
        return
    os.chdir(project)
    with run_lock(project / ".cache" / "repro", what=project) as lock:
        ask_for_recording()
        runner = PlainRunner(
            project, keep_going=not options.stop, jobs=options.jobs, force=options.force, held=(lock.descriptor,)
        )
        runner.run(stages)
    if runner.failed:
        require_room(project)
        names = " ".join(shlex.quote(address) for address in runner.failed)
        codes = set(runner.failed.values())
        print(
            f"error: {len(runner.failed)} of {len(stages)} stages failed ({names}), {len(runner.left_out)} were left out; "
            f"again, only what is missing: sceneexpander run",
            file=sys.stderr,
        )
        raise SystemExit(EXIT_BAD_INPUT if codes == {EXIT_BAD_INPUT} else 1)
    print(f"{len(runner.ran)} of {len(stages)} stages ran, the others were up to date")
