"""How likely the depth of a pixel is right: a logistic regression on the evidence of the dense base.

No single cue tells a right depth from a wrong one: two views agree on the wrong stripe of a wallpaper, and a plain floor that a
plane fills well has nothing to match. Together they do. The coefficients are fitted on procedural scenes with exact truth, with
true, slightly wrong and estimated cameras (`scripts/fit_confidence.py`), and lie beside this module.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from sceneexpander.geometry.priors import EVIDENCE_CHANNELS

RIGHT = 0.05  # log depth error below which a depth counts as right
_SCHEMA = "dense-confidence-1"


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfidenceModel:
    """Log odds of "within 5 % of the truth" = bias + weights . features."""

    bias: float
    weights: Float[np.ndarray, " feature"]

    def __call__(self, features: Float[np.ndarray, "feature *pixel"]) -> NDArray[np.float32]:
        """Probability in (0, 1) that a depth is right."""
        log_odds = np.tensordot(self.weights.astype(np.float32), features, axes=1) + np.float32(self.bias)
        return np.asarray(1 / (1 + np.exp(-log_odds)), np.float32)

    def as_json(self) -> str:
        """For `confidence.json`."""
        named = {name: round(float(weight), 5) for name, weight in zip(FEATURES, self.weights, strict=True)}
        return json.dumps({"schema": _SCHEMA, "bias": round(self.bias, 5), "weights": named}, indent=1) + "\n"


# Counts of agreeing views as steps, because one is not half of two; distances to other estimates with a bend where "equal" ends.
FEATURES = (
    "one_agrees",
    "two_agree",
    "three_agree",
    "cost",
    "cost_squared",
    "ambiguity",
    "ambiguity_root",
    "parallax",
    "parallax_squared",
    "plane",
    "on_a_plane",
    "gap_small",
    "gap",
    "sparse_small",
    "sparse",
    "distance",
    "agreed_cost",
    "agreed_ambiguity",
    "agreed_parallax",
    "agreed_gap",
    "agreed_sparse",
    "parallax_ambiguity",
    "view_agreed",
    "view_agreed_squared",
    "view_cost",
    "view_ambiguity",
    "agreed_view_agreed",
)


def confidence_features(
    evidence: Float[np.ndarray, "channel height width"], agreeing_views: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "feature height width"]:
    """What the regression reads, for one view: cues of the pixel, and how well the view as a whole fits (its pose may be wrong).

    Args:
        evidence: channels of `EVIDENCE_CHANNELS`, lengths at the resolution that was matched; "confident" and "agreeing" are ignored.
        agreeing_views: how many other views agree.
    """
    channel = {name: evidence[k] for k, name in enumerate(EVIDENCE_CHANNELS)}
    cost, ambiguity, parallax, plane = (channel[name] for name in ("cost", "ambiguity", "parallax", "plane"))
    gap, sparse = np.abs(channel["gap"]), np.abs(channel["sparse"])
    agreed = (agreeing_views >= 1).astype(np.float32)
    share = agreed.mean()
    features: list[NDArray[np.generic]] = [
        agreed,
        agreeing_views >= 2,
        agreeing_views >= 3,
        cost,
        cost**2,
        ambiguity,
        np.sqrt(ambiguity),
        parallax,
        parallax**2,
        plane,
        plane > 0,
        np.minimum(gap, 0.05),
        np.minimum(gap, 0.3),
        np.minimum(sparse, 0.1),
        np.minimum(sparse, 0.5),
        channel["distance"],
        agreed * cost,
        agreed * ambiguity,
        agreed * parallax,
        agreed * np.minimum(gap, 0.1),
        agreed * np.minimum(sparse, 0.3),
        parallax * ambiguity,
        *(np.full_like(agreed, value) for value in (share, share**2, cost.mean(), ambiguity.mean())),
        agreed * share,
    ]
    return np.stack([feature.astype(np.float32) for feature in features])


@cache
def shipped_model() -> ConfidenceModel:
    """The fitted coefficients."""
    stored = json.loads(files("sceneexpander.frontend").joinpath("confidence.json").read_text())
    if stored["schema"] != _SCHEMA or tuple(stored["weights"]) != FEATURES:
        raise ValueError("confidence.json does not belong to this code: run scripts/fit_confidence.py")
    return ConfidenceModel(bias=stored["bias"], weights=np.array(list(stored["weights"].values())))
