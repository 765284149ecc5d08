"""The configuration that ships: every option composes, validates, and says exactly what it claims."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from sceneexpander.adaptation.config import AdaptConfig, Realign
from sceneexpander.config.compose import FORBIDDEN_KEYS, compose, refuse_forbidden_keys, scene_option
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig

CONF = Path(__file__).parents[3] / "conf"
NEEDED = {"model=worldmirror": ["model.weights=x.safetensors"], "generator=file": ["generator.file=x.png"]}
NEEDED |= {"tracking=server": ["tracking.uri=http://127.0.0.1:5000"]}
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
OPTIONS = sorted(f"{group}={path.stem}" for group in GROUPS for path in (CONF / group).glob("*.yaml"))
ABLATIONS = sorted(path.stem for path in (CONF / "ablation").glob("*.yaml"))
TABLE_ROWS = {"baseline", "anchor", "subset_aug", "self_distill", "self_distill_p1", "full"}


@cache
def composed(*overrides: str) -> dict[str, Any]:
    return compose(CONF, overrides)


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def typed(values: dict[str, Any]) -> ProjectConfig:
    return parse_dataclass(ProjectConfig, values)


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_composes_and_validates(option: str) -> None:
    values = composed(option, *NEEDED.get(option, []))
    assert set(values) == {f.name for f in fields(ProjectConfig)}
    assert typed(values)


def test_no_key_has_a_name_that_the_cache_would_ignore() -> None:
    seen = 0
    for option in OPTIONS:
        for key, _ in leaves(composed(option, *NEEDED.get(option, []))):
            assert not FORBIDDEN_KEYS & set(key.split(".")), f"{option}: {key}"
            seen += 1
    assert seen > 100 * len(OPTIONS)
    params = yaml.safe_load((CONF.parent / "params.yaml").read_text())
    assert not FORBIDDEN_KEYS & set(params)
    with pytest.raises(ConfigError, match=r"adapt\.deep\.size"):
        refuse_forbidden_keys({"adapt": {"deep": {"size": 1}}})


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_changes_exactly_the_keys_it_names(ablation: str) -> None:
    default, changed = dict(leaves(composed())), dict(leaves(composed(f"ablation={ablation}")))
    different = {key for key in default.keys() | changed.keys() if default.get(key) != changed.get(key)}
    named = yaml.safe_load((CONF / "ablation" / f"{ablation}.yaml").read_text()) or {}
    assert different == {key for key, _ in leaves(named)}
    assert bool(different) == (ablation != "none")


def test_ablations_are_different_experiments() -> None:
    seen: dict[str, str] = {}
    for ablation in ABLATIONS:
        if ablation == "none":
            continue
        content = repr(sorted(leaves(composed(f"ablation={ablation}"))))
        assert content not in seen, f"{ablation} is the same as {seen[content]}"
        seen[content] = ablation


def test_the_rows_of_the_papers_table_add_one_component_each() -> None:
    assert set(ABLATIONS) >= TABLE_ROWS
    rows = {name: typed(composed(f"ablation={name}")).adapt for name in TABLE_ROWS}
    assert rows["baseline"].steps == 0
    assert rows["anchor"].lambda_gen == 0
    assert not rows["anchor"].augment.enabled
    assert rows["anchor"].subset == "all"
    assert rows["subset_aug"].augment.enabled
    assert rows["subset_aug"].subset == "paper"
    assert rows["subset_aug"].lambda_gen == 0
    assert rows["self_distill"].lambda_gen > 0
    assert rows["self_distill"].insertion_probability == 0.5
    assert rows["self_distill"].restore_interval == 0
    assert rows["self_distill_p1"].insertion_probability == 1
    assert rows["full"].restore_interval > 0
    # The default of the embedded model is the last row and four things beyond the paper.
    assert (
        replace(rows["full"], realign=Realign.CHOOSE, tone=True, trust=True, close_gaps=0.7) == typed(composed()).adapt
    )
    for row in rows.values():
        assert (row.realign, row.splat_steps, row.inserted_weights) == ("none", 0, "uniform")
        assert not row.tone
        assert not row.trust
        assert row.close_gaps == 0


def test_the_controls_take_away_what_they_say() -> None:
    full = typed(composed()).adapt
    without = typed(composed("ablation=control_no_insertion")).adapt
    assert (without.insertion_probability, without.lambda_gen) == (0, 0)
    assert without.steps == full.steps > 0
    assert typed(composed("ablation=control_no_anchor")).adapt.lambda_anchor == 0 < full.lambda_anchor
    only = typed(composed("ablation=control_no_adaptation")).adapt
    assert replace(only, steps=full.steps) == full
    assert only.steps == 0


def test_the_gpu_profile_with_worldmirror_has_the_papers_values() -> None:
    config = typed(composed("profile=gpu", "model=worldmirror", "model.weights=x.safetensors"))
    paper = AdaptConfig()  # its defaults are the paper's, and are tested as such where they live
    assert config.adapt == paper
    assert (paper.steps, paper.learning_rate, paper.insertion_probability) == (400, 1e-5, 0.5)
    assert config.device == "cuda"
    assert config.warmup.steps == 0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("adapt.stepz=5", "adapt.stepz: unknown key; did you mean 'adapt.steps'?"),
        ("ablation=ancor", "ablation: has no option 'ancor'; did you mean 'anchor'?"),
        ("adpt=default", "adpt: unknown key; did you mean 'adapt'?"),
        ("adapt.steps=many", "adapt.steps: is 'many' (str), expected a whole number"),
        ("adapt.steps=-1", "adapt: adapt.steps must be >= 0, is -1"),
        ("+adapt.extra=1", "adapt.extra: unknown key"),
        ("scene.fit=stretch", "scene.fit: is 'stretch'; known: crop, pad"),
        ("render.path=obrit", "render.path: is 'obrit'; did you mean 'orbit'?"),
        ("render.path=keyframes", "render.keyframes: path keyframes needs at least two, has 0"),
        (
            "render.keyframes=[{eye: [0, 0, 0], targt: [0, 0, 1]}]",
            "render.keyframes[0].targt: unknown key; did you mean",
        ),
        ("render.keyframes=[{view: 3}]", "render.keyframes[0].view: is 3 (int), expected text"),
        ("device=tpu", "device: is 'tpu'; use cpu, cuda or cuda:N"),
        ("model=worldmirror", "model.weights: has no value; set it in conf/ or as an override"),
    ],
)
def test_a_typo_is_one_line_with_a_suggestion(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(CONF, [override])
    assert caught.value.line().startswith(message)


def test_key_frames_come_from_an_override_or_from_a_file_of_ones_own(tmp_path: Path) -> None:
    keys = "[{view: photo_1}, {eye: [0.5, 0, -1], target: [0, 0, 4]}]"
    given = typed(composed("render.path=keyframes", f"render.keyframes={keys}")).render
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    text = f"defaults: [default, _self_]\npath: keyframes\nkeyframes: {keys}\n"
    (conf / "render" / "flight.yaml").write_text(text)
    assert typed(compose(conf, ["render=flight"])).render == given
    assert [type(key).__name__ for key in given.keyframes] == ["ViewKey", "EyeKey"]


def test_a_scene_without_a_file_of_its_own_takes_the_default() -> None:
    assert scene_option(CONF, "no_such_scene") == "default"
    assert scene_option(CONF, "default") == "default"
