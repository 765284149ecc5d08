"""What every image back-end looks like from outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sceneexpander.artifacts.candidates import Candidate, CandidateSet
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.generation.config import GeneratorConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationContext:
    """What is known of a round before anything runs.

    Attributes:
        scene_folder: the user's folder with ``scene.yaml``.
        scene: the scene's name.
        round_number: from 1.
        spec: the user's words.
        captured: the photos, as prepared.
        cache: folder of answers that were paid for, by content; shared by all runs of a project, and no stage's output.
        recorded: folder that the path of a recorded picture is relative to; None: the user's.
    """

    scene_folder: Path
    scene: str
    round_number: int
    spec: RoundSpec
    captured: ViewSet
    cache: Path
    recorded: Path | None = None

    @property
    def where(self) -> str:
        """The round, for messages."""
        return f"round {self.round_number} of {self.scene_folder}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneSoFar:
    """What a round starts from: the views so far, inserted ones included, and what was reconstructed of them."""

    views: ViewSet
    reconstruction: Reconstruction
    known: KnownCameras | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """What a back-end would do for a round, found out for nothing.

    Attributes:
        prompt: the text that would be sent, or that belongs to pictures which are there.
        requests: how many it would send at least, none of which has an answer yet.
        cost_usd: of these; None: no price is configured.
        stored: the pictures, where they are there already.
        notes: what else a user may want to know before.
        warnings: those of them that every run says.
    """

    prompt: str
    requests: int = 0
    cost_usd: float | None = 0.0
    stored: tuple[Candidate, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class ViewGenerator(Protocol):
    """Views and an instruction -> candidates. Secrets are read from the environment where they are needed, and never kept."""

    def check(self, context: GenerationContext) -> Forecast:
        """Find out what can be known before anything runs: free, offline, and without a request.

        Raises:
            UserError: the round cannot be served: words, a key, a package, a file are missing.
        """
        ...

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """Make candidates; what costs something is asked for once, see `GenerationContext.cache`.

        Raises:
            UserError: nothing can be delivered. What was delivered before stays.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Backend:
    """A way to get pictures: the type of its settings and what is made of them.

    ``takes_recorded``: it uses the pictures that the rounds in ``scene.yaml`` name.
    """

    config: type[GeneratorConfig]
    make: Callable[[Any], ViewGenerator]
    takes_recorded: bool = False
