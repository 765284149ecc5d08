"""SPZ files: what comes back is what bytes can hold, and renders accordingly; damage is refused in one line."""

from __future__ import annotations

import base64
import gzip
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard

from sceneexpander.errors import UserError
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import ROWS, Gaussians
from sceneexpander.geometry.rigid import rotation_angle_deg, rotation_from_quat_wxyz
from sceneexpander.splatting import render
from sceneexpander.splatting.spz import HEADER, MAGIC, read_spz, write_spz
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians


def bounded(count: int, sh_coefficients: int = 4) -> Gaussians:
    """A scene whose values are all inside the format's range."""
    scene = random_gaussians(count, sh_coefficients=sh_coefficients)
    return replace(scene, sh=torch.cat([scene.sh[:, :1].clamp(-3, 3), scene.sh[:, 1:].clamp(-0.95, 0.95)], 1))


@pytest.mark.parametrize("sh_coefficients", [1, 4, 9, 16])
def test_values_come_back_within_the_stated_steps(tmp_path: Path, sh_coefficients: int) -> None:
    scene = bounded(500, sh_coefficients)
    path = tmp_path / "folder" / "scene.spz"
    assert write_spz(scene, path) == 0
    again = read_spz(path)
    # The largest coordinate is below 4: 21 fractional bits, and half a step.
    assert scene.means.abs().max() < 4
    torch.testing.assert_close(again.means, scene.means, atol=2**-22 + 2e-7, rtol=0)
    torch.testing.assert_close(again.opacities, scene.opacities, atol=0.5 / 255 + 1e-6, rtol=0)
    torch.testing.assert_close(again.sh[:, 0], scene.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-5, rtol=0)
    assert float((again.scales / scene.scales).log().abs().max()) <= 1 / 32 + 1e-5
    turned = rotation_angle_deg(rotation_from_quat_wxyz(again.quat_wxyz), rotation_from_quat_wxyz(scene.quat_wxyz))
    assert float(turned.max()) < 0.3
    for k in range(1, sh_coefficients):
        half_step = (4 if k < 4 else 8) / 128
        torch.testing.assert_close(again.sh[:, k], scene.sh[:, k], atol=half_step + 1e-5, rtol=0)
    assert (again.source_view == -1).all()
    assert not again.generated.any()
    assert [p.name for p in path.parent.iterdir()] == ["scene.spz"]


def test_it_renders_the_same_within_what_the_format_allows(tmp_path: Path) -> None:
    scene = bounded(400, 16)
    write_spz(scene, tmp_path / "a.spz")
    again = read_spz(tmp_path / "a.spz")
    a, b = (render(s, Cameras(cameras(2), intrinsics(2, 60, 80), 60, 80)).rgb for s in (scene, again))
    # Several rounded bytes meet in a pixel, harmonics of degrees 2 and 3 being the coarsest by far.
    assert -10 * math.log10(float(((a - b) ** 2).mean())) > 35
    flat = replace(scene, sh=scene.sh[:, :1])  # what reconstructions here hold
    write_spz(flat, tmp_path / "b.spz")
    a, b = (
        render(s, Cameras(cameras(2), intrinsics(2, 60, 80), 60, 80)).rgb for s in (flat, read_spz(tmp_path / "b.spz"))
    )
    assert -10 * math.log10(float(((a - b) ** 2).mean())) > 45
    assert float((a - b).abs().max()) < 8 / 255


def test_writing_what_was_read_gives_the_same_bytes(tmp_path: Path) -> None:
    write_spz(bounded(300, 16), tmp_path / "a.spz")
    write_spz(read_spz(tmp_path / "a.spz"), tmp_path / "b.spz")
    first, second = (gzip.decompress((tmp_path / f"{n}.spz").read_bytes()) for n in "ab")
    # Not the rotations: a component may round to the other side of the largest one.
    differ = np.frombuffer(first, np.uint8) != np.frombuffer(second, np.uint8)
    start = HEADER.size + 300 * (9 + 1 + 3 + 3)
    assert not differ[:start].any()
    assert not differ[start + 4 * 300 :].any()


