"""The page in a real browser at the widths of a laptop and of a phone: nothing is reached by scrolling sideways."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sceneexpander.report import SceneSource, collect_scene, write_page
from tests.support.browser import Page, browser_page
from tests.support.pages import NARROW, SCROLLING, STICKING_OUT, WIDE
from tests.worlds.reports_with_cameras import with_cameras


@pytest.fixture(scope="module")
def html(source: SceneSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown")
    (folder / "room").mkdir()
    collect_scene(with_cameras(source, folder), folder / "room")
    write_page([folder / "room"], folder / "report")
    return folder / "report" / "index.html"


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser_page(tmp_path_factory.mktemp("browser") / "profile") as page:
        yield page


@pytest.mark.parametrize("width", [NARROW, 700, WIDE])
def test_no_width_needs_sideways_scrolling(tab: Page, html: Path, width: int) -> None:
    tab.open(f"file://{html}", width, 900)
    tab.wait("document.readyState === 'complete' && location.protocol === 'file:'")
    tab.value("document.querySelectorAll('details').forEach(e => { e.open = true; })")
    assert tab.value("document.documentElement.scrollWidth <= innerWidth"), tab.value(STICKING_OUT)
    assert tab.value(STICKING_OUT) == []
    assert tab.value(SCROLLING) == []
    assert tab.value(
        "[...document.querySelectorAll('table.numbers td')].every(e => e.scrollWidth <= e.clientWidth + 1)"
    )


@pytest.mark.parametrize(("width", "shown"), [(NARROW, True), (WIDE, False)])
def test_a_narrow_screen_has_units_and_names_beside_the_numbers(tab: Page, html: Path, width: int, shown: bool) -> None:
    tab.open(f"file://{html}", width, 900)
    tab.wait("document.readyState === 'complete' && location.protocol === 'file:'")
    cell = "document.querySelector('table.numbers td')"
    assert (tab.value(f"getComputedStyle({cell}.querySelector('.unit')).display") != "none") is shown
    assert ("PSNR" in tab.value(f"getComputedStyle({cell}, '::before').content")) is shown
    heading = tab.value("getComputedStyle(document.querySelector('table.numbers thead')).display")
    assert (heading == "none") is shown
