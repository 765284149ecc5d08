"""Which rows cannot differ from what they are compared with in so few steps, whatever is measured.

Some components act slowly: the teacher needs 1 / (1 - mu) steps to leave theta_0, restoration touches a share of the weights that grows
with the steps, and stopping early needs two windows before it can stop at all. A tie of two rows that differ in nothing else says nothing.
"""

from __future__ import annotations

from dataclasses import fields

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.expansion import MethodConfig

LEAST_TOUCHED = 0.03  # share of the weights that restoration must touch; the paper's own run touches 3.9 %


def without_power(method: MethodConfig, compared: MethodConfig) -> str | None:
    """Why a row cannot differ from its reference in its number of steps; None if it can.

    Args:
        method: a row of the ablation.
        compared: what it is compared with.
    """
    if method.corrections != compared.corrections:
        return None  # they act whatever the steps
    row, reference = method.adapt, compared.adapt
    differing = {f.name for f in fields(AdaptConfig) if getattr(row, f.name) != getattr(reference, f.name)}
    reasons = []
    for names, reason in (
        ({"restore_interval", "restore_rate"}, _restoration(row, reference)),
        ({"ema_momentum"}, _teacher(row, reference)),
        ({"plateau"}, _plateau(row)),
    ):
        if differing & names:
            if reason is None:
                return None
            reasons.append(reason)
            differing -= names
    if differing or not reasons:
        return None
    return f"no power at {row.steps} steps: {'; '.join(reasons)}"


def share_restored(config: AdaptConfig) -> float:
    """Share of the weights that restoration puts back at least once in the whole run."""
    times = config.steps // config.restore_interval if config.restore_interval else 0
    return float(1 - (1 - config.restore_rate) ** times)


def _restoration(row: AdaptConfig, reference: AdaptConfig) -> str | None:
    own, other = share_restored(row), share_restored(reference)
    if abs(own - other) >= LEAST_TOUCHED:
        return None
    return f"restoration touches {100 * own:.1f} % of the weights, {100 * other:.1f} % in the other"


def _teacher(row: AdaptConfig, reference: AdaptConfig) -> str | None:
    if row.steps * (1 - min(row.ema_momentum, reference.ema_momentum)) >= 1:
        return None
    kept = " and ".join(f"{100 * c.ema_momentum**c.steps:.0f} %" for c in (row, reference))
    return f"the teachers hold {kept} of the start"


def _plateau(row: AdaptConfig) -> str | None:
    needed = 2 * row.plateau.window
    return f"stopping early needs {needed} steps" if row.steps < needed or not needed else None
