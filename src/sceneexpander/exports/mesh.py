"""A surface by fusing the views' rendered depths in a truncated signed distance field (Curless and Levoy 1996), and marching cubes.

Depths are those of the Gaussians that are exported, seen from the views' own cameras, so the mesh shows what the Gaussians show.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.exports.gltf import glb_bytes, load_trimesh
from sceneexpander.exports.scene import ExportScene
from sceneexpander.exports.statement import Statement
from sceneexpander.files import write_bytes_atomic
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import Render, render
from sceneexpander.splatting.ply import ply_comment

VOXELS = 224  # along the longest side
COLLIDER_VOXELS = 64
_MESH_TRUNCATION, _COLLIDER_TRUNCATION = 6.0, 3.0  # in voxels: about 3 and 5 % of the longest side
_FREE = 0.25  # weight of a view that looks past a voxel, against one that sees a surface there: depths disagree by more than a truncation
_COVERED = 0.8  # alpha from which a pixel's depth counts
_STEEPEST = 0.05  # relative step of depth to a neighbour beyond which a pixel lies on an edge, between two surfaces
_EDGE_SHARE = (
    0.02  # of points at either end of each axis that the box leaves out: what is far away would make voxels huge
)
_SMALLEST_PIECE = 0.002  # of all faces: smaller pieces are dust
_CHUNK = 1 << 20  # voxels at once


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """Triangles in the export's frame, counter-clockwise seen from outside. ``generated``: share of each vertex's colour."""

    vertices: NDArray[np.float64]  # (vertex, 3)
    faces: NDArray[np.int64]  # (face, 3)
    rgb: NDArray[np.uint8]  # (vertex, 3)
    generated: NDArray[np.float32]  # (vertex,)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Field:
    """A grid of voxels; the centre of voxel (i, j, k) is ``origin + voxel * (i, j, k)``."""

    origin: Float[Tensor, "3"]
    voxel: float
    shape: tuple[int, int, int]
    distance: Float[Tensor, "x y z"]  # in truncations, positive in front of surfaces
    weight: Float[Tensor, "x y z"]  # of the views that saw the voxel; 0: none did
    colour: Float[Tensor, "x y z 4"]  # red green blue generated


def make_mesh(scene: ExportScene, *, voxels: int) -> Mesh:
    """The visible surface: open where nobody looked."""
    field = _fuse(scene, voxels, _MESH_TRUNCATION)
    known = (field.weight > 0).numpy()
    mesh = _extract(field, np.where(known, field.distance.numpy(), 1.0), known)
    return _without_dust(mesh)


def make_collider(scene: ExportScene, *, voxels: int) -> Mesh:
    """A coarse closed shell around every surface, as thick as the truncation: what nobody saw behind it is empty."""
    field = _fuse(scene, voxels, _COLLIDER_TRUNCATION)
    solid = np.where((field.weight > 0).numpy(), field.distance.numpy(), 1.0)
    for axis in range(3):  # the shell is closed at the box too
        for end in (0, -1):
            np.moveaxis(solid, axis, 0)[end] = 1.0
    return _without_dust(_extract(field, solid, None))


def write_mesh(scene: ExportScene, path: Path) -> None:
    """The visible surface as GLB or PLY, by the path's ending."""
    _write(make_mesh(scene, voxels=VOXELS), scene.statement, path, coloured=True)


def write_collider(scene: ExportScene, path: Path) -> None:
    """The closed shell as GLB, without colours."""
    _write(make_collider(scene, voxels=COLLIDER_VOXELS), scene.statement, path, coloured=False)


def _fuse(scene: ExportScene, voxels: int, truncation: float) -> _Field:
    made = scene.reconstruction
    views = [made.view_ids.index(view.view_id) for view in scene.views]
    if not views:
        raise UserError("has no view with a camera", where=scene.statement.scene, fix="a mesh needs one")
    cameras = made.cameras[views]
    with torch.no_grad():
        seen = [render(made.gaussians, cameras[i]) for i in range(len(views))]
    maps = torch.stack([_maps(one) for one in seen])  # depth (0: none), red green blue, generated
    origin, voxel, shape = _box(scene, maps, cameras, voxels, truncation)
    count = int(np.prod(shape))
    distance, weight = torch.zeros(count), torch.zeros(count)
    colour, colours = torch.zeros(count, 4), torch.zeros(count)
    for start in range(0, count, _CHUNK):
        rows = torch.arange(start, min(start + _CHUNK, count))
        points = origin + voxel * torch.stack(torch.unravel_index(rows, shape), -1)
        for view in range(len(views)):
            # Nearest: between two surfaces there is no depth.
            there, place = cameras[view].look_up(points, maps[view : view + 1], "nearest")
            found = there[0]
            ahead = (found[0] - place.depth[0]) / (truncation * voxel)
            use = place.in_frame[0] & (found[0] > 0) & (ahead > -1)
            trust = torch.where(ahead[use] < 1, 1.0, _FREE)
            distance[rows[use]] += trust * ahead[use].clamp(max=1)
            weight[rows[use]] += trust
            # Colour is that of the views that see the surface here, not of those that look past it.
            at = use & (ahead.abs() < 1)
            colour[rows[at]] += found[1:, at].T
            colours[rows[at]] += 1
    distance /= weight.clamp(min=_FREE)
    colour /= colours.clamp(min=1)[:, None]
    return _Field(
        origin=origin,
        voxel=voxel,
        shape=shape,
        distance=distance.view(shape),
        weight=weight.view(shape),
        colour=colour.view(*shape, 4),
    )


