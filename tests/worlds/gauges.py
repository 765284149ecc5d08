"""Inputs of an adaptation in other frames and scales."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.adaptation.inputs import AdaptationInputs
from sceneexpander.geometry.priors import Priors
from tests.support.gauged_model import GaugedReconstructor, gauged_scene
from tests.worlds.anchors import anchors_of


def enlarged(priors: Priors, factor: float) -> Priors:
    assert priors.world_from_cam is not None
    assert priors.depth is not None
    poses = priors.world_from_cam.clone()
    poses[:, :3, 3] *= factor
    return replace(priors, world_from_cam=poses, depth=priors.depth * factor)


def inputs_of(captured: int, factor: float) -> AdaptationInputs:
    """A scene whose joint estimate has another scale."""
    images, priors = gauged_scene(captured + 1)
    alone = priors.select(range(captured))
    with torch.no_grad():
        frozen = GaugedReconstructor().predict(images[:captured], alone)
    anchors = anchors_of(frozen)
    return AdaptationInputs(
        captured=images[:captured],
        inserted=images[captured],
        anchors=anchors,
        captured_priors=alone,
        joint_priors=enlarged(priors, factor),
    )
