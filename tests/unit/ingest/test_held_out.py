"""Photos that are held out: which ones, what is left of the scene, and what is kept of them."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.held_out import HeldOut, TiePoints
from sceneexpander.artifacts.scene import KnownCameras, Scene
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.errors import UserError
from sceneexpander.geometry.rigid import look_at
from sceneexpander.ingest import choose_held_out, hold_out


def scene(count: int, *, known: KnownCameras | None = None) -> Scene:
    records = tuple(
        ViewRecord(
            view_id=f"{index:03d}",
            name=f"{index}.jpg",
            original_height=4,
            original_width=6,
            sha256=str(index),
            stored_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        )
        for index in range(count)
    )
    images = torch.arange(count)[:, None, None, None].expand(count, 3, 4, 6) / 255
    return Scene(name="s", views=ViewSet(records=records, images=images, detail_images=images), known=known)


def test_one_of_five_or_more_is_held_out_by_default_and_none_of_fewer() -> None:
    assert [len(choose_held_out(count, "auto")) for count in (1, 4, 5, 8, 30)] == [0, 0, 1, 1, 1]


@pytest.mark.parametrize("photos", range(3, 13))
def test_every_number_is_held_out_evenly_and_never_the_first(photos: int) -> None:
    for count in range(photos - 1):
        chosen = choose_held_out(photos, count)
        assert len(set(chosen)) == count
        assert all(0 < view < photos for view in chosen)
        gaps = [b - a for a, b in itertools.pairwise(chosen)]
        assert not gaps or max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize("wanted", [4, 5, 1000])
def test_too_many_are_refused_in_one_line(wanted: int) -> None:
    with pytest.raises(UserError, match=r"evaluate.hold_out: .*the scene has 5 photos"):
        hold_out(scene(5), wanted)


def test_scene_and_held_out_photos_are_all_photos_once_and_named() -> None:
    kept, held_out = hold_out(scene(6), 2)
    assert held_out.views is not None
    assert sorted((*kept.views.view_ids, *held_out.views.view_ids)) == [f"{i:03d}" for i in range(6)]
    for record, image in zip(held_out.views.records, held_out.views.images, strict=True):
        assert float(image[0, 0, 0] * 255) == int(record.view_id)
        assert f"{record.name}" in kept.notes[-1]
    untouched, none = hold_out(scene(6), 0)
    assert (len(untouched.views), none.views, untouched.notes) == (6, None, ())


def test_known_cameras_stay_those_of_their_photos_in_the_captures_world() -> None:
    """The frame's own photo came without a pose, so the first pose that there is goes with the photo that is held out."""
    eyes = torch.tensor([[0.0, 0, 0], [1, 0, 0.2], [2, 0.3, 0], [3, 0, 0.5]])
    world = look_at(eyes, eyes + torch.tensor([0.1, 0, 1.0]), torch.tensor([0.0, -1, 0])).double()
    frame = world[1]
    poses = torch.linalg.solve(frame, world)
    poses[0] = float("nan")
    capture = tuple(tuple(row) for row in frame.tolist())
    known = KnownCameras(world_from_cam=poses.float(), capture_from_world=capture)
    kept, held_out = hold_out(scene(4, known=known), 2)
    assert held_out.views is not None
    assert "001" in held_out.views.view_ids
    assert kept.known is not None
    assert kept.known.world_from_cam is not None
    own = torch.tensor(kept.known.capture_from_world, dtype=torch.float64)
    for row, view in enumerate(kept.views.view_ids):
        pose = kept.known.world_from_cam[row]
        if view == "000":
            assert not torch.isfinite(pose).any()
        else:
            torch.testing.assert_close(own @ pose.double(), world[int(view)], atol=1e-5, rtol=0)
    assert held_out.given == ("001", "002", "003")
    assert held_out.given_world_from_cam is not None
    torch.testing.assert_close(held_out.given_world_from_cam, world[1:], atol=1e-5, rtol=0)
    posed = kept.known.world_from_cam[torch.isfinite(kept.known.world_from_cam).all(-1).all(-1)]
    torch.testing.assert_close(posed[0], torch.eye(4), atol=1e-6, rtol=0)


def test_they_survive_the_disk(tmp_path: Path) -> None:
    _, held_out = hold_out(scene(5), "auto")
    assert held_out.views is not None
    ties = TiePoints(
        held_out=held_out.views.view_ids[0], captured="000", held_out_xy=torch.rand(3, 2), captured_xy=torch.rand(3, 2)
    )
    whole = HeldOut(views=held_out.views, lens_of=("000",), ties=(ties,))
    whole.save(tmp_path / "some")
    HeldOut().save(tmp_path / "none")
    read, none = HeldOut.load(tmp_path / "some"), HeldOut.load(tmp_path / "none")
    assert read.views is not None
    assert torch.equal(read.views.images, held_out.views.images)
    assert torch.equal(read.ties_of(ties.held_out)[0].captured_xy, ties.captured_xy)
    assert (read.lens_of, none.views, len(none)) == (("000",), None, 0)
