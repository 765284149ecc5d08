"""Isolated runs of the pipeline: a copy of the source tree with its own selection, sharing the project's cache.

A workspace is a pipeline folder of its own (no version control), so what one run changes no other run sees. Outputs that another
workspace or the project itself has made before come from the shared cache. Several workspaces may run at the same time: each stage
runs under a lock named by what determines its result, so a stage that two of them need is executed once.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from sceneexpander.artifacts.store import write_bytes_atomic
from sceneexpander.errors import UserError
from sceneexpander.project import ERROR_FILE_ENV, ROOT_ENV, SWEEP_ENV, find_project

COPIED_FOLDERS = ("conf", "src", "stages")
COPIED_FILES = ("dvc.yaml", ".dvcignore", "pyproject.toml", ".dvc/config")
ERROR_FILE = "error.txt"
PATH_KEYS = frozenset({"model.weights", "generator.file", "rivals.omnivggt.weights", "rivals.ttt3r.weights"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What a workspace runs: the content of its params.yaml."""

    scenes: tuple[str, ...]
    rounds: int
    methods: tuple[str, ...] = ("captured", "backbone", "sceneexpander")
    overrides: tuple[str, ...] = ()

    def to_yaml(self) -> str:
        """The text of params.yaml."""
        content = {
            "scenes": list(self.scenes),
            "rounds": [{"k": k, "prev": k - 1} for k in range(1, self.rounds + 1)],
            "methods": list(self.methods),
            "overrides": list(self.overrides),
        }
        return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def merged_overrides(base: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    """``base`` followed by ``more``; of several overrides of one key the last stands. Paths of files become absolute.

    A workspace runs in a folder of its own, where a path relative to the user's would name nothing.
    """
    by_key = {override.lstrip("+~").partition("=")[0]: override for override in (*base, *more)}
    return tuple(_with_absolute_path(override) for override in by_key.values())


def _with_absolute_path(override: str) -> str:
    key, _, value = override.partition("=")
    if key not in PATH_KEYS or not Path(value).expanduser().is_file():
        return override
    return f"{key}={Path(value).expanduser().resolve()}"


def read_selection(project: Path) -> Selection:
    """The selection of a project folder. Raises `UserError` if its params.yaml is malformed."""
    path = project / "params.yaml"
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        return Selection(
            scenes=tuple(str(scene) for scene in raw["scenes"]),
            rounds=len(raw["rounds"]),
            methods=tuple(str(method) for method in raw["methods"]),
            overrides=tuple(str(item) for item in raw["overrides"]),
        )
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        raise UserError(
            f"does not select a run ({error})", where=path, fix="see params.yaml of the repository"
        ) from None


def make_workspace(
    folder: Path, selection: Selection, *, project: Path, scenes: Mapping[str, Path] | None = None
) -> Path:
    """Create or refresh a workspace. Outputs of an earlier run in the same folder stay, so only what changed runs again.

    Args:
        folder: where the workspace lives.
        selection: what it runs.
        project: the folder that it copies the sources from and shares the cache with.
        scenes: scene folders by name; those not named here come from the project's ``scenes/``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in COPIED_FOLDERS:
        _replace_folder(project / name, folder / name)
    for name in COPIED_FILES:
        if (project / name).is_file():
            write_bytes_atomic(folder / name, (project / name).read_bytes())
    for scene in selection.scenes:
        source = (scenes or {}).get(scene, project / "scenes" / scene)
        if source.resolve() != (folder / "scenes" / scene).resolve():
            _replace_folder(source, folder / "scenes" / scene)
    write_bytes_atomic(folder / "params.yaml", selection.to_yaml().encode())
    shared = project / ".dvc"
    local = f"[core]\n    no_scm = true\n    site_cache_dir = {shared / 'tmp' / 'site'}\n[cache]\n    dir = {shared / 'cache'}\n"
    write_bytes_atomic(folder / ".dvc" / "config.local", local.encode())
    return folder


def _replace_folder(source: Path, target: Path) -> None:
    """Make ``target`` a copy of ``source``."""
    if not source.is_dir():
        raise UserError("does not exist", where=source)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        shutil.copytree(source, scratch, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", "*.egg-info", ".*.part"))
        shutil.rmtree(target, ignore_errors=True)
        scratch.rename(target)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def workspace_environment(folder: Path, project: Path) -> dict[str, str]:
    """Environment in which a workspace's stages run its own copy of the sources with this interpreter."""
    return {
        **os.environ,
        ROOT_ENV: str(project),
        ERROR_FILE_ENV: str(folder / ERROR_FILE),
        "PYTHONPATH": str(folder / "src"),
        # Not resolved: a virtual environment's python is a link, and its folder is what selects the environment.
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
        "MLFLOW_DISABLE_TELEMETRY": "true",
    }


def run_group(command: Sequence[str], *, cwd: Path, env: Mapping[str, str]) -> int:
    """Run a command in a process group of its own; when this process is interrupted, the whole group ends with it."""
    process = subprocess.Popen(list(command), cwd=cwd, env=dict(env), start_new_session=True)
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM)) if _in_main_thread() else None
    try:
        return process.wait()
    finally:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            process.wait()
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)


