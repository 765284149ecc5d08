"""Speed of the CPU rasteriser as ratios to gsplat's own torch reference, in one process on one thread.

    python benchmarks/rasteriser.py [--scene S|M] [--repeats 5] [--json FILE]

The scene is that of a feed-forward reconstruction: one Gaussian per pixel of two source views of a wall with relief behind a
disc, seen from a third camera; RGB, squared-error loss. Figures are CPU time of the process (the machine may be shared), medians.

Baselines, from the installed ``gsplat`` package (pip install gsplat==1.5.3), whose functions are only called:
  ref   projection, tile lists, pixel lists and accumulation; what gsplat has only as CUDA code (tile intersection, pixel lists)
        and what it takes from nerfacc is replaced by the vectorised functions below
  core  projection and accumulation with the index lists given: gsplat's own differentiable code only
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import sys
import time
import types
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from sceneexpander.geometry.rigid import look_at, rigid_inverse
from sceneexpander.splatting import RasterSettings, rasterise
from sceneexpander.splatting.kernel_backend import load_kernel

SCENES = {
    "S": (256, 192, 256, 192),
    "M": (448, 336, 512, 384),
    "T": (96, 72, 96, 72),
}  # source, target width and height
FOV_RAD = math.radians(60)
TILE = 16
TARGETS = {"forward vs ref": 40.0, "forward+backward vs ref": 25.0, "forward+backward vs core": 11.0}  # AVX2, scene M


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Tensors in gsplat's conventions, one view."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor
    viewmat: Tensor
    intrinsics: Tensor
    width: int
    height: int
    target: Tensor

    def leaves(self) -> list[Tensor]:
        """Fresh leaf tensors that ask for gradients."""
        return [t.clone().requires_grad_() for t in (self.means, self.quats, self.scales, self.opacities, self.colours)]


def _intrinsics(width: int, height: int) -> Tensor:
    focal = width / 2 / math.tan(FOV_RAD / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def make_scene(name: str) -> Scene:
    """One Gaussian per source pixel: sigma 0.8 pixel with log-normal spread 0.25, opacity sigmoid(N(0.8, 1.2))."""
    source_w, source_h, width, height = SCENES[name]
    generator = torch.Generator().manual_seed(5)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator)

    k = _intrinsics(source_w, source_h)
    v, u = torch.meshgrid(torch.arange(source_h) + 0.5, torch.arange(source_w) + 0.5, indexing="ij")
    rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1).reshape(-1, 3)
    up, target = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 0.0, 4.0])
    means, pixel = [], []
    for x in (-0.4, 0.4):
        pose = look_at(torch.tensor([x, 0.0, 0.0]), target, up)
        directions = rays @ pose[:3, :3].T
        wall = (4.0 - pose[2, 3]) / directions[:, 2]
        at = pose[:3, 3] + directions * wall[:, None]
        depth = wall * (1 + 0.06 * torch.sin(2.5 * at[:, 0]) * torch.cos(3.1 * at[:, 1]))
        disc = (2.2 - pose[2, 3]) / directions[:, 2]
        hit = (pose[:3, 3] + directions * disc[:, None])[:, :2].norm(dim=-1) < 0.45
        depth = torch.where(hit, disc, depth)
        means.append(pose[:3, 3] + directions * depth[:, None])
        pixel.append(depth / k[0, 0])
    points, size = torch.cat(means), torch.cat(pixel)
    count = len(points)
    viewmat = rigid_inverse(look_at(torch.tensor([0.1, -0.1, -0.05]), target, up))
    return Scene(
        means=points,
        quats=normal(count, 4),
        scales=0.8 * size[:, None] * torch.exp(0.25 * normal(count, 3)),
        opacities=torch.sigmoid(0.8 + 1.2 * normal(count)),
        colours=torch.rand(count, 3, generator=generator),
        viewmat=viewmat,
        intrinsics=_intrinsics(width, height),
        width=width,
        height=height,
        target=torch.rand(height, width, 3, generator=generator),
    )


# --------------------------------------------------------------------------------------------- ours


def run_ours(scene: Scene, backend: str, threads: int) -> Callable[[], tuple[Tensor, list[Tensor]]]:
    """A function that renders and returns (image, leaves)."""
    settings = RasterSettings(max_alpha=0.999, backend=backend, threads=threads)  # type: ignore[arg-type]

    def forward() -> tuple[Tensor, list[Tensor]]:
        leaves = scene.leaves()
        out = rasterise(
            *leaves,
            scene.viewmat[None],
            scene.intrinsics[None],
            scene.height,
            scene.width,
            with_depth=False,
            settings=settings,
        )
        return out.rgb[0].movedim(0, -1), leaves

    return forward


# --------------------------------------------------------------------------------------------- gsplat's reference


def install_nerfacc_stand_in() -> None:
    """The two segment functions that gsplat's accumulation imports from nerfacc: float64 log cumsum and index_add."""

    def render_weight_from_alpha(
        alphas: Tensor, *, ray_indices: Tensor, n_rays: int, **_: object
    ) -> tuple[Tensor, Tensor]:
        log_keep = torch.log1p(-alphas.double())
        running = log_keep.cumsum(0) - log_keep
        starts = torch.ones_like(ray_indices, dtype=torch.bool)
        starts[1:] = ray_indices[1:] != ray_indices[:-1]
        before = running - running[starts][starts.cumsum(0) - 1]
        transmittance = torch.exp(before).to(alphas.dtype)
        return alphas * transmittance, transmittance

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None = None, ray_indices: Tensor | None = None, n_rays: int | None = None
    ) -> Tensor:
        assert ray_indices is not None
        assert n_rays is not None
        source = weights[:, None] if values is None else weights[:, None] * values
        return source.new_zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    module.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    sys.modules.setdefault("nerfacc", module)


