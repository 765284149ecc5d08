"""3D Gaussians as SPZ files: a tenth of a PLY, for sharing and for viewers on phones.

The format stores bytes, so it loses what a byte cannot hold. Worst cases of what is written here, per Gaussian: position half a
step of 1 / 2^23 of the largest coordinate (a power of two above it); scale 3.2 %; opacity and colour of degree 0 one 255th each;
rotation 0.2 degrees; higher harmonics 1/16 (degree 1) and 1/8 (degrees 2, 3) as in other writers. Scales outside
[4.5e-5, 380] are cut there, harmonics outside [-1, 1] and colours outside [-0.44, 1.44] as well; `write_spz` returns how many.
**Provenance is lost**: SPZ has no place for it. Write a PLY to keep it. How opacities are meant (`Gaussians.antialiased`) is kept.

Layout: a header of 16 bytes, then positions (24-bit fixed point), opacities, colours, logarithms of the scales, rotations (the
smallest three components of the quaternion in 10 bits each), higher harmonics; everything through gzip. Version 4 holds the
same bytes, but its header (32 bytes) is followed by a table of lengths (compressed, whole; 64 bits each) and one Zstandard stream
per kind of value. Axes are x right, y up, z backwards, where scenes here (like PLY files) have y down and z forward. Versions 3
and 4 are written, 2 to 4 are read.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.splatting.scene import check_finite
from sceneexpander.splatting.torch_backend import sh_basis

MAGIC = 0x5053474E  # "NGSP"
Version = Literal[3, 4]
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
HEADER_4 = struct.Struct("<IIIBBBBI12x")  # the same with the number of streams, then where their table starts
STREAM = struct.Struct("<QQ")  # of that table: bytes in the file, bytes inflated
ANTIALIASED, EXTENDED = 1, 2  # bits of the flags
COORDINATE_LIMIT = (1 << 23) - 1
MOST_FRACTIONAL_BITS = 23
COLOUR_GAIN = 0.15  # a byte of colour is 255 * (0.5 + gain * coefficient)
SCALE_OFFSET, SCALE_STEPS = 10.0, 16.0  # a byte of scale is steps * (log(scale) + offset)
SH_GAIN = 128.0  # a byte of a higher harmonic is 128 * (1 + coefficient)
SH_STEPS = {1: 8, 2: 16, 3: 16}  # by degree: bytes are rounded to multiples, which compress well
ROTATION_BITS = 9  # of a component's size, beside its sign
# Real scenes come to a third or half of their size, equal Gaussians to a hundredth; gzip itself reaches a thousandth, and a file of a
# megabyte would become gigabytes in memory.
WORST_RATIO, SMALL_BYTES = 50, 64 << 20
_ROTATION_BYTES = {2: 3, 3: 4, 4: 4}
_MOST_DEGREE = {2: 3, 3: 3, 4: 4}
_LARGEST_WINDOW = 1 << 27  # bytes of memory that a Zstandard stream may ask for
_ZSTD_LEVEL = 9
_log = logging.getLogger(__name__)


def write_spz(gaussians: Gaussians, path: Path, *, version: Version = 3) -> int:
    """Write a scene, atomically; returns the number of Gaussians of which some value was cut to the format's range.

    Version 3 opens in most programs, version 4 in the newest.

    Raises:
        UserError: version 4 needs the package zstandard, which is not installed.
        ValueError: values that are not finite or positions beyond 8.3 million scene units, naming the tensor and row.
    """
    scene = gaussians.detach().to("cpu")
    for name in ("means", "quat_wxyz", "scales", "opacities", "sh"):
        check_finite(name, getattr(scene, name))
    degree = math.isqrt(scene.sh.shape[1]) - 1
    if (degree + 1) ** 2 != scene.sh.shape[1] or degree > 3:
        raise ValueError(f"sh has {scene.sh.shape[1]} coefficients, SPZ holds degrees 0 to 3")
    flipped = scene.means * torch.tensor([1.0, -1.0, -1.0])
    largest = float(flipped.abs().max()) if len(scene) else 0.0
    if largest > COORDINATE_LIMIT:
        row = int((flipped.abs().amax(-1) > COORDINATE_LIMIT).nonzero()[0, 0])
        raise ValueError(f"means row {row} is farther out than SPZ can hold ({largest:.3g})")
    bits = MOST_FRACTIONAL_BITS if largest == 0 else math.floor(math.log2(COORDINATE_LIMIT / largest))
    bits = max(0, min(bits, MOST_FRACTIONAL_BITS))

    fixed = np.rint(flipped.double().numpy() * (1 << bits)).astype("<i4")
    positions = fixed.view(np.uint8).reshape(len(scene), 3, 4)[:, :, :3]
    opacities, _ = _bytes(255 * scene.opacities[:, None])
    colours, cut_colours = _bytes(255 * (0.5 + COLOUR_GAIN * scene.sh[:, 0]))
    scales, cut_scales = _bytes(SCALE_STEPS * (scene.scales.clamp(min=1e-30).log() + SCALE_OFFSET))
    harmonics, cut_harmonics = _bytes(_rounded(SH_GAIN * (1 + scene.sh[:, 1:] * _signs(degree))))
    columns = [positions, opacities, colours, scales, _pack_rotations(scene.quat_wxyz), harmonics]
    streams = [column.tobytes() for column in columns]
    facts = (MAGIC, version, len(scene), degree, bits, ANTIALIASED * scene.antialiased)
    with complete_file(path) as scratch, scratch.open("wb") as file:
        if version == 4:
            file.write(_zstd_file(facts, streams))
        else:
            # No time and no name inside: the same scene gives the same bytes.
            with gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0, compresslevel=6) as packed:
                packed.write(HEADER.pack(*facts, 0) + b"".join(streams))
        file.flush()
    return int((cut_colours | cut_scales | cut_harmonics).sum())


def read_spz(path: Path) -> Gaussians:
    """Read a scene of version 2 or 3; ``source_view`` is -1 and ``generated`` false throughout.

    Raises:
        UserError: no such file, no SPZ, an unknown version, a wrong length.
    """
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        raise UserError("does not exist", where=path) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"cannot be read ({reason})", where=str(path)[:300]) from None
    header, body = _unpack(raw, path)
    count, degree = header.count, header.degree
    at = 0

    def take(*shape: int) -> NDArray[np.uint8]:
        nonlocal at
        length = count * math.prod(shape)
        at += length
        return body[at - length : at].reshape(count, *shape)

    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, 1:] = take(3, 3)  # in the upper bytes, so that the shift below brings the sign along
    means = torch.from_numpy((fixed.view("<i4")[..., 0] >> 8).astype(np.float64) / (1 << header.bits)).float()
    opacities = _floats(take(1))[:, 0] / 255
    colours = (_floats(take(3)) / 255 - 0.5) / COLOUR_GAIN
    scales = (_floats(take(3)) / SCALE_STEPS - SCALE_OFFSET).exp()
    quats = _unpack_rotations(take(_ROTATION_BYTES[header.version]))
    stored = _floats(take((degree + 1) ** 2 - 1, 3)) / SH_GAIN - 1
    if degree > 3:
        _log.warning("%s: harmonics of degree 4 are left out, scenes here hold degrees 0 to 3", path)
    kept = min(degree, 3)
    higher = stored[:, : (kept + 1) ** 2 - 1] * _signs(kept)
    return Gaussians(
        means=means * torch.tensor([1.0, -1.0, -1.0]),
        quat_wxyz=quats,
        scales=scales,
        opacities=opacities,
        sh=torch.cat([colours[:, None], higher], 1),
        source_view=torch.full((count,), -1),
        generated=torch.zeros(count, dtype=torch.bool),
        antialiased=header.antialiased,
    )


def _zstd_file(facts: tuple[int, ...], streams: list[bytes]) -> bytes:
    present = [
        stream for stream in streams if stream
    ]  # without higher harmonics, or without Gaussians, there are fewer
    packed = [_zstd().ZstdCompressor(level=_ZSTD_LEVEL).compress(stream) for stream in present]
    table = [STREAM.pack(len(small), len(whole)) for small, whole in zip(packed, present, strict=True)]
    return b"".join([HEADER_4.pack(*facts, len(present), HEADER_4.size), *table, *packed])


def _zstd() -> Any:
    try:
        import zstandard
    except ImportError:
        fix = "pip install zstandard, or use SPZ 3"
        raise UserError("needs the package zstandard", where="SPZ 4", fix=fix) from None
    return zstandard


@dataclass(frozen=True, slots=True)
class _Header:
    version: int
    count: int
    degree: int
    bits: int  # of coordinates behind the binary point
    antialiased: bool

    @property
    def lengths(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, rotations, higher harmonics."""
        harmonics = 3 * ((self.degree + 1) ** 2 - 1)
        return tuple(self.count * width for width in (9, 1, 3, 3, _ROTATION_BYTES[self.version], harmonics))