def _in_main_thread() -> bool:
    import threading

    return threading.current_thread() is threading.main_thread()


def reproduce(folder: Path, *, project: Path) -> None:
    """``dvc repro`` in a workspace.

    Raises:
        UserError: a stage refused its input; the message is the stage's own.
        RuntimeError: anything else went wrong; the stage's output is on stderr.
    """
    error = folder / ERROR_FILE
    error.unlink(missing_ok=True)
    code = run_group([sys.executable, "-m", "dvc", "repro"], cwd=folder, env=workspace_environment(folder, project))
    _raise_for(code, folder)


def reproduce_shared(folder: Path, *, project: Path, sweep: str | None = None) -> None:
    """Like `reproduce`, stage by stage under the project's locks: for workspaces that run at the same time.

    Runs are tagged with the id of the ``sweep``, if there is one.
    """
    (folder / ERROR_FILE).unlink(missing_ok=True)
    command = [sys.executable, "-m", "sceneexpander.workspace", str(folder)]
    environment = workspace_environment(folder, project)
    if sweep is not None:
        environment[SWEEP_ENV] = sweep
    _raise_for(run_group(command, cwd=folder, env=environment), folder)


def _raise_for(code: int, folder: Path) -> None:
    if code == 0:
        return
    error = folder / ERROR_FILE
    if error.is_file():
        raise UserError(error.read_text(encoding="utf-8"))
    raise RuntimeError(f"the pipeline failed in {folder} (exit code {code}); its last lines say where")


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold an exclusive lock; the kernel releases it if the process dies."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)


def run_stages(folder: Path, locks: Path) -> None:
    """Run every stage of a workspace in order, each under a lock named by what determines its result.

    Uses two private functions of DVC for that name; the version is pinned and a test checks that they are there.
    """
    import networkx
    from dvc.repo import Repo
    from dvc.stage.cache import _can_hash, _get_stage_hash

    addresses = [stage.addressing for stage in reversed(list(networkx.topological_sort(Repo(folder).index.graph)))]
    for address in addresses:
        stage = Repo(folder).stage.collect(address)[0]
        stage.save_deps()  # everything before it has run, so its dependencies exist
        identity = _get_stage_hash(stage) if _can_hash(stage) else f"{folder}:{address}"
        name = hashlib.sha256(str(identity).encode()).hexdigest()
        # A second workspace waits here, then finds the result in the cache.
        with file_lock(locks / name):
            Repo(folder).reproduce(targets=[address], single_item=True)


def main() -> None:
    """``python -m sceneexpander.workspace FOLDER``: what `reproduce_shared` starts."""
    folder = Path(sys.argv[1]).resolve()
    os.chdir(folder)
    run_stages(folder, find_project() / ".cache" / "locks")


if __name__ == "__main__":
    main()
