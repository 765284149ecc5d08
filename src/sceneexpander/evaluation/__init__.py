"""Exact image metrics, preservation and insertion scores, errors against known truth, comparison tables."""

from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.table import COLUMNS, Column, Table, comparison_table, scene_table

__all__ = ["COLUMNS", "Column", "EvaluateConfig", "Table", "comparison_table", "scene_table"]
