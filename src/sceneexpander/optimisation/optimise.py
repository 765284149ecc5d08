"""The optimisation of one scene: views in, a better reconstruction in the same gauge out."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import sha256_of_tensors, to_plain
from sceneexpander.evaluation.image import WINDOW, similarity
from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.optimisation.cameras import RefinedCameras
from sceneexpander.optimisation.checkpoint import OptimisationCheckpoint
from sceneexpander.optimisation.config import OptimiseConfig
from sceneexpander.optimisation.density import CloneAndSplit, DensityControl, Relocation, Seen
from sceneexpander.optimisation.pictures import Picture, Pictures
from sceneexpander.optimisation.splats import Splats, thin_gaussians
from sceneexpander.splatting import RasterSettings, rasterise, render

FEWEST_VIEWS = 2  # with known cameras: one view alone says nothing about where things are
_MARGIN = WINDOW // 2  # SSIM's windows lie inside the picture
_COVERED = 0.5  # alpha above which a pixel's rendered depth means something
_EXTENT_MARGIN = 1.1
_LEAST_EXTENT = 0.1  # of the median depth: cameras close together still look at a scene of some size
_DEGREE_SHARE = 1 / 30  # of the steps, before the colours may depend on the direction one degree more
_COMPENSATED = RasterSettings(antialiased=True)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimisationResult:
    """The optimised scene and the loss of every step."""

    reconstruction: Reconstruction
    losses: tuple[float, ...]


def scene_extent(reconstruction: Reconstruction) -> float:
    """Unit of positions: 1.1 times the distance of the farthest known camera from their mean, at least a tenth of the median depth."""
    known = reconstruction.posed
    centres = reconstruction.world_from_cam[known, :3, 3]
    radius = float((centres - centres.mean(0)).norm(dim=-1).max())
    return max(_EXTENT_MARGIN * radius, _LEAST_EXTENT * float(reconstruction.depth[known].median()))


def unusable(start: Reconstruction) -> str | None:
    """Why nothing can be optimised from a reconstruction, as its row will say, or None."""
    if int(start.posed.sum()) < FEWEST_VIEWS:
        return f"needs {FEWEST_VIEWS} views with known cameras"
    return None


def optimise(
    start: Reconstruction,
    images: Float[Tensor, "view 3 height width"],
    config: OptimiseConfig,
    *,
    method: str,
    seed: int,
    photos: Sequence[UInt8[Tensor, "3 photo_height photo_width"]] | None = None,
    valid: Bool[Tensor, "view height width"] | None = None,
    device: torch.device | str = "cpu",
    checkpoint_folder: Path | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> OptimisationResult:
    """Optimise the Gaussians of ``start`` on the pictures of its views, generated ones included.

    Pictures are taken at several sizes and before backgrounds of random colours, and no Gaussian gets narrower than what its finest view
    resolves, as in `sceneexpander.photometric.refine`. Views without a known camera are left out. On a CPU the same input gives the
    same bits, interrupted or not.

    Args:
        start: cameras and Gaussians to start from.
        images: pictures of its views, in order, RGB in [0, 1], at its size.
        config: settings.
        method: name of the result.
        seed: of every random draw.
        photos: the same pictures in the photos' own pixels; None: nothing finer is known.
        valid: pixels that show the place; the others count nothing. None: all.
        device: where to work.
        checkpoint_folder: resume points; None: none are kept.
        on_step: told the number of finished steps and the last loss.

    Raises:
        ValueError: the start is `unusable`, or sizes do not fit.
    """
    problem = unusable(start)
    if problem is not None or images.shape[2:] != start.depth.shape[1:]:
        raise ValueError(
            problem or f"pictures of {tuple(images.shape)} do not fit depths of {tuple(start.depth.shape)}"
        )
    run = _Run(start, images, config, photos=photos, valid=valid, seed=seed, device=torch.device(device))
    first = run.resume(checkpoint_folder)
    if first:
        _log.info("resumed the optimisation after step %d", first)
    for step in range(first + 1, config.steps + 1):
        loss = run.step(step)
        if checkpoint_folder is not None and step % config.checkpoint_every == 0 and step < config.steps:
            run.checkpoint(step).save(checkpoint_folder)
        if on_step is not None:
            on_step(step, loss)
    return OptimisationResult(reconstruction=run.result(method), losses=tuple(run.losses))


class _Run:
    """What changes from step to step."""

    def __init__(
        self,
        start: Reconstruction,
        images: Float[Tensor, "view 3 height width"],
        config: OptimiseConfig,
        *,
        photos: Sequence[UInt8[Tensor, "3 photo_height photo_width"]] | None,
        valid: Bool[Tensor, "view height width"] | None,
        seed: int,
        device: torch.device,
    ) -> None:
        self._start, self._config, self._seed, self._device = start, config, seed, device
        weights = None if valid is None else valid.to(images.dtype)
        self._pictures = Pictures(images, photos, start.intrinsics_px, weights, device)
        self._views = start.posed.nonzero()[:, 0].tolist()
        self._extent = scene_extent(start)
        kept = thin_gaussians(start.gaussians, config.start_gaussians, child_generator(seed, "optimise/start")).to(
            device
        )
        kept = self._pictures.compensated(kept, start.world_from_cam.to(device))
        self.splats = Splats.of(
            kept,
            config.rates,
            extent=self._extent,
            sh_degree=config.sh_degree,
            finest=self._finest_pixel(kept.means),
        )
        self._cameras = RefinedCameras(start.world_from_cam.to(device), rate=config.rates.poses, extent=self._extent)
        self._density = density_control(config, extent=self._extent, device=device)
        self.losses: list[float] = []
        self._key = _run_key(start, images, photos, valid, config, seed)

    def step(self, step: int) -> float:
        """One view, one update."""
        view = self._view_of(step)
        rate = self._set_mean_rate(step)
        picture = self._picture(view, step)
        height, width = picture.height, picture.width
        background = torch.rand(3, generator=child_generator(self._seed, f"optimise/background/{step}"))
        splats = self.splats
        offsets = torch.zeros(1, len(splats), 2, device=self._device, requires_grad=True)
        seen = rasterise(
            splats.params["means"],
            splats.params["quats"],
            splats.scales,
            splats.opacities,
            splats.colours(self._degree(step)),
            self._cameras.cam_from_world(view),
            picture.intrinsics_px[None],
            height,
            width,
            background=background.to(picture.rgb),
            screen_offsets=offsets,
            with_depth=False,
            settings=_COMPENSATED,
        )
        loss = photometric_loss(seen.rgb[0], picture.rgb, self._config.ssim_weight, picture.weights)
        (loss + self._density.penalty(splats)).backward()  # type: ignore[no-untyped-call]
        assert offsets.grad is not None  # noqa: S101 - every picture depends on them
        facts = Seen(centre_gradient=offsets.grad[0], radius_px=seen.radius_px[0], height=height, width=width)
        self._density.observe(splats, facts, step)
        splats.step()
        self._cameras.step(rate / (self._extent * self._config.rates.means))
        generator = child_generator(self._seed, f"optimise/density/{step}")
        self._density.change(splats, step, mean_rate=rate, generator=generator)
        if step % self._config.density.every == 0:
            splats.limit_band(self._finest_pixel(splats.params["means"]))
        self.losses.append(float(loss.detach()))
        return self.losses[-1]

    def _view_of(self, step: int) -> int:
        """Every view once before any comes again, in a new order each time."""
        turn, place = divmod(step - 1, len(self._views))
        order = torch.randperm(len(self._views), generator=child_generator(self._seed, f"optimise/order/{turn}"))
        return int(self._views[int(order[place])])

    def _picture(self, view: int, step: int) -> Picture:
        """What the view of a step is compared with: sizes take turns, the photo's own among them."""
        turn = (step - 1) // len(self._views)
        return (self._pictures.stored, self._pictures.own, self._pictures.stored, self._pictures.half)[turn % 4](view)

    def _finest_pixel(self, means: Float[Tensor, "gaussian 3"]) -> Float[Tensor, " gaussian"]:
        return self._pictures.finest_pixel(means, self._start.world_from_cam.to(self._device), self._views)

    def _set_mean_rate(self, step: int) -> float:
        rates = self._config.rates
        share = (step - 1) / max(self._config.steps - 1, 1)
        fallen = (rates.means_final / rates.means) ** share if rates.means else 0.0
        rate = self._extent * rates.means * fallen
        self.splats.optimisers["means"].param_groups[0]["lr"] = rate
        return rate

    def _degree(self, step: int) -> int:
        return min(self._config.sh_degree, int((step - 1) / max(self._config.steps * _DEGREE_SHARE, 1)))

    def checkpoint(self, step: int) -> OptimisationCheckpoint:
        """The state after a step."""
        return OptimisationCheckpoint(
            run_key=self._key,
            step=step,
            losses=self.losses,
            splats=self.splats.state(),
            density=self._density.state(),
            cameras=self._cameras.state(),
        )

    def resume(self, folder: Path | None) -> int:
        """Take up this very run's last resume point, if there is one; the number of steps it had done."""
        saved = None if folder is None else OptimisationCheckpoint.load(folder, self._key)
        if saved is None:
            return 0
        self.splats.restore(saved.splats)
        self._density.restore({name: value.to(self._device) for name, value in saved.density.items()})
        self._cameras.restore(saved.cameras)
        self.losses = list(saved.losses)
        return saved.step

    @torch.no_grad()
    def result(self, method: str) -> Reconstruction:
        """The scene as an artefact: depth as the Gaussians show it, and the start's where they show nothing."""
        start, gaussians = self._start, self.splats.gaussians()
        poses = self._cameras.world_from_cam().cpu()
        height, width = start.depth.shape[1:]
        depth = start.depth.clone()
        for view in self._views:
            one = slice(view, view + 1)
            lens = start.intrinsics_px[one].to(self._device)
            seen = render(gaussians.to(self._device), Cameras(poses[one].to(self._device), lens, height, width))
            shown = (seen.alpha > _COVERED) & (seen.depth > 0)
            depth[one] = torch.where(shown.cpu(), seen.depth.cpu(), depth[one])
        return replace(
            start,
            method=method,
            gaussians=gaussians,
            world_from_cam=poses,
            camera_vector=camera_vector_from_pose(poses, start.intrinsics_px, height, width),
            depth=depth,
            normals=normals_from_depth(depth, start.intrinsics_px),
            normals_conf=start.depth_conf,
        )


