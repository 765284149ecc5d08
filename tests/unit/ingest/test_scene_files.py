"""A scene folder may come from a stranger: what it names stays inside it, and only that is needed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.ingest import IngestConfig, list_pictures, load_scene, scene_files

pytestmark = pytest.mark.timeout(60)
CONFIG = IngestConfig(long_side_px=56)
DIGEST = "ab/cdef0123456789abcdef0123456789"  # as DVC splits it: two letters and thirty


def photo(path: Path, seed: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    Image.fromarray(coarse).resize((120, 80), Image.Resampling.BICUBIC).save(path, format="PNG")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "repository" / "scenes" / "mine"
    for seed in range(2):
        photo(folder / "captured" / f"{seed}.png", seed)
    photo(folder / "inserted" / "one.png", 7)
    photo(folder / "candidates" / "a.png", 8)
    photo(folder / "candidates" / "b.png", 9)
    photo(folder / "truth" / "depth" / "0.png", 3)
    (folder / "truth" / "cameras.json").write_text("{}")
    write(folder, "{prompt: A cat., inserted: inserted/one.png}", "{prompt: A dog., inserted: candidates}")
    (folder / "film.mov").write_bytes(b"not needed")
    (folder / "captured" / "notes.txt").write_text("not needed")
    (folder / "elsewhere").symlink_to("/")
    (folder / "loop").symlink_to(".")
    os.mkfifo(folder / "pipe")
    return folder


def write(folder: Path, *rounds: str, more: str = "") -> None:
    text = "rounds:\n" + "".join(f"  - {item}\n" for item in rounds) + more
    (folder / "scene.yaml").write_text(text, encoding="utf-8")


def refusal(folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        scene_files(folder)
    line = caught.value.line()
    assert "\n" not in line
    return line


def test_the_needed_files_and_no_others(folder: Path) -> None:
    assert [path.relative_to(folder).as_posix() for path in scene_files(folder)] == [
        "scene.yaml",
        "captured/0.png",
        "captured/1.png",
        "inserted/one.png",
        "candidates/a.png",
        "candidates/b.png",
        "truth/cameras.json",
        "truth/depth/0.png",
    ]


@pytest.mark.parametrize(
    "link", ["captured/z.png", "inserted/one.png", "candidates/c.png", "truth/t.png", "scene.yaml"]
)
def test_links_out_of_a_scene_are_refused(folder: Path, tmp_path: Path, link: str) -> None:
    secret = photo(tmp_path / "private.png", 20)
    if link == "scene.yaml":
        secret.write_text((folder / link).read_text())
    (folder / link).unlink(missing_ok=True)
    (folder / link).symlink_to(secret)
    assert "out of" in refusal(folder)


@pytest.mark.parametrize("name", ["captured", "candidates", "truth"])
def test_linked_folders_are_refused(folder: Path, tmp_path: Path, name: str) -> None:
    (folder / name).rename(tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    assert "out of" in refusal(folder)


@pytest.mark.parametrize(
    "target", [f".dvc/cache/files/md5/{DIGEST}", f".dvc/cache/{DIGEST}", f"../shared/files/md5/{DIGEST}"]
)
def test_links_into_the_cache_of_dvc_are_files(folder: Path, target: str) -> None:
    stored = photo(folder.parents[1] / target, 30)
    (folder / "captured" / "0.png").unlink()
    (folder / "captured" / "0.png").symlink_to(os.path.relpath(stored, folder / "captured"))
    assert folder / "captured" / "0.png" in scene_files(folder)
    assert len(load_scene(folder, CONFIG).views) == 2


def test_links_into_the_annex_of_the_same_repository_are_files(folder: Path, tmp_path: Path) -> None:
    (folder / "captured" / "0.png").unlink()
    for repository, good in ((folder.parents[1], True), (tmp_path / "another", False)):
        stored = photo(
            repository / ".git" / "annex" / "objects" / "Wx" / "q7" / "SHA256E-s1--ff.png" / "SHA256E-s1--ff.png", 31
        )
        (folder / "captured" / "0.png").unlink(missing_ok=True)
        (folder / "captured" / "0.png").symlink_to(stored)
        if good:
            assert len(load_scene(folder, CONFIG).views) == 2
        else:
            assert "out of" in refusal(folder)


@pytest.mark.parametrize(
    "name",
    [
        "../../../private.png",
        "sub/../../../../private.png",
        "'/etc/hostname'",
        "elsewhere/etc/hostname",
        '"a\\0b.png"',
        "x" * 5000,
    ],
)
def test_names_that_lead_out_or_nowhere(folder: Path, tmp_path: Path, name: str) -> None:
    photo(tmp_path / "private.png", 20)
    photo(folder / ".dvc" / "cache" / "files" / "md5" / DIGEST, 3)
    write(folder, f"prompt: A cat.\n    inserted: {name}")
    assert "scene.yaml" in refusal(folder)
    write(folder, "prompt: A cat.", more=f"images: {name}\n")
    assert "scene.yaml" in refusal(folder)


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("ONE.png", "did you mean 'one.png'"),
        ("one.PNG", "did you mean 'one.png'"),
        ("on.png", "did you mean 'one.png'"),
    ],
)
def test_near_names_are_offered(folder: Path, written: str, expected: str) -> None:
    write(folder, f"{{prompt: A cat., inserted: inserted/{written}}}")
    assert expected in refusal(folder)
    write(folder, "{prompt: A cat., inserted: 'inserted\\one.png'}")
    assert "did you mean 'inserted/one.png'" in refusal(folder)


@pytest.mark.parametrize("stored", ["Ku\u0308che.png", "K\u00fcche.png", "が.png", "か\u3099.png"])
@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_are_found_in_either_form_of_unicode(folder: Path, stored: str, form: str) -> None:
    import unicodedata

    photo(folder / "captured" / stored, 40)
    photo(folder / "inserted" / stored, 41)
    written = unicodedata.normalize(form, stored)
    write(folder, f"{{prompt: A cat., inserted: inserted/{written}}}", more=f"order: [{written}]\n")
    scene = load_scene(folder, CONFIG)
    assert scene.views.records[0].name == stored
    assert scene.rounds[0].inserted == f"inserted/{stored}"
    assert folder / "inserted" / stored in scene_files(folder)


@pytest.mark.parametrize("place", ["captured/p.png", "candidates/p.png", "truth/p.png", "inserted/one.png"])
@pytest.mark.parametrize("kind", ["fifo", "dangling", "loop"])
def test_needed_names_that_are_no_files(folder: Path, place: str, kind: str) -> None:
    path = folder / place
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to(path.name if kind == "loop" else "nowhere.png")
    assert path.name in refusal(folder)


@pytest.mark.parametrize("links", ["folder", "links"])
def test_a_folder_of_photos_may_hold_links(folder: Path, tmp_path: Path, links: str) -> None:
    plain = tmp_path / "photos"
    if links == "folder":
        plain.symlink_to(folder / "captured")
    else:
        plain.mkdir()
        for path in (folder / "captured").glob("*.png"):
            (plain / path.name).symlink_to(path)
    assert len(list_pictures(plain)) == 2


def test_names_that_are_not_valid_text(tmp_path: Path) -> None:
    photo(tmp_path / "a.png", 1)
    photo(Path(os.fsdecode(os.fsencode(tmp_path) + b"/z\xff\xfe.png")), 2)
    with pytest.raises(UserError, match="not valid text") as caught:
        list_pictures(tmp_path)
    assert "z\\xff\\xfe.png" in caught.value.line()
