"""The back-ends by name. A new one is a file here, its settings in ``conf/generator``, and a line in `BACKENDS`; nothing else knows it."""

from __future__ import annotations

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.generation.backends.comfyui import ComfyUIConfig, make_comfyui
from sceneexpander.generation.backends.diffusers import DiffusersConfig, make_diffusers
from sceneexpander.generation.backends.gemini import GeminiConfig, make_gemini
from sceneexpander.generation.backends.openai import OpenAIConfig, make_openai
from sceneexpander.generation.backends.reproject import ReprojectConfig, ReprojectGenerator
from sceneexpander.generation.backends.stored import FileConfig, FileGenerator, ReplayConfig, ReplayGenerator
from sceneexpander.generation.config import GeneratorConfig
from sceneexpander.generation.protocol import Backend, ViewGenerator

BACKENDS: dict[str, Backend] = {
    "replay": Backend(config=ReplayConfig, make=ReplayGenerator, takes_recorded=True),
    "file": Backend(config=FileConfig, make=FileGenerator),
    "reproject": Backend(config=ReprojectConfig, make=ReprojectGenerator),
    "openai": Backend(config=OpenAIConfig, make=make_openai),
    "gemini": Backend(config=GeminiConfig, make=make_gemini),
    "comfyui": Backend(config=ComfyUIConfig, make=make_comfyui),
    "diffusers": Backend(config=DiffusersConfig, make=make_diffusers),
}


def backend_of(config: GeneratorConfig) -> Backend:
    """The back-end that the settings name. Raises `UserError` for an unknown name."""
    if config.backend not in BACKENDS:
        problem = f"unknown back-end {config.backend!r}"
        raise UserError(problem, where="generator.backend", fix=did_you_mean(config.backend, BACKENDS))
    return BACKENDS[config.backend]


def make_generator(config: GeneratorConfig) -> ViewGenerator:
    """The generator with these settings. Raises `UserError` for an unknown name."""
    return backend_of(config).make(config)
