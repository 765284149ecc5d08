"""The benchmark on disk, for methods of all kinds: what they may be given, and the exact truth about it.

Layout::

    expandbench.json                    version, splits, scenes, grades, content hash: written last
    SCENE/scene.json                    what the scene is, its files and hashes
    SCENE/captured/captured_1.png ...   the photographs
    SCENE/inserted/GRADE.png            the picture to be inserted, as a generator with these errors draws it (see `grades`)
    SCENE/truth/cameras.json            poses and intrinsics of all true views, see `VIEWS`
    SCENE/truth/VIEW.npz                ``depth``, ``normals`` and ``seen`` (see `Seen`) at the centres of the view's pixels
    SCENE/truth/intended.png ...        the consistent pictures from where no photograph was taken
    SCENE/truth/captured.ply, ...       points of the true surfaces, with normals and colours: what the photographs show
    SCENE/truth/expanded.ply            and what only the other views show
    SCENE/truth/inserted.json           everything that is wrong with each inserted picture

Everything is in the first captured view's frame, in metres. A scene's folder appears when all of it is written.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from enum import IntEnum
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.artifacts.store import (
    read_json,
    read_typed,
    sha256_of_bytes,
    sha256_of_file,
    to_plain,
    write_json_atomic,
)
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.expandbench.grades import GRADES, Grade
from sceneexpander.expandbench.scenes import (
    CAPTURED,
    SCENES,
    SPLITS,
    VIEWS,
    BenchScene,
    DrawnScene,
    bench_scene,
    draw_scene,
)
from sceneexpander.files import directory_being_written
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest.decode import read_picture
from sceneexpander.synthetic.bundled import unseen_by

VERSION = "1.0"
# Of all scenes of this version, as they were made where it was published. Other processors and versions of NumPy and OpenCV can round the
# last bits otherwise.
CONTENT = "ee25bd1e6eb48ab071e384dae1152a04997bfe2d394715a83fa1a75fa88f8e73"
SCHEMA, SCENE_SCHEMA = "expandbench/1", "expandbench-scene/1"
MANIFEST, SCENE_FACTS = "expandbench.json", "scene.json"
AGAIN = "make it again: sceneexpander expandbench generate FOLDER"
CAPTURED_VIEWS, HELD_OUT = VIEWS[:CAPTURED], VIEWS[CAPTURED + 1 :]
INTENDED = VIEWS[CAPTURED]
INSERTED = "inserted"  # what methods call the inserted picture's camera
# Grades that differ in what a method is told, and not in the picture, share it.
PICTURED: dict[str, Grade] = {name: grade for name, grade in GRADES.items() if not grade.told}
POINT_STRIDE = 4  # pixels from one point of the geometry to the next


class Seen(IntEnum):
    """By which pictures a pixel's surface is shown."""

    CAPTURED = 0  # a photograph
    EXPANDED = 1  # no photograph, but the consistent inserted picture
    UNKNOWN = 2  # neither: nothing is measured there
    NOTHING = 3  # there is no surface: sky


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueDetail:
    """The truth about one view, at the centres of its picture's pixels.

    ``depth`` is z-depth in metres, 0 where there is no surface; ``normals`` are in the camera's frame, facing it; ``seen`` holds `Seen`.
    """

    image: Float[Tensor, "3 height width"]
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    seen: UInt8[Tensor, "height width"]
    world_from_cam: Float[Tensor, "4 4"]  # double precision
    intrinsics_px: Float[Tensor, "3 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueScene:
    """The truth about a scene. ``size_m`` is the median depth of its photographs: what lengths are divided by."""

    name: str
    views: dict[str, TrueDetail]
    size_m: float

    @property
    def captured_poses(self) -> Float[Tensor, "view 4 4"]:
        """Of the photographs."""
        return torch.stack([self.views[name].world_from_cam for name in CAPTURED_VIEWS])


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFacts:
    """What ``scene.json`` says. ``files``: the SHA-256 of each file; ``content``: that of what they hold, whatever packed them."""

    version: str
    name: str
    kind: str
    seed: int
    split: str
    shrink: int
    height: int
    width: int
    size_m: float
    grades: tuple[str, ...]
    files: Mapping[str, str]
    content: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What ``expandbench.json`` says. ``complete``: all scenes of the version are there, at full size."""

    version: str
    content: str
    complete: bool
    splits: Mapping[str, tuple[str, ...]]
    scenes: Mapping[str, str]  # content of each


def picture_of(view: str) -> str:
    """The file of a true picture, in the scene's folder."""
    return f"captured/{view}.png" if view in CAPTURED_VIEWS else f"truth/{view}.png"


def true_details(drawn: DrawnScene) -> dict[str, TrueDetail]:
    """The truth about all views of a scene."""
    rendered, cameras = drawn.rendered, drawn.cameras
    pictures, relative = drawn.pictures(), torch.from_numpy(drawn.relative)
    found = {}
    for index, name in enumerate(VIEWS):
        depth = rendered.depth[index]
        found[name] = TrueDetail(
            image=pictures[index],
            depth=torch.from_numpy(np.where(np.isfinite(depth), depth, np.float32(0))),
            normals=torch.from_numpy(rendered.normals[index].astype(np.float16)),
            seen=torch.from_numpy(_seen(index, rendered.depth, cameras)),
            world_from_cam=relative[index],
            intrinsics_px=cameras.intrinsics_px[index].clone(),
        )
    return found


def _seen(index: int, depths: NDArray[Any], cameras: Cameras) -> NDArray[np.uint8]:
    depth, camera = depths[index], cameras[index]
    photographed = np.full(depth.shape, index < CAPTURED)
    if index >= CAPTURED:
        photographed = ~unseen_by(depth, camera, depths[:CAPTURED], cameras[:CAPTURED])
    intended = np.full(depth.shape, index == CAPTURED)
    if index > CAPTURED:
        only = slice(CAPTURED, CAPTURED + 1)
        intended = ~unseen_by(depth, camera, depths[only], cameras[only])
    seen = np.where(photographed, Seen.CAPTURED, np.where(intended, Seen.EXPANDED, Seen.UNKNOWN))
    return np.where(np.isfinite(depth), seen, Seen.NOTHING).astype(np.uint8)


def scene_size_m(views: Mapping[str, TrueDetail]) -> float:
    """The median depth of the photographs."""
    depth = torch.stack([views[name].depth for name in CAPTURED_VIEWS])
    return float(depth[depth > 0].median())


@dataclass(frozen=True, slots=True)
class _Folder:
    """A scene's folder that is being filled. What is written is noted twice: the file's bytes, and what they hold."""

    path: Path
    files: dict[str, str] = field(default_factory=dict)
    content: dict[str, str] = field(default_factory=dict)

    def write(self, name: str, data: bytes, *arrays: NDArray[Any]) -> None:
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
        self.files[name] = sha256_of_bytes(data)
        held = hashlib.sha256()
        for array in arrays:
            held.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        self.content[name] = held.hexdigest() if arrays else self.files[name]

    def write_picture(self, name: str, pixels: NDArray[np.uint8]) -> None:
        done, packed = cv2.imencode(".png", pixels[..., ::-1])
        if not done:
            raise ValueError(f"cannot encode {name} {pixels.shape}")
        self.write(name, packed.tobytes(), pixels)

    def write_arrays(self, name: str, **arrays: NDArray[Any]) -> None:
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)  # type: ignore[arg-type]
        self.write(name, packed.getvalue(), *arrays.values())

    def write_json(self, name: str, value: object) -> None:
        self.write(name, (json.dumps(to_plain(value), indent=1, sort_keys=True, allow_nan=False) + "\n").encode())


