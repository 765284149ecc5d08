"""Folders of photos as prepared scenes."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.decode import Picture, Pixels, read_picture, read_picture_shape
from sceneexpander.ingest.fit import FittedPicture, common_frame, fit_picture
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.listing import safe_name
from sceneexpander.ingest.scene_file import SCENE_FILE, read_scene_file, same_name
from sceneexpander.ingest.survey import list_pictures

logger = logging.getLogger(__name__)

LITTLE_KEPT = 0.6  # share of a picture's area: losing more than the rest is worth a remark


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedViews:
    """Captured views with what else the files told.

    ``exif_focal_px`` is the focal length in *stored* pixels from EXIF (a hint only: cropped or edited photos keep a wrong value), or None.
    ``notes`` says what was noticed: duplicates left out, much cut off.
    """

    views: ViewSet
    exif_focal_px: tuple[float | None, ...]
    notes: tuple[str, ...]


def load_scene(folder: Path, config: IngestConfig, *, name: str | None = None) -> Scene:
    """Prepare a scene folder: ``scene.yaml`` and the captured photos that it names (default: in ``captured/``).

    Args:
        folder: the scene folder.
        config: stored size and limits.
        name: overrides the name in ``scene.yaml``; without either, the folder's name is used.

    Raises:
        UserError: one line for each way in which the folder, ``scene.yaml`` or a photo is unusable.
    """
    if not folder.is_dir():
        raise UserError("is not a scene folder" if folder.exists() else "does not exist", where=folder)
    facts = read_scene_file(folder)
    images = require_inside(folder / facts.images, folder, where=f"{folder / SCENE_FILE}: 'images'")
    paths = _ordered(list_pictures(images, inside=folder), facts.order, folder / SCENE_FILE)
    return _scene(paths, facts.rounds, config, name or facts.name or folder.resolve().name)


def load_photos(folder: Path, rounds: Sequence[RoundSpec], config: IngestConfig, *, name: str | None = None) -> Scene:
    """Prepare a plain folder of photos with rounds given by the caller (see `make_round`).

    Raises:
        UserError: no rounds, or one line for each way in which the folder or a photo is unusable.
    """
    if not rounds:
        raise UserError("has no prompt", where=folder, fix="pass the sentence that says what to add")
    return _scene(list_pictures(folder), tuple(rounds), config, name or folder.resolve().name)


def read_views(paths: Sequence[Path], config: IngestConfig) -> LoadedViews:
    """Read, check and fit captured photos. The first one decides the common aspect ratio.

    Photos with exactly the same pixels as an earlier one are left out and noted: a view without a baseline tells geometry nothing.

    Raises:
        UserError: a photo is unusable, or there are too few or too many.
    """
    _check_count(len(paths), paths, config)
    limit = config.max_megapixels
    frame = common_frame(
        [read_picture_shape(path, max_megapixels=limit) for path in paths],
        long_side_px=config.long_side_px,
        multiple=config.multiple,
        detail_scale=config.detail_scale,
        fit=config.fit,
    )
    parts: list[ViewSet] = []
    focals: list[float | None] = []
    notes: list[str] = []
    names: dict[str, str] = {}  # by digest of the pixels
    for path in paths:  # one at a time: thirty camera originals at once would not fit in memory
        picture = read_picture(path, max_megapixels=limit)
        first_name = names.setdefault(_pixel_digest(picture), picture.name)
        if first_name != picture.name:
            notes.append(f"{picture.name}: shows the same pixels as {first_name}, left out")
            continue
        view_id = f"{len(parts):03d}_{safe_name(Path(picture.name).stem)}"
        fitted = fit_picture(picture.pixels, frame, config.fit)
        if fitted.kept < LITTLE_KEPT:
            notes.append(f"{picture.name}: only {fitted.kept:.0%} of it fits the frame of the first view")
        parts.append(view_from_fitted(picture, fitted, view_id=view_id))
        scale = parts[-1].records[0].stored_from_original[0][0]
        focals.append(None if picture.exif_focal_px is None else picture.exif_focal_px * scale)
    _check_count(len(parts), paths, config, distinct=" different")
    views = parts[0]
    for part in parts[1:]:
        views = views.append(part)
    return LoadedViews(views=views, exif_focal_px=tuple(focals), notes=tuple(notes))


def view_from_fitted(
    picture: Picture, fitted: FittedPicture, *, view_id: str, generated: bool = False, round_number: int = 0
) -> ViewSet:
    """A decoded picture and its fit to the common frame as a set of one view."""
    record = ViewRecord(
        view_id=view_id,
        name=picture.name,
        original_height=picture.height,
        original_width=picture.width,
        sha256=picture.sha256,
        stored_from_original=fitted.stored_from_original,
        generated=generated,
        round=round_number,
    )
    return ViewSet(
        records=(record,), images=image_tensor(fitted.image)[None], detail_images=image_tensor(fitted.detail)[None]
    )


def image_tensor(pixels: Pixels) -> Float[Tensor, "3 height width"]:
    """8-bit pixels (H, W, 3) as RGB in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).to(torch.float32) / 255


def _scene(paths: list[Path], rounds: tuple[RoundSpec, ...], config: IngestConfig, name: str) -> Scene:
    loaded = read_views(paths, config)
    for note in loaded.notes:
        logger.warning("%s", note)
    return Scene(name=safe_name(name, fallback="scene"), views=loaded.views, rounds=rounds)


def _ordered(paths: list[Path], order: tuple[str, ...], scene_file: Path) -> list[Path]:
    by_name = {path.name: path for path in paths}
    alike = {same_name(path.name): path.name for path in paths}
    first: list[str] = []
    for name in order:
        found = name if name in by_name else alike.get(same_name(name))
        if found is None:
            raise UserError(
                f"'order' names {name!r}, which is not there", where=scene_file, fix=did_you_mean(name, by_name)
            )
        first.append(found)
    return [by_name[name] for name in first] + [path for path in paths if path.name not in first]


def _check_count(count: int, paths: Sequence[Path], config: IngestConfig, *, distinct: str = "") -> None:
    where = paths[0].parent if paths else None
    needed = 1 if config.allow_single_view else 2
    if count < needed:
        raise UserError(
            f"holds only {count}{distinct} picture{'s' * (count != 1)}, {needed} or more are needed",
            where=where,
            fix="add photos of the same place from other positions",
        )
    if count > config.max_views:
        raise UserError(
            f"holds {count} pictures, more than the {config.max_views} allowed",
            where=where,
            fix="remove some or raise max_views",
        )


def _pixel_digest(picture: Picture) -> str:
    # Pixels, not files: the same photo saved with other metadata is still the same photo.
    shape = f"{picture.height}x{picture.width}:".encode()
    return hashlib.sha256(shape + picture.pixels.tobytes()).hexdigest()
