"""What the engines cost when nothing changed: ``dvc status`` and ``make repro``'s command over scenes whose results are all there.

    python benchmarks/many_scenes.py FOLDER [--scenes 50] [--files 8]

FOLDER must not exist; it becomes a project with that many scenes, every one with the settings of the bundled scene, and small files in
place of results: as many per output folder as asked for. ``dvc.lock`` is what DVC would have written. Printed are CPU and wall seconds of
each command, twice: the first time DVC hashes every file. Two commands that start Python and do nothing else are the
floor. `track` is left out: it always runs, and would look at results.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sceneexpander.catalogue.methods import known_methods
from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import read_settings, write_settings
from sceneexpander.pipeline.declared import DeclaredStage, read_pipeline
from sceneexpander.pipeline.project import find_project
from sceneexpander.pipeline.selection import ROUND_SECTIONS
from stages import layout

COPIED = (
    "conf",
    "src",
    "stages",
    "dvc.yaml",
    "params.yaml",
    "requirements.lock",
    "requirements-nodeps.lock",
    ".dvcignore",
)
SCENE = "courtyard"


def make_project(folder: Path, scenes: int, files: int) -> None:
    """Fill ``folder``: sources as they are, scenes, results in small, and the lock that goes with them."""
    project = find_project()
    folder.mkdir(parents=True)
    for name in COPIED:
        source = project / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
        else:
            shutil.copy2(source, folder / name)
    quiet = {**os.environ, "DVC_NO_ANALYTICS": "true"}
    subprocess.run(["dvc", "init", "--no-scm", "-q"], cwd=folder, env=quiet, check=True)
    (folder / ".dvc" / "config").write_text((project / ".dvc" / "config").read_text() + "    no_scm = true\n")
    names = [f"scene_{number:04d}" for number in range(scenes)]
    params = yaml.safe_load((folder / "params.yaml").read_text())
    (folder / "params.yaml").write_text(yaml.safe_dump({**params, "scenes": names}, sort_keys=False))
    values = compose(project / "conf", [f"scene={scene_option(project / 'conf', SCENE)}"])
    for name in names:
        shutil.copytree(project / "scenes" / SCENE, folder / "scenes" / name)
        (folder / "outputs" / name).mkdir(parents=True)
        write_settings(folder / layout.config(name), values)
        write_settings(
            folder / layout.round_settings(name), {layout.round_key(1): {key: values[key] for key in ROUND_SECTIONS}}
        )
        write_settings(
            folder / layout.selection(name), {method.name: True for method in known_methods() if not method.always_made}
        )
    stages = read_pipeline(folder)
    write_settings(
        folder / layout.CODE, {stage.name: hashlib.sha256(stage.name.encode()).hexdigest() for stage in stages}
    )
    for stage in stages:
        for path in (*(output.path for output in stage.outputs), *stage.dependencies):  # which may be parts of outputs
            _make_output(folder / path, files)
    lock = {"schema": "2.0", "stages": {stage.address: _locked(stage, folder) for stage in stages}}
    (folder / "dvc.lock").write_text(yaml.safe_dump(lock, sort_keys=False, width=80))


def _make_output(path: Path, files: int) -> None:
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix:
        path.write_text(str(path))
        return
    for number in range(files):
        (path / f"part_{number % 2}").mkdir(parents=True, exist_ok=True)
        (path / f"part_{number % 2}" / f"{number}.txt").write_text(f"{path} {number}")


def _locked(stage: DeclaredStage, folder: Path) -> dict[str, Any]:
    entry: dict[str, Any] = {"cmd": stage.command}
    if stage.dependencies:
        entry["deps"] = [_hashed(path, folder) for path in sorted(stage.dependencies)]
    if stage.parameters:
        entry["params"] = {
            file: {key: _value(read_settings(folder / file), key) for key in sorted(keys)}
            for file, keys in sorted(stage.parameters.items(), key=lambda item: (item[0] != "params.yaml", item[0]))
        }
    entry["outs"] = [_hashed(output.path, folder) for output in sorted(stage.outputs, key=lambda output: output.path)]
    return entry


def _value(node: Mapping[str, Any], dotted: str) -> Any:
    for part in dotted.split("."):
        node = node[part]
    return node


_HASHES: dict[Path, dict[str, Any]] = {}


def _hashed(name: str, folder: Path) -> dict[str, Any]:
    path = folder / name
    if path not in _HASHES:
        _HASHES[path] = _hash_of(path, folder)
    return {"path": name, "hash": "md5", **_HASHES[path]}


def _hash_of(path: Path, folder: Path) -> dict[str, Any]:
    if path.is_file():
        content = path.read_bytes()
        return {"md5": _cached(content, folder), "size": len(content)}
    listed, size = [], 0
    for file in (file for file in path.rglob("*") if file.is_file()):
        content = file.read_bytes()
        size += len(content)
        listed.append({"md5": _cached(content, folder), "relpath": file.relative_to(path).as_posix()})
    text = json.dumps(sorted(listed, key=lambda item: item["relpath"].split("/")), sort_keys=True)
    return {"md5": _cached(text.encode(), folder, ".dir"), "size": size, "nfiles": len(listed)}


def _cached(content: bytes, folder: Path, ending: str = "") -> str:
    """The hash of it, which is where DVC's cache has it from then on."""
    digest = hashlib.md5(content, usedforsecurity=False).hexdigest() + ending
    path = folder / ".dvc" / "cache" / "files" / "md5" / digest[:2] / digest[2:]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    path.chmod(0o444)
    return digest


def measure(command: list[str], folder: Path) -> tuple[float, float, str]:
    """(CPU s, wall s, last line of what it printed)."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {**os.environ, "SCENEEXPANDER_ROOT": str(folder)}
    ran = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, wall, (ran.stdout.strip().splitlines() or [""])[-1]


def main() -> None:
    """Make the project and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--files", type=int, default=8)
    arguments = parser.parse_args()
    folder = arguments.folder.absolute()
    make_project(folder, arguments.scenes, arguments.files)
    lines = (folder / "dvc.lock").read_text().count("\n")
    print(f"{arguments.scenes} scenes, {len(read_pipeline(folder))} stages, {lines} lines of dvc.lock")
    for label, command in (
        ("python (floor)", [sys.executable, "-c", ""]),
        ("dvc version (floor)", ["dvc", "version"]),
        ("dvc status, first", ["dvc", "status"]),
        ("dvc status", ["dvc", "status"]),
        ("status, first", [sys.executable, "-m", "sceneexpander", "status"]),
        ("status", [sys.executable, "-m", "sceneexpander", "status"]),
        ("repro of nothing", [sys.executable, "-m", "sceneexpander.pipeline.repro", "report"]),
    ):
        cpu, wall, last = measure(command, folder)
        print(f"{label:22} {cpu:7.1f} CPU s {wall:7.1f} s   {last[:100]}")


if __name__ == "__main__":
    main()
