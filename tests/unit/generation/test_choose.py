"""Back-ends with stored pictures: choice, checks, fit, provenance."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.scene import Scene
from sceneexpander.errors import UserError
from sceneexpander.generation import ChoiceConfig, ChosenView, GeneratorConfig, check_round, choose_view, make_generator
from sceneexpander.generation.backends.stored import FileConfig, ReplayConfig
from sceneexpander.ingest import IngestConfig, load_scene
from tests.worlds.rounds import context_of, flat_scene, photo

CONFIG = IngestConfig(long_side_px=84)
REPLAY = ReplayConfig()


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


def chosen_view(
    folder: Path, number: int, generator: GeneratorConfig = REPLAY, scene: Scene | None = None, **choice: Any
) -> ChosenView:
    """Through both stages: candidates, then the choice; and what is known before agrees with it."""
    scene = load_scene(folder, CONFIG) if scene is None else scene
    context, so_far, chosen = context_of(scene, folder, number), flat_scene(scene.views), ChoiceConfig(**choice)
    _, foreseen = check_round(context, generator, chosen)
    made = make_generator(generator).generate(context, so_far)
    view = choose_view(context, made.candidates, so_far, chosen, seed=0)
    assert view.sheet.ndim == 3
    if not view.inserted.ranking:
        assert foreseen is not None
        assert foreseen.provenance == view.inserted.provenance
        assert torch.equal(foreseen.view.images, view.inserted.view.images)
    return view


def insert(folder: Path, number: int, generator: GeneratorConfig = REPLAY, **choice: Any) -> InsertedView:
    return chosen_view(folder, number, generator, **choice).inserted


def refusal(folder: Path, number: int, generator: GeneratorConfig = REPLAY, **choice: Any) -> str:
    with pytest.raises(UserError) as caught:
        insert(folder, number, generator, **choice)
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
    first, second = insert(folder, 2, candidate=0), insert(folder, 2, candidate=1)
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
    assert insert(folder, 2, candidate=1, fit="crop").view.images[0, :, :, :10].std() > 0.01


def test_own_file(folder: Path, tmp_path: Path) -> None:
    photo(tmp_path / "mine_3.webp", 20)
    inserted = insert(folder, 3, FileConfig(file=str(tmp_path / "mine_{round}.webp")))
    assert inserted.provenance[0].backend == "file"
    assert inserted.provenance[0].source == "mine_3.webp"  # no path of the user's machine is recorded
    assert "generator.file: is not set" in refusal(folder, 3, FileConfig())
    assert "none.png: does not exist" in refusal(folder, 3, FileConfig(file=str(tmp_path / "none.png")))
    assert "is a folder" in refusal(folder, 3, FileConfig(file=str(tmp_path)))


def test_copy_of_a_captured_view_is_noticed(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Image.open(folder / "captured" / "v1.jpg") as picture:
        picture.resize((200, 133)).save(tmp_path / "copy.jpg", quality=60)
    with caplog.at_level(logging.WARNING):
        inserted = insert(folder, 3, FileConfig(file=str(tmp_path / "copy.jpg")))
    assert "nearly a copy of v1.jpg" in inserted.provenance[0].parameters["warning"]
    assert "nearly a copy of v1.jpg" in caplog.text


def test_much_cropped_picture_is_noticed(folder: Path, tmp_path: Path) -> None:
    inserted = insert(folder, 3, FileConfig(file=str(photo(tmp_path / "tall.png", 30, size=(300, 100)))))
    assert "fits the captured aspect ratio" in inserted.provenance[0].parameters["warning"]


def test_content_that_cannot_be_a_view(folder: Path, tmp_path: Path) -> None:
    def line(pixels: np.ndarray) -> str:
        Image.fromarray(pixels).save(tmp_path / "x.png")
        return refusal(folder, 3, FileConfig(file=str(tmp_path / "x.png")))

    assert "x.png: shows a single colour" in line(np.full((200, 300, 3), (9, 200, 30), np.uint8))
    assert "x.png: has only 20 x 30 pixels" in line(np.random.default_rng(0).integers(0, 255, (30, 20, 3), np.uint8))
    (tmp_path / "x.png").write_bytes(b"<html>error 500</html>")
    assert "x.png: is not a picture" in refusal(folder, 3, FileConfig(file=str(tmp_path / "x.png")))


def test_a_recorded_picture_that_cannot_be_a_view_is_named_by_its_path(folder: Path) -> None:
    """Who copied the scene's folder can then name the file that the user gave."""
    photo(folder / "one.png", 14, size=(30, 20))
    assert refusal(folder, 1).startswith(f"{folder / 'one.png'}: has only 20 x 30 pixels")


