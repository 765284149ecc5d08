"""params.yaml: what cannot run is one line before anything starts."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml

from sceneexpander.catalogue import METHODS
from sceneexpander.errors import UserError
from sceneexpander.pipeline.selection import RESERVED, Selection, check_name, read_selection
from stages import layout

ROOT = Path(__file__).parents[3]
GOOD = {
    "scenes": "[courtyard]",
    "rounds": "[{k: 1, prev: 0}]",
    "methods": "[captured, backbone, sceneexpander]",
    "overrides": "[]",
}


def written(folder: Path, **changed: str) -> Path:
    (folder / "params.yaml").write_text("".join(f"{key}: {value}\n" for key, value in (GOOD | changed).items()))
    return folder


def test_the_committed_selection_is_one() -> None:
    assert read_selection(ROOT).scenes == ("courtyard",)


@pytest.mark.parametrize(
    ("rounds", "previous"),
    [("[{k: 1, prev: 0}, {k: 2, prev: 1}]", ()), ("[{k: 1, prev: 0}, {k: 2, prev: 0}]", (0, 0))],
)
def test_a_selection_comes_back_as_it_was_written(tmp_path: Path, rounds: str, previous: tuple[int, ...]) -> None:
    selection = read_selection(written(tmp_path, rounds=rounds))
    assert (selection.rounds, selection.previous) == (2, previous)
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "params.yaml").write_text(selection.to_yaml())
    assert read_selection(tmp_path / "again") == selection


def test_a_round_may_say_itself_how_its_picture_is_obtained(tmp_path: Path) -> None:
    text = "[{k: 1, prev: 0}, {k: 2, prev: 1, overrides: [generator=reproject, choose.candidate=2]}]"
    selection = read_selection(written(tmp_path, rounds=text))
    assert selection.overrides_of(1) == ()
    assert selection.overrides_of(2) == ("generator=reproject", "choose.candidate=2")
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "params.yaml").write_text(selection.to_yaml())
    assert read_selection(tmp_path / "again") == selection


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(
            ("rounds", value)
            for value in (
                "[]",
                "{}",
                "1",
                "null",
                "[1]",
                "[{k: 1}]",
                "[{prev: 0}]",
                "[{k: 1, prev: 0, x: 1}]",
                "[{k: 1, prev: 0, overrides: 1}]",
                "[{k: 1, prev: 0, overrides: [1]}]",
                "[{k: 1, prev: 0, overrides: [adapt.steps=5]}]",
                "[{k: 2, prev: 1}]",
                "[{k: 1, prev: 1}]",
                "[{k: 1, prev: -1}]",
                "[{k: 1, prev: 5}]",
                "[{k: 0, prev: 0}]",
                "[{k: -1, prev: 0}]",
                "[{k: 1.0, prev: 0}]",
                "[{k: 1.5, prev: 0}]",
                "[{k: true, prev: 0}]",
                "[{k: 1, prev: false}]",
                "[{k: '1; touch x', prev: 0}]",
                "[{k: '1', prev: 0}]",
                "[{k: 1, prev: 0}, {k: 1, prev: 0}]",
                "[{k: 1, prev: 0}, {k: 3, prev: 1}]",
            )
        ),
        *(
            ("scenes", value)
            for value in (
                "[]",
                "courtyard",
                "{a: b}",
                "[courtyard, courtyard]",
                "[courtyard/]",
                "[./courtyard]",
                "[../x]",
                "[../scenes/courtyard]",
                "[/etc]",
                "['']",
                "[.]",
                "[..]",
                "[.hidden]",
                "[-x]",
                "['a b']",
                "['$(touch x)']",
                '["a\\nb"]',
                "[{a: b}]",
                "[7]",
                "[null]",
                "[[courtyard]]",
                f"[{'a' * 5000}]",
                "[pages]",
                "[Report]",
                "[code.json]",
            )
        ),
        *(
            ("methods", value)
            for value in ("[]", "captured", "[captured, captured]", "[capured]", "[{a: b}]", "[ttt3r_optimised]", "[1]")
        ),
        *(("overrides", value) for value in ("null", "{a: 1}", "adapt.steps=5", "[5]", "[[a]]")),
        ("more", "1"),
    ],
)
def test_what_cannot_run_is_one_line(tmp_path: Path, key: str, value: str) -> None:
    with pytest.raises(UserError) as caught:
        read_selection(written(tmp_path, **{key: value}))
    assert "params.yaml" in caught.value.line()
    assert len(caught.value.line()) < 400
    assert "\n" not in caught.value.line()


@pytest.mark.parametrize("key", list(GOOD))
def test_a_missing_or_repeated_key_is_one_line(tmp_path: Path, key: str) -> None:
    text = "".join(f"{name}: {value}\n" for name, value in GOOD.items() if name != key)
    for content in (text, f"{text}{key}: {GOOD[key]}\n{key}: {GOOD[key]}\n"):
        (tmp_path / "params.yaml").write_text(content)
        with pytest.raises(UserError, match=key):
            read_selection(tmp_path)


@pytest.mark.parametrize(
    "data",
    [
        b"scenes: [\xff\xfe]",
        "scenes: [a]".encode("utf-16"),
        b"scenes: " + b"[" * 20_000,
        b"",
        b"- a",
        b"\0",
        b"a: &a [*a]",
    ],
    ids=["not UTF-8", "UTF-16", "deep", "empty", "list", "NUL", "circle"],
)
def test_bytes_that_are_no_selection_are_one_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "params.yaml").write_bytes(data)
    with pytest.raises(UserError, match=r"params\.yaml"):
        read_selection(tmp_path)


def test_a_pipe_does_not_hold_it_up(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "params.yaml")
    with pytest.raises(UserError, match="pipe"):
        read_selection(tmp_path)


def test_names_of_the_pipelines_own_results_are_those_of_the_layout() -> None:
    assert {
        path.name for path in (layout.PAGES, layout.REPORT, layout.CODE, layout.ENVIRONMENT, layout.GIVEN)
    } == RESERVED
    outs = {
        place.split("/")[1]
        for stage in yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"].values()
        for out in (*stage.get("outs", []), *stage.get("metrics", []))
        for place in [out if isinstance(out, str) else next(iter(out))]
        if place.startswith("outputs/") and "${" not in place.split("/")[1]
    }
    assert outs == RESERVED


def test_names_in_commands_are_quoted() -> None:
    for name, stage in yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"].items():
        assert stage["cmd"].count("${") == stage["cmd"].count("'${"), name


@pytest.mark.parametrize("name", ["terrace", "a.b-c_d", "7", "x" * 100])
def test_plain_names_are_taken(name: str) -> None:
    check_name(name, where="--name", fix="")


def test_a_selection_of_all_methods_is_valid(tmp_path: Path) -> None:
    selection = Selection(scenes=("a",), rounds=1, methods=tuple(method.name for method in METHODS))
    (tmp_path / "params.yaml").write_text(selection.to_yaml())
    assert read_selection(tmp_path) == selection
