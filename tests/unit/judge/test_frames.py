"""Which frames the judge sees: cameras decide, each is shown once, and the inserted one always."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.trajectory import navigation
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


@pytest.mark.parametrize("frames", [95, 96])
def test_the_tour_is_a_way_there_and_back(frames: int) -> None:
    """Whole frames at the key cameras make it a little uneven."""
    keys = path_along(torch.tensor([0.0, 0.4, 1.5, 2.2]))
    keys[:, 2, 3] = torch.tensor([0.0, 1.0, 0.7, 0.1])
    cameras = Cameras(keys, torch.eye(3).expand(4, 3, 3), 4, 6)
    tour = navigation(cameras, frames, [0, 1, 2, 3, 2, 1, 0]).world_from_cam
    goal = int((tour[:, 0, 3] - 2.2).abs().argmin())
    chosen = choose_frames(tour, goal, 8)
    assert len(chosen) == 8
    assert tour[list(chosen), 0, 3].diff().min() > 0, "no camera twice"
    assert float((tour[chosen[-1], 0, 3] - 2.2).abs()) < 0.05


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
