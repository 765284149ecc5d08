"""Whatever a name leads to, it is read to its end or refused in one line; it never hangs and never fills the memory."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from sceneexpander.errors import UserError, printable
from sceneexpander.plainfiles import list_folder, read_plain_file, require_folder, require_plain_file

pytestmark = pytest.mark.timeout(20)


def _link_to_itself(root: Path) -> Path:
    (root / "a").symlink_to(root / "b")
    (root / "b").symlink_to(root / "a")
    return root / "a"


def _dangling(root: Path) -> Path:
    (root / "d").symlink_to("nowhere")
    return root / "d"


def _fifo(root: Path) -> Path:
    os.mkfifo(root / "f")
    return root / "f"


def _link_to_fifo(root: Path) -> Path:
    (root / "l").symlink_to(_fifo(root))
    return root / "l"


def _socket(root: Path) -> Path:
    here = os.getcwd()
    os.chdir(root)  # the name of a socket may not be long
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("s")
    os.chdir(here)
    return root / "s"


UNREADABLE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "fifo": (_fifo, "named pipe"),
    "link to a fifo": (_link_to_fifo, "named pipe"),
    "socket": (_socket, "a socket"),
    "endless device": (lambda _: Path("/dev/zero"), "character device"),
    "empty device": (lambda _: Path("/dev/null"), "character device"),
    "folder": (lambda root: root, "is a folder"),
    "link to itself": (_link_to_itself, "leads back to itself"),
    "dangling link": (_dangling, "a link to nowhere, which does not exist"),
    "missing": (lambda root: root / "m", "does not exist"),
    "below a file": (lambda root: _plain(root) / "x", "does not exist"),
    "long name": (lambda root: root / ("x" * 300), "too long"),
    "long path": (lambda root: root / "/".join(["y" * 100] * 60), "too long"),
    "NUL": (lambda root: root / "a\0b", "cannot be the name"),
    "surrogate": (lambda root: root / "a\ud800b", "cannot be the name"),
}


def _plain(root: Path) -> Path:
    (root / "plain").write_bytes(b"0123456789")
    return root / "plain"


@pytest.mark.parametrize("case", UNREADABLE)
def test_what_is_no_plain_file_is_one_line(tmp_path: Path, case: str) -> None:
    make, expected = UNREADABLE[case]
    path = make(tmp_path)
    for refuse in (lambda: read_plain_file(path, limit_bytes=100), lambda: require_plain_file(path)):
        with pytest.raises(UserError, match=expected) as caught:
            refuse()
        line = caught.value.line()
        assert "\n" not in line
        assert len(line) < 600
        line.encode()  # can be printed


def test_plain_files_are_read_through_links_and_not_beyond_the_limit(tmp_path: Path) -> None:
    plain = _plain(tmp_path)
    (tmp_path / "link").symlink_to(plain)
    assert read_plain_file(tmp_path / "link", limit_bytes=10) == b"0123456789"
    with pytest.raises(UserError, match="larger than"):
        read_plain_file(plain, limit_bytes=9)
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(UserError, match="larger than the 1 MiB"):
        read_plain_file(tmp_path / "sparse", limit_bytes=2**20)


def test_a_pipe_that_takes_the_place_of_a_file_does_not_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fifo = _fifo(tmp_path)
    monkeypatch.setattr("sceneexpander.plainfiles.require_plain_file", lambda *_, **__: None)
    with pytest.raises(UserError, match="named pipe"):
        read_plain_file(fifo, limit_bytes=10)


def test_no_permission_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(UserError, match=r"cannot be read \(Permission denied\)"):
        read_plain_file(_plain(tmp_path), limit_bytes=10)


@pytest.mark.parametrize("case", [name for name in UNREADABLE if name != "folder"])
def test_what_is_no_folder_is_one_line(tmp_path: Path, case: str) -> None:
    path = UNREADABLE[case][0](tmp_path)
    for refuse in (require_folder, list_folder):
        with pytest.raises(UserError) as caught:
            refuse(path)
        assert "\n" not in caught.value.line()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a\nb.jpg", "a\\nb.jpg"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\r\t\x07\x9b", "a\\r\\t\\x07\\x9b"),
        (os.fsdecode(b"z\xff\xfe.png"), "z\\xff\\xfe.png"),
        ("a\ud800b", "a\\ud800b"),
        ("gpj.\u202ea", "gpj.\\u202ea"),
        ("Küche 写真 😀 a\\b.jpg", "Küche 写真 😀 a\\b.jpg"),
    ],
)
def test_names_are_shown_without_what_a_terminal_would_obey(text: str, expected: str) -> None:
    assert printable(text) == expected
    line = UserError("is odd", where=text, fix=f"rename {text}").line()
    assert line.startswith(f"{expected}: is odd; rename ")
    assert line.isprintable()
