"""The pictures that Gaussians are fitted to, at several sizes.

A scene that is fitted at one size is right at that size alone: the rasteriser's blur and the samples of the pixels hide what is between
them. Here every view can be asked for at the size of its photo, at the stored size, and at half of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from sceneexpander.evaluation.image import WINDOW
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.sampling import finest_pixel
from sceneexpander.splatting import RasterSettings

_SMALLEST_SIDE_PX = 2 * WINDOW  # below it there is hardly a window of SSIM in a picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """What one camera should see, at one size."""

    rgb: Float[Tensor, "3 height width"]
    weights: Float[Tensor, "height width"] | None  # how much each pixel is to be believed; None: all of them alike
    intrinsics_px: Float[Tensor, "3 3"]

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.rgb.shape[1])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.rgb.shape[2])


class Pictures:
    """Pictures of some views.

    Args:
        images: at the stored size, RGB in [0, 1].
        photos: the same framing in the pixels of the photos; None: nothing finer than the stored pictures is known.
        intrinsics_px: at the stored size.
        weights: of the stored pixels, see `Picture`.
        device: where they are wanted.
    """

    def __init__(
        self,
        images: Float[Tensor, "view 3 height width"],
        photos: Sequence[UInt8[Tensor, "3 photo_height photo_width"]] | None,
        intrinsics_px: Float[Tensor, "view 3 3"],
        weights: Float[Tensor, "view height width"] | None,
        device: torch.device,
    ) -> None:
        if photos is not None and len(photos) != len(images):
            raise ValueError(f"{len(photos)} photos for {len(images)} views")
        self._images, self._photos, self._device = images.to(device), photos, device
        self._intrinsics = intrinsics_px.to(device)
        self._weights = None if weights is None else weights.to(device)

    def own(self, view: int) -> Picture:
        """A view as its photo shows it; stored if the photo has no more pixels than that."""
        height, width = self._own_size(view)
        if self._photos is None or (height, width) == tuple(self._images.shape[2:]):
            return self.stored(view)
        return self._made(view, self._photos[view].to(self._device, self._images.dtype) / 255)

    def stored(self, view: int) -> Picture:
        """A view at the stored size."""
        return self._made(view, self._images[view])

    def half(self, view: int) -> Picture:
        """A view at half the stored size, each pixel the mean of four; stored if that would be too small to compare."""
        image = self._images[view]
        if min(image.shape[1:]) < 2 * _SMALLEST_SIDE_PX:
            return self.stored(view)
        return self._made(view, functional.avg_pool2d(image, 2))

    def finest_pixel(
        self, points: Float[Tensor, "point 3"], world_from_cam: Float[Tensor, "view 4 4"], views: list[int]
    ) -> Float[Tensor, " point"]:
        """See `sceneexpander.geometry.sampling.finest_pixel`, for the given views at the sizes of their photos."""
        stored = self._cameras(world_from_cam)
        return finest_pixel(points, [stored[view].resized(*self._own_size(view)) for view in views])

    def compensated(self, gaussians: Gaussians, world_from_cam: Float[Tensor, "view 4 4"]) -> Gaussians:
        """Gaussians as rasterisers that compensate for the screen blur draw them: of others, what the blur makes at the stored size.

        A Gaussian that was meant for the blur is really as wide as the blur makes it. Taken over as it is, it would lose its light.
        """
        if gaussians.antialiased:
            return gaussians
        pixel = finest_pixel(gaussians.means, [self._cameras(world_from_cam)])
        blur = RasterSettings().eps2d * pixel.square()
        return replace(gaussians, scales=(gaussians.scales.square() + blur[:, None]).sqrt(), antialiased=True)

    def _cameras(self, world_from_cam: Float[Tensor, "view 4 4"]) -> Cameras:
        height, width = (int(side) for side in self._images.shape[2:])
        return Cameras(world_from_cam, self._intrinsics, height, width)

    def _own_size(self, view: int) -> tuple[int, int]:
        height, width = (int(side) for side in self._images.shape[2:])
        if self._photos is None or self._photos[view].shape[1] <= height:
            return height, width
        return int(self._photos[view].shape[1]), int(self._photos[view].shape[2])

    def _made(self, view: int, rgb: Float[Tensor, "3 height width"]) -> Picture:
        stored_height, stored_width = self._images.shape[2:]
        height, width = rgb.shape[1:]
        weights = None if self._weights is None else self._weights[view]
        if weights is not None and (height, width) != (stored_height, stored_width):
            weights = functional.interpolate(weights[None, None], size=(height, width), mode="area")[0, 0]
        return Picture(
            rgb=rgb,
            weights=weights,
            intrinsics_px=resize_intrinsics(self._intrinsics[view], width / stored_width, height / stored_height),
        )
