"""The tour: all methods fly the same way, each through its own cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.errors import UserError
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.rendering.config import EyeKey, RenderConfig, ViewKey
from sceneexpander.rendering.produce import produce_renders
from sceneexpander.rendering.tour import plan_tour
from sceneexpander.splatting import render
from sceneexpander.splatting.spz import read_spz
from tests.worlds.row_of_views import reconstruction

CONFIG = RenderConfig(frames=9, fps=6, stills=3)


BACKBONE = reconstruction("backbone", [0.0, 0.4, 0.2, 1.5], generated=1)


def test_it_starts_and_ends_at_a_captured_camera_and_visits_the_inserted_one() -> None:
    tour = plan_tour(BACKBONE, BACKBONE, CONFIG)
    x = tour.cameras.world_from_cam[:, 0, 3]
    # Shortest way to the inserted camera at 1.5: 0.0, 0.2, 0.4, 1.5 and back.
    torch.testing.assert_close(x[[0, -1]], torch.zeros(2))
    assert tour.inserted_frame == int(x.argmax())
    torch.testing.assert_close(tour.cameras.world_from_cam[tour.inserted_frame], BACKBONE.world_from_cam[3])
    torch.testing.assert_close(x, x.flip(0), atol=1e-5, rtol=0)
    assert tour.inserted_camera == "backbone"


@pytest.mark.parametrize("frames", [9, 10])
def test_the_way_back_is_the_way_there_and_is_not_drawn_again(
    frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []

    def count(*given: Any, **settings: Any) -> Any:
        drawn.append(given)
        return render(*given, **settings)

    monkeypatch.setattr("sceneexpander.rendering.produce.render", count)
    done = produce_renders(BACKBONE, BACKBONE, replace(CONFIG, frames=frames, stills=frames), tmp_path)
    assert torch.equal(done.world_from_cam, done.world_from_cam.flip(0))
    assert torch.equal(done.intrinsics_px, done.intrinsics_px.flip(0))
    assert len(drawn) == 5 + len(done.views)
    stills = [picture for _, picture in done.stills]
    assert len(stills) == frames
    for there, back in zip(stills, stills[::-1], strict=True):
        assert (tmp_path / there["provenance"]).read_bytes() == (tmp_path / back["provenance"]).read_bytes()
    assert (tmp_path / stills[0]["rgb"]).read_bytes() != (tmp_path / stills[4]["rgb"]).read_bytes()


def test_before_the_insertion_the_camera_comes_from_the_reference_in_this_gauge() -> None:
    captured = reconstruction("captured", [0.0, 0.4, 0.2], scale=3.0)
    tour = plan_tour(captured, BACKBONE, CONFIG)
    assert tour.inserted_camera == "backbone"
    # The reference's camera at 1.5 stands at 4.5 where every length is three times as long.
    torch.testing.assert_close(
        tour.cameras.world_from_cam[tour.inserted_frame, 0, 3], torch.tensor(4.5), atol=1e-3, rtol=0
    )


def test_views_without_a_camera_are_not_visited() -> None:
    lost = replace(BACKBONE, posed=torch.tensor([True, False, True, True]))
    tour = plan_tour(lost, lost, CONFIG)
    stops = (tour.cameras.world_from_cam[:, 0, 3, None] - torch.tensor([0.0, 0.2, 1.5])).abs().min(0).values
    torch.testing.assert_close(stops, torch.zeros(3), atol=1e-5, rtol=0)


def test_the_orbit_starts_at_the_inserted_camera_and_keeps_what_it_looks_at() -> None:
    tour = plan_tour(BACKBONE, BACKBONE, replace(CONFIG, path="orbit", orbit_deg=40.0))
    torch.testing.assert_close(tour.cameras.world_from_cam[0], BACKBONE.world_from_cam[3])
    assert tour.inserted_frame == 0
    eye, ahead = tour.cameras.world_from_cam[:, :3, 3], tour.cameras.world_from_cam[:, :3, 2]
    # It looks along +z from x = 1.5 at a wall 2 away.
    torch.testing.assert_close(eye + 2 * ahead, torch.tensor([1.5, 0.0, 2.0]).expand(9, 3), atol=1e-5, rtol=0)
    turned = rotation_angle_deg(torch.eye(3).expand(9, 3, 3), tour.cameras.world_from_cam[:, :3, :3])
    assert 19 < float(turned.max()) <= 20.01
    torch.testing.assert_close(eye[:, 1], torch.zeros(9), atol=1e-6, rtol=0)


def test_the_spiral_stays_within_its_radius() -> None:
    tour = plan_tour(BACKBONE, BACKBONE, replace(CONFIG, frames=60, path="spiral", spiral_radius=0.2))
    away = (tour.cameras.world_from_cam[:, :3, 3] - BACKBONE.world_from_cam[3, :3, 3]).norm(dim=-1)
    assert 0.3 < float(away.max()) < 1.2 * 0.2 * 2
    torch.testing.assert_close(tour.cameras.world_from_cam[[0, -1]], BACKBONE.world_from_cam[[3, 3]], atol=1e-5, rtol=0)


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_other_paths_are_the_same_in_another_gauge(path: str) -> None:
    captured = reconstruction("captured", [0.0, 0.4, 0.2], scale=3.0)
    config = replace(CONFIG, path=path)  # type: ignore[arg-type]
    ours, theirs = plan_tour(captured, BACKBONE, config), plan_tour(BACKBONE, BACKBONE, config)
    moved = theirs.cameras.world_from_cam.clone()
    moved[:, :3, 3] *= 3
    torch.testing.assert_close(ours.cameras.world_from_cam, moved, atol=1e-3, rtol=0)
    assert ours.inserted_camera == "backbone"


def test_key_frames_are_passed_in_order_each_method_in_its_own_frame() -> None:
    keys = (ViewKey(view="v1"), EyeKey(eye=(0.0, -1.0, 0.5), target=(0.3, 0.0, 2.0)), ViewKey(view="v3"))
    config = replace(CONFIG, path="keyframes", keyframes=keys, frames=21)
    tour = plan_tour(BACKBONE, BACKBONE, config)
    torch.testing.assert_close(tour.cameras.world_from_cam[0], BACKBONE.world_from_cam[1])
    torch.testing.assert_close(tour.cameras.world_from_cam[-1], BACKBONE.world_from_cam[3])
    nearest = (tour.cameras.world_from_cam[:, :3, 3] - torch.tensor([0.0, -1.0, 0.5])).norm(dim=-1)
    assert float(nearest.min()) < 1e-5
    ahead = tour.cameras.world_from_cam[int(nearest.argmin()), :3, 2]
    torch.testing.assert_close(ahead, torch.nn.functional.normalize(torch.tensor([0.3, 1.0, 1.5]), dim=0))
    captured = plan_tour(reconstruction("captured", [0.0, 0.4, 0.2], scale=3.0), BACKBONE, config)
    nearest = (captured.cameras.world_from_cam[:, :3, 3] - torch.tensor([0.0, -3.0, 1.5])).norm(dim=-1)
    assert float(nearest.min()) < 1e-3


def test_key_frames_that_cannot_be_are_refused() -> None:
    for keys, message in (
        ((ViewKey(view="v1"), ViewKey(view="v9")), "key frame 1 is at view 'v9'.*there are v0, v1, v2, v3"),
        ((ViewKey(view="v1"), EyeKey(eye=(0.0, 0.0, 0.0), target=(0.0, 5.0, 0.0))), "key frame 1 looks straight up"),
    ):
        with pytest.raises(UserError, match=message):
            plan_tour(BACKBONE, BACKBONE, replace(CONFIG, path="keyframes", keyframes=keys))
    with pytest.raises(UserError, match="like the eye, must be another place"):
        EyeKey(eye=(0.0, 0.0, 0.0), target=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_every_path_gives_three_videos(tmp_path: Path, path: str) -> None:
    config = replace(CONFIG, path=path, spz=True)  # type: ignore[arg-type]
    heard: list[int] = []
    done = produce_renders(BACKBONE, BACKBONE, config, tmp_path, on_frame=heard.append)
    assert heard == list(range(1, 10))
    assert sorted(done.videos) == ["depth", "provenance", "rgb"]
    assert len(read_spz(tmp_path / "gaussians.spz")) == len(BACKBONE.gaussians)


def test_what_is_written_is_complete_and_reads_back(tmp_path: Path) -> None:
    done = produce_renders(BACKBONE, BACKBONE, CONFIG, tmp_path)
    read = Renders.load(tmp_path)
    assert read.videos == done.videos == {name: f"{name}.mp4" for name in ("rgb", "depth", "provenance")}
    assert read.frames == 9
    assert done.inserted_frame in [index for index, _ in read.stills]
    assert [view for view, _ in read.views] == ["v0", "v1", "v2", "v3"]
    torch.testing.assert_close(read.world_from_cam, done.world_from_cam)
    (tmp_path / "rgb.mp4").unlink()
    with pytest.raises(ArtifactError, match=r"rgb\.mp4: is missing"):
        Renders.load(tmp_path)


def test_renders_repeat_bit_for_bit(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        produce_renders(BACKBONE, BACKBONE, CONFIG, tmp_path / name)
    names = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(names) > 10
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 1}, "frames: is 1, must be from 2 to"),
        ({"crf": 52}, "crf: is 52, must be from 0 to 51"),
        ({"orbit_deg": 0.0}, "orbit_deg: is 0.0, must be above 0 and at most 360"),
        ({"spiral_radius": 1.5}, "spiral_radius: is 1.5, must be above 0 and at most 1"),
        ({"path": "keyframes"}, r"render\.keyframes: path keyframes needs at least two, has 0"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        RenderConfig(**changes)
