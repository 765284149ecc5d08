"""Generated candidates and the one that was chosen, with everything known about how they came to be."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.agreement import CandidateScore, MisalignmentReport
from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, refusing, save_artifact
from sceneexpander.artifacts.views import ViewSet

SCHEMA = "inserted/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """How one picture was made. Never holds a secret: keys are read from the environment at call time only.

    Attributes:
        backend: name of the back-end.
        prompt: the text that was sent, or that belongs to a picture which was there before.
        source: file name, or model.
        sha256: of the picture's original bytes.
        reference_sha256: of the views that were shown to the generator: their originals' bytes.
        parameters: what was asked for, and what was noticed about the answer.
        refusal: why it cannot be used; None: it can.
        request_id: what the service calls the request; None: it gives no name, or there was none.
        created: when the answer came, UTC (ISO 8601); None: not known.
        usage: what the service counted, e.g. tokens.
        cost_usd: estimated from the configured price; None: no price is configured, or nothing was asked of a service.
        prompt_given: the text before a chat model rewrote it; None: it was sent as it was.
        rewritten_by: that model; None: nobody rewrote it.
        digital_source_type: IPTC's term for how the picture came to be, e.g. "trainedAlgorithmicMedia"; None: not known.
    """

    backend: str
    prompt: str
    source: str
    sha256: str
    reference_sha256: tuple[str, ...] = ()
    parameters: dict[str, str] = field(default_factory=dict)
    refusal: str | None = None
    request_id: str | None = None
    created: str | None = None
    usage: dict[str, int] = field(default_factory=dict)
    cost_usd: float | None = None
    prompt_given: str | None = None
    rewritten_by: str | None = None
    digital_source_type: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class InsertedView:
    """The chosen candidate fitted to the captured views' size; all candidates' provenance in order.

    ``ranking`` says how they compare and why the chosen one was taken; empty where there was nothing to choose. ``misalignment`` and
    ``support`` (per pixel: 1, or 0 where the scene shows something else) say how it goes with the scene; None: not looked at, or no camera.
    """

    round: int
    view: ViewSet  # exactly one view, generated=True
    chosen: int
    provenance: tuple[Provenance, ...]
    ranking: tuple[CandidateScore, ...] = ()
    misalignment: MisalignmentReport | None = None
    support: Float[Tensor, "height width"] | None = None

    def __post_init__(self) -> None:
        if len(self.view) != 1:
            raise ValueError(f"an inserted view is one picture, got {len(self.view)}")
        if not 0 <= self.chosen < len(self.provenance):
            raise ValueError(f"candidate {self.chosen} was chosen from {len(self.provenance)}")

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        self.view.save(folder / "view")
        facts = {
            "round": self.round,
            "chosen": self.chosen,
            "provenance": self.provenance,
            "ranking": self.ranking,
            "misalignment": self.misalignment,
        }
        save_artifact(folder, SCHEMA, facts, {} if self.support is None else {"support": self.support})

    @classmethod
    def load(cls, folder: Path) -> InsertedView:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        with refusing(folder):
            return cls(
                round=read.round,
                view=ViewSet.load(folder / "view"),
                chosen=read.chosen,
                provenance=read.provenance,
                ranking=read.ranking,
                misalignment=read.misalignment,
                support=tensors.get("support"),
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """Everything of an `InsertedView` but the view, which is an artefact of its own."""

    round: int
    chosen: int
    provenance: tuple[Provenance, ...]
    ranking: tuple[CandidateScore, ...] = ()
    misalignment: MisalignmentReport | None = None
