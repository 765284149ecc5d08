"""The Gaussian head trained on the captured photos after Algorithm 1, as a correction of a round (beyond the paper)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sceneexpander.artifacts.state import WeightsChange
from sceneexpander.insertion.contradiction import opacity_factors
from sceneexpander.insertion.protocol import RoundContext, RoundInputs
from sceneexpander.models.protocol import Prediction
from sceneexpander.photometric.config import HeadConfig
from sceneexpander.photometric.head import fit_gaussian_head
from sceneexpander.reconstruction.views import device_priors


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianHead(HeadConfig):
    """`fit_gaussian_head` on the adapted weights; generated Gaussians fade in what it is shown where the round fades them."""

    def correct_weights(self, weights: WeightsChange, inputs: RoundInputs, context: RoundContext) -> WeightsChange:
        """The weights with the trained head; the very same ones without steps."""
        if self.steps == 0:
            return weights
        loaded, views = context.loaded, inputs.views
        images, generated = views.images.to(loaded.device), views.generated.to(loaded.device)
        priors = device_priors(inputs.joint_priors, loaded)

        def fade(prediction: Prediction) -> Tensor | None:
            if prediction.gaussians is None or prediction.depth is None:
                return None
            posed = generated.new_ones(len(generated)) if priors is None or priors.posed is None else priors.posed
            cameras = prediction.cameras_of(*images.shape[2:])
            return opacity_factors(prediction.gaussians, prediction.depth, cameras, generated, posed, images)

        loaded.apply(weights)
        fade_as_shown = fade if context.doubted else None
        fit_gaussian_head(loaded.model, images, generated, priors, self, fade=fade_as_shown, seed=context.seed)
        return WeightsChange.between(loaded.base, loaded.state())
