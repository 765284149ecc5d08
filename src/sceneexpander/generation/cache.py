"""Answers that were paid for, kept by what was asked: no rerun pays for the same picture twice.

The folder belongs to the project, not to a stage, so it outlives forced reruns, killed ones and deleted outputs. Below it,
``<question>/<request>/``: the question is everything but the pictures that were shown, the request is all of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.store import (
    FACTS_NAME,
    ArtifactError,
    load_artifact,
    read_typed,
    save_artifact,
    sha256_of_bytes,
)
from sceneexpander.files import directory_being_written, write_bytes_atomic
from sceneexpander.services.kept import digest_of

SCHEMA = "answer/1"
_PICTURE = "picture"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """A picture (``data``) with its record, or a refusal (``refused``)."""

    data: bytes | None = None
    provenance: Provenance | None = None
    refused: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerCache:
    """Answers to one question, by the pictures that were shown with it and the candidate's number."""

    folder: Path

    @classmethod
    def of(cls, root: Path, question: Mapping[str, object]) -> AnswerCache:
        """The part of the cache that belongs to a question: back-end, model, parameters, words."""
        return cls(folder=root / digest_of(question))

    def count(self) -> int:
        """How many answers there are at least, whatever was shown."""
        return sum(1 for _ in self.folder.glob(f"*/{FACTS_NAME}"))

    def get(self, references: Mapping[str, str], number: int) -> Answer | None:
        """The kept answer; None if there is none, or it is damaged."""
        place = self._place(references, number)
        if not (place / FACTS_NAME).is_file():
            return None
        try:
            facts, _ = load_artifact(place, SCHEMA)
            read = read_typed(_Facts, facts, place / FACTS_NAME)
            if read.provenance is None:
                return Answer(refused=read.refused)
            data = (place / _PICTURE).read_bytes()
        except (ArtifactError, OSError):
            return None
        if sha256_of_bytes(data) != read.provenance.sha256:
            return None
        return Answer(data=data, provenance=read.provenance)

    def put(self, references: Mapping[str, str], number: int, answer: Answer) -> None:
        """Keep an answer, whole or not at all."""
        with directory_being_written(self._place(references, number)) as folder:
            if answer.data is not None:
                write_bytes_atomic(folder / _PICTURE, answer.data)
            save_artifact(folder, SCHEMA, {"provenance": answer.provenance, "refused": answer.refused}, {})

    def _place(self, references: Mapping[str, str], number: int) -> Path:
        # Sorted: which of the same views comes first may hang on the last digit of an estimated camera.
        return self.folder / digest_of({"references": sorted(references.values()), "number": number})


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    provenance: Provenance | None
    refused: str | None
