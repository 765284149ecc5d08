"""Numbers about one reconstruction: one row per scene, round, method and seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.store import ArtifactError, read_json, read_typed, write_json_atomic

SCHEMA = "metrics/1"
UNAVAILABLE_SCHEMA = "metrics-unavailable/1"


class Fit(StrEnum):
    """What was done to a reconstruction's Gaussians after they were predicted: only rows with the same can be compared.

    ``FITTED``: fitted for seconds to the pictures that they were made from (`sceneexpander.photometric.refine`). ``OPTIMISED``: the
    same for minutes and with densification (`sceneexpander.optimisation.optimise`).
    """

    PREDICTED = "as predicted"
    FITTED = "fitted"
    OPTIMISED = "optimised"

    @property
    def mark(self) -> str:
        """What stands behind a method's name; methods that optimise say so by their names."""
        return " + fit" if self is Fit.FITTED else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeMetrics:
    """What a camera sees of the reconstruction when its picture is drawn at another size than the stored one, against the photo.

    ``open_share`` is the share of pixels that show something in the photo and where the reconstruction's alpha is below 0.9: one looks
    through it. The others compare with the photo brought to that size; None where it has not that many pixels.
    """

    open_share: float
    psnr_db: float | None = None
    ssim: float | None = None
    st_lpips: float | None = None


