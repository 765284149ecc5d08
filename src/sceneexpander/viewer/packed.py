"""Gaussians small enough for a page: the most visible ones of a reconstruction in 18 bytes each.

Which ones: each Gaussian's weight is the sum, over all pixels of all the reconstruction's own cameras, of the share with which it enters
the pixel (its alpha times what light is left in front of it). Gaussians are ordered by that weight and the lightest are left out; those
that enter no pixel go first. Any prefix of the packed order is therefore the best set of its size.

How many: a surface that one view alone shows needs all its Gaussians, so too few leave holes there. The number grows until every one
of the reconstruction's own views looks like that of all Gaussians (`FAITHFUL_DB`) and stays as closed (`MOST_OPENED`), at the size of a
window and not of the stored pictures, or the page would become too large.

Layout of `PackedSplats.data`, column after column, little-endian, ``count`` rows each:

====================  ======  ================================================================================================
rotation              u32     unit quaternion without its largest component: index of that one (wxyz) in bits 30-31, then the three
                              others in their order, 10 bits each, from -1/sqrt(2) to 1/sqrt(2)
x, y, z               3 u16   contracted position u = d / (|d| + reach), d relative to ``origin``; from -1 to 1
scales                3 u8    natural logarithm of the standard deviations, from ``log_scale_low`` to ``log_scale_high``
red, green, blue      3 u8    colour towards the camera whose view made the Gaussian
opacity               u8
generated             u8      1 if it comes from a generated view
====================  ======  ================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import load_artifact, load_fields, refusing, save_artifact
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting import RasterSettings, rasterise, render
from sceneexpander.splatting.torch_backend import shade
from sceneexpander.viewer.cameras import ShownCameras

SCHEMA = "packed-splats/3"
SPLATS_PER_METHOD = 400_000  # at most: three methods stay below 30 MB of page
FAITHFUL_DB = 33.0  # PSNR of the worst view against all Gaussians at which no more are added
MOST_OPENED = 0.002  # share of the worst view's pixels that may become open (alpha below 0.9) by what is left out
_OPEN_ALPHA = 0.9
_WINDOW = 2  # windows have about this many times the stored pixels a side
_FEWEST, _MORE = 200_000, 100_000  # where the search for the number begins, and its step
_EQUAL_DB = 100.0
BYTES_PER_SPLAT = 18
_CAMERA_TENSORS = ("generated", "posed", "world_from_cam", "intrinsics_px", "focus")
_FACTS = (
    "method",
    "model",
    "total",
    "worst_view_db",
    "origin",
    "reach",
    "log_scale_low",
    "log_scale_high",
    "antialiased",
)
_LOG_SCALE_RANGE = 14.0  # a step of 5.6 % at most
_HALF_ROOT = math.sqrt(0.5)
_QUAT_STEPS = 1023
_POSITION_STEPS = 65535
_BYTE_STEPS = 255
_REACH = 2.0  # positions are finest within this multiple of the usual distance


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedSplats:
    """The most visible Gaussians of one method's reconstruction, most visible first, with the cameras; world frame of that method."""

    method: str
    model: str
    cameras: ShownCameras
    total: int  # Gaussians of the reconstruction
    worst_view_db: float  # PSNR against all of them, in the one of the method's own views where it is lowest
    origin: tuple[float, float, float]
    reach: float
    log_scale_low: float
    log_scale_high: float
    antialiased: bool  # see `Gaussians`
    data: UInt8[Tensor, " byte"]

    def __post_init__(self) -> None:
        if len(self.data) % BYTES_PER_SPLAT or self.count > self.total:
            raise ValueError(f"{len(self.data)} bytes do not hold up to {self.total} splats of {BYTES_PER_SPLAT} bytes")

    @property
    def count(self) -> int:
        """Number of Gaussians kept."""
        return len(self.data) // BYTES_PER_SPLAT

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        facts = {name: getattr(self, name) for name in _FACTS}
        facts |= {name: getattr(self.cameras, name) for name in ("view_ids", "height", "width")}
        tensors = {name: getattr(self.cameras, name) for name in _CAMERA_TENSORS}
        save_artifact(folder, SCHEMA, facts, {**tensors, "data": self.data})

    @classmethod
    def load(cls, folder: Path) -> PackedSplats:
        """Read what `save` wrote. Raises `ArtifactError` for a damaged or invalid artefact."""
        facts, tensors = load_artifact(folder, SCHEMA)
        of_cameras: dict[str, object] = {
            name: facts.pop(name) for name in ("view_ids", "height", "width") if name in facts
        }
        with refusing(folder):
            cameras = ShownCameras(**load_fields(ShownCameras, of_cameras, tensors, folder))
            return cls(cameras=cameras, **load_fields(cls, facts, tensors, folder, given=("cameras",)))


