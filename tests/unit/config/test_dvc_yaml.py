"""dvc.yaml says what the stages do: parameters are the declared sections, and paths are the layout's."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml

from sceneexpander.catalogue import METHODS, Kind, Method
from sceneexpander.catalogue.methods import CORRECTED, methods_of
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.inference.config import RivalsConfig
from sceneexpander.pipeline.packages import LOCKS
from stages import layout
from stages.fingerprint import stage_names

ROOT = Path(__file__).parents[3]
PIPELINE: dict[str, Any] = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
CONFIG = "outputs/${item.scene}/config.json"
ROUND_SETTINGS = "outputs/${item.scene}/rounds.json"
# resolve makes the configuration; the gathering stages get it through the artefacts of the scenes.
WITHOUT_SECTIONS = {"code", "resolve", "collect", "report", "track"}
SECTIONS_OF = {"correct": "adapt"}  # which it imports only if it is asked for


def tracked(stage: str, file: str) -> list[str]:
    for entry in PIPELINE[stage].get("params", []):
        if isinstance(entry, dict) and file in entry:
            return list(entry[file])
    return []


def paths(stage: str, kind: str) -> list[str]:
    return [next(iter(item)) if isinstance(item, dict) else item for item in PIPELINE[stage].get(kind, [])]


def test_every_stage_file_is_a_stage_and_the_other_way_round() -> None:
    assert set(PIPELINE) == {*stage_names(ROOT / "stages"), "code"}


@pytest.mark.parametrize("stage", sorted(set(PIPELINE) - {"code"}))
def test_a_stage_depends_on_its_own_code(stage: str) -> None:
    assert tracked(stage, "outputs/code.json") == [stage]


@pytest.mark.parametrize("stage", sorted(set(PIPELINE) - WITHOUT_SECTIONS))
def test_parameters_are_the_sections_that_the_stage_reads(stage: str) -> None:
    module = importlib.import_module(f"stages.{SECTIONS_OF.get(stage, stage)}")
    # A key below a section: the part of it that belongs to the stage's method.
    assert [key.partition(".")[0] for key in tracked(stage, CONFIG)] == [f.name for f in fields(module.Sections)]
    of_round = fields(module.RoundSections) if hasattr(module, "RoundSections") else ()
    assert [filled(key) for key in tracked(stage, ROUND_SETTINGS)] == [
        f"{layout.round_key(2)}.{f.name}" for f in of_round
    ]


def filled(path: str) -> str:
    for field, value in (("scene", "S"), ("round.k", "2"), ("round.prev", "1"), ("method", "backbone")):
        path = path.replace("${item." + field + "}", value)
    return path


@pytest.mark.parametrize(
    ("stage", "written"),
    [
        ("code", [layout.CODE, layout.ENVIRONMENT]),
        (
            "resolve",
            [
                layout.config("S"),
                layout.round_settings("S"),
                layout.selection("S"),
                *(
                    layout.given("S", kind)
                    for kind in ("generator", "choice", "judge", "lpips", "model", *methods_of(Kind.RIVAL))
                ),
            ],
        ),
        (
            "prepare",
            [
                layout.prepared("S"),
                layout.asked("S", 1).parent,
                layout.held_out("S"),
                layout.truth("S"),
                layout.statistics("prepare", "S"),
            ],
        ),
        ("reconstruct", [layout.state("S", 0), layout.match_memory("S"), layout.statistics("reconstruct", "S")]),
        ("match_held_out", [layout.matched_held_out("S"), layout.statistics("match_held_out", "S")]),
        ("generate_view", [layout.candidates("S", 2), layout.statistics("generate_view", "S", 2)]),
        ("choose_view", [layout.inserted("S", 2), layout.statistics("choose_view", "S", 2)]),
        (
            "precompute_anchors",
            [
                layout.anchors("S", 2),
                layout.reconstruction("S", 2, "captured").parent,
                layout.statistics("precompute_anchors", "S", 2),
            ],
        ),
        (
            "reconstruct_inserted",
            [
                layout.reconstruction("S", 2, "backbone").parent,
                layout.joint_priors("S", 2),
                layout.statistics("reconstruct_inserted", "S", 2),
            ],
        ),
        ("propose", [layout.proposals("S", 2), layout.statistics("propose", "S", 2)]),
        ("adapt", [layout.state("S", 2), layout.statistics("adapt", "S", 2)]),
        (
            "correct",
            [
                layout.reconstruction("S", 2, CORRECTED).parent,
                layout.statistics("correct", "S", 2, CORRECTED),
            ],
        ),
        (
            "rival",
            [layout.reconstruction("S", 2, "backbone").parent, layout.statistics("rival", "S", 2, "backbone")],
        ),
        (
            "gaussian_splatting",
            [
                layout.reconstruction("S", 2, "gaussian_splatting").parent,
                layout.statistics("gaussian_splatting", "S", 2, "gaussian_splatting"),
            ],
        ),
        (
            "optimise",
            [
                layout.reconstruction("S", 2, "backbone_optimised").parent,
                layout.statistics("optimise", "S", 2, "backbone_optimised"),
            ],
        ),
        ("render", [layout.renders("S", 2, "backbone"), layout.statistics("render", "S", 2, "backbone")]),
        ("pack", [layout.packed("S", 2, "backbone"), layout.statistics("pack", "S", 2, "backbone")]),
        (
            "evaluate",
            [
                layout.metrics("S", 2, "backbone"),
                layout.held_out_seen("S", 2, "backbone"),
                layout.statistics("evaluate", "S", 2, "backbone"),
            ],
        ),
        ("judge", [layout.judged("S", 2), layout.statistics("judge", "S", 2)]),
        ("collect", [layout.PAGES / "S"]),
        ("report", [layout.REPORT, Path("results/metrics.json")]),
    ],
)
def test_outputs_are_where_the_layout_says(stage: str, written: list[Path]) -> None:
    declared = {filled(path) for path in paths(stage, "outs") + paths(stage, "metrics")}
    assert declared == {path.as_posix() for path in written}


def test_held_out_photos_lead_to_nothing_but_what_is_measured_on_them() -> None:
    def readers(path: Path) -> set[str]:
        """Stages that depend on what is there, or on a folder around it."""
        around = {path.as_posix(), *(parent.as_posix() for parent in path.parents)}
        return {stage for stage in PIPELINE if {filled(dep) for dep in paths(stage, "deps")} & around}

    gathers = {"collect"}  # names its files one by one
    assert readers(layout.held_out("S")) - gathers == {"match_held_out"}
    assert readers(layout.matched_held_out("S")) - gathers == {"evaluate"}
    assert not {layout.held_out("S"), layout.matched_held_out("S")} & set(layout.prepared("S").parents)


def test_nothing_persists_but_what_belongs_to_this_machine() -> None:
    persistent = {
        filled(path)
        for content in PIPELINE.values()
        for item in content.get("outs", [])
        if isinstance(item, dict)
        for path, options in item.items()
        if options.get("persist")
    }
    given = {
        layout.given("S", kind).as_posix()
        for kind in ("generator", "choice", "judge", "lpips", "model", *methods_of(Kind.RIVAL))
    }
    # Never restored from the cache of runs (another machine's environment), never copied into it (links to the user's files).
    assert persistent == {"mlflow/tracked.json", layout.CODE.as_posix(), layout.ENVIRONMENT.as_posix()} | given


def test_code_depends_on_the_locks() -> None:
    assert set(paths("code", "deps")) == {"src", "stages", *LOCKS}


def test_selected_methods_exist() -> None:
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    assert set(params["methods"]) <= {method.name for method in METHODS}
    assert [item["prev"] for item in params["rounds"]] == [item["k"] - 1 for item in params["rounds"]]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_every_method_of_the_catalogue_is_made_by_its_stage(method: Method) -> None:
    """A stage that makes several has them in its matrix: what it runs on is part of the name where it optimises another's result."""
    assert method.stage in PIPELINE
    made = [filled(path) for path in paths(method.stage, "outs")]
    axis = PIPELINE[method.stage]["matrix"].get("method")
    if axis is not None:
        of_stage = [other for other in METHODS if other.stage == method.stage]
        ends = {"rival": [other.name for other in of_stage], "optimise": [other.starts_from for other in of_stage]}
        assert set(axis) == set(ends[method.stage])
    else:
        assert {f"outputs/S/round_2/{method.name}"} <= set(made)


def test_methods_that_can_be_left_out_are_parameters_of_their_stages() -> None:
    for method in METHODS:
        named = tracked(method.stage, "outputs/${item.scene}/methods.json")
        assert bool(named) is not method.always_made, method.name


def test_reconstructors_of_others_have_a_section_of_the_configuration() -> None:
    assert {f.name for f in fields(RivalsConfig)} == {method.name for method in METHODS if method.needs_weights}


def test_no_setting_has_a_name_that_the_cache_ignores() -> None:
    """DVC compares outputs and parameters without keys of its own bookkeeping."""

    def keys(schema: Any) -> Iterator[str]:
        for name, hint in get_type_hints(schema).items():
            yield name
            if is_dataclass(hint):
                yield from keys(hint)

    found = set(keys(ProjectConfig))
    assert {"steps", "long_side_px"} <= found
    assert not found & {"size", "nfiles"}
