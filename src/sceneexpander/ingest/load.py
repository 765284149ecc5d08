"""Folders of photos as prepared scenes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.views import LensFacts, ViewRecord, ViewSet, to_uint8
from sceneexpander.errors import UserError, did_you_mean, printable
from sceneexpander.ingest.bars import Bars, find_bars, find_overlay
from sceneexpander.ingest.config import Fit, IngestConfig
from sceneexpander.ingest.copies import Thumbnail, is_copy, thumbnail
from sceneexpander.ingest.decode import (
    Picture,
    PictureFacts,
    decode_picture,
    decode_picture_header,
    pixel_digest,
    read_picture,
)
from sceneexpander.ingest.fit import FittedPicture, FrameSize, common_frame, fit_picture
from sceneexpander.ingest.known import make_known_cameras
from sceneexpander.ingest.lens_models import Lens, straighten_picture
from sceneexpander.ingest.listing import read_scene_capture, safe_name
from sceneexpander.ingest.panorama import (
    MARKED_PANORAMA,
    doubtful_shape,
    is_marked_panorama,
    panorama_reason,
    strip_reason,
)
from sceneexpander.ingest.samples import Mask, Pixels
from sceneexpander.ingest.scene_file import SCENE_FILE, read_scene_file, same_name
from sceneexpander.ingest.sources import Capture, Shot, read_capture
from sceneexpander.plainfiles import require_folder

logger = logging.getLogger(__name__)

SMALLEST_SIDE_PX = 32
_MASK_LEVEL = 128  # grey level from which a mask's pixels are used
_MANY = 4  # photos with the same note share one line
_CONSTANT_SPREAD = 2.0  # grey levels: below it a picture shows nothing
# Pictures are worked on side by side as long as they have no more pixels together, which is what a single one may have by default.
_MEGAPIXELS_AT_ONCE = 200.0
LITTLE_KEPT = 0.6  # share of a picture's area: losing more than the rest is worth a remark


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedViews:
    """Captured views, and what was noticed: files and photos left out, parts not used, samples and profiles taken in some way."""

    views: ViewSet
    notes: tuple[str, ...]
    known: KnownCameras | None = None


def load_scene(folder: Path, config: IngestConfig, *, name: str | None = None) -> Scene:
    """Prepare a scene folder: ``scene.yaml`` and the captured photos that it names (default: in ``captured/``).

    Args:
        folder: the scene folder.
        config: stored size and limits.
        name: overrides the name in ``scene.yaml``; without either, the folder's name is used.

    Raises:
        UserError: one line for each way in which the folder, ``scene.yaml`` or a photo is unusable.
    """
    require_folder(folder, expected="a scene folder")
    facts = read_scene_file(folder)
    capture = read_scene_capture(folder, facts, config)
    capture = replace(capture, shots=_ordered(capture.shots, facts.order, folder / SCENE_FILE))
    return _scene(capture, facts.notes, facts.rounds, config, name or facts.name or folder.resolve().name)


def load_photos(folder: Path, rounds: Sequence[RoundSpec], config: IngestConfig, *, name: str | None = None) -> Scene:
    """Prepare a capture of any kind (see `sceneexpander.ingest.sources`) with rounds given by the caller (see `make_round`).

    Raises:
        UserError: no rounds, or one line for each way in which the folder or a photo is unusable.
    """
    if not rounds:
        raise UserError("has no prompt", where=folder, fix="pass the sentence that says what to add")
    return _scene(read_capture(folder, config), (), tuple(rounds), config, name or folder.resolve().name)


def read_views(paths: Sequence[Path], config: IngestConfig, *, noticed: Sequence[str] = ()) -> LoadedViews:
    """`read_shots` of files of which nothing else is known."""
    return read_shots([Shot(name=path.name, picture=path) for path in paths], config, noticed=noticed)


def read_shots(
    shots: Sequence[Shot], config: IngestConfig, *, noticed: Sequence[str] = (), metric: bool = False
) -> LoadedViews:
    """Read, check and fit captured photos. The first one decides the common aspect ratio.

    Left out, with a note: panoramas and strips, which no pinhole camera took; photos that are the same picture as an earlier one, to the
    pixel or saved again, because a view without a baseline tells geometry nothing. Not valid in the result: what is transparent, the
    border of ``fit=pad``, bars of one colour, strips that are the same in all photos, and what masks leave out.

    Pictures of calibrated lenses are straightened, so that what is stored is a pinhole camera's.

    Args:
        shots: the photos and what came with them, in order.
        config: stored size, limits, and what is believed.
        noticed: notes that come first.
        metric: whether the unit of the photos' poses and depth is the metre.

    Raises:
        UserError: a photo is unusable, or there are too few or too many.
    """
    notes = list(noticed)
    shots = [_believed(shot, config) for shot in shots]
    where = _place_of(shots)
    _check_count(len(shots), where, config)
    usable, frame, largest = _usable(shots, config, notes)
    parts: list[ViewSet] = []
    kept: list[tuple[Shot, FittedPicture, tuple[int, int]]] = []
    seen: list[_Read] = []
    for this in _read_all(usable, frame, config, at_once=max(1, int(_MEGAPIXELS_AT_ONCE / largest))):
        notes += this.first_notes
        if this.fitted is None:
            notes.append(f"{this.shown}: {this.reason}; left out")
            continue
        twin = next((other for other in seen if other.same_picture(this)), None)
        if twin is not None:
            same = "shows the same pixels as" if twin.digest == this.digest else "is the same picture, saved again, as"
            notes.append(f"{this.shown}: {same} {twin.shown}, left out and counted once")
            continue
        seen.append(this)
        notes += [f"{this.shown}: {remark}" for remark in this.remarks]
        view_id = f"{len(parts):03d}_{safe_name(Path(this.picture.name).stem)}"
        parts.append(view_from_fitted(this.picture, this.fitted, view_id=view_id))
        kept.append((this.shot, this.fitted, this.picture.shape))
    _check_count(len(parts), where, config, distinct=" different", notes=notes[len(noticed) :])
    views = parts[0]
    for part in parts[1:]:
        views = views.append(part)
    if len({this.picture.shape for this in seen}) == 1:
        views = _without_overlay(views, notes)
    known_cameras = make_known_cameras(kept, (frame.height, frame.width), metric=metric)
    return LoadedViews(views=views, notes=_gathered(notes), known=known_cameras)


def _believed(shot: Shot, config: IngestConfig) -> Shot:
    """The shot without what the configuration does not believe."""
    return replace(
        shot,
        lens=shot.lens if config.use_intrinsics else None,
        world_from_cam=shot.world_from_cam if config.use_poses else None,
        depth=shot.depth if config.use_depth else None,
    )


def _place_of(shots: Sequence[Shot]) -> Path | None:
    first = shots[0].picture if shots else None
    return first.parent if isinstance(first, Path) else None


def _read_shot(shot: Shot, config: IngestConfig, notes: list[str]) -> tuple[Picture, Lens | None]:
    """The picture, masked and straightened, and its lens at the picture's size."""
    where: str | Path = shot.picture if isinstance(shot.picture, Path) else shot.name
    picture = decode_picture(
        shot.data(),
        name=Path(shot.name).name,
        where=where,
        max_megapixels=config.max_megapixels,
        upright=not shot.calibrated,
    )
    valid = picture.valid
    if shot.mask is not None:
        mask = read_picture(shot.mask, max_megapixels=config.max_megapixels, upright=not shot.calibrated)
        if mask.shape != picture.shape:
            sizes = f"{mask.width} x {mask.height}, the picture {picture.width} x {picture.height}"
            raise UserError(f"is not as large as its picture ({sizes})", where=shot.mask)
        used = mask.pixels.max(axis=-1) >= _MASK_LEVEL
        valid = used if valid is None else valid & used
        if not valid.any():
            raise UserError("leaves nothing of its picture", where=shot.mask)
    if shot.lens is None:
        return replace(picture, valid=valid), None
    lens = shot.lens.of_size(picture.shape)
    if lens is None:
        height, width = shot.lens.size or (0, 0)
        problem = f"has {picture.width} x {picture.height} pixels, its camera was calibrated for {width} x {height}"
        raise UserError(
            problem, where=where, fix="use the pictures that were calibrated, or scene.use_intrinsics=false"
        )
    if not lens.bends:
        return replace(picture, valid=valid), lens
    pixels, valid = straighten_picture(picture.pixels, valid, lens)
    notes.append(f"{printable(picture.name)}: its lens ({lens.projection}) was straightened as calibrated")
    return replace(picture, pixels=pixels, valid=valid), lens


