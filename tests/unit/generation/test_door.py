"""A back-end comes in from outside with a file, its settings and a line; and looking at a round sends nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from sceneexpander.artifacts.candidates import CandidateSet
from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import text_keys
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.generation import (
    BACKENDS,
    Backend,
    Forecast,
    GenerationContext,
    GeneratorConfig,
    SceneSoFar,
    make_generator,
)
from sceneexpander.pipeline.preflight import check_scene
from tests.worlds.photos import photos

CONF = Path(__file__).parents[3] / "conf"


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyConfig(GeneratorConfig):
    """Settings of a back-end that this test brings."""

    backend: str = "toy"
    colour: str = "red"


@dataclass(frozen=True, slots=True)
class ToyGenerator:
    """Counts what is asked of it."""

    config: ToyConfig
    asked: ClassVar[dict[str, int]] = {"check": 0, "generate": 0}

    def check(self, context: GenerationContext) -> Forecast:
        """See `ViewGenerator`."""
        self.asked["check"] += 1
        return Forecast(prompt=context.spec.prompt, requests=4, cost_usd=0.16)

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """See `ViewGenerator`."""
        self.asked["generate"] += 1
        raise AssertionError("this costs money")


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, int]:
    monkeypatch.setitem(BACKENDS, "toy", Backend(config=ToyConfig, make=ToyGenerator))
    monkeypatch.setattr(ToyGenerator, "asked", {"check": 0, "generate": 0})
    return ToyGenerator.asked


def test_settings_of_the_newcomer_are_its_own_type(toy: dict[str, int]) -> None:
    values = compose(CONF, [])
    values["generator"] = {"backend": "toy", "colour": "blue"}
    config = parse_dataclass(ProjectConfig, values).generator
    assert config == ToyConfig(colour="blue")
    assert isinstance(make_generator(config), ToyGenerator)
    text_keys.cache_clear()
    assert "generator.colour" in text_keys()
    text_keys.cache_clear()


def test_every_back_end_has_a_configuration_and_the_other_way_round() -> None:
    assert {path.stem for path in (CONF / "generator").glob("*.yaml")} == set(BACKENDS)


def test_looking_at_a_round_never_generates(
    toy: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "scene"
    photos(folder / "captured", 2)
    (folder / "scene.yaml").write_text("rounds:\n  - {prompt: A bench.}\n  - {prompt: A cat.}\n")
    shown = compose(CONF, ["profile=smoke"])
    shown["generator"] = {"backend": "toy", "colour": "blue"}
    monkeypatch.setattr("sceneexpander.pipeline.preflight.compose", lambda *_: shown)
    checked = check_scene("s", folder, conf=CONF, overrides=[])
    assert checked.rounds == 2
    assert [forecast.requests for forecast in checked.forecasts] == [4, 4]
    assert toy == {"check": 2, "generate": 0}
