"""The rule for pixel-aligned Gaussians: a surface renders back to its pictures, scales, opacity, provenance."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sceneexpander.geometry.camera import intrinsics_from_parts, pixel_centres, unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, rgb_from_sh
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.rigid import look_at, rotation_from_quat_wxyz
from sceneexpander.geometry.sampling import BAND_LIMIT_PX, band_limited
from sceneexpander.models.pixel_aligned import SplatRule, depth_of_points, pixel_aligned
from sceneexpander.splatting.render import render

HEIGHT, WIDTH, FOCAL = 48, 64, 60.0


def plane_depth(normal: Tensor, distance: float, world_from_cam: Tensor, intrinsics: Tensor) -> Tensor:
    """z-depth of the plane ``normal . x = distance`` at the pixel centres of each camera, by intersecting rays."""
    uv = pixel_centres(HEIGHT, WIDTH, like=intrinsics)
    rays = torch.cat([(uv - intrinsics[0, :2, 2]) / FOCAL, torch.ones(HEIGHT, WIDTH, 1)], dim=-1)
    world_rays = torch.einsum("vij,hwj->vhwi", world_from_cam[:, :3, :3], rays)
    to_plane = distance - world_from_cam[:, :3, 3] @ normal
    return to_plane[:, None, None] / (world_rays @ normal)


def painted(points: Tensor) -> Tensor:
    """Colours of a smooth pattern in space with a period of 1.8 units: 36 pixels at a distance of 3."""
    phases = torch.tensor([0.0, 2.0, 4.0])
    wave = torch.sin(points[..., :1] * math.tau / 1.8 + phases) + torch.cos(points[..., 1:2] * math.tau / 1.8 + phases)
    return (0.5 + 0.2 * wave).movedim(-1, 1)


def pinhole(views: int) -> Tensor:
    one = torch.ones(views)
    return intrinsics_from_parts(FOCAL * one, FOCAL * one, WIDTH / 2 * one, HEIGHT / 2 * one)


def slanted_plane() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(images, depth, poses, intrinsics) of a painted plane, slanted by 25 degrees, before two cameras."""
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.7, -0.3, 0.2]])
    poses = look_at(eyes, torch.tensor([0.0, 0.0, 3.0]).expand(2, 3), torch.tensor([0.0, -1.0, 0.0]).expand(2, 3))
    normal = torch.tensor([math.sin(math.radians(25)), 0.0, math.cos(math.radians(25))])
    intrinsics = pinhole(2)
    depth = plane_depth(normal, 3 * float(normal[2]), poses, intrinsics)
    return painted(unproject_to_world(depth, intrinsics, poses)), depth, poses, intrinsics


def psnr_db(rendered: Tensor, truth: Tensor, margin: int = 4) -> float:
    inner = (..., slice(margin, -margin), slice(margin, -margin))
    return float(-10 * torch.log10((rendered[inner] - truth[inner]).square().mean()))


def frontal(
    depth: float = 2.0, conf: float = 50.0, tilt_deg: float = 0.0, rule: SplatRule | None = None
) -> tuple[Gaussians, Tensor]:
    """Gaussians of a plane before one camera, tilted about the vertical axis, and its depth."""
    poses, intrinsics = torch.eye(4)[None], pinhole(1)
    normal = torch.tensor([math.sin(math.radians(tilt_deg)), 0.0, math.cos(math.radians(tilt_deg))])
    maps = plane_depth(normal, depth * float(normal[2]), poses, intrinsics)
    images = torch.full((1, 3, HEIGHT, WIDTH), 0.25)
    gaussians = pixel_aligned(
        images=images,
        depth=maps,
        depth_conf=torch.full_like(maps, conf),
        cameras=Cameras(poses, intrinsics, *images.shape[2:]),
        rule=rule or SplatRule(),
    )
    return gaussians, maps


CENTRE = HEIGHT // 2 * WIDTH + WIDTH // 2  # row of a pixel next to the principal point


