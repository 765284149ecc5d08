"""The page from made-up artefacts: complete, offline, and safe with any text."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from sceneexpander.artifacts.held_out import HeldOut
from sceneexpander.artifacts.held_out_seen import HeldOutSeen
from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.metrics import Fit, MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import Refinement, ScenePage
from sceneexpander.artifacts.source_type import read_source_type
from sceneexpander.artifacts.store import ArtifactError, read_json, write_json_atomic
from sceneexpander.artifacts.views import save_png
from sceneexpander.report import RoundSource, SceneSource, collect_scene, write_page
from sceneexpander.report.course import fits
from sceneexpander.report.curve import Curve, curve_chart, objective_curves
from sceneexpander.report.words import number_tables
from sceneexpander.tracking import scene_runs
from tests.support.pages import Links
from tests.worlds.reports import (
    FITTING,
    HARM,
    METHODS,
    save_looks,
    view,
)


@pytest.fixture(scope="module")
def page(gathered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_page([gathered], folder)
    return folder / "index.html"


def test_every_file_it_names_is_there_and_none_is_remote(page: Path) -> None:
    links = Links()
    links.feed(page.read_text())
    assert len(links.found) > 20
    assert "media/room/round_1/viewer.html" in links.found
    for place in links.found:
        assert (page.parent / place).is_file(), place
    assert not re.search(r"(https?:)?//[a-z]", page.read_text().replace("http://www.w3.org", ""))


def test_text_from_users_stays_text(page: Path) -> None:
    html = page.read_text()
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html
    links = Links()
    links.feed(html)
    assert links.scripts == 1, "only the player's own"


def test_it_says_what_rows_and_columns_mean_and_what_went_wrong(page: Path) -> None:
    html = page.read_text()
    assert "SceneExpander on mini" in html
    assert "WorldMirror" not in html
    assert "ceiling" not in html, "fitted Gaussians show the photos better than the scene before the insertion"
    shown = [
        item
        for _, table in number_tables()
        for item in table
        if item.name in {"psnr_captured_db", "psnr_at_photo_size_db", "seen_through_at_photo_size", "psnr_inserted_db"}
    ]
    assert len(shown) == 4
    for item in shown:
        assert item.meaning.split(":")[0] in html
        assert f'>{item.heading}<span class="arrow">' in html
    assert "backbone: no camera could be estimated for v2" in html
    assert "is blurred" in html
    assert "not for resale" in html, "a method with weights of its own says whose they are"


def test_a_method_that_could_not_be_run_says_why_where_its_numbers_would_be(page: Path) -> None:
    rows = page.read_text().split("<tbody>")[1].split("</tbody>")[0].split("<tr ")
    (lacking,) = [row for row in rows if 'class="ttt3r"' in row]
    assert "needs the public checkpoint" in lacking
    assert not re.search(r">[\d.]+<", lacking), "no number"


def test_every_number_has_its_name_and_its_unit_for_narrow_screens(page: Path) -> None:
    table = page.read_text().split("<tbody>")[1].split("</tbody>")[0]
    cells = re.findall(r'data-label="([^"]*)"><span>([^<]*)(?:<span class="unit"> (\w+)</span>)?', table)
    assert ("PSNR \u2191", "21.00", "dB") in cells
    assert ("SSIM \u2191", "0.400", "") in cells


def test_bold_compares_methods_with_the_inserted_view(page: Path) -> None:
    table = page.read_text().split("<tbody>")[1].split("</tbody>")[0]
    bold = re.findall(r'<td class="best"[^>]*><span>([^<]+)<', table)
    assert "21.00" in bold
    assert "20.00" not in bold, "the scene before the insertion is no competitor"


def test_bold_and_names_tell_fitted_rows_from_others(gathered: Path, tmp_path: Path) -> None:
    """A method whose Gaussians were fitted wins nothing over one whose were not, and says what it is."""
    folder = tmp_path / "room"
    shutil.copytree(gathered, folder)
    for name, value, fit in (("backbone", 21.0, Fit.PREDICTED), ("sceneexpander", 27.0, Fit.FITTED)):
        path = folder / "round_1" / name / "metrics.json"
        one = MetricsRow.load(path)
        replace(one, values={**one.values, "psnr_captured_db": value}, fit=fit).save(path)
    (tmp_path / "report").mkdir()
    write_page([folder], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    table = html.split("<tbody>")[1].split("</tbody>")[0]
    assert ">27.00<" in table
    assert 'class="best"' not in table
    names = re.findall(r'<th scope="row">([^<]*)</th>', table)
    assert [name.endswith("+ fit") for name in names[:3]] == [False, False, True]
    runs = {run.tags["method"]: run for run in scene_runs(folder, commit="abc")}
    assert runs["sceneexpander"].name.startswith("room r1 sceneexpander + fit")
    assert "+ fit" not in runs["backbone"].name
    assert runs["sceneexpander"].params["gaussians"] == "fitted"
    assert runs["backbone"].params["gaussians"] == "as predicted"
    assert "+ fit." in runs["sceneexpander"].tags["mlflow.note.content"]


def looks_of(page: Path) -> list[str]:
    """One text per look."""
    return re.findall(r'<figure class="look">.*?</figure>', page.read_text(), re.DOTALL)


def test_looks_show_the_inserted_view_step_by_step_with_their_numbers(page: Path) -> None:
    cards = looks_of(page)
    assert [re.findall(r"<b>(.*?)</b>", card) for card in cards] == [["before the first step"], ["after step 40"]]
    for card, step in zip(cards, ("0000", "0040"), strict=True):
        assert re.findall(r'looks/([^"]+)"', card) == [f"inserted_{step}.jpg", f"depth_{step}.jpg"]
    found = [re.findall(r"<li><span>(.*?)</span> <span>(.*?)</span></li>", card) for card in cards]
    first, last = ({name: re.sub("<[^>]+>", "", text) for name, text in numbers} for numbers in found)
    assert (first["Captured PSNR"], last["Captured PSNR"]) == ("22.25 dB", "21.50 dB -0.75"), (
        "what was lost stands beside it"
    )
    assert (first["Inserted PSNR"], last["Inserted PSNR"]) == ("18.00 dB", "18.40 dB +0.40")
    assert (first["Captured depth moved"], last["Captured depth moved"]) == ("3.4 %", "3.4 %")
    assert (first["Weights moved"], last["Weights moved"]) == ("0.000", "2.000"), "the norm over both modules"


def test_harm_is_said_where_it_shows_and_with_the_rounds_warnings(page: Path) -> None:
    above, below = page.read_text().split("<h3>Before and after</h3>")
    sentence = f'<p class="warning">T{HARM[1:]}.</p>'
    assert sentence in above
    assert sentence in below


def test_the_verdict_on_the_inserted_view_is_a_sentence(page: Path) -> None:
    (sentence,) = re.findall(r"Before the adaptation, the inserted view[^<]*", page.read_text())
    for part in (
        "found to fit",
        "see 45 % of it",
        "depth differs from theirs by 0.6 %",
        "colours by 1.3 %",
        "0.03 degrees",
    ):
        assert part in sentence


def written(source: SceneSource, item: RoundSource, folder: Path) -> str:
    (folder / "room").mkdir()
    (folder / "report").mkdir()
    collect_scene(replace(source, rounds=[item]), folder / "room")
    write_page([folder / "room"], folder / "report")
    return (folder / "report" / "index.html").read_text()


def test_a_view_that_does_not_fit_is_a_warning(source: SceneSource, tmp_path: Path) -> None:
    state = tmp_path / "state"
    write_json_atomic(state / "log.json", [])
    refused = replace(FITTING, posed=False, depth_conflict=None, colour_conflict=None, reasons=("no camera was found",))
    write_json_atomic(state / "acceptance.json", refused)
    html = written(source, replace(source.rounds[0], log=state / "log.json"), tmp_path)
    above, below = html.split("<h3>Before and after</h3>")
    for part in (above, below):
        assert re.search(r'<p class="warning">The inserted view fits badly[^<]*: no camera was found\.', part)
    assert "found to fit" not in html


@pytest.mark.parametrize("saved", ["nothing", "no looks"])
def test_without_looks_the_page_is_silent_about_them(source: SceneSource, tmp_path: Path, saved: str) -> None:
    state = tmp_path / "state"
    write_json_atomic(state / "log.json", [{"loss": 1.0, "inserted": True}])
    if saved == "no looks":
        save_looks(state, [], [])
    methods = [replace(method, refinement=None) for method in source.rounds[0].methods]
    html = written(source, replace(source.rounds[0], log=state / "log.json", methods=methods), tmp_path)
    assert 'class="look' not in html
    assert "inserted view was found" not in html
    assert "Gaussians of" not in html
    assert "<h3>Adaptation" in html
    assert not (tmp_path / "room" / "round_1" / "looks").exists()


def test_a_fit_of_the_gaussians_says_what_it_changed(page: Path, gathered: Path) -> None:
    lines = re.findall(r"Gaussians of [^<]*", page.read_text())
    assert lines == ["Gaussians of Captured only: photometric loss 0.0820 to 0.0312 in 80 steps"], "the others had none"
    assert page.read_text().count("those of pictures it was fitted to") == 1
    (method, *_) = ScenePage.load(gathered).rounds[0].methods
    useless = replace(method, refinement=Refinement(steps=4, before=0.08, after=0.09))
    assert "kept as they were" in fits([useless])[0]


def test_gathering_repeats_bit_for_bit(source: SceneSource, gathered: Path, tmp_path: Path) -> None:
    collect_scene(source, tmp_path)
    for path in sorted(gathered.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / path.relative_to(gathered)).read_bytes(), path.name


def test_a_missing_video_is_named(source: SceneSource, tmp_path: Path) -> None:
    broken = replace(source.rounds[0], methods=[replace(source.rounds[0].methods[0], renders=tmp_path / "no")])
    with pytest.raises(ArtifactError, match="does not exist"):
        collect_scene(replace(source, rounds=[broken]), tmp_path / "out")


def test_runs_to_track_come_from_the_same_folder(gathered: Path, tmp_path: Path) -> None:
    ply = tmp_path / "gaussians.ply"
    ply.write_bytes(b"ply")
    runs = {run.tags["method"]: run for run in scene_runs(gathered, commit="abc", extra=lambda number, method: [ply])}
    lacking = runs.pop("ttt3r")
    assert not lacking.metrics
    assert lacking.tags["unavailable"] == "needs the public checkpoint"
    assert set(runs) == set(METHODS)
    assert len({run.key for run in (*runs.values(), lacking)}) == 4
    adapted = runs["sceneexpander"]
    assert adapted.curves["5_look/captured_psnr"] == [(0, 22.25), (40, 21.5)]
    assert len([place for place in adapted.artefacts if place.startswith("looks/")]) == 6
    assert adapted.curves["4_loss/loss_without_inserted"] == [(1, 2.0), (3, 2.0 / 3)]
    assert adapted.curves["4_loss/loss_with_inserted"] == [(2, 1.0)]
    assert adapted.curves["4_loss/gen_depth"] == [(2, 0.5)], "zero is no loss where there is nothing to lose"
    assert not runs["backbone"].curves
    assert adapted.metrics["1_quality/psnr_captured_db"] == 22.0
    assert "PSNR **21.00 dB**; Inserted PSNR **10.00 dB**." in adapted.tags["mlflow.note.content"]
    assert "is blurred" in adapted.tags["mlflow.note.content"]
    assert adapted.params["adapt.steps"] == "3"
    assert adapted.tags["reconstructor"] == "mini"
    assert (adapted.started_ms, adapted.duration_ms) == (1_700_000_000_000, 2000)
    for run in runs.values():
        for place, path in run.artefacts.items():
            assert path.is_file(), place
            assert place.rpartition("/")[2] == path.name
    assert scene_runs(gathered, commit="other")[0].key == scene_runs(gathered, commit="abc")[0].key


@pytest.fixture
def with_held_out(source: SceneSource, tmp_path: Path) -> SceneSource:
    """A held-out photo that has a camera in the scene of two methods and none in that of the third."""
    photo = view("v-held")
    HeldOut(views=photo).save(tmp_path / "photos")
    methods = []
    for item in source.rounds[0].methods:
        if item.name == "ttt3r":
            methods.append(item)
            continue
        posed = item.name != "captured"
        place = tmp_path / item.name
        place.mkdir()
        save_png(place / "v-held.png", photo.images[0] * (0.5 if item.name == "backbone" else 0.9))
        HeldOutSeen(pictures={"v-held": "v-held.png"} if posed else {}).save(place)
        measured = ViewMetrics(
            view_id="v-held", generated=False, posed=posed, values={"psnr_held_out_db": 17.125} if posed else {}
        )
        replace(MetricsRow.load(item.metrics), held_out=(measured,)).save(tmp_path / f"{item.name}.json")
        methods.append(replace(item, held_out=place, metrics=tmp_path / f"{item.name}.json"))
    return replace(source, held_out=tmp_path / "photos", rounds=[replace(source.rounds[0], methods=methods)])


def test_a_held_out_photo_stands_beside_what_each_scene_shows_from_there(
    with_held_out: SceneSource, tmp_path: Path
) -> None:
    collect_scene(with_held_out, tmp_path / "pages" / "room")
    write_page([tmp_path / "pages" / "room"], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    links = Links()
    links.feed(html)
    assert all((tmp_path / "report" / place).is_file() for place in links.found)
    shown = html[html.index("Held-out photos, beside") : html.index("Every view, rendered")]
    assert "v-held.jpg" in shown
    assert shown.count("17.12 dB") == 2
    assert shown.count("no camera in its scene") == 1
    assert shown.count("<img") == 3
    runs = {run.tags["method"]: run for run in scene_runs(tmp_path / "pages" / "room", commit="abc")}
    names = {name for name in runs["backbone"].pictures if "held-out" in name}
    assert len(names) == 2
    for name in names:
        (step, path), *_ = runs["backbone"].pictures[name]
        assert step == 0
        assert path.is_file()
    assert not any("held-out" in name for name in runs["captured"].pictures)


def test_without_held_out_photos_the_page_is_silent_about_them(page: Path) -> None:
    assert "Held-out photos, beside" not in page.read_text()


def test_facts_hold_no_absolute_path(gathered: Path) -> None:
    text = (gathered / "page.json").read_text()
    assert str(gathered.parent) not in text
    assert read_json(gathered / "page.json")["rounds"][0]["backend"] == "replay"


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("trainedAlgorithmicMedia", "AI-generated picture: new.png"),
        ("compositeSynthetic", "Picture rendered from the scene itself, with parts that nobody captured: new.png"),
        (None, "Picture: new.png"),
    ],
)
def test_the_page_and_the_picture_say_how_it_came_to_be(
    kind: str | None, words: str, source: SceneSource, tmp_path: Path
) -> None:
    place = source.rounds[0].inserted
    inserted = InsertedView.load(place)
    (provenance,) = inserted.provenance
    replace(inserted, provenance=(replace(provenance, digital_source_type=kind),)).save(tmp_path / "inserted")
    collect_scene(
        replace(source, rounds=[replace(source.rounds[0], inserted=tmp_path / "inserted")]), tmp_path / "pages" / "room"
    )
    with Image.open(tmp_path / "pages" / "room" / "round_1" / "inserted.jpg") as picture:
        assert read_source_type(picture.info.get("xmp", b"").decode()) == kind
    write_page([tmp_path / "pages" / "room"], tmp_path / "report")
    assert words in (tmp_path / "report" / "index.html").read_text()


@pytest.mark.parametrize(
    ("inserted", "wanted"),
    [
        ([True, False, True, False], {"with": [1, 3], "without": [2, 4]}),
        ([True] * 4, {"with": [1, 2, 3, 4]}),
        ([False] * 4, {"without": [1, 2, 3, 4]}),
        ([True, False, True, True], {"with": [1, 4], "without": [2]}),
    ],
)
def test_steps_with_and_without_the_inserted_view_are_curves_of_their_own(
    inserted: list[bool], wanted: dict[str, list[int]]
) -> None:
    lost = float("nan") if inserted == [True, False, True, True] else 3.0
    curves = objective_curves(inserted, [1.0, 2.0, lost, 4.0])
    assert {curve.name: [step for step, _ in curve.points] for curve in curves} == wanted
    chart = curve_chart(curves, 4)
    assert chart.count("<polyline") == len(wanted)
    assert chart.count("<circle") == sum(len(steps) for steps in wanted.values())


def test_the_page_names_both_curves(page: Path) -> None:
    assert re.findall(r'<span class="key (\w+)">', page.read_text()) == ["with", "without"]


def test_curves_share_their_axes() -> None:
    high = Curve(name="with", title="", points=((1, 10.0), (3, 10.0)))
    low = Curve(name="without", title="", points=((2, 5.0), (4, 5.0)))
    both = curve_chart([high, low], 4)
    heights = [float(y) for y in re.findall(r'cy="([\d.]+)"', both)]
    assert heights[0] == heights[1] < heights[2] == heights[3]


def test_a_curve_of_nothing_is_nothing() -> None:
    assert objective_curves([], []) == []
    assert objective_curves([True], [float("nan")]) == []
    assert curve_chart([], 3) == ""
    assert "polyline" in curve_chart(objective_curves([True, True], [1.0, 1.0]), 2)
