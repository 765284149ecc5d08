"""The Gaussians while they are optimised: unbounded parameters, one Adam each, and rows that come and go.

Names and shapes of the parameters are those of gsplat's strategies, which can therefore work on the same object. Three of them are never
trained and follow their rows through every change: where a Gaussian comes from (``source_view``, ``generated``), and the standard
deviation that none of its axes falls below (``narrowest``). What is trained as ``scales`` is the logarithm of the standard deviation
before that band limit (`sceneexpander.geometry.sampling`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sceneexpander.errors import UserError
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.sampling import BAND_LIMIT_PX
from sceneexpander.optimisation.config import RatesConfig

FIXED = ("source_view", "generated", "narrowest")  # parameters that are never trained
MAX_START_OPACITY = 0.99  # the logit of 1 is infinite
MIN_START_SCALE = 1e-9
ADAM_EPSILON = 1e-15
_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(slots=True, kw_only=True)
class Splats:
    """``params`` and ``optimisers`` by name; trained parameters have an optimiser of their own name."""

    params: dict[str, nn.Parameter]
    optimisers: dict[str, torch.optim.Adam]

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        rates: RatesConfig,
        *,
        extent: float,
        sh_degree: int,
        finest: Float[Tensor, " gaussian"] | None = None,
    ) -> Splats:
        """Trainable copies. Colours get coefficients up to ``sh_degree``; higher ones are dropped.

        Args:
            gaussians: where to start.
            rates: learning rates.
            extent: unit of the rate of the means, scene units.
            sh_degree: of the colours.
            finest: side of the smallest pixel that sees each Gaussian, for the band limit; None: there is none.
        """
        narrowest = torch.zeros_like(gaussians.opacities) if finest is None else BAND_LIMIT_PX * finest
        before_limit = gaussians.scales.square() - narrowest.square()[:, None]
        # What is narrower already starts at a tenth of the limit: its gradient vanishes with it.
        least = (0.1 * narrowest[:, None]).clamp(min=MIN_START_SCALE)
        coefficients = (sh_degree + 1) ** 2
        sh = torch.zeros(len(gaussians), coefficients, 3).to(gaussians.sh)
        kept = min(coefficients, gaussians.sh.shape[1])
        sh[:, :kept] = gaussians.sh[:, :kept]
        trained = {
            "means": (gaussians.means, rates.means * extent),
            "scales": (before_limit.clamp(min=0).sqrt().maximum(least).log(), rates.scales),
            "quats": (nn.functional.normalize(gaussians.quat_wxyz, dim=-1), rates.rotations),
            "opacities": (gaussians.opacities.clamp(1e-4, MAX_START_OPACITY).logit(), rates.opacities),
            "sh0": (sh[:, :1], rates.colours),
        }
        if coefficients > 1:
            trained["shN"] = (sh[:, 1:], rates.view_colours)
        fixed = {"source_view": gaussians.source_view, "generated": gaussians.generated, "narrowest": narrowest}
        params = {name: nn.Parameter(value.detach().clone()) for name, (value, _) in trained.items()}
        optimisers = {
            name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=ADAM_EPSILON, fused=True)
            for name, (_, rate) in trained.items()
        }
        params |= {name: nn.Parameter(value.clone(), requires_grad=False) for name, value in fixed.items()}
        return cls(params=params, optimisers=optimisers)

    def __len__(self) -> int:
        return int(self.params["means"].shape[0])

    @property
    def scales(self) -> Float[Tensor, "gaussian 3"]:
        """Standard deviations, scene units, none below the row's ``narrowest``."""
        return ((2 * self.params["scales"]).exp() + self.params["narrowest"].square()[:, None]).sqrt()

    @property
    def opacities(self) -> Float[Tensor, " gaussian"]:
        """In (0, 1)."""
        return self.params["opacities"].sigmoid()

    def colours(self, degree: int) -> Float[Tensor, "gaussian coefficient 3"]:
        """Spherical harmonics up to ``degree``, as far as there are any."""
        if degree == 0 or "shN" not in self.params:
            return self.params["sh0"]
        return torch.cat([self.params["sh0"], self.params["shN"][:, : (degree + 1) ** 2 - 1]], dim=1)

    def gaussians(self) -> Gaussians:
        """The present state, on the CPU."""
        parts: list[Tensor] = [self.params[name] for name in ("sh0", "shN") if name in self.params]
        return (
            Gaussians(
                means=self.params["means"],
                quat_wxyz=nn.functional.normalize(self.params["quats"], dim=-1),
                scales=self.scales,
                opacities=self.opacities,
                sh=torch.cat(parts, dim=1),
                source_view=self.params["source_view"],
                generated=self.params["generated"],
                antialiased=True,
            )
            .detach()
            .to("cpu")
        )

    def step(self) -> None:
        """One step of every optimiser, after a backward pass.

        Raises:
            UserError: a value left the range of numbers, which rates that are too high do.
        """
        for optimiser in self.optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        for name in self.optimisers:
            value = self.scales if name == "scales" else self.params[name]
            # One sum instead of a mask per value: NaN and infinity survive it.
            if not math.isfinite(float(value.detach().sum())):
                raise UserError(
                    f"{name} of the Gaussians are no longer finite", where="fit", fix="lower its learning rates"
                )

    @torch.no_grad()
    def rearrange(self, rows: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None:
        """Replace the rows by copies of old ones, optimiser state included; ``fresh`` rows start without any momentum."""
        for name, old in self.params.items():
            new = nn.Parameter(old[rows], requires_grad=old.requires_grad)
            self.params[name] = new
            if name not in self.optimisers:
                continue
            optimiser = self.optimisers[name]
            state = optimiser.state.pop(old, {})
            for moment in _MOMENTS:
                if moment in state:
                    state[moment] = state[moment][rows]
                    state[moment][fresh] = 0
            optimiser.param_groups[0]["params"] = [new]
            if state:
                optimiser.state[new] = state

    @torch.no_grad()
    def limit_band(self, finest: Float[Tensor, " gaussian"]) -> None:
        """Set anew what no axis falls below, for Gaussians that moved: see `of`."""
        self.params["narrowest"].copy_(BAND_LIMIT_PX * finest)

    @torch.no_grad()
    def edit(self, name: str, rows: Tensor, values: Tensor) -> None:
        """Overwrite some rows of a parameter."""
        self.params[name][rows] = values

    @torch.no_grad()
    def forget(self, name: str, rows: Tensor | None = None) -> None:
        """Take the momentum from some rows of a parameter, or from all."""
        state = self.optimisers[name].state.get(self.params[name], {})
        for moment in _MOMENTS:
            if moment in state:
                state[moment][slice(None) if rows is None else rows] = 0

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, as tensors."""
        found = {name: value.detach() for name, value in self.params.items()}
        for name, optimiser in self.optimisers.items():
            for key, value in optimiser.state.get(self.params[name], {}).items():
                found[f"{name}/{key}"] = value
        return found

    @torch.no_grad()
    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`; the number of rows may differ from the present one."""
        for name, old in self.params.items():
            new = nn.Parameter(state[name].to(old.device).clone(), requires_grad=old.requires_grad)
            self.params[name] = new
            if name not in self.optimisers:
                continue
            optimiser = self.optimisers[name]
            optimiser.state.pop(old, None)
            optimiser.param_groups[0]["params"] = [new]
            # Adam's fused update wants its step count beside the parameter.
            kept = {
                key: state[f"{name}/{key}"].to(old.device).clone()
                for key in ("step", *_MOMENTS)
                if f"{name}/{key}" in state
            }
            if kept:
                optimiser.state[new] = kept


def thin_gaussians(gaussians: Gaussians, limit: int, generator: torch.Generator) -> Gaussians:
    """At most ``limit`` Gaussians, drawn evenly, each enlarged so that together they cover what all did."""
    count = len(gaussians)
    if count <= limit:
        return gaussians
    rows = torch.randperm(count, generator=generator)[:limit].sort().values
    kept = gaussians.select(rows.to(gaussians.means.device))
    # On a surface the area per Gaussian grows with the inverse of their number.
    return replace(kept, scales=kept.scales * (count / limit) ** 0.5)
