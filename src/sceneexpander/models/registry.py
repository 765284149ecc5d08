"""Reconstructors by name: architecture, weights and licence."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import torch

from sceneexpander.errors import UserError
from sceneexpander.models.protocol import Reconstructor
from sceneexpander.models.weights import HUB_FILE, ResolvedWeights, load_weights, resolve_weights

DEFAULT_VARIANT = "default"
_Config = TypeVar("_Config")
_Model = TypeVar("_Model")


@dataclass(frozen=True, slots=True, kw_only=True)
class BuiltReconstructor:
    """A reconstructor with its weights, and what a report says about them."""

    model: Reconstructor
    weights: ResolvedWeights
    licence: str


def _mini(variant: str, weights: ResolvedWeights) -> Reconstructor:
    from sceneexpander.models.mini import Mini

    _check_variant("mini", variant, (DEFAULT_VARIANT, "free_cameras"))
    model = Mini.from_weights(weights.path)
    if variant == "free_cameras":
        model.config = replace(model.config, camera_gain=1.0)
    return model


def _worldmirror(variant: str, weights: ResolvedWeights) -> Reconstructor:
    from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig

    configs = {
        DEFAULT_VARIANT: WorldMirrorConfig.large,
        "large": WorldMirrorConfig.large,
        "tiny": WorldMirrorConfig.tiny,
    }
    model = _on_meta("worldmirror", variant, configs, WorldMirror)
    load_weights(model, weights.path)
    return model


def _omnivggt(variant: str, weights: ResolvedWeights) -> Reconstructor:
    from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig

    configs = {
        DEFAULT_VARIANT: OmniVGGTConfig.large,
        "large": OmniVGGTConfig.large,
        "tiny": OmniVGGTConfig.tiny,
    }
    model = _on_meta("omnivggt", variant, configs, OmniVGGT)
    load_weights(model, weights.path)
    return model


def _ttt3r(variant: str, weights: ResolvedWeights) -> Reconstructor:
    from sceneexpander.models.ttt3r import TTT3R, TTT3RConfig

    configs: dict[str, Callable[[], TTT3RConfig]] = {
        DEFAULT_VARIANT: TTT3RConfig.large,
        "large": TTT3RConfig.large,
        "cut3r": partial(TTT3RConfig.large, update="cut3r"),
        "tiny": TTT3RConfig.tiny,
    }
    model = _on_meta("ttt3r", variant, configs, TTT3R)
    load_weights(model, weights.path)
    return model


def _on_meta(
    name: str, variant: str, configs: Mapping[str, Callable[[], _Config]], make: Callable[[_Config], _Model]
) -> _Model:
    """The model of a variant without memory of its own, so that loading never holds random numbers beside the weights."""
    _check_variant(name, variant, tuple(configs))
    with torch.device("meta"):
        return make(configs[variant]())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Family:
    build: Callable[[str, ResolvedWeights], Reconstructor]
    licence: str
    hub_file: str = HUB_FILE  # name of the weights in the authors' repository


_BUILDERS = {
    "mini": _Family(build=_mini, licence="Apache-2.0, made by this project"),
    "worldmirror": _Family(
        build=_worldmirror,
        licence="Tencent HunyuanWorld-Mirror community licence: not valid in the EU, the UK and South Korea; adapted weights are "
        "derivatives",
    ),
    "omnivggt": _Family(
        build=_omnivggt,
        licence="code MIT; the terms of the released weights (Livioni/OmniVGGT) are those of their own page, read them there",
        hub_file="OmniVGGT.safetensors",
    ),
    "ttt3r": _Family(
        build=_ttt3r,
        licence="weights: CUT3R, CC BY-NC-SA 4.0 (no commercial use; adapted weights under the same licence); additions of "
        "TTT3R: MIT",
    ),
}


def licence_of(name: str) -> str:
    """What a report says about using the weights of a reconstructor that `build_reconstructor` knows."""
    return _BUILDERS[name].licence


def reconstructor_names() -> tuple[str, ...]:
    """The names that `build_reconstructor` knows."""
    return tuple(_BUILDERS)


def build_reconstructor(
    name: str, *, variant: str = DEFAULT_VARIANT, weights: str, allow_download: bool = False
) -> BuiltReconstructor:
    """Build a reconstructor on the CPU and load its weights strictly.

    Args:
        name: see `reconstructor_names`.
        variant: a configuration of it; "default" is the released one.
        weights: see `sceneexpander.models.weights.resolve_weights`.
        allow_download: let a hub id use the network.

    Raises:
        UserError: unknown name or variant; weights that are missing or do not fit.
    """
    if name not in _BUILDERS:
        raise UserError(
            f"unknown reconstructor {name!r}", where="model.name", fix=_did_you_mean(name, tuple(_BUILDERS))
        )
    family = _BUILDERS[name]
    resolved = resolve_weights(weights, model=name, hub_file=family.hub_file, allow_download=allow_download)
    model = family.build(variant, resolved)
    return BuiltReconstructor(model=model, weights=resolved, licence=family.licence)


def _check_variant(model: str, variant: str, known: tuple[str, ...]) -> None:
    if variant not in known:
        raise UserError(
            f"unknown variant {variant!r} of {model}", where="model.variant", fix=_did_you_mean(variant, known)
        )


def _did_you_mean(text: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(text, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
