"""What `expand` lets in: odd inputs end in one line before anything runs."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from sceneexpander.cli.expand import parse_arguments, stage_scene
from sceneexpander.errors import UserError
from sceneexpander.ingest import load_scene
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.pipeline.preflight import check_scene
from tests.worlds.photos import photos, texture

pytestmark = pytest.mark.timeout(60)
CONF = Path(__file__).parents[3] / "conf"


def refusal(root: Path, *arguments: str) -> str:
    with pytest.raises(UserError) as caught:
        stage_scene(parse_arguments(arguments), "x", root / "scene")
    line = caught.value.line()
    assert "\n" not in line
    line.encode()
    return line


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    photos(tmp_path / "photos", 2)
    texture(9).save(tmp_path / "bench.png")
    return tmp_path / "photos"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *(("/dev/zero", "character device"), ("pipe", "named pipe"), (".", "a folder"), ("loop", "back to itself")),
        *(
            ("none.png", "does not exist"),
            ("x" * 5000, "too long"),
            ("empty", "is empty"),
            ("/dev/null", "character device"),
        ),
    ],
)
def test_inserted_pictures_that_are_no_files(tmp_path: Path, folder: Path, name: str, expected: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "empty").write_bytes(b"")
    line = refusal(tmp_path, str(folder), "--inserted", str(tmp_path / name), "--prompt", "A bench.")
    assert expected in line


@pytest.mark.parametrize(
    "name", ["p." + "x" * 240, "a\nb.png", "no ending", "bench.p-n'g", os.fsdecode(b"\xff.png"), "it's #1, (a=b).PNG"]
)
def test_inserted_pictures_with_odd_names(tmp_path: Path, folder: Path, name: str) -> None:
    (tmp_path / "bench.png").rename(tmp_path / name)
    arguments = (str(folder), "--inserted", str(tmp_path / name), "--prompt", "A bench.")
    stage_scene(parse_arguments(arguments), "x", tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", IngestConfig(long_side_px=112))
    inserted = scene.rounds[0].inserted
    assert inserted is not None
    assert len(inserted) < 30
    assert inserted.isprintable()


@pytest.mark.parametrize("word", ["a\udcffb", "a bench \ud800"])
@pytest.mark.parametrize("option", ["--prompt", "--motion", "--object"])
def test_words_that_are_not_text(tmp_path: Path, folder: Path, word: str, option: str) -> None:
    line = refusal(tmp_path, str(folder), "--inserted", str(tmp_path / "bench.png"), option, word)
    assert "not valid text" in line


@pytest.mark.parametrize("photos", ["x" * 5000, "/dev/zero", "pipe", "none", "loop", "bench.png"])
def test_photos_that_are_no_folder(tmp_path: Path, folder: Path, photos: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    refusal(tmp_path, str(tmp_path / photos), "--inserted", str(tmp_path / "bench.png"), "--prompt", "A bench.")


def test_files_that_are_not_copied_are_still_told(
    tmp_path: Path, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "film: #1, it's\n.mov").write_bytes(b"x")
    arguments = (str(folder), "--inserted", str(tmp_path / "bench.png"), "--prompt", "A bench.")
    stage_scene(parse_arguments(arguments), "x", tmp_path / "scene")
    with caplog.at_level(logging.WARNING):
        scene = load_scene(tmp_path / "scene", IngestConfig(long_side_px=112))
    note = "2 of 3 files are photos; 1 skipped: film: #1, it's\\n.mov (a video)"
    assert scene.notes[0] == note
    assert note in caplog.text
    assert not (tmp_path / "scene" / "captured" / "film.mov").exists()


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"\xff\xfe\x00", b'{"intrinsics_px": [[NaN]], "captured": []}', b'{"captured": []}']
)
def test_truth_is_read_before_anything_runs(tmp_path: Path, folder: Path, content: bytes) -> None:
    arguments = (str(folder), "--inserted", str(tmp_path / "bench.png"), "--prompt", "A bench.")
    stage_scene(parse_arguments(arguments), "x", tmp_path / "scene")
    (tmp_path / "scene" / "truth").mkdir()
    (tmp_path / "scene" / "truth" / "cameras.json").write_bytes(content)
    with pytest.raises(UserError, match=r"truth/cameras.json: is "):
        check_scene("x", tmp_path / "scene", conf=CONF, overrides=["profile=smoke"])
