"""The arrows between the rooms point one way."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "sceneexpander"

# What every room stands on: how user errors look, how commands read arguments, how users' files are opened and ours written, ranges of
# numbers, plain values into types.
# These import nothing but each other.
GROUND = {"commandline", "errors", "files", "plainfiles", "ranges", "typed", "yamlfile"}
# What each room may import besides itself and the ground floor.
ROOMS: dict[str, set[str]] = {
    "geometry": set(),
    "catalogue": set(),
    "artifacts": {"geometry"},
    "frontend": {"geometry"},
    "synthetic": {"geometry"},
    "splatting": {"geometry"},
    "models": {"geometry", "splatting"},
    "ingest": {"artifacts", "geometry"},
    "services": {"artifacts"},
    "judge": {"artifacts", "services"},
    "generation": {"artifacts", "frontend", "geometry", "ingest", "judge", "services", "splatting"},
    "training": {"frontend", "geometry", "models", "splatting", "synthetic"},
    "adaptation": {"artifacts", "geometry", "models", "splatting"},
    "optimisation": {"artifacts", "evaluation", "geometry", "splatting"},
    "photometric": {"artifacts", "geometry", "models", "optimisation", "splatting"},
    "inference": {"artifacts", "geometry", "models"},
    "planning": {"adaptation", "geometry", "models"},
    "reconstruction": {"artifacts", "frontend", "geometry", "inference", "models", "photometric"},
    "insertion": {"artifacts", "geometry", "models", "photometric", "reconstruction", "splatting"},
    "expansion": {"adaptation", "artifacts", "insertion", "photometric", "reconstruction"},
    "evaluation": {"artifacts", "catalogue", "frontend", "geometry", "splatting"},
    "expandbench": {
        "adaptation",
        "artifacts",
        "catalogue",
        "evaluation",
        "expansion",
        "frontend",
        "geometry",
        "ingest",
        "insertion",
        "photometric",
        "reconstruction",
        "splatting",
        "synthetic",
    },
    "study": {
        "artifacts",
        "catalogue",
        "evaluation",
        "geometry",
        "splatting",
        "viewer",
    },  # the last: which hosts are answered
    "exports": {"artifacts", "geometry", "splatting", "viewer"},  # the last: which Gaussians are seen most
    "rendering": {"artifacts", "evaluation", "exports", "geometry", "splatting"},
    "tracking": {"artifacts", "catalogue", "evaluation"},
    "viewer": {"artifacts", "catalogue", "geometry", "splatting"},
    "report": {"artifacts", "catalogue", "evaluation", "viewer"},
    "conformance": {"artifacts", "geometry", "models", "splatting"},  # a command: runs recorded cases
}
# What people type and what it stands on: these may import every room, and no room imports them.
ENTRIES = {"cli", "config", "pipeline"}
ENTRY_ONLY_LIBRARIES = {"dvc", "hydra", "omegaconf"}


def imports(path: Path) -> Iterator[str]:
    package = ("sceneexpander", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            yield module
            if module == "sceneexpander":
                yield from (f"{module}.{alias.name}" for alias in node.names)


def rooms_imported(path: Path) -> set[str]:
    ours = (name.split(".")[1] for name in imports(path) if name.startswith("sceneexpander."))
    return set(ours) - GROUND


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def test_every_room_is_listed() -> None:
    found = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert found == {*ROOMS, *ENTRIES}


def test_only_the_ground_floor_stands_outside_of_rooms() -> None:
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "__main__", *GROUND}


def test_the_rules_have_no_cycle() -> None:
    done: set[str] = set()
    while len(done) < len(ROOMS):
        ready = {room for room, allowed in ROOMS.items() if room not in done and allowed <= done}
        assert ready, f"these rooms import each other: {set(ROOMS) - done}"
        done |= ready


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_file_imports_upwards(path: Path) -> None:
    room = room_of(path)
    if room in ("cli", "pipeline"):
        assert room == "cli" or "cli" not in rooms_imported(path), "the commands stand on the pipeline"
        return
    allowed = set(ROOMS) if room == "config" else ROOMS[room]
    assert rooms_imported(path) - {room} <= allowed


@pytest.mark.parametrize("name", sorted(GROUND))
def test_the_ground_floor_stands_on_itself(name: str) -> None:
    assert not rooms_imported(PACKAGE / f"{name}.py")
    assert name != "errors" or not [item for item in imports(PACKAGE / "errors.py") if item.startswith("sceneexpander")]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_room_knows_the_pipeline(path: Path) -> None:
    libraries = {name.split(".")[0] for name in imports(path)}
    assert "stages" not in libraries
    if room_of(path) not in ENTRIES:
        assert not libraries & ENTRY_ONLY_LIBRARIES
        assert not rooms_imported(path) & ENTRIES
        assert "params.yaml" not in path.read_text(encoding="utf-8") or room_of(path) == "artifacts"


def test_the_walk_sees_imports_at_all() -> None:
    assert "geometry" in rooms_imported(PACKAGE / "artifacts" / "reconstruction.py")


TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize("path", sorted(TESTS.rglob("*.py")), ids=lambda path: path.relative_to(TESTS).as_posix())
def test_tests_share_worlds_and_support_but_do_not_import_each_other(path: Path) -> None:
    found = [name for name in imports_of_tests(path) if ".test_" in name or name.startswith("tests.pipeline")]
    assert not found, "what two tests need stands in tests/worlds or tests/support"


def imports_of_tests(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("tests"):
            yield node.module
