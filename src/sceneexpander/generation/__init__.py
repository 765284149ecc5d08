"""From a sentence to the picture beyond the captured boundary."""

from sceneexpander.generation.backends import BACKENDS, backend_of, make_generator
from sceneexpander.generation.choose import ChosenView, check_round, choose_view
from sceneexpander.generation.config import ChoiceConfig, GeneratorConfig
from sceneexpander.generation.prompt import EXPLORATION, PromptTemplate, fill_prompt, split_words
from sceneexpander.generation.protocol import Backend, Forecast, GenerationContext, SceneSoFar, ViewGenerator

__all__ = [
    "BACKENDS",
    "EXPLORATION",
    "Backend",
    "ChoiceConfig",
    "ChosenView",
    "Forecast",
    "GenerationContext",
    "GeneratorConfig",
    "PromptTemplate",
    "SceneSoFar",
    "ViewGenerator",
    "backend_of",
    "check_round",
    "choose_view",
    "fill_prompt",
    "make_generator",
    "split_words",
]
