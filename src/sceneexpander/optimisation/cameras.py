"""Cameras that may move a little while the Gaussians are optimised."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.geometry.rigid import rigid_from_parts, rigid_inverse, rotation_from_quat_wxyz


class RefinedCameras:
    """Small motions on top of given poses: three of rotation (radians, small angles) and three of translation (in extents) per view.

    The first view stays: it is the world.
    """

    def __init__(self, world_from_cam: Float[Tensor, "view 4 4"], *, rate: float, extent: float) -> None:
        self._start = rigid_inverse(world_from_cam)
        self._extent, self._rate = extent, rate
        self.motion = nn.Parameter(torch.zeros(len(world_from_cam), 6).to(world_from_cam))
        self._optimiser = torch.optim.Adam([self.motion], lr=rate) if rate > 0 else None
        self.motion.requires_grad_(self._optimiser is not None)

    def cam_from_world(self, view: int) -> Float[Tensor, "1 4 4"]:
        """The present pose of one view."""
        if self._optimiser is None or view == 0:
            return self._start[view : view + 1]
        half = self.motion[view : view + 1, :3] / 2
        turn = rotation_from_quat_wxyz(torch.cat([torch.ones_like(half[:, :1]), half], dim=-1))
        moved = rigid_from_parts(turn, self.motion[view : view + 1, 3:] * self._extent)
        return moved @ self._start[view : view + 1]

    def step(self, share: float) -> None:
        """One optimiser step of the views that were drawn since the last one, at a share of the learning rate."""
        if self._optimiser is not None and self.motion.grad is not None:
            self._optimiser.param_groups[0]["lr"] = share * self._rate
            self._optimiser.step()
            self._optimiser.zero_grad(set_to_none=True)

    @torch.no_grad()
    def world_from_cam(self) -> Float[Tensor, "view 4 4"]:
        """All present poses."""
        return rigid_inverse(torch.cat([self.cam_from_world(view) for view in range(len(self._start))]))

    def state(self) -> dict[str, Tensor]:
        """Motions and the optimiser's moments."""
        kept = {"motion": self.motion.detach()}
        return kept | (dict(self._optimiser.state.get(self.motion, {})) if self._optimiser is not None else {})

    @torch.no_grad()
    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        self.motion.copy_(state["motion"])
        if self._optimiser is not None and "step" in state:
            names = ("step", "exp_avg", "exp_avg_sq")
            self._optimiser.state[self.motion] = {name: state[name].to(self.motion.device).clone() for name in names}
