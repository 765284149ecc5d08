"""Reconstructions as videos and pictures."""

from sceneexpander.rendering.config import EyeKey, RenderConfig, ViewKey

__all__ = ["EyeKey", "RenderConfig", "ViewKey"]
