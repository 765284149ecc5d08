from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.pipeline.fingerprint import FingerprintError, SourceTree

FILES = {
    "pkg/__init__.py": "",
    "pkg/a.py": "from pkg import b\n\ndef f():\n    return b.g()\n",
    "pkg/b.py": "def g():\n    from .room.c import VALUE\n    return VALUE\n",
    "pkg/room/__init__.py": "",
    "pkg/room/c.py": "VALUE = 1\n",
    "pkg/room/weights/w.bin": "bytes",
    "pkg/room/native/__init__.py": "",
    "pkg/room/native/kernel.cpp": "int f();",
    "pkg/unused.py": "import os\n",
    "pkg/other/__init__.py": "",
    "pkg/other/data.txt": "x",
}


@pytest.fixture
def tree(tmp_path: Path) -> SourceTree:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return SourceTree(packages={"pkg": tmp_path / "pkg"})


def edit(tree: SourceTree, name: str, text: str) -> None:
    (tree.packages["pkg"].parent / name).write_text(text)


def test_closure_follows_function_level_and_relative_imports(tree: SourceTree) -> None:
    assert tree.closure("pkg.a") == ["pkg", "pkg.a", "pkg.b", "pkg.room", "pkg.room.c"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pkg/room/c.py", '"""A docstring."""\n\n# a comment\nVALUE = (\n    1\n)\n'),
        ("pkg/b.py", 'def g():\n    """What g does."""\n    from .room.c import VALUE  # why\n\n    return VALUE\n'),
        ("pkg/unused.py", "import sys\n"),
        ("pkg/other/data.txt", "y"),
        ("pkg/room/weights/CARD.md", "text about what counts"),
    ],
)
def test_what_means_the_same_or_is_not_used_changes_nothing(tree: SourceTree, name: str, text: str) -> None:
    before = tree.fingerprint("pkg.a")
    edit(tree, name, text)
    assert tree.fingerprint("pkg.a") == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pkg/room/c.py", "VALUE = 2\n"),
        ("pkg/__init__.py", "SWITCH = True\n"),
        ("pkg/room/weights/w.bin", "other"),
        ("pkg/room/weights/more.bin", "new"),
        ("pkg/room/native/kernel.cpp", "int g();"),
    ],
)
def test_what_is_used_counts_down_to_data_files(tree: SourceTree, name: str, text: str) -> None:
    before = tree.fingerprint("pkg.a")
    edit(tree, name, text)
    assert tree.fingerprint("pkg.a") != before


def test_a_computed_import_must_be_declared(tree: SourceTree) -> None:
    dynamic = "import importlib\n\ndef load(name):\n    return importlib.import_module(name)\n"
    edit(tree, "pkg/b.py", dynamic)
    with pytest.raises(FingerprintError, match=r"b\.py:4.*DYNAMIC_IMPORTS"):
        tree.fingerprint("pkg.a")
    edit(tree, "pkg/b.py", 'DYNAMIC_IMPORTS = ("pkg.room.c",)\n' + dynamic)
    assert "pkg.room.c" in tree.closure("pkg.a")


def test_the_projects_own_stages_have_a_closure() -> None:
    root = Path(__file__).parents[3]
    ours = SourceTree(packages={"sceneexpander": root / "src" / "sceneexpander", "stages": root / "stages"})
    adapt, prepare = ours.closure("stages.adapt"), ours.closure("stages.prepare")
    assert {"sceneexpander.adaptation.loop", "sceneexpander.models.registry", "stages.runner"} <= set(adapt)
    # An edit of the adaptation must not prepare every scene again, nor one of the report adapt again.
    assert not any(name.startswith(("sceneexpander.adaptation", "sceneexpander.models")) for name in prepare)
    assert not any(name.startswith(("sceneexpander.report", "sceneexpander.tracking")) for name in adapt)


def test_the_rasterisers_source_and_flags_are_code_of_all_that_render(tmp_path: Path) -> None:
    root = Path(__file__).parents[3]
    shutil.copytree(root / "src" / "sceneexpander", tmp_path / "sceneexpander", ignore=shutil.ignore_patterns("*.so"))
    ours = SourceTree(packages={"sceneexpander": tmp_path / "sceneexpander", "stages": root / "stages"})
    stages = (
        "prepare",
        "reconstruct",
        "precompute_anchors",
        "adapt",
        "gaussian_splatting",
        "optimise",
        "render",
        "pack",
        "evaluate",
    )
    for edited in ("rasteriser.cpp", "recipe.py"):
        before = {stage: ours.fingerprint(f"stages.{stage}") for stage in stages}
        source = tmp_path / "sceneexpander" / "splatting" / "kernel" / edited
        source.write_text(source.read_text().replace("1e-4f", "2e-4f").replace('"-O3"', '"-O2"'))
        changed = {stage for stage in stages if ours.fingerprint(f"stages.{stage}") != before[stage]}
        assert changed == set(stages) - {"prepare"}


def test_an_edit_of_the_adaptation_reruns_no_reconstructor() -> None:
    root = Path(__file__).parents[3]
    ours = SourceTree(packages={"sceneexpander": root / "src" / "sceneexpander", "stages": root / "stages"})

    def adaptation(stage: str) -> set[str]:
        room = "sceneexpander.adaptation"
        return {
            name.removeprefix(f"{room}.") for name in ours.closure(f"stages.{stage}") if name.startswith(f"{room}.")
        }

    assert adaptation("reconstruct") == set()
    assert adaptation("precompute_anchors") == set()
    assert adaptation("reconstruct_inserted") == set()
    assert adaptation("rival") == set()
    assert "loop" in adaptation("adapt")


@pytest.mark.parametrize("stage", ["prepare", "generate_view", "reconstruct_inserted", "evaluate", "track"])
def test_what_a_stage_imports_is_in_its_closure(stage: str) -> None:
    root = Path(__file__).parents[3]
    ours = SourceTree(packages={"sceneexpander": root / "src" / "sceneexpander", "stages": root / "stages"})
    program = f"import stages.{stage}, sys; print(*(n for n in sys.modules if n.split('.')[0] in ('sceneexpander', 'stages')))"
    done = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= set(ours.closure(f"stages.{stage}"))
