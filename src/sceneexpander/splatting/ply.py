"""3D Gaussians as PLY files that every splat viewer opens.

The layout is the usual one of 3D Gaussian splatting: position ``x y z``, unused normals ``nx ny nz``, spherical harmonics
``f_dc_*`` and ``f_rest_*`` (channel by channel), ``opacity`` as a logit, ``scale_*`` as natural logarithms, ``rot_*`` as a
scalar-first quaternion; float32, binary little-endian. Provenance follows in two properties that other programs skip:
``source_view`` (-1 unknown) and ``generated`` (0 or 1). They are float32 too: some readers take rows for arrays of floats.

`write_ply` can leave them out, for readers that know one row length only, and can add ``red green blue`` (bytes, colour of degree 0), which
MeshLab and CloudCompare show.

A comment says how opacities are meant (`Gaussians.antialiased`), as gsplat, nerfstudio, Brush and splat-transform write and read it:
``SplatRenderMode: mip`` for rasterisers that compensate them for the screen blur, ``default`` for others.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file
from sceneexpander.geometry.gaussians import Gaussians, rgb_from_sh
from sceneexpander.splatting.scene import check_finite

Linear = Literal["opacity", "scale"]
ROWS_PER_CHUNK = 65536  # written at once, bounds the memory
OPACITY_MARGIN = 1e-6  # logits of exactly 0 or 1 would be infinite, which viewers do not expect
SMALLEST_SCALE = 1e-30
MAX_HEADER_BYTES = 1 << 16
REST_COUNTS = (0, 9, 24, 45)  # f_rest properties of SH degrees 0 to 3
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
SCALAR_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
FIXED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
PROVENANCE = ("source_view", "generated")
COLOURS = ("red", "green", "blue")
COMPRESSED = {"packed_position", "packed_rotation", "packed_scale", "packed_color"}
RENDER_MODES = {True: "mip", False: "default"}
MAX_COUNT_DIGITS = 15
MOST_VIEWS = 1 << 31
MAX_COMMENT = 1000  # letters of one line; the header as a whole is bounded by `MAX_HEADER_BYTES`
FEWEST_TO_JUDGE = 10  # of fewer Gaussians nobody can say what their numbers mean
WIDE_OVERLAP = 3.0  # size of the usual Gaussian in distances between neighbours, beyond which a scene would be fog
_log = logging.getLogger(__name__)


def write_ply(
    gaussians: Gaussians,
    path: Path,
    *,
    provenance: bool = True,
    rgb: bool = False,
    comments: Sequence[str] = (),
) -> None:
    """Write a scene, atomically. Opacities are kept within 1e-6 of 0 and 1 (their logits must be finite).

    Args:
        gaussians: the scene.
        path: of the file.
        provenance: with ``source_view`` and ``generated``.
        rgb: with ``red green blue``; then a row is no longer an array of floats.
        comments: lines for people, put into the header.

    Raises:
        ValueError: values that no PLY can carry (not finite, SH degree above 3), naming the tensor.
    """
    rest = 3 * (gaussians.sh.shape[1] - 1)
    if rest not in REST_COUNTS:
        raise ValueError(f"sh has {gaussians.sh.shape[1]} coefficients, a PLY holds degrees 0 to 3")
    for name in ("means", "quat_wxyz", "scales", "opacities", "sh"):
        check_finite(name, getattr(gaussians, name))
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", *ROTATION, *(PROVENANCE if provenance else ())]
    mode = f"comment SplatRenderMode: {RENDER_MODES[gaussians.antialiased]}"
    header = ["ply", "format binary_little_endian 1.0", mode, *map(ply_comment, comments)]
    header += [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in names)]
    header += [*(f"property uchar {name}" for name in COLOURS if rgb), "end_header"]
    with complete_file(path) as scratch, scratch.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        scene = gaussians.detach()
        for start in range(0, len(scene), ROWS_PER_CHUNK):
            rows = scene.select(torch.arange(start, min(start + ROWS_PER_CHUNK, len(scene))))
            floats = _float_columns(rows, provenance=provenance)
            file.write(_with_colours(floats, rows) if rgb else floats.data)
        file.flush()


def ply_comment(text: str) -> str:
    """A header's line that says ``text`` to people: one line of ASCII, at most 1000 letters of it."""
    plain = " ".join(text.split()).encode("ascii", "backslashreplace").decode("ascii")
    return f"comment {plain[:MAX_COMMENT]}"


