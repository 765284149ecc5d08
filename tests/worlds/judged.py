"""A judge on this machine, and pictures to be judged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.judge.ask import Judge, make_judge
from sceneexpander.judge.config import ChatJudgeConfig
from sceneexpander.judge.frames import Shown
from sceneexpander.judge.rounds import Work
from sceneexpander.services.pictures import SentPicture, encode_picture
from tests.support.loopback import Answer, Service, said

CONF = Path(__file__).parents[2] / "conf"
KEY = "sk-verysecret0123456789"
OF_CHAT = ("take", "attempts", "max_requests", "max_cost_usd", "price_usd", "timeout_s", "extra_body", "key_variable")


def settings(service: Service, **changes: Any) -> ChatJudgeConfig:
    """The shipped settings, with this machine's address; ``changes`` of the chat model or of the judge."""
    config = parse_dataclass(ProjectConfig, compose(CONF, ["judge=openai"])).judge
    assert isinstance(config, ChatJudgeConfig)
    given: dict[str, Any] = {"base_url": f"{service.address}/v1", "key_variable": "TEST_KEY", "timeout_s": 20.0}
    given |= {name: changes.pop(name) for name in OF_CHAT if name in changes}
    return replace(config, chat=replace(config.chat, **given), **changes)


def judge_of(service: Service, cache: Path, waits: list[float] | None = None, **changes: Any) -> Judge:
    """A judge with these settings that does not wait."""
    made = make_judge(settings(service, **changes), cache, sleep=([] if waits is None else waits).append)
    assert made is not None
    return made


def picture_of(seed: int) -> SentPicture:
    """Noise."""
    pixels = np.random.default_rng(seed).integers(0, 255, (16, 24, 3), dtype=np.uint8)
    return encode_picture(pixels, long_side_px=768)


def work_of(*methods: str) -> Work:
    """A round with three frames of each method."""
    shown = tuple(
        Shown(method=method, frames=(0, 4, 9), pictures=tuple(picture_of(10 * number + k) for k in range(3)))
        for number, method in enumerate(methods, start=1)
    )
    return Work(scene="hidden_place", round=1, target=picture_of(0), shown=shown)


def message(content: object, **facts: Any) -> Answer:
    """What a chat endpoint answers with this message."""
    text = content if isinstance(content, str) else json.dumps(content)
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop"}
    usage = {"prompt_tokens": 900, "completion_tokens": 30, "prompt_tokens_details": {"cached_tokens": 1}}
    return said(
        {"id": "x", "model": "seer-2026-01-01", "choices": [choice], "usage": usage, **facts}, x_request_id="r1"
    )


def scored(score: float, confidence: float = 0.8, reason: str = "because") -> Answer:
    """A well-formed score."""
    return message({"reason": reason, "score": score, "confidence": confidence})


def preferred(better: str) -> Answer:
    """A well-formed comparison."""
    return message({"reason": "because", "better": better, "confidence": 0.8})


def refusal() -> Answer:
    """A message that is a refusal."""
    choice = {"message": {"role": "assistant", "content": None, "refusal": "I cannot judge this."}}
    return said({"model": "seer", "choices": [choice]})
