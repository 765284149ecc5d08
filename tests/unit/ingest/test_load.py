"""Scene folders and photo folders: what is accepted, and one clear line for what is not."""

from __future__ import annotations

import logging
import os
import shutil
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.scene import Scene
from sceneexpander.errors import UserError
from sceneexpander.ingest import (
    IngestConfig,
    list_pictures,
    load,
    load_photos,
    load_scene,
    make_round,
    read_views,
    safe_name,
)
from sceneexpander.ingest.survey import natural_key

CONFIG = IngestConfig(long_side_px=56)
ROUNDS = [make_round("A wooden bench stands behind the table.")]


def photo(path: Path, seed: int, size: tuple[int, int] = (80, 120), **options: object) -> Path:
    """A different smooth picture for every seed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    Image.fromarray(coarse).resize(size[::-1], Image.Resampling.BICUBIC).save(path, **options)
    return path


def scene_folder(root: Path, text: str, count: int = 2) -> Path:
    for index in range(count):
        photo(root / "captured" / f"v{index}.jpg", index)
    root.mkdir(exist_ok=True)
    (root / "scene.yaml").write_text(text, encoding="utf-8")
    return root


def refusal(folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        load_scene(folder, CONFIG)
    assert "\n" not in caught.value.line()
    return caught.value.line()


def test_scene_folder(tmp_path: Path) -> None:
    photo(tmp_path / "inserted" / "a.png", 9)
    folder = scene_folder(
        tmp_path,
        "name: my scene\norigin: us\nrounds:\n  - prompt: 'A  bench.'\n    inserted: inserted/a.png\n"
        "  - {motion: move back, object: a squirrel sits on a stone bench}\n",
    )
    scene = load_scene(folder, CONFIG)
    assert scene.name == "my_scene"
    assert scene.views.images.shape == (2, 3, 42, 56)
    # The 80 x 120 originals have pixels for 26/14 of the stored size, not for twice.
    assert scene.views.detail_images.shape == (2, 3, 78, 104)
    assert scene.rounds[0].prompt == "A bench."
    assert len(scene.rounds[0].inserted_sha256 or "") == 64
    assert scene.rounds[1].prompt == "move back; a squirrel sits on a stone bench"
    assert (scene.rounds[1].motion, scene.rounds[1].new_object) == ("move back", "a squirrel sits on a stone bench")
    assert not bool(scene.views.generated.any())


def test_saved_scene_is_the_loaded_scene(tmp_path: Path) -> None:
    scene = load_scene(scene_folder(tmp_path / "s", "rounds: [{prompt: A cat.}]"), CONFIG, name="other")
    scene.save(tmp_path / "out")
    again = Scene.load(tmp_path / "out")
    assert again.name == "other"
    assert again.views.records == scene.views.records
    assert torch.equal(again.views.images, scene.views.images)
    assert torch.equal(again.views.detail_images, scene.views.detail_images)


def test_plain_folder_with_mixed_sizes_and_names(tmp_path: Path) -> None:
    names = ["view 10.JPG", "view 2.JPEG", "äöü: été.png", "-dash.webp", "view 1.TIF", "日本.bmp"]
    for seed, name in enumerate(names):
        photo(tmp_path / name, seed, size=(80, 120) if seed % 2 else (130, 90))
    for junk in ("._view 1.jpg", ".hidden.png", "Thumbs.db", "notes.txt"):
        (tmp_path / junk).write_bytes(b"junk")
    (tmp_path / "folder.jpg").mkdir()
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert [record.name for record in scene.views.records] == [
        "-dash.webp",
        "view 1.TIF",
        "view 2.JPEG",
        "view 10.JPG",
        "äöü: été.png",
        "日本.bmp",
    ]
    assert scene.views.view_ids == (
        "000_dash",
        "001_view_1",
        "002_view_2",
        "003_view_10",
        "004_aou_ete",
        "005_view",
    )
    assert scene.views.images.shape[0] == 6
    portrait = scene.views.records[1]
    assert (portrait.original_height, portrait.original_width) == (130, 90)


def test_natural_order_is_total() -> None:
    names = ["b", "a10", "a2", "A2", "a02", "10", "9", "a"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "A2", "a02", "a2", "a10", "b"]


def test_same_stem_twice_stays_apart(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", 1)
    photo(tmp_path / "a.png", 2)
    assert load_photos(tmp_path, ROUNDS, CONFIG).views.view_ids == ("000_a", "001_a")


def test_safe_names() -> None:
    assert safe_name("../../etc/passwd") == "etc_passwd"
    assert safe_name("a\nb:c") == "a_b_c"
    assert safe_name("...") == "view"
    assert len(safe_name("x" * 500)) == 48


def test_order(tmp_path: Path) -> None:
    folder = scene_folder(tmp_path, "rounds: [{prompt: A cat.}]\norder: [v2.jpg, v0.jpg]\n", count=3)
    assert [r.name for r in load_scene(folder, CONFIG).views.records] == ["v2.jpg", "v0.jpg", "v1.jpg"]
    (folder / "scene.yaml").write_text("rounds: [{prompt: A cat.}]\norder: [v7.jpg]\n")
    assert "'v7.jpg'" in refusal(folder)
    assert "did you mean" in refusal(folder)


def test_images_folder_can_be_named(tmp_path: Path) -> None:
    folder = scene_folder(tmp_path, "rounds: [{prompt: A cat.}]\nimages: photos\n")
    assert "names photos, which does not exist" in refusal(folder)
    (folder / "captured").rename(folder / "photos")
    assert len(load_scene(folder, CONFIG).views) == 2
    (folder / "scene.yaml").write_text("rounds: [{prompt: A cat.}]\nimages: ../elsewhere\n")
    assert "leads out of" in refusal(folder)


def test_duplicates_are_reported_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    photo(tmp_path / "a.png", 1)
    photo(tmp_path / "b.png", 2)
    photo(tmp_path / "c.bmp", 1)  # the same pixels in another format
    with caplog.at_level(logging.WARNING):
        scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert [record.name for record in scene.views.records] == ["a.png", "b.png"]
    assert "c.bmp: shows the same pixels as a.png" in caplog.text
    (tmp_path / "b.png").unlink()
    with pytest.raises(UserError, match="only 1 different picture,"):
        load_photos(tmp_path, ROUNDS, CONFIG)


def test_much_cropped_views_are_noted(tmp_path: Path) -> None:
    paths = [photo(tmp_path / "a.png", 1, (80, 120)), photo(tmp_path / "b.png", 2, (120, 80))]
    loaded = read_views(paths, CONFIG)
    assert len(loaded.notes) == 1
    assert loaded.notes[0].startswith("b.png: only 50%") or loaded.notes[0].startswith("b.png: only 4")


def test_lens_facts_reach_the_records(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0110] = "Phone 7"
    exif.get_ifd(0x8769)[0xA405] = 36
    paths = [photo(tmp_path / "a.jpg", 1, exif=exif.tobytes()), photo(tmp_path / "b.jpg", 2)]
    first, second = read_views(paths, CONFIG).views.records
    assert first.lens is not None
    assert first.lens.camera == "Phone 7"
    assert first.lens.focal_px == pytest.approx(120)  # of the original's pixels
    assert second.lens is not None
    assert second.lens.focal_px is None


def test_links(tmp_path: Path) -> None:
    outside = photo(tmp_path / "outside.jpg", 5)
    folder = scene_folder(tmp_path / "scene", "rounds: [{prompt: A cat.}]")
    (folder / "captured" / "inner.jpg").symlink_to(photo(folder / "store" / "x.jpg", 6))
    assert len(load_scene(folder, CONFIG).views) == 3
    (folder / "captured" / "outer.jpg").symlink_to(outside)
    assert "outer.jpg: is a link that leads out of" in refusal(folder)
    linked = tmp_path / "linked_scene"
    (folder / "captured" / "outer.jpg").unlink()
    linked.symlink_to(folder)
    assert load_scene(linked, CONFIG).name == "scene"


def test_too_few_and_too_many(tmp_path: Path) -> None:
    folder = scene_folder(tmp_path / "one", "rounds: [{prompt: A cat.}]", count=1)
    assert "holds only 1 picture, 2 or more are needed" in refusal(folder)
    assert len(load_scene(folder, IngestConfig(long_side_px=56, allow_single_view=True)).views) == 1
    (folder / "captured" / "v0.jpg").unlink()
    assert "holds no pictures" in refusal(folder)
    many = scene_folder(tmp_path / "many", "rounds: [{prompt: A cat.}]", count=4)
    with pytest.raises(UserError, match="more than the 3 allowed"):
        load_scene(many, IngestConfig(long_side_px=56, max_views=3))


@pytest.mark.parametrize("content", [b"", b"not a picture", b"\xff\xd8\xff\xe0 cut"])
def test_one_bad_photo_is_named(tmp_path: Path, content: bytes) -> None:
    folder = scene_folder(tmp_path, "rounds: [{prompt: A cat.}]")
    (folder / "captured" / "v1.jpg").write_bytes(content)
    assert "captured/v1.jpg: is" in refusal(folder)


def test_heic_is_not_passed_over(tmp_path: Path) -> None:
    folder = scene_folder(tmp_path, "rounds: [{prompt: A cat.}]")
    (folder / "captured" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    assert "IMG_1.HEIC" in refusal(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "holds NoneType"),
        ("name: [x", "is not valid YAML"),
        ("- a\n- b\n", "holds list"),
        ("name: x\n", "has no rounds"),
        ("rounds: []\n", "has no rounds"),
        ("rounds: [{promt: A cat.}]\n", "did you mean 'prompt'?"),
        ("rounds: [{prompt: '  '}]\n", 'round 1: has no prompt; say what to add, e.g. prompt: "'),
        ("rounds: [{prompt: A cat.}, {inserted: x.png}]\n", "round 2: has no prompt"),
        ("rounds: [{prompt: [a, b]}]\n", "expected text"),
        ("rounds: [A cat.]\n", "round 1 holds str"),
        ("ronds: [{prompt: A cat.}]\n", "did you mean 'rounds'?"),
        ("rounds: [{prompt: A cat., inserted: none.png}]\n", "none.png, which does not exist"),
        ("rounds: [{prompt: A cat., inserted: ../x.png}]\n", "leads out of"),
        ("rounds: [{prompt: A cat., inserted: /etc/hostname}]\n", "absolute path"),
        ("rounds: [{prompt: A cat.}]\norder: v0.jpg\n", "list of file names"),
        ("rounds: [{prompt: A cat.}]\norder: [v0.jpg, v0.jpg]\n", "names a file twice"),
        ("rounds: [{prompt: A cat.}]\nname: {a: b}\n", "expected text"),
        ("rounds: [{prompt: !!python/object/apply:os.getcwd []}]\n", "is not valid YAML"),
    ],
)
def test_scene_file_refusals(tmp_path: Path, text: str, expected: str) -> None:
    line = refusal(scene_folder(tmp_path, text))
    assert expected in line
    assert "scene.yaml" in line


def test_folder_refusals(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "nowhere")
    assert "has no scene.yaml" in refusal(tmp_path)
    with pytest.raises(UserError, match="no prompt"):
        load_photos(tmp_path, [], CONFIG)
    with pytest.raises(UserError, match="no prompt"):
        make_round(" \n ")
    with pytest.raises(UserError, match="holds no pictures"):
        list_pictures(tmp_path)


def test_folder_of_candidates_has_one_digest(tmp_path: Path) -> None:
    photo(tmp_path / "inserted" / "1.png", 7)
    photo(tmp_path / "inserted" / "2.png", 8)
    folder = scene_folder(tmp_path, "rounds: [{prompt: A cat., inserted: inserted}]")
    first = load_scene(folder, CONFIG).rounds[0].inserted_sha256
    photo(tmp_path / "inserted" / "2.png", 9)
    assert load_scene(folder, CONFIG).rounds[0].inserted_sha256 != first


@pytest.mark.parametrize(
    "settings", [{"long_side_px": 340}, {"fit": "stretch"}, {"max_views": 0}, {"max_megapixels": -1.0}]
)
def test_config_ranges(settings: dict[str, object]) -> None:
    with pytest.raises(UserError, match=rf"^(ingest\.)?{next(iter(settings))}: "):
        IngestConfig(**settings)  # type: ignore[arg-type]


@pytest.fixture
def several_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def mixed_photos(folder: Path) -> list[Path]:
    """Of several formats; a copy, one of a single colour and one with bars among them."""
    paths = [photo(folder / f"{index}.{ending}", index) for index, ending in enumerate(("png", "tiff", "jpg", "png"))]
    paths.append(folder / "copy.png")
    shutil.copyfile(paths[0], paths[-1])
    paths.append(folder / "grey.png")
    Image.new("RGB", (120, 80), (90, 90, 90)).save(paths[-1])
    with Image.open(photo(folder / "barred.png", 7)) as picture:
        picture.paste((0, 0, 0), (0, 0, 120, 12))
        picture.save(folder / "barred.png")
    return [*paths, folder / "barred.png"]


@pytest.mark.usefixtures("several_threads")
def test_photos_that_are_read_side_by_side_are_those_read_one_after_the_other(tmp_path: Path) -> None:
    paths = mixed_photos(tmp_path)
    together = read_views(paths, CONFIG)
    torch.set_num_threads(1)
    alone = read_views(paths, CONFIG)
    assert together.notes == alone.notes
    assert len(alone.notes) == 3
    assert together.views.records == alone.views.records
    assert torch.equal(together.views.images, alone.views.images)
    assert torch.equal(together.views.validity(), alone.views.validity())


@pytest.mark.usefixtures("several_threads")
def test_reading_side_by_side_leaves_messages_and_warnings_as_they_were(tmp_path: Path) -> None:
    paths = [photo(tmp_path / f"{index}.png", index, (60, 90)) for index in range(12)]
    before, filters = os.fstat(2), list(warnings.filters)
    read_views(paths, CONFIG)
    assert (os.fstat(2).st_dev, os.fstat(2).st_ino) == (before.st_dev, before.st_ino)
    assert warnings.filters == filters


@pytest.mark.usefixtures("several_threads")
@pytest.mark.parametrize(("allowed", "most"), [(1.0, 3), (0.01, 1)])
def test_pictures_are_read_side_by_side_only_while_they_are_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, allowed: float, most: int
) -> None:
    paths = [photo(tmp_path / f"{index}.png", index) for index in range(6)]
    inside, counts, lock, read = [0], list[int](), threading.Lock(), load._read_shot
    everyone = threading.Barrier(most)

    def counted(*arguments: Any) -> Any:
        with lock:
            inside[0] += 1
            counts.append(inside[0])
        everyone.wait(timeout=10)
        found = read(*arguments)
        with lock:
            inside[0] -= 1
        return found

    monkeypatch.setattr(load, "_read_shot", counted)
    monkeypatch.setattr(load, "_MEGAPIXELS_AT_ONCE", allowed)
    assert len(read_views(paths, CONFIG).views) == len(paths)
    assert max(counts) == most


@pytest.mark.usefixtures("several_threads")
def test_the_first_unusable_photo_is_the_one_that_is_named(tmp_path: Path) -> None:
    paths = [photo(tmp_path / f"{index}.png", index) for index in range(6)]
    for broken in (2, 4):
        paths[broken].write_bytes(paths[broken].read_bytes()[:200])
    with pytest.raises(UserError, match=r"2\.png"):
        read_views(paths, CONFIG)
