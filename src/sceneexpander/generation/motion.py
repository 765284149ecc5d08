"""Camera motions in plain words: "move back 20 %, then turn right 30 degrees".

A motion is a list of steps, separated by commas, "and" or "then". A step is a move (``move``, ``step``, ``walk``, ...), a turn on the spot
(``turn``, ``look``, ``pan``, ``tilt``) or an orbit about what the camera looks at (``orbit``, ``circle``), with a direction and, if one
likes, an amount: degrees for turns and orbits; metres, or a share of the distance to what the camera looks at, for moves. A step without a
verb goes on with the one before. What is not understood is refused, never guessed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.rigid import rigid_from_parts, rotation_from_quat_wxyz

Kind = Literal["move", "turn", "orbit"]
Direction = Literal["forward", "back", "left", "right", "up", "down"]
Unit = Literal["degrees", "metres", "share"]

EXAMPLE = 'e.g. "move back 20 %", "turn right 30 degrees", "orbit left 15 degrees and move up 0.5 m"'
_DEFAULT_DEG = 20.0
_DEFAULT_SHARE = 0.2  # of the distance to what the camera looks at
_VERBS: dict[Kind, str] = {
    "move": "move|moves|moving|step|go|walk|fly|dolly|truck|slide|shift|pedestal|pull|push|zoom|rise|sink",
    "turn": "turn|turns|turning|rotate|look|looks|looking|face|pan|tilt|yaw|pitch",
    "orbit": "orbit|orbits|orbiting|circle|arc|revolve",
}
_DIRECTIONS: dict[Direction, str] = {
    "forward": "forward|forwards|ahead|closer|in",
    "back": "back|backward|backwards|away|out",
    "left": "left|leftward|leftwards",
    "right": "right|rightward|rightwards",
    "up": "up|upward|upwards|higher",
    "down": "down|downward|downwards|lower",
}
_FILLERS = (
    "the|your|camera|view|viewpoint|please|by|about|around|to|a|an|it|straight|further|of|scene|distance|way|slowly"
)
_LITTLE, _MUCH = "a little|a bit|little|slightly", "a lot|far|much"
_NUMBERS = {
    "a quarter": 0.25, "a third": 1 / 3, "two thirds": 2 / 3, "three quarters": 0.75, "half a": 0.5, "half": 0.5,
    "one": 1.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "ten": 10.0, "fifteen": 15.0, "twenty": 20.0, "thirty": 30.0,
    "forty five": 45.0, "forty-five": 45.0, "forty": 40.0, "sixty": 60.0, "ninety": 90.0,
}  # fmt: skip
_UNITS: tuple[tuple[str, Unit, float], ...] = (
    (r"°|degrees?\b|deg\b", "degrees", 1.0),
    (r"centimet(?:er|re)s?\b|cm\b", "metres", 0.01),
    (r"met(?:er|re)s?\b|m\b", "metres", 1.0),
    (r"%|percent\b|per cent\b", "share", 0.01),
    (r"(?:of )?(?:the |its )?(?:scene|distance|depth|way)\b", "share", 1.0),
)
_WORDS = "|".join(sorted(_NUMBERS, key=len, reverse=True))
_VALUE = re.compile(rf"(?<![\w.])(\d+(?:\.\d+)?(?![\d.])|\.\d+|(?:{_WORDS})\b)\s*")
_SEPARATOR = re.compile(r"\s*(?:[,;]|\.(?!\d)|\band then\b|\bthen\b|\band\b)\s*")
_AIM = re.compile(r"\btowards?\b[^,;.]*?(?=\s+(?:and|then)\b|[,;.]|$)")  # what people add for people
_MOST_DEG, _MOST_SHARE, _MOST_METRES = 180.0, 5.0, 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One part of a motion. ``amount`` is in ``unit``: a share is one of the distance to what the camera looks at."""

    kind: Kind
    direction: Direction
    amount: float
    unit: Unit

    def words(self) -> str:
        """In the words that `parse_motion` understands."""
        shown = {
            "degrees": f"{self.amount:g} degrees",
            "metres": f"{self.amount:g} m",
            "share": f"{100 * self.amount:g} %",
        }
        return f"{self.kind} {self.direction} {shown[self.unit]}"


def parse_motion(text: str, *, where: str) -> tuple[Step, ...]:
    """The steps of a motion.

    Raises:
        UserError: there are no words, or some that are not understood.
    """
    steps: list[Step] = []
    kind: Kind | None = None
    for clause in _SEPARATOR.split(_AIM.sub("", " ".join(text.casefold().split()))):
        if clause:
            found = _parse_clause(clause, kind, where)
            steps += found
            kind = found[-1].kind
    if not steps:
        raise UserError("says no camera motion", where=where, fix=f"say how the camera moves, {EXAMPLE}")
    return tuple(steps)


def is_motion(text: str) -> bool:
    """Whether `parse_motion` understands all of it, as a motion that a verb begins."""
    first = re.match(r"(?:please |the |camera )*(\w+)", text.casefold().strip())
    if first is None or not any(re.fullmatch(verbs, first[1]) for verbs in _VERBS.values()):
        return False
    try:
        parse_motion(text, where="")
    except UserError:
        return False
    return True


