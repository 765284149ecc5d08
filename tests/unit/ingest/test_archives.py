"""ZIP archives: what is unpacked lies below its folder, is bounded, and is there as a whole or not at all."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneexpander.errors import UserError
from sceneexpander.ingest import archives
from sceneexpander.ingest.archives import is_archive, unpack_archive
from sceneexpander.ingest.sources import find_source, read_capture
from tests.worlds.captures import CONFIG, colmap, pictures, video

pytestmark = pytest.mark.timeout(60)


def pack(folder: Path, archive: Path) -> Path:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for path in sorted(folder.rglob("*")):
            packed.write(path, path.relative_to(folder.parent))
    return archive


def archive_of(path: Path, *members: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in members:
            packed.writestr(name, data)
    return path


def refusal(archive: Path, tmp_path: Path) -> str:
    before = set(tmp_path.rglob("*"))
    with pytest.raises(UserError) as caught:
        unpack_archive(archive, tmp_path / "unpacked")
    assert set(tmp_path.rglob("*")) == before, "nothing may be left"
    line = caught.value.line()
    assert line.startswith(str(archive))
    return line


def test_a_packed_folder_is_the_same_capture(tmp_path: Path) -> None:
    colmap(tmp_path / "data")
    place = unpack_archive(pack(tmp_path / "data", tmp_path / "data.zip"), tmp_path / "unpacked")
    assert find_source(place) == "colmap"
    first, again = (read_capture(folder, CONFIG) for folder in (tmp_path / "data", place))
    assert [shot.name for shot in first.shots] == [shot.name for shot in again.shots]
    assert [shot.data() for shot in first.shots] == [shot.data() for shot in again.shots]


def test_a_video_alone_and_photos_without_a_folder(tmp_path: Path) -> None:
    (tmp_path / "v").mkdir()
    video(tmp_path / "v")
    assert unpack_archive(pack(tmp_path / "v", tmp_path / "v.zip"), tmp_path / "one").name == "walk.mp4"
    pictures(tmp_path, ["0.png", "1.png"])
    members = [(name, (tmp_path / name).read_bytes()) for name in ("0.png", "1.png")]
    beside = [("__MACOSX/._0.png", b"x"), (".DS_Store", b"x")]
    place = unpack_archive(archive_of(tmp_path / "p.zip", *members, *beside), tmp_path / "two")
    assert sorted(path.name for path in place.iterdir()) == ["0.png", "1.png"]


def test_names_of_windows_programs_are_folders(tmp_path: Path) -> None:
    archive = archive_of(tmp_path / "a.zip", ("photos\\0.txt", b"a"), ("photos\\more\\1.txt", b"b"))
    place = unpack_archive(archive, tmp_path / "unpacked")
    assert sorted(path.relative_to(place).as_posix() for path in place.rglob("*.txt")) == ["0.txt", "more/1.txt"]


@pytest.mark.parametrize(
    "name", ["../out.png", "a/../../out.png", "/etc/out.png", "..\\out.png", "C:\\out.png", "a/..", "\\\\host\\out.png"]
)
def test_names_that_lead_out(tmp_path: Path, name: str) -> None:
    archive = archive_of(tmp_path / "a.zip", ("0.png", b"a"), (name, b"b"))
    assert "leads out of it" in refusal(archive, tmp_path)


def special(kind: int, target: bytes) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        info = zipfile.ZipInfo("0.png")
        info.create_system, info.external_attr = 3, (kind | 0o777) << 16
        return archive_of(path, (info, target))

    return make


def patched(pattern: bytes, offset: int, value: bytes) -> Callable[[Path], Path]:
    """An archive of which some bytes are others, counted from the last place where a pattern is."""

    def make(path: Path) -> Path:
        data = bytearray(archive_of(path, ("0.png", b"abc" * 1000)).read_bytes())
        place = data.rindex(pattern) + offset
        data[place : place + len(value)] = value
        path.write_bytes(bytes(data))
        return path

    return make


def twice(path: Path) -> Path:
    with pytest.warns(UserWarning, match="Duplicate"):
        return archive_of(path, ("a/0.png", b"a"), ("a/0.png", b"b"))


def truncated(path: Path) -> Path:
    path.write_bytes(archive_of(path, ("0.png", bytes(range(256)) * 50)).read_bytes()[:-30])
    return path


CENTRAL, LOCAL = b"PK\x01\x02", b"PK\x03\x04"
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "symbolic link": (special(0o120000, b"/etc/passwd"), "is a link"),
    "pipe": (special(0o010000, b""), "named pipe"),
    "device": (special(0o020000, b""), "character device"),
    "name twice": (twice, "is there twice"),
    "file as folder": (lambda path: archive_of(path, ("a", b"a"), ("a/b", b"b")), "is there twice"),
    "long name": (lambda path: archive_of(path, ("x" * 300, b"a")), "too long for a file name"),
    "encrypted": (patched(CENTRAL, 8, b"\x01\x00"), "is encrypted"),
    "odd method": (patched(CENTRAL, 10, b"\x09\x00"), "method that is not read"),
    "wrong checksum": (patched(CENTRAL, 16, b"\x00\x00\x00\x00"), "damaged or truncated"),
    "truncated": (truncated, "damaged or truncated"),
    "not where it says": (patched(CENTRAL, 42, b"\xff\xff\xff\x0f"), "damaged or truncated"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_no_capture_is_packed_as(tmp_path: Path, name: str) -> None:
    make, words = BAD[name]
    assert words in refusal(make(tmp_path / "a.zip"), tmp_path)


def test_bombs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "_NEVER_A_BOMB_BYTES", 1000)
    bomb = archive_of(tmp_path / "a.zip", ("0.png", bytes(10**6)))
    assert "MiB are allowed" in refusal(bomb, tmp_path)
    # The same, with a smaller size announced: what comes out is counted.
    data = bytearray(bomb.read_bytes())
    for start, offset in ((LOCAL, 22), (CENTRAL, 24)):
        place = data.rindex(start) + offset
        data[place : place + 4] = struct.pack("<I", 900)
    (tmp_path / "b.zip").write_bytes(bytes(data))
    refusal(tmp_path / "b.zip", tmp_path)
    monkeypatch.setattr(archives, "_MOST_MEMBERS", 3)
    assert "4 files" in refusal(archive_of(tmp_path / "c.zip", *((f"{k}", b"") for k in range(4))), tmp_path)
    monkeypatch.setattr(archives, "_MOST_DIRECTORY_BYTES", 100)
    assert "lists its files" in refusal(archive_of(tmp_path / "d.zip", *((f"{k}", b"") for k in range(3))), tmp_path)


def test_archives_within_stay_files(tmp_path: Path) -> None:
    inner = archive_of(tmp_path / "inner.zip", ("0.png", b"a")).read_bytes()
    place = unpack_archive(archive_of(tmp_path / "a.zip", ("inner.zip", inner)), tmp_path / "unpacked")
    with pytest.raises(UserError, match="holds no pictures, only: an archive"):
        read_capture(place, CONFIG)


@pytest.mark.parametrize("start", [b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07\x01\0", b"\x1f\x8b\x08\0", b"PK\x03\x04"])
def test_archives_given_where_none_is_unpacked_are_called_so(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "a").write_bytes(start + bytes(100))
    with pytest.raises(UserError, match="archive; unpack it"):
        find_source(tmp_path / "a")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_a_line_and_stays_inside(tmp_path: Path, data: st.DataObject) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("photos/0.txt", b"abc" * 50)
        archive.writestr("photos/1.txt", bytes(range(256)))
    content = bytearray(packed.getvalue())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path / str(len(list(tmp_path.iterdir())))
    (folder / "in").mkdir(parents=True)
    (folder / "a.zip").write_bytes(bytes(content))
    if is_archive(folder / "a.zip"):
        try:
            unpack_archive(folder / "a.zip", folder / "in" / "unpacked")
        except UserError:
            assert not list((folder / "in").iterdir())
    assert {path.name for path in folder.iterdir()} == {"in", "a.zip"}
