"""The benchmark's scenes: captured views, a place beyond them, and the truth about both.

Each scene is a procedural world of the test split (textures and layouts that no training saw). The captured views walk past something, or
along a corridor; the *intended* inserted view stands beyond the end of the walk and looks away from it, so that a good part of what it sees
is new. Which seeds are used was settled before any method was run: see `DEVELOPMENT` and `TEST`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.artifacts.truth import SceneTruth, ViewTruth
from sceneexpander.artifacts.views import ViewRecord, ViewSet, to_uint8
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic.bundled import unseen_by
from sceneexpander.synthetic.degrade import auto_exposure, encode_radiance
from sceneexpander.synthetic.misalign import MisalignedView, Misalignment, misalign
from sceneexpander.synthetic.render import RenderedViews, render_world, trace_camera
from sceneexpander.synthetic.scenes import KINDS, build_world
from sceneexpander.synthetic.trajectories import pose_from_angles, same_lens
from sceneexpander.synthetic.world import World, rotation_z

HEIGHT, WIDTH = 168, 224  # of the stored pictures
DETAIL = 2  # the "photographs" have this many times the pixels per side
CAPTURED = 5
UNSEEN_LIMITS = (0.25, 0.65)  # share of the inserted view that no captured view sees
FOCAL = (0.7, 1.0)  # range of the focal length, in image widths
DISTANCE_M = (1.5, 7.0)  # from the cameras to what they walk past
WALK = 0.25  # half the length of the walk, in such distances
BEYOND = 0.4  # how far to the side of its middle the inserted view stands, in such distances
TURN_DEG = (25.0, 45.0)  # and how far it looks away
CORRIDOR_STRIDE_M = (2.5, 5.0)  # in corridors, what stands for the distance to what is walked past
CORRIDOR_LOOK_DEG = (12.0, 28.0)  # and how far the captured views are turned from the way ahead to one wall
MIN_CLEARANCE_M = 0.2  # between cameras and things
MIN_DEPTH_M = 0.4
MIN_SOLID = 0.6  # share of every view that is not sky
BESIDE = 0.15  # how far to the side of the intended view the one beside it stands, in such distances
MOST_UNKNOWN = 0.2  # share of what it sees that neither the captured nor the intended view does
VIEWS = (*(f"captured_{number}" for number in range(1, CAPTURED + 1)), "intended", "half_way", "beside")
_PROBE = (84, 112)  # size of the depth maps that views are chosen by
_ATTEMPTS = 60
_WALKS = 12  # per world

# Scenes by name: kind of world and seed. Settings, defaults and rates were chosen on the development scenes: the first seeds of each kind
# (counting from 1) whose captured views the geometric front-end poses completely, within 3 degrees of the truth; the inserted view
# played no part in that choice.
DEVELOPMENT = (
    "room_1",
    "room_2",
    "corridor_1",
    "corridor_2",
    "open_1",
    "open_2",
    "table_top_1",
    "courtyard_1",
    "courtyard_2",
)
# Nothing is chosen on the test scenes: five of each kind, the first seeds counting from 101. Whether the front-end poses their views was
# not looked at: scenes in which it does not are among them as they come.
TEST = tuple(f"{kind}_{seed}" for kind in KINDS for seed in range(101, 106))
# Those that the ablation measures once per release.
ABLATION_TEST = (
    "room_101",
    "room_102",
    "corridor_101",
    "open_101",
    "open_102",
    "table_top_101",
    "courtyard_101",
    "courtyard_102",
)
SPLITS = {"development": DEVELOPMENT, "test": TEST}
# Part of no benchmark: on these a decision is checked that was taken elsewhere, and the test scenes stay unseen. First seeds from 201.
CHECK = tuple(f"{kind}_{seed}" for kind in KINDS for seed in (201, 202))


def _kind_and_seed(name: str) -> tuple[str, int]:
    kind, _, seed = name.rpartition("_")
    return kind, int(seed)


SCENES: dict[str, tuple[str, int]] = {name: _kind_and_seed(name) for name in (*DEVELOPMENT, *TEST)}
_DRAWN = SCENES | {name: _kind_and_seed(name) for name in CHECK}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueView:
    """A consistent picture of a place and what is there. Pixels of the stored pictures; poses in the first captured view's frame."""

    image: Float[Tensor, "3 height width"]
    depth: Float[Tensor, "height width"]  # metres; 0 where there is no surface
    new_region: Bool[Tensor, "height width"]  # what no captured view sees
    world_from_cam: Float[Tensor, "4 4"]
    intrinsics_px: Float[Tensor, "3 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchScene:
    """A scene before anything is inserted. ``cameras`` are those of the detail pictures, in the world's frame (double precision); the last
    one is the intended inserted view's.

    ``between`` is a camera half-way from the nearest captured view to the intended one, which no method is given: ghosting shows there.
    """

    name: str
    world: World
    cameras: Cameras
    exposure: float
    captured: ViewSet
    captured_truth: dict[str, ViewTruth]  # by the picture's digest
    intended: TrueView
    between: TrueView

    @property
    def truth(self) -> SceneTruth:
        """Of the captured views."""
        return SceneTruth(views=self.captured_truth)

    def draw(self, misalignment: Misalignment, *, seed: int = 0) -> MisalignedView:
        """The inserted picture, in detail pixels, as a generator with these errors draws it, with the record of what is wrong where."""
        digest = hashlib.sha256(f"{self.name}:{seed}".encode()).digest()
        generator = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        return misalign(
            self.world, self.cameras[-1], misalignment, generator, exposure=self.exposure, supersample=1.0
        )  # fmt: skip

    def insert(self, misalignment: Misalignment, *, seed: int = 0) -> tuple[ViewSet, SceneTruth]:
        """(the inserted view as a generator with these errors draws it, truth of all views).

        The truth of the inserted view is that of the *intended* view.
        """
        drawn = self.draw(misalignment, seed=seed)
        view = _view_set([_picture(drawn.image)], ["inserted"], generated=True)
        truth = ViewTruth(
            world_from_cam=self.intended.world_from_cam.double(),
            intrinsics_px=self.cameras.intrinsics_px[-1].clone(),
            depth=_enlarged(self.intended.depth),
            new_region=_enlarged(self.intended.new_region),
        )
        return view, SceneTruth(views=self.captured_truth | {view.records[0].sha256: truth})


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnScene:
    """All true views of a scene, at the size of its photographs: `VIEWS` in this order, ``cameras`` in the world's frame."""

    name: str
    world: World
    cameras: Cameras
    exposure: float
    rendered: RenderedViews

    @property
    def relative(self) -> NDArray[np.float64]:
        """Poses in the first captured view's frame."""
        poses = self.cameras.world_from_cam.numpy()
        poses = np.linalg.inv(poses[0]) @ poses
        poses[0] = np.eye(4)
        return poses

    def pictures(self) -> list[Float[Tensor, "3 height width"]]:
        """What a photograph at each of the cameras shows, in 8 bits."""
        return [_picture(picture) for picture in encode_radiance(self.rendered.radiance, self.exposure)]


def build_scene(name: str) -> BenchScene:
    """Build and render a scene of `SCENES` or `CHECK`. The same name gives the same bits."""
    return bench_scene(draw_scene(name))


def draw_scene(name: str, *, shrink: int = 1) -> DrawnScene:
    """Build and render a scene of `SCENES` or `CHECK`; ``shrink``: in that many times fewer pixels per side, for trying things out.

    Raises:
        ValueError: no suitable cameras in that many worlds.
    """
    kind, seed = _DRAWN[name]
    height, width = HEIGHT * DETAIL // shrink, WIDTH * DETAIL // shrink
    world, cameras = _world_and_cameras(kind, seed)
    cameras = cameras.resized(height, width)
    # Half-way to the intended view from the captured view nearest to it.
    poses = cameras.world_from_cam.numpy()
    distance = np.linalg.norm(poses[:-1, :3, 3] - poses[-1, :3, 3], axis=-1)
    halfway = _moved_to(cameras[-1], _halfway(poses[int(distance.argmin())], poses[-1]))
    cameras = cameras.followed_by(halfway).followed_by(_beside(world, cameras))
    rendered = render_world(world, cameras, supersample=1.0, seed=seed)
    return DrawnScene(
        name=name,
        world=world,
        cameras=cameras,
        exposure=auto_exposure(rendered.radiance[:CAPTURED]),
        rendered=rendered,
    )


def bench_scene(drawn: DrawnScene) -> BenchScene:
    """The scene as methods are given it, with the truth that they are measured against."""
    pictures, cameras, rendered = drawn.pictures(), drawn.cameras, drawn.rendered
    photographs, lenses = cameras[:CAPTURED], cameras.intrinsics_px
    ids = [f"{index:03d}_captured" for index in range(CAPTURED)]
    captured = _view_set(pictures[:CAPTURED], ids, generated=False)
    relative = torch.from_numpy(drawn.relative)
    truth = {
        record.sha256: ViewTruth(
            world_from_cam=relative[index],
            intrinsics_px=lenses[index].clone(),
            depth=_known(rendered.depth[index]),
        )
        for index, record in enumerate(captured.records)
    }

    def true_view(index: int) -> TrueView:
        unseen = unseen_by(rendered.depth[index], cameras[index], rendered.depth[:CAPTURED], photographs)
        return TrueView(
            image=_shrunk(pictures[index]),
            depth=_known(rendered.depth[index])[_every_second()],
            new_region=torch.from_numpy(unseen)[_every_second()],
            world_from_cam=relative[index].float(),
            intrinsics_px=resize_intrinsics(lenses[index], 1 / DETAIL, 1 / DETAIL).float(),
        )

    return BenchScene(
        name=drawn.name,
        world=drawn.world,
        cameras=cameras[: CAPTURED + 1],
        exposure=drawn.exposure,
        captured=captured,
        captured_truth=truth,
        intended=true_view(CAPTURED),
        between=true_view(CAPTURED + 1),
    )


def _world_and_cameras(kind: str, seed: int) -> tuple[World, Cameras]:
    """(world, cameras of the detail pictures with the intended inserted view last)."""
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt, 20_260_101])
        world = build_world(rng, kind, split="test")
        focal = float(rng.uniform(*FOCAL)) * WIDTH * DETAIL
        for _ in range(_WALKS):
            poses = _walk(world, rng)
            if poses is None:
                continue
            cameras = same_lens(poses, focal, HEIGHT * DETAIL, WIDTH * DETAIL)
            if _fits(world, cameras):
                return world, cameras
    raise ValueError(f"no suitable cameras for kind {kind!r}, seed {seed} in {_ATTEMPTS} worlds")


