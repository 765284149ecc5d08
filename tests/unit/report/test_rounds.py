"""The heat map and the drift over rounds."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import RoundPage, ScenePage, StageRun
from sceneexpander.artifacts.proposals import Proposal, Proposals
from sceneexpander.report import SceneSource, collect_scene, write_page
from sceneexpander.report.rounds import drift_chart, rounds_shown
from tests.worlds.reports import row

NAMES = {"v0": "a.jpg", "v1": "b.jpg", "n1": "inserted view of round 1", "n2": "inserted view of round 2"}


def measured(**psnr: float | None) -> MetricsRow:
    views = tuple(
        ViewMetrics(
            view_id=name,
            generated=name.startswith("n"),
            posed=value is not None,
            values={("psnr_inserted_db" if name.startswith("n") else "psnr_captured_db"): value or 5.0},
        )
        for name, value in psnr.items()
    )
    return replace(row("sceneexpander", 20.0), views=views)


@pytest.fixture
def rounds(source: SceneSource, tmp_path: Path) -> list[RoundPage]:
    collect_scene(source, tmp_path / "room")
    page = ScenePage.load(tmp_path / "room").rounds[0]
    runs = {
        "adapt": StageRun(started=0, wall_s=2.0, peak_rss_mb=90),
        "render": StageRun(started=2, wall_s=3.0, peak_rss_mb=70),
    }
    return [replace(page, number=number, statistics=runs) for number in (1, 2)]


def test_drift_is_counted_from_when_a_view_was_new(rounds: list[RoundPage]) -> None:
    rows = [measured(v0=24.0, v1=29.0, n1=20.0), measured(v0=23.0, v1=30.0, n1=17.0, n2=22.0)]
    shown = rounds_shown(rounds, rows, measured(v0=25.0, v1=30.0), NAMES)
    assert shown is not None
    assert [label for label, _ in shown.columns] == list(NAMES.values())
    assert [[cell.drift_db for cell in item.cells] for item in shown.rows] == [
        [0.0, 0.0, None, None],
        [-1.0, -1.0, 0.0, None],
        [-2.0, 0.0, -3.0, 0.0],
    ]
    assert [item.drift for item in shown.rows] == ["", "-1.00 dB", "-1.67 dB"], "the round's own view is not older"
    assert [(item.time, item.memory) for item in shown.rows] == [("", ""), ("5 s", "90 MB"), ("5 s", "90 MB")]
    assert shown.rows[2].cells[2].lost
    assert shown.rows[2].cells[2].strength == 1.0
    assert "round 2: -1.67 dB" in shown.curve


def test_a_view_without_a_camera_has_no_number(rounds: list[RoundPage]) -> None:
    shown = rounds_shown(rounds[:1], [measured(v0=24.0, v1=None, n1=20.0)], measured(v0=24.0, v1=30.0), NAMES)
    assert shown is not None
    assert [cell.text for cell in shown.rows[1].cells] == ["24.0", "", "20.0"]
    assert shown.curve == "", "one round is no curve"
    assert rounds_shown(rounds, [None, None], None, NAMES) is None


def test_the_curve_stays_inside_its_frame() -> None:
    text = drift_chart([(1, -0.5), (2, 1.0), (4, -6.0)])
    places = [(float(x), float(y)) for x, y in re.findall(r'cx="([\d.-]+)" cy="([\d.-]+)"', text)]
    assert all(0 <= x <= 560 and 0 <= y <= 220 for x, y in places)
    (_, first), (_, second), (_, third) = places
    assert second < first < third, "higher is better"


def test_the_page_shows_proposals_with_their_pictures(source: SceneSource, tmp_path: Path) -> None:
    place = tmp_path / "proposals"
    for name in ("coverage.png", "preview_1.png"):
        place.mkdir(exist_ok=True)
        Image.new("RGB", (8, 6)).save(place / name)
    item = Proposal(motion="turn left 35 degrees", new=0.42, direction_deg=(-35.0, 0.0), preview="preview_1.png")
    Proposals(start="a.jpg", covered=0.25, map="coverage.png", proposals=(item,)).save(place)
    collect_scene(replace(source, rounds=[replace(source.rounds[0], proposals=place)]), tmp_path / "pages" / "room")
    (tmp_path / "out").mkdir()
    write_page([tmp_path / "pages" / "room"], tmp_path / "out")
    html = (tmp_path / "out" / "index.html").read_text()
    assert "25 % of all directions show something" in html
    assert "turn left 35 degrees" in html
    for name in re.findall(r'src="([^"]*proposals/[^"]*)"', html):
        assert (tmp_path / "out" / name).is_file()
    assert len(re.findall(r'src="[^"]*proposals/', html)) == 2