def test_the_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    # One Gaussian whose every byte can be worked out by hand.
    scene = Gaussians(
        means=torch.tensor([[1.0, 2.0, -3.0]]),
        quat_wxyz=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.tensor([[1.0, math.e, 1 / math.e]]),
        opacities=torch.tensor([0.2]),
        sh=torch.tensor([[[0.0, 1.0, -1.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]]]),
        source_view=torch.tensor([0]),
        generated=torch.tensor([True]),
    )
    write_spz(scene, tmp_path / "a.spz")
    raw = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert raw[:4] == b"NGSP"
    assert HEADER.unpack(raw[:16]) == (MAGIC, 3, 1, 1, 21, 0, 0)
    body = raw[16:]
    fixed = [int.from_bytes(body[i : i + 3], "little", signed=True) for i in (0, 3, 6)]
    assert fixed == [1 << 21, -2 << 21, 3 << 21]  # y up, z backwards
    assert list(body[9:16]) == [51, 128, 166, 89, 160, 176, 144]
    assert int.from_bytes(body[16:20], "little") == 3 << 30  # w is the largest
    # Harmonics y, z, x: the first two change sign; red, green, blue inside.
    assert list(body[20:]) == [64, 128, 128, 128, 64, 128, 128, 128, 192]


def test_other_programs_files_of_version_2_open(tmp_path: Path) -> None:
    quat = torch.nn.functional.normalize(torch.tensor([0.6, 0.2, -0.5, 0.4]), dim=0)
    wire = torch.stack([quat[1], -quat[2], -quat[3]])
    body = HEADER.pack(MAGIC, 2, 1, 0, 12, 1, 0)
    body += b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (0.5, -0.25, 7.0))
    body += bytes([128, 128, 128, 128, 96, 112, 128, *((wire + 1) * 127.5).round().int().tolist()])
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    scene = read_spz(tmp_path / "a.spz")
    torch.testing.assert_close(scene.means, torch.tensor([[0.5, 0.25, -7.0]]))
    torch.testing.assert_close(scene.scales, torch.tensor([[math.exp(-4), math.exp(-3), math.exp(-2)]]))
    torch.testing.assert_close(scene.quat_wxyz[0], quat, atol=0.01, rtol=0)


def test_an_independent_reader_sees_the_same(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="pip install gsply[spz]")
    write_spz(bounded(200, 16), tmp_path / "a.spz")
    theirs, ours = gsply.read_spz(str(tmp_path / "a.spz")), read_spz(tmp_path / "a.spz")
    # It keeps the file's axes (y up, z backwards): sizes must agree, signs differ where an axis is reversed.
    pairs = [
        (theirs.means, ours.means),
        (theirs.quats, ours.quat_wxyz),
        (theirs.scales, ours.scales.log()),
        (theirs.sh0, ours.sh[:, 0]),
        (theirs.shN, ours.sh[:, 1:]),
    ]
    for their, our in pairs:
        torch.testing.assert_close(torch.tensor(np.asarray(their)).abs(), our.abs(), atol=1e-5, rtol=0)


# `random_gaussians(4)` as the format's own library writes it (its WebAssembly build, @adobe/spz 0.2.3), told of y down and z forward.
FROM_THE_LIBRARY = {
    3: (
        "H4sIAAAAAAAAAwGEAHv/TkdTUAMAAAAEAAAAAQwBAMsOANECAOsUAHUFAGkKAG0NAN8DAPT3/+gGACH8/7oFAEH+/32Sf0mHkYVqYICMe3d1"
        "hHJ4cX1ren1jem5ze29tgE6yRiT1cX4TORNkQVSliv+GKaJFfByLlE16eUm6e7N8/1qdfBqbYlJpbG2Dp22JspVmsX8OsIQAAAA="
    ),
    4: (
        "TkdTUAQAAAAEAAAAAQwBBiAAAAAAAAAAAAAAAAAAAAAtAAAAAAAAACQAAAAAAAAADQAAAAAAAAAEAAAAAAAAABUAAAAAAAAADAAAAAAAAAAV"
        "AAAAAAAAAAwAAAAAAAAAGQAAAAAAAAAQAAAAAAAAAC0AAAAAAAAAJAAAAAAAAAAotS/9ICQhAQDLDgDRAgDrFAB1BQBpCgBtDQDfAwD09//o"
        "BgAh/P+6BQBB/v8otS/9IAQhAAB9kn9JKLUv/SAMYQAAh5GFamCAjHt3dYRyKLUv/SAMYQAAeHF9a3p9Y3puc3tvKLUv/SAQgQAAbYBOskYk"
        "9XF+EzkTZEFUpSi1L/0gJCEBAIr/himiRXwci5RNenlJunuzfP9anXwam2JSaWxtg6dtibKVZg=="
    ),
}


