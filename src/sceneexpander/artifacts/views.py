"""Views as stored: pictures of one common size, and where each came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.store import (
    FACTS_NAME,
    RERUN,
    ArtifactError,
    check_inside,
    load_artifact,
    read_typed,
    refusing,
    save_artifact,
)

SCHEMA = "views/2"
Affine = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFacts:
    """What a file says of the camera and lens that took it. Hints: edited, cropped and forwarded files keep wrong values.

    Attributes:
        camera: maker and model; empty if not said.
        lens: the lens, or what else tells one lens of a device from another; empty if not said.
        focal_mm: focal length in millimetres as written, without any crop factor.
        focal_px: focal length in *original* pixels, digital zoom included; None if the file does not allow to work it out.
        focal_rule: how ``focal_px`` was worked out, in words for people ("35 mm equivalent", "focal length and sensor"); empty without.
        exif_size: (height, width) that the camera wrote down, upright; another aspect ratio than the file's means that it was cropped.
    """

    camera: str = ""
    lens: str = ""
    focal_mm: float | None = None
    focal_px: float | None = None
    focal_rule: str = ""
    exif_size: tuple[int, int] | None = None


def has_panorama_shape(height: int, width: int) -> bool:
    """Whether a picture is exactly twice as wide as high, as 360 x 180 degrees are; small ones are not asked."""
    return width >= 1000 and abs(width / height - 2) <= 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRecord:
    """Where a view came from. ``stored_from_original`` maps original to stored pixel coordinates (corner origin, 2x3).

    ``distortion`` is (k1, k2) of the lens that was taken out of the stored picture: the affine map then leads from the original's
    pixels *after* undistortion. (0, 0) for pictures stored as they were.
    """

    view_id: str  # unique within the scene and safe as a file name, e.g. "000_DSC_0286"
    name: str  # the original file name
    original_height: int
    original_width: int
    sha256: str  # of the original bytes; of the pixels for a picture that no file has, such as a toned one
    stored_from_original: Affine
    generated: bool = False
    round: int = 0  # 0: captured; k: inserted in round k
    lens: LensFacts | None = None
    distortion: tuple[float, float] = (0.0, 0.0)

    @property
    def may_be_panorama(self) -> bool:
        """Whether a photo has the shape of a panorama all around and its file names no lens; it could also be cut to that shape."""
        named = self.lens is not None and self.lens.focal_px is not None
        return not self.generated and not named and has_panorama_shape(self.original_height, self.original_width)

    def original_from_stored(self) -> Affine:
        """The inverse map, from stored to original pixel coordinates."""
        matrix = np.vstack([np.asarray(self.stored_from_original, dtype=np.float64), [0.0, 0.0, 1.0]])
        inverse = np.linalg.inv(matrix)
        return (
            (float(inverse[0, 0]), float(inverse[0, 1]), float(inverse[0, 2])),
            (float(inverse[1, 0]), float(inverse[1, 1]), float(inverse[1, 2])),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSet:
    """S views of one size. ``detail_images`` show the same framing at a higher resolution, for feature matching.

    ``photos`` show the same framing as well, each in the pixels of its own original (up to a limit of the ingest): what the scene is
    measured against and fitted to. None: nothing finer than the detail images is known.

    ``valid`` are the pixels that show the place: not what was transparent, the border of a padded picture, bars, or an overlay.
    None: all of them.
    """

    records: tuple[ViewRecord, ...]
    images: Float[Tensor, "view 3 height width"]  # RGB in [0, 1]
    detail_images: Float[Tensor, "view 3 detail_height detail_width"]
    valid: Bool[Tensor, "view height width"] | None = None
    photos: tuple[UInt8[Tensor, "3 photo_height photo_width"], ...] | None = None

    def __post_init__(self) -> None:
        ids = [record.view_id for record in self.records]
        if len(set(ids)) != len(ids):
            raise ValueError(f"view ids are not unique: {ids}")
        if not len(ids) == self.images.shape[0] == self.detail_images.shape[0]:
            raise ValueError(
                f"{len(ids)} records, {self.images.shape[0]} images, {self.detail_images.shape[0]} detail images"
            )
        if self.images.ndim != 4 or self.images.shape[1] != 3:
            raise ValueError(f"images have shape {tuple(self.images.shape)}, expected (view, 3, height, width)")
        if self.photos is not None and len(self.photos) != len(ids):
            raise ValueError(f"{len(ids)} records, {len(self.photos)} photos")
        if self.valid is not None and self.valid.shape != (len(ids), *self.images.shape[2:]):
            raise ValueError(f"masks have shape {tuple(self.valid.shape)}, images {tuple(self.images.shape)}")

    def __len__(self) -> int:
        return len(self.records)

    @property
    def height(self) -> int:
        """Rows of the stored images."""
        return int(self.images.shape[-2])

    @property
    def width(self) -> int:
        """Columns of the stored images."""
        return int(self.images.shape[-1])

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids in order."""
        return tuple(record.view_id for record in self.records)

    @property
    def generated(self) -> Bool[Tensor, "view"]:
        """Which views were generated."""
        return torch.tensor([record.generated for record in self.records], dtype=torch.bool)

    def select(self, indices: Sequence[int]) -> ViewSet:
        """The views at the given indices, in that order."""
        picked = list(indices)
        return ViewSet(
            records=tuple(self.records[i] for i in picked),
            images=self.images[picked],
            detail_images=self.detail_images[picked],
            valid=None if self.valid is None else self.valid[picked],
            photos=None if self.photos is None else tuple(self.photos[i] for i in picked),
        )

    def append(self, other: ViewSet) -> ViewSet:
        """These views followed by the other ones, which must have the same sizes."""
        if other.images.shape[1:] != self.images.shape[1:]:
            raise ValueError(f"views of {tuple(other.images.shape[1:])} cannot join {tuple(self.images.shape[1:])}")
        masked = self.valid is not None or other.valid is not None
        return ViewSet(
            records=self.records + other.records,
            images=torch.cat([self.images, other.images]),
            detail_images=torch.cat([self.detail_images, other.detail_images]),
            valid=torch.cat([self.validity(), other.validity().to(self.images.device)]) if masked else None,
            photos=None if self.photos is None and other.photos is None else self._finest() + other._finest(),
        )

    def with_pictures_of(self, other: ViewSet) -> ViewSet:
        """The same views, those that ``other`` has too taken from there, picture and record."""
        place = {view_id: index for index, view_id in enumerate(other.view_ids)}
        both = [(index, place[view_id]) for index, view_id in enumerate(self.view_ids) if view_id in place]
        records, images, detail_images = list(self.records), self.images.clone(), self.detail_images.clone()
        for index, there in both:
            records[index] = other.records[there]
            images[index], detail_images[index] = other.images[there], other.detail_images[there]
        photos = None
        if self.photos is not None or other.photos is not None:
            theirs = other._finest()
            finest = {index: theirs[there] for index, there in both}
            photos = tuple(finest.get(index, mine) for index, mine in enumerate(self._finest()))
        return replace(self, records=tuple(records), images=images, detail_images=detail_images, photos=photos)

    def photo(self, view: int) -> Float[Tensor, "3 photo_height photo_width"]:
        """One view in the pixels of its original, RGB in [0, 1]; its detail image where no finer one is kept."""
        if self.photos is None:
            return self.detail_images[view]
        return self.photos[view].to(self.images) / 255

    def _finest(self) -> tuple[UInt8[Tensor, "3 photo_height photo_width"], ...]:
        if self.photos is not None:
            return self.photos
        return tuple(to_bytes(image) for image in self.detail_images)

    def validity(self) -> Bool[Tensor, "view height width"]:
        """``valid``, written out where everything is."""
        if self.valid is not None:
            return self.valid
        return torch.ones(len(self), self.height, self.width, dtype=torch.bool, device=self.images.device)

    def save(self, folder: Path) -> None:
        """Write into an existing or new (scratch) folder: lossless pictures and the records."""
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "detail").mkdir(exist_ok=True)
        for record, image, detail in zip(self.records, self.images, self.detail_images, strict=True):
            save_png(folder / "images" / f"{record.view_id}.png", image)
            save_png(folder / "detail" / f"{record.view_id}.png", detail)
        if self.photos is not None:
            (folder / "photos").mkdir(exist_ok=True)
            for record, photo in zip(self.records, self.photos, strict=True):
                save_png(folder / "photos" / f"{record.view_id}.png", photo)
        tensors = {} if self.valid is None else {"valid": self.valid.to(torch.uint8)}
        facts = {"records": self.records, "has_photos": self.photos is not None}
        save_artifact(folder, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path) -> ViewSet:
        """Read what `save` wrote. Raises `ArtifactError` if a picture or record is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        records = read.records
        if not records:
            raise ArtifactError("holds no views", where=folder, fix=RERUN)
        for record in records:
            if Path(record.view_id).name != record.view_id:
                raise ArtifactError(f"has a view {record.view_id!a}, which is no file name", where=folder, fix=RERUN)
            check_inside(record.view_id, folder)
        with refusing(folder):
            images = torch.stack([load_png(folder / "images" / f"{r.view_id}.png") for r in records])
            detail = torch.stack([load_png(folder / "detail" / f"{r.view_id}.png") for r in records])
            valid = tensors["valid"].to(torch.bool) if "valid" in tensors else None
            photos = None
            if read.has_photos:
                photos = tuple(_load_bytes(folder / "photos" / f"{r.view_id}.png") for r in records)
            return cls(records=records, images=images, detail_images=detail, valid=valid, photos=photos)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """What is not in the pictures."""

    records: tuple[ViewRecord, ...]
    has_photos: bool = False


def to_uint8(image: Float[Tensor, "3 height width"]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(H, W, 3) bytes of an RGB image in [0, 1], rounded to nearest."""
    return to_bytes(image).cpu().permute(1, 2, 0).numpy()


def to_bytes(image: Float[Tensor, "*batch 3 height width"]) -> UInt8[Tensor, "*batch 3 height width"]:
    """An RGB image in [0, 1] as bytes, rounded to nearest."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def save_png(path: Path, image: Float[Tensor, "3 height width"] | UInt8[Tensor, "3 height width"]) -> None:
    """Write an RGB image, in [0, 1] or in bytes, as an 8-bit PNG."""
    pixels = image if image.dtype == torch.uint8 else to_bytes(image)
    Image.fromarray(pixels.cpu().permute(1, 2, 0).numpy()).save(path, format="PNG", compress_level=3)


def load_png(path: Path) -> Float[Tensor, "3 height width"]:
    """Read an 8-bit picture that `save_png` wrote as RGB in [0, 1]."""
    return _load_bytes(path).to(torch.float32) / 255


def _load_bytes(path: Path) -> UInt8[Tensor, "3 height width"]:
    try:
        with Image.open(path) as picture:
            array = np.asarray(picture.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise ArtifactError(f"cannot be read ({error})", where=path, fix="rerun the stage that makes it") from None
    return torch.from_numpy(array.copy()).permute(2, 0, 1)