def _gathered(notes: Sequence[str]) -> tuple[str, ...]:
    """Notes of many photos that say the same as one note each."""
    names: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        names.setdefault(text if colon else note, []).append(name if colon else "")
    gathered = []
    for text, those in names.items():
        if len(those) >= _MANY:
            gathered.append(f"{len(those)} photos ({', '.join(those[:3])}, ...): {text}")
        else:
            gathered += [f"{name}: {text}" if name else text for name in those]
    return tuple(gathered)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Read:
    """What is left of a photo once its pixels are gone.

    Attributes:
        shot: where it is from, with its lens at the picture's size.
        picture: what its file says.
        digest: of its pixels.
        small: to recognise it saved again.
        first_notes: about how it was read.
        reason: why it is left out; it has no ``fitted`` then.
        remarks: what to say of it unless it is left out.
        fitted: the parts of it that are kept.
    """

    shot: Shot
    picture: PictureFacts
    digest: str
    small: Thumbnail
    first_notes: tuple[str, ...]
    reason: str | None = None
    remarks: tuple[str, ...] = ()
    fitted: FittedPicture | None = None

    @property
    def shown(self) -> str:
        """Its name, for people."""
        return printable(self.picture.name)

    def same_picture(self, other: _Read) -> bool:
        aspects = (self.picture.width / self.picture.height, other.picture.width / other.picture.height)
        return self.digest == other.digest or is_copy(self.small, other.small, aspects=aspects)


