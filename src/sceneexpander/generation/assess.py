"""A candidate looked at: can it be a view, how does it fit the captured frame, and what is odd about it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sceneexpander.artifacts.candidates import Candidate
from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.source_type import read_source_type
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.generation.checks import check_content, nearest_copy
from sceneexpander.ingest.bars import find_bars
from sceneexpander.ingest.config import Fit
from sceneexpander.ingest.decode import Picture, decode_picture
from sceneexpander.ingest.fit import FittedPicture, FrameSize, fit_picture
from sceneexpander.ingest.load import LITTLE_KEPT, image_tensor, without_bars
from sceneexpander.ingest.panorama import doubtful_shape


@dataclass(frozen=True, slots=True, kw_only=True)
class Assessed:
    """A candidate after the checks: usable (picture and its fit) or not (``provenance.refusal`` says why)."""

    name: str
    provenance: Provenance
    picture: Picture | None = None
    fitted: FittedPicture | None = None


def frame_of(views: ViewSet) -> FrameSize:
    """The common frame that the views are in."""
    return FrameSize(
        height=views.height,
        width=views.width,
        detail_height=views.detail_images.shape[-2],
        detail_width=views.detail_images.shape[-1],
    )


def assess(candidate: Candidate, views: ViewSet, fit: Fit) -> Assessed:
    """Decode, check and fit a candidate.

    Its provenance then holds in ``parameters`` the fit (``fit``, ``original_size``, ``kept``: visible share of its area) and a ``warning``
    if something looks odd.
    """
    source = candidate.provenance.source
    try:
        picture = decode_picture(candidate.data, name=candidate.name, where=source)
        check_content(picture, source)
    except UserError as error:
        # One bad candidate must not hide the others: it counts as refused, and only choosing it is an error.
        refusal = f"{error.problem}; {error.fix}" if error.fix else error.problem
        return Assessed(name=candidate.name, provenance=replace(candidate.provenance, refusal=refusal))
    bars = find_bars(picture.pixels)
    fitted = fit_picture(picture.pixels, frame_of(views), fit, valid=without_bars(picture, bars))
    parameters = {
        **candidate.provenance.parameters,
        "format": picture.file_format,
        "original_size": f"{picture.width}x{picture.height}",
        "fit": fit,
        "kept": f"{fitted.kept:.4f}",
    }
    warnings = list(picture.notes)
    if bars:
        warnings.append(f"has bars of one colour ({bars.words(*picture.shape)}), not used")
    doubt = doubtful_shape(picture.height, picture.width, has_lens=picture.lens.focal_px is not None)
    if doubt is not None:
        warnings.append(doubt)
    copied = nearest_copy(image_tensor(fitted.image), views)
    if copied is not None:
        warnings.append(f"is nearly a copy of {copied}: it shows nothing new")
    if fitted.kept < LITTLE_KEPT:
        warnings.append(f"only {fitted.kept:.0%} of it fits the captured aspect ratio")
    if warnings:
        parameters["warning"] = "; ".join(warnings)
    stated = candidate.provenance.digital_source_type or read_source_type(picture.xmp)
    provenance = replace(candidate.provenance, parameters=parameters, digital_source_type=stated)
    return Assessed(name=candidate.name, provenance=provenance, picture=picture, fitted=fitted)
