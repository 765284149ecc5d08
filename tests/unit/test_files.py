"""Where nothing can be written is one line, and nothing that was there is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file, directory_being_written, write_bytes_atomic


@pytest.mark.parametrize("deep", ["x", "x/y"])
def test_a_place_below_a_file_is_named(tmp_path: Path, deep: str) -> None:
    (tmp_path / "file").write_text("mine")
    place = tmp_path / "file" / deep
    with pytest.raises(UserError, match=r"cannot be written to \(Not a directory\)") as caught:
        write_bytes_atomic(place / "a.bin", b"a")
    assert caught.value.where == str(place)
    with pytest.raises(UserError, match="cannot be written to"), directory_being_written(place / "folder"):
        raise AssertionError("nothing can be written")


def test_what_is_there_under_the_name_is_kept(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a").write_text("mine")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="folder: is a folder, expected a file"):
        write_bytes_atomic(tmp_path / "folder", b"a")
    with (
        pytest.raises(UserError, match="file: is a file, expected a folder"),
        directory_being_written(tmp_path / "file"),
    ):
        raise AssertionError("nothing can be written")
    assert (tmp_path / "folder" / "a").read_text() == (tmp_path / "file").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_a_file_that_is_missing_while_another_is_written_is_not_taken_for_the_place(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), complete_file(tmp_path / "a") as scratch:
        scratch.write_bytes((tmp_path / "nothing").read_bytes())
