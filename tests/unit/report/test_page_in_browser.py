"""The page in a real browser at the widths of a laptop and of a phone: nothing is reached by scrolling sideways."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from sceneexpander.artifacts.metrics import ViewMetrics
from sceneexpander.artifacts.proposals import Proposal, Proposals
from sceneexpander.catalogue import MAIN
from sceneexpander.report import SceneSource, collect_scene, write_page
from tests.support.browser import Page, browser_page
from tests.support.pages import NARROW, SCROLLING, STICKING_OUT, WIDE
from tests.worlds.reports import row
from tests.worlds.reports_with_cameras import with_cameras

VIEWS = ("a_photo_with_quite_a_long_name", "v0", "v1", "v2")


def with_rounds(source: SceneSource, folder: Path) -> SceneSource:
    """Three rounds of the same view, measured, with proposals after the last."""
    rounds = []
    for number in (1, 2, 3):
        views = tuple(
            ViewMetrics(
                view_id=view,
                generated=view == "v2",
                posed=True,
                values={"psnr_inserted_db" if view == "v2" else "psnr_captured_db": 25.0 - number},
            )
            for view in VIEWS
        )
        metrics = folder / f"metrics_{number}.json"
        replace(row(MAIN, 20.0), views=views).save(metrics)
        methods = [replace(item, metrics=metrics) if item.name == MAIN else item for item in source.rounds[0].methods]
        rounds.append(replace(source.rounds[0], number=number, methods=methods))
    place = folder / "proposals"
    place.mkdir()
    for name in ("coverage.png", "preview.png"):
        Image.new("RGB", (64, 32)).save(place / name)
    motions = [
        Proposal(motion="turn left 50 degrees", new=0.4, direction_deg=direction, preview="preview.png")
        for direction in ((-178.0, 89.0), (178.0, -89.0), (0.0, 0.0))
    ]
    Proposals(start="v0.jpg", covered=0.2, map="coverage.png", proposals=tuple(motions)).save(place)
    return replace(source, rounds=[*rounds[:2], replace(rounds[2], proposals=place)])


@pytest.fixture(scope="module")
def html(source: SceneSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown")
    (folder / "room").mkdir()
    collect_scene(with_rounds(with_cameras(source, folder), folder), folder / "room")
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


def test_rounds_and_proposals_are_shown(tab: Page, html: Path) -> None:
    tab.open(f"file://{html}", NARROW, 900)
    tab.wait("document.readyState === 'complete' && location.protocol === 'file:'")
    rows = (
        "[...document.querySelectorAll('table.heat tbody tr')].map(e => e.innerText.split(/\\s+/).slice(-5).join(' '))"
    )
    assert tab.value(rows) == ["24.0 23.0 -1.0 22.0 -2.0"] * len(VIEWS)
    assert tab.value("[...document.querySelectorAll('table.heat td')].every(e => e.scrollWidth <= e.clientWidth + 1)")
    inside = """[...document.querySelectorAll('.panorama span')].map(e => {
      const mark = e.getBoundingClientRect(), map = e.parentElement.getBoundingClientRect();
      return [(mark.left + mark.width / 2 - map.left) / map.width, (mark.top + mark.height / 2 - map.top) / map.height];
    })"""
    found = [tuple(round(part, 2) for part in place) for place in tab.value(inside)]
    assert found == [(0.01, 0.01), (0.99, 0.99), (0.5, 0.5)], "directions lie where the map has them"
