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

from sceneexpander.adaptation.config import AdaptConfig, Spend
from sceneexpander.config.compose import (
    _RENAMED,
    _RENAMED_OPTIONS,
    FORBIDDEN_KEYS,
    compose,
    known_keys,
    options_of,
    refuse_forbidden_keys,
    scene_option,
)
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.insertion.config import CorrectionsConfig

CONF = Path(__file__).parents[3] / "conf"
NEEDED = {"model=worldmirror": ["model.weights=x.safetensors"], "generator=file": ["generator.file=x.png"]}
NEEDED |= {"generator=comfyui": ["generator.workflow=x.json"], "generator=diffusers": ["generator.model=x/y"]}
NEEDED |= {"tracking=server": ["tracking.uri=http://127.0.0.1:5000"]}
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
OPTIONS = sorted(f"{group}={path.stem}" for group in GROUPS for path in (CONF / group).glob("*.yaml"))
ABLATIONS = sorted(path.stem for path in (CONF / "ablation").glob("*.yaml"))
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
TABLE_ROWS = {"baseline", "anchor", "subset_aug", "self_distill", "self_distill_p1", "paper"}


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
    keys = [key for key, _ in leaves(values)]
    assert len(keys) > 100
    assert not {key for key in keys if FORBIDDEN_KEYS & set(key.split("."))}, "the cache would ignore it"


def test_no_key_has_a_name_that_the_cache_would_ignore() -> None:
    params = yaml.safe_load((CONF.parent / "params.yaml").read_text())
    assert not FORBIDDEN_KEYS & set(params)
    with pytest.raises(ConfigError, match=r"adapt\.deep\.size"):
        refuse_forbidden_keys({"adapt": {"deep": {"size": 1}}})


def named_by(ablation: str) -> set[str]:
    """The keys that an overlay names, with those of the overlays that it starts from."""
    content = yaml.safe_load((CONF / "ablation" / f"{ablation}.yaml").read_text()) or {}
    below = [name for name in content.pop("defaults", []) if name != "_self_"]
    return {key for key, _ in leaves(content)}.union(*(named_by(name) for name in below))


def changed_by(*overrides: str, ablation: str) -> set[str]:
    default, changed = dict(leaves(composed(*overrides))), dict(leaves(composed(*overrides, f"ablation={ablation}")))
    return {key for key in default.keys() | changed.keys() if default.get(key) != changed.get(key)}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_changes_exactly_the_keys_it_names(ablation: str, model: str) -> None:
    option = f"model={model}"
    different = changed_by(option, *NEEDED.get(option, []), ablation=ablation)
    assert different == named_by(ablation)
    assert bool(different) == (ablation != "default")


@pytest.mark.parametrize("ablation", sorted(set(ABLATIONS) - {"default"}))
def test_of_the_papers_method_an_ablation_changes_what_it_names_or_is_refused(ablation: str) -> None:
    beyond = ablation.startswith("no_") and not {key for key in named_by(ablation) if key.startswith("adapt.")}
    if beyond or ablation in ("paper", "spend_always"):
        with pytest.raises(ConfigError) as caught:
            compose(CONF, ["method=paper", f"ablation={ablation}"])
        expected = f"ablation={ablation}: changes nothing of these settings; leave it out, or choose another method="
        assert caught.value.line() == expected
    else:
        different = changed_by("method=paper", ablation=ablation)
        assert different
        assert different <= named_by(ablation)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("method", ["extended", "paper"])