def _unpack(raw: bytes, path: Path) -> tuple[_Header, NDArray[np.uint8]]:
    """(header, all values); never inflates more than the header announces."""
    # The header of versions before 4 is compressed like the rest.
    header, body = _unpack_4(raw, path) if raw[:4] == MAGIC.to_bytes(4, "little") else _unpack_gzip(raw, path)
    return header, np.frombuffer(body, np.uint8)


def _check_header(version: int, count: int, degree: int, bits: int, flags: int, size: int, path: Path) -> _Header:
    if degree > _MOST_DEGREE[version] or bits > MOST_FRACTIONAL_BITS:
        most = _MOST_DEGREE[version]
        raise UserError(f"has SH degree {degree} and {bits} fractional bits, at most {most} and 23 exist", where=path)
    header = _Header(version, count, degree, bits, bool(flags & ANTIALIASED))
    if sum(header.lengths) > max(SMALL_BYTES, WORST_RATIO * size):
        raise UserError(f"announces {count} Gaussians, too many for a file of {size} bytes", where=path)
    return header


def _unpack_gzip(raw: bytes, path: Path) -> tuple[_Header, bytes]:
    inflate = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = inflate.decompress(raw, HEADER.size)
        if len(head) < HEADER.size:
            raise UserError("is not an SPZ file (too short)", where=path)
        magic, version, count, degree, bits, flags, _ = HEADER.unpack(head)
        if magic != MAGIC:
            raise UserError("is not an SPZ file (its mark is missing)", where=path)
        if version not in (2, 3):
            raise UserError(f"has SPZ version {version}", where=path, fix="versions 2 to 4 can be read")
        header = _check_header(version, count, degree, bits, flags, len(raw), path)
        expected = sum(header.lengths)
        body = inflate.decompress(inflate.unconsumed_tail, expected + 1)
        if not inflate.eof:
            inflate.decompress(inflate.unconsumed_tail, 1)  # to the end of the stream, where its check sum is
    except zlib.error:
        raise UserError("is not an SPZ file (not compressed with gzip, or damaged)", where=path) from None
    if len(body) != expected:
        found = "more" if len(body) > expected else str(len(body))
        raise UserError(f"announces {count} Gaussians in {expected} bytes and holds {found}", where=path)
    if not inflate.eof:
        raise UserError("is truncated: its check sum is missing", where=path)
    if inflate.unused_data:
        raise UserError(f"holds {len(inflate.unused_data)} bytes behind its end", where=path)
    return header, body


