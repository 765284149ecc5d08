"""Pictures a person can look at: MP4 files, coloured depth, tinted provenance."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sceneexpander.files import complete_file

BT709 = 1  # code of ITU-R BT.709 for colour matrix, primaries and transfer in video streams
LIMITED_RANGE = 1
GENERATED_TINT = (1.0, 0.45, 0.05)
# The same frames are to give the same bytes. x264's macroblock tree reads memory that nobody wrote (seen on AVX-512: other bytes each
# time, pixels up to 54 levels apart), and what several threads make depends on their number, which would be that of the cores.
REPEATABLE = {"x264-params": "mbtree=0", "threads": "1"}
SMALLEST_SPREAD = 1e-6  # relative, of depths that still get more than one colour


class VideoEncoder:
    """Takes the frames of one video; made by `open_video`."""

    def __init__(self, container: Any, fps: float, crf: int) -> None:
        self._container = container
        self._stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        self._crf = crf
        self._shape: torch.Size | None = None
        self.count = 0

    def add(self, frame: Float[Tensor, "3 height width"] | UInt8[Tensor, "3 height width"]) -> None:
        """Encode the next frame. Floats are RGB in [0, 1] and are clamped; odd sizes are padded by their last row or column.

        Raises:
            ValueError: another shape or dtype than the first one, or values that are not finite; names its index.
        """
        import av

        pixels = _to_bytes(frame, self.count)
        if self._shape is None:
            self._shape = pixels.shape
            self._set_up(*pixels.shape[:2])
        if pixels.shape != self._shape:
            raise ValueError(f"frame {self.count} is {tuple(pixels.shape)}, the first one was {tuple(self._shape)}")
        picture = av.VideoFrame.from_ndarray(pixels.numpy(), format="rgb24")
        picture = picture.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        self._container.mux(self._stream.encode(picture))
        self.count += 1

    def finish(self) -> None:
        """Write what the encoder still holds. Raises `ValueError` if there was no frame."""
        if self.count == 0:
            raise ValueError("a video needs at least one frame")
        self._container.mux(self._stream.encode())

    def _set_up(self, height: int, width: int) -> None:
        stream = self._stream
        stream.height, stream.width = height, width
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(self._crf), "preset": "medium", **REPEATABLE}
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709
        context.color_range = LIMITED_RANGE


@contextlib.contextmanager
def open_video(path: Path, fps: float, *, crf: int = 18) -> Iterator[VideoEncoder]:
    """An H.264 file (yuv420p, BT.709, faststart MP4) that takes frames as they come; the same frames give the same bytes.

    It appears at the end of the context, complete; after an error nothing is left behind, and an older file stays.

    Args:
        path: of the MP4.
        fps: frames per second.
        crf: constant quality of the encoder, 0 (lossless) to 51; 18 looks like the original.
    """
    import av

    if fps <= 0:
        raise ValueError(f"fps must be > 0, got {fps}")
    options = {"movflags": "+faststart"}
    with complete_file(path) as scratch, av.open(str(scratch), "w", format="mp4", options=options) as container:
        encoder = VideoEncoder(container, fps, crf)
        yield encoder
        encoder.finish()


def write_video(
    frames: Iterable[Float[Tensor, "3 height width"] | UInt8[Tensor, "3 height width"]],
    path: Path,
    fps: float,
    *,
    crf: int = 18,
) -> int:
    """Encode all frames (see `open_video`) and return how many there were."""
    with open_video(path, fps, crf=crf) as video:
        for frame in frames:
            video.add(frame)
    return video.count


def _to_bytes(frame: Tensor, index: int) -> UInt8[Tensor, "height width 3"]:
    """Interleaved 8-bit RGB with even sides."""
    if frame.ndim != 3 or frame.shape[0] != 3 or 0 in frame.shape:
        raise ValueError(f"frame {index} has shape {tuple(frame.shape)}, expected (3, height, width)")
    if frame.is_floating_point():
        if not bool(torch.isfinite(frame).all()):
            raise ValueError(f"frame {index} is not finite")
        frame = (frame.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    elif frame.dtype != torch.uint8:
        raise ValueError(f"frame {index} is {frame.dtype}, expected floating point or uint8")
    pixels = frame.movedim(0, -1).cpu()
    height, width = pixels.shape[:2]
    if height % 2:
        pixels = torch.cat([pixels, pixels[-1:]], 0)
    if width % 2:
        pixels = torch.cat([pixels, pixels[:, -1:]], 1)
    return pixels.contiguous()


def depth_range(
    depth: Float[Tensor, "*batch height width"],
    valid: Bool[Tensor, "*batch height width"] | None = None,
    *,
    percentiles: tuple[float, float] = (2.0, 98.0),
) -> tuple[float, float]:
    """(near, far) that hold most of the valid depths (finite and > 0 at least); (1, 1) if there are none.

    Take it once over a whole video: colours that rescale from frame to frame flicker.
    """
    usable = torch.isfinite(depth) & (depth > 0)
    if valid is not None:
        usable = usable & valid
    values = depth.detach()[usable].cpu().numpy()
    if not len(values):
        return 1.0, 1.0
    low, high = (round(p / 100 * (len(values) - 1)) for p in percentiles)
    values.partition([low, high])  # a copy of its own already; sorting all of a video would take a second
    return float(values[low]), float(values[high])


def colourise_depth(
    depth: Float[Tensor, "*batch height width"],
    valid: Bool[Tensor, "*batch height width"] | None = None,
    *,
    limits: tuple[float, float] | None = None,
) -> Float[Tensor, "*batch 3 height width"]:
    """Depth as RGB: near is red, far is blue, even steps of inverse depth; what is not valid (or not > 0) is black.

    Args:
        limits: (near, far) of the colour scale; default `depth_range` of this very map.
    """
    near, far = limits if limits is not None else depth_range(depth, valid)
    usable = torch.isfinite(depth) & (depth > 0)
    if valid is not None:
        usable = usable & valid
    inverse = 1 / torch.where(usable, depth.detach(), torch.ones_like(depth))
    spread = 1 / near - 1 / far
    if spread > SMALLEST_SPREAD / near:
        level = ((inverse - 1 / far) / spread).clamp(0, 1)
    else:
        level = torch.full_like(inverse, 0.5)
    table = _turbo().to(depth)
    rgb = table[(level * (len(table) - 1)).round().long()]
    return torch.where(usable[..., None], rgb, 0).movedim(-1, -3)


def tint_generated(
    rgb: Float[Tensor, "*batch 3 height width"],
    generated: Float[Tensor, "*batch height width"],
    *,
    strength: float = 0.45,
) -> Float[Tensor, "*batch 3 height width"]:
    """The picture with generated content tinted orange; ``generated`` is the share of a `Render`."""
    colour = rgb.new_tensor(GENERATED_TINT)[:, None, None]
    share = strength * generated.clamp(0, 1).unsqueeze(-3)
    return rgb * (1 - share) + colour * share


@functools.cache
def _turbo() -> Float[Tensor, "level 3"]:
    from matplotlib import colormaps

    return torch.tensor(colormaps["turbo"](range(256))[:, :3], dtype=torch.float32)
