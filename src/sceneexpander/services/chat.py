"""Chat models that are asked for one JSON object, through OpenAI's official client: OpenAI's and those of compatible servers."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from sceneexpander.artifacts.store import ArtifactError, read_json, read_typed, to_plain, write_json_atomic
from sceneexpander.errors import UserError
from sceneexpander.ranges import Range, check_ranges
from sceneexpander.services.kept import digest_of
from sceneexpander.services.openai_client import OpenAIAccess
from sceneexpander.services.pictures import SentPicture
from sceneexpander.services.transport import Budget, ServiceError, ask_patiently, safe_text

_SCHEMA = "chat-answer/1"
_LONGEST_TEXT = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatConfig:
    """Settings of a chat model.

    Attributes:
        model: the server's name of the model; better a dated snapshot than an alias.
        base_url: of the API; null: OpenAI's.
        key_variable: environment variable that holds the key; null: the server wants none.
        temperature: null: the server's own.
        take: another number asks anew; earlier answers stay, and come back with their number.
        max_requests: most requests of one run, repeated ones included.
        max_cost_usd: most that one run may cost; null: no limit.
        price_usd: of one request; null: not known.
        attempts: how often a request is sent that fails for a passing reason.
        timeout_s: how long an answer may take.
        extra_body: further fields of the request. No secrets: they are part of the record.
    """

    model: str
    base_url: str | None
    key_variable: str | None
    temperature: Annotated[float, Range(0, 2)] | None
    take: Annotated[int, Range(0, 10**6)]
    max_requests: Annotated[int, Range(1, 100_000)]
    max_cost_usd: Annotated[float, Range(0, 1e6)] | None
    price_usd: Annotated[float, Range(0, 1e6)] | None
    attempts: Annotated[int, Range(1, 20)]
    timeout_s: Annotated[float, Range(0, 86_400, low_open=True)]
    extra_body: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.max_cost_usd is not None and self.price_usd is None:
            problem = "is not known, so max_cost_usd cannot be kept"
            raise UserError(problem, where="price_usd", fix="set it to what one request costs")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatQuestion:
    """One request. All instructions are in ``instructions``; ``evidence`` is what they are about, texts and pictures in turn.

    The two never mix: instructions are the system message, and whatever comes from users, files or pictures is in the user's.
    ``schema`` is the JSON schema of the answer, ``name`` what it is called.
    """

    instructions: str
    evidence: Sequence[str | SentPicture]
    name: str
    schema: Mapping[str, object]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatAnswer:
    """What came. ``text`` is None for a refusal (``refused`` says it) and for an answer with nothing in it."""

    text: str | None
    model: str
    created: str
    refused: str | None = None
    request_id: str | None = None
    usage: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True, kw_only=True)
class Chat:
    """Asks, and keeps what came.

    Attributes:
        config: settings.
        section: of the configuration that holds them, for messages.
        cache: folder of answers by what was asked and shown; no stage's output.
        sleep: waits between tries.
        requests: what was asked in this object's life, by name, pictures as hashes of their pixels; answers from the cache included.
    """

    config: ChatConfig
    section: str
    cache: Path
    sleep: Callable[[float], None] = time.sleep
    requests: dict[str, object] = field(default_factory=dict)
    _budget: Budget = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        self._budget = Budget(
            section=self.section,
            thing="answer",
            max_requests=config.max_requests,
            max_cost_usd=config.max_cost_usd,
            price_usd=config.price_usd,
        )

    @property
    def server(self) -> str:
        """Who is asked."""
        return self.config.base_url or "api.openai.com"

    @property
    def sent(self) -> int:
        """Requests so far, repeated ones included; answers from the cache are not."""
        return self._budget.sent

    def require(self) -> None:
        """Raise `UserError` if the model could not be asked. Sends nothing."""
        self._access().require(self.section)

    def name_of(self, question: ChatQuestion) -> str:
        """Names everything that makes an answer another one, but which sample it is."""
        return digest_of(self._record(question))

    def kept(self, question: ChatQuestion, number: int = 0) -> ChatAnswer | None:
        """The answer that is there already; None without one, or if it is damaged. Sends nothing."""
        place = self._place(question, number)
        if not place.is_file():
            return None
        try:
            return read_typed(_Kept, read_json(place), place).answer
        except ArtifactError:
            return None

    def ask(self, question: ChatQuestion, number: int, *, what: str) -> ChatAnswer:
        """The answer, from the cache or by a request.

        Args:
            question: what is asked.
            number: of the sample: others are asked anew.
            what: is asked, said while waiting.

        Raises:
            UserError: there is no answer, not even a refusal; what came before is kept.
        """
        self.requests[self.name_of(question)] = self._record(question)
        found = self.kept(question, number)
        if found is not None:
            return found
        self.require()
        secrets = self._access().secrets()
        try:
            answer = ask_patiently(
                lambda: self._asked(question),
                what=what,
                attempts=self.config.attempts,
                budget=self._budget,
                secrets=secrets,
                sleep=self.sleep,
            )
        except ServiceError as error:
            reason = safe_text(error.reason, secrets)
            if error.ending != "refused":
                raise UserError(reason, where=self.section, fix=error.fix or None) from None
            answer = ChatAnswer(text=None, refused=reason, model=self.config.model, created=_now())
        write_json_atomic(self._place(question, number), {"schema": _SCHEMA, "answer": answer})
        return answer

    def _asked(self, question: ChatQuestion) -> ChatAnswer:
        body = self._body(question, _data_uri)
        content, request_id = self._access().send(
            lambda client: client.chat.completions.with_raw_response.create(
                **body, extra_body=self.config.extra_body or None
            )
        )
        if not isinstance(content, dict):
            raise ServiceError("failed_final", "the answer is JSON, but no answer of a chat endpoint")
        text, refused = _said(content)
        secrets = self._access().secrets()
        usage = content.get("usage")
        model = content.get("model")
        return ChatAnswer(
            text=None if text is None else _without(text[:_LONGEST_TEXT], secrets),
            refused=None if refused is None else safe_text(refused, secrets),
            model=model if isinstance(model, str) and model else self.config.model,
            request_id=request_id,
            created=_now(),
            usage={name: count for name, count in usage.items() if type(count) is int}
            if isinstance(usage, dict)
            else {},
        )

    def _body(self, question: ChatQuestion, show: Callable[[SentPicture], str]) -> dict[str, Any]:
        parts: list[dict[str, object]] = [
            {"type": "text", "text": item}
            if isinstance(item, str)
            else {"type": "image_url", "image_url": {"url": show(item)}}
            for item in question.evidence
        ]
        temperature = {} if self.config.temperature is None else {"temperature": self.config.temperature}
        return {
            "model": self.config.model,
            "messages": [
                {"role": "system", "content": question.instructions},
                {"role": "user", "content": parts},
            ],
            "response_format": {
                "type": "json_schema",
                "json_schema": {"name": question.name, "strict": True, "schema": dict(question.schema)},
            },
            **temperature,
        }

    def _record(self, question: ChatQuestion) -> dict[str, object]:
        body = self._body(question, lambda picture: f"sha256 of pixels: {picture.pixels_sha256}")
        plain: dict[str, object] = to_plain(
            {"server": self.server, "take": self.config.take, "body": {**body, **self.config.extra_body}}
        )
        return plain

    def _place(self, question: ChatQuestion, number: int) -> Path:
        return self.cache / self.name_of(question) / f"{number}.json"

    def _access(self) -> OpenAIAccess:
        config = self.config
        return OpenAIAccess(
            base_url=config.base_url,
            key_variable=config.key_variable,
            timeout_s=config.timeout_s,
            section=self.section,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    schema: Literal["chat-answer/1"]
    answer: ChatAnswer


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _data_uri(picture: SentPicture) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.png).decode()}"


def _said(content: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """(the message's text, the refusal) of an answer, whatever it holds."""
    choices = content.get("choices")
    choice = choices[0] if isinstance(choices, list) and choices else None
    if not isinstance(choice, dict):
        return None, None
    message = choice.get("message")
    message = message if isinstance(message, dict) else {}
    refusal, text = message.get("refusal"), message.get("content")
    if isinstance(refusal, str) and refusal:
        return None, refusal
    if choice.get("finish_reason") == "content_filter":
        return None, "stopped by the provider's content filter"
    return (text, None) if isinstance(text, str) else (None, None)


def _without(text: str, secrets: tuple[str, ...]) -> str:
    for secret in secrets:
        text = text.replace(secret, "***")
    # Half of a surrogate pair, which JSON can write, is no text that a file can hold.
    return text.encode(errors="replace").decode()
