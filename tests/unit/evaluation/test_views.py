"""Preservation, insertion and coverage on a made scene whose right answers are known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.catalogue import measured_metrics
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import MEASURES, evaluate
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.likeness import PSNR_CAP_DB
from sceneexpander.evaluation.views import measure_views, navigation_coverage, same_place, see_views
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from tests.worlds.wall import HEIGHT, WIDTH, made_reconstruction, own_pictures, without_generated

CONFIG = EvaluateConfig()


def preservation(scene: Reconstruction, views: ViewSet, config: EvaluateConfig) -> tuple[ViewMetrics, ...]:
    return measure_views(see_views(scene, views, config), MEASURES, generated=False)


def insertion_fidelity(scene: Reconstruction, views: ViewSet, config: EvaluateConfig) -> tuple[ViewMetrics, ...]:
    return measure_views(see_views(scene, views, config), MEASURES, generated=True)


def psnr_of(row: ViewMetrics) -> float:
    return row.values["psnr_inserted_db" if row.generated else "psnr_captured_db"]


def covered(row: ViewMetrics) -> float:
    return row.values["inserted_covered" if row.generated else "views_covered"]


def test_a_perfect_reconstruction() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    captured, inserted = preservation(scene, views, CONFIG), insertion_fidelity(scene, views, CONFIG)
    assert [row.view_id for row in captured] == ["000", "001"]
    assert [row.view_id for row in inserted] == ["002"]
    for row in (*captured, *inserted):
        assert psnr_of(row) == PSNR_CAP_DB
        assert row.values["ssim_inserted" if row.generated else "ssim_captured"] == pytest.approx(1, abs=1e-9)
        assert covered(row) > 0.95
        disagreement = row.values["inserted_depth_disagreement" if row.generated else "depth_disagreement"]
        assert disagreement == pytest.approx(0, abs=1e-5)  # every centre is at depth 3 exactly
    # From 0 the inserted view's part of the wall is hardly seen; from 2.2 about 60 % is seen by no captured view.
    assert captured[0].values["share_generated_captured"] < 0.05
    assert inserted[0].values["share_generated"] == pytest.approx(0.6, abs=0.06)
    assert captured[0].values["covered_by_others"] > 0.8
    assert captured[0].values["psnr_from_others_db"] > 25


def test_views_are_matched_by_id_not_by_place() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene).select([2, 1, 0])
    assert all(psnr_of(row) == PSNR_CAP_DB for row in preservation(scene, views, CONFIG))
    with pytest.raises(ValueError, match="no picture of view '001'"):
        preservation(scene, views.select([0, 2]), CONFIG)


def test_a_damaged_picture_costs_what_it_must() -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    images = views.images.clone()
    images[0] = (images[0] * 0.5).clamp(0, 1)
    damaged = dataclasses.replace(views, images=images)
    rows = preservation(scene, damaged, CONFIG)
    assert psnr_of(rows[0]) == pytest.approx(psnr(views.images[0], images[0]), abs=1e-4)
    assert psnr_of(rows[1]) == PSNR_CAP_DB


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
        assert psnr_of(got) == PSNR_CAP_DB
        assert got.values["ssim_inserted" if got.generated else "ssim_captured"] == pytest.approx(1, abs=1e-9)
        assert covered(got) > 0.95
    assert all(psnr_of(row) < 30 for row in preservation(scene, barred, CONFIG))
    # A hole below the bar is not seen either.
    half = scene.gaussians.select(scene.gaussians.means[:, 1] > scene.gaussians.means[:, 1].quantile(0.3))
    holed = dataclasses.replace(scene, gaussians=half)
    assert covered(preservation(holed, masked, CONFIG)[0]) > covered(preservation(holed, barred, CONFIG)[0]) + 0.1


def test_ghosting_is_noticed_only_by_the_cross_view_number() -> None:
    """Shifted copies behind each view's own surface leave the view itself nearly untouched."""
    good = made_reconstruction(generated_last=False)
    views = own_pictures(good)
    moved = good.gaussians.means.clone()
    moved[good.gaussians.source_view == 1] += torch.tensor([0.5, 0.0, 0.5])
    ghosted = dataclasses.replace(good, gaussians=dataclasses.replace(good.gaussians, means=moved))
    before, after = preservation(good, views, CONFIG)[0], preservation(ghosted, views, CONFIG)[0]
    assert psnr_of(after) > 20
    assert after.values["psnr_from_others_db"] < before.values["psnr_from_others_db"] - 5


def test_one_view_has_no_others() -> None:
    scene = made_reconstruction(eyes_x=(0.0,), generated_last=False)
    row = preservation(scene, own_pictures(scene), CONFIG)[0]
    assert not {"psnr_from_others_db", "covered_by_others"} & set(row.values)