def _walk(world: World, rng: np.random.Generator) -> NDArray[np.float64] | None:
    """A few steps sideways past something, then a turn of the head and a step beyond; None if that leaves the world."""
    if world.kind == "corridor":
        return _walk_along(world, rng)
    low, high = world.bounds.astype(np.float64)
    target = world.focus[rng.integers(len(world.focus))].astype(np.float64)
    start = rng.uniform(low, high)
    ahead = target[:2] - start[:2]
    distance = float(np.linalg.norm(ahead))
    if not DISTANCE_M[0] <= distance <= DISTANCE_M[1]:
        return None
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    pitch = 0.6 * float(np.arctan2(target[2] - start[2], distance))
    poses = []
    for place in np.linspace(-1, 1, CAPTURED):
        eye = start + place * WALK * distance * left + rng.normal(0, 0.02, 3) * distance
        towards = target - eye
        # Looks half-way between straight ahead and at the target, as people do who walk past something.
        turned = yaw + 0.5 * _wrapped(float(np.arctan2(towards[1], towards[0])) - yaw) + float(rng.normal(0, 0.05))
        poses.append(pose_from_angles(eye, turned, pitch + float(rng.normal(0, 0.02)), float(rng.normal(0, 0.015))))
    side = 1.0 if rng.random() < 0.5 else -1.0
    beyond = start + side * BEYOND * distance * left - float(rng.uniform(0.0, 0.15)) * distance * forward
    turn = side * float(np.deg2rad(rng.uniform(*TURN_DEG)))
    poses.append(pose_from_angles(beyond, yaw + turn, pitch, 0.0))
    return np.stack(poses)