def _maps(seen: Render) -> Float[Tensor, "5 height width"]:
    """Depth (0: none), red, green, blue, generated."""
    depth, alpha = seen.depth[0], seen.alpha[0]
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    steps = [
        (padded[1 + y : 1 + y + depth.shape[0], 1 + x : 1 + x + depth.shape[1]] - depth).abs()
        for y, x in ((0, 1), (0, -1), (1, 0), (-1, 0))
    ]
    smooth = torch.stack(steps).amax(0) < _STEEPEST * depth
    kept = torch.where((alpha > _COVERED) & smooth, depth, 0.0)
    rgb = (seen.rgb[0] / alpha.clamp(min=_COVERED)).clamp(0, 1)
    return torch.cat([kept[None], rgb, seen.generated])


def _box(
    scene: ExportScene, maps: Tensor, cameras: Cameras, voxels: int, truncation: float
) -> tuple[Float[Tensor, "3"], float, tuple[int, int, int]]:
    """(centre of the first voxel, length of a voxel, number of them along each axis)."""
    points = cameras.unproject(maps[:, 0].clamp(min=1e-6))[maps[:, 0] > 0]
    if not len(points):
        fix = "crop less, or export its points"
        raise UserError("covers no view enough for a surface", where=scene.statement.scene, fix=fix)
    points = points[:: max(1, len(points) // 200_000)]
    low, high = (torch.quantile(points, share, dim=0) for share in (_EDGE_SHARE, 1 - _EDGE_SHARE))
    extent = (high - low).clamp(min=float((high - low).max()) * 0.02)
    voxel = float(extent.max()) / voxels
    margin = (truncation + 1) * voxel
    shape = [int(n) for n in ((extent + 2 * margin) / voxel).ceil()]
    return low - margin, voxel, (shape[0], shape[1], shape[2])


def _extract(field: _Field, values: NDArray[np.float32], known: NDArray[np.bool_] | None) -> Mesh:
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        fix = "pip install 'sceneexpander[exports]'"
        raise UserError("needs the package scikit-image", where="mesh", fix=fix) from None
    try:
        # A cell counts only if all its corners are known: elsewhere the field ends without a surface. The mask's entry is the last corner.
        corners = None if known is None else minimum_filter(known, size=2)
        cells, faces, _, _ = marching_cubes(values, 0.0, mask=corners, gradient_direction="descent")
    except (ValueError, RuntimeError):  # no value crosses 0
        raise UserError("has no surface", where="mesh", fix="crop less, or export its points") from None
    nearest = np.rint(cells).astype(np.int64).clip(0, np.array(field.shape) - 1)
    colour = field.colour.numpy()[tuple(nearest.T)]
    return Mesh(
        vertices=field.origin.double().numpy() + field.voxel * cells.astype(np.float64),
        faces=faces.astype(np.int64),
        rgb=(colour[:, :3] * 255).round().astype(np.uint8),
        generated=colour[:, 3].astype(np.float32),
    )


def _without_dust(mesh: Mesh) -> Mesh:
    """Without pieces of very few faces, and without the vertices that only they used."""
    count, edges = len(mesh.vertices), mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    faces_of = np.bincount(piece[mesh.faces[:, 0]])
    kept = mesh.faces[(faces_of >= _SMALLEST_PIECE * len(mesh.faces))[piece[mesh.faces[:, 0]]]]
    used, faces = np.unique(kept, return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3),
        rgb=mesh.rgb[used],
        generated=mesh.generated[used],
    )


def _write(mesh: Mesh, statement: Statement, path: Path, *, coloured: bool) -> None:
    if path.suffix == ".ply":
        write_bytes_atomic(path, _ply_bytes(mesh, statement))
        return
    trimesh = load_trimesh()
    colours: dict[str, Any] = {}
    if coloured:
        colours["vertex_colors"] = np.concatenate([mesh.rgb, np.full((len(mesh.rgb), 1), 255, np.uint8)], 1)
        # glTF: names of an application's own attributes begin with an underscore.
        colours["vertex_attributes"] = {"_generated": mesh.generated}
    content = trimesh.Scene(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **colours))
    write_bytes_atomic(path, glb_bytes(content, statement))


def _ply_bytes(mesh: Mesh, statement: Statement) -> bytes:
    fields = [("xyz", "<f4", 3), ("rgb", "u1", 3), ("generated", "<f4")]
    rows = np.empty(len(mesh.vertices), fields)
    rows["xyz"], rows["rgb"], rows["generated"] = mesh.vertices, mesh.rgb, mesh.generated
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", *map(ply_comment, statement.lines())]
    header += [f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property uchar {colour}" for colour in ("red", "green", "blue")), "property float generated"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    return "\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes()
