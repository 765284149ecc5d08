"""The pictures that a generator made for a round, as they came, and what became of the requests that made none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.store import (
    FACTS_NAME,
    RERUN,
    ArtifactError,
    check_inside,
    load_artifact,
    read_typed,
    refusing,
    save_artifact,
    sha256_of_bytes,
    write_json_atomic,
)
from sceneexpander.files import write_bytes_atomic

SCHEMA = "candidates/1"
Ending = Literal["candidate", "refused", "failed_retryable", "failed_final"]
_SUFFIXES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"RIFF": ".webp"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One picture. ``data`` is the file as it was received, ``name`` what it is called on the contact sheet."""

    data: bytes
    name: str
    provenance: Provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How one request ended, with the provider's own reason where there is no picture. ``sent`` is 0 for an answer that was kept."""

    number: int  # of the candidate that was asked for, from 0
    ending: Ending
    sent: int = 0
    reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateSet:
    """Everything that was made for a round. There is at least one candidate."""

    round: int
    candidates: tuple[Candidate, ...]
    outcomes: tuple[Outcome, ...] = ()

    def __post_init__(self) -> None:
        if not self.candidates:
            raise ValueError("there is no candidate")

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder: each picture as it is, with a JSON file beside it that says how it came to be."""
        records = []
        for index, candidate in enumerate(self.candidates):
            name = f"pictures/{index:03d}{_suffix(candidate.data)}"
            write_bytes_atomic(folder / name, candidate.data)
            write_json_atomic((folder / name).with_suffix(".json"), candidate.provenance)
            records.append(_Record(file=name, name=candidate.name, provenance=candidate.provenance))
        save_artifact(folder, SCHEMA, {"round": self.round, "records": records, "outcomes": self.outcomes}, {})

    @classmethod
    def load(cls, folder: Path) -> CandidateSet:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, _ = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        candidates = []
        for record in read.records:
            check_inside(record.file, folder)
            try:
                data = (folder / record.file).read_bytes()
            except OSError as error:
                raise ArtifactError(
                    f"cannot be read ({error.strerror})", where=folder / record.file, fix=RERUN
                ) from None
            if sha256_of_bytes(data) != record.provenance.sha256:
                raise ArtifactError("is not the picture that was made", where=folder / record.file, fix=RERUN)
            candidates.append(Candidate(data=data, name=record.name, provenance=record.provenance))
        with refusing(folder):
            return cls(round=read.round, candidates=tuple(candidates), outcomes=read.outcomes)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Record:
    file: str
    name: str
    provenance: Provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    round: int
    records: tuple[_Record, ...]
    outcomes: tuple[Outcome, ...] = ()


def _suffix(data: bytes) -> str:
    """For people who look into the folder: the bytes decide what a picture is."""
    return next((suffix for magic, suffix in _SUFFIXES.items() if data.startswith(magic)), ".img")
