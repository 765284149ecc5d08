"""A reconstructor in memory with the weights it was released with, and changes of them applied and taken back."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from sceneexpander.artifacts.state import WeightsChange
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.models.protocol import Reconstructor, as_module
from sceneexpander.models.registry import build_reconstructor


class PriorsUse(StrEnum):
    """Whether the geometric front-end's estimate is given to the model: as the model needs it, or always."""

    AUTO = "auto"
    FRONT_END = "front_end"


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """Which reconstructor, in which configuration, with which weights."""

    name: str = "mini"
    variant: str = "default"  # e.g. "large" for WorldMirror's released configuration
    weights: str = "builtin"  # "builtin", a .safetensors path, or a hub id with revision: org/name@revision
    allow_download: bool = False
    priors: PriorsUse = PriorsUse.AUTO


@dataclass(slots=True, kw_only=True)
class LoadedModel:
    """``base`` are the weights as released; the model itself holds whatever was applied last."""

    model: Reconstructor
    base: dict[str, Tensor]
    weights_sha256: str  # of the weights file
    licence: str
    device: torch.device
    priors: PriorsUse = PriorsUse.AUTO

    @property
    def uses_front_end(self) -> bool:
        """Whether the front-end runs for this model."""
        return self.model.requires_priors or self.priors is PriorsUse.FRONT_END

    def state(self) -> dict[str, Tensor]:
        """The weights the model holds now."""
        return dict(as_module(self.model).state_dict())

    def reset(self) -> None:
        """Put the released weights back."""
        as_module(self.model).load_state_dict(self.base)

    def apply(self, weights: WeightsChange) -> None:
        """Give the model the released weights plus a change. Raises `ArtifactError` if the change belongs to other weights."""
        as_module(self.model).load_state_dict(weights.applied_to(self.base))

    def fingerprint(self, weights: WeightsChange) -> str:
        """Hash that identifies released weights plus change."""
        return sha256_of_tensors({f"change/{k}": v for k, v in weights.change.items()} | {"base": _as_bytes(weights)})


def _as_bytes(weights: WeightsChange) -> Tensor:
    return torch.tensor(list(bytes.fromhex(weights.base_sha256)), dtype=torch.uint8)


def load_model(config: ModelConfig, device: torch.device | str = "cpu") -> LoadedModel:
    """Build the configured reconstructor and load its weights strictly.

    Raises:
        UserError: unknown model or variant, or weights that are missing or do not fit.
    """
    target = torch.device(device)
    built = build_reconstructor(
        config.name, variant=config.variant, weights=config.weights, allow_download=config.allow_download
    )
    module = as_module(built.model).to(target)
    # On the host: a second copy of large weights has no place on a GPU.
    base = {name: value.detach().to("cpu", copy=True) for name, value in module.state_dict().items()}
    return LoadedModel(
        model=built.model,
        base=base,
        weights_sha256=built.weights.sha256,
        licence=built.licence,
        device=target,
        priors=config.priors,
    )
