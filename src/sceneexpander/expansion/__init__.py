"""One round of expansion, put together from the rooms below: state in, state out."""

from sceneexpander.expansion.procedure import Adapted, Expanded, MethodConfig, Procedure, Watch, compose_procedure
from sceneexpander.insertion.acceptance import judge_round
from sceneexpander.insertion.config import CorrectionsConfig
from sceneexpander.insertion.protocol import RoundInputs
from sceneexpander.reconstruction.cameras import report_cameras, straighten_views
from sceneexpander.reconstruction.initial import initial_state
from sceneexpander.reconstruction.loaded import LoadedModel, ModelConfig, PriorsUse, load_model
from sceneexpander.reconstruction.views import captured_prediction, joint_reconstruction

__all__ = [
    "Adapted",
    "CorrectionsConfig",
    "Expanded",
    "LoadedModel",
    "MethodConfig",
    "ModelConfig",
    "PriorsUse",
    "Procedure",
    "RoundInputs",
    "Watch",
    "captured_prediction",
    "compose_procedure",
    "initial_state",
    "joint_reconstruction",
    "judge_round",
    "load_model",
    "report_cameras",
    "straighten_views",
]
