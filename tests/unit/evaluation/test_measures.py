"""The doors: a metric and a method from outside the package are in every row, table, page and run."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.store import read_json
from sceneexpander.catalogue import Group, Kind, Method, Metric, Scope, Shown, Views, methods, metrics
from sceneexpander.evaluation import comparison_table
from sceneexpander.evaluation import evaluate as module
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate, register_measure
from sceneexpander.evaluation.measure import Measure, SeenView, Subject, Values
from sceneexpander.pipeline.selection import Selection, read_selection
from sceneexpander.report import write_page
from sceneexpander.tracking import scene_runs
from tests.worlds.reports import gathered, source  # noqa: F401 - fixtures
from tests.worlds.wall import made_reconstruction, own_pictures

BRIGHTNESS = Metric(
    name="brightness_captured",
    group=Group.QUALITY,
    title="Brightness",
    scope=Scope(views=Views.CAPTURED),
    meaning="How bright the renders are.",
    digits=3,
    better="higher",
    shown=Shown.PAGE,
)
DENSITY = Metric(
    name="gaussians_per_view",
    group=Group.COUNT,
    title="Gaussians per view",
    scope=Scope(views=Views.NONE),
    digits=1,
)


class Toy(Measure):
    """One number of every photo, one of the whole."""

    metrics: tuple[Metric, ...] = (BRIGHTNESS, DENSITY)

    def of_view(self, view: SeenView) -> Values:
        return {} if view.generated else {BRIGHTNESS.name: float(view.render.rgb.mean())}

    def of_scene(self, subject: Subject) -> Values:
        scene = subject.reconstruction
        return {DENSITY.name: len(scene.gaussians) / len(scene.view_ids)}


@pytest.fixture(autouse=True)
def _own_registries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "_known", dict(metrics._known))
    monkeypatch.setattr(methods, "_known", dict(methods._known))
    monkeypatch.setattr(module, "MEASURES", list(module.MEASURES))


def evaluated() -> MetricsRow:
    scene = made_reconstruction()
    return evaluate(scene, own_pictures(scene), EvaluateConfig(st_lpips=False), scene="made", round_number=1, seed=0)


def test_a_metric_from_outside_is_in_rows_tables_the_page_and_runs(
    gathered: Path,  # noqa: F811 - the fixture
    tmp_path: Path,
) -> None:
    before = evaluated()
    register_measure(Toy())
    row = evaluated()
    assert {name: value for name, value in row.values.items() if name in before.values} == before.values
    seen = [view.values[BRIGHTNESS.name] for view in row.views if not view.generated]
    assert row.value(BRIGHTNESS.name) == pytest.approx(sum(seen) / len(seen))

    row.save(tmp_path / "metrics.json")
    assert read_json(tmp_path / "metrics.json")["values"][BRIGHTNESS.name] == row.values[BRIGHTNESS.name]
    assert row.numbers()[DENSITY.name] == row.values["gaussians"] / 3
    table = comparison_table([row])
    for text in (table.markdown(), table.csv(), table.latex()):
        assert "Brightness" in text
        assert f"{row.values[BRIGHTNESS.name]:.3f}" in text
        assert "Gaussians per view" not in text, "it is tracked only"

    folder = tmp_path / "room"
    shutil.copytree(gathered, folder)
    path = folder / "round_1" / "backbone" / "metrics.json"
    known = MetricsRow.load(path)
    values = {name: row.values[name] for name in (BRIGHTNESS.name, DENSITY.name)}
    replace(known, values={**known.values, **values}).save(path)
    (tmp_path / "report").mkdir()
    write_page([folder], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    assert '>Brightness<span class="arrow">' in html
    assert "How bright the renders are." in html
    assert f"<span>{row.values[BRIGHTNESS.name]:.3f}</span>" in html
    (run,) = [run for run in scene_runs(folder, commit="abc") if run.tags["method"] == "backbone"]
    assert run.metrics["1_quality/brightness_captured"] == pytest.approx(row.values[BRIGHTNESS.name], rel=1e-5)
    assert run.metrics["8_count/gaussians_per_view"] == pytest.approx(row.values[DENSITY.name], rel=1e-5)


def test_a_measure_answers_only_with_what_it_declares() -> None:
    class Other(Toy):
        metrics = (DENSITY,)

    register_measure(Other())
    with pytest.raises(ValueError, match="'brightness_captured', which is none of its metrics"):
        evaluated()


def test_a_metric_is_measured_once() -> None:
    register_measure(Toy())
    with pytest.raises(ValueError, match="Toy answers with 'brightness_captured' already"):
        register_measure(Toy())


def test_numbers_of_captured_and_of_inserted_views_are_not_mixed_up() -> None:
    class Mixed(Toy):
        def of_view(self, view: SeenView) -> Values:
            return {BRIGHTNESS.name: 1.0}

    register_measure(Mixed())
    with pytest.raises(ValueError, match="not a metric of inserted views"):
        evaluated()


def test_a_mean_over_fewer_views_is_no_mean() -> None:
    class Gappy(Toy):
        def of_view(self, view: SeenView) -> Values:
            return {BRIGHTNESS.name: 1.0 if view.index == 0 else None} if not view.generated else {}

    register_measure(Gappy())
    row = evaluated()
    assert BRIGHTNESS.name in row.views[0].values
    assert row.value(BRIGHTNESS.name) is None


def test_a_method_from_outside_is_selected_and_named_everywhere(
    gathered: Path,  # noqa: F811 - the fixture
    tmp_path: Path,
) -> None:
    toy = Method(
        name="toy",
        kind=Kind.RIVAL,
        stage="play",
        title="Toy on {model}",
        short="for children",
        meaning="{model}, played with.",
    )
    methods.register_method(toy)
    selection = Selection(scenes=("a",), rounds=1, methods=("captured", "toy"))
    (tmp_path / "params.yaml").write_text(selection.to_yaml())
    assert read_selection(tmp_path) == selection
    table = comparison_table([replace(evaluated(), method="toy"), replace(evaluated(), method="captured")])
    assert [line[0] for line in table.lines] == ["Captured only", "Toy on made"]

    folder = tmp_path / "room"
    shutil.copytree(gathered, folder)
    text = (folder / "page.json").read_text().replace('"backbone"', '"toy"').replace('"adapt":', '"play":')
    (folder / "page.json").write_text(text)
    (tmp_path / "report").mkdir()
    write_page([folder], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    assert "Toy on mini" in html
    assert "mini, played with." in html
    (run,) = [run for run in scene_runs(folder, commit="abc") if run.tags["method"] == "toy"]
    assert "Toy on mini." in run.tags["mlflow.note.content"]
    assert run.metrics["7_cost/time_play_s"] == 2.0
