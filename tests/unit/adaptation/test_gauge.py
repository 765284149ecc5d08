"""One gauge: what was known of the captured views and what is known with the inserted one share frame and scale."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import pytest
import torch

from sceneexpander.adaptation.config import AdaptConfig, Gauge, InsertedWeights
from sceneexpander.adaptation.inputs import AdaptationInputs
from sceneexpander.adaptation.loop import Run, adapt
from sceneexpander.adaptation.objective import StepLosses
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.geometry.gauge import in_gauge_of, poses_relative_to
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.models.protocol import Reconstructor
from tests.support.gauged_model import GaugedReconstructor, gauged_scene
from tests.worlds.gauges import enlarged, inputs_of

LOSSES = AdaptConfig(observe_every=0, checkpoint_every=0)


def losses(inputs: AdaptationInputs, batch: Batch, config: AdaptConfig) -> StepLosses:
    """Of the unadapted model on unwarped views."""
    model: Reconstructor = GaugedReconstructor()
    run = Run(model, inputs, config, seed=0)
    return run.learner.losses(run.source.plain_views(batch), batch)


def subsets(count: int, gauge: Gauge) -> list[tuple[int, ...]]:
    every = [chosen for size in range(1, count + 1) for chosen in combinations(range(count), size)]
    return [chosen for chosen in every if gauge is Gauge.REALIGN or chosen[0] == 0]


@pytest.mark.parametrize("gauge", list(Gauge))
@pytest.mark.parametrize("captured", [1, 2, 3, 4])
def test_the_scale_of_the_joint_estimate_is_no_loss(captured: int, gauge: Gauge) -> None:
    config = replace(LOSSES, gauge=gauge)
    for chosen in subsets(captured, gauge):
        for inserted in (False, True):
            batch = Batch(captured=chosen, inserted=inserted)
            plain, scaled = (losses(inputs_of(captured, factor), batch, config) for factor in (1.0, 1.1))
            for name in ("anchor_camera", "anchor_depth", "anchor_normal"):
                value = float(getattr(scaled, name).detach())
                assert value == pytest.approx(float(getattr(plain, name).detach()), abs=2e-7), (chosen, inserted, name)
                assert value < 1e-5, f"the unadapted model is at its anchors: {name} of {chosen}"


@pytest.mark.parametrize("weights", list(InsertedWeights))
def test_steps_do_not_depend_on_the_scale_of_the_joint_estimate(weights: InsertedWeights) -> None:
    config = replace(LOSSES, steps=6, learning_rate=1e-3, insertion_probability=1.0, inserted_weights=weights)
    runs = [adapt(GaugedReconstructor(), inputs_of(4, factor), config, seed=0) for factor in (1.0, 1.1)]
    for name, value in runs[0].student.items():
        torch.testing.assert_close(value, runs[1].student[name], atol=1e-6, rtol=0)


def test_poses_and_depths_change_scale_together() -> None:
    _, priors = gauged_scene(4)
    back = in_gauge_of(priors.select(range(3)), enlarged(priors, 2.5))
    torch.testing.assert_close(back.world_from_cam, priors.world_from_cam)
    torch.testing.assert_close(back.depth, priors.depth)
    assert in_gauge_of(priors.select(range(3)), back) is back, "the same gauge is left alone, bit for bit"


def test_views_without_a_camera_have_no_say_in_the_scale() -> None:
    _, priors = gauged_scene(5)
    joint = enlarged(priors, 2.0)
    assert joint.depth is not None
    depth = joint.depth.clone()
    depth[[1, 2]] *= 5  # more than half of the captured views, were they counted
    lost = replace(joint, depth=depth, posed=torch.tensor([True, False, False, True, True]))
    back = in_gauge_of(priors.select(range(4)), lost)
    torch.testing.assert_close(back.world_from_cam, priors.world_from_cam)
    torch.testing.assert_close(back.depth[[0, 3, 4]], priors.depth[[0, 3, 4]])


def test_a_first_view_without_a_camera_does_not_tear_the_frames_apart() -> None:
    """The world is then a placeholder, and another one in each estimate."""
    _, priors = gauged_scene(4)
    assert priors.world_from_cam is not None
    elsewhere = poses_relative_to(enlarged(priors, 2.0).world_from_cam, 3)
    elsewhere = torch.cat([torch.eye(4)[None], elsewhere[1:]])
    posed = torch.tensor([False, True, True, True])
    joint = replace(enlarged(priors, 2.0), world_from_cam=elsewhere, posed=posed)
    back = in_gauge_of(replace(priors, posed=posed).select(range(3)), joint)
    torch.testing.assert_close(back.world_from_cam, priors.world_from_cam, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.depth, priors.depth)


def test_without_any_camera_on_both_sides_all_views_are_compared() -> None:
    _, priors = gauged_scene(3)
    lost = replace(enlarged(priors, 2.0), posed=torch.tensor([False, False, True]))
    assert in_gauge_of(priors.select(range(2)), lost).depth is not None
    torch.testing.assert_close(in_gauge_of(priors.select(range(2)), lost).depth, priors.depth)


def test_the_gauged_model_is_what_it_says() -> None:
    images, priors = gauged_scene(3)
    model = GaugedReconstructor()
    with torch.no_grad():
        whole, part = model.predict(images, priors), model.predict(images[1:], priors.select([1, 2]))
    assert float(rotation_angle_deg(part.world_from_cam[0, :3, :3], torch.eye(3))) < 0.1
    moved = rigid_inverse(whole.world_from_cam[1]) @ whole.world_from_cam[2]
    ratio = float((part.depth[0] / whole.depth[1]).median())
    assert abs(ratio - 1) > 0.02, "another first picture, another scale"
    torch.testing.assert_close(part.world_from_cam[1, :3, 3], moved[:3, 3] * ratio, atol=1e-5, rtol=1e-4)