def _walk_along(world: World, rng: np.random.Generator) -> NDArray[np.float64]:
    """A few steps along a corridor, looking a little to one wall, then a step beyond and a turn of the head to the other."""
    low, high = world.bounds.astype(np.float64)
    start, stride = rng.uniform(low, high), float(rng.uniform(*CORRIDOR_STRIDE_M))
    ahead, side = (0.0 if rng.random() < 0.5 else np.pi), (1.0 if rng.random() < 0.5 else -1.0)
    forward = np.array([np.cos(ahead), np.sin(ahead), 0.0])
    yaw = ahead + side * float(np.deg2rad(rng.uniform(*CORRIDOR_LOOK_DEG)))
    poses = []
    for place in np.linspace(-1, 1, CAPTURED):
        eye = start + place * WALK * stride * forward + rng.normal(0, 0.02, 3) * stride
        turned, pitch, roll = (float(rng.normal(0, spread)) for spread in (0.05, 0.02, 0.015))
        poses.append(pose_from_angles(eye, yaw + turned, pitch, roll))
    beyond = start + BEYOND * stride * forward
    turn = side * float(np.deg2rad(rng.uniform(*TURN_DEG)))
    poses.append(pose_from_angles(beyond, yaw - turn, 0.0, 0.0))
    return np.stack(poses)


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _fits(world: World, cameras: Cameras) -> bool:
    """Inside the world, nothing in the way, and the last view sees neither too little nor too much that is new."""
    eyes = cameras.centres.numpy()
    inside = bool(((eyes >= world.bounds[0] - 1e-6) & (eyes <= world.bounds[1] + 1e-6)).all())
    if not inside or float(world.clearance(eyes).min()) < MIN_CLEARANCE_M:
        return False
    small = cameras.resized(*_PROBE)
    depths = _traced(world, small)
    solid = np.isfinite(depths)
    if float(depths.min()) < MIN_DEPTH_M or float(solid.mean((1, 2)).min()) < MIN_SOLID:
        return False
    unseen = float(unseen_by(depths[-1], small[-1], depths[:-1], small[:-1]).mean())
    return UNSEEN_LIMITS[0] <= unseen <= UNSEEN_LIMITS[1]


