"""A scene in the formats that are asked for, each whole or not at all."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.exports.cameras import write_cameras_csv, write_cameras_json, write_colmap, write_nerfstudio
from sceneexpander.exports.formats import FORMATS
from sceneexpander.exports.maps import write_depth, write_normals
from sceneexpander.exports.mesh import write_collider, write_mesh
from sceneexpander.exports.points import write_points
from sceneexpander.exports.scene import ExportScene
from sceneexpander.files import directory_being_written
from sceneexpander.splatting.ply import write_ply
from sceneexpander.splatting.spz import Version, write_spz

logger = logging.getLogger(__name__)
Writer = Callable[[ExportScene, Path], None]


def write_exports(scene: ExportScene, names: Iterable[str], folder: Path) -> list[Path]:
    """Write the formats of these names into ``folder``; returns what was written. Each appears when it is complete.

    Raises:
        UserError: a format's package is missing, or the scene has nothing that it could hold.
    """
    targets = {item.name: item.target for item in FORMATS}
    written = []
    for name in names:
        target = folder / targets[name]
        if name in _FOLDERS:
            with directory_being_written(target) as scratch:
                _FOLDERS[name](scene, scratch)
        else:
            _FILES[name](scene, target)
        written.append(target)
    return written


def _write_ply(scene: ExportScene, path: Path, *, provenance: bool = True, rgb: bool = False) -> None:
    lines = scene.statement.lines()
    write_ply(scene.reconstruction.gaussians, path, provenance=provenance, rgb=rgb, comments=lines)


def _write_spz(scene: ExportScene, path: Path, *, version: Version) -> None:
    # The statement first: there is never a file of this format without it.
    about = {"about": scene.statement, "statement": scene.statement.sentence()}
    write_json_atomic(path.with_suffix(".about.json"), about)
    cut = write_spz(scene.reconstruction.gaussians, path, version=version)
    if cut:
        logger.warning("%s: values of %d Gaussians were cut to the range of the format", path.name, cut)


_FILES: dict[str, Writer] = {
    "ply": _write_ply,
    "ply-plain": lambda scene, path: _write_ply(scene, path, provenance=False),
    "ply-rgb": lambda scene, path: _write_ply(scene, path, rgb=True),
    "spz": lambda scene, path: _write_spz(scene, path, version=3),
    "spz4": lambda scene, path: _write_spz(scene, path, version=4),
    "points": write_points,
    "mesh": write_mesh,
    "mesh-ply": write_mesh,
    "collider": write_collider,
    "cameras": write_cameras_json,
    "cameras-csv": write_cameras_csv,
}
_FOLDERS: dict[str, Writer] = {
    "colmap": lambda scene, folder: write_colmap(scene, folder, text=False),
    "colmap-text": lambda scene, folder: write_colmap(scene, folder, text=True),
    "nerfstudio": write_nerfstudio,
    "depth": write_depth,
    "normals": write_normals,
}
