"""Weights by a rule instead of a file: every tensor from a random stream named by the tensor, the same with every library and version."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn


def seeded_tensor(name: str, shape: tuple[int, ...]) -> Tensor:
    """Sizeable values for a parameter of this name: every part of a network matters, and none drowns the rest."""
    uniform = np.random.RandomState(zlib.crc32(name.encode())).uniform(-1, 1, shape)  # a stream that NumPy has frozen
    if len(shape) >= 2 and "token" not in name and "embed" not in name and "mem" not in name:
        fan_in = float(np.prod(shape[1:]))
        values = np.sqrt(3 / fan_in) * uniform
    elif name.endswith(("norm.weight", "norm1.weight", "norm2.weight", "norm3.weight", "gamma")):
        values = 1 + 0.2 * uniform
    else:
        values = 0.3 * uniform
    return torch.from_numpy(values.astype(np.float32))


def write_seeded_weights(model: nn.Module, path: Path) -> None:
    """A weights file for a model, which may be on the meta device. Buffers get their seeded values, too."""
    tensors = {name: seeded_tensor(name, tuple(value.shape)) for name, value in model.state_dict().items()}
    save_file(tensors, path)
