"""What a round leaves of older views."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.earlier import EarlierRegions
from sceneexpander.evaluation.measure import Subject, Values
from sceneexpander.evaluation.views import see_views
from tests.worlds.wall import made_reconstruction, own_pictures

CONFIG = EvaluateConfig(st_lpips=False, cross_view=False)
EYES = (0.0, 0.3, 2.2, 4.0)  # the last two were inserted, in rounds 1 and 2


def measured(posed: tuple[bool, ...] = (True,) * 4, *, round_number: int = 2, damaged: int | None = None) -> Values:
    made = dataclasses.replace(
        made_reconstruction(EYES), generated=torch.tensor([False, False, True, True]), posed=torch.tensor(posed)
    )
    views = own_pictures(made)
    rounds = (0, 0, 1, 2)
    records = tuple(dataclasses.replace(r, round=k) for r, k in zip(views.records, rounds, strict=True))
    images = views.images.clone()
    if damaged is not None:
        images[damaged] = 1 - images[damaged]
    views = ViewSet(records=records, images=images, detail_images=images)
    return EarlierRegions().of_scene(
        Subject(
            reconstruction=made,
            views=views,
            round_number=round_number,
            config=CONFIG,
            seen=see_views(made, views, CONFIG),
        )
    )


def test_the_rounds_own_view_takes_no_part() -> None:
    whole, own = measured(), measured(damaged=3)
    assert whole == own
    assert whole["psnr_earlier_inserted_db"] is not None
    assert measured(round_number=1)["psnr_earlier_inserted_db"] is None, "nothing was inserted before the first round"


def test_damage_to_any_older_region_shows() -> None:
    whole = measured()
    inserted, captured = measured(damaged=2), measured(damaged=0)
    assert whole["psnr_worst_earlier_db"] is not None
    for found in (inserted, captured):
        assert found["psnr_worst_earlier_db"] is not None
        assert found["psnr_worst_earlier_db"] < 15 < whole["psnr_worst_earlier_db"]
    assert inserted["psnr_earlier_inserted_db"] == inserted["psnr_worst_earlier_db"]
    assert captured["psnr_earlier_inserted_db"] == pytest.approx(whole["psnr_earlier_inserted_db"])


def test_a_view_without_a_camera_takes_no_part() -> None:
    assert measured((True, True, False, True), damaged=2)["psnr_earlier_inserted_db"] is None
    after = measured((False, True, True, True), damaged=2)
    assert after["psnr_earlier_inserted_db"] == measured(damaged=2)["psnr_earlier_inserted_db"], "those after it do"