@pytest.mark.parametrize("version", [3, 4])
def test_what_the_library_of_the_format_writes_is_read(tmp_path: Path, version: int) -> None:
    path = tmp_path / "theirs.spz"
    path.write_bytes(base64.b64decode("".join(FROM_THE_LIBRARY[version])))
    read, wanted = read_spz(path), random_gaussians(4)
    assert read.antialiased
    torch.testing.assert_close(read.means, wanted.means, atol=2**-13, rtol=0)  # it keeps 12 fractional bits
    torch.testing.assert_close(read.opacities, wanted.opacities, atol=0.5 / 255 + 1e-6, rtol=0)
    assert float((read.scales / wanted.scales).log().abs().max()) <= 1 / 32 + 1e-5
    turned = rotation_angle_deg(rotation_from_quat_wxyz(read.quat_wxyz), rotation_from_quat_wxyz(wanted.quat_wxyz))
    assert float(turned.max()) < 0.3
    torch.testing.assert_close(read.sh[:, 0], wanted.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-5, rtol=0)
    torch.testing.assert_close(read.sh[:, 1:], wanted.sh[:, 1:].clamp(-1, 127 / 128), atol=1e-2, rtol=0)  # 8 bits


def test_what_had_to_be_cut_is_counted(tmp_path: Path) -> None:
    scene = bounded(5)
    scene.scales[1, 0] = 1e-6
    scene.sh[3, 0, 2] = 9.0
    scene.sh[4, 2, 0] = -2.0
    assert write_spz(scene, tmp_path / "a.spz") == 3
    again = read_spz(tmp_path / "a.spz")
    assert float(again.scales[1, 0]) == pytest.approx(math.exp(-10))


def test_an_empty_scene_and_bad_values(tmp_path: Path) -> None:
    assert write_spz(random_gaussians(0), tmp_path / "a.spz") == 0
    assert len(read_spz(tmp_path / "a.spz")) == 0
    scene = bounded(5)
    scene.scales[2, 1] = math.inf
    with pytest.raises(ValueError, match="scales row 2 is not finite"):
        write_spz(scene, tmp_path / "b.spz")
    scene = bounded(5)
    scene.means[4, 1] = 1e9
    with pytest.raises(ValueError, match="means row 4 is farther out"):
        write_spz(scene, tmp_path / "b.spz")
    assert [p.name for p in tmp_path.iterdir()] == ["a.spz"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[:-9], "announces 5 Gaussians in 145 bytes and holds 136"),
        (lambda raw: raw + b"x", "announces 5 Gaussians in 145 bytes and holds more"),
        (lambda raw: raw[:7], "too short"),
        (lambda raw: b"ply\n" + raw[4:], "its mark is missing"),
        (lambda raw: raw[:4] + b"\x04" + raw[5:], "has SPZ version 4; versions 2 to 4 can be read"),
        (lambda raw: raw[:12] + b"\x09" + raw[13:], "has SH degree 9"),
        (lambda raw: raw[:8] + b"\xff\xff\xff\xff" + raw[12:], "announces 4294967295 Gaussians, too many"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, damage: Callable[[bytes], bytes], message: str) -> None:
    path = tmp_path / "a.spz"
    write_spz(bounded(5), path)
    path.write_bytes(gzip.compress(damage(gzip.decompress(path.read_bytes()))))
    with pytest.raises(UserError, match=message) as caught:
        read_spz(path)
    assert str(path) in caught.value.line()
    assert "\n" not in caught.value.line()


def test_what_is_no_gzip_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(b"ply\nformat ascii 1.0\n")
    with pytest.raises(UserError, match="is not an SPZ file"):
        read_spz(tmp_path / "a.spz")
    with pytest.raises(UserError, match="does not exist"):
        read_spz(tmp_path / "b.spz")


@pytest.mark.parametrize("version", [3, 5, 99])
def test_a_version_with_a_plain_header_that_is_not_4_is_named(tmp_path: Path, version: int) -> None:
    (tmp_path / "a.spz").write_bytes(b"NGSP" + version.to_bytes(4, "little") + bytes(40))
    with pytest.raises(UserError, match=f"has SPZ version {version}; versions 2 to 4"):
        read_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("sh_coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_version_4_holds_what_version_3_holds(tmp_path: Path, sh_coefficients: int, count: int) -> None:
    scene = replace(bounded(max(count, 1), sh_coefficients).select(torch.arange(count)), antialiased=True)
    write_spz(scene, tmp_path / "3.spz")
    write_spz(scene, tmp_path / "4.spz", version=4)
    three, four = read_spz(tmp_path / "3.spz"), read_spz(tmp_path / "4.spz")
    for name in ROWS:
        assert torch.equal(getattr(three, name), getattr(four, name)), name
    assert four.antialiased


def version_4(folder: Path, count: int = 5) -> bytes:
    write_spz(bounded(count), folder / "a.spz", version=4)
    return (folder / "a.spz").read_bytes()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[:20], "too short"),
        (lambda raw: raw[:40], "its table of streams is missing"),
        (lambda raw: raw[:-1], "is truncated: stream 5 ends behind its end"),
        (lambda raw: raw + b"xy", "holds 2 bytes behind its end"),
        (lambda raw: raw[:12] + b"\x05" + raw[13:], "has SH degree 5"),
        (lambda raw: raw[:8] + b"\xff\xff\xff\xff" + raw[12:], "announces 4294967295 Gaussians, too many"),
        (lambda raw: raw[:8] + b"\x06" + raw[9:], "stream 0 announces 45 bytes, expected 54"),
        (lambda raw: raw[:15] + b"\x02" + raw[16:], "holds 2 streams, expected 6"),
        (lambda raw: raw[:128] + b"\0\0\0\0" + raw[132:], "stream 0 is damaged"),
    ],
)
def test_a_damaged_version_4_is_one_line(tmp_path: Path, damage: Callable[[bytes], bytes], message: str) -> None:
    (tmp_path / "a.spz").write_bytes(damage(version_4(tmp_path)))
    with pytest.raises(UserError, match=message) as caught:
        read_spz(tmp_path / "a.spz")
    assert "\n" not in caught.value.line()


