"""What one step minimises: the anchor loss on the captured views and the self-distillation loss on the inserted one."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, Gauge
from sceneexpander.adaptation.losses import LossTerms, ViewGeometry, anchor_loss, generation_loss, splat_distance
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.errors import UserError
from sceneexpander.geometry.gauge import camera_vectors_relative_to, scale_camera_vectors
from sceneexpander.geometry.lookup import warp_maps

Grid = Float[Tensor, "height width 2"]


class NonFiniteLoss(UserError):
    """A loss term or the gradient became NaN or infinite: settings, weights or pictures that the adaptation cannot work with."""

    def __init__(self, what: str, step: int) -> None:
        fix = "lower adapt.learning_rate or the lambdas, or check the weights"
        super().__init__(f"{what} at step {step} of the adaptation", where="adapt", fix=fix)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepLosses:
    """The terms of one step as they enter the objective (before lambda), in the order of the record's fields."""

    anchor_camera: Float[Tensor, ""]
    anchor_depth: Float[Tensor, ""]
    anchor_normal: Float[Tensor, ""]
    anchor_gaussian: Float[Tensor, ""]
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
                raise NonFiniteLoss(f"{name} is {number}", step)
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
    splats = anchor.total.new_zeros(())
    if student.splats is not None and anchors.splats is not None:
        splats = config.alpha_gaussian * splat_distance(student.splats[:count], anchors.splats).sum()
    if teacher is None:
        zero = anchor.total.new_zeros(())
        gen = LossTerms(camera=zero, depth=zero, normal=zero)
    else:
        gen = generation_loss(student.view(count), teacher, config, inserted_weights)
    return StepLosses(
        anchor_camera=anchor.camera,
        anchor_depth=anchor.depth,
        anchor_normal=anchor.normal,
        anchor_gaussian=splats,
        gen_camera=gen.camera,
        gen_depth=gen.depth,
        gen_normal=gen.normal,
        objective=config.lambda_anchor * (anchor.total + splats) + config.lambda_gen * gen.total,
    )


def anchor_targets(
    anchors: ViewGeometry, batch: Batch, grids: list[Grid | None], student: ViewGeometry, config: AdaptConfig
) -> ViewGeometry:
    """Anchors of the batch's captured views, in the gauge of the batch's first view."""
    index = list(batch.captured)
    depth, normals, camera = anchors.depth[index], anchors.normals[index], anchors.camera_vector[index]
    splats = None if anchors.splats is None else anchors.splats[index]
    if config.gauge is Gauge.REALIGN and index[0] != 0:
        camera = camera_vectors_relative_to(camera, 0)
        # Another first view may also change the scale that the model chooses: compare in the student's.
        ratio = (student.depth[: len(index)].detach() / depth).flatten().median()
        camera, depth = scale_camera_vectors(camera, ratio), depth * ratio
        if splats is not None:
            splats = splats + ratio.log() * splats.new_tensor([0.0, 1, 1, 1])
    if config.warp_targets:
        depth, normals = _warp_maps(depth, normals, grids)
        splats = None if splats is None else _warp_splats(splats, grids)
    return ViewGeometry(camera_vector=camera, depth=depth, normals=normals, splats=splats)


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


def _warp_splats(splats: Tensor, grids: list[Grid | None]) -> Tensor:
    """The same for what belongs to the pixels' Gaussians."""
    moved = [
        own if grid is None else warp_maps(own.permute(2, 0, 1), grid).permute(1, 2, 0)
        for own, grid in zip(splats, grids, strict=True)
    ]
    return torch.stack(moved)
