"""What code a program really consists of, as one hash that comments, docstrings and layout do not change.

The hash of an entry file covers the syntax trees of every first-party module it can import (transitively, function-level imports
included) and the bytes of the data files that lie beside them: shipped weights, page templates, kernel sources. Texts about them do not
count.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

_IGNORED_SUFFIXES = frozenset({".py", ".pyc", ".pyi", ".so", ".typed", ".md"})
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


class FingerprintError(ValueError):
    """A module imports others in a way that cannot be read from its text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceTree:
    """Where first-party packages live, e.g. ``{"sceneexpander": src/sceneexpander, "stages": stages}``."""

    packages: dict[str, Path]

    def file_of(self, module: str) -> Path | None:
        """The file of a dotted module name, or None if it is not one of ours (or a folder without ``__init__.py``)."""
        top, *rest = module.split(".")
        if top not in self.packages:
            return None
        base = self.packages[top].joinpath(*rest)
        for path in (base.with_suffix(".py") if rest else None, base / "__init__.py"):
            if path is not None and path.is_file():
                return path
        return None

    def is_package(self, module: str) -> bool:
        """Whether the dotted name is a folder of ours."""
        top, *rest = module.split(".")
        return top in self.packages and self.packages[top].joinpath(*rest).is_dir()

    def closure(self, module: str) -> list[str]:
        """All first-party modules that ``module`` imports, itself included, sorted.

        Importing ``a.b.c`` also runs ``a`` and ``a.b``. Raises `FingerprintError` for an import that only running would reveal.
        """
        found: set[str] = set()
        todo = [module]
        while todo:
            name = todo.pop()
            parts = name.split(".")
            for ancestor in (".".join(parts[:n]) for n in range(1, len(parts) + 1)):
                path = self.file_of(ancestor)
                if path is not None and ancestor not in found:
                    found.add(ancestor)
                    todo.extend(self._imports(ancestor, path))
        return sorted(found)

    def fingerprint(self, module: str) -> str:
        """Hex digest of the closure's syntax trees and of the data files beside them."""
        return self.fingerprint_of(self.closure(module))

    def fingerprint_of(self, modules: Sequence[str]) -> str:
        """The same of a closure that is known."""
        digest = hashlib.sha256()
        folders: set[Path] = set()
        for name in modules:
            path = self.file_of(name)
            assert path is not None  # noqa: S101 - closure holds only modules with a file
            digest.update(f"{name}\n{meaning(path)}\n".encode())
            if path.parent not in self.packages.values() or path.name != "__init__.py":
                folders.add(path.parent)
        roots = set(self.packages.values())
        for asset in sorted({asset for folder in folders for asset in _assets(folder, whole=folder not in roots)}):
            digest.update(f"{self._label(asset)}\n".encode())
            digest.update(hashlib.sha256(asset.read_bytes()).digest())
        return digest.hexdigest()

    def _label(self, path: Path) -> str:
        for name, folder in self.packages.items():
            if path.is_relative_to(folder):
                return f"{name}/{path.relative_to(folder).as_posix()}"
        raise FingerprintError(f"{path} is outside the source tree")

    def _imports(self, module: str, path: Path) -> Iterator[str]:
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        source = _source_of(path)
        yield from source.declared or ()
        for statement in source.imports:
            if isinstance(statement, ast.Import):
                yield from (alias.name for alias in statement.names)
            else:
                base = _absolute(statement, package)
                for alias in statement.names:
                    # ``from a import b``: b is a submodule or a name inside a.
                    submodule = f"{base}.{alias.name}"
                    yield submodule if self.file_of(submodule) or self.is_package(submodule) else base
        for line, name in source.calls:
            if name is not None:
                yield name
            elif source.declared is None:
                raise FingerprintError(
                    f"{path}:{line}: imports by a computed name; list the modules in DYNAMIC_IMPORTS"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """What one file says: how it imports, and the rest as a hash."""

    declared: Sequence[str] | None  # its DYNAMIC_IMPORTS
    imports: Sequence[ast.Import | ast.ImportFrom]
    calls: Sequence[tuple[int, str | None]]  # of ``import_module``: the line, the name if it is written there
    meaning: str


def meaning(path: Path) -> str:
    """Hash of the syntax tree of a Python file without docstrings, comments and positions."""
    return _source_of(path).meaning


def _source_of(path: Path) -> _Source:
    return _read(path.read_text(encoding="utf-8"), str(path))


# Stages share most of their modules.
@functools.lru_cache(maxsize=2048)
def _read(text: str, name: str) -> _Source:
    tree = ast.parse(text, filename=name)
    imports: list[ast.Import | ast.ImportFrom] = []
    calls: list[tuple[int, str | None]] = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            imports.append(node)
        elif isinstance(node, ast.Call) and _is_import_module(node.func):
            target = node.args[0] if node.args else None
            written = target.value if isinstance(target, ast.Constant) else None
            calls.append((node.lineno, written if isinstance(written, str) else None))
        elif isinstance(node, _DOCUMENTED) and node.body and _is_docstring(node.body[0]):
            node.body = node.body[1:] or [ast.Pass()]
    return _Source(
        declared=_declared_imports(tree),
        imports=imports,
        calls=calls,
        meaning=hashlib.sha256(ast.dump(tree).encode()).hexdigest(),
    )


def _is_docstring(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _absolute(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    parts = package.split(".")
    base = parts[: len(parts) - node.level + 1]
    return ".".join([*base, node.module] if node.module else base)


def _is_import_module(function: ast.expr) -> bool:
    if isinstance(function, ast.Name):
        return function.id in {"import_module", "__import__"}
    return isinstance(function, ast.Attribute) and function.attr == "import_module"


def _declared_imports(tree: ast.Module) -> Sequence[str] | None:
    """The module-level ``DYNAMIC_IMPORTS = ("a.b", ...)``, if there is one."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "DYNAMIC_IMPORTS" for target in statement.targets
        ):
            return [str(item) for item in ast.literal_eval(statement.value)]
    return None


def _assets(folder: Path, *, whole: bool) -> Iterator[Path]:
    """Data files of a package folder and of its sub-folders.

    Sub-folders that hold Python are packages of their own. With ``whole`` their data counts all the same, imported or not: what lies in
    a room may be read by any of its modules.
    """
    for path in sorted(folder.iterdir()):
        if path.name.startswith((".", "__pycache__")):
            continue
        if path.is_file() and path.suffix not in _IGNORED_SUFFIXES:
            yield path
        elif path.is_dir() and (whole or not any(path.rglob("*.py"))):
            yield from _assets(path, whole=whole)
