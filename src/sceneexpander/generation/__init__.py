"""From a sentence to the picture beyond the captured boundary."""

from sceneexpander.generation.backends import BACKENDS, make_generator
from sceneexpander.generation.config import GeneratorConfig
from sceneexpander.generation.insert import generate_inserted_view
from sceneexpander.generation.prompt import EXPLORATION, PromptTemplate, fill_prompt
from sceneexpander.generation.protocol import Candidate, GenerationContext, ViewGenerator

__all__ = [
    "BACKENDS",
    "EXPLORATION",
    "Candidate",
    "GenerationContext",
    "GeneratorConfig",
    "PromptTemplate",
    "ViewGenerator",
    "fill_prompt",
    "generate_inserted_view",
    "make_generator",
]
