"""The paper's template and its two fields."""

from __future__ import annotations

import pytest

from sceneexpander.artifacts.scene import RoundSpec
from sceneexpander.errors import UserError
from sceneexpander.generation.prompt import EXPLORATION, PromptTemplate, fill_prompt, split_words
from sceneexpander.ingest import make_round

HEAD = "You are exploring. Please generate a new viewpoint following the requirements: "


def test_both_fields() -> None:
    spec = RoundSpec(prompt="unused", motion="move back", new_object="a squirrel sits on a stone bench.")
    assert fill_prompt(spec) == HEAD + "move back, a squirrel sits on a stone bench."


def test_the_papers_own_example() -> None:
    paper = PromptTemplate(text=EXPLORATION.text.replace("], [", "]; ["), separator="; ")
    spec = RoundSpec(
        prompt="-",
        motion="move back",
        new_object="outside the tunnel, there is a stone bench, and a squirrel sits on it",
    )
    expected = "move back; outside the tunnel, there is a stone bench, and a squirrel sits on it."
    assert fill_prompt(spec, paper) == HEAD + expected


def test_a_free_sentence_takes_the_second_field() -> None:
    assert fill_prompt(RoundSpec(prompt="Behind the table is a bench.")) == HEAD + "Behind the table is a bench."
    both = RoundSpec(prompt="There is a bench.", motion="turn left,")
    assert fill_prompt(both) == HEAD + "turn left, There is a bench."


def test_one_field_only() -> None:
    assert fill_prompt(make_round("", motion="Move back.")) == HEAD + "Move back."
    assert fill_prompt(make_round("", new_object="a red bicycle")) == HEAD + "a red bicycle."
    assert fill_prompt(make_round("", motion="move back", new_object="a cat")) == HEAD + "move back, a cat."


@pytest.mark.parametrize(
    "words", ["[CAMERA_MOTION]", "[NEW_OBJECT], [CAMERA_MOTION]", r"a \1 back\g<0> slash", "{x} %s"]
)
def test_what_the_user_wrote_is_never_a_field(words: str) -> None:
    assert fill_prompt(RoundSpec(prompt="-", motion="go", new_object=words)) == f"{HEAD}go, {words}."


def test_no_words() -> None:
    with pytest.raises(UserError, match="has no words"):
        fill_prompt(RoundSpec(prompt=" . "))
    with pytest.raises(ValueError, match="exactly once"):
        PromptTemplate(text="Draw [NEW_OBJECT].")


@pytest.mark.parametrize(
    ("sentence", "motion", "content"),
    [
        ("Turn right 30 degrees, there is a well.", "Turn right 30 degrees", "there is a well"),
        ("Move back to reveal a bench.", "Move back", "a bench"),
        ("Move back 20 % and then turn left. A cat sleeps.", "Move back 20 % and then turn left", "A cat sleeps"),
        ("Turn right towards the old gate, a well, and a cat", "Turn right towards the old gate", "a well, and a cat"),
        ("move up 1.5 m; a roof", "move up 1.5 m", "a roof"),
        ("Move back 20 %", "Move back 20 %", ""),
        ("Behind the white table is a wooden bench.", "", "Behind the white table is a wooden bench"),
        ("To the right of the table, there is a door.", "", "To the right of the table, there is a door"),
        ("Look at the table, it has a cat on it", "", "Look at the table, it has a cat on it"),
        ("A cat. Turn right.", "", "A cat. Turn right"),
    ],
)
def test_a_free_sentence_is_split_where_its_motion_ends(sentence: str, motion: str, content: str) -> None:
    assert split_words(RoundSpec(prompt=sentence)) == (motion, content)
    filled = ", ".join(part for part in (motion, content) if part)
    assert fill_prompt(RoundSpec(prompt=sentence)) == f"{HEAD}{filled}."


def test_fields_that_are_given_are_not_split() -> None:
    spec = RoundSpec(prompt="Turn right, a well.", motion="go on", new_object="move back, a cat")
    assert split_words(spec) == ("go on", "move back, a cat")
    assert split_words(RoundSpec(prompt="Turn left, a well.", new_object="Turn right, a cat")) == (
        "",
        "Turn right, a cat",
    )