def _float_columns(scene: Gaussians, *, provenance: bool) -> NDArray[np.float32]:
    columns = [
        scene.means,
        torch.zeros_like(scene.means),
        scene.sh[:, 0],
        scene.sh[:, 1:].transpose(1, 2).flatten(1),
        torch.logit(scene.opacities.double(), eps=OPACITY_MARGIN)[:, None],
        scene.scales.clamp(min=SMALLEST_SCALE).log(),
        torch.nn.functional.normalize(scene.quat_wxyz, dim=-1),
    ]
    if provenance:
        columns += [scene.source_view[:, None], scene.generated[:, None]]
    return torch.cat([c.float().cpu() for c in columns], 1).numpy().astype("<f4", copy=False)


def _with_colours(floats: NDArray[np.float32], scene: Gaussians) -> bytes:
    colours = (rgb_from_sh(scene.sh[:, 0]).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return np.concatenate([floats.view(np.uint8), colours], 1).tobytes()


def read_ply(path: Path, *, linear: Collection[Linear] = ()) -> Gaussians:
    """Read a scene written here or by other 3D Gaussian splatting programs: any property order and numeric type, with or without
    normals, ascii or binary of either byte order; properties that are not ours are ignored.

    Without provenance, ``source_view`` is -1 and ``generated`` false; without a comment on it, ``antialiased`` is false.

    Some programs write opacities and scales as they are, and not as logits and logarithms. Nothing in the file says so; the numbers do,
    mostly: see `_refuse_linear`. Such a file is read when the caller says what it is.

    Args:
        path: of the file.
        linear: which quantities are stored as they are.

    Raises:
        UserError: no such file, no PLY, no Gaussians in it, a wrong length, values that are not finite, or plainly linear.
    """
    try:
        with path.open("rb") as file:
            header = _read_header(file, path)
            table = _read_table(file, header, path)
    except FileNotFoundError:
        raise UserError("does not exist", where=path) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"cannot be read ({reason})", where=str(path)[:300]) from None
    return _gaussians(table, header, path, frozenset(linear))


@dataclass(frozen=True, slots=True)
class _Header:
    encoding: str  # ascii or a key of BYTE_ORDERS
    count: int  # of vertices
    properties: tuple[tuple[str, str], ...]  # name, numpy type without byte order
    skip: int  # bytes (binary) or lines (ascii) of elements before the vertices
    is_last: bool  # nothing follows the vertices
    antialiased: bool  # as a comment says; without one they are not


