"""Videos for the pages: comparable, without a word inside about where they come from, and catch videos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file
from sceneexpander.plainfiles import require_plain_file
from sceneexpander.splatting.video import write_video

PLAYABLE = ("h264", "vp9", "av1")  # in MP4, by every current browser
_BLOCK_PX = 8  # of the noise in catch videos: coarse enough to survive compression


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFacts:
    """What two videos must have in common to be compared by eye."""

    width: int
    height: int
    frames: int
    fps: Fraction

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.frames} frames at {float(self.fps):g} per second"


def copy_video(source: Path, target: Path) -> VideoFacts:
    """Copy the picture track alone, bit by bit, into a fresh MP4 file: no sound, no title, no encoder's note of the container.

    Raises:
        UserError: it is no video that browsers play.
    """
    import av

    require_plain_file(source)
    try:
        with av.open(str(source)) as original:
            if not original.streams.video:
                raise UserError("holds no picture track", where=source)
            track = original.streams.video[0]
            if track.codec_context.name not in PLAYABLE and track.codec_context.codec.name not in PLAYABLE:
                raise UserError(
                    f"is coded as {track.codec_context.name}, which browsers do not play",
                    where=source,
                    fix="encode it as H.264",
                )
            frames = 0
            options = {"movflags": "+faststart", "fflags": "+bitexact"}
            with complete_file(target) as scratch, av.open(str(scratch), "w", format="mp4", options=options) as copy:
                written = copy.add_stream_from_template(track)
                written.metadata.clear()
                for packet in original.demux(track):
                    if packet.dts is None:
                        continue
                    packet.stream = written
                    copy.mux(packet)
                    frames += 1
            rate = track.average_rate or Fraction(0)
            facts = VideoFacts(width=track.width, height=track.height, frames=frames, fps=Fraction(rate))
    except (av.FFmpegError, ValueError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"cannot be read as a video ({reason})", where=source) from None
    if facts.frames < 2 or facts.fps <= 0:
        raise UserError("holds fewer than two frames", where=source)
    return facts


def degrade_video(source: Path, target: Path, share: float, rng: np.random.Generator) -> None:
    """Blend each frame with blocks of noise, the same in all frames.

    Args:
        source: a readable video.
        target: MP4.
        share: of the noise: 0 leaves the video as it is, 1 leaves nothing of it.
        rng: of the noise.
    """
    import av

    with av.open(str(source)) as container:
        track = container.streams.video[0]
        blocks = rng.random((3, track.height // _BLOCK_PX + 1, track.width // _BLOCK_PX + 1), dtype=np.float32)
        noise = torch.from_numpy(
            blocks.repeat(_BLOCK_PX, 1).repeat(_BLOCK_PX, 2)[:, : track.height, : track.width].copy()
        )

        def frames() -> Iterator[torch.Tensor]:
            for frame in container.decode(track):
                pixels = torch.from_numpy(frame.to_ndarray(format="rgb24")).permute(2, 0, 1).float() / 255
                yield pixels * (1 - share) + noise * share

        write_video(frames(), target, float(track.average_rate or 0))
