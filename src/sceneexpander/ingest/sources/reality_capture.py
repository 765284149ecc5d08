"""Cameras that RealityCapture (RealityScan) writes beside its pictures: ``NAME.xmp`` for ``NAME.jpg``.

Format: the vendor's "RealityCapture XMP Camera Math". ``Rotation`` is world-to-camera, row by row, OpenCV axes; ``Position`` is the
camera's centre. The focal length is that of a frame 36 mm wide; focal length and principal point are in units of the longer side, the
latter from the picture's middle; distortion is Brown's, before the focal length.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.decode import read_picture_header
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Capture, Shot, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.survey import MASKS_FOLDER, list_pictures
from sceneexpander.ingest.xmlfile import numbers_of, read_user_xml

_SPACE = "http://www.capturingreality.com/ns/xcr/1.1#"
_MARK = b"capturingreality.com/ns/xcr"
_HEAD_BYTES = 4096
_FRAME_MM = 36.0
_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")


class RealityCaptureXmp:
    """Pictures, each with its XMP file; some may have none."""

    title = "pictures with RealityCapture's XMP files"

    def detect(self, place: Path) -> bool:
        """Whether there is an XMP file of RealityCapture's; those of cameras and photo programs are others."""
        return place.is_dir() and any(_looks_right(path) for path in place.iterdir())

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All pictures; those that were registered have cameras."""
        shots, files = [], []
        for picture in list_pictures(place):
            file = next(
                (path for ending in (".xmp", ".XMP") if _looks_right(path := picture.with_suffix(ending))), None
            )
            pose = lens = None
            if file is not None:
                facts = _facts(file)
                header = read_picture_header(picture, max_megapixels=config.max_megapixels, upright=False)
                pose, lens = _pose(facts, file), _lens(facts, (header.height, header.width), file)
                files.append(file)
            mask = mask_of(picture.name, place / MASKS_FOLDER)
            shots.append(Shot(name=picture.name, picture=picture, lens=lens, world_from_cam=pose, mask=mask))
        if not files:
            raise UserError("holds no XMP file of RealityCapture's beside a picture", where=place)
        return Capture(shots=tuple(shots), files=tuple(files), chosen=True)


def _looks_right(path: Path) -> bool:
    if path.suffix.casefold() != ".xmp":
        return False
    try:
        with path.open("rb") as file:
            return _MARK in file.read(_HEAD_BYTES)
    except OSError:
        return False


def _facts(path: Path) -> dict[str, str]:
    """What RealityCapture says, whether as attribute or as element."""
    found: dict[str, str] = {}
    for element in read_user_xml(path).iter():
        named = {**element.attrib, element.tag: element.text or ""}
        found |= {name.removeprefix(f"{{{_SPACE}}}"): text for name, text in named.items() if _SPACE in name}
    return found


def _number(facts: dict[str, str], name: str, path: Path, otherwise: float) -> float:
    return float(numbers_of(facts[name], 1, f"{path}: {name}")[0]) if name in facts else otherwise


def _pose(facts: dict[str, str], path: Path) -> Float[np.ndarray, "4 4"] | None:
    if "Rotation" not in facts or "Position" not in facts:
        return None
    pose = np.eye(4)
    pose[:3, :3] = numbers_of(facts["Rotation"], 9, f"{path}: Rotation").reshape(3, 3).T
    pose[:3, 3] = numbers_of(facts["Position"], 3, f"{path}: Position")
    return rigid_pose(pose, path)


def _lens(facts: dict[str, str], size: tuple[int, int], path: Path) -> Lens | None:
    if "FocalLength35mm" not in facts:
        return None
    if _number(facts, "Skew", path, 0.0) != 0 or _number(facts, "AspectRatio", path, 1.0) != 1:
        raise UserError(
            "has pixels that are no squares, which is not read here", where=path, fix="export undistorted pictures"
        )
    model = facts.get("DistortionModel", "perspective")
    radial = np.zeros(3)
    if "DistortionCoeficients" in facts and model != "perspective":  # the vendor's spelling
        words = facts["DistortionCoeficients"]
        values = numbers_of(words, len(words.split()), f"{path}: DistortionCoeficients")
        if values.any():
            if model not in _MODELS or len(values) < 3 or values[3:].any():
                problem = f"has a distortion of the model {printable(model[:40])} that is not read here"
                fix = "register with the model Brown3, or export undistorted pictures"
                raise UserError(problem, where=path, fix=fix)
            radial = values[:3]
    centre = tuple(_number(facts, f"PrincipalPoint{axis}", path, 0.0) for axis in "UV")
    k1, k2, k3 = (float(value) for value in radial)
    return make_lens(_number(facts, "FocalLength35mm", path, 0.0), (centre[0], centre[1]), (k1, k2, k3), size, path)


def make_lens(
    focal_mm: float,
    centre: tuple[float, float],
    radial: tuple[float, float, float],
    size: tuple[int, int],
    where: str | Path,
) -> Lens:
    """A camera in the vendor's units.

    Args:
        focal_mm: of a frame whose longer side is 36 mm.
        centre: principal point from the picture's middle, in units of the longer side.
        radial: k1, k2, k3.
        size: (height, width) of the picture.
        where: what error messages name.

    Raises:
        UserError: no camera has these values.
    """
    side = float(max(size))
    focal = focal_mm / _FRAME_MM * side
    k1, k2, k3 = radial
    try:
        return Lens(
            focal_px=(focal, focal),
            centre_px=(size[1] / 2 + centre[0] * side, size[0] / 2 + centre[1] * side),
            size=size,
            distortion=(k1, k2, 0.0, 0.0, k3) if any(radial) else (),
        )
    except UserError as error:
        raise UserError(f"has a camera that {error.problem}", where=where) from None
