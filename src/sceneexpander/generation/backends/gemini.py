"""Gemini's image models, through Google's official client."""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sceneexpander.errors import UserError
from sceneexpander.generation.config import ServiceConfig
from sceneexpander.generation.service import Question, Reply, ServiceGenerator, plain_settings
from sceneexpander.services.transport import ServiceError, http_error, retry_after_s

_REFUSED = ("SAFETY", "PROHIBITED", "RECITATION", "BLOCKLIST", "SPII", "MODEL_ARMOR")  # in the reasons for ending


@dataclass(frozen=True, slots=True, kw_only=True)
class GeminiConfig(ServiceConfig):
    """Settings of ``gemini``.

    Attributes:
        model: Google's name of the model.
        base_url: of the API; null: Google's.
        key_variable: environment variable that holds the key.
        ratios: ``WIDTH:HEIGHT`` that the model offers; the one nearest to the captured ratio is asked for.
        resolution: as the service calls it, e.g. ``2K``; null: its own choice.
    """

    backend: str = "gemini"
    model: str
    base_url: str | None
    key_variable: str
    ratios: tuple[str, ...]
    resolution: str | None

    def __post_init__(self) -> None:
        ServiceConfig.__post_init__(self)
        for ratio in self.ratios:
            if not re.fullmatch(r"[1-9][0-9]{0,3}:[1-9][0-9]{0,3}", ratio):
                raise UserError(f"holds {ratio!r}", where="generator.ratios", fix="write WIDTH:HEIGHT")


def make_gemini(config: GeminiConfig) -> ServiceGenerator:
    """The generator with these settings."""
    return ServiceGenerator(config, GeminiService(config))


@dataclass(frozen=True, slots=True)
class GeminiService:
    """See `Service`. The client's own retries are off: ours know the budget."""

    config: GeminiConfig

    def require(self) -> None:
        """The package and the key."""
        if importlib.util.find_spec("google") is None or importlib.util.find_spec("google.genai") is None:
            fix = "pip install 'sceneexpander[gemini]'"
            raise UserError("needs the package google-genai, which is not installed", where="generator gemini", fix=fix)
        if not os.environ.get(self.config.key_variable):
            raise UserError("is not set, and holds the service's key", where=self.config.key_variable, fix="export it")

    def identity(self) -> Mapping[str, object]:
        """Address, model, and what is asked for."""
        return plain_settings(self.config, "model", "base_url", "ratios", "resolution")

    def secrets(self) -> tuple[str, ...]:
        """The key."""
        key = os.environ.get(self.config.key_variable, "")
        return (key,) if key else ()

    def ask(self, question: Question) -> Reply:
        """One request for one picture."""
        import httpx2
        from google import genai
        from google.genai import errors, types

        config = self.config
        ratio = nearest_ratio(question.height, question.width, config.ratios)
        client = genai.Client(
            api_key=os.environ.get(config.key_variable, ""),
            vertexai=False,
            http_options=types.HttpOptions(
                base_url=config.base_url,
                timeout=max(1, round(config.timeout_s * 1000)),
                retry_options=types.HttpRetryOptions(attempts=1),
            ),
        )
        contents: list[Any] = [question.prompt]
        contents += [types.Part.from_bytes(data=item.png, mime_type="image/png") for item in question.references]
        wanted = types.GenerateContentConfig(
            response_modalities=["IMAGE"],
            image_config=types.ImageConfig(aspect_ratio=ratio, image_size=config.resolution),
        )
        try:
            answer = client.models.generate_content(model=config.model, contents=contents, config=wanted)
        except errors.APIError as error:
            raise _failed(error, config) from None
        except httpx2.TimeoutException:
            fix = "raise generator.timeout_s, or start again later"
            raise ServiceError("failed_retryable", f"no answer within {config.timeout_s:g} s", fix=fix) from None
        except httpx2.HTTPError as error:
            fix = "check the network, then start again"
            raise ServiceError("failed_retryable", f"no connection: {error}", fix=fix) from None
        except ValueError:  # malformed JSON, or JSON of another shape
            fix = "start again later"
            raise ServiceError("failed_retryable", "the answer is not what Gemini answers", fix=fix) from None
        finally:
            client.close()
        usage = answer.usage_metadata
        counted = {} if usage is None else usage.model_dump(exclude_none=True)
        return Reply(
            data=_picture_of(answer),
            model=answer.model_version or config.model,
            request_id=answer.response_id,
            usage={name: count for name, count in counted.items() if isinstance(count, int)},
            parameters={"asked_ratio": ratio or "any", "resolution": config.resolution or "any"},
        )


def nearest_ratio(height: int, width: int, ratios: tuple[str, ...]) -> str | None:
    """The offered ``WIDTH:HEIGHT`` that is nearest to a frame's; None if none is offered."""

    def apart(text: str) -> float:
        across, _, down = text.partition(":")
        offered = int(across) / int(down)
        return max(offered * height / width, width / height / offered)

    return min(ratios, key=apart) if ratios else None


def _failed(error: Any, config: GeminiConfig) -> ServiceError:
    details = json.dumps(error.details, default=str)
    status = 401 if "API_KEY_INVALID" in details else int(error.code or 500)
    asked = re.search(r'"retryDelay": ?"([0-9.]+)s"', details)
    headers = getattr(error.response, "headers", None) or {}
    wait = float(asked[1]) if asked else retry_after_s(headers)
    message = str(error.message or "")
    return http_error(status, str(error.status or ""), message, key_variable=config.key_variable, wait_s=wait)


def _picture_of(answer: Any) -> bytes:
    """The picture in an answer. Raises `ServiceError` if there is none, which is an ordinary success here."""
    blocked = getattr(answer.prompt_feedback, "block_reason", None)
    if blocked is not None:
        raise ServiceError("refused", f"the words or views were refused ({_name(blocked)})")
    said, ended = [], ""
    for candidate in answer.candidates or ():
        ended = _name(candidate.finish_reason) or ended
        for part in (candidate.content.parts if candidate.content else None) or ():
            if part.inline_data is not None and part.inline_data.data:
                return bytes(part.inline_data.data)
            if part.text:
                said.append(part.text)
    if any(word in ended for word in _REFUSED):
        raise ServiceError("refused", f"the picture was refused ({ended})")
    if said:
        raise ServiceError("refused", f"the service answered with words and no picture: {' '.join(said)}")
    fix = "start again later, or use another model"
    raise ServiceError(
        "failed_retryable", f"the service answered without a picture ({ended or 'no reason given'})", fix=fix
    )


def _name(value: Any) -> str:
    return "" if value is None else str(getattr(value, "value", value))