def write_scene(name: str, folder: Path, *, shrink: int = 1, grades: Collection[str] = tuple(PICTURED)) -> SceneFacts:
    """Draw a scene of `SCENES` and write it to ``folder/name``, all or nothing.

    Args:
        name: of the scene.
        folder: of the benchmark.
        shrink: pictures have that many times fewer pixels per side: for trying things out.
        grades: of `PICTURED`.
    """
    drawn = draw_scene(name, shrink=shrink)
    scene, views = bench_scene(drawn), true_details(drawn)
    height, width = views[INTENDED].depth.shape
    with directory_being_written(folder / name) as scratch:
        target = _Folder(scratch)
        for view in CAPTURED_VIEWS:
            target.write_picture(picture_of(view), to_uint8(views[view].image))
        _write_inserted(target, scene, grades)
        _write_truth(target, views)
        kind, seed = SCENES[name]
        facts = SceneFacts(
            version=VERSION,
            name=name,
            kind=kind,
            seed=seed,
            split=next(split for split, names in SPLITS.items() if name in names),
            shrink=shrink,
            height=height,
            width=width,
            size_m=scene_size_m(views),
            grades=tuple(grades),
            files=target.files,
            content=_digest(target.content),
        )
        write_json_atomic(scratch / SCENE_FACTS, {"schema": SCENE_SCHEMA, **to_plain(facts)})
    return facts


