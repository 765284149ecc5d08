"""Training the Gaussian head alone: only it moves, only photos are targets, and a head that does not help is taken back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.photometric.config import HeadConfig
from sceneexpander.photometric.head import fit_gaussian_head, head_parameters
from tests.support.tiny_model import TinyReconstructor, tiny_images

CONFIG = HeadConfig(steps=6, learning_rate=3e-2)
GENERATED = torch.tensor([False, False, True])


def fitted(images: torch.Tensor, config: HeadConfig = CONFIG, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights after the fit."""
    model = TinyReconstructor()
    report = fit_gaussian_head(model, images, GENERATED, None, config, seed=seed)
    assert report is not None
    assert all(p.requires_grad for p in model.parameters())
    return {name: value.detach().clone() for name, value in model.state_dict().items()}


def test_the_head_is_found_by_what_it_reaches() -> None:
    model = TinyReconstructor()
    found = {id(p) for p in head_parameters(model, tiny_images(1), None)}
    assert found == {id(p) for p in model.gaussian_head.parameters()}
    assert sum(p.numel() for p in head_parameters(model, tiny_images(1), None)) == 9


def test_only_the_head_moves_and_the_error_falls() -> None:
    images = tiny_images(3)
    start = TinyReconstructor().state_dict()
    after = fitted(images)
    changed = {name.split(".")[0] for name in start if not torch.equal(start[name], after[name])}
    assert changed == {"gaussian_head"}
    report = fit_gaussian_head(TinyReconstructor(), images, GENERATED, None, CONFIG, seed=0)
    assert report is not None
    assert report.accepted
    assert report.after < report.before
    assert report.steps == CONFIG.steps


def test_the_same_seed_gives_the_same_bits() -> None:
    images = tiny_images(3)
    first, second = fitted(images), fitted(images)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_head_that_does_not_help_is_taken_back() -> None:
    model = TinyReconstructor()
    start = {name: value.clone() for name, value in model.state_dict().items()}
    report = fit_gaussian_head(
        model, tiny_images(3), GENERATED, None, replace(CONFIG, learning_rate=1.0, steps=1), seed=0
    )
    assert report is not None
    if not report.accepted:
        assert all(torch.equal(start[name], value) for name, value in model.state_dict().items())
    else:
        pytest.fail("a step of this size was expected to do harm")


def test_no_steps_no_change() -> None:
    model = TinyReconstructor()
    assert fit_gaussian_head(model, tiny_images(3), GENERATED, None, replace(CONFIG, steps=0), seed=0) is None