def _read_all(shots: Sequence[Shot], frame: FrameSize, config: IngestConfig, *, at_once: int) -> Iterator[_Read]:
    """The photos in order, as many at the same time as torch has threads, but at most ``at_once``.

    Decoders and resampling filters leave Python's lock alone, and thirty camera originals at once would not fit in memory.
    """
    with ThreadPoolExecutor(max_workers=min(torch.get_num_threads(), at_once, len(shots))) as pool:
        try:
            yield from pool.map(lambda shot: _read(shot, frame, config), shots)
        finally:
            pool.shutdown(cancel_futures=True)  # after the first photo that is refused no other is read


def _read(shot: Shot, frame: FrameSize, config: IngestConfig) -> _Read:
    notes: list[str] = []
    picture, lens = _read_shot(shot, config, notes)
    known = lens is not None or _knows_lens(picture.lens)
    read = _Read(
        shot=replace(shot, lens=lens),
        picture=picture.facts,
        digest=pixel_digest(picture),
        small=thumbnail(picture.pixels),
        first_notes=tuple(notes),
        reason=_nothing_to_see(picture.pixels) or panorama_reason(picture.pixels, picture.xmp, has_lens=known),
    )
    if read.reason is not None:
        return read
    doubt = doubtful_shape(picture.height, picture.width, has_lens=known)
    remarks = [*picture.notes, *([] if doubt is None else [doubt])]
    fitted = _fitted(picture, frame, config.fit, remarks)
    return replace(read, remarks=tuple(remarks), fitted=fitted)


def _usable(shots: Sequence[Shot], config: IngestConfig, notes: list[str]) -> tuple[list[Shot], FrameSize, float]:
    """The photos that a pinhole camera may have taken, by their headers, the frame for them, and the largest one's megapixels."""
    usable, sizes = [], []
    for shot in shots:
        where: str | Path = shot.picture if isinstance(shot.picture, Path) else shot.name
        header = decode_picture_header(
            shot.data(), where=where, max_megapixels=config.max_megapixels, upright=not shot.calibrated
        )
        reason = strip_reason(header.height, header.width)
        if reason is None and is_marked_panorama(header.xmp):
            reason = MARKED_PANORAMA
        if reason is not None:
            notes.append(f"{printable(Path(shot.name).name)}: {reason}; left out")
            continue
        usable.append(shot)
        sizes.append((header.height, header.width))
    _check_count(len(usable), _place_of(shots), config, distinct=" usable", notes=notes)
    frame = common_frame(
        sizes,
        long_side_px=config.long_side_px,
        multiple=config.multiple,
        detail_scale=config.detail_scale,
        fit=config.fit,
    )
    return usable, frame, max(height * width for height, width in sizes) / 1e6


def _nothing_to_see(pixels: Pixels) -> str | None:
    if min(pixels.shape[:2]) < SMALLEST_SIDE_PX:
        return f"has only {pixels.shape[1]} x {pixels.shape[0]} pixels"
    return "shows a single colour" if is_single_colour(pixels) else None


