"""Methods put together from their sections, all corrections off unless said."""

from __future__ import annotations

from typing import Any

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.expansion import CorrectionsConfig, MethodConfig, Procedure, compose_procedure
from sceneexpander.photometric.config import RefineConfig

UNFITTED = RefineConfig(visits=0)


def make_method(adapt: AdaptConfig | None = None, **sections: Any) -> MethodConfig:
    """Algorithm 1, by default the paper's, with these sections of the corrections."""
    return MethodConfig(adapt=adapt or AdaptConfig(), corrections=CorrectionsConfig(**sections))


def make_procedure(adapt: AdaptConfig, fit: RefineConfig = UNFITTED, **sections: Any) -> Procedure:
    """The procedure of `make_method`; by default its Gaussians stay as the model made them."""
    return compose_procedure(make_method(adapt, **sections), fit)