def test_a_plane_seen_from_two_cameras_renders_back_to_both_pictures() -> None:
    images, depth, poses, intrinsics = slanted_plane()
    conf = torch.full_like(depth, 50.0)
    gaussians = pixel_aligned(
        images=images, depth=depth, depth_conf=conf, cameras=Cameras(poses, intrinsics, *images.shape[2:])
    )
    rendered = render(gaussians, Cameras(poses, intrinsics, HEIGHT, WIDTH)).rgb
    # On a slanted surface the nearer neighbours cover part of every pixel, which displaces the picture by about half a pixel and
    # blurs it by one: 29 dB for this pattern. A further pixel off or Gaussians of 1 px cost 2 dB and more. The limit lies between.
    least_db = 28.5
    assert min(psnr_db(a, b) for a, b in zip(rendered, images, strict=True)) > least_db
    shifted = intrinsics.clone()
    shifted[:, :2, 2] += 1
    for camera, rule in ((shifted, SplatRule()), (intrinsics, SplatRule(std_px=1.0))):
        worse = pixel_aligned(
            images=images, depth=depth, depth_conf=conf, cameras=Cameras(poses, camera, *images.shape[2:]), rule=rule
        )
        assert psnr_db(render(worse, Cameras(poses, intrinsics, HEIGHT, WIDTH)).rgb, images) < least_db - 1


def test_a_surface_has_no_holes_even_from_somewhat_nearer() -> None:
    nearer = torch.eye(4)[None].clone()
    nearer[0, 2, 3] = (
        0.6  # of a distance of 2 in the centre and of 1.3 at the near end: pixels become 1.4 to 1.9 pixels wide
    )
    inner = (..., slice(4, -4), slice(4, -4))
    for camera, least in (
        # A certain pixel has opacity 0.94, of which the compensation takes a third, and its neighbours add to it.
        (torch.eye(4)[None], 0.92),
        # The middle between four pixels that are 1.9 apart is 1.3 from each, where a Gaussian of 1.3 px has 0.6 of its
        # opacity, less a sixth: 1 - (1 - 0.47)^4 = 0.92.
        (nearer, 0.9),
    ):
        alpha = render(frontal(tilt_deg=40)[0], Cameras(camera, pinhole(1), HEIGHT, WIDTH)).alpha
        assert alpha[inner].min() > least


@pytest.mark.parametrize("times", [0.5, 1, 2, 4, 8])
def test_a_surface_stays_closed_at_every_size(times: float) -> None:
    """However narrow a rule makes the Gaussians: what a pixel cannot resolve is not drawn narrower than that."""
    height, width = int(times * HEIGHT), int(times * WIDTH)
    lens = pinhole(1) * torch.tensor([times, times, 1.0])[:, None]
    margin = math.ceil(4 * times)
    inner = (..., slice(margin, -margin), slice(margin, -margin))
    for rule, least in ((SplatRule(), 0.9), (SplatRule(std_px=0.1), 0.6)):
        gaussians, _ = frontal(rule=rule)
        assert gaussians.antialiased
        assert render(gaussians, Cameras(torch.eye(4)[None], lens, height, width)).alpha[inner].min() > least
    # Without the limit, and drawn as it used to be, the same rule falls apart as soon as the picture is larger.
    gaussians, _ = frontal(rule=SplatRule(std_px=0.1))
    narrow = replace(gaussians, scales=gaussians.scales * 0.2, antialiased=False)
    if times >= 4:
        assert render(narrow, Cameras(torch.eye(4)[None], lens, height, width)).alpha[inner].min() < 0.1


@pytest.mark.parametrize("depth", [0.5, 2.0])
def test_scale_is_depth_over_focal(depth: float) -> None:
    gaussians, _ = frontal(depth)
    rule = SplatRule()
    pixel = depth / FOCAL
    expected = band_limited(rule.std_px * pixel * torch.tensor([1.0, 1.0, rule.thickness]), torch.tensor(pixel))
    # The pixel's ray is 0.7 degrees off the normal: 1 / cosine is 1.00007.
    assert torch.allclose(gaussians.scales[CENTRE], expected, rtol=1e-3)


