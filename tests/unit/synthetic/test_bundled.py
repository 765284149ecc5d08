"""The bundled scene: the committed folder is complete, small and true, and the script still makes it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sceneexpander.synthetic.bundled import BundledScene, render_bundled, write_bundled

FOLDER = Path(__file__).parents[3] / "scenes" / "courtyard"
SMALL = (72, 96)
VIEWS = 8


@pytest.fixture(scope="module")
def small() -> BundledScene:
    return render_bundled(*SMALL, supersample=1.0, ambient_samples=0)


@pytest.fixture(scope="module", params=["committed", "remade"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, small: BundledScene) -> Path:
    if request.param == "committed":
        return FOLDER
    made = tmp_path_factory.mktemp("scene") / "courtyard"
    write_bundled(small, made)
    return made


def _picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def test_folder_is_complete_and_small(folder: Path) -> None:
    scene = yaml.safe_load((folder / "scene.yaml").read_text())
    assert scene["name"] == "courtyard"
    (only,) = scene["rounds"]
    assert set(only) == {"prompt", "motion", "object", "inserted"}
    assert (folder / only["inserted"]).is_file()
    cameras = json.loads((folder / "truth/cameras.json").read_text())
    assert [view["file"] for view in cameras["captured"]] == [f"captured/view_{i:02d}.jpg" for i in range(1, VIEWS + 1)]
    size = (cameras["height"], cameras["width"])
    for view in cameras["captured"]:
        assert _picture(folder / view["file"]).shape == (*size, 3)
    for name in ("clean.png", "new_region.png", "object.png", "depth/inserted.png"):
        assert _picture(folder / "truth" / name).shape[:2] == size
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) <= 5_000_000


def test_first_captured_view_is_the_frame(folder: Path) -> None:
    cameras = json.loads((folder / "truth/cameras.json").read_text())
    poses = np.array([view["world_from_cam"] for view in (*cameras["captured"], cameras["inserted"])])
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3)[None].repeat(9, 0), atol=1e-9
    )


def test_truth_agrees_with_the_captured_pictures(folder: Path) -> None:
    cameras = json.loads((folder / "truth/cameras.json").read_text())
    k, height, width = np.array(cameras["intrinsics_px"]), cameras["height"], cameras["width"]
    poses = np.array([view["world_from_cam"] for view in cameras["captured"]])
    depths = [_picture(folder / f"truth/depth/view_{i + 1:02d}.png") / 1000.0 for i in range(VIEWS)]
    images = [_picture(folder / f"captured/view_{i + 1:02d}.jpg").astype(float) for i in range(VIEWS)]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for i, j in ((0, 1), (3, 5), (7, 6)):
        z = depths[i]
        cam = np.stack([(x - k[0, 2]) / k[0, 0] * z, (y - k[1, 2]) / k[1, 1] * z, z], -1)[z > 0]
        local = (cam @ poses[i, :3, :3].T + poses[i, :3, 3] - poses[j, :3, 3]) @ poses[j, :3, :3]
        pixel = local @ k.T
        column, row = (np.floor(pixel[:, axis] / pixel[:, 2]).astype(int) for axis in (0, 1))
        inside = (local[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        assert inside.mean() > 0.3
        there, here = depths[j][row[inside], column[inside]], local[inside, 2]
        same = np.abs(there - here) < 0.02 * here
        # The rest is hidden in view j or at edges.
        assert same.mean() > 0.7
        colour_i, colour_j = images[i][z > 0][inside][same], images[j][row[inside], column[inside]][same]
        error = np.abs(colour_i - colour_j).mean()
        shuffled = np.abs(colour_i - np.random.default_rng(0).permutation(colour_j)).mean()
        assert error < 0.35 * shuffled


def test_inserted_view_extends_the_scene_and_is_misaligned(folder: Path) -> None:
    record = json.loads((folder / "truth/misalignment.json").read_text())
    new, thing = (_picture(folder / f"truth/{name}.png") > 0 for name in ("new_region", "object"))
    assert 0.4 <= new.mean() <= 0.6
    assert new.mean() == pytest.approx(record["new_region_share"], abs=1e-6)
    assert thing.mean() > 0.04
    assert not (thing & ~new).any()
    depth = _picture(folder / "truth/depth/inserted.png")
    assert not depth[~new].any()
    assert (depth[thing] > 0).all()
    inserted, clean = (_picture(folder / name).astype(float) for name in ("inserted/round_1.png", "truth/clean.png"))
    assert np.abs(inserted - clean).mean() > 4
    relative = np.array(record["true_from_used"])
    angle = np.rad2deg(np.arccos((np.trace(relative[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(record["asked"]["rotation_deg"], abs=1e-3)
    shift = np.linalg.norm(relative[:3, 3])
    assert shift == pytest.approx(record["asked"]["translation_fraction"] * record["scene_size_m"], rel=1e-4)


def test_truth_numbers_are_reproduced(small: BundledScene) -> None:
    cameras = json.loads((FOLDER / "truth/cameras.json").read_text())
    stored = np.array([view["world_from_cam"] for view in (*cameras["captured"], cameras["inserted"])])
    np.testing.assert_allclose(stored, small.world_from_cam[: VIEWS + 1], atol=1e-9)
    scale = SMALL[1] / cameras["width"]
    np.testing.assert_allclose(np.array(cameras["intrinsics_px"])[:2] * scale, small.intrinsics_px[:2], atol=1e-9)
    record = json.loads((FOLDER / "truth/misalignment.json").read_text())
    # The scene size is a median over pixels and moves a little with the resolution.
    assert record["scene_size_m"] == pytest.approx(small.inserted.scene_size_m, rel=0.02)
    assert record["new_region_share"] == pytest.approx(float(small.new_region.mean()), abs=0.02)
    assert record["object_share"] == pytest.approx(float(small.object_mask.mean()), abs=0.01)
    assert len(record["moved_objects"]) == len(small.inserted.moved)


def test_rewriting_replaces_the_folder_whole(tmp_path: Path, small: BundledScene) -> None:
    target = tmp_path / "courtyard"
    target.mkdir()
    (target / "stale.txt").write_text("old")
    write_bundled(small, target)
    assert not (target / "stale.txt").exists()
    assert (target / "scene.yaml").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["courtyard"]
