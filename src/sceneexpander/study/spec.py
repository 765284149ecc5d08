"""What a researcher writes: ``study.yaml``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated

from sceneexpander.errors import UserError
from sceneexpander.ranges import Range, check_ranges
from sceneexpander.typed import DecodeError, decode_dataclass
from sceneexpander.yamlfile import read_user_yaml

LETTERS = "ABCDEFGHIJ"
MOST_METHODS = len(LETTERS)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,63}")


class Criterion(Enum):
    """What is ranked; the paper's H-IS and H-RQ (Sec. "User Study Details")."""

    INSERTION = "insertion_satisfaction"
    QUALITY = "render_quality"

    @property
    def column(self) -> str:
        """The column of the paper's table."""
        return "H-IS" if self is Criterion.INSERTION else "H-RQ"


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """The heading of a screen, and what it asks for."""

    title: str
    text: str


_INSERTION = Question(
    title="How well was the request carried out?",
    text="Rank the videos by what the request asked for: is the new content or the new place there, as it was described, and does "
    "it belong to the scene? Leave blur, noise and flicker aside; the next or the previous screen asks about them.",
)
_QUALITY = Question(
    title="How good do the videos look?",
    text="Rank the videos by how they look as a whole, all the way through: clear and stable comes first; double contours, noise, "
    "holes, smears and bent shapes come last. Whether the request was carried out does not matter on this screen.",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Questions:
    """The words of both screens."""

    insertion_satisfaction: Question = _INSERTION
    render_quality: Question = _QUALITY

    def of(self, criterion: Criterion) -> Question:
        """The question about a criterion."""
        return self.insertion_satisfaction if criterion is Criterion.INSERTION else self.render_quality


@dataclass(frozen=True, slots=True, kw_only=True)
class CatchRule:
    """Screens whose right answer is known: one video in steps of growing noise, the last one nothing but noise.

    Attributes:
        scenes: how many such scenes everybody sees, each under both criteria; 0: none.
        minimum_tau: Kendall's tau between answer and truth from which a screen counts as passed. Guessing passes the default with five
            videos in 12 % of the cases, both screens in 1.4 %.
        allowed_failures: screens that a participant may fail without being excluded.
    """

    scenes: Annotated[int, Range(0, 10)] = 1
    minimum_tau: Annotated[float, Range(-1, 1)] = 0.6
    allowed_failures: Annotated[int, Range(0, 20)] = 0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneSpec:
    """One finished scene.

    Attributes:
        name: for the results; participants do not see it.
        prompt: the request, as participants read it.
        picture: the inserted picture, shown beside the request; None: words alone.
        videos: by method.
        folder: ``outputs/<scene>`` of the pipeline, from which prompt, picture and videos are taken unless they are given.
        round: of the folder.
    """

    name: str
    prompt: str = ""
    picture: Path | None = None
    videos: dict[str, Path] = field(default_factory=dict)
    folder: Path | None = None
    round: Annotated[int, Range(1, 1000)] = 1

    def __post_init__(self) -> None:
        check_ranges(self)
        _check_name("name", self.name)
        if not self.videos and self.folder is None:
            raise UserError("are missing", where="videos", fix="give a video for each method, or the scene's folder")
        if not self.prompt.strip() and self.folder is None:
            raise UserError("is missing", where="prompt", fix="participants judge by it")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudySpec:
    """The whole file.

    Attributes:
        title: heading of the pages.
        contact: who answers questions: name and address.
        consent: what participants agree to; blank lines separate paragraphs.
        participants: number of pages.
        methods: what is compared; empty: the methods of the first scene's videos.
        scenes: in any order.
        seed: of orders and catch videos. Tokens and file names are secrets and never the same twice.
        minimum_s: seconds for which a screen must have been open before its answer is taken.
        catch: screens with a known answer.
        questions: own words instead of the default ones.
    """

    title: str
    contact: str
    consent: str
    participants: Annotated[int, Range(1, 10_000)]
    scenes: tuple[SceneSpec, ...]
    methods: tuple[str, ...] = ()
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    minimum_s: Annotated[float, Range(0, 3600)] = 15.0
    catch: CatchRule = CatchRule()
    questions: Questions = Questions()

    def __post_init__(self) -> None:
        check_ranges(self)
        for name in ("title", "contact", "consent"):
            if not getattr(self, name).strip():
                raise UserError("is empty", where=name)
        if not self.scenes:
            raise UserError("is empty", where="scenes")
        names = [scene.name for scene in self.scenes]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"holds {name!r} twice", where="scenes")
        compared = self.compared
        if not 2 <= len(compared) <= MOST_METHODS:
            raise UserError(f"are {len(compared)}, must be from 2 to {MOST_METHODS}", where="methods")
        for method in compared:
            _check_name("methods", method)
            if compared.count(method) > 1:
                raise UserError(f"holds {method!r} twice", where="methods")
        for index, scene in enumerate(self.scenes):
            lacking = [method for method in compared if method not in scene.videos]
            if scene.folder is None and lacking:
                raise UserError(
                    f"scene {scene.name!r} has no video of {lacking[0]!r}",
                    where=f"scenes[{index}]",
                    fix="every scene needs one of each method",
                )
            unknown = sorted(set(scene.videos) - set(compared))
            if unknown:
                raise UserError(
                    f"scene {scene.name!r} has a video of {unknown[0]!r}, which is not compared",
                    where=f"scenes[{index}]",
                    fix="list it under methods, or remove it",
                )

    @property
    def compared(self) -> tuple[str, ...]:
        """The methods, in the order of the tables."""
        return self.methods or tuple(self.scenes[0].videos)

    @property
    def worst_guess(self) -> float:
        """Share of random answers that pass a catch screen."""
        pairs = math.comb(len(self.compared), 2)
        allowed = math.floor((1 - self.catch.minimum_tau) / 2 * pairs + 1e-9)
        counts = [1]  # of permutations by number of inversions
        for size in range(2, len(self.compared) + 1):
            counts = [sum(counts[max(0, n - size + 1) : n + 1]) for n in range(len(counts) + size - 1)]
        return sum(counts[: allowed + 1]) / math.factorial(len(self.compared))


def _check_name(where: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise UserError(f"is {name!r}", where=where, fix="letters, digits, '_', '-', '+' and '.', at most 64")


def read_spec(path: Path) -> StudySpec:
    """Read ``study.yaml``; paths in it are relative to its folder.

    Raises:
        UserError: it is no such file, or something in it is missing, unknown or impossible; names the key.
    """
    raw = read_user_yaml(path, sentences=("title", "contact", "prompt", "text"))
    try:
        return decode_dataclass(StudySpec, raw)
    except DecodeError as error:
        raise UserError(f"{error.where}: {error.problem}", where=path, fix=error.fix) from None
