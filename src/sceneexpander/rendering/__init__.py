"""Reconstructions as videos and pictures."""

from sceneexpander.rendering.config import RenderConfig
from sceneexpander.rendering.produce import plan_tour, produce_renders

__all__ = ["RenderConfig", "plan_tour", "produce_renders"]
