"""The exposures of photos: what differs in brightness and tint between them is not the scene's.

Without them a fit has to show one wall in several brightnesses, and answers with patches. As in NeRF in the Wild (Martin-Brualla et al.,
CVPR 2021) every photo has an appearance of its own, here a gain and an offset per channel, that is thrown away after the fit.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_PRICE = 0.1  # of the mean square of logarithms of gains and of offsets: what explains nothing stays at 1 and 0
_QUIET = 0.1  # Adam's epsilon: gradients well below it, of photos that are exposed alike, hardly move anything


class Exposures:
    """A gain and an offset per photo and channel. The scene keeps the mean exposure: they are relative to the photos' mean.

    Args:
        views: number of views.
        photos: which of them have an exposure of their own; the others are taken as they are.
        rate: Adam's; 0: no photo has one.
        device: of the pictures.
    """

    def __init__(self, views: int, photos: list[int], *, rate: float, device: torch.device) -> None:
        self._photos = photos if rate > 0 else []
        self._rate = rate
        # Logarithms of gains, then offsets.
        self._change = torch.zeros(views, 2, 3, device=device, requires_grad=True)
        self._optimiser = torch.optim.Adam([self._change], lr=rate, eps=_QUIET)

    def applied(self, rgb: Float[Tensor, "3 height width"], view: int) -> Float[Tensor, "3 height width"]:
        """What the scene shows as the photo of a view would have taken it."""
        if view not in self._photos:
            return rgb
        log_gain, offset = self._change[view] - self._change[self._photos].mean(0)
        return rgb * log_gain.exp()[:, None, None] + offset[:, None, None]

    def applied_to_each(
        self, colours: Float[Tensor, "gaussian 3"], source_view: Int[Tensor, " gaussian"]
    ) -> Float[Tensor, "gaussian 3"]:
        """Colours of Gaussians as the photo that each was made from would have taken them. The exposures learn nothing from it."""
        if not self._photos:
            return colours
        change = torch.zeros_like(self._change)
        change[self._photos] = (self._change[self._photos] - self._change[self._photos].mean(0)).detach()
        log_gain, offset = change.unbind(1)
        # Several times as fast as indexing, and there are as many Gaussians as pixels.
        return colours * log_gain.exp().index_select(0, source_view) + offset.index_select(0, source_view)

    def penalty(self) -> Float[Tensor, ""]:
        """For the loss."""
        return _PRICE * self._change.square().mean()

    def step(self, share: float) -> None:
        """One step of the optimiser, after a backward pass, at a share of the rate."""
        if not self._photos:
            return
        self._optimiser.param_groups[0]["lr"] = self._rate * share
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)
