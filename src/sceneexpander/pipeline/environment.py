"""What beside code and input decides the bits of a result: the installed packages, the rasteriser's build, the number of threads."""

from __future__ import annotations

import hashlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.pipeline.fingerprint import SourceTree
from sceneexpander.pipeline.packages import installed_packages

_RENDERER = "sceneexpander.splatting.kernel_backend"


@dataclass(frozen=True, slots=True, kw_only=True)
class Environment:
    """What results of this machine belong to."""

    packages: str  # hash of the locked packages as they are installed, and of Python's version
    kernel: str  # build of the compiled rasteriser, or "torch"

    def identify(self, tree: SourceTree, module: str) -> str:
        """Hash of a module's code together with the environment that it runs in; the rasteriser's build counts for those that draw."""
        modules = tree.closure(module)
        parts = [tree.fingerprint_of(modules), self.packages]
        if _RENDERER in modules:
            parts.append(self.kernel)
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def find_environment(project: Path) -> Environment:
    """The environment of this process. Raises `UserError` if it is not the locked one, or the rasteriser is of another source."""
    from sceneexpander.splatting.kernel_backend import kernel_build

    python = ".".join(str(part) for part in sys.version_info[:2])
    text = "\n".join([f"python {python}", *installed_packages(project)])
    return Environment(packages=hashlib.sha256(text.encode()).hexdigest(), kernel=kernel_build())


def usable_cpus() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
