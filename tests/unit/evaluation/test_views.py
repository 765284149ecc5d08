"""Preservation, insertion and coverage on a made scene whose right answers are known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.errors import UserError
from sceneexpander.evaluation import EvaluateConfig, Navigation, evaluate, navigation_coverage, same_place
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.views import PSNR_CAP_DB, insertion_fidelity, preservation
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from tests.unit.evaluation.made import HEIGHT, WIDTH, made_reconstruction, own_pictures, without_generated

CONFIG = EvaluateConfig()


def test_a_perfect_reconstruction() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    captured, inserted = preservation(scene, views, CONFIG), insertion_fidelity(scene, views, CONFIG)
    assert [row.view_id for row in captured] == ["000", "001"]
    assert [row.view_id for row in inserted] == ["002"]
    for row in (*captured, *inserted):
        assert row.psnr_db == PSNR_CAP_DB
        assert row.ssim == pytest.approx(1, abs=1e-9)
        assert row.coverage > 0.95
        assert row.depth_disagreement == pytest.approx(0, abs=1e-5)  # every centre is at depth 3 exactly
    # From 0 the inserted view's part of the wall is hardly seen; from 2.2 about 60 % is seen by no captured view.
    assert captured[0].generated_share < 0.05
    assert inserted[0].generated_share == pytest.approx(0.6, abs=0.06)
    assert (captured[0].others_coverage or 0) > 0.8
    assert (captured[0].others_psnr_db or 0) > 25


def test_views_are_matched_by_id_not_by_place() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene).select([2, 1, 0])
    assert all(row.psnr_db == PSNR_CAP_DB for row in preservation(scene, views, CONFIG))
    with pytest.raises(ValueError, match="no picture of view '001'"):
        preservation(scene, views.select([0, 2]), CONFIG)


def test_a_damaged_picture_costs_what_it_must() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    images = views.images.clone()
    images[0] = (images[0] * 0.5).clamp(0, 1)
    damaged = dataclasses.replace(views, images=images)
    rows = preservation(scene, damaged, CONFIG)
    assert rows[0].psnr_db == pytest.approx(psnr(views.images[0], images[0]), abs=1e-4)
    assert rows[1].psnr_db == PSNR_CAP_DB


def test_pixels_that_do_not_show_the_place_count_in_no_number() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    images = views.images.clone()
    images[:, :, : HEIGHT // 4] = 0.5  # a bar
    valid = torch.ones(len(views), HEIGHT, WIDTH, dtype=torch.bool)
    valid[:, : HEIGHT // 4 + 5] = False  # and the windows that reach into it
    barred = dataclasses.replace(views, images=images)
    masked = dataclasses.replace(barred, valid=valid)
    for got in (*preservation(scene, masked, CONFIG), *insertion_fidelity(scene, masked, CONFIG)):
        assert got.psnr_db == PSNR_CAP_DB
        assert got.ssim == pytest.approx(1, abs=1e-9)
        assert got.coverage > 0.95
    assert all(row.psnr_db < 30 for row in preservation(scene, barred, CONFIG))
    # A hole below the bar is not seen either.
    half = scene.gaussians.select(scene.gaussians.means[:, 1] > scene.gaussians.means[:, 1].quantile(0.3))
    holed = dataclasses.replace(scene, gaussians=half)
    assert preservation(holed, masked, CONFIG)[0].coverage > preservation(holed, barred, CONFIG)[0].coverage + 0.1


def test_ghosting_is_noticed_only_by_the_cross_view_number() -> None:
    """Shifted copies behind each view's own surface leave the view itself nearly untouched."""
    good = made_reconstruction(generated_last=False)
    views = own_pictures(good)
    moved = good.gaussians.means.clone()
    moved[good.gaussians.source_view == 1] += torch.tensor([0.5, 0.0, 0.5])
    ghosted = dataclasses.replace(good, gaussians=dataclasses.replace(good.gaussians, means=moved))
    before, after = preservation(good, views, CONFIG)[0], preservation(ghosted, views, CONFIG)[0]
    assert after.psnr_db > 20
    assert (after.others_psnr_db or 0) < (before.others_psnr_db or 0) - 5


def test_one_view_has_no_others() -> None:
    scene = made_reconstruction(eyes_x=(0.0,), generated_last=False)
    row = preservation(scene, own_pictures(scene), CONFIG)[0]
    assert row.others_psnr_db is None
    assert row.others_coverage is None


def test_coverage_gained_by_the_expansion() -> None:
    scene = made_reconstruction()
    before = without_generated(scene)
    poses, intrinsics = scene.world_from_cam[2:], scene.intrinsics_px[2:]
    after_share = navigation_coverage(scene, poses, intrinsics, HEIGHT, WIDTH, CONFIG)
    before_share = navigation_coverage(before, poses, intrinsics, HEIGHT, WIDTH, CONFIG)
    # Each view spans 3.15 of the wall; seen from 2.2, the view from 0.3 reaches (3.15 - 1.9) / 3.15 = 40 % of it.
    assert float(before_share[0]) == pytest.approx(0.4, abs=0.06)
    assert float(after_share[0]) > 0.95


