"""The keypoints and matches of a scene's photos as an artefact, for the stages that meet the photos again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sceneexpander.artifacts.store import (
    RERUN,
    TENSORS_NAME,
    ArtifactError,
    load_artifact,
    require_tensor,
    save_artifact,
)
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.learned import LearnedKeypoints
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.memory import MatchMemory

SCHEMA = "matches/1"
_Entry = dict[str, tuple[torch.dtype, tuple[int, ...]]]
_MATCHES: _Entry = {"index_a": (torch.int64, (-1,)), "index_b": (torch.int64, (-1,)), "ratio": (torch.float64, (-1,))}
# Of each table what an entry holds: number type and shape, -1 for any length.
_ENTRIES: dict[str, _Entry] = {
    "features": {"pixel_xy": (torch.float64, (-1, 2)), "descriptors": (torch.float32, (-1, 128))},
    "described": _MATCHES,
    "keypoints": {
        "keypoints": (torch.float32, (-1, 2)),
        "descriptors": (torch.float32, (-1, 64)),
        "size_wh": (torch.int64, (2,)),
        "pixel_xy": (torch.float64, (-1, 2)),
    },
    "learned": _MATCHES,
}


def save_memory(folder: Path, memory: MatchMemory) -> None:
    """Write into a (scratch) folder."""
    tensors = {
        f"{table}/{key}/{name}": torch.as_tensor(getattr(entry, name))
        for table, names in _ENTRIES.items()
        for key, entry in getattr(memory, table).items()
        for name in names
    }
    save_artifact(folder, SCHEMA, {}, tensors)


def load_memory(folder: Path) -> MatchMemory:
    """Read what `save_memory` wrote. Raises `ArtifactError` if it is missing or damaged."""
    _, tensors = load_artifact(folder, SCHEMA)
    memory = MatchMemory()
    for table, key in sorted({tuple(name.split("/")[:2]) for name in tensors if name.count("/") == 2}):
        if table not in _ENTRIES:
            raise ArtifactError(f"holds {table!r}, which is no table", where=folder / TENSORS_NAME, fix=RERUN)
        values = {
            name: _read(tensors, f"{table}/{key}/{name}", *kind, folder) for name, kind in _ENTRIES[table].items()
        }
        getattr(memory, table)[key] = _entry(table, values)
    return memory


def _read(tensors: dict[str, Tensor], name: str, dtype: torch.dtype, shape: tuple[int, ...], folder: Path) -> Tensor:
    value = require_tensor(tensors, name, folder)
    fits = value.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, value.shape, strict=True))
    if value.dtype != dtype or not fits:
        problem = f"tensor {name!r} is {tuple(value.shape)} of {value.dtype}, expected {shape} of {dtype}"
        raise ArtifactError(problem, where=folder / TENSORS_NAME, fix=RERUN)
    return value


def _entry(table: str, values: dict[str, Tensor]) -> Any:
    arrays = {name: value.numpy() for name, value in values.items()}
    if table == "features":
        return Features(**arrays)
    if table != "keypoints":
        return Matches(**arrays)
    width, height = values["size_wh"].tolist()
    return LearnedKeypoints(
        keypoints=values["keypoints"],
        descriptors=values["descriptors"],
        size_wh=(width, height),
        pixel_xy=arrays["pixel_xy"],
    )
