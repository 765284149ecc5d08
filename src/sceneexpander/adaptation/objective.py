"""What one step minimises: the anchor loss on the captured views and the self-distillation loss on the inserted one."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, Gauge
from sceneexpander.adaptation.losses import LossTerms, ViewGeometry, anchor_loss, generation_loss
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.geometry.gauge import camera_vectors_relative_to, scale_camera_vectors
from sceneexpander.geometry.lookup import warp_maps

Grid = Float[Tensor, "height width 2"]


class NonFiniteLoss(RuntimeError):
    """A loss term became NaN or infinite; the message names the term and the step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepLosses:
    """The terms of one step as they enter the objective (before lambda), in the order of the record's fields."""

    anchor_camera: Float[Tensor, ""]
    anchor_depth: Float[Tensor, ""]
    anchor_normal: Float[Tensor, ""]
    gen_camera: Float[Tensor, ""]
    gen_depth: Float[Tensor, ""]
    gen_normal: Float[Tensor, ""]
    objective: Float[Tensor, ""]  # everything but the drift term, which the update adds

    def values(self, step: int) -> dict[str, float]:
        """All terms as numbers, in one transfer.

        Raises:
            NonFiniteLoss: one of them is not finite.
        """
        names = [f.name for f in fields(self)]
        numbers = torch.stack([getattr(self, name).detach() for name in names]).tolist()
        for name, number in zip(names, numbers, strict=True):
            if not math.isfinite(number):
                raise NonFiniteLoss(f"{name} is {number} at step {step}")
        return dict(zip(names, numbers, strict=True))


def step_losses(
    student: ViewGeometry,
    anchors: ViewGeometry,
    teacher: ViewGeometry | None,
    config: AdaptConfig,
    inserted_weights: Float[Tensor, "1 height width"] | None = None,
) -> StepLosses:
    """Eq. (anchor) on the captured views, Eq. (gen) on the inserted one.

    Args:
        student: prediction for the captured views of the batch, followed by the inserted one if there is one.
        anchors: targets of the captured views, see `anchor_targets`.
        teacher: prediction of the inserted view, the last of the batch; None if the batch has none.
        config: weights and distances.
        inserted_weights: how much each pixel of the inserted view counts, see `consistency`; None: all alike.
    """
    count = anchors.depth.shape[0]
    anchor = anchor_loss(student.view(0, count), anchors, config)
    if teacher is None:
        zero = anchor.total.new_zeros(())
        gen = LossTerms(camera=zero, depth=zero, normal=zero)
    else:
        gen = generation_loss(student.view(count), teacher, config, inserted_weights)
    return StepLosses(
        anchor_camera=anchor.camera,
        anchor_depth=anchor.depth,
        anchor_normal=anchor.normal,
        gen_camera=gen.camera,
        gen_depth=gen.depth,
        gen_normal=gen.normal,
        objective=config.lambda_anchor * anchor.total + config.lambda_gen * gen.total,
    )


def anchor_targets(
    anchors: ViewGeometry, batch: Batch, grids: list[Grid | None], student: ViewGeometry, config: AdaptConfig
) -> ViewGeometry:
    """Anchors of the batch's captured views, in the gauge of the batch's first view."""
    index = list(batch.captured)
    depth, normals, camera = anchors.depth[index], anchors.normals[index], anchors.camera_vector[index]
    if config.gauge is Gauge.REALIGN and index[0] != 0:
        camera = camera_vectors_relative_to(camera, 0)
        # Another first view may also change the scale that the model chooses: compare in the student's.
        ratio = (student.depth[: len(index)].detach() / depth).flatten().median()
        camera, depth = scale_camera_vectors(camera, ratio), depth * ratio
    if config.warp_targets:
        depth, normals = _warp_maps(depth, normals, grids)
    return ViewGeometry(camera_vector=camera, depth=depth, normals=normals)


def _warp_maps(depth: Tensor, normals: Tensor, grids: list[Grid | None]) -> tuple[Tensor, Tensor]:
    """Move depth and normals with the pixels of their views (option ``warp_targets``)."""
    moved_depth, moved_normals = [], []
    for view, grid in enumerate(grids):
        if grid is None:
            moved_depth.append(depth[view])
            moved_normals.append(normals[view])
            continue
        maps = warp_maps(torch.cat([depth[view][None], normals[view].permute(2, 0, 1)]), grid)
        moved_depth.append(maps[0])
        moved_normals.append(torch.nn.functional.normalize(maps[1:].permute(1, 2, 0), dim=-1))
    return torch.stack(moved_depth), torch.stack(moved_normals)
