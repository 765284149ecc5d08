"""Several scenes are a site: an index of scenes, rounds and methods, a page per scene, and nothing that is not there."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest
from PIL import Image

from sceneexpander.artifacts.page import ScenePage
from sceneexpander.report import SceneSource, collect_scene, write_page
from sceneexpander.report.media import SIDE_PX
from sceneexpander.report.site import FULL_SCENES
from tests.support.browser import browser_page
from tests.support.pages import NARROW, SCROLLING, STICKING_OUT, WIDE, Links

MANY = tuple(f"scene_{number}" for number in range(FULL_SCENES + 1))


@pytest.fixture(scope="module")
def pages(source: SceneSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Gathered scenes of different names; the first one's pictures are larger than a site of many shows them."""
    folder = tmp_path_factory.mktemp("pages")
    first = folder / MANY[0]
    collect_scene(source, first)
    for name in MANY:
        if name != MANY[0]:
            shutil.copytree(first, folder / name)
        page = replace(ScenePage.load(folder / name), scene=name)
        if name == MANY[1]:
            page = replace(page, rounds=(*page.rounds, replace(page.rounds[0], number=2)))
        page.save(folder / name)
    Image.new("RGB", (1000, 500), "red").save(first / "round_1" / "inserted.jpg", xmp=b"who made it")
    return folder


def site(pages: Path, names: Sequence[str], folder: Path, **more: Sequence[str]) -> Path:
    write_page([pages / name for name in names], folder, **more)
    return folder


def require_links(folder: Path) -> None:
    for page in folder.rglob("*.html"):
        if page.name == "viewer.html":
            continue
        links = Links()
        links.feed(page.read_text())
        for place in {unquote(link).partition("#")[0] for link in links.found}:
            assert not place.startswith(("/", "http")), place
            assert (page.parent / place).is_file(), f"{page.name}: {place}"


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_one_scene_is_one_page(pages: Path, tmp_path: Path) -> None:
    site(pages, MANY[:1], tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").glob("**/*.html")].count("index.html") == 1
    assert not (tmp_path / "out" / "scenes").exists()
    require_links(tmp_path / "out")
    assert "all scenes" not in (tmp_path / "out" / "index.html").read_text()


def test_several_scenes_have_a_page_each_and_an_index_of_all(pages: Path, tmp_path: Path) -> None:
    out = site(pages, MANY[:2], tmp_path / "out", missing=["lost"])
    require_links(out)
    index = (out / "index.html").read_text()
    assert "lost" in index
    for name in MANY[:2]:
        assert f'href="scenes/{name}.html"' in index
        page = (out / "scenes" / f"{name}.html").read_text()
        assert 'href="../index.html"' in page
        assert 'id="round-1"' in page
        assert f"../media/{name}/round_1/viewer.html" in page
    assert f'href="scenes/{MANY[1]}.html#round-2"' in index
    assert f"{MANY[0]}.html#round" not in index, "one round is no timeline"
    assert 'href="#round-2"' in (out / "scenes" / f"{MANY[1]}.html").read_text()
    methods, *matrices = re.findall(r"<table.*?</table>", index, re.DOTALL)
    assert "SceneExpander on mini" in methods
    assert "21.00" in methods, "22 dB for both scenes at the stored size are 21 at their own"
    for matrix in matrices:
        assert [re.search(rf'"row">{name}<', matrix) is not None for name in MANY[:2]] == [True, True]


def test_a_single_scene_that_is_left_is_not_taken_for_all(pages: Path, tmp_path: Path) -> None:
    out = site(pages, MANY[:1], tmp_path / "out", missing=["lost"])
    assert "lost" in (out / "index.html").read_text()
    assert (out / "scenes" / f"{MANY[0]}.html").is_file()


def test_many_scenes_show_reduced_pictures_and_say_so(pages: Path, tmp_path: Path) -> None:
    full = site(pages, MANY[:1], tmp_path / "full")
    many = site(pages, MANY, tmp_path / "many")
    require_links(many)
    assert not list(many.rglob("viewer.html"))
    assert not list(many.rglob("*.png"))
    with Image.open(many / "media" / MANY[0] / "round_1" / "inserted.jpg") as picture:
        assert max(picture.size) == SIDE_PX
        assert picture.info["xmp"] == b"who made it"
    page = (many / "scenes" / f"{MANY[0]}.html").read_text()
    assert f"sceneexpander view outputs/{MANY[0]} --round 1" in page
    assert 'data-layer="depth"' not in page, "no button for what is not there"
    assert 'data-layer="provenance"' in page
    assert size(many / "media") / len(MANY) < size(full / "media") / 2


def test_a_page_copies_only_what_it_shows(pages: Path, tmp_path: Path) -> None:
    out = site(pages, MANY[:1], tmp_path / "out")
    links = Links()
    links.feed((out / "index.html").read_text())
    shown = {(out / link).resolve() for link in links.found}
    assert {path.resolve() for path in (out / "media").rglob("*") if path.is_file()} <= shown


@pytest.mark.parametrize("width", [NARROW, WIDE])
def test_the_index_needs_no_sideways_scrolling(width: int, pages: Path, tmp_path: Path) -> None:
    out = site(pages, MANY, tmp_path / "out")
    with browser_page(tmp_path / "profile") as tab:
        tab.open(f"file://{out / 'index.html'}", width, 900)
        tab.wait("document.readyState === 'complete' && location.protocol === 'file:'")
        assert tab.value("document.documentElement.scrollWidth <= innerWidth"), tab.value(STICKING_OUT)
        assert tab.value(STICKING_OUT) == []
        assert tab.value(SCROLLING) == []
        assert tab.messages == []
        assert tab.value("[...document.images].filter(e => e.loading !== 'lazy').every(e => e.naturalWidth > 0)")
