"""Exposure and white balance of the inserted picture, brought to the photos' (beyond the paper).

An image model returns the place in its own light: brighter, warmer. Nothing in the geometry is wrong with such a picture, but where it
meets the photos there is a seam, and what only it shows has colours the place does not have. One gain per channel explains most of it;
it is read off the surfaces that both show.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.artifacts.views import to_bytes
from sceneexpander.geometry.agreement import SAME_SURFACE
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.insertion.protocol import RoundContext, RoundInputs
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.views import predict

LEAST_SHARE = 0.01  # of the inserted view's pixels that have to be seen in a photo
DARKEST, BRIGHTEST = 0.06, 0.94  # display values beyond which noise and clipping say nothing about gains
KNEE = 0.9  # display value of the brightest channel from which on a picture is darkened less and less
LARGEST_GAIN = 1.7  # either way; more is another scene, not another exposure

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Colour:
    """The inserted picture's exposure and white balance."""

    match: bool = False  # bring them to the photos'

    def correct_inputs(self, inputs: RoundInputs, context: RoundContext) -> RoundInputs:
        """See `tone_inserted_view`."""
        return tone_inserted_view(inputs, context.loaded) if self.match else inputs


def tone_inserted_view(inputs: RoundInputs, loaded: LoadedModel) -> RoundInputs:
    """The inserted picture in the photos' tone, by the geometry of the weights that the round starts from."""
    inserted = inputs.inserted
    views = inputs.state.toned_views.append(inserted.view)
    seen = predict(views, inputs.joint_priors, loaded, inputs.state.weights)
    if seen.depth is None:
        raise ValueError("the tone is compared by means of the depth head")
    tone = match_tone(
        views.images,
        seen.depth.cpu(),
        Cameras(seen.world_from_cam.cpu(), seen.intrinsics_px.cpu(), *views.images.shape[2:]),
        generated=views.generated,
        posed=inputs.joint_priors.posed,
        view=len(views) - 1,
    )
    if tone is None:
        _log.info("the inserted view shares too little with the photos to compare their tone")
        return inputs
    _log.info("the inserted picture x (%.2f, %.2f, %.2f) has the photos' tone", *tone.gains)
    view = inserted.view
    images = tone.applied(view.images)
    record = replace(view.records[0], sha256=sha256_of_tensors({"toned": images}))
    changed = replace(
        view,
        records=(record,),
        images=images,
        detail_images=tone.applied(view.detail_images),
        photos=(to_bytes(tone.applied(view.photo(0))),),
    )
    return replace(inputs, toned=changed, report=replace(inputs.report, gains=tone.gains))


@dataclass(frozen=True, slots=True, kw_only=True)
class Tone:
    """Gains that bring a picture to the photos' tone.

    Attributes:
        gains: of the display values (RGB). Pictures are stored with a power law, so a gain of linear light is one here as well.
        pairs: (pixel, photo) pairs they were read from.
    """

    gains: tuple[float, float, float]
    pairs: int

    def applied(self, image: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 3 height width"]:
        """The picture in the photos' tone, clipped to [0, 1].

        What is clipped to white has lost its colour: darkening it would paint bright walls grey. From `KNEE` to white the gains that
        darken fade out.
        """
        gains = image.new_tensor(self.gains)[:, None, None]
        above = ((image.amax(-3, keepdim=True) - KNEE) / (1 - KNEE)).clamp(0, 1)
        clipped = above * above * (3 - 2 * above)
        return (image * torch.where(gains < 1, gains + (1 - gains) * clipped, gains)).clamp(0, 1)


@torch.no_grad()
def match_tone(
    images: Float[Tensor, "view 3 height width"],
    depth: Float[Tensor, "view height width"],
    cameras: Cameras,
    *,
    generated: Bool[Tensor, "view"],
    posed: Bool[Tensor, "view"] | None = None,
    view: int,
) -> Tone | None:
    """Median ratios of the photos' colours to those of one view, over the surfaces that both show.

    The median over thousands of pairs is hardly moved by objects that differ or pixels that are a little off.

    Args:
        images: RGB in [0, 1].
        depth, cameras: of all views, in one frame and scale.
        generated: these views are no photos, and not compared with.
        posed: views whose camera was estimated; what a placeholder shows is not known. Default: all.
        view: whose tone is to change.

    Returns:
        The gains, each within `LARGEST_GAIN` of 1; None where too little is seen in common (`LEAST_SHARE`) or the view has no camera.
    """
    height, width = depth.shape[1:]
    placed = torch.ones_like(generated) if posed is None else posed
    photos = torch.nonzero(~generated & placed)[:, 0]
    if len(photos) == 0 or not bool(placed[view]):
        return None
    points = cameras[view].unproject(depth[view : view + 1]).reshape(-1, 3)
    content = torch.cat([images[photos], depth[photos, None]], dim=1)
    there, found = cameras[photos].look_up(points, content)
    ratio = (found.depth / there[:, 3].clamp(min=1e-6)).log()
    mine = images[view].flatten(1).expand(len(photos), -1, -1)
    usable = found.in_frame & (ratio.abs() < SAME_SURFACE)
    for colours in (mine, there[:, :3]):
        usable &= (colours.amin(1) > DARKEST) & (colours.amax(1) < BRIGHTEST)
    if int(usable.any(0).sum()) < LEAST_SHARE * height * width:
        return None
    logs = (there[:, :3] / mine.clamp(min=DARKEST)).movedim(1, -1)[usable].log()
    gains = logs.median(0).values.exp().clamp(1 / LARGEST_GAIN, LARGEST_GAIN)
    return Tone(gains=(float(gains[0]), float(gains[1]), float(gains[2])), pairs=int(usable.sum()))
