"""Comparing the tensor names of a released model with a recorded list, without allocating the model."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from sceneexpander.conformance.registry import key_families, read_config
from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck
from sceneexpander.models.weights import describe_mismatch


def _size(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError("a size is a whole number")
    return value


def check_keys(path: Path) -> list[OutputCheck]:
    """Names, shapes and dtypes of the released model that the list belongs to, against the list.

    The file maps every tensor name to ``[shape, dtype]``.

    Raises:
        UserError: if the file is not such a list, or belongs to no known model.
    """
    recorded = read_config(path)
    try:
        expected = {name: (tuple(_size(n) for n in shape), str(dtype)) for name, (shape, dtype) in recorded.items()}
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise UserError("is not a key list (name -> [shape, dtype])", where=path, fix="fetch it again") from None
    family = next((family for family in key_families() if family.matches(expected.keys())), None)
    if family is None:
        known = ", ".join(family.name for family in key_families())
        raise UserError("belongs to no known model", where=path, fix=f"known models: {known}")
    with torch.device("meta"):
        model = family.build()
    found = {
        name: (tuple(value.shape), str(value.dtype).removeprefix("torch."))
        for name, value in model.state_dict().items()
    }
    shapes = describe_mismatch({n: s for n, (s, _) in expected.items()}, {n: s for n, (s, _) in found.items()})
    wrong_dtype = [name for name in expected if name in found and expected[name][1] != found[name][1]]
    differing = sum(1 for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    detail = shapes or f"all {len(expected)} names, shapes and dtypes agree"
    if wrong_dtype:
        detail = f"{shapes + '; ' if shapes else ''}{len(wrong_dtype)} of another dtype ({', '.join(wrong_dtype[:3])})"
    name = f"{family.name} keys"
    error = float(differing) if expected else math.inf
    return [OutputCheck(name=name, error=error, tolerance=0.0, detail=detail)]
