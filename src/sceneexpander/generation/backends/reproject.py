"""The scene so far, seen from where a camera motion leads: offline, free, and without anything new in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.candidates import Candidate, CandidateSet
from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.source_type import MADE_FROM_SCENE, source_type_xmp
from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.generation.config import GeneratorConfig
from sceneexpander.generation.motion import EXAMPLE, Step, parse_motion
from sceneexpander.generation.prompt import fill_prompt, split_words
from sceneexpander.generation.protocol import Forecast, GenerationContext, SceneSoFar
from sceneexpander.generation.source_picture import png_bytes
from sceneexpander.generation.start import CENTRAL, moved_camera, start_view
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting.render import render

_MOSTLY_SEEN = 0.5  # of what covers a pixel: below it, the pixel counts as not seen
_TOO_LITTLE_SEEN = 0.1  # of the picture
_ALL = "which is all that reproject goes by"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReprojectConfig(GeneratorConfig):
    """Settings of ``reproject``. ``start`` is the file name of the photo that the motion starts from, or ``central``."""

    backend: str = "reproject"
    start: str = CENTRAL


@dataclass(frozen=True, slots=True)
class ReprojectGenerator:
    """Renders the Gaussians of the scene so far from the moved camera and continues them into what nobody has seen.

    It shows more of the place only as far as other photos do, and invents no object: with words for one, it says so.
    """

    config: ReprojectConfig

    def check(self, context: GenerationContext) -> Forecast:
        """Read the motion. See `ViewGenerator`."""
        motion_of(context, _ALL)
        names = [record.name for record in context.captured.records]
        if context.round_number == 1 and self.config.start not in (CENTRAL, *names):
            problem = f"there is no photo {self.config.start!r}"
            raise UserError(problem, where="generator.start", fix=did_you_mean(self.config.start, (CENTRAL, *names)))
        _, new_object = split_words(context.spec)
        warning = f"reproject invents no object: {new_object!r} will not be in the picture"
        return Forecast(prompt=fill_prompt(context.spec), warnings=(warning,) if new_object else ())

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """One picture. See `ViewGenerator`."""
        rgb, alpha, pose, start = seen_from_motion(context, so_far, self.config.start)
        steps = motion_of(context, _ALL)
        share = float((alpha >= _MOSTLY_SEEN).float().mean())
        picture = fill_unseen(rgb, alpha)
        parameters = {
            "motion": ", ".join(step.words() for step in steps),
            "start": start,
            "filled": f"{1 - share:.4f}",
            "world_from_cam": " ".join(f"{value:.6g}" for value in pose.flatten().tolist()),
        }
        xmp = source_type_xmp(MADE_FROM_SCENE, credit="sceneexpander reproject")
        data = png_bytes(Image.fromarray(to_uint8(picture)), xmp)
        provenance = Provenance(
            backend=self.config.backend,
            prompt=fill_prompt(context.spec),
            source="the scene so far",
            sha256=sha256_of_bytes(data),
            reference_sha256=tuple(record.sha256 for record in so_far.views.records),
            parameters=parameters,
            digital_source_type=MADE_FROM_SCENE,
        )
        name = f"{parameters['motion']}, from {start}"
        return CandidateSet(
            round=context.round_number, candidates=(Candidate(data=data, name=name, provenance=provenance),)
        )


def motion_of(context: GenerationContext, purpose: str) -> tuple[Step, ...]:
    """The steps of a round's camera motion. Raises `UserError` without one; ``purpose`` says what it is needed for."""
    motion, _ = split_words(context.spec)
    if not motion:
        fix = f"say one with --motion, {EXAMPLE}"
        raise UserError(f"says no camera motion, {purpose}", where=_where(context), fix=fix)
    return parse_motion(motion, where=_where(context))


@torch.no_grad()
def seen_from_motion(
    context: GenerationContext, so_far: SceneSoFar, start: str
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"], Float[Tensor, "4 4"], str]:
    """(RGB on black, alpha, ``world_from_cam``, name of the photo it starts from) of the scene from where a round's motion leads.

    In detail pixels. Raises `UserError` if next to nothing is seen from there.
    """
    view = start_view(so_far, start)
    pose = moved_camera(so_far, motion_of(context, _ALL), view, where=_where(context))
    views, scene = so_far.views, so_far.reconstruction
    height, width = views.detail_images.shape[-2:]
    intrinsics = resize_intrinsics(scene.intrinsics_px[view], width / views.width, height / views.height)
    seen = render(scene.gaussians, Cameras(pose[None], intrinsics[None], height, width))
    share = float((seen.alpha[0] >= _MOSTLY_SEEN).float().mean())
    if share < _TOO_LITTLE_SEEN:
        problem = f"leads to where the photos show only {share:.0%} of the picture"
        raise UserError(problem, where=_where(context), fix="move or turn less")
    return seen.rgb[0], seen.alpha[0], pose, views.records[view].name


def _where(context: GenerationContext) -> str:
    return f"motion of {context.where}"


def fill_unseen(
    rgb: Float[Tensor, "3 height width"], alpha: Float[Tensor, "height width"]
) -> Float[Tensor, "3 height width"]:
    """A render over black with what it does not cover continued from around: smoothly, coarser the wider the hole.

    Push-pull: Gortler et al., "The Lumigraph", SIGGRAPH 1996, section 3.4. What is covered stays as it is.
    """
    cover = alpha.clamp(0, 1)[None]
    colours, covers = [rgb[None]], [cover[None]]
    while max(colours[-1].shape[-2:]) > 1:
        both = torch.cat([colours[-1], covers[-1]], dim=1)
        pooled = torch.nn.functional.avg_pool2d(both, 2, ceil_mode=True, count_include_pad=False)
        # A cell with any cover has a colour that is as sure as can be: holes take it over undiluted.
        weight = pooled[:, 3:]
        sure = (weight * 4).clamp(max=1)
        colours.append(pooled[:, :3] / weight.clamp(min=1e-6) * sure)
        covers.append(sure)
    filled = colours[-1] / covers[-1].clamp(min=1e-6)
    for colour, weight in zip(colours[-2::-1], covers[-2::-1], strict=True):
        size = [int(side) for side in colour.shape[-2:]]
        coarse = torch.nn.functional.interpolate(filled, size=size, mode="bilinear", align_corners=False)
        filled = colour + (1 - weight) * coarse
    return filled[0].clamp(0, 1)
