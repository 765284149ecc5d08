"""Every file of a folder is accounted for, and the same picture is counted once."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageEnhance, ImageFilter

from sceneexpander.errors import UserError
from sceneexpander.ingest import IngestConfig, load_photos, make_round, read_views, survey_pictures
from sceneexpander.ingest.copies import is_copy, thumbnail
from sceneexpander.ingest.panorama import panorama_reason
from tests.worlds.photos import photos, texture

pytestmark = pytest.mark.timeout(60)
CONFIG = IngestConfig(long_side_px=112)
ROUNDS = [make_round("A bench stands behind the table.")]
VIDEO, RAW = b"\0\0\0\x14ftypqt  " + bytes(100), b"II*\0\x08\0\0\0" + bytes(100)


def load_line(folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        load_photos(folder, ROUNDS, CONFIG)
    line = caught.value.line()
    assert "\n" not in line
    return line


def test_files_that_are_no_photos_are_named_first(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    for name, content in (
        ("a.mov", VIDEO),
        ("b.txt", b"hello"),
        ("c.DNG", RAW),
        ("d", b"\x89 nothing"),
        ("e.psd", b"8BPS"),
    ):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "more").mkdir()
    for name in (".DS_Store", "Thumbs.db", "._0.jpg", "0.xmp", "1.AAE"):
        (tmp_path / name).write_bytes(b"companion")
    notes = load_photos(tmp_path, ROUNDS, CONFIG).notes
    assert notes[0] == (
        "2 of 13 files are photos; 6 skipped: a.mov (a video), b.txt, c.DNG (a raw picture), d, e.psd (a Photoshop file), "
        "more (a folder); 5 companion files of the system or of photos"
    )


def test_many_skipped_files_stay_one_line(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    for k in range(300):
        (tmp_path / f"n{k}.txt").write_bytes(b"")
    (note,) = survey_pictures(tmp_path).notes
    assert "300 skipped" in note
    assert "and 292 more" in note
    assert len(note) < 300


def test_companions_alone_are_not_worth_a_note(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    (tmp_path / ".DS_Store").write_bytes(b"x")
    assert not load_photos(tmp_path, ROUNDS, CONFIG).notes


@pytest.mark.parametrize(
    ("name", "fmt"),
    [
        *(
            ("a.jfif", "JPEG"),
            ("a.jpe", "JPEG"),
            ("a.JIF", "JPEG"),
            ("a.avif", "AVIF"),
            ("a.mpo", "MPO"),
            ("a.jp2", "JPEG2000"),
        ),
        *(
            ("a.j2k", "JPEG2000"),
            ("a.gif", "GIF"),
            ("a.ppm", "PPM"),
            ("a.jpg", "AVIF"),
            ("a.png", "WEBP"),
            ("a.heic", "JPEG"),
        ),
        *(
            ("a", "JPEG"),
            ("a.jpg_large", "JPEG"),
            ("a.dat", "PNG"),
            ("IMG_0001", "TIFF"),
            ("a.mov", None),
            ("a.dng", None),
        ),
    ],
)
def test_content_decides_what_is_a_photo(tmp_path: Path, name: str, fmt: str | None) -> None:
    photos(tmp_path, 2)
    if fmt is None:
        (tmp_path / name).write_bytes(RAW)
    else:
        texture(7).save(tmp_path / name, format=fmt)
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert (name in [record.name for record in scene.views.records]) == (fmt is not None)
    assert bool(scene.notes) == (fmt is None)


def test_a_raw_picture_by_another_name_is_refused(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    info = Image.new("RGB", (64, 48)).getexif()
    info[0xC612] = b"\x01\x04\0\0"
    Image.new("RGB", (64, 48), "red").save(tmp_path / "x.tif", tiffinfo={0xC612: b"\x01\x04\0\0"})
    assert "x.tif: is a raw picture" in load_line(tmp_path)


@pytest.mark.parametrize(
    ("head", "name"), [(b"\0\0\0\x18ftypheic" + bytes(99), "pillow-heif"), (b"\xff\x0a" + bytes(99), "pillow-jxl")]
)
@pytest.mark.parametrize("extension", ["heic", "jpg", "jxl"])
def test_photos_that_cannot_be_decoded_name_what_is_missing(
    tmp_path: Path, head: bytes, name: str, extension: str
) -> None:
    photos(tmp_path, 2)
    (tmp_path / f"x.{extension}").write_bytes(head)
    line = load_line(tmp_path)
    assert f"x.{extension}: is a " in line
    assert name in line


def test_pictures_below_are_offered(tmp_path: Path) -> None:
    photos(tmp_path / "DCIM" / "100APPLE", 3)
    assert "holds no pictures itself; DCIM/100APPLE/ holds 3; pass that folder" in load_line(tmp_path)
    photos(tmp_path / "b", 2)
    assert "DCIM/100APPLE/ holds 3, b/ holds 2; pass one of these" in load_line(tmp_path)


def test_a_folder_of_videos_says_so(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.MOV"):
        (tmp_path / name).write_bytes(VIDEO)
    assert "holds no pictures, only: a video (2 times)" in load_line(tmp_path)
    assert "cannot be read as a video" in load_line(tmp_path / "a.mp4")


@pytest.mark.parametrize(
    "name",
    ["a\nb.jpg", "x\x1b[31m.jpg", "\u202egpj.jpg", "Küche 写真.jpg", "it's #1.jpg", "x" * 240 + ".jpg", "a\tb.txt"],
)
def test_odd_names_are_accepted_and_shown_on_one_line(tmp_path: Path, name: str) -> None:
    photos(tmp_path, 2)
    texture(5).save(tmp_path / name, format="JPEG")
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert name in [record.name for record in scene.views.records]
    texture(5).save(tmp_path / name, format="JPEG", quality=60)
    texture(5).save(tmp_path / "again.jpg", quality=50)
    for note in load_photos(tmp_path, ROUNDS, CONFIG).notes:
        assert note.isprintable()


def test_special_files_beside_photos(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "gone").symlink_to("nowhere")
    (note,) = load_photos(tmp_path, ROUNDS, CONFIG).notes
    assert "gone (cannot be read), pipe (a named pipe (FIFO))" in note
    os.mkfifo(tmp_path / "pipe.jpg")
    assert "pipe.jpg: is a named pipe" in load_line(tmp_path)


def saved_again(image: Image.Image) -> dict[str, Image.Image]:
    def jpeg(picture: Image.Image, quality: int) -> Image.Image:
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=quality)
        return Image.open(buffer).convert("RGB")

    half = (image.width // 2, image.height // 2)
    return {
        "compressed": jpeg(image, 30),
        "half": image.resize(half, Image.Resampling.LANCZOS),
        "half, compressed": jpeg(image.resize(half), 60),
        "larger": image.resize((image.width * 2, image.height * 2), Image.Resampling.BICUBIC),
        "brighter": ImageEnhance.Brightness(image).enhance(1.1),
        "darker": ImageEnhance.Brightness(image).enhance(0.8),
        "contrast": ImageEnhance.Contrast(image).enhance(1.15),
        "sharpened": image.filter(ImageFilter.SHARPEN),
    }


def moved(image: Image.Image, share: float, *, only_right: bool = False) -> Image.Image:
    """Shifted by a share of the width, as a hand-held camera would; perhaps only what is near and on the right."""
    shifted = image.transform(
        image.size, Image.Transform.AFFINE, (1, 0, image.width * share, 0, 1, 0), Image.Resampling.BICUBIC
    )
    if only_right:
        half = image.width // 2
        result = image.copy()
        result.paste(shifted.crop((half, 0, image.width, image.height)), (half, 0))
        return result
    return shifted


@pytest.mark.parametrize("seed", range(4))
def test_a_picture_saved_again_is_a_copy_and_a_burst_is_not(seed: int) -> None:
    image = texture(seed, 600, 800, cells=(10, 24, 40, 60)[seed])
    first = thumbnail(np.asarray(image))
    for name, again in saved_again(image).items():
        assert is_copy(first, thumbnail(np.asarray(again)), aspects=(4 / 3, 4 / 3)), name
    for share in (0.002, 0.005, 0.02):
        for only_right in (False, True):
            other = thumbnail(np.asarray(moved(image, share, only_right=only_right)))
            assert not is_copy(first, other, aspects=(4 / 3, 4 / 3)), (share, only_right)
    assert not is_copy(first, thumbnail(np.asarray(texture(seed + 9, 600, 800))), aspects=(4 / 3, 4 / 3))


def test_copies_are_counted_once(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    texture(0).save(tmp_path / "0_copy.jpg", quality=70)
    texture(0).resize((120, 90)).save(tmp_path / "0_small.png")
    moved(texture(0), 0.02).save(tmp_path / "0_next.jpg", quality=95)
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert [record.name for record in scene.views.records] == ["0.jpg", "0_next.jpg", "1.jpg"]
    assert sum("is the same picture, saved again, as 0.jpg" in note for note in scene.notes) == 2
    for name in ("0_next.jpg", "1.jpg"):
        (tmp_path / name).unlink()
    assert "holds only 1 different picture" in load_line(tmp_path)
    assert "saved again, as 0.jpg" in load_line(tmp_path)


@pytest.mark.parametrize(
    "picture", [Image.new("RGB", (120, 90), (3, 0, 0)), Image.new("RGB", (120, 90), "white"), texture(0, 9, 12)]
)
def test_pictures_that_show_nothing_are_left_out(tmp_path: Path, picture: Image.Image) -> None:
    photos(tmp_path, 2)
    picture.save(tmp_path / "nothing.png")
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert len(scene.views) == 2
    assert "nothing.png: " in scene.notes[0]
    assert "left out" in scene.notes[0]


def equirectangular(height: int = 256) -> np.ndarray:
    """Waves on a sphere, sampled by longitude and latitude."""
    longitude, latitude = np.meshgrid(
        np.linspace(0, 2 * np.pi, 2 * height, False), np.linspace(np.pi / 2, -np.pi / 2, height)
    )
    x, y, z = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    channels = [np.sin(9 * x + 2 * y + k) + np.sin(11 * z + 7 * y + k) for k in range(3)]
    return ((np.stack(channels, -1) / 4 + 0.5) * 255).astype(np.uint8)


GPANO = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'


def test_panoramas_are_left_out_by_mark_content_and_shape(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    Image.fromarray(equirectangular()).save(tmp_path / "content.jpg")
    texture(4).save(tmp_path / "marked.jpg", xmp=GPANO.encode())
    texture(5, 80, 500).save(tmp_path / "strip.png")
    texture(6, 500, 80).save(tmp_path / "tall.png")
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert len(scene.views) == 2
    told = " ".join(scene.notes)
    for name in (
        "content.jpg: is a panorama",
        "marked.jpg: is marked as a panorama",
        "strip.png: is a strip",
        "tall.png: is a strip",
    ):
        assert name in told
    assert told.count("cut ordinary views out of it") == 4
    for name in ("0.jpg", "1.jpg"):
        (tmp_path / name).unlink()
    assert "panorama" in load_line(tmp_path)


def test_wide_photos_are_not_panoramas(tmp_path: Path) -> None:
    wide = np.asarray(texture(3, 200, 420))
    assert panorama_reason(wide, "", has_lens=False) is None
    assert panorama_reason(equirectangular(), "", has_lens=True) is None
    # Twice as wide as high without a word about the lens may still be one: it is used, and said.
    for seed in range(2):
        texture(seed, 500, 1000).save(tmp_path / f"{seed}.jpg")
    loaded = read_views(sorted(tmp_path.iterdir()), CONFIG)
    assert len(loaded.views) == 2
    assert all("exactly twice as wide as high" in note for note in loaded.notes)


def test_the_frame_is_that_of_the_first_photo_used(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    texture(5, 80, 500).save(tmp_path / "#first.png")
    assert load_photos(tmp_path, ROUNDS, CONFIG).views.images.shape[2:] == (84, 112)


def test_the_same_note_of_many_photos_is_one_note(tmp_path: Path) -> None:
    for seed in range(5):
        Image.new("RGB", (240, 240)).save(tmp_path / f"{seed}.png")
        framed = Image.new("RGB", (240, 240))
        framed.paste(texture(seed), (0, 30))
        framed.save(tmp_path / f"{seed}.png")
    (note,) = load_photos(tmp_path, ROUNDS, CONFIG).notes
    assert note.startswith("5 photos (0.png, 1.png, 2.png, ...): has bars")
