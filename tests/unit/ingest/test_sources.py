"""Captures of every kind end as the same pictures and cameras."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from sceneexpander.cli.expand import parse_arguments, stage_scene
from sceneexpander.errors import UserError
from sceneexpander.ingest import IngestConfig, load_photos, load_scene, make_round
from sceneexpander.ingest.config import CameraAxes
from sceneexpander.ingest.depth_files import DepthFile, DepthFormat
from sceneexpander.ingest.lens_models import Lens, Projection, straighten_picture
from sceneexpander.ingest.sources import SOURCES, Capture, Shot, find_source, read_capture
from sceneexpander.ingest.sources.posed import write_posed_photos
from tests.worlds.captures import (
    CONFIG,
    MAKERS,
    SIZE,
    camera_texts,
    colmap,
    eth3d,
    metashape,
    pictures,
    pose,
    reality_capture,
    reality_capture_csv,
    seven_scenes,
    transforms,
    video,
)
from tests.worlds.photos import texture

pytestmark = pytest.mark.timeout(120)
ROUNDS = [make_round("A bench.")]


@pytest.mark.parametrize("name", MAKERS)
def test_each_kind_is_recognised_and_its_poses_are_read(tmp_path: Path, name: str) -> None:
    MAKERS[name](tmp_path)
    assert find_source(tmp_path) == name
    capture = read_capture(tmp_path, CONFIG)
    assert [Path(shot.name).stem.rpartition("-")[2].split(".")[0].lstrip("0") or "0" for shot in capture.shots] == list(
        "012"
    )
    for k, shot in enumerate(capture.shots):
        if shot.world_from_cam is not None:
            np.testing.assert_allclose(shot.world_from_cam, pose(k), atol=1e-5)
    assert sum(shot.world_from_cam is not None for shot in capture.shots) == (2 if name == "camera_texts" else 3)


@pytest.mark.parametrize("name", MAKERS)
def test_text_as_programs_for_windows_write_it_is_read_the_same(tmp_path: Path, name: str) -> None:
    for kind in ("plain", "wide"):
        MAKERS[name](tmp_path / kind)
    texts = [path for path in (tmp_path / "wide").rglob("*") if path.suffix in (".txt", ".json", ".csv")]
    for path in texts:
        path.write_bytes(path.read_text().encode("utf-16"))
    plain, wide = (read_capture(tmp_path / kind, CONFIG) for kind in ("plain", "wide"))
    assert wide.notes == plain.notes
    for one, other in zip(plain.shots, wide.shots, strict=True):
        assert one.lens == other.lens
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)


@pytest.mark.parametrize("name", MAKERS)
def test_a_staged_copy_reads_as_the_original_does(tmp_path: Path, name: str) -> None:
    (tmp_path / "data").mkdir()
    MAKERS[name](tmp_path / "data")
    request = parse_arguments([str(tmp_path / "data"), "--prompt", "A bench."])
    stage_scene(request, "copy", tmp_path / "copy", ingest=CONFIG, recorded=False)
    first, again = load_photos(tmp_path / "data", ROUNDS, CONFIG), load_scene(tmp_path / "copy", CONFIG)
    assert torch.equal(first.views.images, again.views.images)
    assert first.known is not None
    assert again.known is not None
    assert first.known.capture_from_world is not None
    np.testing.assert_allclose(first.known.capture_from_world, again.known.capture_from_world)
    for field, value in first.known.tensors().items():
        torch.testing.assert_close(getattr(again.known, field), value, equal_nan=True)
    again.save(tmp_path / "saved")
    assert type(again).load(tmp_path / "saved").known is not None


def test_known_cameras_are_those_of_the_stored_pictures(tmp_path: Path) -> None:
    colmap(tmp_path)
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    known = scene.known
    assert known is not None
    assert known.world_from_cam is not None
    assert known.intrinsics_px is not None
    scale = scene.views.width / SIZE[1]
    torch.testing.assert_close(known.world_from_cam[0], torch.eye(4), atol=1e-5, rtol=0)
    expected = torch.tensor([[200.0, 0, 119], [0, 201, 91], [0, 0, 1 / scale]]) * scale
    torch.testing.assert_close(known.intrinsics_px[1], expected, atol=1e-3, rtol=0)
    assert any("sub/7.png" in note for note in scene.notes)


def test_the_capture_world_is_found_again_after_any_similarity(tmp_path: Path) -> None:
    colmap(tmp_path)
    known = load_photos(tmp_path, ROUNDS, CONFIG).known
    assert known is not None
    assert known.world_from_cam is not None
    moved = known.world_from_cam.clone()
    moved[:, :3, 3] *= 0.37
    found = known.similarity_from(moved, torch.ones(len(moved), dtype=torch.bool))
    assert found is not None
    assert found.scale == pytest.approx(1 / 0.37, rel=1e-4)
    np.testing.assert_allclose(found.poses(moved.double())[2].numpy(), pose(2), atol=1e-4)


@pytest.mark.parametrize(
    ("key", "field"), [("use_intrinsics", "intrinsics_px"), ("use_poses", "world_from_cam"), ("use_depth", "depth")]
)
def test_each_kind_of_knowledge_can_be_switched_off(tmp_path: Path, key: str, field: str) -> None:
    camera_texts(tmp_path)
    told, without = (load_photos(tmp_path, ROUNDS, c).known for c in (CONFIG, replace(CONFIG, **{key: False})))
    assert told is not None
    assert without is not None
    assert set(told.tensors()) - set(without.tensors()) == {field}


def test_depth_lies_under_its_pixels(tmp_path: Path) -> None:
    camera_texts(tmp_path)
    ramp = np.tile(np.arange(1, SIZE[1] + 1, dtype=np.float32), (SIZE[0], 1))
    np.save(tmp_path / "depths" / "0.npy", ramp)
    known = load_photos(tmp_path, ROUNDS, CONFIG).known
    assert known is not None
    assert known.depth is not None
    width = known.depth.shape[2]
    expected = (torch.arange(width) + 0.5) * SIZE[1] / width + 0.5
    assert float((known.depth[0, 40] - expected).abs().max()) <= 1.5
    assert not known.depth[1:].any()


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_RADIAL", "200 120 90 0.1"),
        ("RADIAL", "200 120 90 0.1 -0.02"),
        ("OPENCV", "200 201 119 91 0.1 -0.02 0.01 0.005"),
        ("FULL_OPENCV", "200 201 119 91 0.1 -0.02 0.01 0.005 0.003 0.02 0.01 0.001"),
        ("OPENCV_FISHEYE", "200 201 119 91 0.05 -0.02 0.01 0.001"),
        ("THIN_PRISM_FISHEYE", "200 201 119 91 0.05 -0.02 0.01 0.005 0.003 0.002 0.001 0.002"),
    ],
)
def test_lenses_bend_as_colmap_has_them(tmp_path: Path, model: str, parameters: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    colmap(tmp_path, f"{model} 240 180 {parameters}")
    lens = read_capture(tmp_path, CONFIG).shots[0].lens
    assert lens is not None
    values = [float(word) for word in parameters.split()]
    camera = pycolmap.Camera(model=model, width=240, height=180, params=values)
    rays = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0], [0.0, -0.35, 1.0]])
    pinhole = rays[:, :2] * lens.focal_px + lens.centre_px
    np.testing.assert_allclose(lens.distorted(pinhole), camera.img_from_cam(rays), atol=1e-6)


def test_binary_models_of_colmap_itself_read_like_its_text(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    colmap(tmp_path)
    folder = tmp_path / "sparse" / "0"
    text = read_capture(tmp_path, CONFIG)
    (folder / "points3D.txt").write_text("")
    (folder / "images.txt").write_text((folder / "images.txt").read_text().replace("1.0 2.0 -1", ""))
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()
    binary = read_capture(tmp_path, CONFIG)
    assert [shot.name for shot in binary.shots] == [shot.name for shot in text.shots]
    for one, other in zip(binary.shots, text.shots, strict=True):
        assert one.lens == other.lens
        np.testing.assert_allclose(one.world_from_cam, other.world_from_cam, atol=1e-12)


def test_straightening_leads_each_pixel_to_where_the_lens_has_it() -> None:
    lens = Lens(focal_px=(200, 200), centre_px=(120, 90), distortion=(0.2, 0, 0, 0), projection=Projection.PINHOLE)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    ramp = np.stack([columns, rows, columns], -1).astype(np.uint8)
    made, _ = straighten_picture(ramp, None, lens)
    x, y = lens.distorted(np.array([[60.5, 40.5]]))[0] - 0.5
    assert made[40, 60, 0] == pytest.approx(x, abs=1)
    assert made[40, 60, 1] == pytest.approx(y, abs=1)


def test_a_lens_of_another_model_is_named(tmp_path: Path) -> None:
    colmap(tmp_path, "FOV 240 180 200 200 120 90 0.5")
    with pytest.raises(UserError, match="FOV"):
        read_capture(tmp_path, CONFIG)


def test_axes_of_a_transforms_file_can_be_said(tmp_path: Path) -> None:
    transforms(tmp_path)
    shots = read_capture(tmp_path, replace(CONFIG, camera_axes=CameraAxes.OPENCV)).shots
    assert shots[0].world_from_cam is not None
    np.testing.assert_allclose(shots[0].world_from_cam[:3, 2], -pose(0)[:3, 2], atol=1e-9)
    assert shots[1].lens is not None
    assert shots[1].lens.focal_px == (150, 151)


def test_axes_that_nobody_knows_are_refused(tmp_path: Path) -> None:
    transforms(tmp_path)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    for said, known in (("COLMAP", True), ("OpenGL (right, up, back)", True), ("unreal", False)):
        path.write_text(json.dumps(content | {"camera_convention": said}))
        if known:
            assert read_capture(tmp_path, CONFIG).shots
        else:
            with pytest.raises(UserError, match=r"'unreal'.*camera_axes"):
                read_capture(tmp_path, CONFIG)


def test_masks_beside_pictures_are_not_used_pixels(tmp_path: Path) -> None:
    pictures(tmp_path, ["0.png", "1.png"])
    (tmp_path / "masks").mkdir()
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, :120] = 0
    Image.fromarray(mask).save(tmp_path / "masks" / "0.png.png")
    valid = load_photos(tmp_path, ROUNDS, CONFIG).views.validity()
    assert float(valid[0].float().mean()) == pytest.approx(0.5, abs=0.05)
    assert bool(valid[1].all())


@pytest.mark.parametrize("make", [pictures, colmap])
def test_masks_that_belong_to_no_picture_are_named(tmp_path: Path, make: Callable[..., None]) -> None:
    make(*((tmp_path, ["0.png", "1.png"]) if make is pictures else (tmp_path,)))
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    for name in ("0.png.png", "sub/0.png.png", "other.png"):
        Image.new("L", SIZE[::-1], 255).save(tmp_path / "masks" / name)
    notes = read_capture(tmp_path, CONFIG).notes
    unused = ["other.png", "sub/0.png.png"] if make is pictures else ["0.png.png", "other.png"]
    assert f"masks of no picture that is used: {', '.join(unused)}" in notes
    assert not any("skipped" in note for note in notes)


@pytest.mark.parametrize("part", ["cameras", "images"])
def test_half_a_model_is_no_folder_of_photos(tmp_path: Path, part: str) -> None:
    colmap(tmp_path)
    pictures(tmp_path, ["0.png", "1.png"])
    (tmp_path / "sparse" / "0" / f"{part}.txt").unlink()
    with pytest.raises(UserError, match="is one part of a model"):
        read_capture(tmp_path, CONFIG)


def test_frames_whose_tracking_was_lost_have_no_pose(tmp_path: Path) -> None:
    seven_scenes(tmp_path)
    (tmp_path / "frame-000001.pose.txt").write_text("-inf -inf -inf -inf\n" * 4)
    capture = read_capture(tmp_path, CONFIG)
    assert [shot.world_from_cam is not None for shot in capture.shots] == [True, False, True]
    assert capture.notes == ("frames whose pose is not finite are taken without one: frame-000001.color.png",)


@pytest.mark.parametrize("far", [False, True])
def test_the_transform_of_a_metashape_chunk_is_applied(tmp_path: Path, far: bool) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([4_000_000.0, 1, 2]) if far else np.array([5.0, 1, 2])
    words = [" ".join(map(str, part.ravel().tolist())) for part in (turn, shift)]
    inner = f'<rotation locked="false">{words[0]}</rotation><translation>{words[1]}</translation><scale>2.5</scale>'
    metashape(tmp_path, f"<transform>{inner}</transform>")
    capture = read_capture(tmp_path, CONFIG)
    assert capture.metric
    points = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 2.0]])
    for k, shot in enumerate(capture.shots):
        assert shot.world_from_cam is not None
        # Of a point of the chunk's frame, where the camera sees it must stay the same.
        of_chunk = points @ pose(k)[:3, :3].T + pose(k)[:3, 3]
        of_world = 2.5 * of_chunk @ turn.T + (0 if far else shift)
        of_camera = (of_world - shot.world_from_cam[:3, 3]) @ shot.world_from_cam[:3, :3]
        np.testing.assert_allclose(of_camera / 2.5, points, atol=1e-9)
    assert any("placed on the Earth" in note for note in capture.notes) is far


def test_the_lens_of_reality_capture_is_in_units_of_the_longer_side(tmp_path: Path) -> None:
    reality_capture(tmp_path)
    lens = read_capture(tmp_path, CONFIG).shots[0].lens
    assert lens is not None
    # The vendor's equations: distortion first, then the focal length, then pixels from the middle.
    ray = np.array([0.3, -0.2])
    square = float(ray @ ray)
    bent = ray * (1 + 0.1 * square - 0.02 * square**2 + 0.003 * square**3)
    expected = (30 / 36 * bent + [-0.01, 0.005]) * 240 + [120, 90]
    np.testing.assert_allclose(lens.distorted((ray * lens.focal_px + lens.centre_px)[None])[0], expected, atol=1e-9)
    path = tmp_path / "0.xmp"
    path.write_text(path.read_text().replace("0.003 0 0 0", "0.003 0 0.1 0"))
    with pytest.raises(UserError, match="model brown3 that is not read"):
        read_capture(tmp_path, CONFIG)


@pytest.mark.parametrize(
    ("angles", "right", "down", "forward"),
    [
        ((0, 0, 0), (1, 0, 0), (0, -1, 0), (0, 0, -1)),  # looks down, top of the picture to the north
        ((90, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 0, -1)),  # top of the picture to the east
        ((0, 90, 0), (1, 0, 0), (0, 0, -1), (0, 1, 0)),  # looks north, upright
        ((90, 90, 0), (0, -1, 0), (0, 0, -1), (1, 0, 0)),  # looks east, upright
        ((0, 0, 90), (0, 0, -1), (0, -1, 0), (-1, 0, 0)),  # rolled about north: looks west
    ],
)
def test_the_angles_of_reality_capture_are_those_of_its_article(
    tmp_path: Path,
    angles: tuple[float, ...],
    right: tuple[float, ...],
    down: tuple[float, ...],
    forward: tuple[float, ...],
) -> None:
    pictures(tmp_path, ["0.png"])
    rows = ["#name,x,y,alt,heading,pitch,roll", f"0.png,1,2,3,{','.join(map(str, angles))}"]
    (tmp_path / "a.csv").write_text("\r\n".join(rows))
    found = read_capture(tmp_path, CONFIG).shots[0].world_from_cam
    assert found is not None
    np.testing.assert_allclose(found[:3, :3], np.array([right, down, forward]).T, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], [1, 2, 3])


def test_the_angles_of_reality_capture_make_the_matrix_of_its_article(tmp_path: Path) -> None:
    pictures(tmp_path, ["0.png"])
    (tmp_path / "a.csv").write_text("#name,x,y,alt,heading,pitch,roll\n0.png,0,0,0,-26.5,87.2,14.7\n")
    found = read_capture(tmp_path, CONFIG).shots[0].world_from_cam
    assert found is not None
    (sz, sy, sx), (cz, cy, cx) = (f(np.radians([-26.5, 87.2, 14.7])) for f in (np.sin, np.cos))
    cam_from_world = [
        [cx * cz + sx * sy * sz, sx * sy * cz - cx * sz, -sx * cy],
        [-cy * sz, -cy * cz, -sy],
        [cx * sy * sz - sx * cz, cx * sy * cz + sx * sz, -cx * cy],
    ]
    np.testing.assert_allclose(found[:3, :3].T, cam_from_world, atol=1e-12)


def test_the_table_of_reality_capture_has_the_lens_of_its_xmp_files(tmp_path: Path) -> None:
    for kind, make in (("xmp", reality_capture), ("csv", reality_capture_csv)):
        make(tmp_path / kind)
    by_xmp, by_table = (read_capture(tmp_path / kind, CONFIG) for kind in ("xmp", "csv"))
    assert by_table.shots[1].lens == by_xmp.shots[1].lens
    assert by_table.notes == ("cameras of pictures that are not there: 7.png",)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("0.003,0,0,0", "0.003,0,1e-4,0", r"0\.png: has a distortion that is not read"),
        ("-0.02,0.003", "0,0", "distortion that is not read"),  # it may be that of the division model
        ("30,-0.01", "0,-0.01", r"0\.png: has a camera that"),
        ("30,-0.01", "x,-0.01", r"cameras\.csv:3: has something else where a number"),
        ("30,-0.01", "nan,-0.01", r"cameras\.csv:3: holds a number that is not finite"),
        ("30,-0.01", "30", "has 15 values for 16 columns"),
        ("1.png", "0.png", r"names 0\.png a second time"),
        ("0.png", '"0.png', "not a row"),
    ],
)
def test_what_a_table_of_reality_capture_cannot_say_is_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    reality_capture_csv(tmp_path)
    path = tmp_path / "cameras.csv"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(UserError) as caught:
        read_capture(tmp_path, CONFIG)
    assert re.search(said, caught.value.line())
    assert "\n" not in caught.value.line()


def test_an_xmp_file_of_a_photo_program_is_none_of_cameras(tmp_path: Path) -> None:
    pictures(tmp_path, ["0.png", "1.png"])
    (tmp_path / "0.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    assert find_source(tmp_path) == "photos"


@pytest.mark.parametrize("undistorted", [True, False])
def test_scenes_of_eth3d(tmp_path: Path, undistorted: bool) -> None:
    values = eth3d(tmp_path, undistorted=undistorted, depth=True)
    assert find_source(tmp_path) == "colmap"
    capture = read_capture(tmp_path, CONFIG)
    assert capture.metric
    for k, shot in enumerate(capture.shots):
        assert shot.world_from_cam is not None
        assert shot.lens is not None
        np.testing.assert_allclose(shot.world_from_cam, pose(k), atol=1e-9)
        assert shot.lens.bends is not undistorted
        assert (shot.depth is None) is undistorted, "depth belongs to the pictures as they were taken"
        if shot.depth is not None:
            np.testing.assert_array_equal(shot.depth.read(SIZE), np.where(np.isinf(values), 0, values))
    assert any("belongs to the distorted pictures" in note for note in capture.notes) is undistorted
    known = load_photos(tmp_path, ROUNDS, CONFIG).known
    assert known is not None
    assert known.metric
    if not undistorted:
        assert known.depth is not None
        seen = known.depth[known.depth > 0]
        assert len(seen) > 0.2 * known.depth.numel()
        assert 1 <= float(seen.min()) < float(seen.max()) <= 3, "metres, and no infinity"
    with pytest.raises(UserError, match="raw float32 depth map"):
        load_photos(tmp_path / "ground_truth_depth" / "dslr_images", ROUNDS, CONFIG)


@pytest.mark.parametrize("quarter_turn", [False, True])
def test_a_video_gives_the_sharpest_frame_of_each_part_upright(tmp_path: Path, quarter_turn: bool) -> None:
    video(tmp_path, quarter_turn=quarter_turn)
    capture = read_capture(tmp_path / "walk.mp4", replace(CONFIG, video_fps=1.0))
    assert [shot.name for shot in capture.shots] == [
        f"walk_{k}00.400s.png".replace(f"{k}00", f"000{k}") for k in range(3)
    ]
    scene = load_photos(tmp_path / "walk.mp4", ROUNDS, replace(CONFIG, video_fps=1.0))
    assert scene.views.records[0].original_height == (SIZE[1] if quarter_turn else SIZE[0])
    picture = np.asarray(
        texture(0, *SIZE).resize((scene.views.width, scene.views.height) if not quarter_turn else (112, 84))
    )
    shown = (scene.views.images[0].permute(1, 2, 0).numpy() * 255).astype(float)
    expected = np.rot90(picture, -1) if quarter_turn else picture
    assert np.abs(shown - expected).mean() < 12


class _Toy:
    title = "a toy"

    def detect(self, place: Path) -> bool:
        return (place / "toy.txt").is_file()

    def read(self, place: Path, config: IngestConfig) -> Capture:
        return Capture(shots=tuple(Shot(name=p.name, picture=p) for p in sorted(place.glob("*.png"))), notes=("toy",))


def test_a_source_from_outside_is_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOURCES, "toy", _Toy())
    pictures(tmp_path / "captured", ["0.png", "1.png"])
    (tmp_path / "scene.yaml").write_text("source: toy\nrounds: [{prompt: A bench.}]\n")
    assert "toy" in load_scene(tmp_path, CONFIG).notes
    (tmp_path / "scene.yaml").write_text("source: toys\nrounds: [{prompt: A bench.}]\n")
    with pytest.raises(UserError, match="did you mean 'toy'"):
        load_scene(tmp_path, CONFIG)


def test_names_that_lead_out_are_refused(tmp_path: Path) -> None:
    transforms(tmp_path)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace("images/1.png", "../1.png"))
    with pytest.raises(UserError, match="outside"):
        read_capture(tmp_path, CONFIG)


def test_more_posed_pictures_than_are_used_are_thinned_and_said(tmp_path: Path) -> None:
    colmap(tmp_path)
    capture = read_capture(tmp_path, replace(CONFIG, max_views=2))
    assert [Path(shot.name).name for shot in capture.shots] == ["0.png", "2.png"]
    assert "2 of 3 pictures" in capture.notes[-1]


@pytest.mark.parametrize(
    ("make", "file", "expected"),
    [(seven_scenes, "frame-000001.pose.txt", "12 or 16"), (camera_texts, "cameras/0.txt", "21")],
)
def test_a_camera_with_the_numbers_of_another_kind_is_one_line(
    tmp_path: Path, make: Callable[[Path], None], file: str, expected: str
) -> None:
    make(tmp_path)
    for count in {12, 16, 21, 20} - {int(word) for word in expected.split(" or ")}:
        (tmp_path / file).write_text("1 " * count)
        with pytest.raises(UserError, match=f"holds {count} numbers, one camera has {expected} here"):
            read_capture(tmp_path, CONFIG)


def test_raw_depth_is_as_large_as_its_picture(tmp_path: Path) -> None:
    depth = np.arange(12, dtype="<f4").reshape(3, 4)
    depth[0, 1] = np.inf
    (tmp_path / "a.JPG").write_bytes(depth.tobytes())
    file = DepthFile(path=tmp_path / "a.JPG", format=DepthFormat.RAW)
    assert file.read((3, 4))[0].tolist() == [0, 0, 2, 3]
    with pytest.raises(UserError, match="bytes"):
        file.read((4, 4))


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path, bytes]]:
    """(capture, one of its camera files, that file's bytes) of every kind."""
    found = []
    for name, make in {**MAKERS, "video": video}.items():
        folder = tmp_path_factory.mktemp(name)
        make(folder)
        place = folder / "walk.mp4" if name == "video" else folder
        capture = read_capture(place, CONFIG)
        found += [(place, path, path.read_bytes()) for path in capture.files[:2]]
    posed = tmp_path_factory.mktemp("posed")
    write_posed_photos(read_capture(found[0][0], CONFIG), posed, CONFIG)
    return [*found, (posed, posed / "cameras.json", (posed / "cameras.json").read_bytes())]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(choice=st.integers(0, 100), cut=st.floats(0, 1), at=st.floats(0, 1), put=st.binary(max_size=12))
def test_damaged_camera_files_are_one_line(
    damaged: list[tuple[Path, Path, bytes]], choice: int, cut: float, at: float, put: bytes
) -> None:
    place, path, data = damaged[choice % len(damaged)]
    start = int(at * len(data))
    changed = data[:start] + put + data[start + len(put) :]
    path.write_bytes(changed[: max(1, int(cut * 2 * len(changed)))])
    try:
        for shot in read_capture(place, CONFIG, find_source(place)).shots:
            assert shot.world_from_cam is None or np.isfinite(shot.world_from_cam).all()
    except UserError:
        pass  # the one thing that may happen
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.zip", b"hello", r"a\.zip: is not an archive, as its name says"),
        ("a.zip", b"", r"a\.zip: is not an archive, as its name says"),
        ("a.7z", b"7z\xbc\xaf\x27\x1c", r"a\.7z: is a 7z archive; unpack it"),
        ("photos", b"7z\xbc\xaf\x27\x1c", r"photos: is a 7z archive; unpack it"),
        ("a.png", b"\xff\xd8\xff\xe0\x00\x10JFIF", r"a\.png: is one picture; give the folder"),
    ],
)
def test_files_are_called_what_they_are(name: str, content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said):
        read_capture(tmp_path / name, CONFIG)
