"""How the set of Gaussians changes during the optimisation, on any device; on CUDA gsplat's own strategies are used instead.

`CloneAndSplit` follows Kerbl et al. 2023: where the loss pulls the projected centres strongly, small Gaussians are cloned and large ones
split; nearly transparent ones go; all opacities are lowered now and then. `Relocation` follows Kheradmand et al. 2024 (3DGS-MCMC): dead
Gaussians move to live ones so that the picture stays, the set grows to a cap, and positions get noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.optimisation.config import DensityConfig
from sceneexpander.optimisation.splats import Splats

SPLIT_SHRINK = 1.6
MAX_COPIES = 51  # of one Gaussian in a relocation
_RESET_SHARE = 2.0  # opacities are lowered to this multiple of the smallest useful one
_MAX_OPACITY = 1 - 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What one step's picture tells about the Gaussians."""

    centre_gradient: Float[Tensor, "gaussian 2"]  # of the loss in the projected centres, per pixel
    radius_px: Float[Tensor, " gaussian"]  # 0 where not seen
    height: int
    width: int


class DensityControl(Protocol):
    """Called once in every step, first with the gradients and then after the parameters moved."""

    def penalty(self, splats: Splats) -> Tensor | float:
        """An addition to the loss."""
        ...

    def observe(self, splats: Splats, seen: Seen, step: int) -> None:
        """Gather what the next change is decided by; ``step`` counts from 1."""
        ...

    def change(self, splats: Splats, step: int, *, mean_rate: float, generator: torch.Generator) -> None:
        """Change the set, if it is time. ``mean_rate`` is the present learning rate of the means."""
        ...

    def state(self) -> dict[str, Tensor]:
        """What is remembered between steps."""
        ...

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """The steps at which the set changes."""

    first: int
    last: int
    every: int

    @classmethod
    def of(cls, config: DensityConfig, steps: int) -> Schedule:
        """In steps instead of shares."""
        return cls(first=math.floor(config.start * steps), last=math.floor(config.stop * steps), every=config.every)

    def due(self, step: int) -> bool:
        """Whether the set changes after this step."""
        return self.first < step <= self.last and step % self.every == 0


class CloneAndSplit:
    """The default densification, with a cap: if there is not room for all, the places that are pulled hardest come first."""

    def __init__(self, config: DensityConfig, steps: int, *, extent: float) -> None:
        self._config, self._extent = config, extent
        self._schedule = Schedule.of(config, steps)
        self._pull = torch.zeros(0)
        self._count = torch.zeros(0)

    def penalty(self, splats: Splats) -> float:
        """None."""
        return 0.0

    @torch.no_grad()
    def observe(self, splats: Splats, seen: Seen, step: int) -> None:
        """Sum the pulls of the pictures that see a Gaussian."""
        if step > self._schedule.last:
            return
        if len(self._pull) != len(splats):
            self._pull = torch.zeros(len(splats), device=seen.radius_px.device)
            self._count = torch.zeros_like(self._pull)
        visible = (seen.radius_px > 0).to(self._pull)
        half_image = seen.centre_gradient.new_tensor([seen.width / 2, seen.height / 2])
        self._pull += (seen.centre_gradient * half_image).norm(dim=-1) * visible
        self._count += visible

    @torch.no_grad()
    def change(self, splats: Splats, step: int, *, mean_rate: float, generator: torch.Generator) -> None:
        """Clone, split and prune; lower all opacities at their own interval."""
        if self._schedule.due(step):
            self._densify(splats, step, generator)
            self._pull = torch.zeros(0)
        every = self._config.reset_every
        if every and step % every == 0 and step <= self._schedule.last:
            ceiling = torch.logit(torch.tensor(_RESET_SHARE * self._config.min_opacity))
            splats.params["opacities"].clamp_(max=float(ceiling))
            splats.forget("opacities")

    def _densify(self, splats: Splats, step: int, generator: torch.Generator) -> None:
        config = self._config
        size = splats.scales.max(-1).values
        keep = splats.opacities >= config.min_opacity
        if config.reset_every and step > config.reset_every:
            keep &= size <= config.prune_above * self._extent
        pull = self._pull / self._count.clamp(min=1)
        wanted = (pull > config.gradient) & keep
        room = max(config.max_gaussians - int(keep.sum()), 0)
        if int(wanted.sum()) > room:
            ranked = torch.where(wanted, pull, torch.full_like(pull, -1)).argsort(descending=True, stable=True)
            wanted = torch.zeros_like(wanted)
            wanted[ranked[:room]] = True
        small = size <= config.split_above * self._extent
        clone, split = wanted & small, wanted & ~small
        stay = (keep & ~split).nonzero()[:, 0]
        cloned, halved = clone.nonzero()[:, 0], split.nonzero()[:, 0].repeat(2)
        rows = torch.cat([stay, cloned, halved])
        fresh = torch.arange(len(rows), device=rows.device) >= len(stay)
        splats.rearrange(rows, fresh)
        halves = torch.arange(len(stay) + len(cloned), len(rows), device=rows.device)
        if len(halves):
            offsets = _samples(splats, halves, generator)
            splats.edit("means", halves, splats.params["means"][halves] + offsets)
            splats.edit("scales", halves, splats.params["scales"][halves] - math.log(SPLIT_SHRINK))

    def state(self) -> dict[str, Tensor]:
        """The sums since the last change."""
        return {"pull": self._pull, "count": self._count}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        self._pull, self._count = state["pull"].clone(), state["count"].clone()


