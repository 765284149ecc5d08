"""Motions in words, and where they lead."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.generation.motion import Step, is_motion, move_camera, parse_motion
from sceneexpander.geometry.rigid import look_at, rotation_angle_deg

UP = torch.tensor([0.0, -1.0, 0.0])  # OpenCV: y points down


def moved(
    text: str, *, pose: torch.Tensor | None = None, distance: float = 4.0, metre: float | None = 0.5
) -> torch.Tensor:
    start = torch.eye(4) if pose is None else pose
    steps = parse_motion(text, where="motion")
    return move_camera(start, steps, up=UP, distance=distance, units_per_metre=metre, where="motion")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("move back 20 %", ("move", "back", 0.2, "share")),
        ("Step forward by 1.5 metres.", ("move", "forward", 1.5, "metres")),
        ("go left 30cm", ("move", "left", 0.3, "metres")),
        ("turn right 30 degrees", ("turn", "right", 30.0, "degrees")),
        ("look up 10°", ("turn", "up", 10.0, "degrees")),
        ("tilt the camera down", ("turn", "down", 20.0, "degrees")),
        ("pan left a little", ("turn", "left", 10.0, "degrees")),
        ("orbit left forty-five degrees", ("orbit", "left", 45.0, "degrees")),
        ("circle around to the right", ("orbit", "right", 20.0, "degrees")),
        ("move back half the distance", ("move", "back", 0.5, "share")),
        ("move a third of the scene up", ("move", "up", 1 / 3, "share")),
        ("zoom out a lot", ("move", "back", 0.4, "share")),
        ("rise 2 m", ("move", "up", 2.0, "metres")),
        ("30 degrees right", ("turn", "right", 30.0, "degrees")),
        ("right", ("move", "right", 0.2, "share")),
        ("turn right towards the corner of the courtyard", ("turn", "right", 20.0, "degrees")),
        ("turn around", ("turn", "right", 180.0, "degrees")),
    ],
)
def test_one_step(text: str, expected: tuple[str, str, float, str]) -> None:
    (step,) = parse_motion(text, where="motion")
    assert (step.kind, step.direction, step.unit) == (expected[0], expected[1], expected[3])
    assert step.amount == pytest.approx(expected[2])
    (again,) = parse_motion(step.words(), where="motion")
    assert again == replace(step, amount=again.amount)
    assert again.amount == pytest.approx(step.amount, rel=1e-4)


def test_steps_follow_each_other_and_keep_the_verb() -> None:
    assert parse_motion("Move back 2 m and up 10 %, then turn left 5 degrees and down.", where="") == (
        Step(kind="move", direction="back", amount=2, unit="metres"),
        Step(kind="move", direction="up", amount=0.1, unit="share"),
        Step(kind="turn", direction="left", amount=5, unit="degrees"),
        Step(kind="turn", direction="down", amount=20, unit="degrees"),
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "says no camera motion"),
        ("behind the table", "'behind'"),
        ("move back 3 bananas", "number without a unit"),
        ("move left 30 degrees", "moves by degrees"),
        ("turn left 2 m", "turns by a length"),
        ("turn back", "turns in no direction"),
        ("move", "not understood"),
        ("move back 900 %", "too far"),
        ("turn left 0 degrees", "by nothing"),
        ("move and turn", "not understood"),
        ("move turn left", "not understood"),
    ],
)
def test_what_is_not_understood_is_refused(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said) as caught:
        parse_motion(text, where="--motion")
    assert caught.value.where == "--motion"
    assert "e.g." in caught.value.line() or "at most" in caught.value.line() or "use left" in caught.value.line()
    assert not is_motion(text)


@pytest.mark.parametrize(
    ("text", "eye"),
    [
        ("move back 25 %", (0, 0, -1)), ("move forward 25 %", (0, 0, 1)), ("move left 25 %", (-1, 0, 0)),
        ("move right 25 %", (1, 0, 0)), ("move up 25 %", (0, -1, 0)), ("move down 25 %", (0, 1, 0)), ("move back 2 m", (0, 0, -1)),
    ],
)  # fmt: skip
def test_moves_change_the_place_alone(text: str, eye: tuple[float, ...]) -> None:
    pose = moved(text)
    assert torch.equal(pose[:3, :3], torch.eye(3))
    assert pose[:3, 3].tolist() == pytest.approx(eye)


@pytest.mark.parametrize(
    ("direction", "towards"),
    [("left", (-1, 0, 0)), ("right", (1, 0, 0)), ("up", (0, -1, 0)), ("down", (0, 1, 0))],
)
def test_turns_look_elsewhere_and_orbits_look_at_the_same(direction: str, towards: tuple[float, ...]) -> None:
    toward = torch.tensor(towards, dtype=torch.float32)
    turned = moved(f"turn {direction} 30 degrees")
    assert torch.equal(turned[:3, 3], torch.zeros(3))
    assert float(turned[:3, 2] @ toward) == pytest.approx(0.5)
    around = moved(f"orbit {direction} 30 degrees")
    centre = torch.tensor([0, 0, 4.0])
    assert float(around[:3, 3] @ toward) == pytest.approx(2.0)
    assert torch.allclose(around[:3, 3] + 4 * around[:3, 2], centre, atol=1e-5)
    for pose in (turned, around):
        assert float(rotation_angle_deg(pose[:3, :3], torch.eye(3))) == pytest.approx(30, abs=1e-3)
        assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), atol=1e-6)


def test_turning_sideways_keeps_the_horizon_of_a_camera_that_looks_down() -> None:
    start = look_at(torch.tensor([0.0, -2.0, 0.0]), torch.tensor([0.0, 0.0, 3.0]), UP)
    for text in ("turn left 70 degrees", "orbit right 70 degrees"):
        assert float(moved(text, pose=start)[1, 0]) == pytest.approx(0, abs=1e-6)


def test_metres_need_to_be_known() -> None:
    with pytest.raises(UserError, match="is in metres, which these photos do not tell"):
        moved("move back 1 m", metre=None)
