"""Random streams derived from a seed and a purpose, so that a new draw in one place never shifts another."""

from __future__ import annotations

import hashlib

import torch


def child_generator(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator that depends only on ``seed`` and ``purpose`` (e.g. ``"adapt/subset/17"``)."""
    digest = hashlib.sha256(f"{seed}:{purpose}".encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "big") >> 1)
