"""Back-ends with stored pictures: choice, checks, fit, provenance."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.scene import Scene
from sceneexpander.errors import UserError
from sceneexpander.generation import GeneratorConfig, generate_inserted_view
from sceneexpander.ingest import IngestConfig, load_scene

CONFIG = IngestConfig(long_side_px=84)


def photo(path: Path, seed: int, size: tuple[int, int] = (168, 252), **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    Image.fromarray(coarse).resize(size[::-1], Image.Resampling.BICUBIC).save(path, **options)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "scene"
    for index in range(2):
        photo(root / "captured" / f"v{index}.jpg", index)
    photo(root / "candidates" / "2.png", 12)
    photo(root / "candidates" / "10.png", 13, size=(200, 200))
    photo(root / "one.png", 14, size=(100, 155))
    (root / "scene.yaml").write_text(
        "rounds:\n  - {prompt: A bench., inserted: one.png}\n  - {prompt: A cat., inserted: candidates}\n"
        "  - {prompt: A dog.}\n"
    )
    return root


def insert(folder: Path, number: int, **settings: object) -> InsertedView:
    scene = load_scene(folder, CONFIG)
    config = GeneratorConfig(**settings)  # type: ignore[arg-type]
    view, sheet = generate_inserted_view(scene, number, scene.views, folder, config)
    assert sheet.ndim == 3
    return view


def refusal(folder: Path, number: int, **settings: object) -> str:
    with pytest.raises(UserError) as caught:
        insert(folder, number, **settings)
    return caught.value.line()


def test_recorded_picture(folder: Path, tmp_path: Path) -> None:
    inserted = insert(folder, 1)
    scene = load_scene(folder, CONFIG)
    record = inserted.view.records[0]
    assert inserted.view.images.shape == scene.views.images[:1].shape
    assert inserted.view.detail_images.shape == scene.views.detail_images[:1].shape
    assert (record.generated, record.round, record.view_id) == (True, 1, "002_inserted_1")
    assert (record.original_height, record.original_width) == (100, 155)
    scale = 56 / 100  # covers 56 x 84: the height decides
    assert np.allclose(record.stored_from_original, [[scale, 0, 42 - 77.5 * scale], [0, scale, 0]])
    provenance = inserted.provenance[0]
    assert provenance.backend == "replay"
    assert provenance.source == "one.png"
    assert provenance.sha256 == hashlib.sha256((folder / "one.png").read_bytes()).hexdigest() == record.sha256
    assert provenance.prompt.endswith("requirements: A bench.")
    assert provenance.reference_sha256 == tuple(r.sha256 for r in scene.views.records)
    assert provenance.parameters["fit"] == "crop"
    assert provenance.parameters["original_size"] == "155x100"
    assert "warning" not in provenance.parameters
    inserted.save(tmp_path / "out")
    again = InsertedView.load(tmp_path / "out")
    assert again.provenance == inserted.provenance
    assert torch.equal(again.view.images, inserted.view.images)
    assert len(scene.views.append(inserted.view)) == 3


def test_folder_of_candidates(folder: Path) -> None:
    first, second = insert(folder, 2), insert(folder, 2, candidate=1)
    assert first.view.records[0].name == "2.png"
    assert second.view.records[0].name == "10.png"
    assert [p.source for p in first.provenance] == ["candidates/2.png", "candidates/10.png"]
    assert (first.chosen, second.chosen) == (0, 1)
    assert "is 2, but round 2 has 2 candidate(s); use 0 to 1" in refusal(folder, 2, candidate=2)


def test_a_bad_candidate_does_not_hide_the_others(folder: Path) -> None:
    (folder / "candidates" / "3.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    inserted = insert(folder, 2, candidate=0)
    assert inserted.provenance[0].refusal is None
    assert "damaged" in (inserted.provenance[1].refusal or "")
    assert "candidates/3.png: is a damaged or truncated PNG" in refusal(folder, 2, candidate=1)


def test_letterbox_keeps_everything(folder: Path) -> None:
    inserted = insert(folder, 2, candidate=1, fit="pad")
    assert inserted.provenance[1].parameters["kept"] == "1.0000"
    assert inserted.view.images[0, :, :, :10].std() < 1e-5  # flat grey, up to float rounding
    assert insert(folder, 2, candidate=1).view.images[0, :, :, :10].std() > 0.01


def test_own_file(folder: Path, tmp_path: Path) -> None:
    photo(tmp_path / "mine_3.webp", 20)
    inserted = insert(folder, 3, backend="file", file=str(tmp_path / "mine_{round}.webp"))
    assert inserted.provenance[0].backend == "file"
    assert inserted.provenance[0].source == "mine_3.webp"  # no path of the user's machine is recorded
    assert "generator.file: is not set" in refusal(folder, 3, backend="file")
    assert "none.png: does not exist" in refusal(folder, 3, backend="file", file=str(tmp_path / "none.png"))
    assert "is a folder" in refusal(folder, 3, backend="file", file=str(tmp_path))


def test_copy_of_a_captured_view_is_noticed(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Image.open(folder / "captured" / "v1.jpg") as picture:
        picture.resize((200, 133)).save(tmp_path / "copy.jpg", quality=60)
    with caplog.at_level(logging.WARNING):
        inserted = insert(folder, 3, backend="file", file=str(tmp_path / "copy.jpg"))
    assert "nearly a copy of v1.jpg" in inserted.provenance[0].parameters["warning"]
    assert "nearly a copy of v1.jpg" in caplog.text


def test_much_cropped_picture_is_noticed(folder: Path, tmp_path: Path) -> None:
    inserted = insert(folder, 3, backend="file", file=str(photo(tmp_path / "tall.png", 30, size=(300, 100))))
    assert "fits the captured aspect ratio" in inserted.provenance[0].parameters["warning"]


def test_content_that_cannot_be_a_view(folder: Path, tmp_path: Path) -> None:
    def line(pixels: np.ndarray) -> str:
        Image.fromarray(pixels).save(tmp_path / "x.png")
        return refusal(folder, 3, backend="file", file=str(tmp_path / "x.png"))

    assert "x.png: shows a single colour" in line(np.full((200, 300, 3), (9, 200, 30), np.uint8))
    assert "x.png: has only 20 x 30 pixels" in line(np.random.default_rng(0).integers(0, 255, (30, 20, 3), np.uint8))
    (tmp_path / "x.png").write_bytes(b"<html>error 500</html>")
    assert "x.png: is not a picture" in refusal(folder, 3, backend="file", file=str(tmp_path / "x.png"))


def test_refusals(folder: Path, tmp_path: Path) -> None:
    assert "unknown back-end 'replai'; did you mean 'replay'?" in refusal(folder, 1, backend="replai")
    assert "round 3" in refusal(folder, 3)
    assert "has no recorded picture" in refusal(folder, 3)
    assert "round 4 was asked for" in refusal(folder, 4)
    for settings in ({"candidate": -1}, {"fit": "squash"}):
        with pytest.raises(UserError, match=rf"^(generator\.)?{next(iter(settings))}: "):
            GeneratorConfig(**settings)  # type: ignore[arg-type]


def test_a_recorded_picture_that_changed_is_refused(folder: Path) -> None:
    scene = load_scene(folder, CONFIG)
    photo(folder / "one.png", 99)
    with pytest.raises(UserError, match="changed since the scene was prepared"):
        generate_inserted_view(scene, 1, scene.views, folder, GeneratorConfig())
    photo(folder / "candidates" / "2.png", 98)
    with pytest.raises(UserError, match="changed since the scene was prepared"):
        generate_inserted_view(scene, 2, scene.views, folder, GeneratorConfig())


def test_recorded_path_may_not_leave_the_scene(folder: Path, tmp_path: Path) -> None:
    photo(tmp_path / "outside.png", 40)
    scene = load_scene(folder, CONFIG)
    rounds = (dataclasses.replace(scene.rounds[0], inserted="../outside.png", inserted_sha256=None),)
    bent = Scene(name="x", views=scene.views, rounds=rounds)
    with pytest.raises(UserError, match="leads out of"):
        generate_inserted_view(bent, 1, bent.views, folder, GeneratorConfig())


def test_contact_sheet_shows_all_and_marks_the_choice(folder: Path) -> None:
    scene = load_scene(folder, CONFIG)
    sheets = [
        generate_inserted_view(scene, 2, scene.views, folder, GeneratorConfig(candidate=index))[1] for index in (0, 1)
    ]
    assert sheets[0].shape == sheets[1].shape
    changed = (sheets[0] - sheets[1]).abs().amax(0) > 0.1
    rows, columns = changed.nonzero(as_tuple=True)
    assert len(rows) > 0
    # Only the borders in the second row, of the first two tiles, differ.
    assert int(rows.min()) >= sheets[0].shape[1] // 2
    assert int(columns.max()) < sheets[0].shape[2] // 2