def _traced(world: World, cameras: Cameras) -> NDArray[Any]:
    """(V,H,W) z-depth, +inf for sky."""
    return np.stack([trace_camera(world, cameras[index])[0] for index in range(len(cameras))])


def _moved_to(camera: Cameras, world_from_cam: NDArray[np.float64]) -> Cameras:
    return replace(camera, world_from_cam=torch.from_numpy(world_from_cam)[None])


def _beside(world: World, cameras: Cameras) -> Cameras:
    """A camera some way to the side of the intended one that looks at the same place: nearly all of it is in the pictures of a method.

    Raises:
        ValueError: there is no place for it.
    """
    small = cameras.resized(*_PROBE)
    known = _traced(world, small)
    poses = cameras.world_from_cam.numpy()
    last = poses[-1]
    reach = BESIDE * float(np.linalg.norm(poses[0, :3, 3] - poses[CAPTURED - 1, :3, 3])) / (2 * WALK)
    away = float(np.median(known[-1][np.isfinite(known[-1])]))
    for share in (1.0, -1.0, 0.5, -0.5, 0.25, -0.25):
        pose = last.copy()
        pose[:3, 3] += share * reach * last[:3, 0]
        # About the vertical of the world, to where the intended view's middle is.
        turn = float(np.arctan2(share * reach, away))
        pose[:3, :3] = rotation_z(turn) @ last[:3, :3]
        probe = _moved_to(small[-1], pose)
        (depth,) = _traced(world, probe)
        solid = np.isfinite(depth)
        unknown = unseen_by(depth, probe, known, small) & solid
        clear = float(world.clearance(pose[None, :3, 3])[0]) >= MIN_CLEARANCE_M and float(depth.min()) >= MIN_DEPTH_M
        if clear and float(unknown.sum()) <= MOST_UNKNOWN * float(solid.sum()):
            return _moved_to(cameras[-1], pose)
    raise ValueError("no place beside the intended view")


def _halfway(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pose half-way between two: mean centre, mean orientation (nearest rotation)."""
    pose = np.eye(4)
    u, _, vt = np.linalg.svd(first[:3, :3] + second[:3, :3])
    pose[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    pose[:3, 3] = (first[:3, 3] + second[:3, 3]) / 2
    return pose


def _picture(pixels: NDArray[Any]) -> Float[Tensor, "3 height width"]:
    """(H,W,3) display values as an image tensor, rounded to 8 bits as a file would be."""
    image = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).float()
    return (image.clamp(0, 1) * 255).round() / 255


def _shrunk(image: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 rows columns"]:
    return (torch.nn.functional.avg_pool2d(image, DETAIL) * 255).round() / 255


def _view_set(pictures: list[Tensor], ids: list[str], *, generated: bool) -> ViewSet:
    records = tuple(
        ViewRecord(
            view_id=view_id,
            name=f"{view_id}.png",
            original_height=picture.shape[1],
            original_width=picture.shape[2],
            sha256=hashlib.sha256(to_uint8(picture).tobytes()).hexdigest(),
            stored_from_original=((1 / DETAIL, 0.0, 0.0), (0.0, 1 / DETAIL, 0.0)),
            generated=generated,
            round=int(generated),
        )
        for view_id, picture in zip(ids, pictures, strict=True)
    )
    return ViewSet(
        records=records,
        images=torch.stack([_shrunk(picture) for picture in pictures]),
        detail_images=torch.stack(pictures),
    )


def _known(depth: NDArray[Any]) -> Float[Tensor, "height width"]:
    return torch.from_numpy(np.where(np.isfinite(depth), depth, 0).astype(np.float32))


def _every_second() -> tuple[slice, slice]:
    """Every stored pixel's sample in a detail map: the detail pixel that `truth` reads there, too (nearest to its centre)."""
    return slice(DETAIL // 2, None, DETAIL), slice(DETAIL // 2, None, DETAIL)


def _enlarged(plane: Tensor) -> Tensor:
    return plane.repeat_interleave(DETAIL, 0).repeat_interleave(DETAIL, 1)
