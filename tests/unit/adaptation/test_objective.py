"""What a step minimises: every weight where the paper has it, every target at its own view and its own pixel."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.adaptation.augmentation import draw_warp
from sceneexpander.adaptation.config import AdaptConfig, AugmentConfig, Gauge
from sceneexpander.adaptation.losses import ViewGeometry, anchor_loss, generation_loss
from sceneexpander.adaptation.objective import anchor_targets, step_losses
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.geometry.gauge import camera_vectors_relative_to, scale_camera_vectors
from sceneexpander.geometry.lookup import warp_maps

VIEWS, H, W = 5, 12, 16
WARPED = AugmentConfig(identity=0, global_affine=0.5, blockwise=0.5, global_and_block=0)


def geometry(seed: int, views: int = VIEWS) -> ViewGeometry:
    draw = torch.Generator().manual_seed(seed)
    vector = torch.randn(views, 9, generator=draw)
    vector[:, 3:7] = torch.nn.functional.normalize(vector[:, 3:7], dim=-1)
    return ViewGeometry(
        camera_vector=vector,
        depth=1 + torch.rand(views, H, W, generator=draw),
        normals=torch.nn.functional.normalize(torch.randn(views, H, W, 3, generator=draw), dim=-1),
    )


@pytest.mark.parametrize(("anchor", "gen"), [(2.0, 3.0), (0.0, 3.0), (2.0, 0.0), (1.0, 0.05)])
def test_the_objective_is_the_weighted_sum_of_both_losses(anchor: float, gen: float) -> None:
    config = AdaptConfig(lambda_anchor=anchor, lambda_gen=gen)
    student, anchors, teacher = geometry(0, 4), geometry(1, 3), geometry(2, 1)
    found = step_losses(student, anchors, teacher, config)
    a, g = anchor_loss(student.view(0, 3), anchors, config), generation_loss(student.view(3), teacher, config)
    assert float(found.objective) == pytest.approx(anchor * float(a.total) + gen * float(g.total), rel=1e-6)
    assert float(found.objective) == pytest.approx(
        anchor * float(found.anchor_camera + found.anchor_depth + found.anchor_normal)
        + gen * float(found.gen_camera + found.gen_depth + found.gen_normal),
        rel=1e-6,
    )


def test_gaussians_join_the_anchors_with_a_weight_of_their_own() -> None:
    config = AdaptConfig(lambda_anchor=2.0, alpha_gaussian=0.5)
    draw = torch.Generator().manual_seed(5)
    made, held = torch.rand(4, H, W, 4, generator=draw), torch.rand(VIEWS, H, W, 4, generator=draw)
    batch = Batch(captured=(0, 2, 3), inserted=True)
    student, anchors = replace(geometry(0, 4), splats=made), replace(geometry(1), splats=held)
    targets = anchor_targets(anchors, batch, [None] * 3, student, config)
    found = step_losses(student, targets, geometry(2, 1), config)
    off = (made[:3] - held[[0, 2, 3]]).abs()
    expected = 0.5 * float(off[..., 0].mean((1, 2)).sum() + off[..., 1:].mean((1, 2, 3)).sum())
    assert float(found.anchor_gaussian) == pytest.approx(expected, rel=1e-5)
    without = step_losses(replace(student, splats=None), targets, geometry(2, 1), config)
    assert float(found.objective - without.objective) == pytest.approx(2 * expected, rel=1e-4)
    grids = [draw_warp(WARPED, H, W, draw), None, None]
    moved = anchor_targets(anchors, batch, grids, student, replace(config, warp_targets=True))
    assert moved.splats is not None
    assert grids[0] is not None
    torch.testing.assert_close(moved.splats[0].movedim(-1, 0), warp_maps(held[0].movedim(-1, 0), grids[0]))
    assert torch.equal(moved.splats[1], held[2])


def test_without_the_inserted_view_there_is_no_self_distillation() -> None:
    config = AdaptConfig(lambda_anchor=2.0, lambda_gen=3.0)
    student, anchors = geometry(0, 3), geometry(1, 3)
    found = step_losses(student, anchors, None, config)
    assert float(found.gen_camera) == float(found.gen_depth) == float(found.gen_normal) == 0
    assert float(found.objective) == pytest.approx(2 * float(anchor_loss(student, anchors, config).total), rel=1e-6)


@pytest.mark.parametrize("chosen", [(0,), (0, 2, 3), (0, 1, 4), (0, 4), (0, 1, 2, 3, 4)])
@pytest.mark.parametrize("inserted", [False, True])
def test_every_view_is_held_to_its_own_anchor(chosen: tuple[int, ...], inserted: bool) -> None:
    anchors = geometry(0)
    batch = Batch(captured=chosen, inserted=inserted)
    student = geometry(1, len(chosen) + inserted)
    targets = anchor_targets(anchors, batch, [None] * len(chosen), student, AdaptConfig())
    for place, view in enumerate(chosen):
        assert torch.equal(targets.depth[place], anchors.depth[view])
        assert torch.equal(targets.normals[place], anchors.normals[view])
        assert torch.equal(targets.camera_vector[place], anchors.camera_vector[view])


@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_targets_follow_the_frame_and_the_scale_of_a_new_first_view(factor: float) -> None:
    anchors, chosen = geometry(0), (1, 3, 4)
    own = camera_vectors_relative_to(anchors.camera_vector[list(chosen)], 0)
    student = ViewGeometry(
        camera_vector=scale_camera_vectors(own, factor),
        depth=anchors.depth[list(chosen)] * factor,
        normals=anchors.normals[list(chosen)],
    )
    config = AdaptConfig(gauge=Gauge.REALIGN)
    targets = anchor_targets(anchors, Batch(captured=chosen, inserted=False), [None] * 3, student, config)
    torch.testing.assert_close(targets.depth, student.depth)
    torch.testing.assert_close(targets.camera_vector, student.camera_vector)
    assert float(anchor_loss(student, targets, config).total) < 1e-5


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_gaussians_grow_with_the_scene_and_stay_as_solid(factor: float) -> None:
    """In the scale of a new first view: opacities as they were, logarithms of sizes moved by the scale's. The inserted view has no say."""
    draw = torch.Generator().manual_seed(6)
    anchors, chosen = replace(geometry(0), splats=torch.randn(VIEWS, H, W, 4, generator=draw)), (1, 3, 4)
    held = anchors.splats
    assert held is not None
    grown = torch.cat([held[..., :1], held[..., 1:] + torch.tensor(factor).log()], dim=-1)[list(chosen)]
    other = geometry(3, 1)
    student = replace(
        geometry(1, 4),
        depth=torch.cat([anchors.depth[list(chosen)] * factor, other.depth * 50]),
        splats=torch.cat([grown, grown[:1]]),
    )
    targets = anchor_targets(
        anchors, Batch(captured=chosen, inserted=True), [None] * 3, student, AdaptConfig(gauge=Gauge.REALIGN)
    )
    assert targets.splats is not None
    torch.testing.assert_close(targets.splats, grown)
    torch.testing.assert_close(targets.depth, student.depth[:3])


