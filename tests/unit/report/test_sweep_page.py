"""The page of a sweep: one line per job, what it gains over the first, and links that stay inside the folder."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.report import SceneSource, collect_scene
from sceneexpander.report.sweep import SweptJob, write_sweep_page
from tests.support.pages import Links

JOBS = (
    SweptJob(label="ablation=baseline", folder="0"),
    SweptJob(label="ablation=<paper>", folder="1"),
    SweptJob(label="seed=2", folder="2", error="was killed"),
)


def test_jobs_stand_side_by_side(source: SceneSource, tmp_path: Path) -> None:
    collect_scene(source, tmp_path / "0" / "pages" / "room")
    shutil.copytree(tmp_path / "0", tmp_path / "1")
    place = tmp_path / "1" / "pages" / "room" / "round_1" / "sceneexpander" / "metrics.json"
    row = MetricsRow.load(place)
    replace(row, values={**row.values, "psnr_at_photo_size_db": 19.5}).save(place)
    for job in "01":
        (tmp_path / job / "report").mkdir()
        (tmp_path / job / "report" / "index.html").touch()
    page = write_sweep_page(JOBS, tmp_path, pages="pages", report="report")
    html = page.read_text()
    links = Links()
    links.feed(html)
    assert {"0/report/index.html", "1/report/index.html"} <= set(links.found)
    for place_name in links.found:
        assert (page.parent / place_name).is_file(), place_name
    table = html.split("<tbody>")[1].split("</tbody>")[0]
    lines = [re.sub(r"<[^>]+>", " ", line).split() for line in table.split("</tr>")]
    assert lines[0][:2] == ["ablation=baseline", "21.00"]
    assert lines[1][:3] == ["ablation=&lt;paper&gt;", "19.50", "(-1.50)"]
    assert "seed=2: was killed" in html
    assert "seed=2" not in table
