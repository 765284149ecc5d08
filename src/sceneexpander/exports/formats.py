"""The names of the formats. Nothing heavy is imported here: the configuration checks names before anything starts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sceneexpander.errors import UserError, did_you_mean


@dataclass(frozen=True, slots=True)
class Format:
    """One word after ``--format``.

    Attributes:
        name: the word.
        target: file or folder (without an ending) that is written.
        summary: what it is, for the list of formats.
    """

    name: str
    target: str
    summary: str


FORMATS = (
    Format("ply", "gaussians.ply", "Gaussians, with provenance as two more properties"),
    Format("ply-plain", "gaussians_plain.ply", "Gaussians without provenance, for readers of one row length"),
    Format("ply-rgb", "gaussians_rgb.ply", "Gaussians with red green blue, for MeshLab and CloudCompare"),
    Format("spz", "gaussians.spz", "Gaussians in a tenth of the bytes, version 3, which most programs open"),
    Format("spz4", "gaussians_v4.spz", "the same, version 4, which the newest programs open"),
    Format("points", "points.glb", "coloured points and cameras"),
    Format("mesh", "mesh.glb", "surface with vertex colours"),
    Format("mesh-ply", "mesh.ply", "the same as PLY"),
    Format("collider", "collider.glb", "closed coarse surface without colours, for physics"),
    Format("colmap", "colmap", "COLMAP model (binary), pictures beside it"),
    Format("colmap-text", "colmap_text", "COLMAP model (text), pictures beside it"),
    Format("nerfstudio", "nerfstudio", "transforms.json, pictures and points beside it"),
    Format("depth", "depth", "depth of every view: 16-bit PNG, float NPY, preview"),
    Format("normals", "normals", "normals of every view: PNG, float NPY"),
    Format("cameras", "cameras.json", "cameras as JSON, the convention written inside"),
    Format("cameras-csv", "cameras.csv", "cameras as a table, the convention written inside"),
)
NAMES = tuple(item.name for item in FORMATS)


def check_formats(names: Iterable[str], *, where: str) -> None:
    """Raise `UserError` for the first name that is no format, or that stands twice."""
    seen: set[str] = set()
    for name in names:
        if name not in NAMES:
            raise UserError(f"unknown format {name!r}", where=where, fix=did_you_mean(name, NAMES))
        if name in seen:
            raise UserError(f"names {name!r} twice", where=where)
        seen.add(name)
