"""Procedural 3D scenes with exact truth: pictures, depth, normals, cameras and object ids of made-up worlds.

`make_views` gives ready samples; `build_world` and `render_world` are the lower level, for hand-designed worlds
(`WorldBuilder`). World frame of the builders: metres, z up. Samples are in the first view's camera frame.
"""

from sceneexpander.synthetic.degrade import auto_exposure, degrade, encode_radiance
from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.misalign import MisalignedView, Misalignment, misalign
from sceneexpander.synthetic.render import RenderedViews, render_world
from sceneexpander.synthetic.scenes import KINDS, build_world
from sceneexpander.synthetic.textures import TextureKey
from sceneexpander.synthetic.trajectories import CameraSet, choose_cameras
from sceneexpander.synthetic.views import SyntheticViews, make_views
from sceneexpander.synthetic.world import Light, Material, Sky, World, WorldBuilder

__all__ = [
    "KINDS",
    "CameraSet",
    "Light",
    "Material",
    "MisalignedView",
    "Misalignment",
    "RenderedViews",
    "Shape",
    "Sky",
    "SyntheticViews",
    "TextureKey",
    "World",
    "WorldBuilder",
    "auto_exposure",
    "build_world",
    "choose_cameras",
    "degrade",
    "encode_radiance",
    "make_views",
    "misalign",
    "render_world",
]