def test_the_model_never_decides_the_method(model: str, method: str) -> None:
    option = f"model={model}"
    other, mini = (
        typed(composed(f"method={method}", option, *NEEDED.get(option, []))),
        typed(composed(f"method={method}")),
    )
    assert other.corrections == mini.corrections
    assert other.refine == mini.refine
    assert replace(other.adapt, learning_rate=mini.adapt.learning_rate) == mini.adapt


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("ablation=none", "ablation: option 'none' has another name now; write ablation=default"),
        ("ablation=full", "ablation: option 'full' has another name now; write ablation=paper"),
        ("method=default", "method: option 'default' has another name now; write method=extended"),
        ("adapt.tone=true", "adapt.tone: has another name now; write corrections.colour.match"),
        ("adapt.close_gaps=0", "adapt.close_gaps: has another name now; write corrections.gaps.reach"),
    ],
)
def test_an_old_name_says_the_new_one(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(CONF, [override])
    assert caught.value.line() == message


@pytest.mark.parametrize("renamed", [*_RENAMED.values(), *("=".join((g, n)) for (g, _), n in _RENAMED_OPTIONS.items())])
def test_new_names_are_there(renamed: str) -> None:
    group, _, option = renamed.partition("=")
    assert option in options_of(CONF, group) if option else renamed in known_keys(ProjectConfig)


def test_ablations_are_different_experiments() -> None:
    seen: dict[str, str] = {}
    for ablation in ABLATIONS:
        if ablation == "default":
            continue
        content = repr(sorted(leaves(composed(f"ablation={ablation}"))))
        assert content not in seen, f"{ablation} is the same as {seen[content]}"
        seen[content] = ablation


def test_the_rows_of_the_papers_table_add_one_component_each() -> None:
    assert set(ABLATIONS) >= TABLE_ROWS
    methods = {name: typed(composed(f"ablation={name}")) for name in TABLE_ROWS}
    rows = {name: method.adapt for name, method in methods.items()}
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
    assert rows["paper"].restore_interval > 0
    # The default is the last row, five corrections, and steps only where they can repair something.
    assert replace(rows["paper"], spend=Spend.WHERE_MOVED) == typed(composed()).adapt
    around = typed(composed()).corrections
    assert (around.camera.realign, around.colour.match, around.contradiction.fade) == ("choose", True, True)
    assert around.free_space.clear
    assert (around.gaps.reach, around.head.steps, around.others) == (0.7, 0, {})
    for name, row in rows.items():
        assert methods[name].corrections == CorrectionsConfig()
        assert (row.alpha_gaussian, row.inserted_weights, row.spend) == (0, "uniform", "always")


@pytest.mark.parametrize("model", MODELS)
def test_the_papers_method_runs_all_its_steps_and_nothing_beyond(model: str) -> None:
    chosen = typed(composed("method=paper", f"model={model}", *NEEDED.get(f"model={model}", []), "profile=gpu"))
    rate = typed(composed("ablation=paper")).adapt.learning_rate if model == "mini" else 1e-5
    assert chosen.adapt == replace(AdaptConfig(), learning_rate=rate)
    assert chosen.refine.visits == 0
    assert chosen.corrections == CorrectionsConfig()
    assert composed("method=paper") == composed("ablation=paper", "refine.visits=0"), (
        "as the study of predictions has it"
    )


def test_the_controls_take_away_what_they_say() -> None:
    full = typed(composed()).adapt
    without = typed(composed("ablation=control_no_insertion")).adapt
    assert (without.insertion_probability, without.lambda_gen) == (0, 0)
    assert without.steps == full.steps > 0
    assert typed(composed("ablation=control_no_anchor")).adapt.lambda_anchor == 0 < full.lambda_anchor
    only = typed(composed("ablation=corrected")).adapt
    assert replace(only, steps=full.steps) == full
    assert only.steps == 0


def test_the_gpu_profile_with_worldmirror_has_the_papers_values() -> None:
    config = typed(composed("profile=gpu", "method=paper", "model=worldmirror", "model.weights=x.safetensors"))
    paper = AdaptConfig()  # its defaults are the paper's, and are tested as such where they live
    assert config.adapt == paper
    assert config.device == "cuda"
    assert config.warmup.steps == 0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("adapt.stepz=5", "adapt.stepz: unknown key; did you mean 'adapt.steps'?"),
        ("ablation=ancor", "ablation: has no option 'ancor'; did you mean 'anchor'?"),
        ("adpt=default", "adpt: unknown key; did you mean 'adapt'?"),
        ("adapt.steps=many", "adapt.steps: is 'many' (str), expected a whole number"),
        ("adapt.steps=-1", "adapt.steps: is -1, must be from 0 to 1000000"),
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


D = "9" * 10_000


@pytest.mark.parametrize(
    ("override", "message"),
    [
        # A group without this option, optional or not; in place of an option, what is none.
        ("experiment=papr_table", "experiment: has no option 'papr_table'; did you mean 'paper_table'?"),
        ("experiment=[paper_table, nope]", "experiment: has no option '[paper_table, nope]'"),
        ("hydra/launcher=nope", "hydra/launcher: has no option 'nope'; known: parallel, serial, slurm"),
        ("model=../model/mini", "model: has no option '../model/mini'"),
        ("adapt=null", "adapt: has no option 'null'; known: default"),
        ("adapt=[1]", "adapt: has no option '[1]'; known: default"),
        ("adapt={}", "adapt: has no option '{}'; known: default"),
        ("adapt=3", "adapt: has no option '3'; known: default"),
        ("~adapt", "adapt."),
        (f"model={'x' * 5000}", "model: has no option 'xxx"),
        # Keys and values of any length and depth.
        ("x" * 100_000 + "=1", "xxx"),
        ("adapt." + "x" * 100_000 + "=1", "adapt.xxx"),
        ("adapt." + ".".join("x" * 90) + "=1", "adapt.x.x"),
        (f"generator.file={'x' * 30_000}", "generator.file: has 30015 characters"),
        (f"adapt.steps={D}", "adapt.steps: is no KEY=VALUE (a number of too many digits)"),
        (f"adapt.learning_rate={D}", "adapt.learning_rate: is no KEY=VALUE (a number of too many digits)"),
        (
            "seed=1" + "0" * 4000,
            "seed: is a whole number of more than 40 digits, must be from 0 to 9223372036854775807",
        ),
        ("seed=9223372036854775808", "seed: is 9223372036854775808, must be from 0 to 9223372036854775807"),
        ("adapt.steps=" + "[" * 900 + "]" * 900, "adapt.steps: is nested too deeply"),
        # No override at all, and values that Hydra does not understand.
        ("adapt", "adapt: is not KEY=VALUE"),
        ("=", "=: is not KEY=VALUE"),
        ("adapt.steps='", "adapt.steps: is no KEY=VALUE"),
        ("adapt.steps=1,2", "adapt.steps: holds several values; give one"),
        ("adapt.steps=${adapt.steps}", "adapt.steps: cannot be set (Recursive interpolation"),
        ("adapt.augment=[1]", "adapt.augment: cannot be set"),
        # Whole numbers.
        ("adapt.steps=1.5", "adapt.steps: is 1.5 (float), expected a whole number"),
        ("adapt.steps=1e300", "adapt.steps: is a whole number of more than 40 digits"),
        ("adapt.steps=1e999", "adapt.steps: is inf, expected a finite number"),
        ("threads=1000", "threads: is 1000, must be from 0 to 256"),
        ("device=cudaX", "device: is 'cudaX'; use cpu, cuda or cuda:N"),
        ("device=cuda:", "device: is 'cuda:'; use cpu, cuda or cuda:N"),
    ],
    ids=lambda text: text[:30],
)
def test_whatever_stands_there_is_one_short_line(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(CONF, [override])
    assert caught.value.line().startswith(message)
    assert len(caught.value.line()) < 400


def test_an_optional_group_may_be_asked_for_nothing() -> None:
    assert composed("experiment=null") == composed()
    assert composed("experiment=paper_table") != composed()


def test_whole_numbers_may_be_written_as_powers_of_ten() -> None:
    values = composed("adapt.steps=1e2", "adapt.weight_decay=1")
    assert (values["adapt"]["steps"], values["adapt"]["weight_decay"]) == (100, 1.0)
    # As it is kept, too: one value has one key in the cache.
    assert [type(values["adapt"][name]) for name in ("steps", "weight_decay")] == [int, float]


@pytest.mark.parametrize("text", ["a: [", "\x00", "a: 1\n b: 2", "- 1", "3", "a: {b: !!python/name:os.system }"])
def test_a_malformed_option_of_ones_own_is_one_line(tmp_path: Path, text: str) -> None:
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    (conf / "render" / "flight.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        compose(conf, ["render=flight"])
    assert len(caught.value.line()) < 400


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
