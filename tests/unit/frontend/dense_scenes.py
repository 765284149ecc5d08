"""Small worlds of textured rectangles with exact depth, for the dense front-end's tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import look_at


@dataclass(frozen=True, kw_only=True)
class Scene:
    images: Tensor
    depth: Tensor
    world_from_cam: Tensor
    intrinsics_px: Tensor

    @property
    def cameras(self) -> Cameras:
        return Cameras(self.world_from_cam, self.intrinsics_px, *self.images.shape[-2:])


@dataclass(frozen=True, kw_only=True)
class Rectangle:
    """Corner plus two edge vectors in the world, a texture seed, texels per unit."""

    corner: tuple[float, float, float]
    edge_u: tuple[float, float, float]
    edge_v: tuple[float, float, float]
    seed: int
    contrast: float = 0.35


def texture(seed: int, contrast: float, size: int = 256) -> np.ndarray:
    """Noise of several scales around a random colour, (size, size, 3)."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size, 3))
    for cells in (8, 32, 128):
        coarse = rng.standard_normal((cells, cells, 3)) * 0.3 + rng.standard_normal((cells, cells, 1))
        position = (np.arange(size) + 0.5) / size * cells - 0.5
        low = np.floor(position).astype(int) % cells
        high, part = (low + 1) % cells, position - np.floor(position)
        rows = coarse[low] * (1 - part)[:, None, None] + coarse[high] * part[:, None, None]
        columns = rows[:, low] * (1 - part)[None, :, None] + rows[:, high] * part[None, :, None]
        image += columns / 3
    return np.clip(rng.uniform(0.3, 0.7, 3) + contrast * image, 0, 1)


def render(rectangles: list[Rectangle], world_from_cam: Tensor, focal: float, height: int, width: int) -> Scene:
    """Ray-cast the rectangles with 2x2 supersampled colour; depth at pixel centres."""
    textures = [texture(r.seed, r.contrast) for r in rectangles]
    images, depths = [], []
    for pose in world_from_cam.double().numpy():
        y, x = np.mgrid[0 : 2 * height, 0 : 2 * width]
        fine, _ = _cast(rectangles, textures, pose, (x + 0.5) / 2, (y + 0.5) / 2, focal, height, width)
        images.append(fine.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)))
        y, x = np.mgrid[0:height, 0:width]
        depths.append(_cast(rectangles, textures, pose, x + 0.5, y + 0.5, focal, height, width)[1])
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Scene(
        images=torch.from_numpy(np.stack(images)).float().permute(0, 3, 1, 2).contiguous(),
        depth=torch.from_numpy(np.stack(depths)).float(),
        world_from_cam=world_from_cam.float(),
        intrinsics_px=intrinsics.expand(len(images), 3, 3).clone(),
    )


def _cast(rectangles, textures, pose, x, y, focal, height, width):  # type: ignore[no-untyped-def]
    ray = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1) @ pose[:3, :3].T
    depth, colour = np.full(x.shape, np.inf), np.full((*x.shape, 3), 0.5)
    for rectangle, image in zip(rectangles, textures, strict=True):
        corner, u, v = (np.array(p, float) for p in (rectangle.corner, rectangle.edge_u, rectangle.edge_v))
        normal = np.cross(u, v)
        slope = ray @ normal
        t = ((corner - pose[:3, 3]) @ normal) / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        offset = pose[:3, 3] + ray * t[..., None] - corner
        a, b = offset @ u / (u @ u), offset @ v / (v @ v)
        hit = (t > 1e-3) & (t < depth) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        size = len(image)
        scale_u, scale_v = np.linalg.norm(u) * 64, np.linalg.norm(v) * 64
        texel = image[(b * scale_v).astype(int) % size, (a * scale_u).astype(int) % size]
        depth, colour = np.where(hit, t, depth), np.where(hit[..., None], texel, colour)
    return colour, depth


def arc(views: int, spread: float, target: tuple[float, float, float] = (0.0, 0.0, 4.0)) -> Tensor:
    """Cameras on a sideways line of length ``spread`` about the origin, all looking at the target; the first at its end."""
    x = torch.linspace(-spread / 2, spread / 2, views) if views > 1 else torch.zeros(1)
    eye = torch.stack([x, -0.1 * x.abs(), torch.zeros(views)], -1)
    return look_at(eye, torch.tensor(target).expand(views, 3), torch.tensor([0.0, -1.0, 0.0]))


def wall(depth: float, seed: int, half: float = 8.0, contrast: float = 0.35) -> Rectangle:
    return Rectangle(
        corner=(-half, -half, depth), edge_u=(2 * half, 0, 0), edge_v=(0, 2 * half, 0), seed=seed, contrast=contrast
    )


def room(seed: int) -> list[Rectangle]:
    """A back wall, a floor, a side wall and a few boards standing in between."""
    rng = np.random.default_rng(seed)
    parts = [
        wall(rng.uniform(5, 8), seed * 31 + 1),
        Rectangle(corner=(-8, 1.2, -1), edge_u=(16, 0, 0), edge_v=(0, 0, 10), seed=seed * 31 + 2),
        Rectangle(corner=(-2.5, -4, -1), edge_u=(0, 0, 10), edge_v=(0, 8, 0), seed=seed * 31 + 3),
    ]
    for k in range(5):
        angle, z = rng.uniform(-0.9, 0.9), rng.uniform(2.2, 5)
        half_width, height = rng.uniform(0.2, 0.7), rng.uniform(0.6, 1.8)
        x = rng.uniform(-0.5, 0.5) * z
        du, dv = np.cos(angle) * half_width, np.sin(angle) * half_width
        corner = (float(x - du), float(1.2 - height), float(z - dv))
        parts.append(
            Rectangle(corner=corner, edge_u=(2 * du, 0, 2 * dv), edge_v=(0, height, 0), seed=seed * 31 + 10 + k)
        )
    return parts


def no_points() -> SparsePoints:
    return SparsePoints.empty()
