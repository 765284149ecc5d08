"""The probability that a depth is right: it holds on scenes that nobody fitted it to."""

from __future__ import annotations

import json
from importlib.resources import files

import numpy as np
import pytest
import torch

from sceneexpander.frontend.confidence import FEATURES, RIGHT, ConfidenceModel, confidence_features, shipped_model
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.synthetic.views import make_views
from sceneexpander.training.confidence import calibration, fit_confidence, pixels_of_sample
from sceneexpander.training.generate import Conditions, sample_of_scene


def test_the_regression_finds_the_odds_that_made_the_data() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 60_000))
    weights = np.array([1.5, -0.7, 0.0])
    right = rng.uniform(size=60_000) < 1 / (1 + np.exp(-(weights @ features + 0.4)))
    found = fit_confidence([(features, np.where(right, 0.0, 1.0))])
    # Standard error of a weight: about 2 / sqrt(60 000) = .01; five of them.
    np.testing.assert_allclose([found.bias, *found.weights], [0.4, *weights], atol=0.05)


def test_probabilities_hold_on_held_out_scenes() -> None:
    """Textures and worlds that the fit never saw, good cameras and slightly wrong ones."""
    parts = []
    off = Conditions(rotation_deg=0.1, baseline_fraction=0.01)
    for seed, conditions in ((800_201, Conditions()), (800_202, off), (800_205, Conditions())):
        scene = make_views(seed, views=4, height=168, width=224, split="test")
        sample = sample_of_scene(scene, 4, conditions, torch.Generator().manual_seed(seed))
        parts.append(pixels_of_sample(sample, 5))
    features, error = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    probability, right = shipped_model()(features), np.abs(error) < RIGHT
    sure, unsure = probability > 0.7, probability < 0.3
    assert sure.mean() > 0.15
    assert unsure.mean() > 0.05
    # Three scenes are no sample of all: half of the gap between the groups is left to chance.
    assert right[sure].mean() > 0.65
    assert right[unsure].mean() < 0.45
    assert (np.abs(error[sure]) < np.log(1.25)).mean() > 0.95, "of confident pixels, .96 on the mean of 200 scenes"


def test_calibration_reports_bins() -> None:
    probability = np.array([0.05, 0.05, 0.95, 1.0])
    right = np.array([False, True, True, True])
    assert calibration(probability, right) == [
        (pytest.approx(0.05), pytest.approx(0.5), pytest.approx(0.5)),
        (pytest.approx(0.975), pytest.approx(1.0), pytest.approx(0.5)),
    ]


def test_agreement_and_a_supporting_plane_raise_the_odds() -> None:
    quiet = np.zeros((len(EVIDENCE_CHANNELS), 4, 4), np.float32)
    quiet[EVIDENCE_CHANNELS.index("cost")] = 0.4
    doubtful = quiet.copy()
    doubtful[EVIDENCE_CHANNELS.index("gap")] = 0.5
    doubtful[EVIDENCE_CHANNELS.index("sparse")] = 0.4
    model = shipped_model()
    agreed, alone = np.full((4, 4), 2.0), np.zeros((4, 4))
    assert model(confidence_features(quiet, agreed)).mean() > model(confidence_features(quiet, alone)).mean()
    assert model(confidence_features(quiet, agreed)).mean() > model(confidence_features(doubtful, agreed)).mean() + 0.2


def test_coefficients_are_written_as_they_are_read() -> None:
    shipped = shipped_model()
    assert json.loads(shipped.as_json()) == json.loads(
        files("sceneexpander.frontend").joinpath("confidence.json").read_text()
    )
    assert len(shipped.weights) == len(FEATURES)
    assert isinstance(shipped, ConfidenceModel)
