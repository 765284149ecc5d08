"""Exports hold the scene: other programs' readers find the same cameras, points and Gaussians, and what was generated."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.artifacts.source_type import read_source_type
from sceneexpander.cli.export import main
from sceneexpander.errors import UserError
from sceneexpander.exports import FORMATS, mesh
from sceneexpander.exports.mesh import make_collider, make_mesh
from sceneexpander.exports.scene import Crop, ExportScene, crop_scene, load_scene, place_scene
from sceneexpander.exports.write import write_exports
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_inverse, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting import render
from sceneexpander.splatting.ply import read_ply
from sceneexpander.splatting.spz import read_spz
from tests.worlds.exported import DEPTH, FINER, GENERATED, HEIGHT, VIEWS, WIDTH, poses, save_finished

NAMES = tuple(item.name for item in FORMATS)
MOVED = Similarity(
    scale=2.5,
    rotation=rotation_from_quat_wxyz(torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64)),
    translation=torch.tensor([3.0, -1.0, 7.0], dtype=torch.float64),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_finished(tmp_path_factory.mktemp("finished") / "wall")


@pytest.fixture(scope="module")
def scene(finished: Path) -> ExportScene:
    return load_scene(finished, 1, "sceneexpander")


@pytest.fixture(scope="module")
def written(scene: ExportScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh, "VOXELS", 40)
        patch.setattr(mesh, "COLLIDER_VOXELS", 24)
        paths = write_exports(scene, NAMES, folder)
    assert all(path.exists() for path in paths)
    return folder


def seen(scene: ExportScene) -> torch.Tensor:
    made = scene.reconstruction
    return render(made.gaussians, Cameras(made.world_from_cam, made.intrinsics_px, HEIGHT, WIDTH)).rgb


def seen_of(scene: ExportScene, path: Path) -> torch.Tensor:
    read = read_spz if path.suffix == ".spz" else read_ply
    return seen(replace(scene, reconstruction=replace(scene.reconstruction, gaussians=read(path))))


@pytest.mark.parametrize("name", ["gaussians.ply", "gaussians_plain.ply", "gaussians_rgb.ply"])
def test_a_ply_shows_the_same_pictures(scene: ExportScene, written: Path, name: str) -> None:
    assert float((seen_of(scene, written / name) - seen(scene)).abs().max()) < 1 / 255


def test_an_spz_shows_the_same_pictures_within_its_steps(scene: ExportScene, written: Path) -> None:
    flat = replace(scene.reconstruction.gaussians, sh=scene.reconstruction.gaussians.sh[:, :1])
    plain = replace(scene, reconstruction=replace(scene.reconstruction, gaussians=flat))
    for path in write_exports(plain, ["spz", "spz4"], written / "flat"):
        # A byte of colour is a step of 0.0074, shapes have steps of 6 %, which shows where the scene ends.
        error = (seen_of(plain, path) - seen(plain)).abs()
        assert float(error.median()) < 1 / 255
        assert float(error.max()) < 0.06
    three, four = (read_spz(written / "flat" / name) for name in ("gaussians.spz", "gaussians_v4.spz"))
    assert torch.equal(three.means, four.means)
    assert torch.equal(three.sh, four.sh)


def test_plyfile_reads_the_properties(scene: ExportScene, written: Path) -> None:
    import plyfile

    gaussians = scene.reconstruction.gaussians
    full = plyfile.PlyData.read(written / "gaussians.ply")
    assert np.array_equal(full["vertex"]["generated"] == 1, gaussians.generated.numpy())
    plain = plyfile.PlyData.read(written / "gaussians_plain.ply")["vertex"].data
    assert plain.dtype.itemsize == 4 * (17 + gaussians.sh[:, 1:].shape[1] * 3)
    coloured = plyfile.PlyData.read(written / "gaussians_rgb.ply")["vertex"]
    wanted = (0.5 + 0.28209479177387814 * gaussians.sh[:, 0]).clamp(0, 1) * 255
    for channel, name in enumerate(("red", "green", "blue")):
        np.testing.assert_allclose(coloured[name], wanted[:, channel].numpy(), atol=0.51)
    surface = plyfile.PlyData.read(written / "mesh.ply")
    assert len(surface["face"].data) > 100
    for data in (full, surface):
        assert any("AI-generated" in comment for comment in data.comments)
        assert any("some-model" in comment for comment in data.comments)
    assert len(plyfile.PlyData.read(written / "nerfstudio" / "sparse_pc.ply")["vertex"].data) > 1000


@pytest.mark.parametrize("name", ["colmap", "colmap_text"])
def test_pycolmap_reads_the_cameras_and_reprojects_the_points(scene: ExportScene, written: Path, name: str) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(written / name / "sparse" / "0"))
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {f"{view}.png" for view in VIEWS}
    for view in scene.views:
        image = images[f"{view.view_id}.png"]
        camera = model.cameras[image.camera_id]
        with Image.open(written / name / "images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height) == (WIDTH * FINER, HEIGHT * FINER)
        found = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(found, rigid_inverse(view.world_from_cam).numpy(), atol=1e-6)
        np.testing.assert_allclose(camera.calibration_matrix(), view.intrinsics_px.numpy(), atol=1e-9)
    errors = [
        np.abs(images_point.xy - model.images[element.image_id].project_point(point.xyz)).max()
        for point in model.points3D.values()
        for element in point.track.elements
        for images_point in [model.images[element.image_id].points2D[element.point2D_idx]]
    ]
    assert len(errors) > 1000
    assert max(errors) < 1e-3  # poses are float32 matrices: orthogonal to 1e-7 only


def test_transforms_json_holds_the_poses_in_opengl_axes(scene: ExportScene, written: Path) -> None:
    content = json.loads((written / "nerfstudio" / "transforms.json").read_text())
    assert [frame["generated"] for frame in content["frames"]] == [False, False, True]
    points = torch.tensor([[0.3, -0.2, DEPTH], [-0.5, 0.4, DEPTH]], dtype=torch.float64)
    for frame, view in zip(content["frames"], scene.views, strict=True):
        assert (written / "nerfstudio" / frame["file_path"]).is_file()
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, 3], view.world_from_cam[:3, 3].numpy(), atol=1e-6)
        # As its own users compute a pixel: OpenGL camera, y up, looking along -z.
        there = (points.numpy() - pose[:3, 3]) @ pose[:3, :3]
        x = frame["fl_x"] * there[:, 0] / -there[:, 2] + frame["cx"]
        y = frame["fl_y"] * -there[:, 1] / -there[:, 2] + frame["cy"]
        wanted, _ = project_points(points, view.intrinsics_px, view.world_from_cam)
        np.testing.assert_allclose(np.stack([x, y], 1), wanted.numpy(), atol=1e-4)


def test_camera_tables_hold_the_same_numbers(scene: ExportScene, written: Path) -> None:
    cameras = json.loads((written / "cameras.json").read_text())["cameras"]
    lines = [line for line in (written / "cameras.csv").read_text().splitlines() if not line.startswith("#")]
    for view, camera, row in zip(scene.views, cameras, csv.DictReader(lines), strict=True):
        assert torch.equal(torch.tensor(camera["world_from_cam"], dtype=torch.float64), view.world_from_cam)
        for i, j in ((0, 0), (1, 3), (2, 1)):
            assert float(row[f"m{i}{j}"]) == camera["world_from_cam"][i][j]
        assert float(row["cy"]) == camera["intrinsics_px"][1][2]


def test_depth_and_normals_come_back(scene: ExportScene, written: Path) -> None:
    step = json.loads((written / "depth" / "about.json").read_text())["depth_per_level"]
    for view, depth in zip(VIEWS, scene.reconstruction.depth.numpy(), strict=True):
        np.testing.assert_array_equal(np.load(written / "depth" / "raw" / f"{view}.npy"), depth)
        with Image.open(written / "depth" / "png" / f"{view}.png") as picture:
            levels = np.asarray(picture)
        assert levels.dtype == np.uint16
        np.testing.assert_allclose(levels * step, depth, atol=step)
        normals = np.load(written / "normals" / "raw" / f"{view}.npy")
        np.testing.assert_allclose(normals, np.broadcast_to([0, 0, -1], normals.shape), atol=1e-6)


def test_trimesh_reads_points_and_cameras(scene: ExportScene, written: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    content = trimesh.load(written / "points.glb")
    assert {f"camera_{view}" for view in VIEWS} <= set(content.graph.nodes_geometry)
    turn, geometry = content.graph["points_generated"]
    points = trimesh.transform_points(content.geometry[geometry].vertices, turn)
    # glTF's y is up: what lay at z = DEPTH lies before the viewer, at -DEPTH.
    np.testing.assert_allclose(points[:, 2], -DEPTH, atol=1e-4)


def test_the_surface_lies_where_the_gaussians_are(scene: ExportScene) -> None:
    surface = make_mesh(scene, voxels=40)
    np.testing.assert_allclose(surface.vertices[:, 2], DEPTH, atol=0.1)
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] < 0).mean() > 0.99  # counter-clockwise seen from the cameras
    only = make_mesh(crop_scene(scene, Crop(part="captured")), voxels=40)
    assert only.generated.max() < 1e-3 < surface.generated.max()


def test_a_collider_is_closed(scene: ExportScene) -> None:
    trimesh = pytest.importorskip("trimesh")
    shell = make_collider(scene, voxels=24)
    assert trimesh.Trimesh(shell.vertices, shell.faces, process=False).is_watertight


def test_one_similarity_moves_everything(scene: ExportScene) -> None:
    moved = place_scene(scene, MOVED, metric=True)
    assert moved.statement.metric
    # The same cameras see the same pictures, view-dependent colours included, at depths of the new scale.
    error = (seen(moved) - seen(scene)).abs()
    assert float(error.mean()) < 1e-4
    assert (
        float(error.quantile(0.99)) < 1e-3
    )  # a pair of Gaussians at nearly one depth may be drawn the other way round
    torch.testing.assert_close(moved.reconstruction.depth, 2.5 * scene.reconstruction.depth)
    for before, after in zip(scene.views, moved.views, strict=True):
        torch.testing.assert_close(after.world_from_cam, MOVED.poses(before.world_from_cam))
    back = place_scene(moved, MOVED.inverse())
    torch.testing.assert_close(back.reconstruction.gaussians.sh, scene.reconstruction.gaussians.sh, atol=1e-5, rtol=0)


def test_a_scene_whose_capture_has_a_world_is_exported_in_it(scene: ExportScene, tmp_path: Path) -> None:
    there = MOVED.poses(poses()[:GENERATED].double())
    known = KnownCameras(
        world_from_cam=(rigid_inverse(there[:1]) @ there).float(),
        metric=True,
        capture_from_world=tuple(tuple(row) for row in there[0].tolist()),  # type: ignore[arg-type]
    )
    found = load_scene(save_finished(tmp_path / "wall", known), 1, "sceneexpander")
    assert found.statement.metric
    for view, pose in zip(found.views, MOVED.poses(poses().double()), strict=True):
        torch.testing.assert_close(view.world_from_cam, pose, atol=1e-4, rtol=0)
    wanted = place_scene(scene, MOVED).reconstruction
    torch.testing.assert_close(found.reconstruction.gaussians.means, wanted.gaussians.means, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.reconstruction.depth, wanted.depth, atol=1e-3, rtol=0)


def test_parts_and_crops(scene: ExportScene) -> None:
    pixels = HEIGHT * WIDTH
    new = crop_scene(scene, Crop(part="generated"))
    assert new.reconstruction.gaussians.generated.all()
    assert (new.statement.gaussians, new.statement.generated_gaussians) == (pixels, pixels)
    old = crop_scene(scene, Crop(part="captured"))
    assert not old.reconstruction.gaussians.generated.any()
    assert old.statement.sentence().startswith("Nothing in this file was generated")
    sure = crop_scene(scene, Crop(part="captured", keep_confident=0.25)).reconstruction.gaussians
    assert len(sure) == pixels // 2
    own = scene.reconstruction.depth_conf[:GENERATED].flatten()
    kept = (old.reconstruction.gaussians.means[:, None] == sure.means[None]).all(-1).any(1)
    assert float(own[kept].quantile(0.05)) > float(own[~kept].quantile(0.95))
    box = crop_scene(scene, Crop(box=(-1, -1, 0, 0, 1, 9))).reconstruction.gaussians.means
    assert 0 < len(box) < 3 * pixels
    assert bool(((box[:, 0] >= -1) & (box[:, 0] <= 0)).all())
    assert len(crop_scene(scene, Crop(most=100)).reconstruction.gaussians) == 100
    with pytest.raises(UserError, match="no Gaussian is left"):
        crop_scene(scene, Crop(box=(90, 90, 90, 91, 91, 91)))


def test_every_export_says_what_was_generated(written: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    for name in ("points.glb", "mesh.glb", "collider.glb"):
        data = (written / name).read_bytes()
        length = int.from_bytes(data[12:16], "little")
        asset = json.loads(data[20 : 20 + length])["asset"]
        assert "AI-generated" in asset["copyright"]
        assert asset["extras"]["about"]["generated_views"][0]["provenance"]["source"] == "some-model"
        assert trimesh.load(written / name).geometry
    sidecars = ["gaussians.about.json", "gaussians_v4.about.json", "cameras.json", "nerfstudio/transforms.json"]
    sidecars += [f"{folder}/about.json" for folder in ("colmap", "colmap_text", "depth", "normals")]
    for name in sidecars:
        content = json.loads((written / name).read_text())
        assert "AI-generated" in content["statement"]
        assert content["about"]["generated_views"][0]["provenance"]["backend"] == "openai"
    assert "AI-generated" in (written / "cameras.csv").read_text()
    for folder in ("colmap", "nerfstudio"):
        with Image.open(written / folder / "images" / f"{VIEWS[GENERATED]}.png") as picture:
            assert read_source_type(picture.text["XML:com.adobe.xmp"]) == "trainedAlgorithmicMedia"
    assert not list(written.rglob("*.part*"))


def test_a_view_without_a_camera_is_left_out_and_named(finished: Path, tmp_path: Path) -> None:
    lost = tmp_path / "lost"
    save_finished(lost)
    place = lost / "round_1" / "sceneexpander" / "reconstruction"
    made = load_scene(lost, 1, "sceneexpander").reconstruction
    replace(made, posed=torch.tensor([True, False, True])).save(place)
    scene = load_scene(lost, 1, "sceneexpander")
    assert [view.view_id for view in scene.views] == [VIEWS[0], VIEWS[2]]
    assert scene.statement.unposed_views == (VIEWS[1],)
    for view, pose in zip(scene.views, poses()[[0, 2]], strict=True):
        torch.testing.assert_close(view.world_from_cam.float(), pose)
    write_exports(scene, ["colmap", "nerfstudio", "depth"], tmp_path / "out")
    assert len(list((tmp_path / "out" / "colmap" / "images").iterdir())) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "colmpa"], "unknown format 'colmpa'; did you mean 'colmap'?"),
        (["--format", "ply", "ply"], "names 'ply' twice"),
        (["--format", "ply", "--round", "3"], "has no round 3; there are rounds 1"),
        (["--format", "ply", "--method", "scenexpander"], "did you mean 'sceneexpander'?"),
        (["--format", "ply", "--part", "new"], "unknown 'new'; known: all, captured, generated"),
        (["--format", "ply", "--box", "1", "0", "0", "0", "1", "1"], "--box: is empty or not finite"),
        (["--format", "ply", "--count", "0"], "must be at least 1"),
        (["--format", "ply", "--keep-confident", "nan"], "must be above 0 and at most 1"),
    ],
)
def test_bad_arguments_are_one_line(
    finished: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(finished), *arguments])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_an_unknown_scene_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("no_such_scene", "a\0b", "x" * 5000):
        with pytest.raises(SystemExit) as ended:
            main([name, "--format", "ply"])
        assert ended.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_the_command_writes_where_it_says(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(finished), "--format", "ply", "cameras", "--part", "generated", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert f"ply: {tmp_path / 'gaussians.ply'}" in printed
    assert "AI-generated" in printed
    assert read_ply(tmp_path / "gaussians.ply").generated.all()
