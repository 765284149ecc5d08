"""AdamW on one flat run of weights, its moments in float32 or in eight bits."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.optim.adamw import adamw

from sceneexpander.adaptation.config import MomentsForm

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8  # AdamW's own defaults; the paper does not state them
BLOCK = 128  # elements that share a scale in eight bits
FIRST_ROOT, SECOND_ROOT = 3, 6  # of the values that bytes hold: moments span many orders of magnitude within a block


class Moments(Protocol):
    """First and second moments of a flat run of weights, and the update that they give."""

    def update(self, weights: Tensor, gradient: Tensor, *, rate: float, decay: float) -> None:
        """One AdamW step on ``weights`` in place; ``decay`` is the decoupled weight decay."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Everything the next update depends on, by name."""
        ...

    def load(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        ...

    def part(self, index: Tensor, *, seed: int) -> Moments:
        """The moments of some of the weights, which go on apart from the others."""
        ...


def make_moments(form: MomentsForm, weights: Tensor, *, seed: int) -> Moments:
    """Moments of zero for ``weights``; ``seed`` is that of the rounding in eight bits."""
    if form is MomentsForm.FP32:
        return FullMoments(weights)
    return ByteMoments(weights, seed=seed)


class FullMoments:
    """Moments in float32, updated by torch's fused kernel: one pass over weights, gradient and moments."""

    def __init__(self, weights: Tensor) -> None:
        self.first = torch.zeros_like(weights)
        self.second = torch.zeros_like(weights)
        self.steps = torch.zeros((), dtype=torch.float32, device=weights.device)

    def update(self, weights: Tensor, gradient: Tensor, *, rate: float, decay: float) -> None:
        """See `Moments.update`."""
        _fused_adamw(weights, gradient, self.first, self.second, self.steps, rate=rate, decay=decay)

    def state(self) -> dict[str, Tensor]:
        """See `Moments.state`."""
        return {"first": self.first, "second": self.second, "steps": self.steps}

    def load(self, state: dict[str, Tensor]) -> None:
        """See `Moments.load`."""
        for name, value in self.state().items():
            value.copy_(state[name])

    def part(self, index: Tensor, *, seed: int) -> FullMoments:
        """See `Moments.part`."""
        made = FullMoments(self.first[index])
        made.first, made.second, made.steps = self.first[index], self.second[index], self.steps.clone()
        return made


class ByteMoments:
    """Moments in one byte per weight and a scale per `BLOCK` weights: a quarter of the memory.

    Bytes hold a root of the value relative to the block's largest. Rounding is random: the second moment changes by a thousandth
    per step, less than the distance of two bytes, and would otherwise never move. Its own seeded stream makes runs repeat.
    """

    def __init__(self, weights: Tensor, *, seed: int) -> None:
        count = weights.numel()
        blocks = -(-count // BLOCK)
        self.count = count
        self.first = torch.zeros(blocks * BLOCK, dtype=torch.int8, device=weights.device)
        self.second = torch.zeros(blocks * BLOCK, dtype=torch.uint8, device=weights.device)
        self.first_scale = torch.zeros(blocks, device=weights.device)
        self.second_scale = torch.zeros(blocks, device=weights.device)
        self.steps = torch.zeros((), dtype=torch.float32, device=weights.device)
        self.seed = seed
        self.done = 0  # the same number on the host: the stream of the rounding depends on it

    def update(self, weights: Tensor, gradient: Tensor, *, rate: float, decay: float) -> None:
        """See `Moments.update`."""
        first = _expand(self.first, self.first_scale, FIRST_ROOT)[: self.count]
        second = _expand(self.second, self.second_scale, SECOND_ROOT)[: self.count]
        _fused_adamw(weights, gradient, first, second, self.steps, rate=rate, decay=decay)
        self.done += 1
        generator = torch.Generator(weights.device).manual_seed((self.seed + self.done) % 2**63)
        self.first_scale = _compress(first, self.first, FIRST_ROOT, generator)
        self.second_scale = _compress(second, self.second, SECOND_ROOT, generator)

    def state(self) -> dict[str, Tensor]:
        """See `Moments.state`."""
        names = ("first", "second", "first_scale", "second_scale", "steps")
        return {name: getattr(self, name) for name in names}

    def load(self, state: dict[str, Tensor]) -> None:
        """See `Moments.load`."""
        for name, value in self.state().items():
            value.copy_(state[name])
        self.done = int(self.steps)

    def part(self, index: Tensor, *, seed: int) -> ByteMoments:
        """See `Moments.part`. Other weights share the scales now, so the bytes are rounded once more."""
        first = _expand(self.first, self.first_scale, FIRST_ROOT)[: self.count][index]
        second = _expand(self.second, self.second_scale, SECOND_ROOT)[: self.count][index]
        made = ByteMoments(first, seed=seed)
        made.steps, made.done = self.steps.clone(), self.done
        generator = torch.Generator(first.device).manual_seed((seed + made.done) % 2**63)
        made.first_scale = _compress(first, made.first, FIRST_ROOT, generator)
        made.second_scale = _compress(second, made.second, SECOND_ROOT, generator)
        return made


def _fused_adamw(
    weights: Tensor, gradient: Tensor, first: Tensor, second: Tensor, steps: Tensor, *, rate: float, decay: float
) -> None:
    adamw(
        [weights],
        [gradient],
        [first],
        [second],
        [],
        [steps],
        fused=True,
        amsgrad=False,
        beta1=BETA1,
        beta2=BETA2,
        lr=rate,
        weight_decay=decay,
        eps=EPSILON,
        maximize=False,
    )


def _expand(codes: Tensor, scale: Tensor, power: int) -> Tensor:
    """Values of bytes: sign x |code / largest code| ** power x scale of the block."""
    root = codes.view(-1, BLOCK).to(torch.float32) / torch.iinfo(codes.dtype).max
    return (torch.copysign(root.abs() ** power, root) * scale[:, None]).flatten()


def _compress(values: Tensor, codes: Tensor, power: int, generator: torch.Generator) -> Tensor:
    """Write ``values`` into ``codes``, rounded at random so that the value is right on average; returns the scales."""
    padded = torch.nn.functional.pad(values, (0, codes.numel() - values.numel())).view(-1, BLOCK)
    scale = padded.abs().amax(1)
    share = padded.abs() / scale.clamp(min=torch.finfo(torch.float32).tiny)[:, None]
    largest = torch.iinfo(codes.dtype).max
    below = (share ** (1 / power) * largest).floor_().clamp_(max=largest - 1)
    low, high = (below / largest) ** power, ((below + 1) / largest) ** power
    chance = (share - low) / (high - low)
    rounded = below + (torch.rand(share.shape, generator=generator, device=share.device) < chance)
    if codes.dtype == torch.uint8:
        # A second moment of nothing would make the step of a weight with a gradient endless.
        rounded.clamp_(min=1)
    rounded = torch.where(share > 0, rounded, 0.0)
    codes.copy_(torch.copysign(rounded, padded).flatten())
    return scale
