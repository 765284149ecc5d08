"""Image files -> network input, as the official inference of WorldMirror and OmniVGGT does it (worldmirror spec 2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.errors import UserError

Strategy = Literal["crop", "pad"]
WHITE = 1.0
RELEASED_TARGET = 518


def load_images(
    files: Sequence[Path], *, target: int = RELEASED_TARGET, strategy: Strategy = "crop", multiple: int = 14
) -> Float[Tensor, "view 3 height width"]:
    """Read and preprocess image files, in the order given.

    Raises:
        UserError: if a file cannot be read as an image, or ``files`` is empty.
    """
    if not files:
        raise UserError("there are no images", fix="give at least one image file")
    pictures = []
    for file in files:
        pictures.append(preprocess_image(read_image(file), target=target, strategy=strategy, multiple=multiple))
    return stack_padded(pictures)


def read_image(file: Path) -> Image.Image:
    """The decoded picture.

    Raises:
        UserError: if the file cannot be read as an image.
    """
    try:
        with Image.open(file) as image:
            image.load()
            return image
    except FileNotFoundError:
        raise UserError("does not exist", where=file, fix="check the path") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"cannot be read as an image ({error})", where=file, fix="replace the file") from None


def preprocess_image(
    image: Image.Image, *, target: int = RELEASED_TARGET, strategy: Strategy = "crop", multiple: int = 14
) -> Float[Tensor, "3 height width"]:
    """RGB in [0, 1] at network size.

    ``crop``: width becomes ``target``, the height follows the aspect (rounded to the multiple) and is cropped centrally to at
    most ``target``. ``pad``: the longer side becomes ``target`` and white fills the square. Transparency becomes white. The
    orientation tag is not applied: that is the job of whoever ingests photos.

    Raises:
        ValueError: if ``target`` is not a multiple of ``multiple``.
    """
    if target < multiple or target % multiple:
        raise ValueError(f"target {target} is not a positive multiple of {multiple}")
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, (255, 255, 255, 255)), image)
    image = image.convert("RGB")
    width, height = image.size
    if strategy == "crop" or width >= height:
        size = (target, fitted_height(width, height, target=target, multiple=multiple))
    else:
        size = (_rounded(width * (target / height), multiple), target)
    pixels = np.asarray(image.resize(size, Image.Resampling.BICUBIC), dtype=np.float32) / 255
    picture = torch.from_numpy(pixels).permute(2, 0, 1)
    if strategy == "pad":
        return _padded(picture, target, target)
    top = crop_top(picture.shape[1], target)
    return picture[:, top : top + target]


def fitted_height(width: int, height: int, *, target: int, multiple: int) -> int:
    """Height of a ``width x height`` picture once its width is ``target``, before any crop."""
    return _rounded(height * (target / width), multiple)


def crop_top(height: int, target: int) -> int:
    """First row that a central crop to at most ``target`` rows keeps."""
    return max(height - target, 0) // 2


def _rounded(length: float, multiple: int) -> int:
    """Nearest multiple, halves to even; at least one multiple, where the official code would fail on an empty image."""
    return max(round(length / multiple), 1) * multiple


def _padded(
    picture: Float[Tensor, "3 height width"], height: int, width: int
) -> Float[Tensor, "3 new_height new_width"]:
    rows, columns = height - picture.shape[1], width - picture.shape[2]
    sides = (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2)
    return F.pad(picture, sides, value=WHITE)


def stack_padded(pictures: Sequence[Float[Tensor, "3 _ _"]]) -> Float[Tensor, "view 3 height width"]:
    """Stack, padding smaller pictures with white, centred, to the largest height and width.

    The official code pads to a square instead and fails unless the largest height equals the largest width; where it works,
    this agrees with it.
    """
    height = max(picture.shape[1] for picture in pictures)
    width = max(picture.shape[2] for picture in pictures)
    return torch.stack([_padded(picture, height, width) for picture in pictures])
