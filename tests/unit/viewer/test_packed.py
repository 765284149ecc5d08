"""Packed splats: the right ones, in the right order, and the same scene after a round trip."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, concatenate
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.splatting import Render, render
from sceneexpander.viewer import packed as packed_module
from sceneexpander.viewer.packed import (
    BYTES_PER_SPLAT,
    FAITHFUL_DB,
    MOST_OPENED,
    PackedSplats,
    pack_splats,
    unpack_splats,
    visible_weight,
)
from tests.worlds.row_of_views import HEIGHT, WIDTH, reconstruction


def random_scene(count: int = 400, *, coefficients: int = 1, seed: int = 0) -> Reconstruction:
    """Gaussians of all shapes, colours and distances in front of three cameras."""
    base = reconstruction("sceneexpander", [0.0, 0.4, 1.5], generated=1)
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([3.0, 2.0, 6.0])
    gaussians = Gaussians(
        means=(torch.rand(count, 3, generator=generator) - 0.5) * spread + torch.tensor([0.5, 0.0, 4.5]),
        quat_wxyz=torch.randn(count, 4, generator=generator) * 3,
        scales=torch.exp(torch.randn(count, 3, generator=generator) - 3),
        opacities=torch.rand(count, generator=generator),
        sh=torch.rand(count, coefficients, 3, generator=generator) - 0.3,
        source_view=torch.randint(0, 3, (count,), generator=generator),
        generated=torch.rand(count, generator=generator) > 0.7,
    )
    return replace(base, gaussians=gaussians)


def see(reconstructed: Reconstruction, gaussians: Gaussians) -> torch.Tensor:
    return render(gaussians, Cameras(reconstructed.world_from_cam, reconstructed.intrinsics_px, HEIGHT, WIDTH)).rgb


def in_a_window(reconstructed: Reconstruction, gaussians: Gaussians) -> Render:
    """At the size of a window, twice that of the stored pictures."""
    lens = resize_intrinsics(reconstructed.intrinsics_px, 2, 2)
    return render(gaussians, Cameras(reconstructed.world_from_cam, lens, 2 * HEIGHT, 2 * WIDTH))


def test_a_round_trip_shows_the_same_scene() -> None:
    scene = random_scene()
    packed = pack_splats(scene)
    assert packed.count == packed.total == 400
    back = unpack_splats(packed)
    # Bytes of colour and opacity and 3 % of a scale: a few grey levels where many Gaussians overlap.
    assert float((see(scene, scene.gaussians) - see(scene, back)).abs().max()) < 6 / 255
    order = torch.argsort(visible_weight(scene), descending=True, stable=True)
    original = scene.gaussians.select(order)
    assert torch.equal(back.generated, original.generated)
    torch.testing.assert_close(back.opacities, original.opacities, atol=0.5 / 255 + 1e-6, rtol=0)
    # Half a step of the contracted coordinate; 8 is the farthest coordinate, 4 the reach.
    torch.testing.assert_close(back.means, original.means, atol=4 * (1 + 8 / 4) ** 2 / 65535, rtol=0)
    # Half a step of 1 / (1023 sqrt(2)) in three components; the fourth follows, at worst three times as far off.
    turned = rotation_from_quat_wxyz(back.quat_wxyz) - rotation_from_quat_wxyz(original.quat_wxyz)
    assert float(turned.abs().max()) < 0.008
    ratio = (back.scales / original.scales).log().abs()
    assert float(ratio.max()) <= 14 / 255 / 2 + 1e-4


def test_the_least_visible_are_left_out_and_nothing_is_seen_of_it() -> None:
    wall = reconstruction("captured", [0.0, 0.4])
    count = len(wall.gaussians)
    hidden = replace(wall.gaussians, means=wall.gaussians.means - torch.tensor([0.0, 0.0, 30.0]))
    both = replace(wall, gaussians=concatenate([hidden, wall.gaussians]))
    weight = visible_weight(both)
    assert float(weight[:count].abs().max()) == 0, "behind all cameras"
    seen = int((weight > 0).sum())
    packed = pack_splats(both, limit=seen)
    assert (packed.count, packed.total) == (seen, 2 * count)
    kept = unpack_splats(packed)
    assert bool((kept.means[:, 2] > 0).all())
    torch.testing.assert_close(see(wall, kept), see(wall, wall.gaussians), atol=4 / 255, rtol=0)


def test_as_many_are_kept_as_the_worst_view_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_module, "_FEWEST", 10)
    monkeypatch.setattr(packed_module, "_MORE", 10)
    scene = random_scene(600)
    packed = pack_splats(scene)
    assert 10 < packed.count < packed.total == 600
    assert packed.worst_view_db >= FAITHFUL_DB
    order = torch.argsort(visible_weight(scene), descending=True, stable=True)

    whole = in_a_window(scene, scene.gaussians)

    def worst(count: int) -> float:
        error = (whole.rgb.clamp(0, 1) - in_a_window(scene, scene.gaussians.select(order[:count])).rgb.clamp(0, 1)) ** 2
        return -10 * math.log10(float(error.mean((1, 2, 3)).max()))

    def opened(count: int) -> float:
        through = (whole.alpha >= 0.9) & (in_a_window(scene, scene.gaussians.select(order[:count])).alpha < 0.9)
        return float(through.double().mean((1, 2)).max())

    assert worst(packed.count) == pytest.approx(packed.worst_view_db, abs=0.01)
    assert opened(packed.count) <= MOST_OPENED
    assert worst(packed.count - 10) < FAITHFUL_DB or opened(packed.count - 10) > MOST_OPENED
    cut = pack_splats(scene, limit=40)
    assert cut.count == 40
    assert cut.worst_view_db == pytest.approx(worst(40), abs=0.01)
    assert cut.worst_view_db < FAITHFUL_DB
    assert pack_splats(scene, limit=10**6).worst_view_db >= FAITHFUL_DB


def test_weights_are_shares_of_pixels() -> None:
    scene = random_scene()
    with torch.no_grad():
        alpha = render(scene.gaussians, Cameras(scene.world_from_cam, scene.intrinsics_px, HEIGHT, WIDTH)).alpha
    # Every pixel's alpha is the sum of the shares in it.
    assert float(visible_weight(scene).sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)


def test_any_prefix_is_the_most_visible_part() -> None:
    scene = random_scene()
    whole, part = (pack_splats(scene, limit=limit) for limit in (400, 100))
    assert part.count == 100
    torch.testing.assert_close(unpack_splats(part).means, unpack_splats(whole).means[:100], atol=1e-6, rtol=0)


def test_colours_are_those_towards_the_source_view() -> None:
    scene = random_scene(coefficients=4)
    flat = random_scene(coefficients=1)
    colours = unpack_splats(pack_splats(scene)).sh
    assert colours.shape == (400, 1, 3)
    assert not torch.allclose(colours, unpack_splats(pack_splats(flat)).sh)


def test_nothing_at_all_can_be_packed() -> None:
    empty = replace(random_scene(), gaussians=random_scene().gaussians.select(torch.zeros(400, dtype=torch.bool)))
    packed = pack_splats(empty)
    assert packed.count == packed.total == 0
    assert len(unpack_splats(packed)) == 0


def test_what_is_saved_reads_back_and_damage_is_named(tmp_path: Path) -> None:
    packed = pack_splats(random_scene(), limit=37)
    packed.save(tmp_path)
    back = PackedSplats.load(tmp_path)
    assert torch.equal(back.data, packed.data)
    assert (back.method, back.total, back.reach) == (packed.method, packed.total, packed.reach)
    torch.testing.assert_close(back.cameras.world_from_cam, packed.cameras.world_from_cam)
    replace(packed, data=packed.data[:BYTES_PER_SPLAT]).save(tmp_path)
    assert PackedSplats.load(tmp_path).count == 1
    with pytest.raises(ValueError, match="19 bytes"):
        replace(packed, data=torch.zeros(19, dtype=torch.uint8))
    with pytest.raises(ArtifactError, match="does not exist"):
        PackedSplats.load(tmp_path / "none")


def test_packing_repeats_bit_for_bit() -> None:
    first, second = (pack_splats(random_scene(), limit=300).data.numpy() for _ in range(2))
    assert np.array_equal(first, second)