def _unpack_4(raw: bytes, path: Path) -> tuple[_Header, bytes]:
    if len(raw) < HEADER_4.size:
        raise UserError("is not an SPZ file (too short)", where=path)
    _, version, count, degree, bits, flags, streams, at = HEADER_4.unpack_from(raw)
    if version != 4:
        raise UserError(f"has SPZ version {version}", where=path, fix="versions 2 to 4 can be read")
    header = _check_header(version, count, degree, bits, flags, len(raw), path)
    if flags & EXTENDED:
        _log.warning("%s: holds extensions, which are not read", path)
    lengths = [length for length in header.lengths if length]
    # Some writers list a stream without bytes too.
    if streams not in (len(lengths), len(header.lengths)):
        raise UserError(f"holds {streams} streams, expected {len(lengths)}", where=path)
    if streams == len(header.lengths):
        lengths = list(header.lengths)
    start = at + streams * STREAM.size
    if at < HEADER_4.size or start > len(raw):
        raise UserError("is truncated: its table of streams is missing", where=path)
    parts = []
    for number, expected in enumerate(lengths):
        packed, whole = STREAM.unpack_from(raw, at + number * STREAM.size)
        if whole != expected:
            raise UserError(f"stream {number} announces {whole} bytes, expected {expected}", where=path)
        if start + packed > len(raw):
            raise UserError(f"is truncated: stream {number} ends behind its end", where=path)
        parts.append(_inflate_zstd(raw[start : start + packed], expected, number, path))
        start += packed
    if start != len(raw):
        raise UserError(f"holds {len(raw) - start} bytes behind its end", where=path)
    return header, b"".join(parts)


