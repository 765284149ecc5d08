"""Which of several candidates is taken by itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.rank import rank_candidates
from sceneexpander.ingest.fit import FittedPicture, fit_picture
from tests.worlds.painted_wall import HEIGHT, WALL, WIDTH, blobs, tensor, view_of_wall
from tests.worlds.rounds import flat_scene, made_views


@pytest.fixture(scope="module")
def so_far() -> SceneSoFar:
    detail = torch.stack([tensor(view_of_wall(0.0))] * 3)
    images = torch.nn.functional.avg_pool2d(detail, 2)
    return flat_scene(made_views(images, detail), apart=0.0)


@pytest.fixture(scope="module")
def fitted(so_far: SceneSoFar) -> Callable[[np.ndarray], FittedPicture]:
    return lambda pixels: fit_picture(pixels, frame_of(so_far.views))


def test_the_candidate_that_goes_with_the_scene_is_first(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    further = view_of_wall(60.0)
    blurred = np.asarray(Image.fromarray(further).resize((40, 27)).resize((2 * WIDTH, 2 * HEIGHT)))
    elsewhere = blobs(9, 2 * HEIGHT, 2 * WIDTH)
    ranking = rank_candidates([fitted(elsewhere), fitted(blurred), None, fitted(further)], so_far, seed=0)
    assert ranking[0].candidate == 3
    assert {score.candidate for score in ranking} == {0, 1, 3}, "one that is no picture is not ranked"
    best = ranking[0]
    assert best.inliers >= 30
    assert best.appearance is not None
    assert best.appearance > 0.95
    assert best.novelty == pytest.approx(60 / (2 * WIDTH), abs=0.04), "as much is new as lies beyond the border"
    assert best.reprojection_px is not None
    assert best.reprojection_px < 1
    (other,) = [score for score in ranking if score.candidate == 0]
    assert other.novelty is None
    assert "its camera is not found" in other.reason


def test_more_of_the_place_beats_a_repetition(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    ranking = rank_candidates([fitted(view_of_wall(2.0)), fitted(view_of_wall(90.0))], so_far, seed=0)
    assert ranking[0].candidate == 1


@pytest.mark.parametrize("stretch", [-0.08, 0.08])
def test_of_pictures_alike_but_for_a_stretch_the_other_one_is_first(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture], stretch: float
) -> None:
    width = 2 * WIDTH / (1 + stretch)
    left, top = (3 * WIDTH - width) / 2 + 30, HEIGHT / 2
    frame = left, top, left + width, top + 2 * HEIGHT
    stretched = Image.fromarray(WALL).resize((2 * WIDTH, 2 * HEIGHT), Image.Resampling.BICUBIC, box=frame)
    ranking = rank_candidates([fitted(np.asarray(stretched)), fitted(view_of_wall(30.0))], so_far, seed=0)
    assert ranking[0].candidate == 1
    assert ranking[0].total > ranking[1].total + 0.1, "not by chance"


def test_another_focal_length_is_no_disagreement(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    (score,) = rank_candidates([fitted(view_of_wall(30.0, zoom=0.85))], so_far, seed=0)
    assert score.registration > 0.5
    assert score.appearance is not None
    assert score.appearance > 0.9
