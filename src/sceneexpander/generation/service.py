"""What all image services have in common: the cache, and the record of each picture. How they are asked: `sceneexpander.services`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Protocol

from sceneexpander.artifacts.candidates import Candidate, CandidateSet, Outcome
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
from sceneexpander.generation.spending import SceneBudget, read_spent, spent_ledger
from sceneexpander.ingest.decode import decode_picture
from sceneexpander.services.transport import Budget, ServiceError, ask_patiently, safe_text

logger = logging.getLogger(__name__)
MAX_MEGAPIXELS = 40.0  # of an answer: no service is asked for as much


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
        cache, budget = self._cache(context), self._budget(context)
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

    def _budget(self, context: GenerationContext) -> SceneBudget:
        config = self.config
        return SceneBudget(
            ledger=spent_ledger(context),
            max_scene_requests=config.max_scene_requests,
            max_scene_cost_usd=config.max_scene_cost_usd,
            section="generator",
            thing="picture",
            max_requests=config.max_requests,
            max_cost_usd=config.max_cost_usd,
            price_usd=config.price_usd,
        )

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

    def _answered(self, question: Question, budget: Budget, *, of: int) -> Answer:
        """The answer to one question, a refusal included. Raises `ServiceError`."""
        what = f"candidate {question.number + 1} of {of}"
        started = time.monotonic()

        def ask() -> Answer:
            reply = self.service.ask(question)
            return Answer(data=reply.data, provenance=self._provenance(question, reply))

        try:
            answer = ask_patiently(
                ask,
                what=what,
                attempts=self.config.attempts,
                budget=budget,
                secrets=self.service.secrets(),
                sleep=self.sleep,
            )
        except ServiceError as error:
            if error.ending != "refused":
                raise
            return Answer(refused=self._safe(error.reason))
        logger.info("%s came after %.0f s", what, time.monotonic() - started)
        return answer

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
        return safe_text(text, self.service.secrets())


def plain_settings(config: ServiceConfig, *names: str) -> dict[str, Any]:
    """The named settings, as `Service.identity` wants them."""
    values: dict[str, Any] = to_plain(config)
    return {name: values[name] for name in names}
