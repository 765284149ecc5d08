"""One round of expansion, put together from the rooms below: state in, state out."""

from sceneexpander.expansion.cameras import report_cameras, straighten_views
from sceneexpander.expansion.loaded import LoadedModel, ModelConfig, PriorsUse, load_model
from sceneexpander.expansion.rounds import (
    RoundInputs,
    adapt_round,
    captured_prediction,
    correct_round,
    initial_state,
    joint_reconstruction,
    judge_round,
    refined,
    refined_round,
)

__all__ = [
    "LoadedModel",
    "ModelConfig",
    "PriorsUse",
    "RoundInputs",
    "adapt_round",
    "captured_prediction",
    "correct_round",
    "initial_state",
    "joint_reconstruction",
    "judge_round",
    "load_model",
    "refined",
    "refined_round",
    "report_cameras",
    "straighten_views",
]