def _inflate_zstd(packed: bytes, expected: int, number: int, path: Path) -> bytes:
    if not packed and not expected:
        return b""
    library = _zstd()
    try:
        reader = library.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).stream_reader(packed)
        body = reader.read(expected + 1)
    except (library.ZstdError, MemoryError):
        raise UserError(f"stream {number} is damaged", where=path) from None
    if len(body) != expected:
        found = "more" if len(body) > expected else str(len(body))
        raise UserError(f"stream {number} holds {found} bytes, expected {expected}", where=path)
    return body


def _bytes(values: Float[Tensor, "gaussian *rest"]) -> tuple[NDArray[np.uint8], Tensor]:
    """(rounded to bytes, which rows had to be cut)."""
    whole = values.round()
    cut = ((whole < 0) | (whole > 255)).flatten(1).any(-1)
    return whole.clamp(0, 255).to(torch.uint8).numpy(), cut


def _floats(values: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


def _degrees(coefficients: int) -> list[int]:
    return [math.isqrt(k) for k in range(1, coefficients + 1)]


def _rounded(levels: Float[Tensor, "gaussian coefficient 3"]) -> Float[Tensor, "gaussian coefficient 3"]:
    """To the multiples that the format's writers use, cut to the bytes' own range only by the caller."""
    steps = torch.tensor([SH_STEPS[degree] for degree in _degrees(levels.shape[1])])[:, None]
    rounded = (levels / steps).round() * steps
    # 1 is level 256, which no byte holds: the largest byte is nearer to it than the range is wide, so it counts as held.
    return torch.where(rounded == 256, 255.0, rounded)


def _signs(degree: int) -> Float[Tensor, "coefficient 1"]:
    """Signs that the higher harmonics take when y and z are reversed: each is even or odd."""
    direction = torch.nn.functional.normalize(torch.tensor([0.3, 0.5, 0.7]), dim=0)
    there, here = (sh_basis(direction * torch.tensor(f), (degree + 1) ** 2)[1:] for f in ([1, -1, -1], [1, 1, 1]))
    return torch.sign(there * here)[:, None]


def _pack_rotations(quat_wxyz: Float[Tensor, "gaussian 4"]) -> NDArray[np.uint8]:
    """From the highest bit: index of the largest of x y z w, then sign and size of the three others in that order."""
    unit = torch.nn.functional.normalize(quat_wxyz.double(), dim=-1)
    xyzw = (unit * torch.tensor([1.0, 1.0, -1.0, -1.0]))[:, [1, 2, 3, 0]].numpy()
    largest = np.abs(xyzw).argmax(-1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    word = largest.astype(np.uint32)
    top = (1 << ROTATION_BITS) - 1
    for component in range(4):
        magnitude = np.rint(np.abs(xyzw[:, component]) * math.sqrt(2) * top).clip(0, top).astype(np.uint32)
        negative = (xyzw[:, component] < 0).astype(np.uint32)
        longer = word << (ROTATION_BITS + 1) | negative << ROTATION_BITS | magnitude
        word = np.where(largest == component, word, longer)
    return word.astype("<u4").view(np.uint8).reshape(-1, 4)


def _unpack_rotations(packed: NDArray[np.uint8]) -> Float[Tensor, "gaussian 4"]:
    count, width = packed.shape
    if width == 3:  # version 2: x y z as bytes, w >= 0 follows
        xyz = packed.astype(np.float64) / 127.5 - 1
        xyzw = np.concatenate([xyz, np.sqrt(np.maximum(0, 1 - (xyz**2).sum(-1, keepdims=True)))], 1)
    else:
        word = np.ascontiguousarray(packed).view("<u4")[:, 0]
        largest = word >> 30
        xyzw = np.zeros((count, 4))
        for component in (3, 2, 1, 0):
            magnitude = (word & ((1 << ROTATION_BITS) - 1)) / (((1 << ROTATION_BITS) - 1) * math.sqrt(2))
            value = np.where(word >> ROTATION_BITS & 1, -magnitude, magnitude)
            xyzw[:, component] = np.where(largest == component, 0, value)
            word = np.where(largest == component, word, word >> (ROTATION_BITS + 1))
        missing = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(-1)))
        np.put_along_axis(xyzw, largest[:, None].astype(np.int64), missing[:, None], 1)
    wxyz = torch.from_numpy(xyzw[:, [3, 0, 1, 2]]) * torch.tensor([1.0, 1.0, -1.0, -1.0])
    return torch.nn.functional.normalize(wxyz, dim=-1).float()
