"""WorldMirror (HunyuanWorld-Mirror v1): a feed-forward reconstructor with optional camera, depth and intrinsics priors."""

from sceneexpander.models.worldmirror.config import WorldMirrorConfig
from sceneexpander.models.worldmirror.model import WorldMirror

__all__ = ["WorldMirror", "WorldMirrorConfig"]