def test_a_picture_that_shows_nothing_of_the_place_has_no_numbers_and_no_mean_is_over_the_others(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    valid = torch.ones(len(views), HEIGHT, WIDTH, dtype=torch.bool)
    valid[1] = False
    config = EvaluateConfig(st_lpips=False, flip=False)
    masked = dataclasses.replace(views, valid=valid)
    row = evaluate(scene, masked, config, scene="s", round_number=1, seed=0)
    assert [bool(view.values) for view in row.views] == [True, False, True]
    assert "psnr_captured_db" not in row.values
    assert row.values["psnr_worst_earlier_db"] == row.views[0].values["psnr_captured_db"]
    assert "too little of the picture shows the place" in caplog.text


def test_coverage_gained_by_the_expansion() -> None:
    scene = made_reconstruction()
    before = without_generated(scene)
    after_share = navigation_coverage(scene, scene.cameras[2:], CONFIG)
    before_share = navigation_coverage(before, scene.cameras[2:], CONFIG)
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
    full = dataclasses.replace(CONFIG, consistency_frames=3)
    row = evaluate(scene, own_pictures(scene), full, scene="made", round_number=1, seed=0, navigation=scene.cameras)
    assert [row.value(name) for name in ("views_captured", "views_generated", "tour_frames")] == [2, 1, 3]
    assert row.value("gaussians") == 3 * HEIGHT * WIDTH
    assert row.value("gaussians_generated") == HEIGHT * WIDTH
    assert row.value("psnr_inserted_db") == PSNR_CAP_DB
    assert row.value("depth_abs_rel") is None
    assert row.value("tour_registered") is not None
    without = evaluate(
        scene, own_pictures(scene), CONFIG, scene="made", round_number=1, seed=0, navigation=scene.cameras
    )
    assert without.value("tour_registered") is None
    assert row.numbers()["psnr_captured_db"] == PSNR_CAP_DB
    assert set(row.values) <= {metric.name for metric in measured_metrics()}
    assert "torch" in row.versions
    row.save(tmp_path / "m.json")
    assert MetricsRow.load(tmp_path / "m.json") == row
    (tmp_path / "m.json").write_text('{"schema": "metrics/2", "scene": "x"}')
    with pytest.raises(ArtifactError, match="is invalid"):
        MetricsRow.load(tmp_path / "m.json")
    (tmp_path / "m.json").write_text('{"schema": "metrics/1", "psnr_db": 20.0}')
    with pytest.raises(ArtifactError, match="is not of schema"):
        MetricsRow.load(tmp_path / "m.json")


def test_captured_only_row() -> None:
    scene = made_reconstruction()
    row = evaluate(without_generated(scene), own_pictures(scene), CONFIG, scene="m", round_number=1, seed=0)
    assert row.method == "captured"
    assert row.value("psnr_inserted_db") is None
    assert row.value("tour_covered") is None


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
    assert (row.value("views_captured"), row.value("views_captured_posed")) == (2, len(kept))
    for name in ("psnr_captured_db", "ssim_captured", "views_covered", "psnr_from_others_db"):
        counted = [by_id[f"{i:03d}"].values[name] for i in kept or (0, 1)]
        assert row.values[name] == pytest.approx(sum(counted) / len(counted))
    assert (row.value("psnr_inserted_db") is None) is (2 in lost)
    assert by_id["002"].posed is (2 not in lost)


def test_only_the_view_of_this_round_counts_as_inserted() -> None:
    scene = made_reconstruction()
    row = evaluate(scene, own_pictures(scene), CONFIG, scene="m", round_number=2, seed=0)
    assert row.value("views_generated") == 1
    assert row.value("psnr_inserted_db") is None


def test_non_finite_numbers_are_refused() -> None:
    scene = made_reconstruction()
    row = evaluate(scene, own_pictures(scene), CONFIG, scene="m", round_number=1, seed=0)
    with pytest.raises(ValueError, match="psnr_captured_db of sceneexpander is inf"):
        dataclasses.replace(row, values={**row.values, "psnr_captured_db": float("inf")})


def test_config_range() -> None:
    with pytest.raises(UserError, match="coverage_alpha"):
        EvaluateConfig(coverage_alpha=1.0)


@pytest.mark.parametrize("lost_in", ["source", "target", "both"])
def test_same_place_is_not_misled_by_placeholders_of_cameras(lost_in: str) -> None:
    scene = made_reconstruction((0.0, 0.3, 0.6, 2.2))
    poses, depth = scene.world_from_cam.clone(), scene.depth.clone()
    poses[1], depth[1] = poses[0], 3 * depth[1]
    posed = torch.tensor([True, False, True, True])
    placeholder = dataclasses.replace(scene, world_from_cam=poses, depth=depth, posed=posed)
    source = scene if lost_in == "target" else placeholder
    target = scene if lost_in == "source" else placeholder
    found = same_place(scene.world_from_cam[-1:], source, target)
    torch.testing.assert_close(found, scene.world_from_cam[-1:], atol=1e-5, rtol=0)


def test_same_place_without_any_camera_on_both_sides_takes_all() -> None:
    scene = made_reconstruction()
    lost = dataclasses.replace(scene, posed=torch.zeros(3, dtype=torch.bool))
    torch.testing.assert_close(same_place(scene.world_from_cam, scene, lost), scene.world_from_cam, atol=1e-5, rtol=0)


def test_what_others_show_thinly_is_compared_by_its_colour() -> None:
    """Half transparent is not darker: black behind the scene belongs to nobody."""
    scene = made_reconstruction()
    thin = dataclasses.replace(
        scene, gaussians=dataclasses.replace(scene.gaussians, opacities=scene.gaussians.opacities * 0.5)
    )
    config = EvaluateConfig(st_lpips=False, coverage_alpha=0.2)
    pictures = own_pictures(scene)
    solid, seen = (
        measure_views(see_views(one, pictures, config), MEASURES, generated=False)[0].values["psnr_from_others_db"]
        for one in (scene, thin)
    )
    assert solid > 30
    assert seen > 30


def test_the_perceptual_distance_can_be_left_out() -> None:
    scene = made_reconstruction()
    rows = preservation(scene, own_pictures(scene), EvaluateConfig(st_lpips=False))
    assert rows
    assert not any("st_lpips_captured" in row.values for row in rows)
