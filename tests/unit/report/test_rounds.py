"""The heat map and the drift over rounds."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import RoundPage, ScenePage, StageRun
from sceneexpander.artifacts.proposals import Proposal, Proposals
from sceneexpander.report import SceneSource, collect_scene, write_page
from sceneexpander.report.rounds import DriftLine, drift_chart, rounds_shown
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
    return [replace(page, number=number, inserted_id=f"n{number}", statistics=runs) for number in (1, 2)]


def test_drift_is_counted_from_when_a_view_was_new(rounds: list[RoundPage]) -> None:
    rows = [measured(v0=24.0, v1=29.0, n1=20.0), measured(v0=23.0, v1=30.0, n1=17.0, n2=22.0)]
    shown = rounds_shown(rounds, rows, measured(v0=25.0, v1=30.0), NAMES)
    assert shown is not None
    assert [(item.name, item.generated) for item in shown.rows] == [
        (name, key[0] == "n") for key, name in NAMES.items()
    ]
    assert [[cell.drift_db for cell in item.cells] for item in shown.rows] == [
        [0.0, -1.0, -2.0],
        [0.0, -1.0, 0.0],
        [None, 0.0, -3.0],
        [None, None, 0.0],
    ]
    assert [item.label for item in shown.columns] == ["before", "round 1", "round 2"]
    assert [item.drift for item in shown.columns] == ["", "-1.00", "-1.67"], "the round's own view is not older"
    assert [(item.time, item.memory) for item in shown.columns] == [("", ""), ("5", "90"), ("5", "90")]
    assert shown.rows[2].cells[2].lost
    assert shown.rows[2].cells[2].strength == 1.0
    titles = re.findall(r"<title>([^<]*)</title>", shown.curve)
    assert [text for text in titles if "round 2" in text] == [
        "photos, round 2: -1.00 dB",
        "inserted 1, round 2: -3.00 dB",
        "inserted 2, round 2: +0.00 dB",
    ], "every region has its own line"


def test_a_view_without_a_camera_has_no_number(rounds: list[RoundPage]) -> None:
    shown = rounds_shown(rounds[:1], [measured(v0=24.0, v1=None, n1=20.0)], measured(v0=24.0, v1=30.0), NAMES)
    assert shown is not None
    assert [item.cells[1].text for item in shown.rows] == ["24.0", "", "20.0"]
    assert shown.curve == "", "one round is no curve"
    assert rounds_shown(rounds, [None, None], None, NAMES) is None


def test_the_curve_stays_inside_its_frame_and_its_labels_apart() -> None:
    drifts = {"photos": (-0.5, 1.0, -6.0), "inserted 1": (0.0, -0.1, -5.9), "inserted 2": (0.0, 0.0, -6.0)}
    lines = [DriftLine(label=k, generated=k != "photos", points=tuple(enumerate(v))) for k, v in drifts.items()]
    text = drift_chart(lines)
    places = [(float(x), float(y)) for x, y in re.findall(r'cx="([\d.-]+)" cy="([\d.-]+)"', text)]
    assert all(0 <= x <= 560 and 0 <= y <= 240 for x, y in places)
    (_, first), (_, second), (_, third) = places[:3]
    assert second < first < third, "higher is better"
    labels = {name: float(re.search(rf'y="([\d.]+)">{name}<', text)[1]) for name in drifts}  # type: ignore[index]
    heights = sorted(labels.values())
    assert heights[-1] <= 240
    assert min(b - a for a, b in itertools.pairwise(heights)) >= 14
    assert labels["inserted 1"] == heights[0], "in the order of their lines"


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