def _read_header(file: BinaryIO, path: Path) -> _Header:
    raw = file.read(MAX_HEADER_BYTES)
    if not raw.startswith((b"ply\n", b"ply\r")):
        raise UserError("is not a PLY file (does not start with 'ply')", where=path)
    end = raw.find(b"\nend_header")
    newline = raw.find(b"\n", end + 1)
    if end < 0 or newline < 0:
        raise UserError(f"has no end_header in its first {MAX_HEADER_BYTES} bytes", where=path)
    file.seek(newline + 1)
    encoding, elements = "", []  # name, count, properties of each element
    antialiased = False
    for line in raw[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            # The second is Postshot's way of saying it.
            case ["comment", "SplatRenderMode:", "mip"] | ["comment", "antialiased", "1"]:
                antialiased = True
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"]:
                encoding = name
            case ["element", _, count] if count.isdecimal() and len(count) > MAX_COUNT_DIGITS:
                raise UserError(f"announces a number of {len(count)} digits of elements", where=path)
            case ["element", name, count] if count.isascii() and count.isdecimal():
                elements.append((name, int(count), list[tuple[str, str]]()))
            case ["property", "list", *_] if elements:
                elements[-1][2].append(("", "list"))
            case ["property", kind, name] if elements and kind in SCALAR_TYPES:
                elements[-1][2].append((name, SCALAR_TYPES[kind]))
            case _:
                raise UserError(f"has a header line that is no PLY: {line[:80]!r}", where=path)
    if encoding not in {"ascii", *BYTE_ORDERS}:
        raise UserError(f"has the unknown format {encoding!r}", where=path)
    names = [name for name, _, _ in elements]
    if "vertex" not in names:
        raise UserError("has no vertices", where=path)
    at = names.index("vertex")
    if any(kind == "list" for _, _, properties in elements[: at + 1] for _, kind in properties):
        raise UserError("has lists in or before its vertices, a 3D Gaussian PLY has none", where=path)
    size = {name: sum(int(kind[1]) for _, kind in properties) for name, _, properties in elements[:at]}
    skip = sum(count if encoding == "ascii" else count * size[name] for name, count, _ in elements[:at])
    properties = tuple(elements[at][2])
    if len({name for name, _ in properties}) != len(properties):
        raise UserError("names a vertex property twice", where=path)
    return _Header(encoding, elements[at][1], properties, skip, at == len(elements) - 1, antialiased)


def _read_table(file: BinaryIO, header: _Header, path: Path) -> NDArray[np.void]:
    """The vertices as a structured array."""
    missing = [name for name in (*FIXED, *ROTATION) if name not in dict(header.properties)]
    if missing and COMPRESSED & set(dict(header.properties)):
        fix = "convert it to a plain PLY first, e.g. with splat-transform"
        raise UserError("is a compressed PLY (SuperSplat), which is not read", where=path, fix=fix)
    if missing:
        raise UserError(f"is not a 3D Gaussian PLY: vertices lack {', '.join(missing)}", where=path)
    order = BYTE_ORDERS.get(header.encoding, "=")
    dtype = np.dtype([(name, order + kind) for name, kind in header.properties])
    if header.encoding == "ascii":
        return _read_ascii(file, header, dtype, path)
    start = file.tell() + header.skip
    available = path.stat().st_size - start
    expected = header.count * dtype.itemsize
    if available < expected:
        raise UserError(
            f"is truncated: {header.count} vertices take {expected} bytes, found {max(available, 0)}", where=path
        )
    if header.is_last and available > expected:
        raise UserError(
            f"is longer than its {header.count} vertices: {available} bytes instead of {expected}", where=path
        )
    file.seek(start)
    return np.fromfile(file, dtype, header.count)


def _read_ascii(file: BinaryIO, header: _Header, dtype: np.dtype[np.void], path: Path) -> NDArray[np.void]:
    lines = file.read().split(b"\n")[header.skip :]
    rows = [line for line in lines if line.strip()]
    if len(rows) < header.count or (header.is_last and len(rows) > header.count):
        raise UserError(f"declares {header.count} vertices and holds {len(rows)}", where=path)
    table = np.empty(header.count, dtype)
    for row, line in enumerate(rows[: header.count]):
        try:
            table[row] = tuple(float(word) for word in line.split())
        except (ValueError, OverflowError):
            raise UserError(f"vertex {row} does not hold {len(header.properties)} numbers", where=path) from None
    return table


def _columns(table: NDArray[np.void], wanted: tuple[str, ...]) -> NDArray[np.float32]:
    """The named properties side by side as float32."""
    fields = dict(table.dtype.fields or {})
    offsets = [fields[name][1] for name in wanted]
    # Neighbours of the usual type are one block of bytes, many times faster to take than property by property.
    if len(table) and wanted and all(fields[name][0] == "<f4" for name in wanted) and np.all(np.diff(offsets) == 4):
        rows = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
        return np.ascontiguousarray(rows[:, offsets[0] : offsets[-1] + 4]).view("<f4").astype(np.float32, copy=False)
    stacked = np.empty((len(table), len(wanted)), np.float32)
    for i, name in enumerate(wanted):
        stacked[:, i] = table[name]
    return stacked


def _refuse_linear(opacities: Tensor, scales: Tensor, means: Tensor, path: Path) -> None:
    """Refuse opacities and scales that cannot be logits and logarithms; where both are possible, say so and take them for that.

    Logits that all lie within 0 and 1 would mean that every Gaussian is between 50 and 73 % opaque. Logarithms that are all above 0 would
    mean that every Gaussian is larger than one unit in every direction: possible in a scene of large units, but not where the usual one
    would then cover many times the distance to its neighbours.
    """
    count = len(opacities)
    if not count or not bool(
        torch.isfinite(opacities).all() & torch.isfinite(scales).all() & torch.isfinite(means).all()
    ):
        return  # refused by row, elsewhere
    faint = bool((opacities == 0).all())  # as they are: nothing to be seen
    within = bool(((opacities >= 0) & (opacities <= 1)).all()) and not faint
    positive = bool((scales > 0).all())
    sample = means[:: max(1, count // 50_000)].double()
    spread = sample.quantile(0.95, 0) - sample.quantile(0.05, 0)
    spacing = float(spread.norm()) / count**0.5
    foggy = positive and float(scales.double().median().exp()) > WIDE_OVERLAP * spacing
    found: list[str] = []
    if within and (positive or count >= FEWEST_TO_JUDGE):
        found.append("opacities (all within 0 and 1) are no logits")
    if positive and (foggy if count >= FEWEST_TO_JUDGE else within):
        found.append("scales (all above 0) are no logarithms")
    if found:
        raise UserError(
            f"holds linear values: its {' and its '.join(found)}",
            where=path,
            fix="write it as other 3D Gaussian splatting programs do, or read it with linear=...",
        )
    if within or positive:
        what = "opacities lie within 0 and 1" if within else "scales are above 0"
        _log.warning("%s: all %s; taken for %s", path, what, "logits" if within else "logarithms")


def _gaussians(table: NDArray[np.void], header: _Header, path: Path, linear: frozenset[Linear]) -> Gaussians:
    names = table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in REST_COUNTS or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise UserError(f"has {rest} f_rest properties, expected f_rest_0.. with 0, 9, 24 or 45 of them", where=path)

    def columns(*wanted: str) -> Tensor:
        return torch.from_numpy(_columns(table, wanted))

    higher = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(table), 3, rest // 3).transpose(1, 2)
    unknown = np.full(len(table), -1, np.int64)
    if (
        "source_view" in names and not (np.abs(table["source_view"].astype(np.float64)) < MOST_VIEWS).all()
    ):  # NaN neither
        raise UserError("has a source_view that is no number of a view", where=path)
    source_view = table["source_view"].astype(np.int64) if "source_view" in names else unknown
    means, opacities, scales = (
        columns("x", "y", "z"),
        columns("opacity")[:, 0],
        columns("scale_0", "scale_1", "scale_2"),
    )
    # What was written here says so by its provenance.
    if not linear and not set(PROVENANCE) <= set(names):
        _refuse_linear(opacities, scales, means, path)
    if "opacity" in linear and not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise UserError("has opacities outside 0 to 1: they are not linear", where=path)
    if "scale" in linear and not bool((scales > 0).all()):
        raise UserError("has scales that are not above 0: they are not linear", where=path)
    scene = Gaussians(
        means=means,
        quat_wxyz=columns(*ROTATION),
        scales=scales if "scale" in linear else scales.exp(),
        opacities=opacities if "opacity" in linear else opacities.sigmoid(),
        sh=torch.cat([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], higher], 1),
        source_view=torch.from_numpy(source_view),
        generated=torch.from_numpy(table["generated"] != 0 if "generated" in names else np.zeros(len(table), bool)),
        antialiased=header.antialiased,
    )
    for name in ("means", "quat_wxyz", "scales", "opacities", "sh"):
        bad = (~torch.isfinite(getattr(scene, name))).nonzero()
        if len(bad):
            raise UserError(f"vertex {int(bad[0, 0])} has {name} that are not finite", where=path)
    flat = (scene.quat_wxyz == 0).all(-1)
    if bool(flat.any()):
        raise UserError(f"vertex {int(flat.nonzero()[0, 0])} has a zero rotation", where=path)
    return scene