def is_single_colour(pixels: Pixels) -> bool:
    """Whether a picture shows nothing at all."""
    spread = pixels.reshape(-1, 3)[:: max(1, pixels.shape[0] * pixels.shape[1] // 10**6)].std(axis=0)
    return float(spread.max()) < _CONSTANT_SPREAD


def _knows_lens(lens: LensFacts) -> bool:
    return lens.focal_mm is not None or lens.focal_px is not None


def _fitted(picture: Picture, frame: FrameSize, fit: Fit, remarks: list[str]) -> FittedPicture:
    bars = find_bars(picture.pixels)
    if bars:
        remarks.append(f"has bars of one colour ({bars.words(*picture.shape)}), not used")
    fitted = fit_picture(picture.pixels, frame, fit, valid=without_bars(picture, bars))
    if fitted.kept < LITTLE_KEPT:
        remarks.append(f"only {fitted.kept:.0%} of it fits the frame of the first view")
    return fitted


def without_bars(picture: Picture, bars: Bars) -> Mask | None:
    """Which pixels of a picture show something, less its bars; None: all."""
    if not bars:
        return picture.valid
    inside = bars.mask(*picture.shape)
    return inside if picture.valid is None else picture.valid & inside


def _without_overlay(views: ViewSet, notes: list[str]) -> ViewSet:
    validity = views.validity().numpy()
    shown = views.validity().any(dim=0).numpy()
    overlay = find_overlay([to_uint8(image) for image in views.images], shown)
    if not overlay:
        return views
    notes.append(
        f"the same strip at the border of all photos ({overlay.words(views.height, views.width)}): an overlay, not used"
    )
    return replace(views, valid=torch.from_numpy(validity & overlay.mask(views.height, views.width)))


def view_from_fitted(
    picture: PictureFacts, fitted: FittedPicture, *, view_id: str, generated: bool = False, round_number: int = 0
) -> ViewSet:
    """A picture and its fit to the common frame as a set of one view."""
    record = ViewRecord(
        view_id=view_id,
        name=picture.name,
        original_height=picture.height,
        original_width=picture.width,
        sha256=picture.sha256,
        stored_from_original=fitted.stored_from_original,
        generated=generated,
        round=round_number,
        lens=picture.lens,
    )
    return ViewSet(
        records=(record,),
        images=image_tensor(fitted.image)[None],
        detail_images=image_tensor(fitted.detail)[None],
        valid=None if fitted.valid is None else torch.from_numpy(fitted.valid)[None],
        photos=(torch.from_numpy(fitted.photo).permute(2, 0, 1),),
    )


def image_tensor(pixels: Pixels) -> Float[Tensor, "3 height width"]:
    """8-bit pixels (H, W, 3) as RGB in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).to(torch.float32) / 255


def _scene(
    capture: Capture, noticed: Sequence[str], rounds: tuple[RoundSpec, ...], config: IngestConfig, name: str
) -> Scene:
    loaded = read_shots(capture.shots, config, noticed=(*noticed, *capture.notes), metric=capture.metric)
    for note in loaded.notes:
        logger.warning("%s", note)
    return Scene(
        name=safe_name(name, fallback="scene"),
        views=loaded.views,
        rounds=rounds,
        known=loaded.known,
        notes=loaded.notes,
    )


def _ordered(shots: tuple[Shot, ...], order: tuple[str, ...], scene_file: Path) -> tuple[Shot, ...]:
    names = [Path(shot.name).name for shot in shots]
    by_name = dict(zip(names, shots, strict=True))
    alike = {same_name(name): name for name in names}
    first: list[str] = []
    for name in order:
        found = name if name in by_name else alike.get(same_name(name))
        if found is None:
            raise UserError(
                f"'order' names {name!r}, which is not there", where=scene_file, fix=did_you_mean(name, by_name)
            )
        first.append(found)
    rest = tuple(shot for name, shot in zip(names, shots, strict=True) if name not in first)
    return (*(by_name[name] for name in first), *rest)


def _check_count(
    count: int, where: Path | None, config: IngestConfig, *, distinct: str = "", notes: Sequence[str] = ()
) -> None:
    needed = 1 if config.allow_single_view else 2
    if count < needed:
        # What was left out is the reason, so it belongs into the line.
        left_out = [note for note in notes if "left out" in note]
        because = (
            f" ({left_out[0]}{f', and {len(left_out) - 1} more' if len(left_out) > 1 else ''})" if left_out else ""
        )
        raise UserError(
            f"holds only {count}{distinct} picture{'s' * (count != 1)}, {needed} or more are needed{because}",
            where=where,
            fix="add photos of the same place from other positions",
        )
    if count > config.max_views:
        raise UserError(
            f"holds {count} pictures, more than the {config.max_views} allowed",
            where=where,
            fix="remove some or raise max_views",
        )
