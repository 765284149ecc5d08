"""One judge: questions out of pictures, samples out of answers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sceneexpander.artifacts.judgement import Answered, Better, Criterion, Missing, PairSample, ScoreSample
from sceneexpander.errors import printable
from sceneexpander.judge.answers import PAIR_SCHEMA, SCORE_SCHEMA, PairAnswer, ScoreAnswer, read_answer
from sceneexpander.judge.config import ChatJudgeConfig, JudgeConfig
from sceneexpander.judge.rubric import pair_instructions, scoring_instructions
from sceneexpander.services.chat import Chat, ChatAnswer, ChatQuestion
from sceneexpander.services.pictures import SentPicture

Form = TypeVar("Form", ScoreAnswer, PairAnswer)

_SHOWN_OF_TEXT = 200  # characters of an answer that is none, for people


def make_judge(config: JudgeConfig, cache: Path, *, sleep: Callable[[float], None] = time.sleep) -> Judge | None:
    """The judge with these settings; None if nobody is to be asked. ``cache``: folder of answers, no stage's output."""
    if not isinstance(config, ChatJudgeConfig):
        return None
    return Judge(config=config, chat=Chat(config=config.chat, section="judge.chat", cache=cache, sleep=sleep))


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """See `make_judge`."""

    config: ChatJudgeConfig
    chat: Chat

    @property
    def title(self) -> str:
        """Who it is."""
        return f"{self.config.chat.model} ({self.chat.server})"

    def require(self) -> None:
        """Raise `UserError` if it could not be asked, or a prompt of the user's cannot be one. Sends nothing."""
        for criterion in self.config.named_files():
            scoring_instructions(self.config, criterion)  # type: ignore[arg-type]
        self.chat.require()

    def scene_question(self, criterion: Criterion, target: SentPicture, frames: Sequence[SentPicture]) -> ChatQuestion:
        """One criterion of one video."""
        return ChatQuestion(
            instructions=scoring_instructions(self.config, criterion),
            evidence=("Target picture:", target, *_sequence("Frame", frames)),
            name="score",
            schema=SCORE_SCHEMA,
        )

    def pair_question(
        self, criterion: Criterion, target: SentPicture, a: Sequence[SentPicture], b: Sequence[SentPicture]
    ) -> ChatQuestion:
        """One criterion of two videos."""
        return ChatQuestion(
            instructions=pair_instructions(self.config, criterion),
            evidence=(
                "Target picture:",
                target,
                *_sequence("Sequence A, frame", a),
                *_sequence("Sequence B, frame", b),
            ),
            name="comparison",
            schema=PAIR_SCHEMA,
        )

    def candidate_question(self, words: str, photos: Sequence[SentPicture], candidate: SentPicture) -> ChatQuestion:
        """A picture that was generated. ``words`` are the user's, and are quoted as JSON: they cannot end the quotation."""
        return ChatQuestion(
            instructions=scoring_instructions(self.config, "candidate"),
            evidence=(
                f"The request, quoted: {json.dumps(words, ensure_ascii=False)}",
                *_sequence("Photo", photos),
                "Proposed picture:",
                candidate,
            ),
            name="score",
            schema=SCORE_SCHEMA,
        )

    def score(self, question: ChatQuestion, *, what: str) -> tuple[ScoreSample, ...]:
        """Ask as often as configured. Raises `UserError` if somebody cannot be asked; what came before is kept."""
        return tuple(self._score(question, number, what=what) for number in range(self.config.samples))

    def compare(self, forward: ChatQuestion, backward: ChatQuestion, *, what: str) -> tuple[PairSample, ...]:
        """The same for a comparison in both orders: A is the first method in ``forward`` and the second in ``backward``."""
        samples = []
        for number in range(self.config.samples):
            there, there_better = self._compare(forward, number, swapped=False, what=what)
            back, back_better = self._compare(backward, number, swapped=True, what=what)
            samples.append(
                PairSample(forward=there, backward=back, forward_better=there_better, backward_better=back_better)
            )
        return tuple(samples)

    def missing_requests(self, questions: Sequence[ChatQuestion]) -> int:
        """How many requests asking all of these would send at least. Sends nothing."""
        numbers = range(self.config.samples)
        return sum(self.chat.kept(question, number) is None for question in questions for number in numbers)

    def _score(self, question: ChatQuestion, number: int, *, what: str) -> ScoreSample:
        answer = self.chat.ask(question, number, what=f"{what}, sample {number + 1} of {self.config.samples}")
        read = _read(ScoreAnswer, answer)
        if not isinstance(read, ScoreAnswer):
            missing, said = read
            return ScoreSample(answered=self._answered(question, number, answer, said, missing))
        answered = self._answered(question, number, answer, read.reason)
        return ScoreSample(answered=answered, score=read.score, confidence=read.confidence)

    def _compare(
        self, question: ChatQuestion, number: int, *, swapped: bool, what: str
    ) -> tuple[Answered, Better | None]:
        answer = self.chat.ask(question, number, what=f"{what}, sample {number + 1} of {self.config.samples}")
        read = _read(PairAnswer, answer)
        if not isinstance(read, PairAnswer):
            missing, said = read
            return self._answered(question, number, answer, said, missing), None
        better: dict[str, Better] = {"A": "second", "B": "first"} if swapped else {"A": "first", "B": "second"}
        return self._answered(question, number, answer, read.reason), better.get(read.better, "equal")

    def _answered(
        self, question: ChatQuestion, number: int, answer: ChatAnswer, said: str, missing: Missing | None = None
    ) -> Answered:
        return Answered(
            request=self.chat.name_of(question),
            number=number,
            model=printable(answer.model),
            request_id=None if answer.request_id is None else printable(answer.request_id),
            created=answer.created,
            usage=answer.usage,
            missing=missing,
            said=printable(said),
        )


def _read(form: type[Form], answer: ChatAnswer) -> Form | tuple[Missing, str]:
    """The answer, or why it counts as missing."""
    if answer.refused is not None:
        return "refused", answer.refused
    if answer.text is None:
        return "malformed", "the answer is empty"
    try:
        return read_answer(form, answer.text)
    except ValueError as error:
        return "malformed", f"{error}: {answer.text[:_SHOWN_OF_TEXT]}"


def _sequence(title: str, pictures: Sequence[SentPicture]) -> list[str | SentPicture]:
    parts: list[str | SentPicture] = []
    for number, picture in enumerate(pictures, start=1):
        parts += [f"{title} {number} of {len(pictures)}:", picture]
    return parts