def test_same_place_in_another_gauge() -> None:
    scene = made_reconstruction()
    rotation = rotation_from_quat_wxyz(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    other_from_scene = Similarity(scale=1.7, rotation=rotation, translation=torch.tensor([0.3, -2.0, 1.0]))
    other = dataclasses.replace(
        without_generated(scene),
        world_from_cam=other_from_scene.poses(scene.world_from_cam[:2]),
        depth=scene.depth[:2] * 1.7,
    )
    found = same_place(scene.world_from_cam, scene, other)
    torch.testing.assert_close(found, other_from_scene.poses(scene.world_from_cam), atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="share no captured view"):
        same_place(scene.world_from_cam, scene, dataclasses.replace(other, view_ids=("a", "b")))


def test_sizes_must_agree() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    smaller = dataclasses.replace(views, images=views.images[:, :, :14])
    with pytest.raises(ValueError, match="pixels"):
        preservation(scene, smaller, CONFIG)


def test_row_holds_everything_and_survives_the_disk(tmp_path: Path) -> None:
    scene = made_reconstruction()
    navigation = Navigation(
        world_from_cam=scene.world_from_cam, intrinsics_px=scene.intrinsics_px, height=HEIGHT, width=WIDTH
    )
    row = evaluate(scene, own_pictures(scene), CONFIG, scene="made", round_number=1, seed=0, navigation=navigation)
    assert (row.captured_views, row.generated_views, row.navigation_frames) == (2, 1, 3)
    assert row.gaussians == 3 * HEIGHT * WIDTH
    assert row.generated_gaussians == HEIGHT * WIDTH
    assert row.inserted_psnr_db == PSNR_CAP_DB
    assert row.truth is None
    assert row.numbers()["psnr_db"] == PSNR_CAP_DB
    assert "torch" in row.versions
    row.save(tmp_path / "m.json")
    assert MetricsRow.load(tmp_path / "m.json") == row
    (tmp_path / "m.json").write_text('{"schema": "metrics/1", "scene": "x"}')
    with pytest.raises(ArtifactError, match="is invalid"):
        MetricsRow.load(tmp_path / "m.json")
    (tmp_path / "m.json").write_text('{"schema": "other/1"}')
    with pytest.raises(ArtifactError, match="is not of schema"):
        MetricsRow.load(tmp_path / "m.json")


def test_captured_only_row() -> None:
    scene = made_reconstruction()
    row = evaluate(without_generated(scene), own_pictures(scene), CONFIG, scene="m", round_number=1, seed=0)
    assert row.method == "captured"
    assert row.inserted_psnr_db is None
    assert row.navigation_coverage is None


@pytest.mark.parametrize("lost", [(0,), (1,), (2,), (0, 2), (0, 1)])
def test_views_without_a_pose_are_measured_but_in_no_mean(lost: tuple[int, ...]) -> None:
    scene = made_reconstruction()
    scene = dataclasses.replace(scene, posed=torch.tensor([view not in lost for view in range(3)]))
    views = own_pictures(scene)
    images = views.images.clone()
    for view, factor in ((0, 0.9), (1, 0.5)):  # different numbers for the two photos
        images[view] = images[view] * factor
    row = evaluate(scene, dataclasses.replace(views, images=images), CONFIG, scene="m", round_number=1, seed=0)
    by_id = {view.view_id: view for view in row.views}
    assert sorted(by_id) == ["000", "001", "002"]
    kept = [i for i in (0, 1) if i not in lost]
    assert (row.captured_views, row.captured_views_posed) == (2, len(kept))
    for name in ("psnr_db", "ssim", "coverage", "others_psnr_db"):
        counted = [getattr(by_id[f"{i:03d}"], name) for i in kept or (0, 1)]
        assert getattr(row, name) == pytest.approx(sum(counted) / len(counted))
    assert (row.inserted_psnr_db is None) is (2 in lost)
    assert by_id["002"].posed is (2 not in lost)


def test_only_the_view_of_this_round_counts_as_inserted() -> None:
    scene = made_reconstruction()
    row = evaluate(scene, own_pictures(scene), CONFIG, scene="m", round_number=2, seed=0)
    assert row.generated_views == 1
    assert row.inserted_psnr_db is None


def test_non_finite_numbers_are_refused() -> None:
    scene = made_reconstruction()
    row = evaluate(scene, own_pictures(scene), CONFIG, scene="m", round_number=1, seed=0)
    with pytest.raises(ValueError, match="psnr_db is inf"):
        dataclasses.replace(row, psnr_db=float("inf"))


def test_config_range() -> None:
    with pytest.raises(UserError, match="coverage_alpha"):
        EvaluateConfig(coverage_alpha=1.0)


def test_what_others_show_thinly_is_compared_by_its_colour() -> None:
    """Half transparent is not darker: black behind the scene belongs to nobody."""
    scene = made_reconstruction()
    thin = dataclasses.replace(
        scene, gaussians=dataclasses.replace(scene.gaussians, opacities=scene.gaussians.opacities * 0.5)
    )
    config = EvaluateConfig(st_lpips=False, coverage_alpha=0.2)
    pictures = own_pictures(scene)
    solid, seen = (preservation(one, pictures, config)[0].others_psnr_db for one in (scene, thin))
    assert solid is not None
    assert seen is not None
    assert solid > 30
    assert seen > 30


def test_the_perceptual_distance_can_be_left_out() -> None:
    scene = made_reconstruction()
    rows = preservation(scene, own_pictures(scene), EvaluateConfig(st_lpips=False))
    assert [row.st_lpips for row in rows] == [None] * len(rows)
