"""How wrong an inserted view is. One axis at a time, and mixtures of all.

Axes:

- ``rotation_N``, ``translation_N``: the picture is drawn from a camera that is N degrees, or N % of the scene size, away from the
  intended one. The reconstructor is told nothing, so it may find the camera that the picture was really drawn from: by itself such a
  picture is a photograph of the scene from a little elsewhere.
- ``told_rotation_N``, ``told_translation_N``: the same picture, but the reconstructor is told the *intended* camera, as when the motion was
  asked for in words and taken at its word. Only these two make a pose shift an inconsistency.
- ``warp_N``: smooth local warps whose largest displacement is N % of the image width.
- ``stretch_N``, ``zoom_N``, ``shift_N``: what image editors do to the whole picture: it is N % wider at the same height, drawn N %
  larger about its middle, or moved by N % of its width in a random direction.
- ``deform_N``: objects moved by up to N % of the scene size and changed in size by up to twice that.
- ``hallucinate``: an object that is neither in the scene nor asked for.
- ``exposure_N``: N tenths of a stop brighter, with a fifth of that as colour cast.
- ``mixed_N``: N times a good generator's errors of every kind (`Misalignment.graded`); from 2 on with a hallucinated object.
"""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.synthetic.misalign import Misalignment


@dataclass(frozen=True, slots=True, kw_only=True)
class Grade:
    """One kind and amount of misalignment.

    Attributes:
        name: as tables print it.
        axis: what varies; grades of one axis make a curve.
        amount: where on the curve, in the axis' unit.
        misalignment: what the picture gets wrong.
        told: the reconstructor is given the intended camera of the inserted view, instead of estimating one.
    """

    name: str
    axis: str
    amount: float
    misalignment: Misalignment
    told: bool = False


def _all() -> dict[str, Grade]:
    grades = [Grade(name="clean", axis="clean", amount=0.0, misalignment=Misalignment())]
    grades.append(Grade(name="told_clean", axis="told", amount=0.0, misalignment=Misalignment(), told=True))
    for told in (False, True):
        prefix = "told_" if told else ""
        for amount in (2, 5, 10):
            rotated, shifted = Misalignment(rotation_deg=amount), Misalignment(translation_fraction=amount / 100)
            for axis, misalignment in (("rotation", rotated), ("translation", shifted)):
                name = f"{prefix}{axis}"
                grades.append(
                    Grade(name=f"{name}_{amount}", axis=name, amount=amount, misalignment=misalignment, told=told)
                )
    for amount in (1, 2, 4):
        grades.append(
            Grade(
                name=f"warp_{amount}",
                axis="warp",
                amount=amount,
                misalignment=Misalignment(warp_fraction=amount / 100),
            )
        )
        grades.append(
            Grade(
                name=f"deform_{amount}",
                axis="deform",
                amount=amount,
                misalignment=Misalignment(deform_fraction=amount / 100),
            )
        )
        mixed = Misalignment.graded(amount)
        grades.append(Grade(name=f"mixed_{amount}", axis="mixed", amount=amount, misalignment=mixed))
    for amount in (4, 8):
        stretched = Misalignment(stretch=amount / 100)
        grades.append(Grade(name=f"stretch_{amount}", axis="stretch", amount=amount, misalignment=stretched))
    for amount in (5, 10, 20):
        zoomed = Misalignment(zoom=amount / 100)
        grades.append(Grade(name=f"zoom_{amount}", axis="zoom", amount=amount, misalignment=zoomed))
    for amount in (2, 5):
        displaced = Misalignment(shift_fraction=amount / 100)
        grades.append(Grade(name=f"shift_{amount}", axis="shift", amount=amount, misalignment=displaced))
    grades.append(Grade(name="hallucinate", axis="hallucinate", amount=1, misalignment=Misalignment(hallucinate=True)))
    for amount in (3, 6):
        brighter = Misalignment(exposure_stops=amount / 10, white_balance=amount / 50)
        grades.append(Grade(name=f"exposure_{amount}", axis="exposure", amount=amount, misalignment=brighter))
    return {grade.name: grade for grade in grades}


GRADES: dict[str, Grade] = _all()


def grade_named(name: str) -> Grade:
    """The grade of that name. Raises `UserError` with a suggestion if there is none."""
    if name not in GRADES:
        raise UserError(f"unknown grade {name!r}", where="expandbench", fix=did_you_mean(name, GRADES))
    return GRADES[name]