PARTS = ("truth", "own", "half", "double", "quadruple", "inserted_own")  # fields of `MetricsRow` that hold numbers
SIZES = ("own", "half", "double", "quadruple")  # fields of `ViewMetrics` and `MetricsRow`


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewMetrics:
    """What one view's camera sees of the reconstruction, against that view's picture. None: not defined there.

    ``psnr_db`` is capped (equal images would be infinite). ``coverage`` is the share of pixels with alpha above the threshold.
    ``depth_disagreement`` is the median of |rendered - per-view depth| / per-view depth over covered pixels (0 for optimised methods, whose
    depth is the rendered one). The ``others_`` columns use
    only Gaussians that came from *other* views, over the pixels that those cover (share ``others_coverage``): a picture that agrees with
    its neighbours scores high, doubled contours (ghosting) score low. ``generated_share`` is the part of alpha that Gaussians
    of generated views contribute. ``st_lpips`` is the shift-tolerant perceptual distance, smaller is better. All of these are at the stored
    size; ``own`` is at the photo's own resolution, the others at multiples of the stored size (of captured views only).
    """

    view_id: str
    generated: bool
    posed: bool
    psnr_db: float
    ssim: float
    coverage: float
    generated_share: float
    depth_disagreement: float | None = None
    others_coverage: float | None = None
    others_psnr_db: float | None = None
    st_lpips: float | None = None
    own: SizeMetrics | None = None
    half: SizeMetrics | None = None
    double: SizeMetrics | None = None
    quadruple: SizeMetrics | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthMetrics:
    """Against known truth. Angles in degrees, from relative poses of view pairs; ATE in the truth's unit; depths after one common scale.

    The scale is the median ratio of true to estimated depth over all captured views; the inserted view's new region
    uses that same scale.
    """

    camera_rotation_deg: float | None = None
    camera_direction_deg: float | None = None
    camera_ate: float | None = None
    depth_abs_rel: float | None = None
    depth_within_125: float | None = None
    inserted_rotation_deg: float | None = None
    inserted_direction_deg: float | None = None
    new_region_abs_rel: float | None = None
    new_region_within_125: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricsRow:
    """One method's result on one scene. Means are over views; None means not known or not applicable, never zero.

    Of a method that was run several times with other seeds, the numbers are means over the ``repeats`` and ``spread`` holds their standard
    deviations (n - 1) by name (see `value`); ``views`` are those of the first run.

    ``psnr_db``, ``ssim`` and ``st_lpips`` are over the captured views (preservation), ``inserted_`` over the view inserted in this round.
    A view without a pose stands at a placeholder and shows little but its own Gaussians: it is in ``views`` and in no mean, and without
    a pose of the inserted view there are no ``inserted_`` numbers. ``captured_views_posed`` is the count behind the means; 0 means that
    no captured view has a pose, and then the means are over all of them.
    ``own``, ``half``, ``double`` and ``quadruple`` are the captured views at other sizes than the stored one, see `ViewMetrics`, and
    ``inserted_own`` the inserted view at its picture's own. ``navigation_coverage`` is the mean share of covered pixels over the frames
    of the navigation. Unless ``fit`` says as predicted, the numbers at the method's own cameras are those of pictures that its Gaussians
    were fitted to.
    """

    scene: str
    round: int
    method: str
    model: str
    weights_sha256: str
    seed: int
    captured_views: int
    generated_views: int
    gaussians: int
    generated_gaussians: int
    psnr_db: float
    ssim: float
    coverage: float
    depth_disagreement: float | None = None
    others_psnr_db: float | None = None
    st_lpips: float | None = None
    inserted_psnr_db: float | None = None
    inserted_ssim: float | None = None
    inserted_st_lpips: float | None = None
    inserted_generated_share: float | None = None
    inserted_others_psnr_db: float | None = None
    navigation_coverage: float | None = None
    navigation_frames: int = 0
    truth: TruthMetrics | None = None
    own: SizeMetrics | None = None
    half: SizeMetrics | None = None
    double: SizeMetrics | None = None
    quadruple: SizeMetrics | None = None
    inserted_own: SizeMetrics | None = None
    captured_views_posed: int | None = None
    fit: Fit = Fit.PREDICTED
    repeats: int = 1
    spread: dict[str, float] = field(default_factory=dict)
    views: tuple[ViewMetrics, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nested = [getattr(holder, name) for holder in (self, *self.views) for name in SIZES]
        for item in (self, self.truth, self.inserted_own, *self.views, *nested):
            if item is None:
                continue
            for f in fields(item):
                value = getattr(item, f.name)
                if isinstance(value, float) and not math.isfinite(value):
                    raise ValueError(f"{type(item).__name__}.{f.name} is {value}; leave out what is not known")

    def value(self, name: str) -> float | None:
        """A number by name; one of a part has the part's name before it, e.g. ``truth.camera_ate`` or ``own.psnr_db``."""
        found: Any = self
        for part in name.split("."):
            found = None if found is None else getattr(found, part)
        return None if found is None else float(found)

    def numbers(self) -> dict[str, float]:
        """All known numbers by flat name (those of parts as ``truth_...``, ``own_...``): for tracking."""
        found: dict[str, float] = {}
        parts = {f"{name}_": getattr(self, name) for name in PARTS}
        for prefix, holder in (("", self), *parts.items()):
            for f in fields(holder) if holder is not None else ():
                value = getattr(holder, f.name)
                if isinstance(value, (int, float)) and not isinstance(value, bool) and f.name not in {"round", "seed"}:
                    found[prefix + f.name] = float(value)
        return found | {f"spread_{name.replace('.', '_')}": value for name, value in self.spread.items()}

    def save(self, path: Path) -> None:
        """Write as a JSON file, atomically."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        write_json_atomic(path, {**plain, "schema": SCHEMA})

    @classmethod
    def load(cls, path: Path) -> MetricsRow:
        """Read what `save` wrote. Raises `ArtifactError` for another schema or a damaged file."""
        content = read_json(path)
        if not isinstance(content, dict) or content.pop("schema", None) != SCHEMA:
            raise ArtifactError(f"is not of schema {SCHEMA!r}", where=path, fix="rerun the evaluation")
        return read_typed(cls, content, path, fix="rerun the evaluation")


@dataclass(frozen=True, slots=True, kw_only=True)
class UnavailableRow:
    """The row of a method that could not be run: tables show ``reason`` where the numbers would be."""

    scene: str
    round: int
    method: str
    model: str
    seed: int
    reason: str

    def save(self, path: Path) -> None:
        """Write as a JSON file, atomically."""
        write_json_atomic(path, {**{f.name: getattr(self, f.name) for f in fields(self)}, "schema": UNAVAILABLE_SCHEMA})


Row = MetricsRow | UnavailableRow


def load_row(path: Path) -> Row:
    """Either kind of row. Raises `ArtifactError` for another schema or a damaged file."""
    content = read_json(path)
    if not isinstance(content, dict) or content.pop("schema", None) != UNAVAILABLE_SCHEMA:
        return MetricsRow.load(path)
    return read_typed(UnavailableRow, content, path, fix="rerun the evaluation")
