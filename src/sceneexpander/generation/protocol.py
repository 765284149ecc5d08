"""What every image back-end looks like from outside."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.scene import RoundSpec
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.generation.config import GeneratorConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One answer of a back-end. ``data`` is the picture file as received."""

    data: bytes
    name: str  # as a file name
    provenance: Provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationContext:
    """Where a back-end may look for stored pictures. ``scene_folder`` is the user's folder with ``scene.yaml``."""

    scene_folder: Path
    round_number: int
    spec: RoundSpec
    config: GeneratorConfig


class ViewGenerator(Protocol):
    """Reference pictures and an instruction -> candidates. Secrets, if any, are read from the environment in `generate`, never kept."""

    def generate(self, references: ViewSet, prompt: str) -> list[Candidate]:
        """Make candidates.

        Args:
            references: the views so far, in order; the first one is the reference frame.
            prompt: the full instruction.

        Returns:
            At least one candidate, in a stable order; partial success keeps what succeeded.

        Raises:
            UserError: nothing can be delivered.
        """
        ...
