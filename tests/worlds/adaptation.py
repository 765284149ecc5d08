"""The smallest adaptation."""

import torch

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.loop import (
    AdaptationInputs,
)
from sceneexpander.artifacts.anchors import Anchors
from tests.support.tiny_model import TinyReconstructor, tiny_images

FAST = AdaptConfig(
    observe_every=0, steps=8, learning_rate=1e-2, restore_interval=3, restore_rate=0.05, checkpoint_every=3
)


def inputs_for(captured: int = 4, inserted_seed: int = 9) -> AdaptationInputs:
    images = tiny_images(captured)
    with torch.no_grad():
        frozen = TinyReconstructor().predict(images)
    anchors = Anchors(
        weights_sha256="0",
        view_ids=tuple(f"{i:03d}" for i in range(captured)),
        camera_vector=frozen.camera_vector,
        depth=frozen.depth,
        depth_conf=frozen.depth_conf,
        normals=frozen.normals,
        normals_conf=frozen.normals_conf,
    )
    return AdaptationInputs(
        captured=images,
        inserted=tiny_images(1, seed=inserted_seed)[0],
        anchors=anchors,
        captured_priors=None,
        joint_priors=None,
    )
