"""Ghosting and the consistency of the camera path: good on frames of one place, worst on everything that is none."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.ghosting import GhostingFound, find_ghosting
from sceneexpander.evaluation.tour import Frames, measure_tour
from sceneexpander.geometry.camera import intrinsics_from_parts, pixel_centres
from sceneexpander.geometry.rigid import look_at

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0
CONTROLS = ("noise", "repeats", "unrelated", "blank")


def texture(seed: int, height: int = 300, width: int = 400) -> torch.Tensor:
    """Random blobs of several sizes: structure that looks different everywhere."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 3, height, width)
    for cell, weight in ((4, 0.6), (10, 0.8), (32, 0.8)):
        coarse = torch.rand(1, 3, height // cell + 1, width // cell + 1, generator=generator) - 0.5
        image += weight * torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)
    return (image + 0.5).clamp(0, 1)[0]


def tour(seed: int = 0) -> Frames:
    """Five cameras that move and turn before a wavy textured wall (x and y on the texture follow the ray, depth is exact)."""
    eyes = torch.tensor([[0.0, 0, 0], [0.25, 0.02, 0.05], [0.5, -0.02, 0.1], [0.75, 0.03, 0.05], [1.0, 0, 0.0]])
    ahead = eyes + torch.tensor([[0.0, 0.0, 1.0], [-0.02, 0, 1], [-0.04, 0.02, 1], [-0.06, 0, 1], [-0.1, 0, 1]])
    poses = look_at(eyes, ahead, torch.tensor([0.0, -1.0, 0.0]))
    ones = torch.ones(len(eyes))
    lenses = intrinsics_from_parts(FOCAL * ones, FOCAL * ones, WIDTH / 2 * ones, HEIGHT / 2 * ones)
    pixel = pixel_centres(HEIGHT, WIDTH, like=eyes)
    rays = torch.cat([(pixel - torch.tensor([WIDTH / 2, HEIGHT / 2])) / FOCAL, torch.ones(HEIGHT, WIDTH, 1)], -1)
    wall = texture(seed)
    depths, pictures = [], []
    for pose in poses:
        turned = rays @ pose[:3, :3].T
        length = torch.full((HEIGHT, WIDTH), 3.0)
        for _ in range(60):  # where the ray meets z = 3 + 0.5 sin(1.5 x) + 0.4 cos(2 y)
            x, y, _z = (pose[:3, 3] + turned * length[..., None]).unbind(-1)
            length = (3 + 0.5 * torch.sin(1.5 * x) + 0.4 * torch.cos(2 * y) - pose[2, 3]) / turned[..., 2]
        x, y, _z = (pose[:3, 3] + turned * length[..., None]).unbind(-1)
        grid = torch.stack([(x - 0.5) / 3.5, y / 2.6], -1)
        pictures.append(torch.nn.functional.grid_sample(wall[None], grid[None], align_corners=False)[0])
        depths.append(length)
    return Frames(
        rgb=torch.stack(pictures),
        depth=torch.stack(depths),
        alpha=torch.ones(len(eyes), HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=lenses,
    )


def control(frames: Frames, kind: str) -> Frames:
    """The same cameras with pictures that do not show the place."""
    rgb = frames.rgb
    made = {
        "noise": lambda: torch.rand(rgb.shape, generator=torch.Generator().manual_seed(3)),
        "repeats": lambda: rgb[:1].expand_as(rgb).clone(),
        "unrelated": lambda: torch.stack([texture(10 + i, HEIGHT, WIDTH) for i in range(len(rgb))]),
        "blank": lambda: torch.full_like(rgb, 0.4),
    }
    return dataclasses.replace(frames, rgb=made[kind]())


@pytest.fixture(scope="module")
def good() -> dict[str, float | None]:
    return measure_tour(tour(), EvaluateConfig())


def number(values: dict[str, float | None], name: str) -> float:
    value = values[name]
    assert value is not None
    return value


def test_frames_of_one_place_are_registered_where_they_are(good: dict[str, float | None]) -> None:
    assert number(good, "tour_registered") == 1
    assert number(good, "tour_camera_auc") > 0.7
    assert number(good, "tour_tsed") == 1
    assert number(good, "tour_steadiness") > 0.8
    assert number(good, "tour_rotation_deg") < 1


@pytest.mark.parametrize("kind", CONTROLS)
def test_what_shows_no_place_is_worst_by_every_number(good: dict[str, float | None], kind: str) -> None:
    bad = measure_tour(control(tour(), kind), EvaluateConfig())
    for name in ("tour_registered", "tour_camera_auc", "tour_tsed", "tour_steadiness", "tour_observations"):
        assert number(bad, name) < 0.4 * number(good, name), name
    assert bad["tour_rotation_deg"] is None or number(bad, "tour_rotation_deg") > number(good, "tour_rotation_deg")


def test_frames_seen_by_other_cameras_than_the_tours_cost_cameras_and_tsed(good: dict[str, float | None]) -> None:
    frames = tour()
    order = [2, 0, 4, 1, 3]
    shuffled = measure_tour(dataclasses.replace(frames, rgb=frames.rgb[order]), EvaluateConfig())
    assert number(shuffled, "tour_registered") == 1, "they are one place nevertheless"
    assert number(shuffled, "tour_camera_auc") < 0.5 * number(good, "tour_camera_auc")


def test_repeated_frames_lie_on_their_epipolar_lines_and_are_refused_for_not_moving() -> None:
    frames = tour()
    straight = frames.world_from_cam.clone()
    straight[:, :3, :3] = straight[0, :3, :3]  # translation alone: every point lies on its own epipolar line
    repeats = dataclasses.replace(control(frames, "repeats"), world_from_cam=straight)
    found = measure_tour(repeats, EvaluateConfig())
    assert found["tour_tsed"] == 0
    assert found["tour_registered"] == 0


def test_frames_that_are_not_finite_are_refused() -> None:
    frames = tour()
    frames.rgb[2, 0, 5, 5] = float("nan")
    with pytest.raises(ValueError, match="non-finite"):
        measure_tour(frames, EvaluateConfig())


def ghosting(photo: torch.Tensor, seen: torch.Tensor) -> GhostingFound:
    found = find_ghosting(photo, seen, torch.ones(photo.shape[1:], dtype=torch.bool))
    assert found is not None
    return found


def test_ghosting_finds_shifted_and_doubled_structure_and_not_exposure_or_softness() -> None:
    photo = texture(1, 240, 320)
    soft = torch.nn.functional.avg_pool2d(photo, 3, stride=1, padding=1, count_include_pad=False)
    assert ghosting(photo, photo) == GhostingFound(ghosted=0.0, offset=0.0)
    assert ghosting(photo, 0.8 * soft + 0.05).ghosted < 0.05
    shifted = ghosting(photo, photo.roll(8, dims=-1))
    assert shifted.ghosted > 0.95
    assert shifted.offset == pytest.approx(8 / 320, abs=0.003)
    assert ghosting(photo, 0.5 * photo + 0.5 * photo.roll(8, dims=-1)).ghosted > 0.6


@pytest.mark.parametrize("kind", CONTROLS)
def test_ghosting_is_worst_where_the_photo_is_not_shown(kind: str) -> None:
    frames = tour()
    assert ghosting(frames.rgb[2], control(frames, kind).rgb[2]).ghosted > 0.9


@pytest.mark.wrong_shapes
def test_ghosting_needs_structure_and_equal_finite_pictures() -> None:
    photo = texture(1, 120, 160)
    everywhere = torch.ones(120, 160, dtype=torch.bool)
    assert find_ghosting(photo, photo, ~everywhere) is None
    assert find_ghosting(torch.full_like(photo, 0.5), photo, everywhere) is None
    with pytest.raises(ValueError, match="cannot compare"):
        find_ghosting(photo, photo[:, :100], everywhere)
    with pytest.raises(ValueError, match="non-finite"):
        find_ghosting(photo, photo * torch.nan, everywhere)


def test_ghosting_is_a_matter_of_the_picture_not_of_its_size() -> None:
    """Pieces grow with it, so that as many are looked up in a picture of three times the pixels per side."""
    small = texture(1, 240, 320)
    double = 0.5 * small + 0.5 * small.roll(5, dims=-1)
    once = ghosting(small, double)
    thrice = ghosting(
        *(torch.nn.functional.interpolate(it[None], scale_factor=3, mode="bicubic")[0] for it in (small, double))
    )
    assert thrice.ghosted == pytest.approx(once.ghosted, abs=0.06)
    assert thrice.offset == pytest.approx(once.offset, abs=0.003)


def test_structure_of_equal_brightness_is_none() -> None:
    """Brightness is what Rec. 601 makes of a colour: red by 0.299, green by 0.587, blue by 0.114."""
    waves = texture(2, 120, 160)[0] - 0.5
    waves /= waves.abs().max()
    everywhere = torch.ones(120, 160, dtype=torch.bool)
    weights = (0.299, 0.587, 0.114)
    for up, down in ((0, 1), (1, 0), (2, 1)):
        amount = 0.45 * min(1.0, weights[down] / weights[up])
        picture = torch.full((3, 120, 160), 0.5)
        picture[up] += amount * waves
        assert find_ghosting(picture, picture, everywhere) is not None
        picture[down] -= amount * weights[up] / weights[down] * waves
        assert find_ghosting(picture, picture, everywhere) is None
