"""Pictures as a set of views."""

from __future__ import annotations

import torch

from sceneexpander.artifacts.views import ViewRecord, ViewSet


def view_set(images: torch.Tensor, *, generated: bool) -> ViewSet:
    height, width = images.shape[-2:]
    affine = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    records = tuple(
        ViewRecord(
            view_id=f"{index}_{generated}", name="x.png", original_height=height, original_width=width, sha256="0",
            stored_from_original=affine, generated=generated, round=int(generated),
        )
        for index in range(len(images))
    )  # fmt: skip
    return ViewSet(records=records, images=images, detail_images=images)
