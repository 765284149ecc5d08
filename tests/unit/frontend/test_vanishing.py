"""Focal length from drawn lines whose camera is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sceneexpander.frontend.vanishing import (
    FocalEvidence,
    find_segments,
    vanishing_focal,
)

SIZE = (480, 640)
TURNS = [(35, 12, 3), (-50, -15, -2), (125, 10, 5)]  # degrees: yaw, pitch, roll


def cam_from_box(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """A camera (OpenCV axes) that looks along the box's z, then turned; the box's y is down."""
    turns = [
        cv2.Rodrigues(np.deg2rad(np.array(axis)))[0] for axis in ((0.0, yaw, 0.0), (pitch, 0.0, 0.0), (0.0, 0.0, roll))
    ]
    return turns[2] @ turns[1] @ turns[0]


def drawn_room(rotation: np.ndarray, focal_ratio: float, *, seed: int = 0, size: tuple[int, int] = SIZE) -> Tensor:
    """A picture of bricks lying around the camera: rectangles on the walls of a box, drawn as lines."""
    rng = np.random.default_rng(seed)
    height, width = size
    focal = focal_ratio * max(size)
    canvas = np.full((height, width), 200, np.uint8)
    drawn = 0
    while drawn < 150:
        axis, wall = rng.integers(3), rng.integers(3)
        if axis == wall:
            continue
        middle = rng.uniform(-3, 3, 3)
        middle[wall] = rng.choice([-3.0, 3.0])
        ends = np.stack([middle, middle])
        ends[:, axis] += np.array([-0.5, 0.5]) * rng.uniform(0.6, 2.0)
        cam = ends @ rotation.T
        if (cam[:, 2] < 0.3).any():
            continue
        pixels = cam[:, :2] / cam[:, 2:] * focal + np.array([width, height]) / 2 - 0.5
        if (np.abs(pixels) > 4 * width).any():
            continue
        fixed = [tuple(round(float(v) * 16) for v in end) for end in pixels]
        cv2.line(canvas, fixed[0], fixed[1], int(rng.integers(0, 120)), 2, cv2.LINE_AA, 4)
        inside = (pixels > 0).all(1) & (pixels < np.array([width, height])).all(1)
        drawn += bool(inside.any())
    return torch.from_numpy(canvas.astype(np.float32) / 255).expand(3, -1, -1).clone()


def random_lines(seed: int) -> Tensor:
    """Lines without any order."""
    rng = np.random.default_rng(seed)
    canvas = np.full(SIZE, 200, np.uint8)
    for _ in range(120):
        start = rng.uniform(0, 1, 2) * np.array(SIZE[::-1])
        angle, length = rng.uniform(0, np.pi), rng.uniform(40, 160)
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(canvas, tuple(start.astype(int).tolist()), tuple(end.astype(int).tolist()), 30, 2, cv2.LINE_AA)
    return torch.from_numpy(canvas.astype(np.float32) / 255).expand(3, -1, -1).clone()


def evidence(images: list[Tensor]) -> FocalEvidence:
    found = vanishing_focal(images)
    assert found is not None
    return found


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("focal_ratio", [0.45, 0.8, 1.5])
def test_one_view_tells_its_focal(focal_ratio: float, turn: tuple[float, float, float]) -> None:
    rotation = cam_from_box(*turn)
    found = evidence([drawn_room(rotation, focal_ratio)])
    assert found.focal_ratio == pytest.approx(focal_ratio, rel=0.04)
    assert found.sigma < 0.1


def test_the_size_of_the_picture_and_its_shape_do_not_matter() -> None:
    rotation = cam_from_box(*TURNS[0])
    for size in ((640, 480), (960, 1280)):
        found = evidence([drawn_room(rotation, 0.9, size=size)])
        assert found.focal_ratio == pytest.approx(0.9, rel=0.04)


def test_views_are_pooled_and_told_apart() -> None:
    alike = [drawn_room(cam_from_box(*turn), 0.9, seed=k) for k, turn in enumerate(TURNS)]
    found = evidence(alike)
    assert found.focal_ratio == pytest.approx(0.9, rel=0.03)
    zoomed = evidence([*alike[:2], drawn_room(cam_from_box(*TURNS[2]), 1.5, seed=2)])
    assert zoomed.sigma > 2 * found.sigma
    alone = [focal for focal, _ in filter(None, zoomed.per_view)]
    assert alone == pytest.approx([0.9, 0.9, 1.5], rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_lines_without_order_claim_nothing(seed: int) -> None:
    found = vanishing_focal([random_lines(seed)])
    assert found is None or found.sigma > 0.2


@pytest.mark.parametrize("focal_ratio", [0.6, 1.2])
def test_a_frontal_view_knows_that_it_says_nothing_about_the_focal(focal_ratio: float) -> None:
    image = drawn_room(cam_from_box(0, 0, 0), focal_ratio)
    found = vanishing_focal([image])
    assert found is None or found.sigma > 0.15


@pytest.mark.parametrize(
    "image", [torch.zeros(3, 120, 160), torch.rand(3, 240, 320, generator=torch.Generator().manual_seed(0))]
)
def test_pictures_without_lines_say_nothing(image: Tensor) -> None:
    found = vanishing_focal([image, image])
    assert found is None or found.sigma > 0.2


def test_the_same_pictures_give_the_same_bits() -> None:
    images = [drawn_room(cam_from_box(*turn), 0.9, seed=k) for k, turn in enumerate(TURNS[:2])]
    first, second = evidence(images), evidence(images)
    assert (first.focal_ratio, first.sigma) == (second.focal_ratio, second.sigma)
    assert (first.curve == second.curve).all()


def test_pieces_of_one_line_are_joined() -> None:
    canvas = torch.ones(3, 300, 400)
    for k in range(5):
        canvas[:, 150:154, 60 + 50 * k : 104 + 50 * k] = 0
    found = find_segments(canvas)
    assert found.count <= 4  # its two edges, and nothing but them
    assert max(found.length) * 400 == pytest.approx(244, abs=6)
