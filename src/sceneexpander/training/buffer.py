"""A rolling buffer of samples on disk: one process fills it, the trainer draws from it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

import torch

from sceneexpander.errors import UserError
from sceneexpander.training.generate import GeneratorConfig, training_sample
from sceneexpander.training.sample import Sample

_LOG = logging.getLogger(__name__)


def sample_path(folder: Path, index: int) -> Path:
    """Where sample number ``index`` lies."""
    return folder / f"{index:08d}.safetensors"


def samples_folder(path: Path) -> Path:
    """The folder, made where it is missing. Raises `UserError` where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"is no folder for samples: {error.strerror}", where=str(path), fix="name another one"
        ) from error
    return path


def stored_indices(folder: Path) -> list[int]:
    """Numbers of the samples that are there, ascending."""
    return sorted(int(path.stem) for path in folder.glob("????????.safetensors"))


def fill_buffer(
    folder: Path,
    config: GeneratorConfig,
    seed: int,
    *,
    capacity: int,
    keep_going: Callable[[], bool] = lambda: True,
) -> None:
    """Add samples after the newest one until ``keep_going`` says no; beyond ``capacity`` the oldest is deleted."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    stored = stored_indices(folder)
    index = stored[-1] + 1 if stored else 0
    while keep_going():
        begin = time.monotonic()
        sample = training_sample(index, seed, config)
        sample.save(sample_path(folder, index))
        _LOG.info("sample %d: %s, %d views, %.1f s", index, sample.kind, sample.inputs, time.monotonic() - begin)
        index += 1
        for old in stored_indices(folder)[:-capacity]:
            sample_path(folder, old).unlink(missing_ok=True)


class BufferReader:
    """Draws samples, each about ``uses`` times, the least used ones first; repeats rather than waits.

    Args:
        folder: the buffer.
        uses: how often a sample is drawn before fresher ones are preferred.
        generator: order of the draws.
    """

    def __init__(self, folder: Path, uses: int, generator: torch.Generator) -> None:
        self.folder = folder
        self.uses = uses
        self.generator = generator
        self.used: dict[int, int] = {}

    def draw(self) -> Sample:
        """A sample drawn at random among those used less than ``uses`` times (all of them, if there is none).

        Raises:
            FileNotFoundError: the buffer is empty.
        """
        for _ in range(20):
            stored = stored_indices(self.folder)
            if not stored:
                break
            self.used = {index: self.used.get(index, 0) for index in stored}
            fresh = [index for index in stored if self.used[index] < self.uses] or stored
            index = fresh[int(torch.randint(len(fresh), (), generator=self.generator))]
            self.used[index] += 1
            try:
                return Sample.load(sample_path(self.folder, index))
            except FileNotFoundError:  # the filler has just retired it
                continue
        raise FileNotFoundError(f"no samples in {self.folder}")
