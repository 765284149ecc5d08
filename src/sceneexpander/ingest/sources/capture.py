"""A capture: pictures, and what came with them. What every source makes, whatever the files look like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.decode import LIMIT_BYTES
from sceneexpander.ingest.depth_files import DepthFile
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.plainfiles import read_plain_file

_NOT_RIGID = 1e-2  # text files keep a few digits of a rotation
_LARGEST_COORDINATE = 1e9
_MOST_NAMED = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One picture of a capture. Everything but the picture may be unknown.

    Attributes:
        name: for people and view ids, e.g. the file's name.
        picture: the file, or the bytes of one that is no file of its own (a frame of a video).
        lens: its calibrated camera. Pictures with one are taken as their samples are stored: calibrations do not look at EXIF.
        world_from_cam: camera-to-world, rigid, OpenCV axes, in the capture's own world frame and unit.
        mask: a grey picture of the same size, black where nothing is to be used.
        depth: z-depth in the unit of the poses.
    """

    name: str
    picture: Path | bytes
    lens: Lens | None = None
    world_from_cam: Float[np.ndarray, "4 4"] | None = None
    mask: Path | None = None
    depth: DepthFile | None = None

    def data(self) -> bytes:
        """The bytes of the picture file. Raises `UserError` if it cannot be read."""
        if isinstance(self.picture, bytes):
            return self.picture
        return read_plain_file(self.picture, limit_bytes=LIMIT_BYTES)

    @property
    def calibrated(self) -> bool:
        """Whether anything is known of its camera."""
        return self.lens is not None or self.world_from_cam is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """Pictures in order, and what was noticed about the files.

    Attributes:
        shots: the pictures.
        notes: for people: what was left out and why.
        files: what else the source has read and needs again (camera files), for copies.
        metric: whether the unit of poses and depth is the metre.
        chosen: whether the source itself decides which pictures there are, so that more than can be used are thinned and not refused.
    """

    shots: tuple[Shot, ...]
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    metric: bool = False
    chosen: bool = False

    @property
    def all_files(self) -> tuple[Path, ...]:
        """Every file that reading the capture again needs."""
        found = list(self.files)
        for shot in self.shots:
            found += [path for path in (shot.picture, shot.mask) if isinstance(path, Path)]
            found += [] if shot.depth is None else [shot.depth.path]
        return tuple(dict.fromkeys(found))

    def thinned(self, count: int) -> Capture:
        """At most ``count`` of the pictures, evenly over the whole, with a note; refusing more is for pictures that a person chose."""
        if not self.chosen or len(self.shots) <= count:
            return self
        kept = np.linspace(0, len(self.shots) - 1, count).round().astype(int)
        note = f"{count} of {len(self.shots)} pictures are used, evenly spaced (scene.max_views)"
        return replace(self, shots=tuple(self.shots[k] for k in kept), notes=(*self.notes, note))


class Source(Protocol):
    """A kind of data that captures come in.

    ``title`` is what people call it, e.g. "a COLMAP model".
    """

    title: str

    def detect(self, place: Path) -> bool:
        """Whether ``place``, a file or folder, looks like this. Looks at names and first bytes only, and raises nothing."""
        ...

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The capture, with paths that start with ``place``, or with its folder if it is a file.

        Raises:
            UserError: one line about what cannot be used.
        """
        ...


def rigid_pose(matrix: object, where: str | Path) -> Float[np.ndarray, "4 4"]:
    """A camera-to-world matrix (3x4 or 4x4 numbers), its rotation made exact.

    Raises:
        UserError: it is no rigid motion.
    """
    values = number_array(matrix, where)
    if values.shape not in ((3, 4), (4, 4)):
        raise UserError(f"holds a pose of shape {values.shape}, expected 3x4 or 4x4 numbers", where=where)
    pose = np.eye(4)
    pose[:3] = values[:3]
    if values.shape == (4, 4) and np.abs(values[3] - [0, 0, 0, 1]).max() > _NOT_RIGID:
        raise UserError("holds a pose whose last row is not 0 0 0 1", where=where)
    rotation = pose[:3, :3]
    if np.abs(pose).max() > _LARGEST_COORDINATE:
        raise UserError("holds a pose beyond any place", where=where)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _NOT_RIGID or np.linalg.det(rotation) < 0:
        raise UserError("holds a pose whose rotation is none", where=where, fix="give rigid camera-to-world matrices")
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt
    return pose


def number_array(value: object, where: str | Path) -> Float[np.ndarray, "..."]:
    """Nested lists of numbers as an array. Raises `UserError` unless they are finite numbers in equal rows."""
    rows: Any = value
    try:
        found = np.asarray(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UserError("holds something else where a matrix of numbers is expected", where=where) from None
    if found.dtype != np.float64 or not np.isfinite(found).all():
        raise UserError("holds a number that is not finite", where=where)
    return found


def member(folder: Path, name: str, where: str | Path) -> Path:
    """The path of a file that a camera file names, below ``folder``. Links are the user's own business, names of a file are not.

    Raises:
        UserError: the name leads out of the folder.
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if ".." in parts or any(part.startswith("/") for part in parts) or not parts:
        raise UserError(f"names {printable(name[:80])}, outside of {folder}", where=where, fix="put the files together")
    return folder.joinpath(*parts)


def name_some(names: Sequence[str]) -> str:
    """A few of the names, for one line."""
    rest = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {rest} more" if rest > 0 else "")
