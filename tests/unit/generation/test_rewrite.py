"""A chat model puts the instruction into its words first: what it is asked, what becomes of its answer, what is kept of both."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from typing import Any

import pytest

from sceneexpander.errors import UserError
from sceneexpander.generation import GenerationContext, SceneSoFar
from sceneexpander.generation.service import ServiceGenerator
from tests.support.loopback import Answer, Asked, Service, error, picture, said
from tests.support.openai_service import KEY, generator, settings

GIVEN = "You are exploring. Please generate a new viewpoint following the requirements: move right 30 %, a bench."
SENT = "Step to the right by a third of the way and show a bench."


def instruction(text: str = SENT) -> Answer:
    content = json.dumps({"instruction": text})
    return said({"model": "chat-1", "choices": [{"message": {"content": content}, "finish_reason": "stop"}]})


def rewriting(
    service: Service, chat: list[Answer], waits: list[float] | None = None, **changes: Any
) -> ServiceGenerator:
    """Pictures without end; of the chat model the given answers, the last of them again and again."""

    def route(request: Asked) -> Answer:
        if request.path.endswith("/chat/completions"):
            return chat.pop(0) if len(chat) > 1 else chat[0]
        return picture(len(service.asked))

    service.route = route
    known = settings(service).rewrite
    assert known is not None
    given = {"enabled": True, "base_url": f"{service.address}/v1", "key_variable": "TEST_KEY", "timeout_s": 5.0}
    return generator(service, waits, rewrite=replace(known, **(given | {"price_usd": 0.01} | changes)))


def asked(service: Service, ending: str) -> list[bytes]:
    return [request.body for request in service.asked if request.path.endswith(ending)]


def test_the_new_words_are_sent_and_both_are_kept(
    service: Service, so_far: SceneSoFar, context: GenerationContext, caplog: pytest.LogCaptureFixture
) -> None:
    made = rewriting(service, [instruction()])
    before = made.check(context)
    assert (before.prompt, before.requests, before.cost_usd) == (GIVEN, 3, pytest.approx(0.09))
    assert "rewrites the prompt first" in before.notes[0]
    assert not service.asked, "looking is free"
    with caplog.at_level(logging.INFO):
        candidates = made.generate(context, so_far).candidates
    assert SENT in caplog.text
    (question,) = asked(service, "/chat/completions")
    system, user = json.loads(question)["messages"]
    assert "bench" not in system["content"], "the user's words are no instructions"
    assert json.loads(user["content"][0]["text"]) == {"motion": "move right 30 %", "object": "a bench"}
    assert all(SENT.encode() in body and b"You are exploring" not in body for body in asked(service, "/images/edits"))
    for candidate in candidates:
        how = candidate.provenance
        assert (how.prompt, how.prompt_given, how.rewritten_by) == (SENT, GIVEN, "chat-1")
    count = len(service.asked)
    assert made.generate(context, so_far).candidates == candidates
    after = made.check(context)
    assert (after.prompt, after.requests) == (SENT, 0)
    assert GIVEN in after.notes[0]
    assert len(service.asked) == count, "nothing is paid for twice"


def test_by_default_nobody_rewrites(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    service.answers = [picture(1)]
    (first, _) = generator(service).generate(context, so_far).candidates
    assert (first.provenance.prompt, first.provenance.prompt_given) == (GIVEN, None)
    assert not asked(service, "/chat/completions")


NO_CHOICE = said({"choices": []})
BAD: dict[str, tuple[Answer, str]] = {
    "refusal": (said({"choices": [{"message": {"refusal": "I will not."}}]}), "the model refused: I will not."),
    "text": (said({"choices": [{"message": {"content": "Sure! Step right."}}]}), "no instruction: Sure! Step right."),
    "nothing": (NO_CHOICE, "answered with no instruction: nothing"),
    "empty": (instruction(" "), "instruction is empty"),
    "a list": (said({"choices": [{"message": {"content": "[1]"}}]}), "no instruction: [1]"),
    "too long": (instruction("step " * 1000), "4000 are allowed"),
    "wrong key": (error(401, f"Incorrect API key provided: {KEY}"), "check the key in TEST_KEY"),
    "retired model": (error(404, "no such model", "model_not_found"), "set generator.rewrite.model"),
    "no credit": (error(429, "no quota", "insufficient_quota"), "no credit left"),
    "no JSON": (Answer(body=b"<html>"), "JSON"),
}


@pytest.mark.parametrize("name", BAD)
def test_without_an_instruction_no_picture_is_paid_for(
    name: str, service: Service, so_far: SceneSoFar, context: GenerationContext
) -> None:
    answer, words = BAD[name]
    with pytest.raises(UserError) as caught:
        rewriting(service, [answer], attempts=1).generate(context, so_far)
    line = caught.value.line()
    assert line.startswith("generator.rewrite: ")
    assert words in line
    assert KEY not in line
    assert not asked(service, "/images/edits")


def test_a_run_goes_on_when_the_cause_is_gone(service: Service, so_far: SceneSoFar, context: GenerationContext) -> None:
    waits: list[float] = []
    made = rewriting(service, [error(503, "busy", retry_after="3"), instruction()], waits, attempts=2)
    assert made.generate(context, so_far).candidates[0].provenance.prompt == SENT
    assert waits == [3.0]
    refused = rewriting(service, [BAD["refusal"][0]], take=1)
    for _ in range(2):
        with pytest.raises(UserError, match="refused"):
            refused.generate(context, so_far)
    assert len(asked(service, "/chat/completions")) == 3, "a refusal is not asked for again"
    with pytest.raises(UserError, match="refused"):
        refused.check(context)


def test_its_budget_and_its_key_are_looked_at_before(
    service: Service, so_far: SceneSoFar, context: GenerationContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = rewriting(service, [error(503, "busy")], attempts=4, max_requests=2)
    with pytest.raises(UserError, match=r"beyond generator\.rewrite\.max_requests"):
        made.generate(context, so_far)
    assert len(service.asked) == 2
    monkeypatch.delenv("OTHER_KEY", raising=False)
    with pytest.raises(UserError, match="OTHER_KEY"):
        rewriting(service, [instruction()], key_variable="OTHER_KEY").check(context)