def visible_weight(reconstruction: Reconstruction, *, device: torch.device | str = "cpu") -> Float[Tensor, " gaussian"]:
    """What each Gaussian contributes to all pixels of all views together, in pixels.

    An image that blends one extra number per Gaussian is the sum of weight times number, so its gradient is the weight.
    """
    scene = reconstruction.gaussians.detach().to(device)
    poses = rigid_inverse(reconstruction.world_from_cam.to(device))
    intrinsics = reconstruction.intrinsics_px.to(device)
    height, width = reconstruction.depth.shape[1:]
    total = torch.zeros(len(scene), dtype=torch.float64, device=device)
    for view in range(len(poses)):
        with torch.enable_grad():
            probe = torch.zeros(len(scene), 1, device=device, requires_grad=True)
            seen = rasterise(
                scene.means,
                scene.quat_wxyz,
                scene.scales,
                scene.opacities,
                torch.zeros_like(scene.means),
                poses[view : view + 1],
                intrinsics[view : view + 1],
                height,
                width,
                features=probe,
                with_depth=False,
                settings=RasterSettings(antialiased=scene.antialiased),
            )
            assert seen.features is not None  # noqa: S101 - they were asked for
            (weight,) = torch.autograd.grad(seen.features.sum(), probe)
        total += weight[:, 0]
    return total.float().cpu()


def pack_splats(
    reconstruction: Reconstruction, *, limit: int = SPLATS_PER_METHOD, device: torch.device | str = "cpu"
) -> PackedSplats:
    """Choose and quantise.

    Args:
        reconstruction: of one method.
        limit: Gaussians to keep at most.
        device: where the weights are computed.
    """
    cameras = ShownCameras.of(reconstruction)
    order = torch.argsort(visible_weight(reconstruction, device=device), descending=True, stable=True)
    order, worst_view_db = _enough(reconstruction, order, limit, device)
    colours = _colours(reconstruction)[order]
    scene = reconstruction.gaussians.detach().select(order)
    seen = cameras.captured()
    origin = cameras.world_from_cam[seen, :3, 3].mean(0)
    reach = _REACH * float(cameras.focus[seen].median())
    log_scales = scene.scales.double().clamp(min=1e-30).log()
    high = float(log_scales.max()) if len(scene) else 0.0
    low = max(float(log_scales.min()) if len(scene) else 0.0, high - _LOG_SCALE_RANGE)
    offset = (scene.means - origin).double()
    contracted = offset / (offset.abs() + reach)
    # The outermost steps would mean infinity.
    positions = _steps(contracted * 0.5 + 0.5, _POSITION_STEPS).clamp(1, _POSITION_STEPS - 1)
    columns = [
        _packed_rotation(scene.quat_wxyz).numpy().astype("<u4"),
        *positions.T.numpy().astype("<u2"),
        *_steps((log_scales - low) / max(high - low, 1e-12), _BYTE_STEPS).T.numpy().astype("u1"),
        *_steps(colours.double(), _BYTE_STEPS).T.numpy().astype("u1"),
        _steps(scene.opacities.double(), _BYTE_STEPS).numpy().astype("u1"),
        scene.generated.numpy().astype("u1"),
    ]
    data = np.frombuffer(b"".join(column.tobytes() for column in columns), dtype=np.uint8)
    return PackedSplats(
        method=reconstruction.method,
        model=reconstruction.model,
        cameras=cameras,
        total=len(reconstruction.gaussians),
        worst_view_db=worst_view_db,
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
        reach=reach,
        log_scale_low=low,
        log_scale_high=high,
        antialiased=scene.antialiased,
        data=torch.from_numpy(data.copy()),
    )


def unpack_splats(packed: PackedSplats) -> Gaussians:
    """The Gaussians as a page draws them. What is not packed is unknown: ``source_view`` is -1."""
    count, raw = packed.count, packed.data.numpy().tobytes()
    words = np.frombuffer(raw, "<u4", count)
    shorts = np.frombuffer(raw, "<u2", 3 * count, 4 * count).reshape(3, count)
    octets = np.frombuffer(raw, "u1", 8 * count, 10 * count).reshape(8, count)
    contracted = torch.from_numpy(shorts.T.astype(np.float64)) / _POSITION_STEPS * 2 - 1
    means = contracted * packed.reach / (1 - contracted.abs()) + torch.tensor(packed.origin, dtype=torch.float64)
    shares = torch.from_numpy(octets.T.astype(np.float64)) / _BYTE_STEPS
    log_scales = packed.log_scale_low + shares[:, :3] * (packed.log_scale_high - packed.log_scale_low)
    return Gaussians(
        means=means.float(),
        quat_wxyz=_unpacked_rotation(torch.from_numpy(words.astype(np.int64))),
        scales=log_scales.exp().float(),
        opacities=shares[:, 6].float(),
        sh=sh_from_rgb(shares[:, None, 3:6].float()),
        source_view=torch.full((count,), -1, dtype=torch.int64),
        generated=torch.from_numpy(octets[7] != 0),
        antialiased=packed.antialiased,
    )


