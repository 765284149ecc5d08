"""How `rasteriser.cpp` is compiled, and the hash that a library carries of it.

``setup.py`` and the pipeline run this file by its path, without the package around it: it imports nothing of ours.
"""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

SOURCE = Path(__file__).with_name("rasteriser.cpp")
HASH_MACRO = "SX_SOURCE_HASH"
# No -ffinite-math-only (NaN must fail comparisons) and no -fassociative-math (exp2 rounds by adding a magic number).
FLAGS = ["-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fvisibility=hidden"]
# What is vectorised is written as vectors; packing unrelated scalars of the projection into some costs 6 % (g++ 12).
FLAGS += ["-fno-tree-slp-vectorize", "-Wno-psabi", "-pthread"]
LEVELS = {
    "v3": ["-march=x86-64-v3"],
    "v4": ["-march=x86-64-v4", "-mprefer-vector-width=512"],
    "plain": [],
}


def builds() -> tuple[str, ...]:
    """Libraries for this machine: two x86-64 levels, of which one is chosen when the library is loaded; elsewhere a plain build."""
    return ("v3", "v4") if platform.machine().lower() in {"x86_64", "amd64"} else ("plain",)


def source_hash(build: str) -> str:
    """Of all that a build is made from: the source and the compiler's flags."""
    digest = hashlib.sha256(SOURCE.read_bytes())
    digest.update("\n".join([*FLAGS, *LEVELS[build]]).encode())
    return digest.hexdigest()
