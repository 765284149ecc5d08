"""gsplat's own strategies behind `DensityControl`, for CUDA.

They work on the same parameters and optimisers (see `Splats`) and call what they read of a rendered picture ``info``. Random draws are
gsplat's, from torch's global CUDA generator.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from sceneexpander.errors import UserError
from sceneexpander.optimisation.config import DensityConfig
from sceneexpander.optimisation.density import Schedule, Seen
from sceneexpander.optimisation.splats import FIXED, Splats

_NEVER = 2**62


class GsplatControl:
    """One of gsplat's strategies, with the project's settings translated.

    Args:
        config: settings; ``max_gaussians`` bounds the ``mcmc`` strategy only, gsplat's default one has no cap.
        steps: of the whole optimisation.
        extent: of the scene.

    Raises:
        UserError: gsplat is not installed.
    """

    def __init__(self, config: DensityConfig, steps: int, *, extent: float) -> None:
        self._config = config
        schedule = Schedule.of(config, steps)
        self._strategy, self._state = _strategy(config, schedule, extent)
        self._info: dict[str, Any] = {}

    def penalty(self, splats: Splats) -> Tensor | float:
        """Of the MCMC strategy, whose regularisation gsplat leaves to its caller."""
        if self._config.strategy == "default":
            return 0.0
        return self._config.opacity_weight * splats.opacities.mean() + self._config.scale_weight * splats.scales.mean()

    def observe(self, splats: Splats, seen: Seen, step: int) -> None:
        """Keep the picture's facts for `change`, as gsplat names them."""
        centres = seen.centre_gradient.new_zeros((1, *seen.centre_gradient.shape))
        centres.grad = seen.centre_gradient[None]
        self._info = {
            "means2d": centres,
            "radii": seen.radius_px[None, :, None].expand(-1, -1, 2),
            "height": seen.height,
            "width": seen.width,
            "n_cameras": 1,
            "gaussian_ids": None,
        }

    def change(self, splats: Splats, step: int, *, mean_rate: float, generator: torch.Generator) -> None:
        """One step of the strategy."""
        arguments: dict[str, Any] = {
            "params": splats.params,
            "optimizers": splats.optimisers,
            "state": self._state,
            "step": step,
            "info": self._info,
        }
        if self._config.strategy == "mcmc":
            arguments["lr"] = mean_rate
        self._strategy.step_post_backward(**arguments)
        # Rows that gsplat copies become trainable by default; those that are never trained must not.
        for name in FIXED:
            splats.params[name] = nn.Parameter(splats.params[name].detach(), requires_grad=False)

    def state(self) -> dict[str, Tensor]:
        """The sums that the default strategy keeps."""
        return {name: value for name, value in self._state.items() if isinstance(value, Tensor)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        self._state.update(state)


def _strategy(config: DensityConfig, schedule: Schedule, extent: float) -> tuple[Any, dict[str, Any]]:
    try:
        from gsplat.strategy import DefaultStrategy, MCMCStrategy
    except ImportError as error:
        raise UserError("gsplat is not installed", fix="pip install 'sceneexpander[gpu]', or use device=cpu") from error
    common = {
        "refine_start_iter": schedule.first,
        "refine_stop_iter": schedule.last,
        "refine_every": schedule.every,
        "verbose": False,
    }
    if config.strategy == "mcmc":
        strategy = MCMCStrategy(
            cap_max=config.max_gaussians, noise_lr=config.noise, min_opacity=config.min_opacity, **common
        )
        return strategy, strategy.initialize_state()
    strategy = DefaultStrategy(
        prune_opa=config.min_opacity,
        grow_grad2d=config.gradient,
        grow_scale3d=config.split_above,
        prune_scale3d=config.prune_above,
        reset_every=config.reset_every or _NEVER,
        **common,
    )
    return strategy, strategy.initialize_state(scene_scale=extent)
