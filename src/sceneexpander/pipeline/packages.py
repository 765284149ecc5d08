"""The locked packages, and whether they are what is installed."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from pathlib import Path

from sceneexpander.errors import UserError

LOCKS = ("requirements.lock", "requirements-nodeps.lock")
_SHOWN = 3  # differences in one line


def installed_packages(project: Path) -> list[str]:
    """``name==version`` of every locked package as it is installed, e.g. ``torch==2.13.0+cpu``.

    The lock leaves out local versions: which of a version's builds is installed (CPU, CUDA) is the machine's choice.

    Raises:
        UserError: another version is installed, or none.
    """
    found, differing = [], []
    for name, version in _pins(project):
        installed = _installed(name)
        found.append(f"{name}=={installed}")
        if installed is None or (installed != version and installed.partition("+")[0] != version):
            differing.append(f"{name} is {installed or 'missing'}, locked is {version}")
    if differing:
        more = f" (and {len(differing) - _SHOWN} more)" if len(differing) > _SHOWN else ""
        raise UserError(
            f"does not match what is installed: {'; '.join(differing[:_SHOWN])}{more}",
            where=project / LOCKS[0],
            fix="make setup installs the locked versions; if the others are meant, write them into the lock",
        )
    return sorted(found)


def _pins(project: Path) -> Iterator[tuple[str, str]]:
    for lock in LOCKS:
        if (project / lock).is_file():
            for line in (project / lock).read_text(encoding="utf-8").splitlines():
                name, pinned, version = line.partition("#")[0].strip().partition("==")
                if pinned:
                    yield name, version


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