def _write_inserted(target: _Folder, scene: BenchScene, grades: Collection[str]) -> None:
    first_from_world = np.linalg.inv(scene.cameras.world_from_cam[0].numpy())
    wrong = {}
    for grade in grades:
        drawn = scene.draw(PICTURED[grade].misalignment)
        target.write_picture(f"inserted/{grade}.png", np.round(drawn.image * 255).astype(np.uint8))
        wrong[grade] = {
            **drawn.record(),
            "world_from_used_cam": (first_from_world @ drawn.world_from_used_cam).tolist(),
        }
    target.write_json("truth/inserted.json", wrong)


def _write_truth(target: _Folder, views: Mapping[str, TrueDetail]) -> None:
    cameras = []
    for name, view in views.items():
        if name not in CAPTURED_VIEWS:
            target.write_picture(picture_of(name), to_uint8(view.image))
        planes = {"depth": view.depth.numpy(), "normals": view.normals.numpy(), "seen": view.seen.numpy()}
        target.write_arrays(f"truth/{name}.npz", **planes)
        cameras.append(
            {
                "name": f"{name}.png",
                "height": view.depth.shape[0],
                "width": view.depth.shape[1],
                "world_from_cam": view.world_from_cam.tolist(),
                "intrinsics_px": view.intrinsics_px.tolist(),
            }
        )
    target.write_json("truth/cameras.json", {"convention": "opencv", "metric": True, "cameras": cameras})
    for region, names in ((Seen.CAPTURED, CAPTURED_VIEWS), (Seen.EXPANDED, VIEWS[CAPTURED:])):
        _write_points(target, f"truth/{region.name.lower()}.ply", [views[name] for name in names], region)


