"""The images endpoint through the official client, against a service on this machine: what is sent, kept, tried again and refused."""

from __future__ import annotations

import base64
import io
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.candidates import CandidateSet
from sceneexpander.artifacts.source_type import MADE_BY_MODEL
from sceneexpander.errors import UserError
from sceneexpander.generation import ChoiceConfig, GenerationContext, SceneSoFar, choose_view
from sceneexpander.generation.backends.openai import asked_size
from tests.support.loopback import Answer, Service, drawn, error, picture, said
from tests.support.openai_service import KEY, generator, settings
from tests.worlds.rounds import HEIGHT, WIDTH, flat_scene, made_views


@pytest.fixture
def so_far() -> SceneSoFar:
    images = torch.rand(5, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return flat_scene(made_views(images, images), apart=0.2)


def test_what_is_sent_and_what_is_recorded(
    service: Service, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path
) -> None:
    usage = {"total_tokens": 7, "input_tokens": 3, "output_tokens": 4, "input_tokens_details": {"text_tokens": 1}}
    service.answers = [picture(1, usage=usage, size="1536x1024"), picture(2)]
    service.answers[0].headers["x-request-id"] = "req_1"
    made = generator(service, max_references=3, quality="high", extra_body={"seed": 5}).generate(context, so_far)
    assert [outcome.ending for outcome in made.outcomes] == ["candidate", "candidate"]
    assert [candidate.data for candidate in made.candidates] == [drawn(1), drawn(2)]
    first = service.asked[0]
    assert (first.method, first.path) == ("POST", "/v1/images/edits")
    assert first.headers["authorization"] == f"Bearer {KEY}"
    for expected in (
        b"You are exploring. Please generate a new viewpoint following the requirements: move right 30 %, a bench.",
        b"gpt-image-2",
        b"1536x1024",
        b'name="seed"',
        b'name="quality"',
    ):
        assert expected in first.body
    # The photos are 10 % of the distance apart: 30 % to the right of the middle one, the last is nearest.
    order = [first.body.index(f'filename="{view}.png"'.encode()) for view in ("004_4", "003_3", "002_2")]
    assert order == sorted(order), "the nearest view comes first"
    assert first.body.count(b"Content-Type: image/png") == 3
    provenance = made.candidates[0].provenance
    assert provenance.source == "gpt-image-2"
    assert provenance.request_id == "req_1"
    assert provenance.usage == {"total_tokens": 7, "input_tokens": 3, "output_tokens": 4}
    assert provenance.cost_usd == 0.04
    assert provenance.digital_source_type == MADE_BY_MODEL
    assert provenance.parameters["asked_size"] == "1536x1024"
    assert provenance.parameters["extra_body"] == '{"seed": 5}'
    assert provenance.reference_sha256 == ("4" * 64, "3" * 64, "2" * 64)
    made.save(tmp_path / "saved")
    assert CandidateSet.load(tmp_path / "saved") == made
    for path in [*(tmp_path / "saved").rglob("*"), *context.cache.rglob("*")]:
        assert not path.is_file() or KEY.encode() not in path.read_bytes(), "no secret is written"
    chosen = choose_view(context, made.candidates, so_far, ChoiceConfig(candidate=1), seed=0).inserted
    assert chosen.provenance[1].parameters["original_size"] == "240x160"


def test_nothing_is_paid_for_twice(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    service.answers = [picture(1), picture(2), picture(3), picture(4)]
    assert generator(service).check(context).requests == 2
    made = generator(service).generate(context, so_far)
    assert len(service.asked) == 2
    assert generator(service).check(context).requests == 0
    again = generator(service).generate(context, so_far)
    assert again.candidates == made.candidates, "the same bytes and the same record"
    assert [outcome.sent for outcome in again.outcomes] == [0, 0]
    assert len(service.asked) == 2
    fresh = generator(service, take=1).generate(context, so_far)
    assert len(service.asked) == 4
    assert {item.data for item in fresh.candidates} == {drawn(3), drawn(4)}
    assert generator(service).generate(context, so_far).candidates == made.candidates
    for place in context.cache.rglob("picture"):
        place.write_bytes(b"damaged")
    generator(service, candidates=1).generate(context, so_far)
    assert len(service.asked) == 5, "what is damaged is asked for again"


def test_what_came_before_a_failure_is_kept_and_continued(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [picture(1), error(401, f"Incorrect API key provided: {KEY}.", "invalid_api_key")]
    made = generator(service, candidates=4).generate(context, so_far)
    assert [outcome.ending for outcome in made.outcomes] == ["candidate", "failed_final"]
    assert KEY not in str(made.outcomes)
    assert len(service.asked) == 2, "what is wrong with the key is wrong for all"
    service.answers = [picture(2)]
    whole = generator(service, candidates=4).generate(context, so_far)
    assert len(whole.candidates) == 4
    assert whole.candidates[0] == made.candidates[0]
    assert len(service.asked) == 5


def huge() -> bytes:
    """A hundred megapixels in few bytes."""
    buffer = io.BytesIO()
    Image.new("1", (10_000, 10_000)).save(buffer, format="PNG")
    return buffer.getvalue()


REFUSAL = error(400, "Your request was rejected by the safety system.", "moderation_blocked")


def test_a_refusal_is_neither_repeated_nor_paid_for_again(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [REFUSAL, picture(1)]
    made = generator(service).generate(context, so_far)
    assert [outcome.ending for outcome in made.outcomes] == ["refused", "candidate"]
    assert "rejected by the safety system" in (made.outcomes[0].reason or "")
    generator(service).generate(context, so_far)
    assert len(service.asked) == 2


def test_passing_failures_are_tried_again_as_the_service_asks(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    waits: list[float] = []
    service.answers = [
        error(429, "slow down", "rate_limit_exceeded", retry_after="7"),
        error(503, "overloaded"),
        Answer(body=b"{half of a jso"),
        picture(1),
    ]
    made = generator(service, waits, candidates=1, attempts=4).generate(context, so_far)
    assert made.outcomes[0].ending == "candidate"
    assert made.outcomes[0].sent == len(service.asked) == 4
    assert waits[0] == 7
    assert 1 <= waits[1] <= 2
    assert 2 <= waits[2] <= 4


@pytest.mark.parametrize(
    ("answer", "said_words", "requests"),
    [
        (REFUSAL, "rejected by the safety system", 1),
        (error(401, f"Incorrect API key provided: {KEY}."), "check the key in TEST_KEY", 1),
        (error(403, "Your organization must be verified"), "verify the organisation", 1),
        (error(404, "The model `gpt-image-1` has been shut down"), "set generator.model", 1),
        (error(429, "You exceeded your quota", "insufficient_quota"), "no credit left", 1),
        (error(429, "slow down", retry_after="4000"), "wants 4000 s", 1),
        (error(400, "size is not supported"), "size is not supported", 1),
        (error(500, "oops"), "start the same command again later", 2),
        (said({"data": []}), "answered without a picture", 1),
        (said({"created": 1, "text": "I cannot draw that."}), "words and no picture: I cannot draw that.", 1),
        (said({"choices": [{"message": {"content": "No."}}]}), "words and no picture: No.", 1),
        (said(["x"]), "no answer of an images endpoint", 1),
        (said({"data": [{"b64_json": "%%%"}]}), "not valid base64", 1),
        (said({"data": [{"url": "http://127.0.0.2:1/x.png"}]}), "lies on another server", 1),
        (Answer(body=b"<html>gateway</html>", content_type="text/html"), "not valid JSON", 2),
        (Answer(body=b'{"data": [' + b"1" * 500, cut=True), "no connection", 2),
        (said({"data": [{"b64_json": base64.b64encode(drawn(1, 1, 1)).decode()}]}), "has only 1 x 1 pixels", 1),
        (said({"data": [{"b64_json": base64.b64encode(b"<svg/>").decode()}]}), "is not a picture", 1),
        (said({"data": [{"b64_json": base64.b64encode(drawn(1)[:900]).decode()}]}), "damaged or truncated", 1),
        (said({"data": [{"b64_json": base64.b64encode(huge()).decode()}]}), "more than the 40 MP allowed", 1),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_goes_wrong_is_one_line(
    answer: Answer, said_words: str, requests: int, service: Service, so_far: SceneSoFar, context: GenerationContext,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    service.answers = [answer]
    with caplog.at_level(logging.DEBUG, logger="sceneexpander"), pytest.raises(UserError) as caught:
        generator(service, candidates=1, attempts=2).generate(context, so_far)
    line = caught.value.line()
    assert said_words in line
    assert "\n" not in line
    assert KEY not in line + caplog.text
    assert len(service.asked) == requests
    service.answers = [picture(1)]
    if "refused" not in str([path.read_text() for path in context.cache.rglob("artifact.json")]):
        assert len(generator(service, candidates=1).generate(context, so_far).candidates) == 1, "it goes on from there"


def test_a_slow_or_absent_service(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    slow = picture(1)
    slow.wait_s = 1.0
    service.answers = [slow]
    with pytest.raises(UserError, match=r"no answer within 0.2 s; raise generator.timeout_s"):
        generator(service, candidates=1, attempts=1, timeout_s=0.2).generate(context, so_far)
    with pytest.raises(UserError, match=r"no connection: .*; check the network"):
        generator(service, attempts=2, base_url="http://127.0.0.1:9/v1").generate(context, so_far)


def test_the_budget_is_looked_at_before_anything_is_sent(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [picture(1)]
    with pytest.raises(UserError, match=r"beyond generator\.max_cost_usd"):
        generator(service, max_cost_usd=0.03).generate(context, so_far)
    assert service.asked == []
    made = generator(service, candidates=5, max_cost_usd=0.09).generate(context, so_far)
    assert (len(made.candidates), len(service.asked)) == (2, 2)
    service.answers = [error(500, "oops")]
    with pytest.raises(UserError, match=r"2 requests were sent: one more is beyond generator\.max_requests"):
        generator(service, take=1, max_requests=2, attempts=9).generate(context, so_far)
    assert len(service.asked) == 4
    with pytest.raises(UserError, match="price_usd: is not known"):
        settings(service, price_usd=None, max_cost_usd=1.0)


def test_the_scenes_budget_is_over_all_rounds_and_runs(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [picture(number) for number in range(1, 6)]
    next_round = replace(context, round_number=2)
    generator(service).generate(context, so_far)
    with pytest.raises(UserError, match=r"2 requests were sent for the scene so far: one more is beyond"):
        generator(service, take=1, max_scene_requests=2).generate(next_round, so_far)
    with pytest.raises(UserError, match=r"0\.08 USD were asked for so far: .*max_scene_cost_usd"):
        generator(service, take=1, max_scene_cost_usd=0.1).generate(next_round, so_far)
    assert len(service.asked) == 2
    made = generator(service, take=1, max_scene_cost_usd=0.12).generate(next_round, so_far)
    assert (len(made.candidates), len(service.asked)) == (1, 3), "exactly up to the limit"
    assert len(generator(service, max_scene_requests=1).generate(context, so_far).candidates) == 2, (
        "kept ones cost nothing"
    )
    other = replace(context, scene="another")
    assert len(generator(service, max_scene_requests=2, take=2).generate(other, so_far).candidates) >= 1
    with pytest.raises(UserError, match=r"max_scene_cost_usd cannot be kept"):
        settings(service, price_usd=None, max_scene_cost_usd=1.0)


def test_a_check_is_free_and_needs_a_key_only_for_what_is_missing(
    service: Service, so_far: SceneSoFar, context: GenerationContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    forecast = generator(service).check(context)
    assert (forecast.requests, forecast.cost_usd) == (2, 0.08)
    assert forecast.prompt.endswith("move right 30 %, a bench.")
    monkeypatch.delenv("TEST_KEY")
    with pytest.raises(UserError, match="TEST_KEY: is not set"):
        generator(service).check(context)
    assert generator(service, key_variable=None).check(context).requests == 2
    assert service.asked == []
    monkeypatch.setenv("TEST_KEY", KEY)
    service.answers = [picture(1)]
    generator(service).generate(context, so_far)
    monkeypatch.delenv("TEST_KEY")
    assert generator(service).check(context).requests == 0
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"pip install 'sceneexpander\[openai\]'"):
        generator(service, take=1).check(context)


def test_a_picture_by_address_comes_from_the_configured_server_alone(
    service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    service.answers = [
        said({"data": [{"url": f"{service.address}/files/1.png"}]}),
        Answer(body=drawn(3), content_type="image/png"),
    ]
    made = generator(service, candidates=1, key_variable=None).generate(context, so_far)
    assert made.candidates[0].data == drawn(3)
    assert KEY not in json.dumps(service.asked[1].headers), "a file is asked for without the key"


@pytest.mark.parametrize(
    ("height", "width", "changes", "expected"),
    [
        (56, 84, {}, "1536x1024"), (84, 56, {}, "1024x1536"), (60, 60, {"long_side_px": 1000}, "992x992"),
        (56, 84, {"sizes": ("1024x1024", "1536x1024")}, "1536x1024"), (70, 84, {"sizes": ("1024x1024", "1536x1024")}, "1024x1024"),
    ],
)  # fmt: skip
def test_the_captured_ratio_is_asked_for(
    height: int, width: int, changes: dict[str, Any], expected: str, service: Service
) -> None:
    assert asked_size(height, width, settings(service, **changes)) == expected


@pytest.mark.parametrize("key", ["hunter2", KEY])
def test_a_key_that_the_service_repeats_is_not_shown(
    key: str, service: Service, so_far: SceneSoFar, context: GenerationContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it looks like; and what looks like a key is left out even if it is not ours."""
    monkeypatch.setenv("TEST_KEY", key)
    service.answers = [error(401, f"Incorrect API key provided: {key}, use sk-anotherone012345.")]
    with pytest.raises(UserError) as caught:
        generator(service).generate(context, so_far)
    assert key not in caught.value.line()
    assert "anotherone" not in caught.value.line()
