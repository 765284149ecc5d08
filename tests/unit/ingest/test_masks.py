"""Which pixels show the place, and which do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.ingest import IngestConfig, load_photos, make_round
from sceneexpander.ingest.bars import Bars, find_bars, find_overlay
from sceneexpander.ingest.fit import FrameSize, fit_picture
from tests.worlds.photos import texture

CONFIG = IngestConfig(long_side_px=112)
ROUNDS = [make_round("A bench stands behind the table.")]


def on_canvas(
    image: Image.Image, size: tuple[int, int], at: tuple[int, int], colour: tuple[int, int, int]
) -> Image.Image:
    canvas = Image.new("RGB", size, colour)
    canvas.paste(image, at)
    return canvas


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (40, 42, 44), (200, 30, 30)])
@pytest.mark.parametrize("quality", [None, 75])
@pytest.mark.parametrize(
    ("size", "at"),
    [((400, 420), (0, 60)), ((560, 300), (80, 0)), ((500, 400), (50, 50)), ((400, 360), (0, 30))],
)
def test_bars_of_one_colour(
    tmp_path: Path, colour: tuple[int, int, int], quality: int | None, size: tuple[int, int], at: tuple[int, int]
) -> None:
    framed = on_canvas(texture(3, 300, 400), size, at, colour)
    if quality is not None:
        framed.save(tmp_path / "x.jpg", quality=quality)
        framed = Image.open(tmp_path / "x.jpg")
    bars = find_bars(np.asarray(framed))
    expected = (at[1], size[1] - 300 - at[1], at[0], size[0] - 400 - at[0])
    found = (bars.top, bars.bottom, bars.left, bars.right)
    for got, wanted in zip(found, expected, strict=True):
        assert wanted <= got <= wanted + 12 if wanted else got == 0  # compression disturbs the last lines of a bar
    assert bars.words(size[1], size[0])


def sky(kind: str) -> np.ndarray:
    pixels = np.asarray(texture(4, 300, 400)).copy()
    if kind == "white":
        pixels[:80] = 255
    if kind == "night":  # the dark ends in a skyline
        for x in range(400):
            pixels[: 60 + int(40 * np.sin(x / 20)), x] = 0
    if kind == "dark":
        pixels = (pixels * 0.03).astype(np.uint8)
    if kind == "black":
        pixels[:] = 0
    if kind == "ramp":
        pixels[:] = np.linspace(0, 255, 300).astype(np.uint8)[:, None, None]
    if kind == "floor":  # a plain floor that begins at an uneven edge
        pixels[200:] = 120
        pixels[200:260, 100:300] = np.asarray(texture(5, 60, 200))
    return pixels


@pytest.mark.parametrize("kind", ["plain", "white", "night", "dark", "black", "ramp"])
def test_parts_of_the_place_are_no_bars(kind: str) -> None:
    assert not find_bars(sky(kind))


def test_the_mask_of_bars_reaches_the_views(tmp_path: Path) -> None:
    for seed in range(3):
        on_canvas(texture(seed), (240, 240), (0, 30), (0, 0, 0)).save(tmp_path / f"{seed}.jpg", quality=90)
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert scene.views.valid is not None
    edge = round(30 / 240 * 112)
    assert not scene.views.valid[:, :edge].any()
    assert not scene.views.valid[:, -edge:].any()
    assert scene.views.valid[:, edge + 3 : -edge - 3].all()


def with_strip(seed: int, side: str, *, clock: bool = False) -> Image.Image:
    picture = texture(seed).copy()
    draw = ImageDraw.Draw(picture)
    box = {"bottom": (0, 158, 240, 180), "top": (0, 0, 240, 21), "left": (0, 0, 30, 180), "right": (210, 0, 240, 180)}[
        side
    ]
    draw.rectangle(box, fill=(20, 20, 20))
    for k in range(8):
        draw.text(
            (
                box[0] + 2 + (k * 28 if side in ("top", "bottom") else 0),
                box[1] + 4 + (0 if side in ("top", "bottom") else 20 * k),
            ),
            "ISO1",
            fill="white",
        )
    if clock:
        draw.text((box[0] + 2, box[1] + 8), str(seed), fill="white")
    return picture


@pytest.mark.parametrize("side", ["top", "bottom", "left", "right"])
@pytest.mark.parametrize("clock", [False, True])
def test_strips_that_are_the_same_in_all_photos(tmp_path: Path, side: str, clock: bool) -> None:
    for seed in range(3):
        with_strip(seed, side, clock=clock).save(tmp_path / f"{seed}.jpg", quality=90)
    scene = load_photos(tmp_path, ROUNDS, CONFIG)
    assert scene.views.valid is not None
    assert f"the same strip at the border of all photos ({side} " in " ".join(scene.notes)
    share = float(scene.views.valid.float().mean())
    assert 0.84 < share < 0.9
    # Without one of the strips there is no overlay: the others' strip is theirs.
    texture(9).save(tmp_path / "9.jpg")
    assert "the same strip" not in " ".join(load_photos(tmp_path, ROUNDS, CONFIG).notes)


def test_a_sky_that_is_the_same_in_all_photos_is_no_overlay() -> None:
    pictures = []
    for seed in range(4):
        pixels = np.asarray(texture(seed)).copy()
        for x in range(240):
            pixels[: 40 + int(15 * np.sin(x / 17 + seed)), x] = 250
        pictures.append(pixels)
    assert not find_overlay(pictures, np.ones((180, 240), dtype=bool))
    assert not find_overlay([np.asarray(texture(k)) for k in range(3)], np.ones((180, 240), dtype=bool))
    assert not find_overlay([np.asarray(texture(1))] * 3, np.ones((180, 240), dtype=bool))


def test_letterbox_is_said_once(tmp_path: Path) -> None:
    for seed in range(3):
        on_canvas(texture(seed), (240, 240), (0, 30), (0, 0, 0)).save(tmp_path / f"{seed}.jpg", quality=90)
    assert "the same strip" not in " ".join(load_photos(tmp_path, ROUNDS, CONFIG).notes)


@pytest.mark.parametrize("fit", ["pad", "crop"])
def test_borders_of_padded_pictures_are_not_valid(fit: str) -> None:
    frame = FrameSize(height=56, width=84, detail_height=112, detail_width=168)
    fitted = fit_picture(np.asarray(texture(1, 300, 200)), frame, fit)  # type: ignore[arg-type]
    if fit == "crop":
        assert fitted.valid is None
        return
    assert fitted.valid is not None
    inner = 200 / 300 * 56
    assert fitted.valid.sum() == pytest.approx(inner * 56, abs=2 * 56)
    # Nothing of the grey border shines into what is valid.
    white = fit_picture(np.full((300, 200, 3), 255, np.uint8), frame, "pad")
    assert white.valid is not None
    assert white.image[white.valid].min() > 230


@pytest.mark.parametrize("fit", ["pad", "crop"])
def test_transparent_parts_are_not_valid_where_they_lie(fit: str) -> None:
    frame = FrameSize(height=56, width=84, detail_height=56, detail_width=84)
    valid = np.ones((200, 300), dtype=bool)
    valid[50:100, 60:120] = False
    fitted = fit_picture(np.asarray(texture(1, 200, 300)), frame, fit, valid=valid)  # type: ignore[arg-type]
    assert fitted.valid is not None
    (a, _, x), (_, d, y) = fitted.stored_from_original
    assert not fitted.valid[round(50 * d + y) : round(100 * d + y), round(60 * a + x) : round(120 * a + x)].any()
    assert (~fitted.valid).sum() <= (50 * d + 3) * (60 * a + 3)


def test_padding_a_long_photo_costs_no_memory_for_its_border() -> None:
    import tracemalloc

    frame = FrameSize(height=224, width=336, detail_height=224, detail_width=336)
    tracemalloc.start()
    fitted = fit_picture(np.zeros((20_000, 30, 3), np.uint8), frame, "pad")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert fitted.image.shape == (224, 336, 3)
    assert peak < 20e6


def views(valid: torch.Tensor | None, start: int) -> ViewSet:
    from sceneexpander.artifacts.views import ViewRecord

    records = tuple(
        ViewRecord(
            view_id=f"{start + k:03d}",
            name="x",
            original_height=4,
            original_width=6,
            sha256="",
            stored_from_original=((1, 0, 0), (0, 1, 0)),
        )
        for k in range(2)
    )
    images = torch.rand(2, 3, 4, 6).mul(255).round() / 255
    return ViewSet(records=records, images=images, detail_images=images, valid=valid)


@pytest.mark.wrong_shapes
def test_masks_travel_with_views(tmp_path: Path) -> None:
    mask = torch.rand(2, 4, 6) > 0.5
    masked, whole = views(mask, 0), views(None, 2)
    joined = whole.append(masked)
    assert joined.valid is not None
    assert joined.valid[:2].all()
    assert torch.equal(joined.valid[2:], mask)
    picked = joined.select([3, 0]).valid
    assert picked is not None
    assert torch.equal(picked[0], mask[1])
    assert whole.append(views(None, 4)).valid is None
    joined.save(tmp_path / "joined")
    again = ViewSet.load(tmp_path / "joined").valid
    assert again is not None
    assert torch.equal(again, joined.valid)
    whole.save(tmp_path / "whole")
    assert ViewSet.load(tmp_path / "whole").valid is None
    with pytest.raises(ValueError, match="masks have shape"):
        views(mask[:, :3], 0)


def test_notes_travel_with_scenes(tmp_path: Path) -> None:
    scene = Scene(name="x", views=views(None, 0), rounds=tuple(ROUNDS), notes=("a.mov is a video",))
    scene.save(tmp_path)
    assert Scene.load(tmp_path).notes == scene.notes


def test_bars_in_words() -> None:
    assert Bars(12, 12, 0, 5).words(100, 100) == "top 12%, bottom 12%, right 5%"
    assert not Bars()
