"""gaussian_splatting: per-scene 3DGS on all views, started from the cameras and Gaussians of the unadapted backbone."""

from __future__ import annotations

from stages.optimise import Sections, optimise_start
from stages.runner import Cell, left_out, stage

__all__ = ["Sections", "main"]


@stage("scene", "round", "previous", "method")
def main(cell: Cell) -> None:
    """The same optimisation as after the fact, as a baseline of its own."""
    if not left_out(cell):
        optimise_start(cell, stage_name="gaussian_splatting")


if __name__ == "__main__":
    main()
