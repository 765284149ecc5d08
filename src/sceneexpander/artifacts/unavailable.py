"""A result that could not be made, and why. It stands where the result would be, so that tables say the reason instead of a number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_json, read_typed, save_artifact
from sceneexpander.files import directory_being_written

SCHEMA = "unavailable/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Unavailable:
    """``reason`` completes the sentence "this row ...", e.g. "needs the public checkpoint"."""

    method: str
    model: str
    reason: str

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        save_artifact(folder, SCHEMA, {"method": self.method, "model": self.model, "reason": self.reason}, {})

    @classmethod
    def load(cls, folder: Path) -> Unavailable:
        """Read what `save` wrote."""
        facts, _ = load_artifact(folder, SCHEMA)
        return read_typed(cls, facts, folder / FACTS_NAME)


def unavailable_in(folder: Path) -> Unavailable | None:
    """What is said in place of the artefact in ``folder``, or None if the artefact itself is there.

    Raises:
        ArtifactError: there is neither.
    """
    facts = read_json(folder / FACTS_NAME)
    return Unavailable.load(folder) if isinstance(facts, dict) and facts.get("schema") == SCHEMA else None


def passed_on(source: Path, target: Path) -> bool:
    """If ``source`` holds a reason instead of a result, write the same reason as ``target``; whether that was so."""
    lacking = unavailable_in(source)
    if lacking is None:
        return False
    with directory_being_written(target) as folder:
        lacking.save(folder)
    return True
