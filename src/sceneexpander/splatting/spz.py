"""3D Gaussians as SPZ files: a tenth of a PLY, for sharing and for viewers on phones.

The format stores bytes, so it loses what a byte cannot hold. Worst cases of what is written here, per Gaussian: position half a
step of 1 / 2^23 of the largest coordinate (a power of two above it); scale 3.2 %; opacity and colour of degree 0 one 255th each;
rotation 0.2 degrees; higher harmonics 1/16 (degree 1) and 1/8 (degrees 2, 3) as in other writers. Scales outside
[4.5e-5, 380] are cut there, harmonics outside [-1, 1] and colours outside [-0.44, 1.44] as well; `write_spz` returns how many.
**Provenance is lost**: SPZ has no place for it. Write a PLY to keep it. How opacities are meant (`Gaussians.antialiased`) is kept.

Layout: a header of 16 bytes, then positions (24-bit fixed point), opacities, colours, logarithms of the scales, rotations (the
smallest three components of the quaternion in 10 bits each), higher harmonics; everything through gzip. Axes are x right, y up,
z backwards, where scenes here (like PLY files) have y down and z forward. Version 3 is written, versions 2 and 3 are read.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.splatting.files import complete_file
from sceneexpander.splatting.scene import check_finite
from sceneexpander.splatting.torch_backend import sh_basis

MAGIC = 0x5053474E  # "NGSP"
VERSION = 3
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
ANTIALIASED = 1  # the bit of the flags
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
_ROTATION_BYTES = {2: 3, 3: 4}


def write_spz(gaussians: Gaussians, path: Path) -> int:
    """Write a scene, atomically; returns the number of Gaussians of which some value was cut to the format's range.

    Raises:
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
    body = HEADER.pack(MAGIC, VERSION, len(scene), degree, bits, ANTIALIASED * scene.antialiased, 0) + b"".join(
        c.tobytes() for c in columns
    )
    with complete_file(path) as scratch, scratch.open("wb") as file:
        # No time and no name inside: the same scene gives the same bytes.
        with gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0, compresslevel=6) as packed:
            packed.write(body)
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
    version, count, degree, bits, flags, body = _unpack(raw, path)
    at = 0

    def take(*shape: int) -> NDArray[np.uint8]:
        nonlocal at
        length = count * math.prod(shape)
        at += length
        return body[at - length : at].reshape(count, *shape)

    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, 1:] = take(3, 3)  # in the upper bytes, so that the shift below brings the sign along
    means = torch.from_numpy((fixed.view("<i4")[..., 0] >> 8).astype(np.float64) / (1 << bits)).float()
    opacities = _floats(take(1))[:, 0] / 255
    colours = (_floats(take(3)) / 255 - 0.5) / COLOUR_GAIN
    scales = (_floats(take(3)) / SCALE_STEPS - SCALE_OFFSET).exp()
    quats = _unpack_rotations(take(_ROTATION_BYTES[version]))
    higher = (_floats(take((degree + 1) ** 2 - 1, 3)) / SH_GAIN - 1) * _signs(degree)
    return Gaussians(
        means=means * torch.tensor([1.0, -1.0, -1.0]),
        quat_wxyz=quats,
        scales=scales,
        opacities=opacities,
        sh=torch.cat([colours[:, None], higher], 1),
        source_view=torch.full((count,), -1),
        generated=torch.zeros(count, dtype=torch.bool),
        antialiased=bool(flags & ANTIALIASED),
    )


def _unpack(raw: bytes, path: Path) -> tuple[int, int, int, int, int, NDArray[np.uint8]]:
    """(version, count, degree, fractional bits, flags, everything after the header); never inflates more than the header announces."""
    if raw[:4] == MAGIC.to_bytes(4, "little"):  # the header of versions before is compressed like the rest
        version = int.from_bytes(raw[4:8], "little")
        fix = "write it as version 3 or as PLY, e.g. with splat-transform"
        raise UserError(f"is SPZ {version}, which is not read here: versions 2 and 3 are", where=path, fix=fix)
    inflate = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = inflate.decompress(raw, HEADER.size)
        if len(head) < HEADER.size:
            raise UserError("is not an SPZ file (too short)", where=path)
        magic, version, count, degree, bits, flags, _ = HEADER.unpack(head)
        if magic != MAGIC:
            raise UserError("is not an SPZ file (its mark is missing)", where=path)
        if version not in _ROTATION_BYTES:
            raise UserError(f"has SPZ version {version}", where=path, fix="versions 2 and 3 can be read")
        if degree > 3 or bits > MOST_FRACTIONAL_BITS:
            raise UserError(f"has SH degree {degree} and {bits} fractional bits, at most 3 and 23 exist", where=path)
        expected = count * (9 + 1 + 3 + 3 + _ROTATION_BYTES[version] + 3 * ((degree + 1) ** 2 - 1))
        if expected > max(SMALL_BYTES, WORST_RATIO * len(raw)):
            raise UserError(f"announces {count} Gaussians, too many for a file of {len(raw)} bytes", where=path)
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
    return version, count, degree, bits, flags, np.frombuffer(body, np.uint8)


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
