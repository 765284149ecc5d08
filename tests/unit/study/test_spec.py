"""What is wrong with a study.yaml is one line that names the key."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
import yaml

from sceneexpander.errors import UserError
from sceneexpander.study.spec import StudySpec, read_spec
from sceneexpander.typed import decode_dataclass

GOOD: dict[str, Any] = {
    "title": "t",
    "contact": "c",
    "consent": "c",
    "participants": 3,
    "scenes": [{"name": "one", "prompt": "p", "videos": {"a": "a.mp4", "b": "b.mp4"}}],
}


def scene(**changes: Any) -> dict[str, Any]:
    return {"scenes": [{**GOOD["scenes"][0], **changes}]}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"participants": 0}, "participants: is 0, must be from 1 to 10000"),
        ({"consent": " "}, "consent: is empty"),
        ({"scenes": []}, "scenes: is empty"),
        ({"scenes": GOOD["scenes"] * 2}, "scenes: holds 'one' twice"),
        (scene(name="a/b"), "scenes[0].name: is 'a/b'"),
        (scene(prompt=""), "scenes[0].prompt: is missing"),
        (scene(videos={}), "scenes[0].videos: are missing"),
        (scene(videos={"a": "a.mp4"}), "methods: are 1, must be from 2 to 10"),
        ({"methods": ["a", "b", "c"]}, "scenes[0]: scene 'one' has no video of 'c'"),
        ({"methods": ["a"], **scene()}, "methods: are 1"),
        ({"methods": ["a", "a"]}, "methods: holds 'a' twice"),
        ({"catch": {"scenes": 11}}, "catch.scenes: is 11"),
        ({"minimum_s": -1}, "minimum_s: is -1.0"),
        ({"titel": "t"}, "titel: unknown key; did you mean 'title'?"),
    ],
)
def test_refusals_name_file_and_key(tmp_path: Path, changes: dict[str, Any], expected: str) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump({**GOOD, **changes}))
    with pytest.raises(UserError) as caught:
        read_spec(path)
    assert caught.value.line().startswith(f"{path}: {expected}")


def test_a_study_without_consent_cannot_be_built(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump({name: value for name, value in GOOD.items() if name != "consent"}))
    with pytest.raises(UserError, match="consent: missing key"):
        read_spec(path)


@pytest.mark.parametrize(("count", "minimum"), [(2, 0.6), (3, 0.3), (5, 0.6), (5, 1.0), (5, 0.0)])
def test_chance_of_guessing_a_catch_screen(count: int, minimum: float) -> None:
    videos = {f"m{index}": "x.mp4" for index in range(count)}
    spec = decode_dataclass(StudySpec, {**GOOD, **scene(videos=videos), "catch": {"minimum_tau": minimum}})
    orders = list(itertools.permutations(range(count)))
    pairs = list(itertools.combinations(range(count), 2))
    passed = [sum(order[a] < order[b] for a, b in pairs) for order in orders]
    share = sum((2 * agreed - len(pairs)) / len(pairs) >= minimum - 1e-9 for agreed in passed) / len(orders)
    assert spec.worst_guess == pytest.approx(share)
