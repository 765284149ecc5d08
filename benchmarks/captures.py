"""How long one waits for a capture to be read: photos of 24 megapixels, and a minute of 1080p video.

    python benchmarks/captures.py [--photos 30] [--seconds 60] [--threads 2]

The photos are JPEG files (quality 90) of a made texture with noise, each from another place of it; read is what ``prepare`` reads: decoded,
looked at, and fitted to the views' sizes. The video is H.264 at 25 frames per second, a clip of two seconds over and over; read is what
`expand` takes of it, 24 frames as files. Wall time, and in brackets the CPU time of the process: the machine may be shared.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from video_and_files import timed

from sceneexpander.ingest import IngestConfig, read_views
from sceneexpander.ingest.sources import read_capture

PHOTO = (4000, 6000)  # rows and columns
FRAME = (1080, 1920)
RATE, CLIP_SECONDS = 25, 2


def texture(height: int, width: int) -> NDArray[np.uint8]:
    """Coloured blobs of many sizes, with noise."""
    generator = np.random.default_rng(0)
    layers = [generator.uniform(0, 1, (height // size, width // size, 3)).astype(np.float32) for size in (400, 80, 20)]
    mixed = sum(cv2.resize(layer, (width, height), interpolation=cv2.INTER_CUBIC) for layer in layers) * 80
    return np.clip(mixed + generator.normal(0, 4, (height, width, 1)), 0, 255).astype(np.uint8)


def make_photos(folder: Path, count: int) -> list[Path]:
    """Files of different parts of one texture."""
    whole = texture(*PHOTO)
    paths = [folder / f"{number:02d}.jpg" for number in range(count)]
    for number, path in enumerate(paths):
        Image.fromarray(np.roll(whole, 150 * number, axis=1)).save(path, quality=90)
    return paths


def make_video(path: Path, seconds: int) -> None:
    """A clip, encoded once and repeated."""
    picture = texture(FRAME[0], FRAME[1] + RATE * CLIP_SECONDS * 8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"preset": "veryfast", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = FRAME[1], FRAME[0], "yuv420p"
        clip = []
        for number in range(RATE * CLIP_SECONDS):
            part = np.ascontiguousarray(picture[:, 8 * number : 8 * number + FRAME[1]])
            clip += [(p.pts, bytes(p), p.is_keyframe) for p in stream.encode(av.VideoFrame.from_ndarray(part))]
        clip += [(p.pts, bytes(p), p.is_keyframe) for p in stream.encode(None)]
        for repeat in range(seconds // CLIP_SECONDS):
            for pts, data, key in clip:
                packet = av.Packet(data)
                packet.pts = packet.dts = pts + repeat * len(clip)
                packet.time_base, packet.stream, packet.is_keyframe = stream.codec_context.time_base, stream, key
                container.mux(packet)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=30)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.photos:
            paths = make_photos(folder, args.photos)
            size = sum(path.stat().st_size for path in paths) / 1e6
            spent = timed(lambda: read_views(paths, IngestConfig()))
            print(f"{args.photos} photos of {PHOTO[1]}x{PHOTO[0]}, {size:.0f} MB: {spent}", flush=True)
        if args.seconds:
            make_video(folder / "walk.mp4", args.seconds)
            spent = timed(lambda: read_capture(folder / "walk.mp4", IngestConfig()))
            print(f"{args.seconds} s of {FRAME[1]}x{FRAME[0]} at {RATE} fps to frames: {spent}", flush=True)


if __name__ == "__main__":
    main()