@torch.no_grad()
def _enough(
    reconstruction: Reconstruction, order: Int[Tensor, " gaussian"], limit: int, device: torch.device | str
) -> tuple[Int[Tensor, " kept"], float]:
    """(the shortest tried prefix of ``order`` whose views are faithful, PSNR of its worst view)."""
    height, width = (_WINDOW * int(side) for side in reconstruction.depth.shape[1:])
    scene = reconstruction.gaussians.detach().to(device)
    poses = reconstruction.world_from_cam.to(device)
    lenses = resize_intrinsics(reconstruction.intrinsics_px.to(device), _WINDOW, _WINDOW)

    def pictures(gaussians: Gaussians) -> Iterator[tuple[Tensor, Tensor]]:
        for pose, lens in zip(poses, lenses, strict=True):
            seen = render(gaussians, Cameras(pose[None], lens[None], height, width))
            yield seen.rgb[0].clamp(0, 1), seen.alpha[0] < _OPEN_ALPHA

    wanted = list(pictures(scene))
    count = min(_FEWEST, limit)
    while True:
        kept = order[:count]
        if len(kept) == len(order):
            return kept, _EQUAL_DB
        errors, opened = [0.0], [0.0]
        for (a, through), (b, was_open) in zip(pictures(scene.select(kept.to(device))), wanted, strict=True):
            errors.append(float(((a - b) ** 2).mean()))
            opened.append(float((through & ~was_open).double().mean()))
        worst = min(_EQUAL_DB, -10 * math.log10(max(*errors, 1e-12)))
        if (worst >= FAITHFUL_DB and max(opened) <= MOST_OPENED) or count >= limit:
            return kept, worst
        count = min(count + _MORE, limit)


def _steps(share: Float[Tensor, "*shape"], steps: int) -> Float[Tensor, "*shape"]:
    return (share.clamp(0, 1) * steps).round()


def _colours(reconstruction: Reconstruction) -> Float[Tensor, "gaussian 3"]:
    """RGB towards the camera that made each Gaussian: what a page without view-dependent colours shows best."""
    scene = reconstruction.gaussians.detach()
    source = scene.source_view.clamp(0, len(reconstruction.view_ids) - 1)
    colours = torch.zeros_like(scene.means)
    for view, cam_from_world in enumerate(rigid_inverse(reconstruction.world_from_cam)):
        rows = (source == view).nonzero()[:, 0]
        colours[rows] = shade(scene.means[rows], scene.sh[rows], cam_from_world)
    return colours


def _packed_rotation(quat_wxyz: Float[Tensor, "gaussian 4"]) -> Int[Tensor, " gaussian"]:
    quat = torch.nn.functional.normalize(quat_wxyz.double(), dim=-1)
    largest = quat.abs().argmax(-1, keepdim=True)
    # q and -q turn alike: with the largest component positive it follows from the others.
    quat = torch.where(quat.gather(-1, largest) < 0, -quat, quat)
    others = quat[_other_components(largest)].reshape(-1, 3)
    a, b, c = _steps(others * _HALF_ROOT + 0.5, _QUAT_STEPS).long().unbind(-1)
    return largest[:, 0] << 30 | a << 20 | b << 10 | c


def _unpacked_rotation(word: Int[Tensor, " gaussian"]) -> Float[Tensor, "gaussian 4"]:
    steps = torch.stack([word >> 20 & _QUAT_STEPS, word >> 10 & _QUAT_STEPS, word & _QUAT_STEPS], -1)
    others = (steps.double() / _QUAT_STEPS - 0.5) / _HALF_ROOT
    largest = (word >> 30)[:, None]
    quat = (1 - (others * others).sum(-1, keepdim=True)).clamp(min=0).sqrt().expand(-1, 4).clone()
    quat[_other_components(largest)] = others.flatten()
    return quat.float()


def _other_components(largest: Int[Tensor, "gaussian 1"]) -> Tensor:
    return torch.arange(4) != largest
