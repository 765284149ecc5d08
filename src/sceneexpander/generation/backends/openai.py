"""OpenAI's images edit endpoint, and servers that speak it (vLLM-Omni, SGLang, LiteLLM, ...), through the official client."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any
from urllib.parse import urlsplit

from sceneexpander.generation.config import ServiceConfig
from sceneexpander.generation.service import Question, Reply, ServiceGenerator, plain_settings
from sceneexpander.ranges import Range
from sceneexpander.services.openai_client import OpenAIAccess
from sceneexpander.services.transport import ServiceError

_LARGEST_DOWNLOAD = 64 * 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenAIConfig(ServiceConfig):
    """Settings of ``openai``.

    Attributes:
        model: the service's name of the model; better a dated snapshot than an alias.
        base_url: of the API; null: OpenAI's.
        key_variable: environment variable that holds the key; null: the server wants none.
        long_side_px: of the picture that is asked for, which has the captured ratio.
        multiple: of which both sides are.
        sizes: ``WIDTHxHEIGHT`` that the model offers, where it does not take any: the one nearest to the captured ratio is asked for.
        quality: as the service calls it; null: its own choice.
        extra_body: further fields of the request, e.g. a server's ``seed``. No secrets: they are part of the record.
    """

    backend: str = "openai"
    model: str
    base_url: str | None
    key_variable: str | None
    long_side_px: Annotated[int, Range(64, 8192)]
    multiple: Annotated[int, Range(1, 512)]
    sizes: tuple[str, ...] = ()
    quality: str | None
    extra_body: dict[str, Any] = field(default_factory=dict)


def make_openai(config: OpenAIConfig) -> ServiceGenerator:
    """The generator with these settings."""
    return ServiceGenerator(config, OpenAIService(config))


@dataclass(frozen=True, slots=True)
class OpenAIService:
    """See `Service`."""

    config: OpenAIConfig

    def require(self) -> None:
        """The package and the key."""
        self._access().require("generator openai")

    def identity(self) -> Mapping[str, object]:
        """Address, model, and what is asked for."""
        names = ("model", "base_url", "long_side_px", "multiple", "sizes", "quality", "extra_body")
        return plain_settings(self.config, *names)

    def secrets(self) -> tuple[str, ...]:
        """The key."""
        return self._access().secrets()

    def ask(self, question: Question) -> Reply:
        """One request for one picture."""
        config = self.config
        size = asked_size(question.height, question.width, config)
        arguments: dict[str, Any] = {"model": config.model, "prompt": question.prompt, "n": 1, "size": size}
        if config.quality is not None:
            arguments["quality"] = config.quality
        files = [(f"{item.view_id}.png", item.png, "image/png") for item in question.references]
        content, request_id = self._access().send(
            lambda client: client.images.with_raw_response.edit(
                image=files, extra_body=config.extra_body or None, **arguments
            )
        )
        if not isinstance(content, dict):
            raise ServiceError("failed_final", "the answer is JSON, but no answer of an images endpoint")
        usage = content.get("usage")
        return Reply(
            data=_picture_of(content, config),
            model=config.model,
            request_id=request_id,
            usage={name: count for name, count in usage.items() if isinstance(count, int)}
            if isinstance(usage, dict)
            else {},
            parameters={
                "asked_size": size,
                "server": config.base_url or "api.openai.com",
                **{
                    name: content[name]
                    for name in ("size", "quality", "output_format")
                    if isinstance(content.get(name), str)
                },
                **({"extra_body": json.dumps(config.extra_body, sort_keys=True)} if config.extra_body else {}),
            },
        )

    def _access(self) -> OpenAIAccess:
        config = self.config
        return OpenAIAccess(
            base_url=config.base_url,
            key_variable=config.key_variable,
            timeout_s=config.timeout_s,
            section="generator",
        )


def asked_size(height: int, width: int, config: OpenAIConfig) -> str:
    """``WIDTHxHEIGHT`` in the captured ratio, as the service wants it."""
    ratio = width / height
    if config.sizes:
        return min(config.sizes, key=lambda text: abs(_ratio(text) / ratio - 1))
    long_side = max(1, round(config.long_side_px / config.multiple))
    short_side = max(1, round(long_side * min(ratio, 1 / ratio)))
    sides = (long_side, short_side) if ratio >= 1 else (short_side, long_side)
    return "x".join(str(side * config.multiple) for side in sides)


def _ratio(text: str) -> float:
    width, _, height = text.partition("x")
    try:
        return int(width) / int(height)
    except (ValueError, ZeroDivisionError):
        raise ServiceError("failed_final", f"generator.sizes holds {text!r}", fix="write WIDTHxHEIGHT") from None


def _picture_of(content: Mapping[str, Any], config: OpenAIConfig) -> bytes:
    """The picture in an answer. Raises `ServiceError` if there is none, which services call a success all the same."""
    entries = content.get("data")
    entry = entries[0] if isinstance(entries, list) and entries else None
    if isinstance(entry, dict) and isinstance(entry.get("b64_json"), str):
        try:
            return base64.b64decode(entry["b64_json"], validate=True)
        except binascii.Error:
            raise ServiceError("failed_final", "the answer's picture is not valid base64") from None
    if isinstance(entry, dict) and isinstance(entry.get("url"), str):
        return _downloaded(entry["url"], config)
    said = _text_in(content)
    if said:  # a sentence in place of a picture is how chat models behind an images endpoint refuse
        raise ServiceError("refused", f"the service answered with words and no picture: {said}")
    fix = "use a model that makes pictures"
    raise ServiceError("failed_final", "the service answered without a picture", fix=fix)


def _text_in(content: Mapping[str, Any]) -> str:
    """The words of an answer that is a chat message, in the forms that proxies hand on."""
    for name in ("text", "message", "output_text", "refusal"):
        if isinstance(content.get(name), str):
            return str(content[name])
    choices = content.get("choices")
    if isinstance(choices, list) and choices and isinstance(choices[0], dict):
        message = choices[0].get("message")
        if isinstance(message, dict):
            return str(message.get("refusal") or message.get("content") or "")
    return ""


def _downloaded(url: str, config: OpenAIConfig) -> bytes:
    """A picture that the answer names by its address: only from the configured host, and without following it elsewhere."""
    import httpx2

    wanted, found = urlsplit(config.base_url or ""), urlsplit(url)
    if not wanted.netloc or (found.scheme, found.netloc) != (wanted.scheme, wanted.netloc):
        problem = f"the answer's picture lies on another server ({found.netloc or 'nowhere'}), which is not asked"
        raise ServiceError("failed_final", problem, fix="have the server send b64_json, e.g. by generator.extra_body")
    try:
        with httpx2.stream("GET", url, timeout=config.timeout_s, follow_redirects=False) as response:
            if response.status_code != 200:
                raise ServiceError(
                    "failed_retryable", f"the answer's picture cannot be had (HTTP {response.status_code})"
                )
            data = bytearray()
            for part in response.iter_bytes():
                data += part
                if len(data) > _LARGEST_DOWNLOAD:
                    raise ServiceError("failed_final", "the answer's picture is larger than any that was asked for")
            return bytes(data)
    except httpx2.HTTPError as error:
        raise ServiceError("failed_retryable", f"the answer's picture cannot be had ({error})") from None
