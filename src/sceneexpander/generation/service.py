"""What all image services have in common: the cache, the budget, what is tried again and what is not, and the record of each picture.

Every request ends in one of four ways: a candidate; *refused* (the provider will not draw this: never asked again by itself); *failed,
retryable* (asked again a few times, then given up); *failed, final* (nothing would come of asking again).
"""

from __future__ import annotations

import logging
import random
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Thread
from typing import Any, Protocol

from sceneexpander.artifacts.candidates import Candidate, CandidateSet, Ending, Outcome
from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.source_type import MADE_BY_MODEL
from sceneexpander.artifacts.store import sha256_of_bytes, to_plain
from sceneexpander.errors import UserError, printable
from sceneexpander.generation.cache import Answer, AnswerCache
from sceneexpander.generation.checks import check_content
from sceneexpander.generation.config import ServiceConfig
from sceneexpander.generation.prompt import fill_prompt
from sceneexpander.generation.protocol import Forecast, GenerationContext, SceneSoFar
from sceneexpander.generation.references import Reference, choose_references
from sceneexpander.ingest.decode import decode_picture

logger = logging.getLogger(__name__)
MAX_MEGAPIXELS = 40.0  # of an answer: no service is asked for as much
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0  # between two tries, doubled each time
_LONGEST_ASKED_WAIT_S = 300.0  # a service that wants more than that is as good as down
_SIGN_OF_LIFE_S = 15.0
_MAX_REASON = 300
_KEY_SHAPED = re.compile(r"\b(?:sk|pk|key|AIza)[-_]?[A-Za-z0-9_*-]{6,}")


