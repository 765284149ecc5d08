"""Random changes that keep a sample true: mirror, order and subset of views, colours."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sceneexpander.training.sample import Sample


def augment(sample: Sample, generator: torch.Generator) -> Sample:
    """Mirror (half of the time), random order, sometimes one view fewer, colours of all views changed together or apart."""
    chance = torch.rand(3, generator=generator).tolist()
    order = torch.randperm(sample.inputs, generator=generator).tolist()
    # The first view defines the world, so it must have a pose.
    first = next((view for view in order if bool(sample.posed[view])), order[0])
    order = [first, *(view for view in order if view != first)]
    if sample.inputs > 2 and chance[0] < 0.2:
        order = order[:-1]
    sample = sample.select_inputs(order)
    if chance[1] < 0.5:
        sample = mirror_sample(sample)
    return replace(sample, images=jitter_colours(sample.images, generator, apart=chance[2] < 0.3))


def mirror_sample(sample: Sample) -> Sample:
    """The sample as seen in a vertical mirror: x becomes -x in pictures, cameras and normals."""
    width = sample.images.shape[-1]
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))

    def intrinsics(value: Tensor) -> Tensor:
        value = value.clone()
        value[:, 0, 2] = width - value[:, 0, 2]
        return value

    return replace(
        sample,
        images=sample.images.flip(-1),
        log_depth=sample.log_depth.flip(-1),
        normals=sample.normals.flip(-2) * torch.tensor([-1.0, 1.0, 1.0]),
        world_from_cam=flip @ sample.world_from_cam @ flip,
        intrinsics_px=intrinsics(sample.intrinsics_px),
        prior_world_from_cam=flip @ sample.prior_world_from_cam @ flip,
        prior_intrinsics_px=intrinsics(sample.prior_intrinsics_px),
        prior_log_depth=sample.prior_log_depth.flip(-1),
        sparse_log_depth=sample.sparse_log_depth.flip(-1),
        evidence=sample.evidence.flip(-1),
    )


def jitter_colours(images: Tensor, generator: torch.Generator, *, apart: bool) -> Tensor:
    """Gain per channel, contrast and gamma; one draw for all views, or one for each."""
    count = len(images) if apart else 1
    strength = 0.4 if apart else 1.0
    gain = (0.15 * strength * torch.randn(count, 3, 1, 1, generator=generator)).exp()
    gamma = (0.2 * strength * torch.randn(count, 1, 1, 1, generator=generator)).exp()
    return (images.clamp(min=1e-4).pow(gamma) * gain).clamp(0, 1)
