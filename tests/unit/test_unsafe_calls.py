"""Nothing that is read becomes a program: no pickle, no evaluated text, no shell, no loader that makes objects."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from sceneexpander.config import files

PROJECT = Path(__file__).parents[2]
FILES = sorted(
    path for folder in ("src", "stages", "scripts", "benchmarks", "docs") for path in (PROJECT / folder).rglob("*.py")
) + [PROJECT / "setup.py"]

MODULES = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal", "jsonpickle"}
BUILTINS = {"eval", "exec", "compile", "__import__"}
SHELLS = {
    "os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput", "asyncio.create_subprocess_shell", "pty.spawn",
}  # fmt: skip
YAML = {f"yaml.{name}" for name in ("load", "load_all", "full_load", "full_load_all", "unsafe_load", "unsafe_load_all")}
# The reader of checkpoints has an unpickler of its own, that knows a closed list of names; the other names an error.
ALLOWED = {
    "src/sceneexpander/convert_checkpoint.py": {"import pickle"},
    "src/sceneexpander/evaluation/visual.py": {"import pickle.UnpicklingError"},
    "src/sceneexpander/config/files.py": {"yaml.load"},  # with a safe loader, see below
    "src/sceneexpander/cli/completion.py": {"shtab.complete(shell)"},  # the name of the shell that completes words
}


def dotted(node: ast.expr) -> str:
    """``a.b.c`` of an expression that is one, else nothing."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        base = dotted(node.value)
        return f"{base}.{node.attr}" if base else ""
    return ""


def unsafe_parts(source: str) -> Iterator[str]:
    """What a file does that could run what it reads."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (f"import {alias.name}" for alias in node.names if alias.name.split(".")[0] in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (f"import {name}" for name in names if name.split(".")[0] in MODULES or name in SHELLS | YAML)
        elif isinstance(node, ast.Call):
            yield from unsafe_call(node)


def unsafe_call(call: ast.Call) -> Iterator[str]:
    name = dotted(call.func).removeprefix("builtins.")
    if name in BUILTINS | SHELLS | YAML or name.startswith(("os.spawn", "os.exec")):
        yield name
    given = {keyword.arg: keyword.value for keyword in call.keywords}
    for option, harmless in (("shell", False), ("allow_pickle", False), ("weights_only", True)):
        value = given.get(option)
        if value is not None and not (isinstance(value, ast.Constant) and value.value is harmless):
            yield f"{name}({option})"
    if name == "torch.load" and "weights_only" not in given:
        yield "torch.load without weights_only"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PROJECT).as_posix())
def test_no_file_runs_what_it_reads(path: Path) -> None:
    found = set(unsafe_parts(path.read_text(encoding="utf-8")))
    assert found <= ALLOWED.get(path.relative_to(PROJECT).as_posix(), set())


def test_no_reader_of_captures_starts_a_program() -> None:
    for path in (PROJECT / "src" / "sceneexpander" / "ingest").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            assert not isinstance(node, ast.Import) or "subprocess" not in [alias.name for alias in node.names], path
            assert not isinstance(node, ast.ImportFrom) or node.module != "subprocess", path


def test_the_exceptions_are_all_used() -> None:
    for name, parts in ALLOWED.items():
        assert set(unsafe_parts((PROJECT / name).read_text(encoding="utf-8"))) == parts


def test_the_loader_of_the_configuration_makes_plain_values_only() -> None:
    assert issubclass(files._UniqueKeyLoader, yaml.SafeLoader)
    with pytest.raises(yaml.YAMLError):
        yaml.load("!!python/object/apply:os.getcwd []", files._UniqueKeyLoader)  # noqa: S506


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import dill as d",
        "eval(text)",
        "import builtins\nbuiltins.exec(text)",
        "os.system(line)",
        "from os import system",
        "subprocess.run(line, shell=True)",
        "subprocess.run(line, shell=wanted)",
        "yaml.load(text, Loader=yaml.Loader)",
        "yaml.unsafe_load(text)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
    ],
)
def test_the_walk_sees_what_is_unsafe(source: str) -> None:
    assert list(unsafe_parts(source))


def test_the_walk_lets_the_safe_forms_pass() -> None:
    safe = "network.eval()\nyaml.safe_load(t)\ntorch.load(p, weights_only=True)\nnp.load(p, allow_pickle=False)\nre.compile(t)"
    assert not list(unsafe_parts(safe))
