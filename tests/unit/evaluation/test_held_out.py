"""Photos that nothing was made from: where they are in a method's own scene, and when they count."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from sceneexpander.artifacts.held_out import HeldOut, TiePoints
from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.evaluation.held_out import pose_held_out
from sceneexpander.evaluation.views import see_views
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import look_at, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting import render
from tests.worlds.wall import DEPTH, HEIGHT, WIDTH, made_reconstruction, own_pictures, record

CONFIG = EvaluateConfig(st_lpips=False, ghosting=False, consistency_frames=0)
CAPTURED = (0.0, 0.6, 0.3)  # the last is the inserted view's place
TRUE = look_at(torch.tensor([[0.25, 0.1, 0.2]]), torch.tensor([[0.2, 0.05, 3.0]]), torch.tensor([0.0, -1, 0]))[0]
TURN = Similarity(
    scale=2.5,
    rotation=rotation_from_quat_wxyz(
        torch.nn.functional.normalize(torch.tensor([0.9, 0.1, 0.4, -0.2]), dim=0)
    ).double(),
    translation=torch.tensor([4.0, -1, 2], dtype=torch.float64),
)


def made() -> tuple[Reconstruction, ViewSet, HeldOut]:
    """A scene, its pictures, and a photo of it taken from `TRUE`, tied to the captured ones by points of the wall."""
    scene = made_reconstruction(CAPTURED)
    lens = scene.intrinsics_px[0]
    picture = render(scene.gaussians, Cameras(TRUE[None], lens[None], HEIGHT, WIDTH)).rgb.clamp(0, 1)
    generator = torch.Generator().manual_seed(0)
    wall = torch.rand(200, 3, generator=generator) * torch.tensor([2.0, 1.4, 0]) + torch.tensor([-0.7, -0.7, DEPTH])
    there, _ = project_points(wall, lens, TRUE)
    ties = []
    for view in (0, 1):
        here, _ = project_points(wall, scene.intrinsics_px[view], scene.world_from_cam[view])
        size = torch.tensor([WIDTH, HEIGHT])
        both = ((here > 0) & (here < size) & (there > 0) & (there < size)).all(-1)
        ties.append(TiePoints(held_out="900", captured=f"{view:03d}", held_out_xy=there[both], captured_xy=here[both]))
    views = ViewSet(
        records=(dataclasses.replace(record(0), view_id="900", name="900.jpg"),), images=picture, detail_images=picture
    )
    return scene, own_pictures(scene), HeldOut(views=views, lens_of=("000",), ties=tuple(ties))


def moved(scene: Reconstruction) -> Reconstruction:
    """The same scene as a method shows it whose frame and unit are others."""
    gaussians = scene.gaussians
    return dataclasses.replace(
        scene,
        world_from_cam=TURN.poses(scene.world_from_cam.double()).float(),
        depth=scene.depth * TURN.scale,
        gaussians=dataclasses.replace(
            gaussians,
            means=TURN.points(gaussians.means.double()).float(),
            scales=gaussians.scales * TURN.scale,  # the wall's Gaussians are round
        ),
    )


def row_of(scene: Reconstruction, pictures: ViewSet, held_out: HeldOut) -> MetricsRow:
    return evaluate(scene, pictures, CONFIG, scene="s", round_number=1, seed=0, held_out=held_out)


def test_a_held_out_photo_is_found_where_it_was_taken_whatever_the_methods_frame_is() -> None:
    scene, pictures, held_out = made()
    for own, expected in ((scene, TRUE), (moved(scene), TURN.poses(TRUE[None].double())[0].float())):
        camera = pose_held_out(own, held_out, 0, see_views(own, pictures, CONFIG))
        assert camera is not None
        torch.testing.assert_close(camera.world_from_cam[0], expected, atol=0.02, rtol=0)
        row = row_of(own, pictures, held_out)
        assert row.values["psnr_held_out_db"] > 35
        assert row.values["held_out_covered"] > 0.9
        assert (row.values["views_held_out"], row.values["views_held_out_posed"]) == (1, 1)
        assert row.held_out[0].posed


def test_its_colours_take_no_part_in_its_camera_and_all_in_its_numbers() -> None:
    scene, pictures, held_out = made()
    assert held_out.views is not None
    other = dataclasses.replace(held_out, views=dataclasses.replace(held_out.views, images=1 - held_out.views.images))
    seen = see_views(scene, pictures, CONFIG)
    own, inverted = (pose_held_out(scene, one, 0, seen) for one in (held_out, other))
    assert own is not None
    assert inverted is not None
    assert torch.equal(own.world_from_cam, inverted.world_from_cam)
    assert row_of(scene, pictures, other).values["psnr_held_out_db"] < 15


def test_a_scene_that_shows_it_in_the_wrong_place_scores_worse() -> None:
    scene, pictures, held_out = made()
    worse = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, sh=scene.gaussians.sh.flip(0)))
    assert row_of(worse, pictures, held_out).values["psnr_held_out_db"] < 25


def test_a_photo_that_no_camera_explains_is_counted_and_in_no_mean() -> None:
    scene, pictures, held_out = made()
    assert held_out.views is not None
    generator = torch.Generator().manual_seed(1)
    stray = tuple(
        dataclasses.replace(
            tie,
            held_out="901",
            held_out_xy=torch.rand(tie.held_out_xy.shape, generator=generator) * torch.tensor([WIDTH, HEIGHT]),
        )
        for tie in held_out.ties
    )
    second = dataclasses.replace(record(1), view_id="901", name="901.jpg")
    views = ViewSet(
        records=(*held_out.views.records, second),
        images=held_out.views.images.expand(2, -1, -1, -1),
        detail_images=held_out.views.images.expand(2, -1, -1, -1),
    )
    row = row_of(scene, pictures, HeldOut(views=views, lens_of=("000", "000"), ties=(*held_out.ties, *stray)))
    assert [view.posed for view in row.held_out] == [True, False]
    assert "psnr_held_out_db" not in row.values
    assert (row.values["views_held_out"], row.values["views_held_out_posed"]) == (2, 1)


def test_given_cameras_are_taken_where_the_method_kept_them_and_not_elsewhere() -> None:
    scene, pictures, held_out = made()
    seen = see_views(scene, pictures, CONFIG)
    world = torch.cat([scene.world_from_cam[:2], TRUE[None]]).double()
    given = dataclasses.replace(
        held_out, given=("000", "001", "900"), given_world_from_cam=TURN.poses(world), ties=held_out.ties
    )
    camera = pose_held_out(scene, dataclasses.replace(given, ties=()), 0, seen)
    assert camera is not None
    torch.testing.assert_close(camera.world_from_cam[0], TRUE, atol=1e-4, rtol=0)
    turned = world.clone()
    turned[0, :3, :3] = turned[0, :3, :3] @ rotation_from_quat_wxyz(torch.tensor([0.9998, 0.02, 0, 0])).double()
    apart = dataclasses.replace(given, given_world_from_cam=turned)
    assert pose_held_out(scene, dataclasses.replace(apart, ties=()), 0, seen) is None
    found = pose_held_out(scene, apart, 0, seen)
    assert found is not None
    torch.testing.assert_close(found.world_from_cam[0], TRUE, atol=0.02, rtol=0)


@pytest.mark.parametrize("place", [0.0, 40.0])
def test_kept_cameras_are_judged_by_how_far_apart_they_are_wherever_they_stand(place: float) -> None:
    scene, pictures, held_out = made()
    seen = see_views(scene, pictures, CONFIG)
    away = Similarity(
        scale=1.0, rotation=torch.eye(3).double(), translation=torch.tensor([place, -place, 0.0]).double()
    )
    scene = dataclasses.replace(scene, world_from_cam=away.poses(scene.world_from_cam.double()).float())
    world = torch.cat([scene.world_from_cam, away.poses(TRUE[None].double()).float()]).double()
    for off, kept in ((0.0, True), (0.02, False)):
        given = world.clone()
        given[2, :3, 3] += torch.tensor([0.0, off, 0.0])
        told = dataclasses.replace(held_out, given=("000", "001", "002", "900"), given_world_from_cam=given, ties=())
        assert (pose_held_out(scene, told, 0, seen) is not None) == kept


def test_a_lens_of_its_own_is_found_with_the_pose() -> None:
    scene, pictures, held_out = made()
    camera = pose_held_out(scene, dataclasses.replace(held_out, lens_of=("",)), 0, see_views(scene, pictures, CONFIG))
    assert camera is not None
    assert float(camera.intrinsics_px[0, 0, 0]) == pytest.approx(float(scene.intrinsics_px[0, 0, 0]), rel=0.15)


def test_photos_of_another_size_are_refused() -> None:
    scene, pictures, held_out = made()
    assert held_out.views is not None
    small = held_out.views.images[..., :-2]
    other = dataclasses.replace(
        held_out, views=ViewSet(records=held_out.views.records, images=small, detail_images=small)
    )
    with pytest.raises(ValueError, match="held-out photos have"):
        row_of(scene, pictures, other)
