"""What stages that draw ask of the machine. Apart from `stages.runner`: others do not depend on the rasteriser."""

from __future__ import annotations

from sceneexpander.artifacts.store import read_json
from sceneexpander.errors import UserError
from sceneexpander.splatting.kernel_backend import kernel_build
from stages import layout
from stages.runner import use_threads


def use_machine(threads: int) -> None:
    """Work with exactly ``threads`` threads, and with the rasteriser's build that the hashes of the code belong to.

    Raises:
        UserError: another build draws here, or the one that is there was built from another source.
    """
    use_threads(threads)
    expected, here = read_json(layout.ENVIRONMENT)["kernel"], kernel_build()
    if here != expected:
        raise UserError(
            f"names the rasteriser's build {expected!r}, but {here!r} draws here, with other bits",
            where=layout.ENVIRONMENT,
            fix="delete that file: all that draws runs again",
        )
