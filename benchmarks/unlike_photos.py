"""Sets of photos that are not all alike, with the true camera of every photo: what `frontend_poses.py --cases` measures.

A place is a procedural world and five cameras in it. A case takes the photos of a place in a certain way: some turned, zoomed, cropped,
seen through a bent lens, with wrong facts in their files, drawn over, mirrored, or of somewhere else. Every photo is rendered with its
own camera, so a zoomed one has real pixels; only what happens to a finished file (crops, bars, downscaling, lens distortion) is done to
pixels. `Photo.world_from_cam` is None where no camera of the place shows what the photo shows: it must not be posed among the others.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sceneexpander.synthetic import World, auto_exposure, courtyard, encode_radiance, render_world
from sceneexpander.synthetic.render import cameras_at
from sceneexpander.synthetic.trajectories import MIN_CLEARANCE_M, pairwise_overlap, pose_from_angles, same_lens
from sceneexpander.synthetic.views import make_scene

Pixels = NDArray[np.uint8]
Pose = NDArray[np.float64]

HEIGHT, WIDTH = 768, 1024
LONG = max(HEIGHT, WIDTH)
VIEWS = 5
JPEG_QUALITY = 95
PHONE_MM, PHONE = 26, 26 / float(np.hypot(36, 24)) * float(np.hypot(HEIGHT, WIDTH)) / LONG  # a phone's main lens
#: The bundled scene, and the seeds up to 27 whose plain and level-phone sets are solved without learned keypoints, every view within a
#: degree: the case is measured, not the scene.
SEEDS: tuple[str, ...] = ("courtyard", "1", "4", "8", "9", "16", "21")
_NOISE = 0.008  # standard deviation of display values
_EXIF_IFD, _FOCAL_MM, _ZOOM, _FOCAL_35MM, _MAKE, _MODEL = 0x8769, 0x920A, 0xA404, 0xA405, 0x010F, 0x0110


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Place:
    """A world, five cameras in it (OpenCV axes, metres; the last one sees most of what the others see) and their focal."""

    name: str
    world: World
    world_from_cam: NDArray[np.float64]  # (5, 4, 4)
    focal_ratio: float  # focal length over the long side
    exposure: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One press of the button: pose, lens and frame."""

    pose: tuple[tuple[float, ...], ...]
    focal_px: float
    height: int
    width: int
    distortion: tuple[float, float] = (0.0, 0.0)  # k1, k2: distorted = undistorted (1 + k1 r^2 + k2 r^4)

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """(3, 3), principal point in the middle of the frame."""
        return np.array([[self.focal_px, 0, self.width / 2], [0, self.focal_px, self.height / 2], [0, 0, 1.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photo:
    """A file to be, and its true camera in the pixels of the file (after undistortion, for a bent lens)."""

    pixels: Pixels
    world_from_cam: Pose | None
    intrinsics: NDArray[np.float64]
    quality: int = JPEG_QUALITY
    suffix: str = ".jpg"
    exif: tuple[tuple[int, Any], ...] = ()  # tags of the Exif block


# --- places ------------------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def place_of(seed: str) -> Place:
    """The bundled courtyard ("courtyard") or the held-out procedural scene of that number."""
    if seed == "courtyard":
        world, focal = courtyard.courtyard_world(well=False), 0.9
        poses = courtyard.captured_cameras(HEIGHT, WIDTH)[1:6].world_from_cam.numpy()
    else:
        world, chosen = make_scene(int(seed), views=VIEWS, height=HEIGHT, width=WIDTH, split="test")
        if chosen.disconnected is not None:
            raise ValueError(f"seed {seed}: a view of this set shares nothing with the others")
        poses, focal = chosen.cameras.world_from_cam.numpy(), float(chosen.cameras.intrinsics_px[0, 0, 0]) / LONG
    small = same_lens(poses, focal * LONG, HEIGHT, WIDTH).resized(HEIGHT // 4, WIDTH // 4)
    preview = render_world(world, small, supersample=1.0)
    coarse = np.stack([cv2.resize(depth, (32, 24), interpolation=cv2.INTER_NEAREST) for depth in preview.depth])
    overlap = pairwise_overlap(small, coarse.astype(np.float64))
    return Place(
        name=seed,
        world=world,
        world_from_cam=poses[np.argsort(overlap.mean(1), kind="stable")],
        focal_ratio=focal,
        exposure=auto_exposure(preview.radiance),
    )


def _aimed(place: Place, focal_ratio: float) -> NDArray[np.float64]:
    """The cameras of a place for a longer lens: all look at what the last one looks at, and stand closer together."""
    last = place.world_from_cam[-1]
    lens = np.array([[WIDTH, 0, 4.0], [0, WIDTH, 3.0], [0, 0, 1.0]])
    depth = float(np.median(render_world(place.world, cameras_at(last, lens, 6, 8), supersample=1.0).depth))
    target = last[:3, 3] + min(depth, 20.0) * last[:3, 2]
    share = min(1.0, place.focal_ratio / focal_ratio) ** 0.5
    poses = []
    for pose in place.world_from_cam:
        eye = last[:3, 3] + share * (pose[:3, 3] - last[:3, 3])
        if place.world.clearance(eye[None])[0] < MIN_CLEARANCE_M:
            eye = pose[:3, 3]
        to = target - eye
        poses.append(
            pose_from_angles(eye, float(np.arctan2(to[1], to[0])), float(np.arctan2(to[2], np.hypot(to[0], to[1]))), 0)
        )
    return np.stack(poses)


# --- photos ------------------------------------------------------------------------------------------------------------------------


def shot(pose: Pose, focal_ratio: float, *, turned: bool = False, distortion: tuple[float, float] = (0.0, 0.0)) -> Shot:
    """A shot with a focal in long sides of the frame; ``turned`` with the frame on end."""
    return Shot(
        pose=tuple(tuple(float(x) for x in row) for row in pose),
        focal_px=focal_ratio * LONG,
        height=WIDTH if turned else HEIGHT,
        width=HEIGHT if turned else WIDTH,
        distortion=distortion,
    )


@lru_cache(maxsize=96)
def take(place: Place, taken: Shot) -> Photo:
    """Render a photo: the exposure of the place, a little noise of its own."""
    pose = np.array(taken.pose)
    if any(taken.distortion):
        picture = _through_bent_lens(place, taken)
    else:
        camera = cameras_at(pose, taken.intrinsics, taken.height, taken.width)
        rendered = render_world(place.world, camera, supersample=1.0)
        picture = encode_radiance(rendered.radiance[0], place.exposure)
    rng = np.random.default_rng(zlib.crc32(repr((place.name, taken)).encode()))
    noisy = picture + _NOISE * rng.standard_normal(picture.shape)
    pixels = np.round(np.clip(noisy, 0, 1) * 255).astype(np.uint8)
    return Photo(pixels=pixels, world_from_cam=pose, intrinsics=taken.intrinsics)


def _through_bent_lens(place: Place, taken: Shot) -> NDArray[Any]:
    """Sampled from a finer and wider picture without distortion."""
    finer = 1.5
    x, y = np.meshgrid(np.arange(taken.width) + 0.5, np.arange(taken.height) + 0.5)
    bent = (np.stack([x, y], -1).reshape(-1, 2) - taken.intrinsics[:2, 2]) / taken.focal_px
    radius = np.linspace(0, 2 * np.linalg.norm(bent, axis=1).max(), 4096)
    k1, k2 = taken.distortion
    bent_radius = radius * (1 + k1 * radius**2 + k2 * radius**4)
    rising = slice(0, int(np.argmin(np.append(np.diff(bent_radius) > 0, False))) + 1)  # beyond, the model folds back
    wanted = np.linalg.norm(bent, axis=1)
    if wanted.max() > bent_radius[rising][-1]:
        raise ValueError(f"the distortion {taken.distortion} does not reach the corners at a focal of {taken.focal_px}")
    straight = bent * (np.interp(wanted, bent_radius[rising], radius[rising]) / np.maximum(wanted, 1e-9))[:, None]
    reach = np.ceil(np.abs(straight).max(0) * taken.focal_px * finer).astype(int) + 2
    lens = np.array([[finer * taken.focal_px, 0, reach[0]], [0, finer * taken.focal_px, reach[1]], [0, 0, 1.0]])
    camera = cameras_at(np.array(taken.pose), lens, 2 * int(reach[1]), 2 * int(reach[0]))
    rendered = render_world(place.world, camera, supersample=1.0)
    wide = encode_radiance(rendered.radiance[0], place.exposure)
    maps = (straight * finer * taken.focal_px + reach - 0.5).reshape(taken.height, taken.width, 2).astype(np.float32)
    return np.asarray(cv2.remap(wide, maps, None, cv2.INTER_LINEAR))


def crop(photo: Photo, left: int, top: int, width: int, height: int) -> Photo:
    """A cut-out of the file, not scaled."""
    return replace(
        photo,
        pixels=photo.pixels[top : top + height, left : left + width],
        intrinsics=np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ photo.intrinsics,
    )


def downscale(photo: Photo, factor: float) -> Photo:
    """A smaller copy of the file."""
    height, width = (round(side * factor) for side in photo.pixels.shape[:2])
    pixels = np.asarray(Image.fromarray(photo.pixels).resize((width, height), Image.Resampling.LANCZOS))
    scale = np.diag([width / photo.pixels.shape[1], height / photo.pixels.shape[0], 1.0])
    return replace(photo, pixels=pixels, intrinsics=scale @ photo.intrinsics)


def upside_down(photo: Photo) -> Photo:
    """The pixels turned by half a turn, and nothing in the file that says so."""
    assert photo.world_from_cam is not None
    height, width = photo.pixels.shape[:2]
    turned = photo.intrinsics.copy()
    turned[:2, 2] = width - turned[0, 2], height - turned[1, 2]
    pose = photo.world_from_cam @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(photo, pixels=photo.pixels[::-1, ::-1], intrinsics=turned, world_from_cam=pose)


def without_camera(pixels: Pixels, **more: Any) -> Photo:
    """A picture that no camera of the place took."""
    return Photo(pixels=pixels, world_from_cam=None, intrinsics=np.eye(3), **more)


def with_letterbox(photo: Photo) -> Photo:
    """Black bars above and below that make it square."""
    height, width = photo.pixels.shape[:2]
    bar = (width - height) // 2
    pixels = np.zeros((width, width, 3), np.uint8)
    pixels[bar : bar + height] = photo.pixels
    return replace(photo, pixels=pixels, intrinsics=np.array([[1, 0, 0], [0, 1, bar], [0, 0, 1.0]]) @ photo.intrinsics)


def with_status_bar(photo: Photo) -> Photo:
    """The strip a camera application draws along the bottom edge."""
    pixels = photo.pixels.copy()
    height, width = pixels.shape[:2]
    top = height - height // 10
    pixels[top:] = 20
    for k in range(10):
        at = (10 + k * width // 10, top + height // 16)
        cv2.putText(pixels, f"ISO {100 * (k + 1)}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.65, (255, 255, 255), 2, cv2.LINE_AA)
    return replace(photo, pixels=pixels)


def with_watermark(photo: Photo) -> Photo:
    """Half-transparent words over the middle."""
    height, width = photo.pixels.shape[:2]
    words = np.zeros((height, width), np.uint8)
    for k, line in enumerate(("SAMPLE PHOTOGRAPH", "www.example.org 2026", "NOT FOR SALE No 48151")):
        at = (width // 10, round(height * (0.38 + 0.15 * k)))
        cv2.putText(words, line, at, cv2.FONT_HERSHEY_DUPLEX, width / 480, 255, 4, cv2.LINE_AA)
    mixed = photo.pixels + 0.45 * (words[..., None] / 255) * (255.0 - photo.pixels)
    return replace(photo, pixels=np.round(mixed).astype(np.uint8))


def exif(focal_35mm: float, *, zoom: float | None = None) -> tuple[tuple[int, Any], ...]:
    """What a phone writes: its lens, and the digital zoom where there was one."""
    tags: tuple[tuple[int, Any], ...] = ((_FOCAL_MM, 4.25), (_FOCAL_35MM, round(focal_35mm)))
    return tags if zoom is None else (*tags, (_ZOOM, zoom))


def mm_from_ratio(focal_ratio: float) -> float:
    """35 mm equivalent (by the diagonal) of a focal in long sides of a whole frame."""
    return focal_ratio * LONG / float(np.hypot(HEIGHT, WIDTH)) * float(np.hypot(36, 24))


def ratio_from_mm(focal_35mm: float) -> float:
    """The inverse of `mm_from_ratio`."""
    return focal_35mm / mm_from_ratio(1.0)


def write_photo(photo: Photo, folder: Path, stem: str) -> Path:
    """Write the file. Grey pictures are written with one channel."""
    path = folder / f"{stem}{photo.suffix}"
    picture = Image.fromarray(np.ascontiguousarray(photo.pixels))
    if (photo.pixels == photo.pixels[..., :1]).all():
        picture = picture.convert("L")
    block = Image.Exif()
    if photo.exif:
        block[_MAKE], block[_MODEL] = "Maker", "Phone 1"
        block.get_ifd(_EXIF_IFD).update(dict(photo.exif))
    options: dict[str, Any] = {"quality": photo.quality} if photo.suffix == ".jpg" else {}
    if photo.exif:
        options["exif"] = block.tobytes()
    picture.save(path, **options)
    return path


# --- cases -------------------------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[Place], list[Photo]]] = {}


def case(function: Callable[[Place], list[Photo]]) -> Callable[[Place], list[Photo]]:
    """Register a case under its function's name."""
    CASES[function.__name__] = function
    return function


def _plain(place: Place) -> list[Photo]:
    return [take(place, shot(pose, place.focal_ratio)) for pose in place.world_from_cam]


def _shots(poses: NDArray[np.float64], focal_ratios: Sequence[float] | float, place: Place, **more: Any) -> list[Photo]:
    ratios = np.broadcast_to(focal_ratios, (len(poses),))
    return [take(place, shot(pose, float(ratio), **more)) for pose, ratio in zip(poses, ratios, strict=True)]


def _phone(place: Place, turned: Sequence[int], views: int = VIEWS) -> list[Photo]:
    """One phone, held level or turned by a quarter: same focal in pixels, same long side."""
    poses = place.world_from_cam[-views:]
    return [take(place, shot(pose, PHONE, turned=k in turned)) for k, pose in enumerate(poses)]


def _with(photos: list[Photo], change: Callable[[Photo], Photo], *which: int) -> list[Photo]:
    """Some photos changed; all without a choice."""
    chosen = {k % len(photos) for k in which} or set(range(len(photos)))
    return [change(photo) if k in chosen else photo for k, photo in enumerate(photos)]


def _zoomed(place: Place, factor: float, view: int = VIEWS - 1) -> list[Photo]:
    """The view that sees most of what the others see, zoomed; as the last photo or the first."""
    poses = np.roll(place.world_from_cam, 1, axis=0) if view == 0 else place.world_from_cam
    return _shots(poses, [place.focal_ratio * (factor if k == view else 1.0) for k in range(VIEWS)], place)


def _with_exif(photos: list[Photo], focal_35mm: float) -> list[Photo]:
    return _with(photos, lambda photo: replace(photo, exif=exif(focal_35mm)))


@lru_cache(maxsize=4)
def _elsewhere(number: int) -> Pixels:
    """A photo of another place."""
    world, chosen = make_scene(9000 + number, views=2, height=HEIGHT, width=WIDTH, split="test")
    rendered = render_world(world, chosen.cameras[:1], supersample=1)
    shown = encode_radiance(rendered.radiance[0], auto_exposure(rendered.radiance))
    return np.round(shown * 255).astype(np.uint8)


@case
def plain(place: Place) -> list[Photo]:
    """The control."""
    return _plain(place)


@case
def two_photos(place: Place) -> list[Photo]:
    """All alike, but only two."""
    return _plain(place)[-2:]


@case
def three_photos(place: Place) -> list[Photo]:
    """All alike, but only three."""
    return _plain(place)[-3:]


@case
def phone_level(place: Place) -> list[Photo]:
    """The control of the next ones: one phone, all photos level."""
    return _phone(place, ())


@case
def phone_one_turned(place: Place) -> list[Photo]:
    return _phone(place, (4,))


@case
def phone_two_turned(place: Place) -> list[Photo]:
    return _phone(place, (1, 4))


@case
def phone_first_turned(place: Place) -> list[Photo]:
    return _phone(place, (0,))


@case
def one_of_three_turned(place: Place) -> list[Photo]:
    return _phone(place, (1,), views=3)


@case
def cropped_to_portrait_two(place: Place) -> list[Photo]:
    width = HEIGHT * 3 // 4
    return _with(_plain(place), lambda photo: crop(photo, (WIDTH - width) // 2, 0, width, HEIGHT), 1, 4)


for _factor in (1.67, 2.0, 2.5):
    CASES[f"zoom_one_x{_factor:g}"] = partial(_zoomed, factor=_factor)


@case
def zoom_one_first(place: Place) -> list[Photo]:
    return _zoomed(place, 2.0, view=0)


@case
def two_lenses(place: Place) -> list[Photo]:
    """Two photos with a wide lens, three with one twice as long."""
    return _shots(_aimed(place, 1.2), [0.6, 1.2, 1.2, 0.6, 1.2], place)


@case
def crop_corner_one(place: Place) -> list[Photo]:
    return _with(_plain(place), lambda photo: crop(photo, 0, 0, WIDTH * 7 // 10, HEIGHT * 7 // 10), -1)


@case
def crop_corner_all(place: Place) -> list[Photo]:
    return _with(_plain(place), lambda photo: crop(photo, 0, 0, WIDTH * 7 // 10, HEIGHT * 7 // 10))


@case
def tele_all(place: Place) -> list[Photo]:
    return _shots(_aimed(place, 2.25), 2.25, place)


@case
def ultra_wide_all(place: Place) -> list[Photo]:
    return _shots(place.world_from_cam, 0.36, place)


@case
def barrel(place: Place) -> list[Photo]:
    return _shots(place.world_from_cam, place.focal_ratio, place, distortion=(-0.22, 0.05))


@case
def pincushion(place: Place) -> list[Photo]:
    return _shots(place.world_from_cam, place.focal_ratio, place, distortion=(0.12, 0.0))


@case
def mild_barrel(place: Place) -> list[Photo]:
    return _shots(place.world_from_cam, place.focal_ratio, place, distortion=(-0.06, 0.0))


@case
def exif_right_two_photos(place: Place) -> list[Photo]:
    return _with_exif(_plain(place)[-2:], mm_from_ratio(place.focal_ratio))


@case
def exif_right_three_photos(place: Place) -> list[Photo]:
    return _with_exif(_plain(place)[-3:], mm_from_ratio(place.focal_ratio))


@case
def exif_wrong_five(place: Place) -> list[Photo]:
    ratio = ratio_from_mm(50)
    return _with_exif(_shots(_aimed(place, ratio), ratio, place), 28)


@case
def exif_wrong_two(place: Place) -> list[Photo]:
    ratio = ratio_from_mm(50)
    return _with_exif(_shots(_aimed(place, ratio), ratio, place)[-2:], 28)


@case
def exif_wrong_three(place: Place) -> list[Photo]:
    ratio = ratio_from_mm(50)
    return _with_exif(_shots(_aimed(place, ratio), ratio, place)[-3:], 28)


@case
def exif_zoomed(place: Place) -> list[Photo]:
    """A phone whose 35 mm equivalent leaves the digital zoom out."""
    photos = _shots(place.world_from_cam, [PHONE] * 4 + [2 * PHONE], place)
    return [replace(p, exif=exif(PHONE_MM, zoom=2.0 if k == 4 else 1.0)) for k, p in enumerate(photos)]


@case
def exif_zoomed_included(place: Place) -> list[Photo]:
    """A phone whose 35 mm equivalent counts the digital zoom."""
    photos = _shots(place.world_from_cam, [PHONE] * 4 + [2 * PHONE], place)
    return [
        replace(p, exif=exif(PHONE_MM * (2 if k == 4 else 1), zoom=2.0 if k == 4 else 1.0))
        for k, p in enumerate(photos)
    ]


@case
def mixed_sizes(place: Place) -> list[Photo]:
    return _with(_plain(place), lambda photo: downscale(photo, 0.5), 2)


@case
def rotated_180_one(place: Place) -> list[Photo]:
    return _with(_plain(place), upside_down, 2)


@case
def grey_one(place: Place) -> list[Photo]:
    def grey(photo: Photo) -> Photo:
        return replace(photo, pixels=np.repeat(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2))

    return _with(_plain(place), grey, -1)


@case
def status_bar(place: Place) -> list[Photo]:
    return _with(_plain(place), with_status_bar)


@case
def watermark(place: Place) -> list[Photo]:
    return _with(_plain(place), with_watermark)


@case
def letterbox(place: Place) -> list[Photo]:
    return _with(_plain(place), with_letterbox)


@case
def burst(place: Place) -> list[Photo]:
    """Three photos from one hand within a second, and two others."""
    rng = np.random.default_rng(1)
    shaken = []
    for _ in range(3):
        pose = place.world_from_cam[-1].copy()
        pose[:3, :3] = cv2.Rodrigues(np.deg2rad(rng.normal(0, 0.25, 3)))[0] @ pose[:3, :3]
        pose[:3, 3] += rng.normal(0, 0.004, 3)
        shaken.append(pose)
    return _shots(np.stack([*shaken, *place.world_from_cam[2:4]]), place.focal_ratio, place)


@case
def recompressed_three(place: Place) -> list[Photo]:
    """One photo, saved three times."""
    return [replace(_plain(place)[0], quality=quality) for quality in (60, 72, 84)]


@case
def rotation_only(place: Place) -> list[Photo]:
    base = place.world_from_cam[-1]
    turns = [cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(angle)]))[0] for angle in (-12, -6, 0, 6, 12)]
    poses = np.tile(base, (len(turns), 1, 1))
    poses[:, :3, :3] = np.stack(turns) @ base[:3, :3]
    return _shots(poses, place.focal_ratio, place)


@case
def mirrored_one(place: Place) -> list[Photo]:
    return _with(_plain(place), lambda photo: without_camera(photo.pixels[:, ::-1]), -1)


@case
def unrelated_one(place: Place) -> list[Photo]:
    return _with(_plain(place), lambda _: without_camera(_elsewhere(0)), -1)


@case
def watermark_alone(place: Place) -> list[Photo]:
    """Four places that share nothing but the words over them."""
    others = [with_watermark(without_camera(_elsewhere(k))) for k in range(3)]
    return [*others, with_watermark(replace(_plain(place)[-1], world_from_cam=None))]


@case
def noise(place: Place) -> list[Photo]:
    rng = np.random.default_rng(zlib.crc32(place.name.encode()))
    return [without_camera(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), suffix=".png") for _ in range(3)]


@case
def black(_place: Place) -> list[Photo]:
    return [without_camera(np.full((480, 640, 3), (k, 0, 0), np.uint8), suffix=".png") for k in range(3)]


@case
def textureless(_place: Place) -> list[Photo]:
    """Four pictures of an even wall."""
    ramps = [np.linspace(150 + 3 * k, 190 + k, 640).astype(np.uint8) for k in range(4)]
    return [without_camera(np.repeat(np.tile(ramp, (480, 1))[..., None], 3, 2), suffix=".png") for ramp in ramps]
