"""Generated candidates and the one that was chosen, with everything known about how they came to be."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, refusing, save_artifact
from sceneexpander.artifacts.views import ViewSet

SCHEMA = "inserted/1"
_NOTABLE_ZOOM, _NOTABLE_STRETCH = 0.05, 0.02  # smaller ones are within what registration can tell


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
    digital_source_type: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateScore:
    """How well one candidate goes with the scene so far. Shares are in [0, 1].

    Attributes:
        candidate: its number.
        total: what candidates are ranked by, larger is better: the weighted mean of the others.
        registration: how surely its camera is known: matched points of the scene that agree with one pose.
        inliers: how many these are.
        reprojection_px: median distance of theirs from where that pose puts them, in stored pixels; None without a pose.
        appearance: likeness to the scene rendered from that pose, where the scene has been seen; None without a pose.
        sharpness: detail, relative to the captured views.
        novelty: share of the picture that shows what the scene so far does not; None without a pose.
        reason: the same in words.
        judge: what a judge says, its scores of 1 to 5 brought to [0, 1]; None: none was asked, or it did not say.
    """

    candidate: int
    total: float
    registration: float
    inliers: int
    reprojection_px: float | None
    appearance: float | None
    sharpness: float
    novelty: float | None
    reason: str
    judge: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MisalignmentReport:
    """How an inserted picture goes with the scene it was made for, posed against it. Without a camera all but the first two is None.

    Attributes:
        inliers: matched points of the scene that agree with one camera.
        matches: matched points in all.
        reprojection_px: median distance of the inliers from where that camera puts them, in stored pixels.
        world_from_cam: (4, 4), in the frame of the scene before the round.
        focal_factor: its focal length, relative to the photos' typical one: above 1 it is drawn larger. 1 where that explains it.
        stretch: how much wider it is drawn at the same height, as a share; 0 where none is told; None, too, with few points.
        gains: RGB; what the scene's colours are multiplied by to have the picture's tone.
        supported: share of the picture where the scene from there shows the same.
        contradicted: share where it shows something else.
        new: share that no view so far has seen.
    """

    inliers: int
    matches: int
    reprojection_px: float | None = None
    world_from_cam: tuple[tuple[float, ...], ...] | None = None
    focal_factor: float | None = None
    stretch: float | None = None
    gains: tuple[float, ...] | None = None
    supported: float | None = None
    contradicted: float | None = None
    new: float | None = None

    @property
    def words(self) -> str:
        """The same in a sentence."""
        if self.contradicted is None or self.supported is None or self.new is None or self.focal_factor is None:
            return f"its camera is not found among the photos ({self.inliers} of {self.matches} matches agree)"
        said = [
            f"{self.supported:.0%} of it agrees with the photos, {self.contradicted:.0%} contradicts them, {self.new:.0%} is new",
            f"{self.inliers} of {self.matches} matches agree with one camera, off by {self.reprojection_px:.1f} px",
        ]
        if abs(self.focal_factor - 1) >= _NOTABLE_ZOOM:
            said.append(f"drawn {abs(self.focal_factor - 1):.0%} {'larger' if self.focal_factor > 1 else 'smaller'}")
        if self.stretch is not None and abs(self.stretch) >= _NOTABLE_STRETCH:
            said.append(f"{abs(self.stretch):.0%} too {'wide' if self.stretch > 0 else 'narrow'}")
        return "; ".join(said)


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