class ServiceError(Exception):
    """A request that made no picture.

    Args:
        ending: how it ends.
        reason: the provider's own, in its words.
        fix: what the user can do about it.
        wait_s: how long the provider asks to wait before the next try; None: it does not say.
    """

    def __init__(self, ending: Ending, reason: str, *, fix: str = "", wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.ending = ending
        self.reason = reason
        self.fix = fix
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What a service is asked for one picture. ``height`` and ``width`` are those of the captured frame, for its ratio."""

    prompt: str
    references: tuple[Reference, ...]
    number: int
    height: int
    width: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """A picture as it was received, and what the service says about it."""

    data: bytes
    model: str
    request_id: str | None = None
    usage: Mapping[str, int] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)


class Service(Protocol):
    """One provider's way of asking."""

    def require(self) -> None:
        """Raise `UserError` if it could not be asked: a package or a key is missing. Sends nothing."""
        ...

    def identity(self) -> Mapping[str, object]:
        """What makes an answer another one: address, model, parameters. Never a secret."""
        ...

    def secrets(self) -> tuple[str, ...]:
        """What must not be written anywhere."""
        ...

    def ask(self, question: Question) -> Reply:
        """Send one request. Raises `ServiceError`."""
        ...


@dataclass(frozen=True, slots=True)
class ServiceGenerator:
    """A `ViewGenerator` on top of a service. ``sleep`` waits between tries."""

    config: ServiceConfig
    service: Service
    sleep: Callable[[float], None] = time.sleep

    def check(self, context: GenerationContext) -> Forecast:
        """Count what is not in the cache yet; nothing is sent. See `ViewGenerator`."""
        missing = max(0, self.config.candidates - self._cache(context).count())
        if missing:
            self.service.require()
        price, spent = self.config.price_usd, read_spent(spent_ledger(context))
        shown = min(self.config.max_references, len(context.captured) + context.round_number - 1)
        notes = (
            f"shows the {shown} views nearest to where the motion leads, at most {self.config.reference_side_px} px long",
            *([f"{len(spent)} requests were sent for this scene before"] if spent else []),
        )
        return Forecast(
            prompt=fill_prompt(context.spec),
            requests=missing,
            cost_usd=None if price is None else price * missing,
            notes=notes,
        )

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """One request per candidate that is not in the cache; see `ViewGenerator`."""
        config = self.config
        references = choose_references(
            context, so_far, limit=config.max_references, long_side_px=config.reference_side_px
        )
        keys = {reference.view_id: reference.pixels_sha256 for reference in references}
        cache, budget = self._cache(context), _Budget(config, spent_ledger(context))
        candidates: list[Candidate] = []
        outcomes: list[Outcome] = []
        errors: list[ServiceError] = []
        for number in range(config.candidates):
            kept = cache.get(keys, number)
            sent_before = budget.sent
            try:
                if kept is None:
                    question = Question(
                        prompt=fill_prompt(context.spec),
                        references=references,
                        number=number,
                        height=context.captured.height,
                        width=context.captured.width,
                    )
                    kept = self._answered(question, budget, of=config.candidates)
                    cache.put(keys, number, kept)
                if kept.data is None or kept.provenance is None:
                    fix = "change the words, or ask again with another generator.take"
                    raise ServiceError("refused", kept.refused or "refused", fix=fix)
            except ServiceError as error:
                reason = self._safe(error.reason)
                logger.warning("candidate %d: %s: %s", number, error.ending.replace("_", ", "), reason)
                outcomes.append(
                    Outcome(number=number, ending=error.ending, sent=budget.sent - sent_before, reason=reason)
                )
                errors.append(error)
                if error.ending == "failed_final":
                    break  # what is wrong is wrong with all of them
                continue
            outcomes.append(Outcome(number=number, ending="candidate", sent=budget.sent - sent_before))
            candidates.append(Candidate(data=kept.data, name=f"{config.backend} {number}", provenance=kept.provenance))
        if not candidates:
            raise UserError(
                self._safe(errors[0].reason), where=f"generator {config.backend}", fix=errors[0].fix or None
            )
        return CandidateSet(round=context.round_number, candidates=tuple(candidates), outcomes=tuple(outcomes))

    def _cache(self, context: GenerationContext) -> AnswerCache:
        config = self.config
        question = {
            "backend": config.backend,
            "service": self.service.identity(),
            "prompt": fill_prompt(context.spec),
            "take": config.take,
            "ratio": [context.captured.height, context.captured.width],
            "reference_side_px": config.reference_side_px,
        }
        return AnswerCache.of(context.cache, question)

    def _answered(self, question: Question, budget: _Budget, *, of: int) -> Answer:
        """The answer to one question, after as many tries as it takes and the settings allow. Raises `ServiceError`."""
        for attempt in range(self.config.attempts):
            budget.spend()
            started = time.monotonic()
            try:
                with _signs_of_life(f"candidate {question.number + 1} of {of}"):
                    reply = self.service.ask(question)
                answer = Answer(data=reply.data, provenance=self._provenance(question, reply))
                logger.info("candidate %d of %d came after %.0f s", question.number + 1, of, time.monotonic() - started)
                return answer
            except ServiceError as error:
                if error.ending == "refused":
                    return Answer(refused=self._safe(error.reason))
                if error.ending == "failed_final" or attempt + 1 == self.config.attempts:
                    raise
                wait = error.wait_s
                if wait is not None and wait > _LONGEST_ASKED_WAIT_S:
                    raise ServiceError(
                        "failed_final", f"{error.reason} (wants {wait:.0f} s of waiting)", fix="start again later"
                    ) from None
                backoff = min(_LONGEST_WAIT_S, _FIRST_WAIT_S * 2**attempt)
                # Jitter keeps jobs of a sweep apart; it decides nothing about the result.
                wait = backoff * random.uniform(0.5, 1) if wait is None else wait  # noqa: S311
                logger.warning("%s; trying again in %.1f s", self._safe(error.reason), wait)
                self.sleep(wait)
        raise AssertionError("the last attempt returns or raises")

    def _provenance(self, question: Question, reply: Reply) -> Provenance:
        """The record of an answer, which is looked at first. Raises `ServiceError` if it is no picture."""
        try:
            picture = decode_picture(reply.data, name="answer", where="the answer", max_megapixels=MAX_MEGAPIXELS)
            check_content(picture, "the answer")
        except UserError as error:
            problem = f"the answer {error.problem}"
            raise ServiceError(
                "failed_final", problem, fix="look at the service's own log, or use another model"
            ) from None
        parameters = {name: printable(str(value)) for name, value in reply.parameters.items()}
        return Provenance(
            backend=self.config.backend,
            prompt=question.prompt,
            source=reply.model,
            sha256=sha256_of_bytes(reply.data),
            reference_sha256=tuple(reference.record_sha256 for reference in question.references),
            parameters={name: self._safe(value) for name, value in parameters.items()},
            request_id=reply.request_id,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            usage=dict(reply.usage),
            cost_usd=self.config.price_usd,
            digital_source_type=MADE_BY_MODEL,
        )

    def _safe(self, text: str) -> str:
        """Without anything that is a secret, or looks like one: services like to repeat the key that they were given."""
        for secret in self.service.secrets():
            text = text.replace(secret, "***")
        return " ".join(_KEY_SHAPED.sub("***", text).split())[:_MAX_REASON]


@dataclass(slots=True)
class _Budget:
    """Looked at before anything is sent. ``ledger``: a line for every request that was ever sent for the scene, in whatever round."""

    config: ServiceConfig
    ledger: Path
    sent: int = 0

    def spend(self) -> None:
        """Count one request. Raises `ServiceError` if it is one too many."""
        config, price = self.config, self.config.price_usd or 0.0
        prices = read_spent(self.ledger)
        limits = (
            (self.sent + 1 > config.max_requests, "generator.max_requests", f"{self.sent} requests were sent"),
            (
                _beyond((self.sent + 1) * price, config.max_cost_usd),
                "generator.max_cost_usd",
                "the round is paid up to it",
            ),
            (
                config.max_scene_requests is not None and len(prices) + 1 > config.max_scene_requests,
                "generator.max_scene_requests",
                f"{len(prices)} requests were sent for the scene so far",
            ),
            (
                _beyond(sum(prices) + price, config.max_scene_cost_usd),
                "generator.max_scene_cost_usd",
                f"pictures for {sum(prices):.2f} USD were asked for so far",
            ),
        )
        for reached, name, so_far in limits:
            if reached:
                problem = f"{so_far}: one more is beyond {name}"
                raise ServiceError("failed_final", problem, fix="raise it and start again: what came is kept")
        self.sent += 1
        # Before the request: one that is killed on its way is paid for, too.
        self.ledger.parent.mkdir(parents=True, exist_ok=True)
        with self.ledger.open("a", encoding="utf-8") as file:
            file.write(f"{price!r}\n")


def _beyond(cost: float, limit: float | None) -> bool:
    return limit is not None and cost > limit + 1e-9


def spent_ledger(context: GenerationContext) -> Path:
    """The file that remembers the requests sent for a scene."""
    return context.cache / "spent" / f"{context.scene}.txt"


def read_spent(ledger: Path) -> list[float]:
    """Prices (USD, 0 where none was configured) of all requests in a ledger. Raises `UserError` for a damaged one."""
    if not ledger.is_file():
        return []
    try:
        return [float(line) for line in ledger.read_text(encoding="utf-8").split()]
    except ValueError:
        fix = "remove it to start counting anew"
        raise UserError("is damaged, so what was spent is not known", where=ledger, fix=fix) from None


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


def http_error(status: int, code: str, message: str, *, key_variable: str | None, wait_s: float | None) -> ServiceError:
    """What an HTTP status and the provider's own code mean for a request.

    Refusals are what is said to be one by its code, never guessed from words.
    """
    reason = f"{message or 'no reason given'} (HTTP {status}{f', {code}' if code else ''})"
    if code in ("moderation_blocked", "content_policy_violation", "image_generation_user_error"):
        return ServiceError("refused", reason)
    if code == "insufficient_quota" or status == 402:
        return ServiceError("failed_final", reason, fix="the account has no credit left: add some and start again")
    if status == 401:
        return ServiceError("failed_final", reason, fix=f"check the key in {key_variable or 'the environment'}")
    if status == 403:
        fix = "the account may not use this model: verify the organisation with the provider, or set another generator.model"
        return ServiceError("failed_final", reason, fix=fix)
    if status == 404:
        return ServiceError("failed_final", reason, fix="set generator.model and generator.base_url to what there is")
    if status in (408, 409, 429) or status >= 500:
        fix = "start the same command again later: what came is kept"
        return ServiceError("failed_retryable", reason, fix=fix, wait_s=wait_s)
    return ServiceError("failed_final", reason, fix="see the settings in conf/generator")


def retry_after_s(headers: Mapping[str, str]) -> float | None:
    """Seconds of a Retry-After header (or Retry-After-Ms); None without one that is a number."""
    for name, factor in (("retry-after-ms", 0.001), ("retry-after", 1.0)):
        try:
            return max(0.0, float(headers[name]) * factor)
        except (KeyError, ValueError):
            continue
    return None


def plain_settings(config: ServiceConfig, *names: str) -> dict[str, Any]:
    """The named settings, as `Service.identity` wants them."""
    values: dict[str, Any] = to_plain(config)
    return {name: values[name] for name in names}
