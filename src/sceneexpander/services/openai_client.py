"""OpenAI's official client, for OpenAI and for servers that speak its protocol. Its own retries are off: ours know the budget."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sceneexpander.errors import UserError
from sceneexpander.services.transport import ServiceError, http_error, retry_after_s

_NO_KEY = "none"  # what a server without keys is sent: the client insists on one


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenAIAccess:
    """Where a server is, and what it wants to know.

    Attributes:
        base_url: of the API; None: OpenAI's.
        key_variable: environment variable that holds the key; None: the server wants none.
        timeout_s: how long an answer may take.
        section: of the configuration that says so, for messages.
    """

    base_url: str | None
    key_variable: str | None
    timeout_s: float
    section: str

    def require(self, where: str) -> None:
        """Raise `UserError` if it could not be asked: the package or the key is missing. Sends nothing."""
        if importlib.util.find_spec("openai") is None:
            fix = "pip install 'sceneexpander[openai]'"
            raise UserError("needs the package openai, which is not installed", where=where, fix=fix)
        if self.key_variable is not None and not os.environ.get(self.key_variable):
            fix = f"export it, or set {self.section}.key_variable=null for a server without keys"
            raise UserError("is not set, and holds the service's key", where=self.key_variable, fix=fix)

    def secrets(self) -> tuple[str, ...]:
        """What must not be written anywhere: the key."""
        key = os.environ.get(self.key_variable or "", "")
        return (key,) if key else ()

    def send(self, call: Callable[[Any], Any]) -> tuple[Any, str | None]:
        """One request.

        Args:
            call: makes it with an ``openai.OpenAI``, by a method of ``with_raw_response``.

        Returns:
            the answer's JSON; the server's name of the request.

        Raises:
            ServiceError: there is no answer, or not in JSON.
        """
        import openai

        key = os.environ.get(self.key_variable, "") if self.key_variable else _NO_KEY
        client = openai.OpenAI(api_key=key or _NO_KEY, base_url=self.base_url, max_retries=0, timeout=self.timeout_s)
        try:
            raw = call(client)
            return json.loads(raw.text), raw.headers.get("x-request-id")
        except openai.APITimeoutError:
            fix = f"raise {self.section}.timeout_s, or start again later"
            raise ServiceError("failed_retryable", f"no answer within {self.timeout_s:g} s", fix=fix) from None
        except openai.APIConnectionError as error:
            cause = error.__cause__ or error
            fix = f"check the network{f' and {self.base_url}' if self.base_url else ''}, then start again"
            raise ServiceError("failed_retryable", f"no connection: {cause}", fix=fix) from None
        except openai.APIStatusError as error:
            raise self._refused_or_failed(error) from None
        except ValueError:
            fix = "start again later, or look at the server's own log"
            raise ServiceError("failed_retryable", "the answer is not valid JSON", fix=fix) from None
        finally:
            client.close()

    def _refused_or_failed(self, error: Any) -> ServiceError:
        body = error.body if isinstance(error.body, dict) else {}
        kinds = [body.get(name) for name in ("code", "type")]
        code = next((kind for kind in kinds if isinstance(kind, str)), "")
        message = body.get("message") if isinstance(body.get("message"), str) else ""
        violations = body.get("safety_violations")
        if isinstance(violations, list) and violations:
            message = f"{message} [{', '.join(map(str, violations))}]"
        return http_error(
            error.status_code,
            code,
            str(message),
            key_variable=self.key_variable,
            wait_s=retry_after_s(error.response.headers),
            section=self.section,
        )
