"""Image, camera and depth files -> network input, as the official loader does it (omnivggt spec 8).

Only depth maps in ``.npy`` are read: the official loader transposes ``.png`` depths, an apparent bug.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.models.omnivggt.priors import BatchPriors
from sceneexpander.models.preprocess import RELEASED_TARGET, crop_top, fitted_height, preprocess_image, read_image

MIN_DEPTH, MAX_DEPTH = 1e-5, 100.0  # what lies outside is missing
CAMERA_NUMBERS = 12 + 9  # three rows of world_from_cam, then the intrinsic matrix
ROTATION_TOLERANCE = 1e-2
ASPECT_TOLERANCE = 0.03  # rounding of a small map's sides


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCamera:
    """A camera as its file holds it."""

    world_from_cam: NDArray[np.float64]  # (4, 4)
    intrinsics_px: NDArray[np.float64]  # (3, 3), of the image file


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedViews:
    """Network input of one scene: a batch of one in the priors."""

    images: Float[Tensor, "view 3 height width"]
    priors: BatchPriors


def load_views(
    files: Sequence[Path], *, cameras: Path | None = None, depths: Path | None = None, target: int = RELEASED_TARGET
) -> PreparedViews:
    """Read image files and, from folders, the camera (``.txt``) and depth (``.npy``) files with the same stems.

    Args:
        files: image files, the reference view first.
        cameras: folder of cameras; views without a file have none.
        depths: folder of depth maps; views without a file have none.
        target: width of the network input.

    Raises:
        UserError: naming the file that cannot be read, belongs to no image, or contradicts its image.
    """
    if not files:
        raise UserError("there are no images", fix="give at least one image file")
    pictures = [read_image(file) for file in files]
    camera_files, depth_files = _by_stem(files, cameras, ".txt"), _by_stem(files, depths, ".npy")
    view_cameras: list[ViewCamera | None] = []
    view_depths: list[NDArray[np.floating] | None] = []
    for picture, camera_file, depth_file in zip(pictures, camera_files, depth_files, strict=True):
        view_cameras.append(None if camera_file is None else read_camera(camera_file, picture.size))
        view_depths.append(None if depth_file is None else read_depth(depth_file, picture.size))
    if any(view_cameras) and view_cameras[0] is None:
        fix = "put a view with a camera first, or give the first view a camera"
        raise UserError("has no camera while other views have one", where=files[0], fix=fix)
    sizes = [_network_size(picture.size, target) for picture in pictures]
    for file, size in zip(files, sizes, strict=True):
        if size != sizes[0]:
            problem = (
                f"becomes {size[0]} x {size[1]} pixels while {files[0].name} becomes {sizes[0][0]} x {sizes[0][1]}"
            )
            raise UserError(problem, where=file, fix="give images of one aspect ratio")
    return prepare_views(pictures, view_cameras, view_depths, target=target)


def prepare_views(
    pictures: Sequence[Image.Image],
    cameras: Sequence[ViewCamera | None],
    depths: Sequence[NDArray[np.floating] | None],
    *,
    target: int = RELEASED_TARGET,
) -> PreparedViews:
    """Resize and crop images, cameras and depth maps together. The images must come out at one size.

    The width becomes ``target``, the height follows (rounded to the patch) and is cropped centrally to at most ``target``.
    """
    images = torch.stack([preprocess_image(picture, target=target) for picture in pictures])
    views, _, height, width = images.shape
    poses = np.tile(np.eye(4), (views, 1, 1))
    intrinsics = np.tile(np.eye(3), (views, 1, 1))
    depth = np.zeros((views, height, width), dtype=np.float32)
    for view, (picture, camera, raw) in enumerate(zip(pictures, cameras, depths, strict=True)):
        full = fitted_height(*picture.size, target=target, multiple=14)
        top = crop_top(full, target)
        if camera is not None:
            poses[view] = camera.world_from_cam
            intrinsics[view] = camera.intrinsics_px
            intrinsics[view, 0] *= target / picture.width
            intrinsics[view, 1] *= full / picture.height
            intrinsics[view, 1, 2] -= top
        if raw is not None:
            depth[view] = resize_nearest(usable_depth(raw), full, target)[top : top + target]
    priors = BatchPriors(
        world_from_cam=torch.from_numpy(poses).float()[None],
        intrinsics_px=torch.from_numpy(intrinsics).float()[None],
        camera_views=tuple(view for view, camera in enumerate(cameras) if camera is not None),
        depth=torch.from_numpy(depth)[None],
        depth_mask=torch.from_numpy((depth > MIN_DEPTH).astype(np.float32))[None],
        depth_views=tuple(view for view, raw in enumerate(depths) if raw is not None),
    )
    return PreparedViews(images=images, priors=priors)


def usable_depth(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """Depth with 0 for what is not finite, above 100 or below 1e-5."""
    clean = np.where(np.isfinite(depth), depth, 0)
    return np.where((clean > MAX_DEPTH) | (clean < MIN_DEPTH), 0, clean).astype(np.float32)


def resize_nearest(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Nearest-neighbour resize by OpenCV's rule: the source index is ``floor(index / factor)``, so corners align, not pixel centres.

    OpenCV itself, because its rounding of the factor decides single columns where the sizes do not divide.
    """
    return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)