def test_the_gauge_is_kept_while_the_first_view_is_there() -> None:
    """A student in another scale than the anchors is then a loss, as in the paper."""
    anchors, batch = geometry(0), Batch(captured=(0, 2), inserted=False)
    student = replace(anchors.view(0, 2), depth=anchors.depth[:2] * 2)
    for gauge in Gauge:
        targets = anchor_targets(anchors, batch, [None] * 2, student, AdaptConfig(gauge=gauge))
        assert torch.equal(targets.depth, anchors.depth[[0, 2]])


def test_warped_targets_move_exactly_as_the_pixels_of_their_view() -> None:
    anchors, batch = geometry(0), Batch(captured=(0, 2, 3), inserted=True)
    grids = [draw_warp(WARPED, H, W, torch.Generator().manual_seed(seed)) for seed in (1, 2, 3)]
    grids[1] = None
    config = AdaptConfig(warp_targets=True)
    targets = anchor_targets(anchors, batch, grids, geometry(1, 4), config)
    for place, view in enumerate(batch.captured):
        grid = grids[place]
        if grid is None:
            assert torch.equal(targets.depth[place], anchors.depth[view])
            assert torch.equal(targets.normals[place], anchors.normals[view])
            continue
        # The depth as the red channel of a picture, which the augmentation warps.
        picture = warp_maps(anchors.depth[view].expand(3, H, W), grid)
        torch.testing.assert_close(targets.depth[place], picture[0])
        moved = warp_maps(anchors.normals[view].movedim(-1, 0), grid).movedim(0, -1)
        torch.testing.assert_close(targets.normals[place], torch.nn.functional.normalize(moved, dim=-1))
        assert (targets.depth[place] - anchors.depth[view]).abs().max() > 0.05, "the test must see a warp"
    assert torch.equal(targets.camera_vector, anchors.camera_vector[list(batch.captured)])


def test_a_shift_by_whole_pixels_is_one() -> None:
    anchors, batch = geometry(0), Batch(captured=(0, 1), inserted=False)
    rows, columns = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    right = torch.stack([(columns + 3) / W, (rows - 2) / H], dim=-1) * 2 - 1  # looks 3 to the right, 2 up
    targets = anchor_targets(anchors, batch, [None, right], geometry(1, 2), AdaptConfig(warp_targets=True))
    torch.testing.assert_close(targets.depth[1, 2:, : W - 3], anchors.depth[1, : H - 2, 3:], atol=1e-5, rtol=0)
    plain = anchor_targets(anchors, batch, [None, right], geometry(1, 2), AdaptConfig())
    assert torch.equal(plain.depth, anchors.depth[:2]), "the paper's targets stay where they are"
