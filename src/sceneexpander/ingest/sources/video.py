"""Videos: the sharpest frame of each part, upright, in standard dynamic range."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import av.error
import cv2
import numpy as np
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.formats import name_of_content, read_head
from sceneexpander.ingest.samples import Pixels
from sceneexpander.ingest.sources.capture import Capture, Shot
from sceneexpander.plainfiles import require_plain_file

_ENDINGS = frozenset(
    {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp", ".flv", ".gif"}
)
_MOST_FRAMES = 1_000_000
_PQ, _HLG = 16, 18  # transfer characteristics of ITU-T H.273
_REFERENCE_WHITE_NITS = 203.0  # ITU-R BT.2408: where diffuse white is in HDR video
_SRGB_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


class Video:
    """One video file; animated GIFs are some."""

    title = "a video"

    def detect(self, place: Path) -> bool:
        """Whether the name or the first bytes say so."""
        if not place.is_file():
            return False
        return place.suffix.casefold() in _ENDINGS or name_of_content(read_head(place)) == "a video"

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The chosen frames, as PNG files in memory."""
        require_plain_file(place)
        try:
            return _read(place, config)
        except (av.error.FFmpegError, ValueError, EOFError, OSError, MemoryError, IndexError) as error:
            # FFmpeg's own errors repeat the name of the file, and an errno that says nothing.
            reason = " ".join((getattr(error, "strerror", None) or str(error)).split())[:80]
            raise UserError(
                f"cannot be read as a video ({reason})", where=place, fix="convert it to MP4 (H.264)"
            ) from None


@dataclass(slots=True)
class _Best:
    """The sharpest frame of a part so far."""

    part: int
    sharpness: float
    frame: Any
    seconds: float


def _read(place: Path, config: IngestConfig) -> Capture:
    times = _packet_times(place)
    if not times:
        raise UserError("holds no pictures", where=place)
    first, last = times[0], times[-1]
    # The last frame is shown for a while, too; how long is not said by all files.
    duration = max(last - first, 0.0) + (last - first) / max(1, len(times) - 1)
    parts = max(1, min(config.video_frames, len(times), round(duration * config.video_fps)))
    notes, shots = [], []
    hdr = False
    for best in _sharpest(place, first, duration, parts):
        _check_size(best.frame, config, place)
        pixels, was_hdr = _standard_range(best.frame)
        hdr |= was_hdr
        turned = np.rot90(pixels, round(getattr(best.frame, "rotation", 0) / 90) % 4)
        shots.append(Shot(name=f"{place.stem}_{best.seconds - first:08.3f}s.png", picture=_png(turned)))
    if not shots:
        raise UserError("holds no frame that can be decoded", where=place)
    note = f"{place.name}: {len(shots)} of {len(times)} frames are used, the sharpest of each {duration / parts:.2f} s"
    notes.append(f"{note} (scene.video_fps, scene.video_frames)")
    if hdr:
        notes.append(f"{place.name}: high dynamic range, brought to standard range; highlights are cut off softly")
    return Capture(shots=tuple(shots), notes=tuple(notes), files=(place,), chosen=True)


def _packet_times(place: Path) -> list[float]:
    """When frames are shown, in seconds and in order; read without decoding, so any frame rate is known before."""
    with av.open(str(place)) as container:
        if not container.streams.video:
            raise UserError("holds no pictures", where=place)
        stream = container.streams.video[0]
        times = []
        for packet in container.demux(stream):
            if packet.pts is not None and packet.size:
                times.append(float(packet.pts * stream.time_base))
            if len(times) > _MOST_FRAMES:
                raise UserError(f"holds more than {_MOST_FRAMES} frames", where=place, fix="cut it")
    return sorted(times)


def _sharpest(place: Path, first: float, duration: float, parts: int) -> Iterator[_Best]:
    """Per part of the video its sharpest frame; one part's at a time is kept."""
    best: _Best | None = None
    with av.open(str(place)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        for frame in container.decode(stream):
            if frame.pts is None:
                continue
            seconds = float(frame.pts * stream.time_base)
            part = min(parts - 1, max(0, int((seconds - first) / duration * parts) if duration > 0 else 0))
            if best is not None and part != best.part:
                yield best
                best = None
            sharpness = _sharpness(frame)
            if best is None or sharpness > best.sharpness:
                best = _Best(part=part, sharpness=sharpness, frame=frame, seconds=seconds)
    if best is not None:
        yield best


def _sharpness(frame: Any) -> float:
    """Variance of the Laplacian of the middle of the picture's brightness."""
    plane = frame.planes[0]
    if frame.format.is_planar and len(frame.format.components) and frame.format.components[0].bits == 8:
        grey = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]
    else:
        grey = frame.to_ndarray(format="gray")
    height, width = grey.shape
    middle = grey[height // 8 : height - height // 8 : 1, width // 8 : width - width // 8]
    return float(cv2.Laplacian(np.ascontiguousarray(middle[::2]), cv2.CV_16S).var())


def _check_size(frame: Any, config: IngestConfig, place: Path) -> None:
    if frame.width * frame.height > config.max_megapixels * 1e6:
        raise UserError(f"has frames of {frame.width} x {frame.height} pixels", where=place, fix="raise max_megapixels")


def _standard_range(frame: Any) -> tuple[Pixels, bool]:
    """(8-bit sRGB pixels, whether the frame was of high dynamic range)."""
    transfer = int(getattr(frame, "color_trc", 0) or 0)
    if transfer not in (_PQ, _HLG):
        return frame.to_ndarray(format="rgb24"), False
    signal = frame.to_ndarray(format="rgb48le").astype(np.float32) / 65535
    # Relative to diffuse white, which SDR shows at its maximum.
    light = (
        _from_pq(signal) / _REFERENCE_WHITE_NITS if transfer == _PQ else _from_hlg(signal) / _from_hlg(np.float32(0.75))
    )
    colours = np.clip(light @ _SRGB_FROM_BT2020.T, 0, None)
    return (_to_srgb(_softly_cut(colours)) * 255 + 0.5).astype(np.uint8), True


def _from_pq(signal: np.ndarray) -> np.ndarray:
    """Luminance in cd/m^2 (SMPTE ST 2084, equation 4.1)."""
    root = np.power(signal, 1 / 78.84375)
    return 10000 * np.power(np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root), 1 / 0.1593017578125)


def _from_hlg(signal: Any) -> Any:
    """Scene light, 1 at the highest (ITU-R BT.2100, inverse OETF of HLG), with the system's gamma of 1.2."""
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)
    return scene**1.2


def _softly_cut(light: np.ndarray, knee: float = 0.8) -> np.ndarray:
    """Light up to ``knee`` as it is; all that is above it between there and 1."""
    over = np.maximum(light - knee, 0)
    return np.minimum(light, knee) + (1 - knee) * over / (over + 1 - knee)


def _to_srgb(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(np.maximum(light, 1e-6), 1 / 2.4) - 0.055)


def _png(pixels: Pixels) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, format="PNG", compress_level=1)
    return file.getvalue()
