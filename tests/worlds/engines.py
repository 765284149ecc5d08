"""Small models to adapt, with their inputs."""

import string

import torch

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.inputs import AdaptationInputs
from sceneexpander.adaptation.loop import AdaptationResult, adapt
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.protocol import GEOMETRY_HEADS, Reconstructor
from tests.support.tiny_worldmirror import random_images, tiny_worldmirror
from tests.worlds.small_mini import make_model, scene

STEPS = AdaptConfig(
    observe_every=0, steps=3, learning_rate=1e-3, insertion_probability=1.0, restore_interval=2, restore_rate=0.01
)


def adapted_worldmirror() -> tuple[Reconstructor, AdaptationInputs]:
    return tiny_worldmirror(), inputs_for(tiny_worldmirror(), random_images(5), None)


def adapted_mini() -> tuple[Reconstructor, AdaptationInputs]:
    images, priors = scene(5, 28, 42)
    return make_model(perturbed=True), inputs_for(make_model(perturbed=True), images, priors)


def inputs_for(model: Reconstructor, images: torch.Tensor, priors: Priors | None) -> AdaptationInputs:
    count = len(images) - 1  # the last one is inserted
    captured = None if priors is None else priors.select(range(count))
    with torch.no_grad():
        frozen = model.predict(images[:count], captured, heads=GEOMETRY_HEADS)
    anchors = Anchors(
        weights_sha256="0",
        view_ids=tuple(string.ascii_lowercase[:count]),
        camera_vector=frozen.camera_vector,
        depth=frozen.depth,
        depth_conf=frozen.depth_conf,
        normals=frozen.normals,
        normals_conf=frozen.normals_conf,
    )
    return AdaptationInputs(
        captured=images[:count], inserted=images[count], anchors=anchors, captured_priors=captured, joint_priors=priors
    )


def run_steps(make: object, config: AdaptConfig) -> AdaptationResult:
    model, inputs = make()  # type: ignore[operator]
    return adapt(model, inputs, config, seed=0)