def _parse_clause(clause: str, before: Kind | None, where: str) -> list[Step]:
    rest = clause
    if re.search(r"\bturn(?:ing)? around\b|\blook behind\b", rest):
        return [Step(kind="turn", direction="right", amount=180.0, unit="degrees")]
    rest, factor = _take_size(rest)
    rest, amount, unit = _take_amount(rest, clause, where)
    kinds = [kind for kind, verbs in _VERBS.items() if re.search(rf"\b(?:{verbs})\b", rest)]
    words = re.findall(r"\w+", rest)
    directions = [name for word in words for name, forms in _DIRECTIONS.items() if re.fullmatch(forms, word)]
    if "rise" in words:
        directions.append("up")
    if "sink" in words:
        directions.append("down")
    known = "|".join([*_VERBS.values(), *_DIRECTIONS.values(), _FILLERS])
    strange = [word for word in words if not re.fullmatch(known, word)]
    if strange or len(kinds) > 1 or not directions:
        problem = f"{clause!r} is not understood" + (f" ({strange[0]!r})" if strange else "")
        raise UserError(problem, where=where, fix=f"write it {EXAMPLE}")
    kind = kinds[0] if kinds else before if unit is None and before else "turn" if unit == "degrees" else "move"
    if kind == "move" and unit == "degrees":
        raise UserError(f"{clause!r} moves by degrees", where=where, fix=f"turn or orbit by degrees, {EXAMPLE}")
    if kind != "move" and unit not in (None, "degrees"):
        raise UserError(f"{clause!r} turns by a length", where=where, fix=f"give it in degrees, {EXAMPLE}")
    if kind != "move" and any(direction in ("forward", "back") for direction in directions):
        raise UserError(f"{clause!r} turns in no direction", where=where, fix="use left, right, up or down")
    if amount is None or unit is None:
        amount, unit = (_DEFAULT_SHARE, "share") if kind == "move" else (_DEFAULT_DEG, "degrees")
        amount *= factor
    most = {"degrees": _MOST_DEG, "share": _MOST_SHARE, "metres": _MOST_METRES}[unit]
    if not 0 < amount <= most:
        shown = f"{100 * most:g} %" if unit == "share" else f"{most:g} {unit}"
        raise UserError(f"{clause!r} goes by nothing or too far", where=where, fix=f"at most {shown}")
    return [Step(kind=kind, direction=direction, amount=amount, unit=unit) for direction in directions]


def _take_size(text: str) -> tuple[str, float]:
    for words, factor in ((_LITTLE, 0.5), (_MUCH, 2.0)):
        found = re.search(rf"\b(?:{words})\b", text)
        if found:
            return text[: found.start()] + text[found.end() :], factor
    return text, 1.0


def _take_amount(text: str, clause: str, where: str) -> tuple[str, float | None, Unit | None]:
    found = _VALUE.search(text)
    if found is None:
        return text, None, None
    value = _NUMBERS[found[1]] if found[1] in _NUMBERS else float(found[1])
    after = text[found.end() :]
    for pattern, unit, factor in _UNITS:
        match = re.match(pattern, after)
        if match:
            return text[: found.start()] + after[match.end() :], value * factor, unit
    raise UserError(f"{clause!r} has a number without a unit", where=where, fix=f"add degrees, % or m, {EXAMPLE}")


def move_camera(
    world_from_cam: Float[Tensor, "4 4"],
    steps: Sequence[Step],
    *,
    up: Float[Tensor, "3"],
    distance: float,
    units_per_metre: float | None,
    where: str,
) -> Float[Tensor, "4 4"]:
    """A camera after a motion.

    Args:
        world_from_cam: where it starts.
        steps: of the motion, in order; each starts where the one before ended.
        up: unit vector, up in the world: turns and orbits to the side go about it.
        distance: to what the camera looks at, in scene units: what shares are of, and where orbits have their centre.
        units_per_metre: scene units; None: not known.
        where: the motion's place, for messages.

    Raises:
        UserError: a step is in metres and nobody knows how long one is.
    """
    pose = world_from_cam
    for step in steps:
        rotation, eye = pose[:3, :3], pose[:3, 3]
        right, down, forward = rotation.unbind(-1)
        if step.kind == "move":
            length = step.amount * distance
            if step.unit == "metres":
                if units_per_metre is None:
                    fix = 'say it as a share of the distance, e.g. "move back 20 %"'
                    raise UserError("is in metres, which these photos do not tell", where=where, fix=fix)
                length = step.amount * units_per_metre
            along = {
                "forward": forward, "back": -forward, "right": right, "left": -right, "down": down, "up": -down,
            }[step.direction]  # fmt: skip
            pose = rigid_from_parts(rotation, eye + length * along)
            continue
        # By the right-hand rule: about `up` to the left, about `right` upwards.
        sideways = step.direction in ("left", "right")
        sign = 1.0 if step.direction in ("left", "up") else -1.0
        if step.kind == "turn":
            turn = _rotation(up if sideways else right, sign * step.amount)
            pose = rigid_from_parts(turn @ rotation, eye)
        else:  # the camera itself goes where it is told, so its gaze turns the other way
            turn = _rotation(up if sideways else right, -sign * step.amount)
            centre = eye + distance * forward
            pose = rigid_from_parts(turn @ rotation, centre + turn @ (eye - centre))
    return pose


def _rotation(axis: Float[Tensor, "3"], angle_deg: float) -> Float[Tensor, "3 3"]:
    half = torch.deg2rad(torch.as_tensor(angle_deg, dtype=axis.dtype, device=axis.device)) / 2
    return rotation_from_quat_wxyz(torch.cat([torch.cos(half)[None], torch.sin(half) * axis]))
