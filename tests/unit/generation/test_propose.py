"""Proposed motions lead to what the scene does not show, and stay where enough of it is seen."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.motion import parse_motion
from sceneexpander.generation.propose import FEWEST_NEW, FEWEST_SEEN, measure_coverage, propose_motions
from tests.worlds.wall import HEIGHT, WIDTH, made_reconstruction, own_pictures


def scene(eyes_x: tuple[float, ...] = (0.0, 0.3)) -> SceneSoFar:
    made = made_reconstruction(eyes_x, generated_last=False)
    return SceneSoFar(views=own_pictures(made), reconstruction=made)


def test_proposals_are_new_seen_and_understood() -> None:
    found = propose_motions(scene())
    assert len(found) == 3
    assert [item.new for item in found] == sorted((item.new for item in found), reverse=True)
    for item in found:
        assert FEWEST_NEW <= item.new <= 1 - FEWEST_SEEN
        assert parse_motion(item.words, where="here") == item.steps
        assert item.preview.shape == (3, HEIGHT, WIDTH)
        assert float(item.preview.min()) >= 0
    assert len({item.words for item in found}) == 3


def test_what_is_covered_on_one_side_is_not_proposed() -> None:
    """Photos that reach far to the right leave nothing to turn right for."""
    so_far = scene((0.0, 0.0, 2.0, 4.0, 6.0))
    found = [item for item in propose_motions(so_far) if item.steps[0].kind == "turn"]
    assert any(item.steps[0].direction == "left" for item in found)
    assert all(item.steps[0].direction != "right" or item.steps[0].amount > 35 for item in found)
    turns = {item.steps[0].direction: item.direction_deg[0] for item in found}
    assert turns["left"] < 0, "azimuth grows to the right"


def test_coverage_is_the_share_of_the_sphere() -> None:
    """A wall of known extent covers a known solid angle, seen from the middle of the cameras."""
    so_far = scene((0.0, 0.0))
    coverage = measure_coverage(so_far)
    # The wall reaches as far as the view does: a pyramid with the picture's half angles.
    across, up = WIDTH / 2 / 40, HEIGHT / 2 / 40
    solid = 4 * math.asin(across * up / math.sqrt((1 + across**2) * (1 + up**2)))
    assert coverage.share == pytest.approx(solid / (4 * math.pi), rel=0.15)
    height, width = coverage.panorama.shape[1:]
    assert float(coverage.panorama[:, height // 2, width // 2].max()) > 0.1, "the start view looks at the middle"
    assert float(coverage.panorama[:, :, : width // 4].max()) == 0, "nothing is known behind it"


def test_the_map_does_not_depend_on_the_frame() -> None:
    so_far = scene((0.0, 0.3))
    made = so_far.reconstruction
    turn = torch.tensor([[0.0, 0.0, 1.0, 5.0], [0.0, 1.0, 0.0, -2.0], [-1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    gaussians = dataclasses.replace(made.gaussians, means=made.gaussians.means @ turn[:3, :3].T + turn[:3, 3])
    moved = dataclasses.replace(made, gaussians=gaussians, world_from_cam=turn @ made.world_from_cam)
    one, other = measure_coverage(so_far), measure_coverage(dataclasses.replace(so_far, reconstruction=moved))
    assert other.share == pytest.approx(one.share, abs=1e-3)
    assert float((one.panorama - other.panorama).abs().mean()) < 1e-2
