"""Comparing a computed tensor with a recorded one: the value that every conformance runner returns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputCheck:
    """How far one output is from what was recorded, and how far it may be.

    ``error`` and ``tolerance`` share a unit, which the runner chooses (absolute error, relative L2, ...) and ``detail`` names.
    """

    name: str
    error: float
    tolerance: float
    detail: str = ""

    @property
    def ok(self) -> bool:
        """True if the error is within the tolerance; an error of NaN never is."""
        return self.error <= self.tolerance

    @property
    def ratio(self) -> float:
        """The error in units of the tolerance (infinite for any error where none is allowed, or for NaN)."""
        if math.isnan(self.error):
            return math.inf
        if self.tolerance == 0:
            return 0.0 if self.error == 0 else math.inf
        return self.error / self.tolerance


def compare_tensors(name: str, actual: Tensor, expected: Tensor, *, atol: float, rtol: float) -> OutputCheck:
    """Check ``|actual - expected| <= atol + rtol * |expected|`` in float64; error 1 means exactly at the limit.

    With ``atol = rtol = 0`` equality is asked for and the error is the largest absolute difference. Entries that are the same
    infinity agree. A difference of shape is an infinite error.
    """
    rule = f"{atol:g} + {rtol:g}*|b|" if atol or rtol else "exact"
    exact = not (atol or rtol)
    tolerance = 0.0 if exact else 1.0
    if actual.shape != expected.shape:
        detail = f"shape {tuple(actual.shape)}, expected {tuple(expected.shape)}"
        return OutputCheck(name=name, error=math.inf, tolerance=tolerance, detail=detail)
    if actual.numel() == 0:
        return OutputCheck(name=name, error=0.0, tolerance=tolerance, detail=rule)
    a, b = actual.detach().double().cpu(), expected.detach().double().cpu()
    difference = torch.where(a == b, torch.zeros_like(a), (a - b).abs())
    if not exact:
        difference = difference / (atol + rtol * b.abs())
    return OutputCheck(name=name, error=float(difference.max()), tolerance=tolerance, detail=rule)
