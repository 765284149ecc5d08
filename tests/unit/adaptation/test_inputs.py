"""The views of a step: what is warped, what is not, and what a step without the inserted view may know."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.adaptation.config import AdaptConfig, AugmentConfig, Gauge
from sceneexpander.adaptation.inputs import AdaptationInputs, ViewSource, geometry_of
from sceneexpander.adaptation.loop import adapt
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.geometry.lookup import warp_maps
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.mini import MiniConfig
from sceneexpander.models.mini.inputs import PreparedViews
from tests.support.gauged_model import GaugedReconstructor
from tests.worlds.engines import inputs_for
from tests.worlds.gauges import inputs_of
from tests.worlds.small_mini import TINY, make_model, scene

ALWAYS = AugmentConfig(identity=0, global_affine=0.4, blockwise=0.3, global_and_block=0.3)
STEPS = AdaptConfig(observe_every=0, checkpoint_every=0, steps=3, learning_rate=1e-3, augment=ALWAYS)
BATCH = Batch(captured=(0, 2, 3), inserted=True)


def mini_inputs(config: MiniConfig = TINY) -> AdaptationInputs:
    images, priors = scene(5, 56, 84)
    return inputs_for(make_model(perturbed=True, config=config), images, priors)


def prepared(inputs: AdaptationInputs, config: AdaptConfig, *, plain: bool = False) -> PreparedViews:
    source = ViewSource(make_model(perturbed=True), inputs, config, seed=0)
    views = source.plain_views(BATCH) if plain else source.views(BATCH, 1)
    assert isinstance(views.prepared, PreparedViews)
    return views.prepared


def test_captured_views_are_warped_and_the_inserted_one_is_not() -> None:
    inputs = inputs_of(4, 1.0)
    views = ViewSource(GaugedReconstructor(), inputs, STEPS, seed=0).views(BATCH, 1)
    assert len(views.grids) == 3
    assert torch.equal(views.images[3], inputs.inserted)
    assert views.priors is not None
    assert inputs.joint_priors is not None
    assert torch.equal(views.priors.depth[3], inputs.joint_priors.depth[4])
    for place, view in enumerate(BATCH.captured):
        grid = views.grids[place]
        assert grid is not None
        torch.testing.assert_close(views.images[place], warp_maps(inputs.captured[view], grid))
        assert (views.images[place] - inputs.captured[view]).abs().max() > 0.05


def test_every_view_and_step_has_a_warp_of_its_own() -> None:
    source = ViewSource(GaugedReconstructor(), inputs_of(4, 1.0), STEPS, seed=0)
    grids = [grid for step in (1, 2) for grid in source.views(BATCH, step).grids]
    assert all(not torch.equal(a, b) for i, a in enumerate(grids) for b in grids[:i])
    again = ViewSource(GaugedReconstructor(), inputs_of(4, 1.0), STEPS, seed=0).views(BATCH, 2).grids
    assert all(torch.equal(a, b) for a, b in zip(grids[3:], again, strict=True)), (
        "a draw depends on seed, step and view"
    )


def test_what_is_known_of_a_photo_moves_with_its_pixels() -> None:
    inputs = inputs_of(4, 1.0)
    assert inputs.joint_priors is not None
    assert inputs.joint_priors.depth is not None
    depth = inputs.joint_priors.depth.clone()
    depth[2, :, 5] = 0.0  # a column of which nothing is known
    evidence = torch.rand(5, 9, *depth.shape[1:], generator=torch.Generator().manual_seed(0))
    inputs = replace(inputs, joint_priors=replace(inputs.joint_priors, depth=depth, evidence=evidence))
    views = ViewSource(GaugedReconstructor(), inputs, STEPS, seed=0).views(BATCH, 1)
    priors = views.priors
    assert priors is not None
    for place, view in enumerate(BATCH.captured):
        grid = views.grids[place]
        assert grid is not None
        torch.testing.assert_close(priors.evidence[place], warp_maps(evidence[view], grid))
        known = priors.depth[place] > 0
        torch.testing.assert_close(priors.depth[place][known], warp_maps(depth[view][None], grid)[0][known])
        assert bool((priors.depth[place][known] > 1.9).all()), "nothing unknown is blended into a depth"
    assert 0 < int((priors.depth[1] == 0).sum()) < 60
    assert torch.equal(priors.world_from_cam, inputs.joint_priors.world_from_cam[[0, 2, 3, 4]])


def test_mini_reads_warped_depth_and_evidence_with_a_warped_picture() -> None:
    inputs = mini_inputs()
    warped, plain = prepared(inputs, STEPS), prepared(inputs, STEPS, plain=True)
    grids = ViewSource(make_model(), inputs, STEPS, seed=0).views(BATCH, 1).grids
    assert torch.equal(warped.working.fine[3, :3], plain.working.fine[3, :3]), "the inserted view stays"
    assert torch.equal(warped.priors.depth[3], plain.priors.depth[3])
    assert torch.equal(warped.working.coarse[3, :12], plain.working.coarse[3, :12])
    for place, grid in enumerate(grids):
        assert grid is not None
        torch.testing.assert_close(warped.images[place], warp_maps(plain.images[place], grid))
        torch.testing.assert_close(warped.priors.depth[place], warp_maps(plain.priors.depth[place][None], grid)[0])
        assert torch.equal(warped.priors.world_from_cam[place], plain.priors.world_from_cam[place])
        rays = slice(12, 14)
        assert torch.equal(warped.working.coarse[place, rays], plain.working.coarse[place, rays]), (
            "rays are the camera's"
        )
        # Against measuring the warped view anew, up to the smoothing of two resamplings instead of one.
        anew = make_model().measure(
            Priors(
                world_from_cam=torch.eye(4)[None],
                intrinsics_px=plain.priors.intrinsics_px[place][None],
                depth=warped.priors.depth[place][None],
                evidence=torch.zeros(1, 9, 56, 84),
            ),
            1,
            56,
            84,
        )
        inside = (slice(2, -2), slice(2, -2))
        error = (warped.priors.log_depth_fine[place] - anew.log_depth_fine[0])[inside].abs().mean()
        unmoved = (plain.priors.log_depth_fine[place] - anew.log_depth_fine[0])[inside].abs().mean()
        assert float(error) < 0.2 * float(unmoved)
        assert (warped.working.coarse[place, :9] - plain.working.coarse[place, :9]).abs().max() > 0.05
        assert (warped.working.coarse[place, 14:] - plain.working.coarse[place, 14:]).abs().max() > 0.05


def test_a_warp_that_moves_nothing_changes_nothing_for_mini() -> None:
    inputs = mini_inputs()
    still = replace(ALWAYS, rotation_deg=0, translation=0, scale=0, shear_deg=0)
    warped, plain = prepared(inputs, replace(STEPS, augment=still)), prepared(inputs, STEPS, plain=True)
    torch.testing.assert_close(warped.working.fine, plain.working.fine, atol=1e-4, rtol=0)
    torch.testing.assert_close(warped.working.coarse, plain.working.coarse, atol=1e-3, rtol=0)
    torch.testing.assert_close(warped.priors.depth, plain.priors.depth)
    half = plain.priors.base_normals
    torch.testing.assert_close(warped.priors.base_normals, half, atol=1e-3, rtol=0)


def test_warped_normals_are_those_of_the_warped_depth() -> None:
    inputs = mini_inputs()
    warped = prepared(inputs, STEPS)
    rows, columns = warped.priors.base_normals.shape[1:3]
    height, width = warped.priors.depth.shape[1:]
    log_depth = torch.nn.functional.avg_pool2d(warped.priors.log_depth_fine[:1, None], 2)[:, 0]
    scale = torch.tensor([columns / width, rows / height, 1.0])[:, None]
    expected = normals_from_depth(log_depth.exp(), warped.priors.intrinsics_px[:1] * scale)
    torch.testing.assert_close(warped.priors.base_normals[:1], expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("gauge", list(Gauge))
def test_with_p_0_nothing_of_the_joint_estimate_reaches_the_student(gauge: Gauge) -> None:
    """Cameras and depths that were found with the inserted view's help are knowledge of it."""
    inputs = mini_inputs()
    assert inputs.joint_priors is not None
    assert inputs.joint_priors.depth is not None
    bent = inputs.joint_priors.depth.clone()
    bent[1] *= 1.3
    other = replace(inputs, joint_priors=replace(inputs.joint_priors, depth=bent), inserted=1 - inputs.inserted)
    for p, runs in ((0.0, 1), (1.0, 2)):
        config = replace(STEPS, insertion_probability=p, gauge=gauge, steps=2)
        bits = {
            sha256_of_tensors(adapt(make_model(perturbed=True), given, config, seed=0).student)
            for given in (inputs, other)
        }
        assert len(bits) == runs


