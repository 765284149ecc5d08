"""What all paid requests have in common: how they end, what is tried again and what is not, the budget, and what is never written.

Every request ends in one of four ways: an answer; *refused* (the provider will not do this: never asked again by itself); *failed,
retryable* (asked again a few times, then given up); *failed, final* (nothing would come of asking again).
"""

from __future__ import annotations

import logging
import random
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Thread
from typing import Literal, TypeVar

logger = logging.getLogger(__name__)
Failure = Literal["refused", "failed_retryable", "failed_final"]
Reply = TypeVar("Reply")
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0  # between two tries, doubled each time
_LONGEST_ASKED_WAIT_S = 300.0  # a service that wants more than that is as good as down
_SIGN_OF_LIFE_S = 15.0
_MAX_REASON = 300
_KEY_SHAPED = re.compile(r"\b(?:sk|pk|key|AIza)[-_]?[A-Za-z0-9_*-]{6,}")


class ServiceError(Exception):
    """A request without an answer.

    Args:
        ending: how it ends.
        reason: the provider's own, in its words.
        fix: what the user can do about it.
        wait_s: how long the provider asks to wait before the next try; None: it does not say.
    """

    def __init__(self, ending: Failure, reason: str, *, fix: str = "", wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.ending = ending
        self.reason = reason
        self.fix = fix
        self.wait_s = wait_s


@dataclass(slots=True, kw_only=True)
class Budget:
    """Looked at before anything is sent.

    Attributes:
        section: of the configuration that holds the limits, for messages.
        thing: what one request is for, for messages.
        max_requests: most requests, repeated ones included.
        max_cost_usd: most that they may cost; None: no limit.
        price_usd: of one request; None: not known.
        sent: requests so far.
    """

    section: str
    thing: str
    max_requests: int
    max_cost_usd: float | None
    price_usd: float | None
    sent: int = 0

    def spend(self) -> None:
        """Count one request. Raises `ServiceError` if it is one too many."""
        fix = "raise it and start again: what came is kept"
        if self.sent >= self.max_requests:
            problem = f"{self.sent} requests were sent: one more is beyond {self.section}.max_requests"
            raise ServiceError("failed_final", problem, fix=fix)
        if self.max_cost_usd is not None and (self.sent + 1) * (self.price_usd or 0.0) > self.max_cost_usd:
            limit = f"{self.section}.max_cost_usd ({self.max_cost_usd:g})"
            raise ServiceError("failed_final", f"one more {self.thing} is beyond {limit}", fix=fix)
        self.sent += 1


def ask_patiently(
    ask: Callable[[], Reply],
    *,
    what: str,
    attempts: int,
    budget: Budget,
    secrets: tuple[str, ...],
    sleep: Callable[[float], None],
) -> Reply:
    """The answer, after as many tries as it takes and the settings allow.

    Args:
        ask: sends one request; raises `ServiceError`.
        what: is asked for, said while waiting.
        attempts: most tries; only failures that pass are tried again, with the wait that the service asks for, else with jitter.
        budget: spent from before each try.
        secrets: not said in warnings.
        sleep: waits for so many seconds.

    Raises:
        ServiceError: refused, a failure that does not pass, or the last of the tries.
    """
    for attempt in range(attempts):
        budget.spend()
        try:
            with _signs_of_life(what):
                return ask()
        except ServiceError as error:
            if error.ending != "failed_retryable" or attempt + 1 == attempts:
                raise
            wait = error.wait_s
            if wait is not None and wait > _LONGEST_ASKED_WAIT_S:
                raise ServiceError(
                    "failed_final", f"{error.reason} (wants {wait:.0f} s of waiting)", fix="start again later"
                ) from None
            backoff = min(_LONGEST_WAIT_S, _FIRST_WAIT_S * 2**attempt)
            # Jitter keeps jobs of a sweep apart; it decides nothing about the result.
            wait = backoff * random.uniform(0.5, 1) if wait is None else wait  # noqa: S311
            logger.warning("%s; trying again in %.1f s", safe_text(error.reason, secrets), wait)
            sleep(wait)
    raise AssertionError("the last attempt returns or raises")


def safe_text(text: str, secrets: tuple[str, ...]) -> str:
    """Without anything that is a secret, or looks like one: services like to repeat the key that they were given."""
    for secret in secrets:
        text = text.replace(secret, "***")
    return " ".join(_KEY_SHAPED.sub("***", text).split())[:_MAX_REASON]


@contextmanager
def _signs_of_life(what: str) -> Iterator[None]:
    """Say now and then that an answer is still being waited for."""
    done = Event()

    def speak() -> None:
        waited = 0.0
        while not done.wait(_SIGN_OF_LIFE_S):
            waited += _SIGN_OF_LIFE_S
            logger.info("%s: waiting for %.0f s", what, waited)

    thread = Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def http_error(
    status: int,
    code: str,
    message: str,
    *,
    key_variable: str | None,
    wait_s: float | None,
    section: str = "generator",
) -> ServiceError:
    """What an HTTP status and the provider's own code mean for a request.

    Refusals are what is said to be one by its code, never guessed from words.
    """
    reason = f"{message or 'no reason given'} (HTTP {status}{f', {code}' if code else ''})"
    if code in ("moderation_blocked", "content_policy_violation", "content_filter", "image_generation_user_error"):
        return ServiceError("refused", reason)
    if code == "insufficient_quota" or status == 402:
        return ServiceError("failed_final", reason, fix="the account has no credit left: add some and start again")
    if status == 401:
        return ServiceError("failed_final", reason, fix=f"check the key in {key_variable or 'the environment'}")
    if status == 403:
        fix = f"the account may not use this model: verify the organisation with the provider, or set another {section}.model"
        return ServiceError("failed_final", reason, fix=fix)
    if status == 404:
        return ServiceError("failed_final", reason, fix=f"set {section}.model and {section}.base_url to what there is")
    if status in (408, 409, 429) or status >= 500:
        fix = "start the same command again later: what came is kept"
        return ServiceError("failed_retryable", reason, fix=fix, wait_s=wait_s)
    return ServiceError("failed_final", reason, fix=f"see the settings in conf/{section.partition('.')[0]}")


def retry_after_s(headers: Mapping[str, str]) -> float | None:
    """Seconds of a Retry-After header (or Retry-After-Ms); None without one that is a number."""
    for name, factor in (("retry-after-ms", 0.001), ("retry-after", 1.0)):
        try:
            return max(0.0, float(headers[name]) * factor)
        except (KeyError, ValueError):
            continue
    return None
