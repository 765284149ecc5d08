"""What a method made of one case of the benchmark, as others hand it in: ``RESULTS/SCENE/GRADE/`` with cameras and what they see.

Cameras, one of:

- ``cameras.json``: a list ``cameras`` with ``name`` (``captured_1`` to ``captured_5``, ``inserted``; an ending is passed over) and
  ``world_from_cam`` (4 x 4 or 3 x 4, OpenCV axes; null: the method could not place that view). ``sceneexpander export`` writes it.
- ``transforms.json``, nerfstudio's: ``frames`` with ``file_path`` (named as above) and ``transform_matrix``; OpenGL axes unless
  ``camera_convention`` says ``opencv``. Views that were not placed are named in ``unplaced``.

All photographs must be there; the inserted picture may be left out. The world's frame and scale are the method's own.

What is seen, one of (or neither: then cameras alone are compared):

- ``gaussians.ply``: 3D Gaussians in the usual layout, in the cameras' world;
- ``renders/VIEW.png`` and ``depths/VIEW.npy`` (z-depth in the cameras' unit, float, 0 where nothing is seen) for the views of
  ``truth/cameras.json``, as large as the photographs, seen from those cameras brought into the method's world (``expandbench place``).
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.errors import UserError, printable
from sceneexpander.expandbench.dataset import CAPTURED_VIEWS, INSERTED
from sceneexpander.expandbench.scenes import CAPTURED, VIEWS
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.ingest.decode import read_picture
from sceneexpander.ingest.jsonfile import read_user_json, text_at
from sceneexpander.ingest.sources.capture import rigid_pose
from sceneexpander.plainfiles import read_plain_file
from sceneexpander.splatting.ply import read_ply

CAMERAS, TRANSFORMS, GAUSSIANS = "cameras.json", "transforms.json", "gaussians.ply"
RENDERS, DEPTHS = "renders", "depths"
_CONVENTION_KEYS = ("convention", "camera_convention", "camera_axes", "coordinate_system")
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LIMIT_BYTES = 512 * 2**20
_NUMBERED = re.compile(r"\d+_")  # before names in exports of this program
_Poses = dict[str, "np.ndarray[Any, Any] | None"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A result in the method's own world. Poses in double precision; those that are not ``posed`` hold placeholders.

    ``renders`` and ``depths`` are by name of the true view; both are empty where there are Gaussians.
    """

    captured: Float[Tensor, "view 4 4"]
    posed: Bool[Tensor, "view"]
    inserted: Float[Tensor, "4 4"] | None = None
    gaussians: Gaussians | None = None
    renders: Mapping[str, Float[Tensor, "3 height width"]] = field(default_factory=dict)
    depths: Mapping[str, Float[Tensor, "height width"]] = field(default_factory=dict)


def entry_of(reconstruction: Reconstruction) -> Entry:
    """A reconstruction of this program as an entry: captured views first, then the inserted one if there is any."""
    poses = reconstruction.world_from_cam.double()
    inserted = len(poses) > CAPTURED and bool(reconstruction.posed[CAPTURED])
    return Entry(
        captured=poses[:CAPTURED],
        posed=reconstruction.posed[:CAPTURED],
        inserted=poses[CAPTURED] if inserted else None,
        gaussians=reconstruction.gaussians,
    )


def read_entry(folder: Path, height: int, width: int) -> Entry:
    """What somebody handed in for one case, see the module.

    Args:
        folder: of the case.
        height, width: of the photographs, which pictures and depths must have.

    Raises:
        UserError: something is missing, ambiguous, damaged, not finite, or not of that size; names the file.
    """
    poses = _read_cameras(folder)
    ply, pictures, depths = folder / GAUSSIANS, _files(folder / RENDERS, ".png"), _files(folder / DEPTHS, ".npy")
    if ply.exists() and (pictures or depths):
        raise UserError(
            f"holds {GAUSSIANS} as well as {RENDERS}/ or {DEPTHS}/", where=folder, fix="leave one of them out"
        )
    placed = [poses[name] for name in CAPTURED_VIEWS]
    inserted = poses.get(INSERTED)
    return Entry(
        captured=torch.from_numpy(np.stack([np.eye(4) if pose is None else pose for pose in placed])),
        posed=torch.tensor([pose is not None for pose in placed]),
        inserted=None if inserted is None else torch.from_numpy(inserted),
        gaussians=read_ply(ply) if ply.exists() else None,
        renders={name: _read_render(path, height, width) for name, path in pictures.items()},
        depths={name: _read_depth(path, height, width) for name, path in depths.items()},
    )


def _read_cameras(folder: Path) -> _Poses:
    """Poses by view, OpenCV axes; None: not placed. All captured views are among them."""
    files = [folder / name for name in (CAMERAS, TRANSFORMS) if (folder / name).exists()]
    if len(files) != 1:
        problem = "holds both" if files else "holds neither"
        raise UserError(f"{problem} {CAMERAS} {'and' if files else 'nor'} {TRANSFORMS}", where=folder, fix="give one")
    (path,) = files
    content = read_user_json(path)
    found = _read_transforms(content, path) if path.name == TRANSFORMS else _read_own(content, path)
    missing = [name for name in CAPTURED_VIEWS if name not in found]
    if missing:
        count = f"{CAPTURED - len(missing)} of the {CAPTURED} photographs' cameras"
        raise UserError(
            f"has {count}: {', '.join(missing)} missing", where=path, fix="say null where a view could not be placed"
        )
    return found


