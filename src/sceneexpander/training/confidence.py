"""Fits the confidence of the dense base to samples with exact truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from sceneexpander.frontend.confidence import RIGHT, ConfidenceModel, confidence_features
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.training.sample import Sample

_RIDGE = 1e-5  # per squared standardised weight


def pixels_of_sample(
    sample: Sample, every: int
) -> tuple[Float[np.ndarray, "feature pixel"], Float[np.ndarray, " pixel"]]:
    """(features, log depth error) of every n-th pixel of the posed views, after the one scale that centres the scene."""
    channel = EVIDENCE_CHANNELS.index("agreeing")
    counted = sample.valid[: sample.inputs] & sample.posed[:, None, None]
    features, errors = [], []
    for view, (evidence, kept) in enumerate(zip(sample.evidence, counted, strict=True)):
        agreeing = (evidence[channel] * max(sample.inputs - 1, 1)).round()
        of_view = torch.from_numpy(confidence_features(evidence.numpy(), agreeing.numpy()))
        features.append(of_view[:, kept][:, ::every])
        errors.append((sample.prior_log_depth[view] - sample.log_depth[view])[kept])
    centre = torch.cat(errors).median()
    return torch.cat(features, 1).numpy(), torch.cat([(error - centre)[::every] for error in errors]).numpy()


def fit_confidence(
    pixels: Iterable[tuple[Float[np.ndarray, "feature pixel"], Float[np.ndarray, " pixel"]]],
) -> ConfidenceModel:
    """The regression of most likelihood."""
    parts = list(pixels)
    features = np.concatenate([part for part, _ in parts], axis=1).astype(np.float64)
    right = np.abs(np.concatenate([error for _, error in parts])) < RIGHT
    mean, deviation = features.mean(1), np.maximum(features.std(1), 1e-6)
    standard = (features - mean[:, None]) / deviation[:, None]

    def loss(parameters: Float[np.ndarray, " parameter"]) -> tuple[float, Float[np.ndarray, " parameter"]]:
        log_odds = parameters[1:] @ standard + parameters[0]
        value = np.logaddexp(0, np.where(right, -log_odds, log_odds)).mean() + _RIDGE * (parameters[1:] ** 2).sum()
        residual = 1 / (1 + np.exp(-log_odds)) - right
        slope = standard @ residual / len(residual) + 2 * _RIDGE * parameters[1:]
        return float(value), np.concatenate([[residual.mean()], slope])

    found = minimize(loss, np.zeros(len(mean) + 1), jac=True, method="L-BFGS-B", options={"maxiter": 500})
    weights = found.x[1:] / deviation
    return ConfidenceModel(bias=float(found.x[0] - weights @ mean), weights=weights)


def calibration(
    probability: Float[np.ndarray, " pixel"], right: Bool[np.ndarray, " pixel"], bins: int = 10
) -> list[tuple[float, float, float]]:
    """(mean probability, share that is right, share of the pixels) per bin of the probability; empty bins are left out."""
    index = np.minimum((probability * bins).astype(int), bins - 1)
    rows = []
    for k in range(bins):
        chosen = index == k
        if chosen.any():
            rows.append((float(probability[chosen].mean()), float(right[chosen].mean()), float(chosen.mean())))
    return rows