def grid_of(region: Seen, view: TrueDetail) -> Tensor:
    """The pixels (height, width; bool) at which the geometry of a region is sampled in a view."""
    grid = torch.zeros_like(view.depth, dtype=torch.bool)
    grid[POINT_STRIDE // 2 :: POINT_STRIDE, POINT_STRIDE // 2 :: POINT_STRIDE] = True
    return grid & (view.seen == region)


def _write_points(target: _Folder, name: str, views: Sequence[TrueDetail], region: Seen) -> None:
    rows = []
    for view in views:
        keep = grid_of(region, view)
        pose = view.world_from_cam
        points = unproject_to_world(view.depth.double(), view.intrinsics_px, pose)[keep]
        normals = view.normals[keep].double() @ pose[:3, :3].T
        row = np.empty(len(points), [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
        row["xyz"], row["normal"], row["rgb"] = points.numpy(), normals.numpy(), to_uint8(view.image)[keep.numpy()]
        rows.append(row)
    table = np.concatenate(rows)
    properties = [f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *properties, "end_header\n"]
    target.write(name, "\n".join(header).encode() + table.tobytes())


def _digest(parts: Mapping[str, str]) -> str:
    return sha256_of_bytes("".join(f"{name} {parts[name]}\n" for name in sorted(parts)).encode())


def generate(
    folder: Path,
    names: Sequence[str],
    *,
    shrink: int = 1,
    grades: Collection[str] = tuple(PICTURED),
    processes: int = 1,
    on_scene: Callable[[SceneFacts, bool], None] | None = None,
) -> Manifest:
    """Write scenes that are not there yet, and the manifest. What was interrupted goes on; damaged scenes are made again.

    Args:
        folder: of the benchmark.
        names: of the scenes.
        shrink: see `write_scene`.
        grades: see `write_scene`.
        processes: scenes that are worked on at the same time.
        on_scene: called with each scene's facts, and whether it was made now.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = []
    for name in names:
        facts = _facts_if_whole(folder, name)
        if facts is None or (facts.version, facts.shrink, set(facts.grades)) != (VERSION, shrink, set(grades)):
            missing.append(name)
        elif on_scene is not None:
            on_scene(facts, False)
    for facts in _written(missing, folder, shrink, grades, processes):
        if on_scene is not None:
            on_scene(facts, True)
    scenes: dict[str, SceneFacts] = {}
    for name in SCENES:
        if (folder / name / SCENE_FACTS).is_file():
            found = read_facts(folder, name)
            if found.version == VERSION:
                scenes[name] = found
    contents = {name: found.content for name, found in scenes.items()}
    full = all(found.shrink == 1 and set(found.grades) == set(PICTURED) for found in scenes.values())
    manifest = Manifest(
        version=VERSION,
        content=_digest(contents),
        complete=full and set(scenes) == set(SCENES),
        splits={split: tuple(name for name in names if name in scenes) for split, names in SPLITS.items()},
        scenes=contents,
    )
    write_json_atomic(folder / MANIFEST, {"schema": SCHEMA, **to_plain(manifest)})
    return manifest


def _written(
    names: Sequence[str], folder: Path, shrink: int, grades: Collection[str], processes: int
) -> Iterator[SceneFacts]:
    if processes <= 1 or len(names) < 2:
        for name in names:
            yield write_scene(name, folder, shrink=shrink, grades=grades)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_alone) as pool:
        yield from pool.map(_write_one, [(name, folder, shrink, tuple(grades)) for name in names])


def _alone() -> None:
    """Processes side by side want one thread each."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _write_one(given: tuple[str, Path, int, tuple[str, ...]]) -> SceneFacts:
    name, folder, shrink, grades = given
    return write_scene(name, folder, shrink=shrink, grades=grades)


def read_manifest(folder: Path) -> Manifest:
    """What the folder holds. Raises `UserError` if it is no benchmark, or one of another version."""
    if not (folder / MANIFEST).is_file():
        fix = "make it: sceneexpander expandbench generate FOLDER"
        raise UserError(f"holds no {MANIFEST}: it is no benchmark, or not finished", where=folder, fix=fix)
    content = read_json(folder / MANIFEST)
    found = content.pop("schema", None) if isinstance(content, dict) else None
    if found != SCHEMA:
        raise UserError(f"is not of schema {SCHEMA!r}", where=folder / MANIFEST, fix=AGAIN)
    manifest = read_typed(Manifest, content, folder / MANIFEST, fix=AGAIN)
    if manifest.version != VERSION:
        raise UserError(f"is of version {manifest.version}, this is {VERSION}", where=folder / MANIFEST, fix=AGAIN)
    return manifest


def read_facts(folder: Path, name: str) -> SceneFacts:
    """What ``scene.json`` of a scene says. Raises `UserError` if it is missing or damaged."""
    path = folder / name / SCENE_FACTS
    if not path.is_file():
        raise UserError("does not exist", where=path, fix=AGAIN)
    content = read_json(path)
    found = content.pop("schema", None) if isinstance(content, dict) else None
    if found != SCENE_SCHEMA:
        raise UserError(f"is not of schema {SCENE_SCHEMA!r}", where=path, fix=AGAIN)
    return read_typed(SceneFacts, content, path, fix=AGAIN)


def check_scene(folder: Path, name: str) -> SceneFacts:
    """The scene's facts, if every file is as it was written. Raises `UserError` naming the first that is not."""
    facts = read_facts(folder, name)
    for file, digest in facts.files.items():
        path = folder / name / file
        if not path.is_file():
            raise UserError("is missing", where=path, fix=AGAIN)
        if sha256_of_file(path) != digest:
            raise UserError("is not as it was written", where=path, fix=AGAIN)
    return facts


def _facts_if_whole(folder: Path, name: str) -> SceneFacts | None:
    try:
        return check_scene(folder, name)
    except UserError:
        return None


def load_truth(folder: Path, name: str) -> TrueScene:
    """The truth about a scene. Raises `UserError` if any of its files is not as it was written."""
    facts = check_scene(folder, name)
    place = folder / name / "truth"
    views = {}
    for camera in read_json(place / "cameras.json")["cameras"]:
        view = Path(camera["name"]).stem
        with np.load(place / f"{view}.npz") as planes:
            depth, normals, seen = planes["depth"], planes["normals"], planes["seen"]
        pixels = read_picture(folder / name / picture_of(view)).pixels
        views[view] = TrueDetail(
            image=torch.from_numpy(pixels.transpose(2, 0, 1).copy()).float() / 255,
            depth=torch.from_numpy(depth),
            normals=torch.from_numpy(normals).float(),
            seen=torch.from_numpy(seen),
            world_from_cam=torch.tensor(camera["world_from_cam"], dtype=torch.float64),
            intrinsics_px=torch.tensor(camera["intrinsics_px"], dtype=torch.float64),
        )
    return TrueScene(name=name, views=views, size_m=facts.size_m)


def scenes_named(words: Sequence[str], *, where: str = "--scenes") -> tuple[str, ...]:
    """Names of scenes, each once; a split stands for its scenes. Raises `UserError` for a word that is neither."""
    found: dict[str, None] = {}
    for word in words:
        if word not in SCENES and word not in SPLITS:
            raise UserError(f"unknown scene {word!r}", where=where, fix=did_you_mean(word, [*SPLITS, *SCENES]))
        found |= dict.fromkeys(SPLITS.get(word, (word,)))
    if not found:
        raise UserError("is empty", where=where, fix="name one or more, or leave the option out")
    return tuple(found)


def split_of(name: str) -> str:
    """Which split a scene belongs to."""
    return next(split for split, names in SPLITS.items() if name in names)
