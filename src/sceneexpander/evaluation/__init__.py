"""Exact image metrics, preservation and insertion scores, errors against known truth, comparison tables."""

from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.table import comparison_table, scene_table

__all__ = ["EvaluateConfig", "comparison_table", "scene_table"]