def _read_own(content: dict[str, Any], path: Path) -> _Poses:
    _check_convention(content, path, known=("opencv",))
    poses: _Poses = {}
    for index, camera in enumerate(_list(content, "cameras", path)):
        where = f"{path}: camera {index}"
        matrix = camera.get("world_from_cam")
        if "world_from_cam" not in camera:
            raise UserError("has no 'world_from_cam'", where=where)
        _add(poses, camera, "name", None if matrix is None else rigid_pose(matrix, where), where)
    return poses


def _read_transforms(content: dict[str, Any], path: Path) -> _Poses:
    convention = _check_convention(content, path, known=("opencv", "opengl", "blender", "nerfstudio"))
    turn = np.eye(4) if convention == "opencv" else _OPENCV_FROM_OPENGL
    poses: _Poses = {}
    for index, frame in enumerate(_list(content, "frames", path)):
        where = f"{path}: frame {index}"
        _add(poses, frame, "file_path", rigid_pose(frame.get("transform_matrix"), where) @ turn, where)
    unplaced = content.get("unplaced", [])
    if not isinstance(unplaced, list) or not set(map(str, unplaced)) <= {*CAPTURED_VIEWS, INSERTED}:
        raise UserError("has something else than names of views in 'unplaced'", where=path)
    return poses | dict.fromkeys(map(str, unplaced))


def _check_convention(content: dict[str, Any], path: Path, *, known: tuple[str, ...]) -> str:
    """The convention that the file states; the last known one if it states none, or says it in a sentence that names one."""
    for key in _CONVENTION_KEYS:
        said = text_at(content, key, path)
        if said is not None:
            named = [name for name in known if name in said.casefold().replace(" ", "")]
            if len(named) != 1:
                fix = f"give cameras as {' or '.join(known)}"
                raise UserError(f"has the unknown {key} {printable(said[:60])!r}", where=path, fix=fix)
            return named[0]
    return known[-1]


def _list(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    values = content.get(key)
    if not isinstance(values, list) or not values or not all(isinstance(value, dict) for value in values):
        raise UserError(f"has no list of {key}", where=path)
    return values


def _add(poses: _Poses, camera: dict[str, Any], key: str, pose: Any, where: str) -> None:
    text = text_at(camera, key, where)
    if text is None:
        raise UserError(f"has no {key!r}", where=where)
    stem = Path(text).stem
    # Exports say which view was generated, whatever its picture was called.
    name = INSERTED if camera.get("generated") is True else stem
    if name not in {*CAPTURED_VIEWS, INSERTED}:
        name = _NUMBERED.sub("", stem, count=1)
    if name not in {*CAPTURED_VIEWS, INSERTED}:
        known = f"{CAPTURED_VIEWS[0]} to {CAPTURED_VIEWS[-1]} and {INSERTED}"
        raise UserError(f"is called {printable(stem[:60])!r}, views are {known}", where=where)
    if name in poses:
        raise UserError(f"is the second one of {name}", where=where)
    poses[name] = pose


def _files(folder: Path, ending: str) -> dict[str, Path]:
    """Files by the true view that they are named after. Raises `UserError` for other names."""
    if not folder.exists():
        return {}
    found = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.casefold() == ending}
    unknown = [name for name in found if name not in VIEWS]
    if unknown:
        raise UserError(f"is named after no view, they are {', '.join(VIEWS)}", where=found[unknown[0]])
    return found


def _read_render(path: Path, height: int, width: int) -> Float[Tensor, "3 height width"]:
    pixels = read_picture(path).pixels
    if pixels.shape[:2] != (height, width):
        raise _wrong_size(path, pixels.shape, height, width)
    return torch.from_numpy(pixels.transpose(2, 0, 1).copy()).float() / 255


def _read_depth(path: Path, height: int, width: int) -> Float[Tensor, "height width"]:
    try:
        depth = np.load(io.BytesIO(read_plain_file(path, limit_bytes=_LIMIT_BYTES)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise UserError(f"is no NumPy array ({' '.join(str(error).split())[:80]})", where=path) from None
    if not isinstance(depth, np.ndarray) or depth.dtype.kind != "f":
        raise UserError("does not hold floating-point numbers", where=path)
    if depth.shape != (height, width):
        raise _wrong_size(path, depth.shape, height, width)
    if not np.isfinite(depth).all() or (depth < 0).any():
        raise UserError("holds depths that are negative or not finite", where=path, fix="write 0 where nothing is seen")
    return torch.from_numpy(depth.astype(np.float32))


def _wrong_size(path: Path, shape: tuple[int, ...], height: int, width: int) -> UserError:
    return UserError(f"is {' x '.join(map(str, shape))}, expected {height} x {width} (rows x columns)", where=path)
