"""Texts reach the configuration as they are, and nothing reads the environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneexpander.config.compose import check_override, compose
from sceneexpander.config.overrides import override, text_keys, written_out
from sceneexpander.config.parse import ConfigError

CONF = Path(__file__).parents[3] / "conf"
PIECES = [
    *",#'\"=()[]{}$\\~!;&%: \n\t?*|<>@.",
    "${",
    "}",
    "${seed}",
    "${oc.env:HOME}",
    "\\",
    "null",
    "é",
    "写真",
    "\u2028",
    "1",
]
TEXTS = st.one_of(st.text(st.characters(exclude_categories=["Cs"])), st.lists(st.sampled_from(PIECES)).map("".join))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Composes one key: the whole configuration takes too long for thousands of texts."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from omegaconf import OmegaConf

    folder = tmp_path_factory.mktemp("conf")
    (folder / "config.yaml").write_text("tracking: {experiment: a}\nseed: 3\n")
    with initialize_config_dir(str(folder), version_base="1.3"):

        def value(item: str) -> Any:
            composed = hydra_compose("config", overrides=[item])
            return OmegaConf.to_container(composed, resolve=True)["tracking"]["experiment"]

        yield value


@settings(max_examples=60, deadline=None)
@given(text=TEXTS.filter(lambda text: text != "???"))
def test_any_text_comes_back_as_it_was(plain: Any, text: str) -> None:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    item = override("tracking.experiment", text)
    parsed = OverridesParser.create().parse_override(item)
    assert not parsed.is_sweep_override()
    assert check_override(CONF, item)
    assert plain(item) == text
    # Going through again changes nothing: a sweep hands its jobs what it has written out already.
    assert written_out([item], absolute=True) == (item,)


NAMES = [
    "Müller, A",
    "it's #1",
    'a "b"',
    "a=b (1)",
    "[x]{y}",
    "50% & more; x!",
    "~a",
    "${seed}",
    "$HOME",
    "back\\",
    "写真",
    "a\nb",
    "  a ",
]


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_in_any_folder_is_found(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / name
    folder.mkdir()
    (folder / f"{name}.png").write_text("x")
    (folder / f"{name}_1.png").write_text("x")
    monkeypatch.chdir(folder)
    for given_text, found in (
        (f"{folder}/{name}.png", f"{name}.png"),
        (f"./{name}.png", f"{name}.png"),
        (f"./{name}_{{round}}.png", f"{name}_{{round}}.png"),
    ):
        (item,) = written_out([f"generator.file={given_text}"], absolute=True)
        values = compose(CONF, ["generator=file", item])
        assert values["generator"]["file"] == str(folder / found)
        assert written_out([item], absolute=True) == (item,)


@pytest.mark.parametrize("text", ["a, b", "it's", "a=b (1)", "#1", "x)", "Müller", "[a]", "a b", "{a}"])
def test_texts_that_are_no_files_are_taken_literally_too(text: str) -> None:
    (item,) = written_out([f"tracking.experiment={text}"])
    assert compose(CONF, [item])["tracking"]["experiment"] == text


@pytest.mark.parametrize("text", ["9" * 5000, "[" * 5000 + "]" * 5000, "{" * 900, "f(" * 3000])
def test_what_hydras_parser_gives_up_on_is_a_text(text: str) -> None:
    (item,) = written_out([f"tracking.experiment={text}"])
    assert item == override("tracking.experiment", text)
    assert check_override(CONF, item)


@pytest.mark.parametrize("key", ["tracking.experiment", "model.weights", "seed"])
def test_a_value_longer_than_any_is_refused_by_its_length(key: str) -> None:
    (item,) = written_out([f"{key}={'b c,' * 50_000}"], absolute=True)
    with pytest.raises(ConfigError, match=r"has 2000\d\d characters"):
        check_override(CONF, item)


@pytest.mark.parametrize(
    "item",
    ["adapt.steps=5", "ablation=a,b", "seed=${threads}", "tracking.uri=${tracking.experiment}", "generator.file=null"],
)
def test_what_hydra_understands_is_left_alone(item: str) -> None:
    assert written_out([item], absolute=True, sweep=True) == (item,)


def test_a_list_of_files_stays_a_sweep() -> None:
    assert written_out(["model.weights=a.x,b.x"], sweep=True) == ("model.weights=a.x,b.x",)


def test_text_keys_are_texts() -> None:
    assert {"model.weights", "generator.file", "tracking.experiment"} <= text_keys()
    assert not {"seed", "adapt.steps", "scene.fit", "corrections.camera.realign"} & text_keys()


def test_the_home_of_nobody_is_one_line() -> None:
    with pytest.raises(ConfigError, match="no home folder ~nosuchuser"):
        written_out(["model.weights=~nosuchuser/x"])


@pytest.mark.parametrize(
    "item",
    [
        "tracking.experiment=${oc.env:SECRET}",
        "tracking.experiment=a${oc.env:SECRET,none}b",
        "generator.file=${oc.decode:'${oc.env:SECRET}'}",
        "tracking.experiment=${oc.decode:${oc.env:SECRET}}",
        "seed=${oc.env:SECRET}",
        "ablation=${oc.env:SECRET}",
        "+adapt.new=${oc.env:SECRET}",
    ],
)
def test_no_setting_reads_the_environment(item: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "canary")
    with pytest.raises(ConfigError) as caught:
        compose(CONF, [item])
    assert "canary" not in str(caught.value)


def test_files_of_conf_do_not_either(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil

    shutil.copytree(CONF, tmp_path / "conf")
    path = tmp_path / "conf" / "tracking" / "local.yaml"
    path.write_text(path.read_text().replace("experiment: sceneexpander", "experiment: ${oc.env:SECRET}"))
    monkeypatch.setenv("SECRET", "canary")
    with pytest.raises(ConfigError, match="environment variable"):
        compose(tmp_path / "conf", [])


def test_elsewhere_the_environment_can_still_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    from omegaconf import OmegaConf

    compose(CONF, [])
    monkeypatch.setenv("SECRET", "canary")
    assert OmegaConf.create({"a": "${oc.env:SECRET}"})["a"] == "canary"
