"""Isolated runs of the pipeline: a copy of the source tree with its own selection, sharing the project's cache.

A workspace is a pipeline folder of its own (no version control), so what one run changes no other run sees. Outputs that another
workspace or the project itself has made before come from the shared cache. Several workspaces may run at the same time: each stage
runs under a lock named by what determines its result, so a stage that two of them need is executed once.
"""

from __future__ import annotations

import glob
import hashlib
import os
import shutil
import sys
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from sceneexpander.config.overrides import key_of, written_out
from sceneexpander.errors import UserError, interruptible
from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.disk import make_writable, remove_tree, require_room
from sceneexpander.pipeline.locks import RunLock, file_lock
from sceneexpander.pipeline.packages import LOCKS
from sceneexpander.pipeline.processes import ended_by_signals, kept
from sceneexpander.pipeline.project import SWEEP_ENV, find_project
from sceneexpander.pipeline.selection import PARAMS, Selection
from sceneexpander.pipeline.surroundings import LOCAL_CONFIG, local_config, pipeline_environment

COPIED_FOLDERS = ("conf", "src", "stages")
COPIED_FILES = ("dvc.yaml", ".dvcignore", "pyproject.toml", *LOCKS, ".dvc/config")
ERROR_FILE = "error.txt"
_NOT_COPIED = shutil.ignore_patterns("__pycache__", "*.pyc", "*.egg-info", ".*.part")


def merged_overrides(base: Sequence[str], more: Sequence[str], *, project: Path) -> tuple[str, ...]:
    """``base``, of the project's params.yaml, followed by ``more``; of several overrides of one key the last stands.

    Paths of files become absolute: those of ``base`` are relative to the project, those of ``more`` to the current folder. A workspace
    runs in a folder of its own, where neither would name anything.
    """
    own = written_out(base, absolute=True, folder=project)
    by_key = {key_of(override): override for override in (*own, *written_out(more, absolute=True))}
    return tuple(by_key.values())


def make_workspace(
    folder: Path,
    selection: Selection,
    *,
    project: Path,
    scenes: Mapping[str, Path] | None = None,
    move_scenes: bool = False,
) -> Path:
    """Create or refresh a workspace. Outputs of an earlier run in the same folder stay, so only what changed runs again.

    Args:
        folder: where the workspace lives.
        selection: what it runs.
        project: the folder that it copies the sources from and shares the cache with.
        scenes: scene folders by name; those not named here come from the project's ``scenes/``.
        move_scenes: the folders in ``scenes`` are copies already, on the same disk, and become the workspace's.
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
            _replace_folder(source, folder / "scenes" / scene, move=move_scenes and scene in (scenes or {}))
    write_bytes_atomic(folder / PARAMS, selection.to_yaml().encode())
    write_bytes_atomic(folder / LOCAL_CONFIG, _shared_cache(folder, project))
    return folder


def _shared_cache(folder: Path, project: Path) -> bytes:
    """DVC's local configuration of a workspace: no version control, the project's cache."""
    shared = project.resolve() / ".dvc"
    home = (folder / ".dvc").resolve()
    # A relative path leaves out what the project's own folders are called, which DVC's configuration may not be able to say.
    near = home.is_relative_to(project.resolve())
    cache = os.path.relpath(shared / "cache", home) if near else shared / "cache"
    try:
        return local_config(cache=cache, site=shared / "tmp" / "site", no_scm=True)
    except UserError:
        return local_config(cache=cache, site=None, no_scm=True)  # pipelines get it by the environment as well


def _replace_folder(source: Path, target: Path, *, move: bool = False) -> None:
    """Make ``target`` a copy of ``source``, or ``source`` itself. What is copied can be written, whatever the original allows."""
    if not source.is_dir():
        raise UserError("does not exist", where=source)
    target.parent.mkdir(parents=True, exist_ok=True)
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
        remove_tree(left)  # of a run that was killed
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        if move:
            source.rename(scratch)
        else:
            shutil.copytree(source, scratch, ignore=_NOT_COPIED)
        make_writable(scratch)
        remove_tree(target)
        scratch.rename(target)
    finally:
        remove_tree(scratch)


def workspace_environment(folder: Path, project: Path) -> dict[str, str]:
    """Environment in which a workspace's stages run its own copy of the sources with this interpreter."""
    return pipeline_environment(folder, project, error_file=folder / ERROR_FILE)


def reproduce(folder: Path, *, project: Path, lock: RunLock | None = None) -> None:
    """``dvc repro`` in a workspace. It ends with this process, however that ends; until then it holds the ``lock``.

    Raises:
        UserError: a stage refused its input (the message is the stage's own), or the disk is full.
        RuntimeError: anything else went wrong; the stage's output is on stderr.
    """
    _run(["-m", "sceneexpander.pipeline"], folder, workspace_environment(folder, project), lock)


def reproduce_shared(folder: Path, *, project: Path, sweep: str | None = None) -> None:
    """Like `reproduce`, stage by stage under the project's locks: for workspaces that run at the same time.

    Runs are tagged with the id of the ``sweep``, if there is one.
    """
    environment = workspace_environment(folder, project)
    if sweep is not None:
        environment[SWEEP_ENV] = sweep
    _run(["-m", "sceneexpander.pipeline.workspace", str(folder)], folder, environment, None)


def _run(arguments: Sequence[str], folder: Path, environment: Mapping[str, str], lock: RunLock | None) -> None:
    (folder / ERROR_FILE).unlink(missing_ok=True)
    command = [sys.executable, *arguments]
    held = () if lock is None else (lock.descriptor,)
    with ended_by_signals(), kept(command, cwd=folder, env=environment, held=held) as process:
        if lock is not None:
            lock.note(os.getpid(), process.pid)
        code = process.wait()
    _raise_for(code, folder)


def _raise_for(code: int, folder: Path) -> None:
    if code == 0:
        return
    error = folder / ERROR_FILE
    if error.is_file():
        raise UserError(error.read_text(encoding="utf-8"))
    require_room(folder)
    raise RuntimeError(f"the pipeline failed in {folder} (exit code {code}); its last lines say where")


def run_stages(folder: Path, locks: Path) -> None:
    """Run every stage of a workspace, which is the current folder, in order, each under a lock named by what determines its result."""
    from sceneexpander.pipeline import dvc_adapter
    from sceneexpander.pipeline.recording import ask_for_recording

    ask_for_recording()
    for address in dvc_adapter.ordered_addresses():
        # Everything before it has run, so its dependencies exist.
        identity = dvc_adapter.identify_result(address) or f"{folder}:{address}"
        name = hashlib.sha256(identity.encode()).hexdigest()
        # A second workspace waits here, then finds the result in the cache.
        with file_lock(locks / name):
            dvc_adapter.reproduce_stage(address)


def main() -> None:
    """``python -m sceneexpander.pipeline.workspace FOLDER``: what `reproduce_shared` starts."""
    interruptible()
    folder = Path(sys.argv[1]).resolve()
    os.chdir(folder)
    run_stages(folder, find_project() / ".cache" / "locks")


if __name__ == "__main__":
    main()
