"""What a vision-language model says about a round's renders. What it did not say is missing, never low."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from sceneexpander.artifacts.store import read_json, read_typed, write_json_atomic

SCHEMA = "judgement/1"
FILE_NAME = "judge.json"
NO_JUDGE: Final = "no judge"
NOT_APPLICABLE: Final = "–"
REQUESTS = "requests"
Criterion = Literal["insertion", "quality", "candidate"]
SCENE_CRITERIA: tuple[Criterion, ...] = ("insertion", "quality")
CRITERION_TITLES = {"insertion": "insertion satisfaction", "quality": "render quality"}
Missing = Literal["refused", "malformed"]
Better = Literal["first", "second", "equal"]
LOWEST_SCORE, HIGHEST_SCORE = 1.0, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """Where one answer comes from.

    Attributes:
        request: names the request, which is kept beside the judgement as ``requests/<request>.json``.
        number: of the sample: the same request is asked several times.
        model: as the server calls what answered.
        request_id: the server's name of the request.
        created: when the answer came, UTC (ISO 8601).
        usage: what the server counted, e.g. tokens.
        missing: why nothing was said that counts; None: something was.
        said: the model's reason, or what it said instead of an answer.
    """

    request: str
    number: int
    model: str
    created: str
    said: str
    request_id: str | None = None
    usage: dict[str, int] = field(default_factory=dict)
    missing: Missing | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreSample:
    """One score in [1, 5], in halves, and the model's confidence in [0, 1]; both None if it is missing."""

    answered: Answered
    score: float | None = None
    confidence: float | None = None

    def __post_init__(self) -> None:
        if (self.score is None) != (self.answered.missing is not None):
            raise ValueError("a sample has a score or says why it has none")


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodScore:
    """One criterion of one method. ``frames`` are the frames of its video that were shown."""

    method: str
    criterion: Criterion
    frames: tuple[int, ...]
    samples: tuple[ScoreSample, ...]

    @property
    def scores(self) -> tuple[float, ...]:
        """Those that were given."""
        return tuple(sample.score for sample in self.samples if sample.score is not None)

    @property
    def mean(self) -> float | None:
        """Over the scores that were given; None without any."""
        return statistics.fmean(self.scores) if self.scores else None

    @property
    def spread(self) -> float | None:
        """Standard deviation (n - 1) of the scores; None for fewer than two."""
        return statistics.stdev(self.scores) if len(self.scores) > 1 else None

    @property
    def text(self) -> str:
        """E.g. ``3.50 ± 0.50``, ``4.00 (1/3)`` where others are missing, ``missing (3 refused)``."""
        if self.mean is None:
            why = Counter(sample.answered.missing for sample in self.samples)
            return f"missing ({', '.join(f'{count} {reason}' for reason, count in sorted(why.items(), key=str))})"
        text = f"{self.mean:.2f}" + ("" if self.spread is None else f" ± {self.spread:.2f}")
        return text if len(self.scores) == len(self.samples) else f"{text} ({len(self.scores)}/{len(self.samples)})"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSample:
    """Both orders of one comparison: ``forward`` with the first method shown as A, ``backward`` with it shown as B.

    ``better`` is what both orders agree on. Where they contradict each other, the place decided and not the picture: ``equal``.
    None if one of the two is missing.
    """

    forward: Answered
    backward: Answered
    forward_better: Better | None = None
    backward_better: Better | None = None

    def __post_init__(self) -> None:
        for answered, better in ((self.forward, self.forward_better), (self.backward, self.backward_better)):
            if (better is None) != (answered.missing is not None):
                raise ValueError("a comparison has a result or says why it has none")

    @property
    def better(self) -> Better | None:
        """See the class."""
        if self.forward_better is None or self.backward_better is None:
            return None
        return self.forward_better if self.forward_better == self.backward_better else "equal"


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two methods side by side by one criterion."""

    first: str
    second: str
    criterion: Criterion
    samples: tuple[PairSample, ...]

    @property
    def text(self) -> str:
        """E.g. ``first 2, second 0, equal 1 of 3``; what is missing makes the numbers' sum smaller."""
        count = Counter(sample.better for sample in self.samples)
        return f"first {count['first']}, second {count['second']}, equal {count['equal']} of {len(self.samples)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedRound:
    """All that was judged in a round. ``judge`` is what the configuration asked; None: nobody, and there are no scores.

    ``unavailable`` is why a method could not be run, by its name: it has no renders and no scores.
    """

    scene: str
    round: int
    judge: str | None = None
    scores: tuple[MethodScore, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    unavailable: dict[str, str] = field(default_factory=dict)

    def score(self, method: str, criterion: Criterion) -> MethodScore | None:
        """Of one method by one criterion; None if it was not judged."""
        found = (score for score in self.scores if (score.method, score.criterion) == (method, criterion))
        return next(found, None)

    def text(self, method: str, criterion: Criterion) -> str:
        """What a table says in the place of the method's score."""
        if self.judge is None:
            return NO_JUDGE
        score = self.score(method, criterion)
        return self.unavailable.get(method, NOT_APPLICABLE) if score is None else score.text

    def save(self, folder: Path, requests: Mapping[str, object]) -> None:
        """Write into a (scratch) folder, with every request by its name; pictures in it stand as hashes of their pixels."""
        for name, request in requests.items():
            write_json_atomic(folder / REQUESTS / f"{name}.json", request)
        write_json_atomic(folder / FILE_NAME, {"schema": SCHEMA, "judged": self})

    @classmethod
    def load(cls, folder: Path) -> JudgedRound:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        path = folder / FILE_NAME
        return read_typed(_File, read_json(path), path).judged


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    schema: Literal["judgement/1"]
    judged: JudgedRound
