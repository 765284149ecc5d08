"""The embedded reconstructor: residuals on the geometric front-end."""

from sceneexpander.models.mini.config import MiniConfig
from sceneexpander.models.mini.model import Mini

__all__ = ["Mini", "MiniConfig"]