def read_camera(path: Path, image_size: tuple[int, int]) -> ViewCamera:
    """A camera file: three rows of ``world_from_cam``, then the 3 x 3 intrinsic matrix in pixels of the image.

    Args:
        path: text file of 21 numbers.
        image_size: (width, height) of the image it belongs to.

    Raises:
        UserError: if it cannot be read, is no camera, or its principal point lies outside the image.
    """
    try:
        numbers = np.array(path.read_text().split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot be read as a camera ({error})", where=path, fix="expected 21 numbers") from None
    if numbers.size != CAMERA_NUMBERS or not np.isfinite(numbers).all():
        problem = f"holds {numbers.size} numbers, expected {CAMERA_NUMBERS} finite ones"
        raise UserError(problem, where=path, fix="write the 3 x 4 world_from_cam matrix, then the 3 x 3 intrinsics")
    pose = np.concatenate([numbers[:12].reshape(3, 4), [[0.0, 0.0, 0.0, 1.0]]])
    intrinsics = numbers[12:].reshape(3, 3)
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise UserError("its pose is not a rotation and a translation", where=path, fix="write world_from_cam, 3 x 4")
    width, height = image_size
    if intrinsics[0, 0] <= 0 or intrinsics[1, 1] <= 0:
        raise UserError("its focal lengths are not positive", where=path, fix="write the intrinsics in pixels")
    if not (0 <= intrinsics[0, 2] <= width and 0 <= intrinsics[1, 2] <= height):
        problem = (
            f"its principal point {intrinsics[0, 2]:g}, {intrinsics[1, 2]:g} lies outside the {width} x {height} image"
        )
        raise UserError(problem, where=path, fix="give intrinsics of the image file's own size")
    return ViewCamera(world_from_cam=pose, intrinsics_px=intrinsics)


def read_depth(path: Path, image_size: tuple[int, int]) -> NDArray[np.floating]:
    """A depth map of any size with the image's aspect ratio.

    Args:
        path: ``.npy`` file of a 2-D array of numbers; nothing in it is executed.
        image_size: (width, height) of the image it belongs to.

    Raises:
        UserError: if it cannot be read, is no map, or has another aspect ratio.
    """
    try:
        depth = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"cannot be read as a depth map ({error})", where=path, fix="expected a .npy file") from None
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "fiu" or not depth.size:
        shape = getattr(depth, "shape", ())
        raise UserError(f"is no depth map (shape {shape})", where=path, fix="expected a 2-D array of z-depths")
    height, width = depth.shape
    aspect = (width / height) / (image_size[0] / image_size[1])
    if abs(aspect - 1) > ASPECT_TOLERANCE:
        problem = f"is {width} x {height} while its image is {image_size[0]} x {image_size[1]}: another aspect ratio"
        raise UserError(problem, where=path, fix="give the depth of this image, not cropped and not turned")
    return depth.astype(np.float64) if depth.dtype.kind != "f" else depth


def _network_size(image_size: tuple[int, int], target: int) -> tuple[int, int]:
    """(width, height) of the network input of an image."""
    return target, min(fitted_height(*image_size, target=target, multiple=14), target)


def _by_stem(files: Sequence[Path], folder: Path | None, suffix: str) -> list[Path | None]:
    """The file of ``folder`` that belongs to each image, None where there is none."""
    if folder is None:
        return [None] * len(files)
    if not folder.is_dir():
        raise UserError("is not a folder", where=folder, fix="check the path of the priors")
    found = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix == suffix}
    strange = sorted(found.keys() - {file.stem for file in files})
    if strange:
        raise UserError("belongs to no image", where=found[strange[0]], fix="name it like its image")
    return [found.get(file.stem) for file in files]
