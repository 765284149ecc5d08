"""Which frames of a method's video the judge is shown. The rule is the same for all methods, and looks at cameras only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.services.pictures import SentPicture, encode_picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Frames of one method's video in the order of time. Nothing that is sent says whose they are."""

    method: str
    frames: tuple[int, ...]
    pictures: tuple[SentPicture, ...]


def shown_of(folder: Path, *, count: int, long_side_px: int) -> Shown:
    """The frames of the `Renders` in ``folder`` that are shown, at most ``long_side_px`` long.

    Raises:
        ArtifactError: an artefact is missing or damaged, or the video has fewer frames than it should.
    """
    renders = Renders.load(folder)
    frames = choose_frames(renders.world_from_cam, renders.inserted_frame, count)
    pixels = read_frames(folder / renders.videos["rgb"], frames)
    pictures = tuple(encode_picture(frame, long_side_px=long_side_px) for frame in pixels)
    return Shown(method=renders.method, frames=frames, pictures=pictures)


def choose_frames(world_from_cam: Float[Tensor, "frame 4 4"], inserted_frame: int, count: int) -> tuple[int, ...]:
    """``count`` frames evenly spread over the path from its first to its last camera, and the one at the inserted camera.

    A path that comes back the way it went (the tour) is shown on the way there: the same cameras twice would show nothing more.
    """
    frames = len(world_from_cam)
    last = frames - 1
    step = (world_from_cam[1:] - world_from_cam[:-1]).flatten(1).norm(dim=1).max()
    there_and_back = (world_from_cam - world_from_cam.flip(0)).flatten(1).norm(dim=1).max()
    # Key frames are whole frames, so the way back may be off by less than one.
    if float(there_and_back) <= float(step):
        last = max(1, (frames - 1) // 2)
        inserted_frame = min(inserted_frame, frames - 1 - inserted_frame)
    spread = torch.linspace(0, last, min(count, last + 1)).round().long().tolist()
    return tuple(sorted({*spread, inserted_frame}))


def read_frames(path: Path, numbers: Sequence[int]) -> list[np.ndarray]:
    """Frames of a video by their numbers, (height, width, 3) of 8-bit RGB. Raises `ArtifactError` if there are fewer."""
    import av

    wanted, found = set(numbers), {}
    try:
        with av.open(str(path)) as container:
            for number, frame in enumerate(container.decode(video=0)):
                if number in wanted:
                    found[number] = frame.to_ndarray(format="rgb24")
                if len(found) == len(wanted):
                    break
    except (av.FFmpegError, IndexError) as error:
        raise ArtifactError(f"cannot be decoded ({error})", where=path, fix="rerun the render stage") from None
    if len(found) < len(wanted):
        raise ArtifactError(f"has no frame {max(wanted)}", where=path, fix="rerun the render stage")
    return [found[number] for number in numbers]
