"""gsplat's strategies on our parameters. They are plain torch up to the relocation itself, which needs CUDA."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.optimisation.config import DensityConfig
from sceneexpander.optimisation.density import CloneAndSplit
from tests.worlds.few_splats import CONFIG, five, generator, moved, seen, splats_of


def test_without_gsplat_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from sceneexpander.optimisation.gsplat_density import GsplatControl

    monkeypatch.setitem(sys.modules, "gsplat.strategy", None)
    with pytest.raises(UserError, match="gsplat is not installed; pip install"):
        GsplatControl(DensityConfig(), 100, extent=1.0)


def test_gsplats_default_strategy_makes_the_same_decisions_as_ours() -> None:
    pytest.importorskip("gsplat")
    from sceneexpander.optimisation.gsplat_density import GsplatControl

    config = replace(CONFIG, reset_every=0)
    pull = torch.tensor([1.0, 1.0, 0.01, 0.01, 0.01])
    results = []
    for control in (CloneAndSplit(config, 10, extent=1.0), GsplatControl(config, 10, extent=1.0)):
        splats = splats_of(five())
        moved(splats)
        control.observe(splats, seen(pull), 2)
        control.change(splats, 2, mean_rate=0.0, generator=generator())
        moved(splats)
        results.append(splats.gaussians())
    ours, theirs = results
    assert sorted(ours.source_view.tolist()) == sorted(theirs.source_view.tolist())
    assert sorted(ours.generated.tolist()) == sorted(theirs.generated.tolist())


def test_gsplats_state_survives_a_resume_point() -> None:
    pytest.importorskip("gsplat")
    from sceneexpander.optimisation.gsplat_density import GsplatControl

    config = replace(CONFIG, every=2, reset_every=0)
    whole, first = GsplatControl(config, 10, extent=1.0), GsplatControl(config, 10, extent=1.0)
    splats = splats_of(five())
    pull = torch.tensor([1.0, 0.01, 0.01, 1.0, 1.0])
    for control in (whole, first):
        control.observe(splats, seen(pull), 1)
        control.change(splats, 1, mean_rate=0.0, generator=generator())
    resumed = GsplatControl(config, 10, extent=1.0)
    resumed.restore(first.state())
    assert set(resumed.state()) == set(whole.state())
    for name, value in whole.state().items():
        assert torch.equal(resumed.state()[name], value)
