"""Videos of high dynamic range, and videos whose frames are not evenly apart."""

from __future__ import annotations

import io
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.ingest.sources import Capture, find_source, read_capture
from tests.worlds.captures import CONFIG
from tests.worlds.photos import texture

pytestmark = pytest.mark.timeout(60)
HEIGHT, WIDTH = 64, 96
PQ, HLG, BT709 = 16, 18, 1


def clip(path: Path, levels: list[int], times_ms: list[int], transfer: int) -> Path:
    """Frames of 10 bits that show one brightness (video range) with a fine pattern, at their times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p10le"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.color_trc = transfer
        for level, time in zip(levels, times_ms, strict=True):
            frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p10le")
            for index, plane in enumerate(frame.planes):
                rows = np.frombuffer(plane, np.uint16).reshape(plane.height, -1)
                rows[:] = level if index == 0 else 512
            frame.pts, frame.time_base, frame.color_trc = time, Fraction(1, 1000), transfer
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def read(path: Path) -> tuple[Capture, list[float]]:
    """The capture, and the mean grey of each frame."""
    capture = read_capture(path, replace(CONFIG, video_fps=2.0))
    return capture, [float(np.asarray(Image.open(io.BytesIO(shot.data()))).mean()) for shot in capture.shots]


def video_range(signal: float) -> int:
    return round(64 + 876 * signal)


# Signals of diffuse white (203 cd/m2) and of what is far brighter: ITU-R BT.2408, table 1.
@pytest.mark.parametrize(("transfer", "white", "bright"), [(PQ, 0.581, 0.75), (HLG, 0.75, 1.0)])
def test_high_dynamic_range_is_said_and_white_stays_below_highlights(
    tmp_path: Path, transfer: int, white: float, bright: float
) -> None:
    levels = [video_range(white)] * 5 + [video_range(bright)] * 5
    capture, (first, second) = read(clip(tmp_path / "a.mkv", levels, [100 * k for k in range(10)], transfer))
    assert any("high dynamic range, brought to standard range" in note for note in capture.notes)
    # Diffuse white is at 0.9 of the light that can be shown (sRGB 0.95): above it is room for highlights.
    assert first / 255 == pytest.approx(0.955, abs=0.01)
    assert first + 4 < second <= 255


def test_standard_range_stays_as_it_is(tmp_path: Path) -> None:
    capture, greys = read(clip(tmp_path / "a.mkv", [video_range(0.5)] * 10, [100 * k for k in range(10)], BT709))
    assert not any("dynamic range" in note for note in capture.notes)
    assert all(grey / 255 == pytest.approx(0.5, abs=0.01) for grey in greys)


def test_parts_are_of_equal_time_whatever_the_frame_rate(tmp_path: Path) -> None:
    # Twenty frames in the first second, three in the next two.
    times = [*range(0, 1000, 50), 1200, 2000, 2600]
    capture, _ = read(clip(tmp_path / "a.mkv", [500] * len(times), times, BT709))
    taken = [float(shot.name.split("_")[1].removesuffix("s.png")) for shot in capture.shots]
    parts = [int(second / (2.6 + 2.6 / 22) * 5) for second in taken]
    assert parts == sorted(set(parts)), "one of each part that shows something"
    assert len(taken) >= 4
    assert sum(second < 1 for second in taken) <= 2, "not one of every so many frames"


def test_an_animated_gif_is_a_video_and_a_single_picture_is_none(tmp_path: Path) -> None:
    frames = [texture(index, 60, 80) for index in range(6)]
    frames[0].save(tmp_path / "walk.gif", save_all=True, append_images=frames[1:], duration=200)
    assert find_source(tmp_path / "walk.gif") == "video"
    assert len(read_capture(tmp_path / "walk.gif", replace(CONFIG, video_fps=5.0)).shots) == 6
    frames[0].save(tmp_path / "one.png")
    with pytest.raises(UserError, match=r"one\.png: is one picture; give the folder"):
        read_capture(tmp_path / "one.png", CONFIG)


def test_what_ffmpeg_refuses_is_said_in_its_words_alone(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text("no video")
    with pytest.raises(UserError) as caught:
        read_capture(tmp_path / "a.mp4", CONFIG)
    assert caught.value.line().count("a.mp4") == 1
    assert "Errno" not in caught.value.line()
