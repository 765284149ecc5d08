"""Videos play back as they were given; depth and provenance become colours."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sceneexpander.splatting.video import colourise_depth, depth_range, tint_generated, write_video


def decode(path: Path) -> tuple[Tensor, float]:
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        frames = [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
        return torch.stack(frames), float(stream.average_rate)


def ramp(count: int, height: int, width: int) -> Iterator[Tensor]:
    for i in range(count):
        colour = torch.tensor([i / count, 0.5, 0.2])
        yield colour[:, None, None].expand(3, height, width)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (33, 47), (2, 2)])
def test_video_decodes_with_its_size_count_rate_and_colours(tmp_path: Path, height: int, width: int) -> None:
    path = tmp_path / "tour.mp4"
    assert write_video(ramp(11, height, width), path, 24) == 11
    frames, rate = decode(path)
    assert frames.shape == (11, height + height % 2, width + width % 2, 3)
    assert rate == 24
    middle = frames[:, height // 2, width // 2].float() / 255
    expected = torch.stack([f[:, 0, 0] for f in ramp(11, 1, 1)])
    assert (middle - expected).abs().max() < 0.03  # lossy, 8-bit limited-range luma and chroma
    raw = path.read_bytes()
    assert raw.find(b"moov") < raw.find(b"mdat")  # the index comes first: playback starts before the download ends
    assert [p.name for p in tmp_path.iterdir()] == ["tour.mp4"]


def test_bytes_and_floats_encode_alike(tmp_path: Path) -> None:
    picture = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    write_video([picture], tmp_path / "a.mp4", 30)
    write_video([(picture * 255).round().to(torch.uint8)], tmp_path / "b.mp4", 30)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize(("count", "height", "width"), [(8, 84, 112), (12, 112, 112), (5, 33, 47)])
def test_the_same_frames_give_the_same_bytes(tmp_path: Path, count: int, height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(count)
    cells = torch.rand(3, height // 4 + count, width // 4 + count, generator=generator)
    wide = cells.repeat_interleave(4, 1).repeat_interleave(4, 2)
    moving = [wide[:, i : i + height, 2 * i : 2 * i + width] for i in range(count)]
    seen = set()
    for turn in range(10):
        # What the encoder must not read: other leftovers in freed memory each time.
        leftovers = [torch.full((1 + 40_000 * (turn + 1) * k,), turn + k, dtype=torch.uint8) for k in range(30)]
        del leftovers
        write_video(moving, tmp_path / f"{turn}.mp4", 24)
        seen.add((tmp_path / f"{turn}.mp4").read_bytes())
    assert len(seen) == 1
    # The encoder writes down its settings: the number of cores, which differs between machines, is none of them.
    assert b" threads=1 " in seen.pop()


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "at least one frame"),
        ([torch.zeros(3, 8, 8), torch.zeros(3, 8, 10)], "frame 1 is"),
        ([torch.zeros(8, 8, 3)], "frame 0 has shape"),
        ([torch.full((3, 8, 8), torch.nan)], "frame 0 is not finite"),
        ([torch.zeros(3, 8, 8, dtype=torch.int64)], "frame 0 is torch.int64"),
    ],
)
@pytest.mark.wrong_shapes
def test_bad_frames_are_named_and_leave_no_file(tmp_path: Path, frames: list[Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_video(frames, tmp_path / "tour.mp4", 24)
    assert not list(tmp_path.iterdir())


def test_failing_source_leaves_an_old_video_untouched(tmp_path: Path) -> None:
    path = tmp_path / "tour.mp4"
    path.write_bytes(b"old")

    def broken() -> Iterator[Tensor]:
        yield torch.zeros(3, 8, 8)
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        write_video(broken(), path, 24)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["tour.mp4"]


def test_near_is_red_far_is_blue_and_invalid_is_black() -> None:
    depth = torch.linspace(1, 5, 50).expand(4, 50).clone()
    depth[0, 10] = 0
    depth[1, 10] = torch.nan
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[2, 10] = False
    rgb = colourise_depth(depth, valid)
    assert rgb.shape == (3, 4, 50)
    assert not rgb[:, :3, 10].any()
    assert rgb[:, 3, 10].any()
    red, _, blue = rgb[:, 3]
    assert red[3] > blue[3]
    assert blue[40] > red[40]


def test_depth_limits_ignore_outliers_and_survive_flat_or_empty_maps() -> None:
    depth = torch.cat([torch.full((98,), 2.0), torch.tensor([1e-3, 1e5])]).reshape(10, 10)
    assert depth_range(depth) == (2.0, 2.0)
    assert depth_range(torch.zeros(3, 3)) == (1.0, 1.0)
    assert colourise_depth(depth).isfinite().all()
    batch = colourise_depth(torch.rand(2, 5, 6) + 1, limits=(1.0, 2.0))
    assert batch.shape == (2, 3, 5, 6)


def test_tint_marks_generated_content_only() -> None:
    rgb = torch.full((3, 2, 2), 0.5)
    tinted = tint_generated(rgb, torch.tensor([[0.0, 1.0], [0.5, 1.0]]))
    assert torch.equal(tinted[:, 0, 0], rgb[:, 0, 0])
    assert tinted[0, 0, 1] > tinted[0, 1, 0] > 0.5 > tinted[2, 1, 0] > tinted[2, 0, 1]
