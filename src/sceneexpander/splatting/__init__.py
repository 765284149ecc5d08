"""Gaussian splatting: rasterisers (compiled CPU kernel, torch, gsplat), PLY, video.

`render` is what everyone calls; `rasterise` is the tensor-level function below it.
"""

from sceneexpander.splatting.rasterise import RasterOutput, rasterise
from sceneexpander.splatting.render import Render, render, render_normals
from sceneexpander.splatting.settings import RasterSettings

__all__ = ["RasterOutput", "RasterSettings", "Render", "rasterise", "render", "render_normals"]
