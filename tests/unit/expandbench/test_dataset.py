"""The benchmark on disk: the same bytes always, whole scenes only, and truth that is true."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits

from sceneexpander.errors import UserError
from sceneexpander.expandbench import dataset
from sceneexpander.expandbench.dataset import (
    CAPTURED_VIEWS,
    HELD_OUT,
    INTENDED,
    PICTURED,
    Seen,
    TrueScene,
    check_scene,
    generate,
    load_truth,
    read_manifest,
    scenes_named,
)
from sceneexpander.expandbench.scenes import (
    ABLATION_TEST,
    DEVELOPMENT,
    SCENES,
    TEST,
    DrawnScene,
    bench_scene,
    draw_scene,
)
from sceneexpander.geometry.rigid import transform_points
from sceneexpander.synthetic.render import trace_rays
from sceneexpander.synthetic.scenes import KINDS

NAME, SHRINK, GRADES = "courtyard_1", 4, ("clean", "mixed_2")
SAMPLE = Path(__file__).parents[3] / "benchmarks" / "expandbench_sample"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    generate(folder, [NAME], shrink=SHRINK, grades=GRADES)
    return folder


@pytest.fixture(scope="module")
def truth(bench: Path) -> TrueScene:
    return load_truth(bench, NAME)


@pytest.fixture(scope="module")
def drawn() -> DrawnScene:
    return draw_scene(NAME, shrink=SHRINK)


def test_splits_are_apart_and_hold_every_kind() -> None:
    assert len(SCENES) == len(DEVELOPMENT) + len(TEST) >= 30
    assert set(ABLATION_TEST) < set(TEST)
    for split in (DEVELOPMENT, TEST):
        assert {SCENES[name][0] for name in split} == set(KINDS)
    assert len({SCENES[name] for name in SCENES}) == len(SCENES), "no world is in both"
    for amounts in ("stretch_4", "stretch_8", "zoom_5", "zoom_10", "zoom_20", "shift_5", "rotation_5", "translation_5"):
        assert amounts in PICTURED


def test_the_same_bytes_on_every_run_and_number_of_threads(bench: Path, tmp_path: Path) -> None:
    before = cv2.getNumThreads(), torch.get_num_threads()
    try:
        cv2.setNumThreads(3)
        torch.set_num_threads(3)
        with threadpool_limits(3):
            again = generate(tmp_path, [NAME], shrink=SHRINK, grades=GRADES)
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])
    assert again == read_manifest(bench)
    files = sorted(path.relative_to(bench) for path in bench.rglob("*") if path.is_file())
    assert len(files) > 20
    for file in files:
        assert (tmp_path / file).read_bytes() == (bench / file).read_bytes(), file


def test_the_sample_in_the_repository_is_what_is_generated(tmp_path: Path) -> None:
    """Within the last bits: the sample was made on another processor."""
    manifest = read_manifest(SAMPLE)
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) < 2**20
    (name,) = manifest.scenes
    facts = check_scene(SAMPLE, name)
    generate(tmp_path, [name], shrink=facts.shrink, grades=facts.grades)
    old, new = load_truth(SAMPLE, name), load_truth(tmp_path, name)
    for view, detail in old.views.items():
        assert float((detail.image - new.views[view].image).abs().mean()) < 1 / 255, view
        torch.testing.assert_close(detail.depth, new.views[view].depth, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(detail.world_from_cam, new.views[view].world_from_cam)
        assert float((detail.seen != new.views[view].seen).float().mean()) < 0.001


def test_depth_normals_poses_and_pictures_are_of_one_world(truth: TrueScene, drawn: DrawnScene) -> None:
    """Rays through the pixel centres, traced apart from the renderer, end where the depth says."""
    world_from_first = drawn.cameras.world_from_cam[0]
    for name in (CAPTURED_VIEWS[2], INTENDED, *HELD_OUT):
        view = truth.views[name]
        rows, columns = torch.meshgrid(torch.arange(3, 84, 9), torch.arange(4, 112, 9), indexing="ij")
        centres = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], -1).flatten(0, 1).double()
        rays = centres @ torch.linalg.inv(view.intrinsics_px).T
        pose = world_from_first @ view.world_from_cam
        directions = (rays @ pose[:3, :3].T).float().numpy()
        origins = np.broadcast_to(pose[:3, 3].float().numpy(), directions.shape)
        found = torch.from_numpy(trace_rays(drawn.world, origins, directions))
        depth = view.depth[rows.flatten(), columns.flatten()]
        torch.testing.assert_close(torch.where(torch.isfinite(found), found, 0.0), depth, rtol=1e-3, atol=1e-3)
        solid = view.depth > 0
        assert torch.equal(~solid, view.seen == Seen.NOTHING)
        torch.testing.assert_close(view.normals[solid].norm(dim=-1), torch.ones(int(solid.sum())), rtol=2e-3, atol=0)


def test_a_shrunk_scene_is_the_same_one_in_fewer_pixels(drawn: DrawnScene) -> None:
    """What methods are told of its pictures' size goes with its intrinsics."""
    scene = bench_scene(drawn)
    assert scene.captured.detail_images is not None
    height, width = scene.captured.detail_images.shape[-2:]
    assert (height, width) == (84, 112)
    for record in (*scene.captured.records, *scene.insert(PICTURED["clean"].misalignment)[0].records):
        assert (record.original_height, record.original_width) == (height, width)
        if record.sha256 in scene.captured_truth:
            intrinsics = scene.captured_truth[record.sha256].intrinsics_px
            assert intrinsics[:2, 2].tolist() == [width / 2, height / 2]
    assert scene.intended.image.shape[1:] == scene.captured.images.shape[2:]


