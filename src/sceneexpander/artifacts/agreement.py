"""How an inserted picture, or a candidate for one, goes with the scene it was made for."""

from __future__ import annotations

from dataclasses import dataclass

_NOTABLE_ZOOM, _NOTABLE_STRETCH = 0.05, 0.02  # smaller ones are within what registration can tell


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
