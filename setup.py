"""Build of the compiled CPU rasteriser, optional by design: without a working compiler the install succeeds without it.

Everything else about the package is in ``pyproject.toml``.
"""

from __future__ import annotations

import platform
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

SOURCE = "src/sceneexpander/splatting/kernel/rasteriser.cpp"
# No -ffinite-math-only (NaN must fail comparisons) and no -fassociative-math (exp2 rounds by adding a magic number).
FLAGS = ["-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fvisibility=hidden"]
# What is vectorised is written as vectors; packing unrelated scalars of the projection into some costs 6 % (g++ 12).
FLAGS += ["-fno-tree-slp-vectorize", "-Wno-psabi", "-pthread"]


def architectures() -> dict[str, list[str]]:
    """Library suffix -> flags: two x86-64 levels, of which one is chosen when the library is loaded; elsewhere a plain build."""
    if platform.machine().lower() in {"x86_64", "amd64"}:
        return {"v3": ["-march=x86-64-v3"], "v4": ["-march=x86-64-v4", "-mprefer-vector-width=512"]}
    return {"plain": []}


class OptionalKernel(build_ext):
    """Compiles the plain C libraries; a failure is reported and passed over."""

    def build_extension(self, ext: Extension) -> None:
        # Every build compiles the same file: separate scratch folders keep their objects apart.
        build_temp = self.build_temp
        self.build_temp = str(Path(build_temp) / ext.name)
        try:
            super().build_extension(ext)
        except Exception as error:  # noqa: BLE001 - whatever a foreign tool chain throws, the install must go on
            self.warn(f"compiled rasteriser not built, the slower torch rasteriser will be used: {error}")
        finally:
            self.build_temp = build_temp


setup(
    ext_modules=[
        Extension(
            f"sceneexpander.splatting.kernel._rasteriser_{name}",
            sources=[SOURCE],
            extra_compile_args=[*FLAGS, *arch],
            extra_link_args=["-pthread"],
            language="c++",
            optional=True,
        )
        for name, arch in architectures().items()
    ],
    cmdclass={"build_ext": OptionalKernel},
)