def test_a_stream_that_inflates_to_more_than_it_announces_is_refused(tmp_path: Path) -> None:
    raw = version_4(tmp_path)
    packed = zstandard.ZstdCompressor().compress(bytes(1 << 24))
    first = int.from_bytes(raw[32:40], "little")
    table = len(packed).to_bytes(8, "little") + raw[40:128]
    (tmp_path / "a.spz").write_bytes(raw[:32] + table + packed + raw[128 + first :])
    with pytest.raises(UserError, match="stream 0 holds more bytes, expected 45"):
        read_spz(tmp_path / "a.spz")


def test_degree_4_is_read_without_its_last_band(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_spz(bounded(3, 16), tmp_path / "a.spz", version=4)
    three = read_spz(tmp_path / "a.spz")
    raw = (tmp_path / "a.spz").read_bytes()
    lengths = [int.from_bytes(raw[32 + 16 * i : 40 + 16 * i], "little") for i in range(6)]
    at = 128 + sum(lengths[:5])
    low = np.frombuffer(zstandard.ZstdDecompressor().decompress(raw[at:]), np.uint8).reshape(3, 15, 3)
    high = np.concatenate([low, np.full((3, 9, 3), 77, np.uint8)], 1).tobytes()
    packed = zstandard.ZstdCompressor().compress(high)
    table = raw[32:112] + len(packed).to_bytes(8, "little") + len(high).to_bytes(8, "little")
    (tmp_path / "a.spz").write_bytes(raw[:12] + b"\x04" + raw[13:32] + table + raw[128:at] + packed)
    assert torch.equal(read_spz(tmp_path / "a.spz").sh, three.sh)
    assert "degree 4 are left out" in caplog.text


@pytest.mark.parametrize("tail", [b"x", b"\0" * 512, b"PK\3\4more", gzip.compress(b"more", mtime=0)])
def test_bytes_behind_the_stream_are_refused(tmp_path: Path, tail: bytes) -> None:
    write_spz(bounded(5), tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes((tmp_path / "a.spz").read_bytes() + tail)
    with pytest.raises(UserError, match=f"holds {len(tail)} bytes behind its end"):
        read_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("cut", [1, 4, 8])
def test_a_stream_without_its_check_sum_is_refused(tmp_path: Path, cut: int) -> None:
    write_spz(bounded(5), tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes((tmp_path / "a.spz").read_bytes()[:-cut])
    with pytest.raises(UserError, match="is truncated"):
        read_spz(tmp_path / "a.spz")


def test_few_bytes_that_stand_for_very_many_gaussians_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    import tracemalloc

    count = 4_000_000
    body = HEADER.pack(MAGIC, 3, count, 0, 12, 0, 0) + bytes(20 * count)
    (tmp_path / "bomb.spz").write_bytes(gzip.compress(body, 9))
    del body
    tracemalloc.start()
    with pytest.raises(UserError, match=f"announces {count} Gaussians, too many for a file of"):
        read_spz(tmp_path / "bomb.spz")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "."])
def test_a_name_that_is_no_file_is_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError):
        read_spz(tmp_path / name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_how_opacities_are_meant_is_the_first_flag(tmp_path: Path, antialiased: bool) -> None:
    write_spz(replace(bounded(5), antialiased=antialiased), tmp_path / "a.spz")
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[14] == int(antialiased)
    assert read_spz(tmp_path / "a.spz").antialiased is antialiased


def test_large_files_of_ordinary_content_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit on what a file may unpack to is about its own length."""
    from sceneexpander.splatting import spz

    monkeypatch.setattr(spz, "SMALL_BYTES", 1000)
    write_spz(random_gaussians(2000), tmp_path / "a.spz")
    assert len(read_spz(tmp_path / "a.spz")) == 2000