@torch.no_grad()
def tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, tiles_x: int, tiles_y: int) -> tuple[Tensor, Tensor]:
    """(sort keys, Gaussians) of all tile intersections by tile, then depth."""
    limit = torch.tensor([tiles_x, tiles_y])
    low = ((means2d - radii) / TILE).floor().clamp(min=0).minimum(limit).long()
    high = ((means2d + radii) / TILE).ceil().clamp(min=0).minimum(limit).long()
    size = torch.where((radii > 0).all(-1, keepdim=True), high - low, 0).clamp(min=0)
    area = size.prod(-1)
    gaussian = torch.repeat_interleave(area)
    within = torch.arange(len(gaussian)) - (area.cumsum(0) - area)[gaussian]
    row = torch.div(within, size[gaussian, 0], rounding_mode="floor")
    tile = (low[gaussian, 1] + row) * tiles_x + low[gaussian, 0] + within - row * size[gaussian, 0]
    key, order = torch.sort(tile << 32 | depths.view(torch.int32)[gaussian].long(), stable=True)
    return key, gaussian[order]


@torch.no_grad()
def pixel_lists(
    scene: Scene, means2d: Tensor, conics: Tensor, opacities: Tensor, offsets: Tensor, flat: Tensor
) -> tuple[Tensor, Tensor]:
    """(Gaussian, pixel) of all contributing pairs, per tile in blocks of 512 Gaussians."""
    tiles_x = (scene.width + TILE - 1) // TILE
    ends = [*offsets.flatten().tolist(), len(flat)]
    gaussians, pixels = [], []
    for tile in range(len(ends) - 1):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        x = torch.arange(x0, min(x0 + TILE, scene.width))
        y = torch.arange(y0, min(y0 + TILE, scene.height))
        py, px = (t.reshape(-1, 1) for t in torch.meshgrid(y, x, indexing="ij"))
        left = torch.ones(len(px), 1)
        masks = []
        for start in range(ends[tile], ends[tile + 1], 512):
            ids = flat[start : min(start + 512, ends[tile + 1])]
            dx, dy = px + 0.5 - means2d[ids, 0], py + 0.5 - means2d[ids, 1]
            a, b, c = conics[ids].unbind(-1)
            sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
            alpha = (opacities[ids] * torch.exp(-sigma)).clamp(max=0.999)
            seen = (sigma >= 0) & (alpha >= 1 / 255)
            after = left * torch.cumprod(torch.where(seen, 1 - alpha, 1.0), 1)
            masks.append(seen & (after > 1e-4))
            left = after[:, -1:]
            if bool((left <= 1e-4).all()):
                break
        if masks:
            pixel, nth = torch.cat(masks, 1).nonzero().unbind(-1)
            gaussians.append(flat[ends[tile] + nth])
            pixels.append((py * scene.width + px).flatten()[pixel])
    return torch.cat(gaussians), torch.cat(pixels)


