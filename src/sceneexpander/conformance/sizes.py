"""The part of a recorded configuration that WorldMirror and OmniVGGT cases write alike."""

from __future__ import annotations

from typing import Any


def backbone_sizes(public: dict[str, Any], encoder: dict[str, Any], trunk: dict[str, Any]) -> dict[str, Any]:
    """Fields of `BackboneConfig` from the recorded constructor arguments of model, image encoder and trunk."""
    return {
        "image_size": public["img_size"],
        "patch": public["patch_size"],
        "dim": public["embed_dim"],
        "encoder_depth": encoder["depth"],
        "encoder_heads": encoder["num_heads"],
        "trunk_depth": trunk["depth"],
        "trunk_heads": trunk["num_heads"],
        "registers": trunk["num_register_tokens"],
        "rope_base": float(trunk["rope_freq"]),
    }
