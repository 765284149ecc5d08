"""`sceneexpander expand` as users run it: a folder of photos, a round more, a round less."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.worlds.project import SMOKE, Project

pytestmark = pytest.mark.pipeline


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """A project in which nothing has run."""
    project = Project(tmp_path_factory.mktemp("expand") / "project")
    yield project
    shutil.rmtree(project.folder, ignore_errors=True)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{tmp}/nowhere", "--prompt", "x"], "nowhere: does not exist"),
        (["{scene}/captured", "--prompt", "A bench."], "--inserted: round 1 has no picture"),
        (["{scene}/captured", "--inserted", "{scene}/inserted/round_1.png"], "has no prompt"),
        (["{scene}", "--prompt", "A bench."], "says itself what to add"),
        (["{scene}", "adapt.stepz=3"], "did you mean 'adapt.steps'?"),
        (["{scene}", "profile=smoke", "model.weights={tmp}/none.safetensors"], "none.safetensors"),
    ],
)
def test_expand_refuses_before_it_runs_anything(
    project: Project, tmp_path: Path, arguments: list[str], said: str
) -> None:
    filled = [item.format(tmp=tmp_path, scene=project.folder / "scenes" / "room") for item in arguments]
    done = project.run("-m", "sceneexpander.cli.expand", *filled, check=False)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
    assert done.stderr.strip().count("\n") == 0, "one line"
    assert not (project.folder / "runs").exists()


ROWS = ("captured", "sceneexpander")


@pytest.fixture(scope="module")
def mine(project: Project) -> tuple[Path, str]:
    """A run of two photos and a picture, and what was printed; the stages themselves are covered above, so the smallest budget will do."""
    scene = project.folder / "scenes" / "room"
    photos = project.folder / "photos"
    photos.mkdir()
    for index in (0, 2):
        shutil.copyfile(scene / "captured" / f"photo_{index}.png", photos / f"photo_{index}.png")
    arguments = ["--inserted", str(scene / "inserted" / "round_1.png"), "--prompt", 'A "wall", further on.']
    arguments += ["--name", "mine", *SMOKE, "adapt.steps=1", "warmup.steps=0", "render.frames=4"]
    params = project.folder / "params.yaml"
    before = params.read_text()
    params.write_text(yaml.safe_dump(yaml.safe_load(before) | {"methods": [*ROWS]}))
    try:
        done = project.run("-m", "sceneexpander.cli.expand", str(photos), *arguments)
    finally:
        params.write_text(before)
    assert project.runs() == len(ROWS), "runs of a workspace are tracked in the project"
    return project.folder / "runs" / "mine", done.stdout


def test_expand_runs_a_folder_of_photos(mine: tuple[Path, str]) -> None:
    run, printed = mine
    page = run / "outputs" / "report" / "index.html"
    assert printed.strip().endswith(f"report: {page}")
    assert "A &#34;wall&#34;, further on." in page.read_text()


def test_a_round_is_added_and_taken_back(project: Project, mine: tuple[Path, str]) -> None:
    """Only what is new runs, an earlier round keeps every bit, and going back is restored."""
    run, _ = mine

    def grow(*arguments: str) -> tuple[set[str], str]:
        done = project.run("-m", "sceneexpander.cli.expand", "--continue", "mine", *arguments)
        return set(re.findall(r"Running stage '([^']+)'", done.stdout)), done.stdout

    def content(folder: Path) -> dict[str, bytes]:
        return {str(path.relative_to(run)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}

    page = run / "outputs" / "pages" / "mine"
    first, shown = content(run / "outputs" / "mine" / "round_1"), content(page)
    executed, _ = grow("--generator", "reproject", "--motion", "turn left 10 degrees")
    looks_at_all_rounds = {"resolve@mine", "prepare@mine", "collect@mine", "report", "track"}
    assert looks_at_all_rounds < executed
    assert all("round1" in name for name in executed - looks_at_all_rounds), executed
    assert content(run / "outputs" / "mine" / "round_1") == first
    row = json.loads((run / "outputs" / "mine" / "round_2" / "metrics" / "sceneexpander.json").read_text())
    assert {"psnr_earlier_inserted_db", "psnr_worst_earlier_db"} <= row["values"].keys()
    html = (run / "outputs" / "report" / "index.html").read_text()
    assert "Drift of every region" in html
    assert "Where the camera could go next" in html

    proposed = project.run("-m", "sceneexpander.cli.expand", "--continue", "mine", "--propose").stdout
    assert all(Path(place).is_file() for place in re.findall(r": (/.*\.png)", proposed))
    undone, _ = grow("--undo")
    assert undone == {"resolve@mine", "track"}, "the rest comes from the cache"
    assert content(run / "outputs" / "mine" / "round_1") == first
    assert content(page) == shown
    assert not (run / "outputs" / "mine" / "round_2").exists()