def run_gsplat(
    scene: Scene, lists: tuple[Tensor, Tensor] | None
) -> Callable[[], tuple[Tensor, list[Tensor], tuple[Tensor, Tensor]]]:
    """A function that renders and returns (image, leaves, index lists); given lists are not recomputed."""
    install_nerfacc_stand_in()
    from gsplat.cuda import _torch_impl as reference

    tiles_x, tiles_y = (scene.width + TILE - 1) // TILE, (scene.height + TILE - 1) // TILE

    def forward() -> tuple[Tensor, list[Tensor], tuple[Tensor, Tensor]]:
        leaves = means, quats, scales, opacities, colours = scene.leaves()
        covars, _ = reference._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        radii, means2d, depths, conics, _ = reference._fully_fused_projection(
            means, covars, scene.viewmat[None], scene.intrinsics[None], scene.width, scene.height
        )
        held = lists
        if held is None:
            keys, flat = tile_lists(means2d[0], radii[0], depths[0], tiles_x, tiles_y)
            offsets = reference._isect_offset_encode(keys, 1, tiles_x, tiles_y)
            held = pixel_lists(scene, means2d[0], conics[0], opacities, offsets, flat)
        gaussian, pixel = held
        image, _ = reference.accumulate(
            means2d,
            conics,
            opacities[None],
            colours[None],
            gaussian,
            pixel,
            torch.zeros_like(gaussian),
            scene.width,
            scene.height,
        )
        return image[0], list(leaves), held

    return forward


# --------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Medians, milliseconds."""

    forward_cpu: float
    both_cpu: float
    forward_wall: float
    both_wall: float


def measure(scene: Scene, forward: Callable[[], tuple[Tensor, ...]], repeats: int, warm_up: int = 1) -> Timing:
    """Time forward and forward + backward of the squared-error loss."""
    rows = []
    for repeat in range(repeats + warm_up):
        cpu, wall = time.process_time(), time.perf_counter()
        image = forward()[0]
        cpu_forward, wall_forward = time.process_time() - cpu, time.perf_counter() - wall
        ((image - scene.target) ** 2).mean().backward()
        if repeat >= warm_up:
            rows.append((cpu_forward, time.process_time() - cpu, wall_forward, time.perf_counter() - wall))
        del image
    return Timing(
        **{name: 1000 * statistics.median(r[i] for r in rows) for i, name in enumerate(Timing.__dataclass_fields__)}
    )


def main() -> None:
    """Run, print ratios, optionally write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=sorted(SCENES), default="M")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--skip-reference", action="store_true", help="time our own backends only")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    scene = make_scene(args.scene)
    kernel = load_kernel()
    assert kernel is not None, "no compiled kernel: install the package with a C++ compiler"
    print(f"scene {args.scene}: {len(scene.means)} Gaussians, {scene.width}x{scene.height}, {kernel.path.name}")
    timings = {
        "kernel, 1 thread": measure(scene, run_ours(scene, "cpu", 1), max(args.repeats, 7)),
        "kernel, 2 threads": measure(scene, run_ours(scene, "cpu", 2), max(args.repeats, 7)),
    }
    ratios: dict[str, float] = {}
    pairs = 0
    if not args.skip_reference:
        timings["torch fallback"] = measure(scene, run_ours(scene, "torch", 1), args.repeats)
        ref_image, _, lists = run_gsplat(scene, None)()
        pairs = len(lists[0])
        difference = (run_ours(scene, "cpu", 1)()[0] - ref_image).abs().flatten()
        print(f"{pairs / (scene.width * scene.height):.1f} contributing pairs per pixel; kernel against gsplat: median")
        print(f"difference {float(difference.median()):.1e}, 99.9 % quantile {float(difference.quantile(0.999)):.1e}")
        timings["gsplat ref"] = measure(scene, run_gsplat(scene, None), args.repeats, warm_up=0)
        timings["gsplat core"] = measure(scene, run_gsplat(scene, lists), args.repeats, warm_up=0)
        ours, fallback = timings["kernel, 1 thread"], timings["torch fallback"]
        ref, core = timings["gsplat ref"], timings["gsplat core"]
        ratios = {
            "forward vs ref": ref.forward_cpu / ours.forward_cpu,
            "forward+backward vs ref": ref.both_cpu / ours.both_cpu,
            "forward+backward vs core": core.both_cpu / ours.both_cpu,
            "fallback forward+backward vs ref": ref.both_cpu / fallback.both_cpu,
        }
    two, one = timings["kernel, 2 threads"], timings["kernel, 1 thread"]
    ratios["2 threads vs 1, forward+backward, wall"] = one.both_wall / two.both_wall
    for name, timing in timings.items():
        print(f"{name:20s} forward {timing.forward_cpu:8.1f} ms   forward+backward {timing.both_cpu:8.1f} ms")
    for name, ratio in ratios.items():
        wanted = f"   (wanted {TARGETS[name]:g} on AVX2)" if args.scene == "M" and name in TARGETS else ""
        print(f"{name:42s} {ratio:7.2f}x{wanted}")
    if args.json:
        result = {
            "scene": args.scene,
            "gaussians": len(scene.means),
            "pairs_per_pixel": pairs / (scene.width * scene.height),
            "kernel": kernel.path.name,
            "machine": platform.machine(),
            "torch": torch.__version__,
            "timings_ms": {name: asdict(timing) for name, timing in timings.items()},
            "ratios": ratios,
        }
        args.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