class Relocation:
    """3DGS-MCMC."""

    def __init__(self, config: DensityConfig, steps: int) -> None:
        self._config = config
        self._schedule = Schedule.of(config, steps)

    def penalty(self, splats: Splats) -> Tensor:
        """Small Gaussians of little opacity are preferred: what is not needed dies and can move."""
        config = self._config
        return config.opacity_weight * splats.opacities.mean() + config.scale_weight * splats.scales.mean()

    def observe(self, splats: Splats, seen: Seen, step: int) -> None:
        """Nothing to gather."""

    @torch.no_grad()
    def change(self, splats: Splats, step: int, *, mean_rate: float, generator: torch.Generator) -> None:
        """Move the dead, grow, and add noise, which is strongest for what is nearly transparent."""
        if self._schedule.due(step):
            self._move_dead(splats, generator)
            self._grow(splats, generator)
        transparency = torch.sigmoid(100 * ((1 - splats.opacities) - 0.995))
        strength = (mean_rate * self._config.noise * transparency)[:, None]
        everything = torch.arange(len(splats), device=strength.device)
        # The covariance itself, not its root: noise stays within the Gaussian's own shape.
        turn = rotation_from_quat_wxyz(splats.params["quats"])
        draw = _normal((len(splats), 3), generator, like=strength)
        along = torch.einsum("gji,gj->gi", turn, draw) * splats.scales.square()
        splats.edit("means", everything, splats.params["means"] + torch.einsum("gij,gj->gi", turn, along) * strength)

    def _move_dead(self, splats: Splats, generator: torch.Generator) -> None:
        dead = splats.opacities <= self._config.min_opacity
        alive = (~dead).nonzero()[:, 0]
        lost = dead.nonzero()[:, 0]
        if not len(lost) or not len(alive):
            return
        chosen = _draw(splats.opacities[alive], len(lost), alive, generator)
        rows = torch.arange(len(splats), device=lost.device)
        rows[lost] = chosen
        fresh = dead.clone()
        fresh[chosen] = True
        self._share(splats, rows, fresh)

    def _grow(self, splats: Splats, generator: torch.Generator) -> None:
        count = len(splats)
        more = min(self._config.max_gaussians, int(count * (1 + self._config.growth))) - count
        if more <= 0:
            return
        everything = torch.arange(count, device=splats.params["means"].device)
        chosen = _draw(splats.opacities, more, everything, generator)
        rows = torch.cat([everything, chosen])
        fresh = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        fresh[chosen], fresh[count:] = True, True
        self._share(splats, rows, fresh)

    def _share(self, splats: Splats, rows: Tensor, fresh: Tensor) -> None:
        """Take copies and let each row and its copies share what the one Gaussian showed."""
        copies = torch.bincount(rows, minlength=len(splats))[rows]
        opacity, factor = shared_appearance(splats.opacities[rows], copies)
        splats.rearrange(rows, fresh)
        many = (copies > 1).nonzero()[:, 0]
        lowest = self._config.min_opacity
        splats.edit("opacities", many, opacity[many].clamp(lowest, _MAX_OPACITY).logit())
        splats.edit("scales", many, splats.params["scales"][many] + factor[many].log()[:, None])

    def state(self) -> dict[str, Tensor]:
        """Nothing is remembered."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Nothing is remembered."""


def shared_appearance(
    opacity: Float[Tensor, " gaussian"], copies: Tensor
) -> tuple[Float[Tensor, " gaussian"], Float[Tensor, " gaussian"]]:
    """(opacity, factor on the scales) of each of N copies in one place that together look like one Gaussian.

    Eq. 9 of Kheradmand et al.: 1 - (1 - o')^N = o in the centre, and equal total light along a line. Their double sum over i <= N and
    k < i of binomial(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1) is, summed over i first, the single one used here.
    """
    number = copies.clamp(1, MAX_COPIES).double()
    each = 1 - (1 - opacity.double().clamp(max=_MAX_OPACITY)) ** (1 / number)
    total = torch.zeros_like(each)
    term = torch.ones_like(each)  # binomial(N, j) o'^j, with the sign of (-1)^(j-1) below
    for j in range(1, int(number.max()) + 1):
        term = term * (number - (j - 1)).clamp(min=0) / j * each
        total += term * (1 if j % 2 else -1) / math.sqrt(j)
    factor = opacity.double() / total.clamp(min=1e-12)
    return each.to(opacity), factor.to(opacity)


def _draw(weights: Tensor, count: int, rows: Tensor, generator: torch.Generator) -> Tensor:
    """``count`` of the rows with replacement, by weight."""
    share = weights.double().cumsum(0).cpu()
    places = torch.rand(count, generator=generator, dtype=torch.float64) * share[-1]
    return rows[torch.searchsorted(share, places).clamp(max=len(share) - 1).to(rows.device)]


def _samples(splats: Splats, rows: Tensor, generator: torch.Generator) -> Float[Tensor, "row 3"]:
    """Offsets drawn from the Gaussians themselves."""
    scaled = splats.scales[rows] * _normal((len(rows), 3), generator, like=splats.scales)
    turn = rotation_from_quat_wxyz(nn.functional.normalize(splats.params["quats"][rows], dim=-1))
    return torch.einsum("gij,gj->gi", turn, scaled)


def _normal(shape: tuple[int, ...], generator: torch.Generator, *, like: Tensor) -> Tensor:
    # Drawn on the CPU on every device: the same seed gives the same numbers.
    return torch.randn(shape, generator=generator).to(like)