def test_refusals(folder: Path, tmp_path: Path) -> None:
    assert "unknown back-end 'replai'; did you mean 'replay'?" in refusal(folder, 1, GeneratorConfig(backend="replai"))
    assert "round 3" in refusal(folder, 3)
    assert "has no recorded picture" in refusal(folder, 3)
    assert "round 4 was asked for" in refusal(folder, 4)
    for settings in ({"candidate": -1}, {"fit": "squash"}):
        with pytest.raises(UserError, match=rf"^(choose\.)?{next(iter(settings))}: "):
            ChoiceConfig(**settings)  # type: ignore[arg-type]


def test_a_recorded_picture_that_changed_is_refused(folder: Path) -> None:
    scene = load_scene(folder, CONFIG)
    photo(folder / "one.png", 99)
    with pytest.raises(UserError, match="changed since the scene was prepared"):
        chosen_view(folder, 1, scene=scene)
    photo(folder / "candidates" / "2.png", 98)
    with pytest.raises(UserError, match="changed since the scene was prepared"):
        chosen_view(folder, 2, scene=scene)


def test_recorded_path_may_not_leave_the_scene(folder: Path, tmp_path: Path) -> None:
    photo(tmp_path / "outside.png", 40)
    scene = load_scene(folder, CONFIG)
    rounds = (dataclasses.replace(scene.rounds[0], inserted="../outside.png", inserted_sha256=None),)
    bent = Scene(name="x", views=scene.views, rounds=rounds)
    with pytest.raises(UserError, match="leads out of"):
        chosen_view(folder, 1, scene=bent)


def test_contact_sheet_shows_all_and_marks_the_choice(folder: Path) -> None:
    sheets = [chosen_view(folder, 2, candidate=index).sheet for index in (0, 1)]
    assert sheets[0].shape == sheets[1].shape
    changed = (sheets[0] - sheets[1]).abs().amax(0) > 0.1
    rows, columns = changed.nonzero(as_tuple=True)
    assert len(rows) > 0
    # Only the borders in the second row, of the first two tiles, differ.
    assert int(rows.min()) >= sheets[0].shape[1] // 2
    assert int(columns.max()) < sheets[0].shape[2] // 2


def test_a_picture_of_ones_own_takes_the_place_of_all_candidates(folder: Path, tmp_path: Path) -> None:
    own = photo(tmp_path / "mine_2.png", 50)
    inserted = insert(folder, 2, candidate=str(tmp_path / "mine_{round}.png"))
    assert inserted.chosen == 2
    assert inserted.provenance[2].sha256 == hashlib.sha256(own.read_bytes()).hexdigest()
    assert inserted.view.records[0].name == "mine_2.png"
    assert "none.png: does not exist" in refusal(folder, 2, candidate=str(tmp_path / "none.png"))


def test_auto_passes_over_what_is_no_picture(folder: Path) -> None:
    (folder / "candidates" / "2.png").write_bytes(b"no picture")
    inserted = insert(folder, 2)
    assert inserted.chosen == 1
    assert inserted.provenance[0].refusal is not None
    assert inserted.ranking == ()