@pytest.mark.parametrize("count", [3, 4])
def test_what_is_measured_of_all_views_counts_the_inserted_one(count: int) -> None:
    """With an odd number of photos too: what is known of the inserted view is the joint estimate's last entry."""
    images, priors = scene(count + 1, 56, 84)
    inputs = inputs_for(make_model(perturbed=True), images, priors)
    assert inputs.joint_priors is not None
    views = ViewSource(make_model(perturbed=True), inputs, STEPS, seed=0).views(
        Batch(captured=(0, 2), inserted=True), 1
    )
    assert isinstance(views.prepared, PreparedViews)
    assert torch.equal(views.prepared.priors.depth[2], inputs.joint_priors.depth[count])


@pytest.mark.parametrize("captured", [(0, 2), (1, 3), (3, 1)])
def test_priors_stand_in_the_frame_of_the_first_view_that_is_there(captured: tuple[int, ...]) -> None:
    inputs = inputs_of(4, 1.0)
    known = inputs.joint_priors
    assert known is not None
    assert known.world_from_cam is not None
    priors = (
        ViewSource(GaugedReconstructor(), inputs, STEPS, seed=0)
        .views(Batch(captured=captured, inserted=True), 1)
        .priors
    )
    assert priors is not None
    assert priors.world_from_cam is not None
    first = torch.linalg.inv(known.world_from_cam[captured[0]])
    torch.testing.assert_close(priors.world_from_cam, first @ known.world_from_cam[[*captured, 4]])
    torch.testing.assert_close(priors.world_from_cam[0], torch.eye(4))


@pytest.mark.parametrize("missing", ["depth", "normals"])
def test_a_model_without_a_head_that_the_losses_read_is_refused(missing: str) -> None:
    inputs = inputs_of(2, 1.0)
    prediction = GaugedReconstructor().predict(inputs.captured, inputs.captured_priors)
    with pytest.raises(ValueError, match="needs the depth and normal heads"):
        geometry_of(replace(prediction, **{missing: None}))
