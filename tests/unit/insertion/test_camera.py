"""Which of two estimates a round takes: the one that shows the captured photos better, whichever that is."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.expansion import ModelConfig, RoundInputs, load_model
from sceneexpander.geometry.priors import Priors
from sceneexpander.insertion.camera import realign_priors
from sceneexpander.insertion.realign import Realign
from tests.worlds.realigned import VIEWS
from tests.worlds.view_sets import view_set


def test_the_estimate_that_shows_the_photos_better_is_taken(world: tuple[Priors, Anchors, torch.Tensor]) -> None:
    true, anchors, images = world
    assert true.depth is not None
    bent = true.depth.clone()
    bent[1] *= 0.7  # the second captured view, in front of where it is
    wrong = replace(true, depth=bent)
    loaded = load_model(ModelConfig())
    source = Provenance(backend="replay", prompt="", source="x", sha256="0")

    def taken(captured: Priors, joint: Priors) -> Priors:
        state = ExpansionState(
            views=view_set(images[:VIEWS], generated=False),
            priors=captured.select(range(VIEWS)),
            weights=WeightsChange.between(loaded.base, loaded.base),
        )
        inserted = InsertedView(round=1, view=view_set(images[VIEWS:], generated=True), chosen=0, provenance=(source,))
        inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=joint)
        return realign_priors(inputs, loaded, Realign.CHOOSE, seed=0)[0]

    kept = taken(captured=true, joint=wrong)
    assert kept.depth is not None
    assert torch.allclose(kept.depth[1], true.depth[1])
    assert taken(captured=wrong, joint=true) is true