def photometric_loss(
    image: Float[Tensor, "3 height width"],
    reference: Float[Tensor, "3 height width"],
    ssim_weight: float,
    weights: Float[Tensor, "height width"] | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) mean absolute error + w (1 - SSIM); each pixel, and each window by its centre, counts as much as ``weights`` says."""
    error, unlike = (image - reference).abs().mean(0), 1 - similarity(image, reference).mean(0)
    if weights is not None:
        error, unlike = error * weights, unlike * weights[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    return (1 - ssim_weight) * error.mean() + ssim_weight * unlike.mean()


def density_control(config: OptimiseConfig, *, extent: float, device: torch.device) -> DensityControl:
    """The configured strategy: ours on a CPU, gsplat's on CUDA."""
    if device.type == "cuda":
        from sceneexpander.optimisation.gsplat_density import GsplatControl

        return GsplatControl(config.density, config.steps, extent=extent)
    if config.density.strategy == "mcmc":
        return Relocation(config.density, config.steps)
    return CloneAndSplit(config.density, config.steps, extent=extent)


def _run_key(
    start: Reconstruction,
    images: Tensor,
    photos: Sequence[Tensor] | None,
    valid: Tensor | None,
    config: OptimiseConfig,
    seed: int,
) -> str:
    """Hash of everything that determines an optimisation."""
    values = {f"start/{item.name}": getattr(start, item.name) for item in fields(start) if item.name != "gaussians"}
    values |= {f"gaussians/{item.name}": getattr(start.gaussians, item.name) for item in fields(start.gaussians)}
    values |= {"images": images, "valid": valid}
    values |= {f"photos/{index}": photo for index, photo in enumerate(photos or ())}
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    facts = {name: value for name, value in values.items() if name not in tensors}
    settings = json.dumps(to_plain({"config": config, "seed": seed, "facts": facts}), sort_keys=True)
    return hashlib.sha256(f"{sha256_of_tensors(tensors)}:{settings}".encode()).hexdigest()
