"""Build of the compiled CPU rasteriser, optional by design: without a working compiler the install succeeds without it.

Everything else about the package is in ``pyproject.toml``; how the rasteriser is compiled is in ``recipe.py`` beside its source.
"""

from __future__ import annotations

import runpy
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

KERNEL = Path("src/sceneexpander/splatting/kernel")
RECIPE = runpy.run_path(str(Path(__file__).parent / KERNEL / "recipe.py"))  # the package may not be importable yet


class OptionalKernel(build_ext):
    """Compiles the plain C libraries; a failure is reported and passed over."""

    def finalize_options(self) -> None:
        """Always compile: a library is told from a newer one by the hash in it, not by the time of its file."""
        super().finalize_options()
        self.force = True

    def build_extension(self, ext: Extension) -> None:
        # Every build compiles the same file: separate scratch folders keep their objects apart.
        build_temp = self.build_temp
        self.build_temp = str(Path(build_temp) / ext.name)
        try:
            super().build_extension(ext)
        except Exception as error:  # noqa: BLE001 - whatever a foreign tool chain throws, the install must go on
            Path(self.get_ext_fullpath(ext.name)).unlink(missing_ok=True)  # of an earlier build: it would be refused
            self.warn(f"compiled rasteriser not built, the slower torch rasteriser will be used: {error}")
        finally:
            self.build_temp = build_temp

    def copy_extensions_to_source(self) -> None:
        for ext in self.extensions:
            (KERNEL / Path(self.get_ext_filename(ext.name)).name).unlink(missing_ok=True)
        super().copy_extensions_to_source()


setup(
    ext_modules=[
        Extension(
            f"sceneexpander.splatting.kernel._rasteriser_{build}",
            sources=[str(KERNEL / "rasteriser.cpp")],
            define_macros=[(RECIPE["HASH_MACRO"], f'"{RECIPE["source_hash"](build)}"')],
            extra_compile_args=[*RECIPE["FLAGS"], *RECIPE["LEVELS"][build]],
            extra_link_args=["-pthread"],
            language="c++",
            optional=True,
        )
        for build in RECIPE["builds"]()
    ],
    cmdclass={"build_ext": OptionalKernel},
)
