"""Graded, known misalignment: what a generated view gets wrong about the scene it claims to extend.

A generated picture is not a photograph of the captured scene: its camera is not quite where it should be, things have moved
or changed size a little, lines bend, the exposure differs, something is there that is not. `misalign` renders a view with a
chosen amount of each and records exactly what was done, so that methods can be judged against the truth.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic.degrade import encode_radiance
from sceneexpander.synthetic.furniture import Palette, add_chair, add_crate, add_lamp, add_plant
from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.render import RenderedViews, cameras_at, pose_and_intrinsics, render_world, trace_camera
from sceneexpander.synthetic.world import World, WorldBuilder, merge_worlds

Array = NDArray[Any]  # float32


@dataclass(frozen=True, slots=True, kw_only=True)
class Misalignment:
    """How much of each error. The scene size is the median depth of the true view.

    Attributes:
        rotation_deg: angle of the camera's rotation about a random axis.
        translation_fraction: length of the camera's shift, relative to the scene size.
        deform_fraction: objects move horizontally by up to this share of the scene size, and change size by up to twice it.
        deform_share: share of the objects that do so.
        warp_fraction: largest displacement of the smooth image warp, relative to the image width.
        stretch: the picture is that much wider at the same height, as when an editor works at a ratio of its own.
        zoom: everything is drawn larger by this share, about the middle of the picture.
        shift_fraction: everything is drawn that far from its place, relative to the image width, in a random direction.
        exposure_stops: exposure difference (powers of two, linear light).
        white_balance: gains of red and blue differ from green by this factor, one up and one down.
        hallucinate: add an object that is neither in the scene nor asked for.
    """

    rotation_deg: float = 0.0
    translation_fraction: float = 0.0
    deform_fraction: float = 0.0
    deform_share: float = 0.6
    warp_fraction: float = 0.0
    stretch: float = 0.0
    zoom: float = 0.0
    shift_fraction: float = 0.0
    exposure_stops: float = 0.0
    white_balance: float = 0.0
    hallucinate: bool = False

    @classmethod
    def graded(cls, grade: float) -> Misalignment:
        """Grade 0 is a perfect view, 1 a good generator's (about 2 deg, 2 %), 2 a poor one's, which also hallucinates."""
        if grade < 0:
            raise ValueError(f"grade is {grade}, expected >= 0")
        return cls(
            rotation_deg=2.0 * grade,
            translation_fraction=0.02 * grade,
            deform_fraction=0.015 * grade,
            warp_fraction=0.01 * grade,
            exposure_stops=0.2 * grade,
            white_balance=0.04 * grade,
            hallucinate=grade >= 2,
        )


Moved = tuple[str, int, tuple[float, float, float], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MisalignedView:
    """A misaligned picture and the full record of what was done to it.

    Attributes:
        image: (H,W,3) float32 display values in [0,1].
        misalignment: the amounts asked for. scene_size_m: the length the fractions refer to.
        world_from_used_cam: (4,4) the pose it was rendered from (the true pose is the caller's).
        moved: per deformed object: name, index, shift in metres, size factor.
        warp_px: (H,W,2) displacement d: picture(p) shows what lies at p + d(p) of what the used camera sees through the true lens,
            whether inside its frame or beyond. Warp, stretch, zoom and shift together.
        gains: linear RGB gains of exposure and white balance.
        object_id: (H,W) int32 objects as seen in the warped picture (ids of ``world``).
        world: the deformed world it was rendered from.
    """

    image: Array
    misalignment: Misalignment
    scene_size_m: float
    world_from_used_cam: NDArray[np.float64]
    moved: tuple[Moved, ...]
    warp_px: Array
    gains: tuple[float, float, float]
    object_id: NDArray[np.int32]
    world: World

    def record(self) -> dict[str, Any]:
        """JSON-ready facts (the warp only by its largest and mean length)."""
        length = np.hypot(self.warp_px[..., 0], self.warp_px[..., 1])
        return {
            "asked": asdict(self.misalignment),
            "scene_size_m": self.scene_size_m,
            "warp_max_px": float(length.max()),
            "warp_mean_px": float(length.mean()),
            "gains_linear_rgb": list(self.gains),
            "moved_objects": [
                {"object": name, "object_id": index, "shift_m": list(shift), "size_factor": factor}
                for name, index, shift, factor in self.moved
            ],
        }


def shifted_pose(
    world_from_cam: NDArray[np.float64], rotation_deg: float, translation_m: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """The pose after a rotation by exactly ``rotation_deg`` and a shift of exactly ``translation_m``, random directions."""
    axis, step = generator.normal(size=3), generator.normal(size=3)
    axis *= np.deg2rad(rotation_deg) / np.linalg.norm(axis)
    pose = world_from_cam.copy()
    pose[:3, :3] = pose[:3, :3] @ np.asarray(cv2.Rodrigues(axis)[0])
    pose[:3, 3] += pose[:3, :3] @ (step * translation_m / np.linalg.norm(step))
    return pose


def deformed_world(
    world: World,
    fraction_m: float,
    share: float,
    scale: float,
    generator: np.random.Generator,
    *,
    fixed: tuple[str, ...] = (),
    together: tuple[str, ...] = (),
) -> tuple[World, tuple[Moved, ...]]:
    """A world some of whose objects are shifted (up to ``fraction_m`` metres) and scaled (by up to 1 +- ``scale``) on their base.

    Objects named in ``fixed``, and the ground and rooms everything stands on, stay; those in ``together`` share one shift and
    one size factor, so that a house does not swallow its windows.
    """
    centre, half, extra = world.centre.copy(), world.half.copy(), world.extra.copy()
    group = [index for index, name in enumerate(world.object_names) if name in together]
    members = [[index] for index, name in enumerate(world.object_names) if name not in together]
    moved: list[Moved] = []
    for indices in ([group] if group else []) + members:
        angle, length = generator.uniform(0, 2 * np.pi), generator.uniform(0.3, 1.0) * fraction_m
        factor, chosen = 1 + float(generator.uniform(-scale, scale)), generator.random() < share or indices is group
        parts = np.flatnonzero(np.isin(world.object_id, indices))
        names = [world.object_names[index] for index in indices]
        if not len(parts) or not chosen or set(names) & {*fixed, "ground", "room", "corridor", "scene"}:
            continue
        shift = np.array([np.cos(angle) * length, np.sin(angle) * length, 0.0])
        base = centre[parts].mean(0)
        base[2] = (centre[parts, 2] - half[parts, 2]).min()
        centre[parts] = base + (centre[parts] - base) * np.float32(factor) + shift.astype(np.float32)
        half[parts] *= np.float32(factor)
        # Tapers and bores are relative; only an arch's radius is a length.
        extra[parts] = np.where(world.shape[parts] == Shape.ARCH, extra[parts] * np.float32(factor), extra[parts])
        step = (float(shift[0]), float(shift[1]), 0.0)
        moved += [(name, index, step, factor) for name, index in zip(names, indices, strict=True)]
    return replace(world, centre=centre, half=half, extra=extra), tuple(moved)


def smooth_warp(height: int, width: int, largest_px: float, generator: np.random.Generator) -> Array:
    """(H,W,2) smooth displacement field whose largest vector is ``largest_px`` long."""
    grid = generator.normal(size=(4, 5, 2)).astype(np.float32)
    field = np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC))
    longest = float(np.hypot(field[..., 0], field[..., 1]).max())
    return field * np.float32(largest_px / longest)


def framed_intrinsics(
    intrinsics_px: NDArray[np.float64],
    height: int,
    width: int,
    misalignment: Misalignment,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Intrinsics of a camera that draws everything stretched, zoomed and shifted as asked; the direction of the shift is drawn."""
    m = misalignment
    shift = np.zeros(2)
    if m.shift_fraction:
        angle = np.random.default_rng(generator.integers(2**32)).uniform(0, 2 * np.pi)
        shift = m.shift_fraction * width * np.array([np.cos(angle), np.sin(angle)])
    scale = (1 + m.zoom) * np.array([1 + m.stretch, 1.0])
    middle = np.array([width, height]) / 2
    framed = intrinsics_px.copy()
    framed[:2] *= scale[:, None]
    framed[:2, 2] += middle * (1 - scale) + shift
    return framed


def displacement_px(
    smooth_px: Array, used_intrinsics_px: NDArray[np.float64], true_intrinsics_px: NDArray[np.float64]
) -> Array:
    """(H,W,2) the displacement of a smooth warp followed by that of drawing through other intrinsics than the true ones."""
    height, width = smooth_px.shape[:2]
    own = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    true_from_used = true_intrinsics_px @ np.linalg.inv(used_intrinsics_px)
    there = (own + smooth_px) @ true_from_used[:2, :2].T + true_from_used[:2, 2]
    return (there - own).astype(np.float32)


def warp_image(image: Array, warp_px: Array, *, nearest: bool = False) -> Array:
    """``image`` at p + warp(p): bilinear (or nearest, for labels), edges repeated."""
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    mode = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    target = (x + warp_px[..., 0]).astype(np.float32), (y + warp_px[..., 1]).astype(np.float32)
    return np.asarray(cv2.remap(image, *target, mode, borderMode=cv2.BORDER_REPLICATE))


def hallucinated_object(
    world: World, world_from_cam: NDArray[np.float64], distance_m: float, generator: np.random.Generator
) -> World:
    """``world`` with one more piece of furniture, standing on z = 0 in view at about ``distance_m``."""
    builder = WorldBuilder(world.kind)
    forward = world_from_cam[:2, 2] / np.linalg.norm(world_from_cam[:2, 2])
    side = np.array([-forward[1], forward[0]])
    place = world_from_cam[:2, 3] + distance_m * (0.75 * forward + float(generator.uniform(-0.25, 0.25)) * side)
    make = (add_crate, add_plant, add_chair, add_lamp)[int(generator.integers(4))]
    make(builder, Palette(generator, "train", 0.3), (*place, 0.0), float(generator.uniform(0, 6.28)))
    extra = builder.build()
    names = tuple(f"hallucinated {name}" for name in extra.object_names)
    return merge_worlds(world, replace(extra, object_names=names))


def misalign(
    world: World,
    camera: Cameras,
    misalignment: Misalignment,
    generator: np.random.Generator,
    *,
    exposure: float,
    fixed: tuple[str, ...] = (),
    together: tuple[str, ...] = (),
    **render_options: Any,
) -> MisalignedView:
    """Render the view of one camera as a generator that gets things wrong would have drawn it.

    Args:
        world: what a consistent view would show (a requested new object included).
        camera: the true one, in the world's frame.
        misalignment: amounts. generator: all draws.
        exposure: that of the captured views (see `encode_radiance`).
        fixed: names of objects that never move, e.g. the requested one.
        together: names of objects that move as one.
        render_options: passed to `render_world`.
    """
    (world_from_cam, intrinsics_px), height, width = pose_and_intrinsics(camera), camera.height, camera.width
    depth = trace_camera(world, camera)[0]
    scene_size = float(np.median(depth[np.isfinite(depth)])) if np.isfinite(depth).any() else 1.0
    m = misalignment
    shift = m.translation_fraction * scene_size
    pose = shifted_pose(world_from_cam, m.rotation_deg, shift, np.random.default_rng(generator.integers(2**32)))
    bent: World = world
    moved: tuple[Moved, ...] = ()
    bend_generator = np.random.default_rng(generator.integers(2**32))
    if m.deform_fraction:
        amount = m.deform_fraction * scene_size
        bent, moved = deformed_world(
            world, amount, m.deform_share, 2 * m.deform_fraction, bend_generator, fixed=fixed, together=together
        )
    if m.hallucinate:
        bent = hallucinated_object(bent, pose, scene_size, np.random.default_rng(generator.integers(2**32)))
    used = framed_intrinsics(intrinsics_px, height, width, m, generator)
    rendered: RenderedViews = render_world(bent, cameras_at(pose, used, height, width), **render_options)
    warp = smooth_warp(height, width, m.warp_fraction * width, generator)
    gain = 2.0**m.exposure_stops
    gains = (gain * (1 + m.white_balance), gain, gain / (1 + m.white_balance))
    radiance = warp_image(rendered.radiance[0], warp) * np.array(gains, dtype=np.float32)
    ids = warp_image(rendered.object_id[0].astype(np.float32), warp, nearest=True).astype(np.int32)
    return MisalignedView(
        image=encode_radiance(radiance, exposure), misalignment=m, scene_size_m=scene_size, world_from_used_cam=pose,
        moved=moved, warp_px=displacement_px(warp, used, intrinsics_px), gains=gains, object_id=ids, world=bent,
    )  # fmt: skip