def test_no_photograph_shows_the_expanded_region(bench: Path, drawn: DrawnScene) -> None:
    """Between every photograph and a point of the expanded region lies the edge of the picture, or a surface."""
    shown = {}
    for region in ("captured", "expanded"):
        points = _read_points(bench / NAME / "truth" / f"{region}.ply")[::3]
        world = transform_points(drawn.cameras.world_from_cam[0], points).numpy()
        seen = np.zeros(len(world), dtype=bool)
        for pose in drawn.cameras.world_from_cam[: len(CAPTURED_VIEWS)].numpy():
            local = (world - pose[:3, 3]) @ pose[:3, :3]
            pixel = local @ drawn.cameras.intrinsics_px[0].numpy().T / np.maximum(local[:, 2:], 1e-6)
            inside = (local[:, 2] > 0) & (pixel[:, :2] > 0).all(1) & (pixel[:, :2] < [112, 84]).all(1)
            rays = (world - pose[:3, 3]).astype(np.float32)
            first = trace_rays(drawn.world, np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape), rays)
            seen |= inside & (first > 0.98)
        shown[region] = float(seen.mean())
        assert len(world) > 100
    assert shown["captured"] > 0.99
    assert shown["expanded"] < 0.02  # a pixel's width along the borders


def _read_points(path: Path) -> torch.Tensor:
    data = path.read_bytes()
    head = data.index(b"end_header\n") + len(b"end_header\n")
    kinds = [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)]
    return torch.from_numpy(np.frombuffer(data, kinds, offset=head)["xyz"].astype(np.float64))


def test_every_view_shows_something_of_what_it_is_for(truth: TrueScene) -> None:
    share = {
        name: [float((view.seen == region).float().mean()) for region in Seen] for name, view in truth.views.items()
    }
    assert all(share[name][Seen.EXPANDED] == 0 for name in CAPTURED_VIEWS)
    assert share[INTENDED][Seen.UNKNOWN] == 0
    assert share[INTENDED][Seen.EXPANDED] > 0.15
    assert share["beside"][Seen.EXPANDED] > 0.1
    assert share["beside"][Seen.UNKNOWN] < 0.25
    assert share["half_way"][Seen.CAPTURED] > 0.2


def test_what_was_interrupted_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, made = dataset._write_truth, []

    def stops(target: dataset._Folder, views: dict[str, dataset.TrueDetail]) -> None:
        made.append(target.path.parent / target.path.name.split(".")[1])
        if len(made) == 2:
            raise KeyboardInterrupt
        real(target, views)

    monkeypatch.setattr(dataset, "_write_truth", stops)
    names = ["room_1", NAME]
    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path, names, shrink=SHRINK, grades=("clean",))
    assert [path.name for path in tmp_path.iterdir()] == ["room_1"], "nothing half-written, and no manifest"
    with pytest.raises(UserError, match="not finished"):
        read_manifest(tmp_path)
    told = []
    manifest = generate(
        tmp_path, names, shrink=SHRINK, grades=("clean",), on_scene=lambda facts, new: told.append((facts.name, new))
    )
    assert told == [("room_1", False), (NAME, True)]
    assert set(manifest.scenes) == set(names)
    assert not manifest.complete

    (tmp_path / NAME / "truth" / "intended.png").write_bytes(b"damaged")
    with pytest.raises(UserError, match=r"intended\.png: is not as it was written"):
        load_truth(tmp_path, NAME)
    assert generate(tmp_path, names, shrink=SHRINK, grades=("clean",)) == manifest
    assert check_scene(tmp_path, NAME).name == NAME
    assert len(made) == 4, "only the damaged one was made again"


def test_another_version_is_refused(bench: Path, tmp_path: Path) -> None:
    content = json.loads((bench / dataset.MANIFEST).read_text())
    (tmp_path / dataset.MANIFEST).write_text(json.dumps(content | {"version": "0.1"}))
    with pytest.raises(UserError, match=r"version 0\.1"):
        read_manifest(tmp_path)


def test_the_card_is_of_this_version() -> None:
    page = (SAMPLE.parents[1] / "docs" / "expandbench.md").read_text(encoding="utf-8")
    assert f"| version | {dataset.VERSION} |" in page
    assert f"| content | `{dataset.CONTENT}` |" in page
    assert f"| scenes | {len(SCENES)}:" in page
    assert f"| inserted pictures | {len(PICTURED)} per scene" in page
    assert all(f"`{name}`" in page for name in DEVELOPMENT)


def test_scenes_are_named_by_split_or_name() -> None:
    assert scenes_named(["test", "room_101"]) == TEST
    with pytest.raises(UserError, match="did you mean 'room_101'"):
        scenes_named(["room101"])
