"""Photos of the bundled scene, and what phones, programs and people make of such photos, come in right."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFilter

from sceneexpander.artifacts.scene import Scene
from sceneexpander.ingest import IngestConfig, load_photos, load_scene, make_round

BUNDLED = Path(__file__).parents[3] / "scenes" / "courtyard"
CONFIG = IngestConfig(long_side_px=168)
ROUNDS = [make_round("Behind the wall is a bench.")]
PHOTOS = [Image.open(path).convert("RGB") for path in sorted((BUNDLED / "captured").iterdir())[:4]]
PLAIN = 4

Make = Callable[[Path], None]
CASES: dict[str, tuple[Make, int, str]] = {}  # what is made, how many views come of it, and what the notes say


def case(views: int = PLAIN, note: str = "") -> Callable[[Make], Make]:
    def register(make: Make) -> Make:
        CASES[make.__name__] = (make, views, note)
        return make

    return register


def put(folder: Path, change: Callable[[int, Image.Image], Image.Image], suffix: str = ".jpg") -> None:
    for k, picture in enumerate(PHOTOS):
        changed = change(k, picture)
        changed.save(folder / f"{k}{suffix}", **({"quality": 92} if suffix == ".jpg" else {}))


@case()
def as_they_are(folder: Path) -> None:
    put(folder, lambda _, picture: picture)


@case()
def dark_blurred_and_grey(folder: Path) -> None:
    changes = [
        lambda picture: Image.fromarray((np.asarray(picture) * [0.35, 0.3, 0.25]).astype(np.uint8)),
        lambda picture: picture.filter(ImageFilter.GaussianBlur(6)),
        lambda picture: picture.convert("L"),
        lambda picture: picture.rotate(180),
    ]
    put(folder, lambda k, picture: changes[k](picture))


@case()
def a_phone_held_level_and_turned(folder: Path) -> None:
    put(folder, lambda k, picture: picture.crop((100, 0, 532, 576)) if k == 2 else picture)


@case()
def zoomed(folder: Path) -> None:
    put(folder, lambda _, picture: picture.crop((192, 144, 576, 432)).resize(picture.size, Image.Resampling.LANCZOS))


@case(note="taken as 12-bit")
def samples_of_12_bits(folder: Path) -> None:
    for k, picture in enumerate(PHOTOS):
        cv2.imwrite(str(folder / f"{k}.png"), np.asarray(picture)[:, :, ::-1].astype(np.uint16) * 16)


@case(note="the same strip at the border of all photos (bottom")
def status_bar(folder: Path) -> None:
    def change(_: int, picture: Image.Image) -> Image.Image:
        picture = picture.copy()
        draw = ImageDraw.Draw(picture)
        draw.rectangle((0, picture.height - 70, picture.width, picture.height), fill=(20, 20, 20))
        for k in range(12):
            draw.text((10 + k * 62, picture.height - 60), f"ISO {100 * k}", fill="white")
        return picture

    put(folder, change)


@case(note="has bars of one colour (top 13%, bottom 13%)")
def letterbox(folder: Path) -> None:
    def change(_: int, picture: Image.Image) -> Image.Image:
        canvas = Image.new("RGB", (picture.width, picture.width))
        canvas.paste(picture, (0, (picture.width - picture.height) // 2))
        return canvas

    put(folder, change)


@case(views=PLAIN, note="saved again")
def forwarded_copies(folder: Path) -> None:
    put(folder, lambda _, picture: picture)
    PHOTOS[0].save(folder / "0 forwarded.jpg", quality=50)
    PHOTOS[1].resize((384, 288)).save(folder / "1 small.jpg", quality=80)


@case()
def other_formats(folder: Path) -> None:
    for picture, name in zip(PHOTOS, ("a.jfif", "b.avif", "c.jpg", "d.jp2"), strict=True):
        fmt = {"a.jfif": "JPEG", "b.avif": "AVIF", "c.jpg": "WEBP", "d.jp2": "JPEG2000"}[name]
        picture.save(folder / name, format=fmt)


@case()
def turned_files(folder: Path) -> None:
    stored = {1: None, 3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
    for k, (orientation, back) in enumerate(stored.items()):
        exif = Image.Exif()
        exif[0x0112] = orientation
        lying = PHOTOS[k] if back is None else PHOTOS[k].transpose(back)
        lying.save(folder / f"{k}.jpg", quality=92, exif=exif.tobytes())


@case()
def links_and_odd_names(folder: Path) -> None:
    for name, path in zip(
        ("Küche 1.jpg", "台所２.jpg", "a,b#c=(1).jpg", "line\nbreak.jpg"), BUNDLED.glob("captured/*"), strict=False
    ):
        (folder / name).symlink_to(path)


@case(note="4 of 6 files are photos; 2 skipped: film.MOV (a video), raw.cr2 (a raw picture)")
def a_memory_card(folder: Path) -> None:
    put(folder, lambda _, picture: picture)
    for name in ("film.MOV", "raw.cr2"):
        (folder / name).write_bytes(os.urandom(64))


def load(folder: Path) -> Scene:
    return load_photos(folder, ROUNDS, CONFIG)


@pytest.mark.parametrize("name", CASES)
def test_photos_come_in_right(tmp_path: Path, name: str) -> None:
    make, views, note = CASES[name]
    make(tmp_path)
    scene = load(tmp_path)
    assert len(scene.views) == views
    told = " ".join(scene.notes)
    if note:
        assert note in told
    else:
        assert not [line for line in scene.notes if "fits the frame" not in line]
    expected_masks = name in ("status_bar", "letterbox")
    assert (scene.views.valid is not None) == expected_masks
    if name in ("samples_of_12_bits", "other_formats", "turned_files", "a_memory_card"):
        (tmp_path / "plain").mkdir()
        as_they_are(tmp_path / "plain")
        difference = (scene.views.images - load(tmp_path / "plain").views.images).abs()
        assert float(difference.mean()) < 0.02


def test_the_bundled_scene_gives_no_cause_for_notes() -> None:
    scene = load_scene(BUNDLED, CONFIG)
    assert not scene.notes
    assert scene.views.valid is None
