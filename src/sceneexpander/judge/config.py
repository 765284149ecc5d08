"""Who judges, by which words, and what is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sceneexpander.artifacts.judgement import Criterion
from sceneexpander.ranges import Range, check_ranges
from sceneexpander.services.chat import ChatConfig

NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeConfig:
    """What all judges share. Which type the section has is decided by ``backend``: ``none`` or ``openai``."""

    backend: str

    def named_files(self) -> dict[str, Path]:
        """The user's own prompts, by criterion."""
        return {}

    @classmethod
    def family(cls) -> tuple[str, Mapping[str, type]]:
        """The key that tells the members apart, and the members by its value; see `sceneexpander.typed`."""
        return "backend", {NONE: NoJudgeConfig, "openai": ChatJudgeConfig}


@dataclass(frozen=True, slots=True, kw_only=True)
class NoJudgeConfig(JudgeConfig):
    """Nobody is asked."""

    backend: str = NONE


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatJudgeConfig(JudgeConfig):
    """A chat model that sees pictures: OpenAI's, or of any server that speaks its protocol.

    Attributes:
        chat: the model, and what asking may cost.
        samples: how often each question is asked; the spread over them is reported.
        frames: of a video that are shown, one more where the inserted camera is not among them.
        picture_side_px: long side of pictures as they are sent.
        compare_with: a method that each other one is compared with, side by side in both orders; null: no comparisons.
        candidates: whether ``choose.candidate=auto`` asks too.
        candidate_weight: of the judge in the ranking of candidates; the rest is that of what is measured.
        insertion_prompt: file with your own rubric of insertion satisfaction; null: the built-in one.
        quality_prompt: the same of render quality.
    """

    backend: str = "openai"
    chat: ChatConfig
    samples: Annotated[int, Range(1, 100)]
    frames: Annotated[int, Range(2, 64)]
    picture_side_px: Annotated[int, Range(64, 4096)]
    compare_with: str | None
    candidates: bool
    candidate_weight: Annotated[float, Range(0, 1)]
    insertion_prompt: str | None
    quality_prompt: str | None

    def __post_init__(self) -> None:
        check_ranges(self)

    def named_files(self) -> dict[str, Path]:
        """See `JudgeConfig`."""
        named: dict[Criterion, str | None] = {"insertion": self.insertion_prompt, "quality": self.quality_prompt}
        return {criterion: Path(given).expanduser() for criterion, given in named.items() if given is not None}
