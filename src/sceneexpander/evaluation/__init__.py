"""Exact image metrics, preservation and insertion scores, errors against known truth, comparison tables."""

from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import Navigation, evaluate
from sceneexpander.evaluation.image import psnr, ssim, ssim_map
from sceneexpander.evaluation.table import COLUMNS, Column, Table, comparison_table, scene_table
from sceneexpander.evaluation.truth import SceneTruth, ViewTruth, against_truth, check_truth, load_truth
from sceneexpander.evaluation.views import insertion_fidelity, navigation_coverage, preservation, same_place

__all__ = [
    "COLUMNS",
    "Column",
    "EvaluateConfig",
    "Navigation",
    "SceneTruth",
    "Table",
    "ViewTruth",
    "against_truth",
    "check_truth",
    "comparison_table",
    "evaluate",
    "insertion_fidelity",
    "load_truth",
    "navigation_coverage",
    "preservation",
    "psnr",
    "same_place",
    "scene_table",
    "ssim",
    "ssim_map",
]
