"""The smallest adaptation."""

import torch

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.loop import (
    AdaptationInputs,
)
from tests.support.tiny_model import TinyReconstructor, tiny_images
from tests.worlds.anchors import anchors_of

FAST = AdaptConfig(
    observe_every=0, steps=8, learning_rate=1e-2, restore_interval=3, restore_rate=0.05, checkpoint_every=3
)


def inputs_for(captured: int = 4, inserted_seed: int = 9) -> AdaptationInputs:
    images = tiny_images(captured)
    with torch.no_grad():
        frozen = TinyReconstructor().predict(images)
    anchors = anchors_of(frozen)
    return AdaptationInputs(
        captured=images,
        inserted=tiny_images(1, seed=inserted_seed)[0],
        anchors=anchors,
        captured_priors=None,
        joint_priors=None,
    )
