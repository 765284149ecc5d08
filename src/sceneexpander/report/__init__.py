"""The pages to look at."""

from sceneexpander.report.collect import MethodSource, RoundSource, SceneSource, collect_scene
from sceneexpander.report.site import write_page

__all__ = ["MethodSource", "RoundSource", "SceneSource", "collect_scene", "write_page"]
