"""One round of expansion, put together from the rooms below: state in, state out."""

from sceneexpander.expansion.rounds import RoundInputs, adapt_round, correct_round, judge_round, refined_round
from sceneexpander.reconstruction.cameras import report_cameras, straighten_views
from sceneexpander.reconstruction.initial import initial_state
from sceneexpander.reconstruction.loaded import LoadedModel, ModelConfig, PriorsUse, load_model
from sceneexpander.reconstruction.refining import refined
from sceneexpander.reconstruction.views import captured_prediction, joint_reconstruction

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
