"""Reconstructions as videos and pictures."""

from sceneexpander.rendering.config import EyeKey, RenderConfig, ViewKey
from sceneexpander.rendering.produce import produce_renders
from sceneexpander.rendering.tour import plan_tour

__all__ = ["EyeKey", "RenderConfig", "ViewKey", "plan_tour", "produce_renders"]
