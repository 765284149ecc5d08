"""Gemini through Google's own client, against a service on this machine."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError
from sceneexpander.generation import GenerationContext, SceneSoFar
from sceneexpander.generation.backends.gemini import GeminiConfig, GeminiService, nearest_ratio
from sceneexpander.generation.service import ServiceGenerator
from tests.support.loopback import Answer, Service, drawn, said
from tests.worlds.rounds import context_of

CONF = Path(__file__).parents[3] / "conf"
KEY = "AIzaverysecret0123456789"


@pytest.fixture
def context(so_far: SceneSoFar, tmp_path: Path) -> GenerationContext:
    spec = RoundSpec(prompt="Move back, a bench.")
    return context_of(Scene(name="s", views=so_far.views, rounds=(spec,)), tmp_path / "scene")


def generator(service: Service, waits: list[float] | None = None, **changes: Any) -> ServiceGenerator:
    config = parse_dataclass(ProjectConfig, compose(CONF, ["generator=gemini"])).generator
    assert isinstance(config, GeminiConfig)
    given = {"base_url": service.address, "key_variable": "TEST_KEY", "timeout_s": 20.0, "candidates": 1}
    config = replace(config, **(given | changes))
    return ServiceGenerator(config, GeminiService(config), sleep=([] if waits is None else waits).append)


def answered(*parts: dict[str, Any], reason: str = "STOP", **facts: Any) -> Answer:
    return said({"candidates": [{"content": {"parts": list(parts)}, "finishReason": reason}], **facts})


def shown(seed: int) -> dict[str, Any]:
    return inline(drawn(seed))


def inline(data: bytes) -> dict[str, Any]:
    return {"inlineData": {"mimeType": "image/png", "data": base64.b64encode(data).decode()}}


def failed(status: int, message: str, name: str, details: object = ()) -> Answer:
    return said({"error": {"code": status, "message": message, "status": name, "details": details}}, status)


def test_what_is_sent_and_what_is_recorded(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    service.answers = [
        answered(
            {"text": "Here it is."},
            shown(1),
            modelVersion="gemini-x-001",
            responseId="r1",
            usageMetadata={"totalTokenCount": 9, "promptTokenCount": 4},
        )
    ]
    made = generator(service, resolution="2K", max_references=2).generate(context, so_far)
    assert made.candidates[0].data == drawn(1)
    (asked,) = service.asked
    assert asked.path.endswith("models/gemini-3.1-flash-image:generateContent")
    body = json.loads(asked.body)
    words, *views = body["contents"][0]["parts"]
    assert words["text"].endswith("following the requirements: Move back, a bench.")
    assert len(views) == 2
    assert base64.b64decode(views[0]["inlineData"]["data"]).startswith(b"\x89PNG")
    assert body["generationConfig"]["imageConfig"] == {"aspectRatio": "3:2", "imageSize": "2K"}
    provenance = made.candidates[0].provenance
    assert (provenance.source, provenance.request_id) == ("gemini-x-001", "r1")
    assert provenance.usage == {"total_token_count": 9, "prompt_token_count": 4}
    generator(service, resolution="2K", max_references=2).generate(context, so_far)
    assert len(service.asked) == 1


@pytest.mark.parametrize(
    ("answer", "said_words", "requests"),
    [
        (answered(reason="IMAGE_SAFETY"), "the picture was refused (IMAGE_SAFETY)", 1),
        (answered({"text": "I cannot."}, reason="PROHIBITED_CONTENT"), "refused (PROHIBITED_CONTENT)", 1),
        (said({"promptFeedback": {"blockReason": "OTHER"}}), "the words or views were refused (OTHER)", 1),
        (answered({"text": "I would rather talk."}), "words and no picture: I would rather talk.", 1),
        (answered(reason="NO_IMAGE"), "answered without a picture (NO_IMAGE)", 2),
        (said({}), "answered without a picture", 2),
        (failed(400, f"API key not valid: {KEY}", "INVALID_ARGUMENT", [{"reason": "API_KEY_INVALID"}]), "check the key in TEST_KEY", 1),
        (failed(404, "models/x is not found", "NOT_FOUND"), "set generator.model", 1),
        (failed(403, "denied", "PERMISSION_DENIED"), "may not use this model", 1),
        (failed(503, "overloaded", "UNAVAILABLE"), "overloaded", 2),
        (failed(429, "quota exceeded", "RESOURCE_EXHAUSTED"), "quota exceeded", 2),
        (answered(inline(drawn(1, 1, 1))), "has only 1 x 1 pixels", 1),
        (answered(inline(b"<svg/>")), "is not a picture", 1),
        (answered(inline(drawn(1)[:900])), "damaged or truncated", 1),
        (Answer(body=b"{half"), "not what Gemini answers", 2),
        (Answer(body=b'{"candidates": [' + b"1" * 500, cut=True), "no connection", 2),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_what_goes_wrong_is_one_line(
    answer: Answer, said_words: str, requests: int, service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [answer]
    with pytest.raises(UserError) as caught:
        generator(service, attempts=2).generate(context, so_far)
    assert said_words in caught.value.line()
    assert KEY not in caught.value.line()
    assert len(service.asked) == requests


def test_the_service_says_how_long_to_wait(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    waits: list[float] = []
    details = [{"@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": "17s"}]
    service.answers = [failed(429, "slow down", "RESOURCE_EXHAUSTED", details), answered(shown(1))]
    assert len(generator(service, waits).generate(context, so_far).candidates) == 1
    assert waits == [17]


def test_the_nearest_ratio_is_asked_for() -> None:
    offered = ("1:1", "3:2", "16:9", "2:3")
    assert [nearest_ratio(*size, offered) for size in ((100, 150), (100, 178), (100, 110), (150, 100))] == [
        "3:2", "16:9", "1:1", "2:3",
    ]  # fmt: skip
    assert nearest_ratio(100, 150, ()) is None