@pytest.mark.parametrize(("tilt_deg", "stretch"), [(30.0, 1.155), (60.0, 2.0), (80.0, 3.0)])
def test_scale_grows_along_the_slant_up_to_a_limit(tilt_deg: float, stretch: float) -> None:
    gaussians, depth = frontal(tilt_deg=tilt_deg)
    limit = BAND_LIMIT_PX * float(depth.flatten()[CENTRE]) / FOCAL  # adds to both in squares
    along, across, _ = (gaussians.scales[CENTRE].square() - limit**2).sqrt()
    # The ray is 0.5 px off the axis, which is 0.5 degrees: 1.5 % of the tangent of 60 degrees.
    assert float(along / across) == pytest.approx(stretch, rel=0.03)
    first, _, third = rotation_from_quat_wxyz(gaussians.quat_wxyz[CENTRE]).unbind(-1)
    angle = math.radians(tilt_deg)
    facing = -torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    receding = torch.tensor([-math.cos(angle), 0.0, math.sin(angle)])
    # The normals come from differences of float32 depths; half a degree of ray turns the direction of a 30 degree slant by one.
    assert torch.allclose(third, facing, atol=1e-3)
    assert torch.allclose(first, receding, atol=0.03)


def test_opacity_grows_with_confidence_within_its_bounds() -> None:
    opacity = [float(frontal(conf=conf)[0].opacities[0]) for conf in (1.0, 2.0, 10.0, 1e6)]
    assert opacity == sorted(opacity)
    assert opacity[0] == pytest.approx(0.665)
    assert opacity[-1] == pytest.approx(0.95, abs=1e-4)


def test_positions_colours_and_provenance_are_those_of_the_pixels() -> None:
    images, depth, poses, intrinsics = slanted_plane()
    generated = torch.tensor([False, True])
    gaussians = pixel_aligned(
        images=images,
        depth=depth,
        depth_conf=torch.full_like(depth, 2.0),
        cameras=Cameras(poses, intrinsics, *images.shape[2:]),
        generated=generated,
    )
    pixels = HEIGHT * WIDTH
    assert torch.equal(gaussians.source_view, torch.arange(2).repeat_interleave(pixels))
    assert torch.equal(gaussians.generated, generated.repeat_interleave(pixels))
    assert torch.allclose(gaussians.means, unproject_to_world(depth, intrinsics, poses).reshape(-1, 3))
    assert torch.allclose(rgb_from_sh(gaussians.sh[:, 0]), images.movedim(1, -1).reshape(-1, 3), atol=1e-6)
    assert not frontal()[0].generated.any()


def test_points_give_the_same_gaussians_as_the_depth_they_came_from() -> None:
    _, depth, poses, intrinsics = slanted_plane()
    points = unproject_to_world(depth, intrinsics, poses)
    # There and back through float32 rotations.
    assert torch.allclose(depth_of_points(points, poses), depth, atol=1e-5)
    behind = points - 100 * poses[:, None, None, :3, 2]
    assert (depth_of_points(behind, poses) > 0).all()


def test_depth_is_differentiable_and_cameras_are_not() -> None:
    images, depth, poses, intrinsics = slanted_plane()
    depth.requires_grad_()
    poses.requires_grad_()
    gaussians = pixel_aligned(
        images=images,
        depth=depth,
        depth_conf=torch.full_like(depth, 2.0),
        cameras=Cameras(poses, intrinsics, *images.shape[2:]),
    )
    (gaussians.means.square().sum() + gaussians.scales.sum()).backward()
    assert depth.grad is not None
    assert depth.grad.ne(0).all()
    assert poses.grad is None


def test_normals_of_a_plane_are_its_own_and_face_the_camera() -> None:
    _, depth, poses, intrinsics = slanted_plane()
    normals = normals_from_depth(depth, intrinsics)
    normal = -torch.tensor([math.sin(math.radians(25)), 0.0, math.cos(math.radians(25))])
    in_camera = poses[:, :3, :3].transpose(1, 2) @ normal
    # Differences of float32 depths of about 3 over 2 pixels of 0.05: noise of a few 1e-6.
    assert torch.allclose(normals, in_camera[:, None, None].expand_as(normals), atol=1e-3)


@pytest.mark.parametrize("name", ["depth", "depth_conf"])
@pytest.mark.wrong_shapes
def test_maps_of_another_size_are_named(name: str) -> None:
    images, depth, poses, intrinsics = slanted_plane()
    maps = {"depth": depth, "depth_conf": torch.full_like(depth, 2.0)}
    maps[name] = maps[name][:, :-1]
    with pytest.raises(ValueError, match=rf"{name} has shape \(2, 47, 64\)"):
        pixel_aligned(images=images, cameras=Cameras(poses, intrinsics, *images.shape[2:]), **maps)
