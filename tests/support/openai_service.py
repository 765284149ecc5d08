"""The images endpoint's generator with a service on this machine in place of OpenAI's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.generation.backends.openai import OpenAIConfig, OpenAIService
from sceneexpander.generation.service import ServiceGenerator
from tests.support.loopback import Service

CONF = Path(__file__).parents[2] / "conf"
KEY = "sk-verysecret0123456789"


def settings(service: Service, **changes: Any) -> OpenAIConfig:
    config = parse_dataclass(ProjectConfig, compose(CONF, ["generator=openai"])).generator
    assert isinstance(config, OpenAIConfig)
    given = {"base_url": f"{service.address}/v1", "key_variable": "TEST_KEY", "timeout_s": 20.0, "price_usd": 0.04}
    return replace(config, **(given | changes))


def generator(service: Service, waits: list[float] | None = None, **changes: Any) -> ServiceGenerator:
    config = settings(service, **changes)
    return ServiceGenerator(config, OpenAIService(config), sleep=([] if waits is None else waits).append)
