"""One round's picture: ask the back-end, check, fit, choose, and record everything."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.generation.backends import make_generator
from sceneexpander.generation.checks import check_content, nearest_copy
from sceneexpander.generation.config import GeneratorConfig
from sceneexpander.generation.prompt import fill_prompt
from sceneexpander.generation.protocol import Candidate, GenerationContext
from sceneexpander.generation.sheet import contact_sheet
from sceneexpander.ingest.bars import find_bars
from sceneexpander.ingest.config import Fit
from sceneexpander.ingest.decode import Picture, decode_picture
from sceneexpander.ingest.fit import FittedPicture, FrameSize, fit_picture
from sceneexpander.ingest.load import LITTLE_KEPT, image_tensor, view_from_fitted, without_bars
from sceneexpander.ingest.panorama import doubtful_shape

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Assessed:
    """A candidate after the checks: usable (picture and its fit) or not (``provenance.refusal`` says why)."""

    name: str
    provenance: Provenance
    picture: Picture | None = None
    fitted: FittedPicture | None = None


def generate_inserted_view(
    scene: Scene,
    round_number: int,
    views: ViewSet,
    scene_folder: Path,
    config: GeneratorConfig,
) -> tuple[InsertedView, Float[Tensor, "3 height width"]]:
    """The picture that round ``round_number`` inserts, in the frame of the views so far, and a contact sheet of all candidates.

    The provenance of each candidate holds the full prompt, the back-end, the digests of its bytes and of the references, and in
    ``parameters`` the fit (``fit``, ``original_size``, ``kept``: visible share of its area) and ``warning`` if something looks odd.

    Args:
        scene: the prepared scene.
        round_number: from 1.
        views: captured views and those inserted in earlier rounds; the new view gets their sizes.
        scene_folder: the user's folder, where recorded pictures are.
        config: back-end, choice and fit.

    Raises:
        UserError: unknown back-end, no picture, or the chosen candidate does not exist or is unusable.
    """
    spec = scene.round_spec(round_number)
    context = GenerationContext(scene_folder=scene_folder, round_number=round_number, spec=spec, config=config)
    candidates = make_generator(context).generate(views, fill_prompt(spec))
    if config.candidate >= len(candidates):
        raise UserError(
            f"is {config.candidate}, but round {round_number} has {len(candidates)} candidate(s)",
            where="generator.candidate",
            fix=f"use 0 to {len(candidates) - 1}",
        )
    frame = FrameSize(
        height=views.height,
        width=views.width,
        detail_height=views.detail_images.shape[-2],
        detail_width=views.detail_images.shape[-1],
    )
    assessed = [_assess(candidate, views, frame, config.fit) for candidate in candidates]
    chosen = assessed[config.candidate]
    if chosen.picture is None or chosen.fitted is None:
        raise UserError(chosen.provenance.refusal or "no picture", where=chosen.provenance.source)
    warning = chosen.provenance.parameters.get("warning")
    if warning:
        logger.warning("round %d, %s: %s", round_number, chosen.name, warning)
    inserted = InsertedView(
        round=round_number,
        view=view_from_fitted(
            chosen.picture,
            chosen.fitted,
            view_id=f"{len(views):03d}_inserted_{round_number}",
            generated=True,
            round_number=round_number,
        ),
        chosen=config.candidate,
        provenance=tuple(item.provenance for item in assessed),
    )
    tiles = [(item.name, None if item.fitted is None else item.fitted.image) for item in assessed]
    return inserted, contact_sheet(views, tiles, chosen=config.candidate)


def _assess(candidate: Candidate, views: ViewSet, frame: FrameSize, fit: Fit) -> _Assessed:
    source = candidate.provenance.source
    try:
        picture = decode_picture(candidate.data, name=candidate.name, where=source)
        check_content(picture, source)
    except UserError as error:
        # One bad candidate must not hide the others: it counts as refused, and only choosing it is an error.
        refusal = f"{error.problem}; {error.fix}" if error.fix else error.problem
        return _Assessed(name=candidate.name, provenance=replace(candidate.provenance, refusal=refusal))
    bars = find_bars(picture.pixels)
    fitted = fit_picture(picture.pixels, frame, fit, valid=without_bars(picture, bars))
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
    provenance = replace(candidate.provenance, parameters=parameters)
    return _Assessed(name=candidate.name, provenance=provenance, picture=picture, fitted=fitted)
