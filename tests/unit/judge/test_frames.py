"""Which frames the judge sees: cameras decide, each is shown once, and the inserted one always."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.judge.frames import choose_frames, read_frames
from sceneexpander.splatting.video import write_video


def path_along(positions: torch.Tensor) -> torch.Tensor:
    poses = torch.eye(4).repeat(len(positions), 1, 1)
    poses[:, 0, 3] = positions
    return poses


@pytest.mark.parametrize(("frames", "turn"), [(96, 47), (95, 47), (7, 3)])
def test_there_and_back_is_shown_on_the_way_there(frames: int, turn: int) -> None:
    t = torch.linspace(-1, 1, frames)
    chosen = choose_frames(path_along(1 - t.abs()), frames - 1 - turn, 8)
    assert (chosen[0], chosen[-1]) == (0, turn)
    assert len(chosen) == min(8, turn + 1)
    gaps = np.diff(chosen)
    assert gaps.max() - gaps.min() <= 1, "evenly spread"


def test_a_path_to_elsewhere_is_shown_whole_with_the_inserted_camera() -> None:
    chosen = choose_frames(path_along(torch.linspace(0, 5, 50)), 30, 6)
    assert chosen == (0, 10, 20, 29, 30, 39, 49)


def test_more_frames_than_there_are() -> None:
    assert choose_frames(path_along(torch.arange(4.0)), 2, 8) == (0, 1, 2, 3)


def test_the_frames_of_the_video_are_those_numbers(tmp_path: Path) -> None:
    greys = torch.linspace(0.1, 0.9, 9)
    write_video([torch.full((3, 32, 48), float(grey)) for grey in greys], tmp_path / "v.mp4", 24)
    found = read_frames(tmp_path / "v.mp4", (1, 4, 8))
    assert [frame.shape for frame in found] == [(32, 48, 3)] * 3
    for frame, grey in zip(found, greys[[1, 4, 8]], strict=True):
        assert abs(frame.mean() / 255 - float(grey)) < 0.02
    with pytest.raises(ArtifactError, match="has no frame 9"):
        read_frames(tmp_path / "v.mp4", (0, 9))
    (tmp_path / "v.mp4").write_bytes(b"nothing")
    with pytest.raises(ArtifactError, match="cannot be decoded"):
        read_frames(tmp_path / "v.mp4", (0,))
