"""A misaligned view deviates by exactly what its record says."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.synthetic import build_world, encode_radiance, render_world
from sceneexpander.synthetic.misalign import Misalignment, deformed_world, misalign, smooth_warp, warp_image
from sceneexpander.synthetic.trajectories import pose_from_angles, same_lens

HEIGHT, WIDTH = 48, 64


@pytest.fixture(scope="module")
def view() -> tuple:
    world = build_world(np.random.default_rng(4), "room")
    pose = pose_from_angles(world.bounds.mean(0).astype(np.float64), 0.4, 0.0, 0.0)
    return world, same_lens(pose, 50.0, HEIGHT, WIDTH)


def test_grade_zero_changes_nothing(view: tuple) -> None:
    world, camera = view
    clean = render_world(world, camera)
    same = misalign(world, camera, Misalignment.graded(0), np.random.default_rng(0), exposure=1.0)
    np.testing.assert_allclose(same.image, encode_radiance(clean.radiance[0], 1.0), atol=1e-5)
    np.testing.assert_array_equal(same.object_id, clean.object_id[0])
    assert same.moved == ()


def test_pose_shift_and_gains_are_as_asked(view: tuple) -> None:
    world, camera = view
    asked = Misalignment(rotation_deg=3.0, translation_fraction=0.05, exposure_stops=0.5, white_balance=0.1)
    got = misalign(world, camera, asked, np.random.default_rng(1), exposure=1.0)
    pose = camera.world_from_cam[0].numpy()
    angle = rotation_angle_deg(torch.from_numpy(pose[:3, :3]), torch.from_numpy(got.world_from_used_cam[:3, :3]))
    assert float(angle) == pytest.approx(3.0, abs=1e-4)
    step = np.linalg.norm(got.world_from_used_cam[:3, 3] - pose[:3, 3])
    assert step == pytest.approx(0.05 * got.scene_size_m, rel=1e-6)
    assert got.gains == pytest.approx((1.1 * 2**0.5, 2**0.5, 2**0.5 / 1.1))
    json.dumps(got.record())


def test_errors_grow_with_the_grade(view: tuple) -> None:
    world, camera = view
    clean = encode_radiance(render_world(world, camera).radiance[0], 1.0)
    errors = []
    for grade in (0.0, 0.5, 1.0, 2.0):
        settings = Misalignment.graded(grade)
        got = misalign(world, camera, settings, np.random.default_rng(2), exposure=1.0)
        errors.append(float(np.abs(got.image - clean).mean()))
    assert errors == sorted(errors)
    assert errors[1] > errors[0] + 1e-3


def test_hallucination_adds_a_named_object(view: tuple) -> None:
    world, camera = view
    got = misalign(world, camera, Misalignment(hallucinate=True), np.random.default_rng(3), exposure=1.0)
    names = got.world.object_names
    assert len(names) == len(world.object_names) + 1
    assert names[-1].startswith("hallucinated ")


def test_deformation_respects_fixed_and_together(view: tuple) -> None:
    world, _ = view
    names = world.object_names
    group, fixed = ("chair", "table", "picture", "window", "door"), ("sofa", "lamp")
    bent, moved = deformed_world(world, 0.1, 1.0, 0.05, np.random.default_rng(0), fixed=fixed, together=group)
    moved_names = {name for name, *_ in moved}
    assert moved
    assert not moved_names & {*fixed, "room"}
    shared = {(shift, factor) for name, _, shift, factor in moved if name in group}
    assert len(shared) == 1
    still = np.isin(world.object_id, [i for i, name in enumerate(names) if name not in moved_names])
    np.testing.assert_array_equal(world.centre[still], bent.centre[still])
    assert np.abs(bent.centre[~still] - world.centre[~still]).max() > 0.02


def test_warp_is_smooth_and_bounded() -> None:
    field = smooth_warp(60, 80, 3.0, np.random.default_rng(5))
    assert np.hypot(field[..., 0], field[..., 1]).max() == pytest.approx(3.0, rel=1e-5)
    assert np.abs(np.diff(field, axis=1)).max() < 0.5
    picture = np.random.default_rng(0).random((60, 80, 3)).astype(np.float32)
    shifted = warp_image(picture, np.full((60, 80, 2), 2.0, np.float32))
    # p + d: the picture moves to the left and up.
    np.testing.assert_allclose(shifted[:-2, :-2], picture[2:, 2:], atol=1e-6)


@pytest.mark.parametrize(
    "asked",
    [
        Misalignment(stretch=0.08),
        Misalignment(zoom=0.2),
        Misalignment(shift_fraction=0.05),
        Misalignment(stretch=0.04, zoom=0.1, shift_fraction=0.02, warp_fraction=0.02),
    ],
)
def test_the_truth_map_says_where_everything_went(view: tuple, asked: Misalignment) -> None:
    world, camera = view
    clean = render_world(world, camera).object_id[0].astype(np.float32)
    got = misalign(world, camera, asked, np.random.default_rng(6), exposure=1.0)
    undone = warp_image(clean, got.warp_px, nearest=True)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    there = np.stack([x, y], -1) + got.warp_px
    inside = (there >= 0).all(-1) & (there <= [WIDTH - 1, HEIGHT - 1]).all(-1)
    assert inside.mean() > 0.7
    # Labels change at borders, where half a pixel decides.
    wrong, unmapped = (float((labels != got.object_id)[inside].mean()) for labels in (undone, clean))
    assert wrong < 0.03
    assert unmapped > 1.5 * wrong


def test_stretch_zoom_and_shift_are_as_asked(view: tuple) -> None:
    world, camera = view
    middle = HEIGHT // 2, WIDTH // 2

    def map_of(asked: Misalignment) -> np.ndarray:
        got = misalign(world, camera, asked, np.random.default_rng(7), exposure=1.0)
        return got.warp_px

    stretched, zoomed = map_of(Misalignment(stretch=0.08)), map_of(Misalignment(zoom=0.2))
    assert np.diff(stretched[0, :, 0]) == pytest.approx(1 / 1.08 - 1, abs=1e-4)
    assert stretched[..., 1] == pytest.approx(0, abs=1e-4)
    assert np.diff(zoomed[:, 0, 1]) == pytest.approx(1 / 1.2 - 1, abs=1e-4)
    assert np.hypot(*zoomed[middle]) < 0.2
    shifted = map_of(Misalignment(shift_fraction=0.05))
    assert np.hypot(shifted[..., 0], shifted[..., 1]) == pytest.approx(0.05 * WIDTH, abs=1e-3)


def test_negative_grade_is_refused() -> None:
    with pytest.raises(ValueError, match="grade is -1"):
        Misalignment.graded(-1)
