"""The voxel merge of WorldMirror's Gaussians."""

from __future__ import annotations

from collections import defaultdict

import torch

from sceneexpander.models.worldmirror.gaussians import PixelGaussians
from sceneexpander.models.worldmirror.merge import merge_voxels, voxel_groups

VOXEL = 0.5
FLOAT_NOISE = 1e-5  # float32 sums of a few dozen terms of size one


def random_pixels(count: int, seed: int = 0) -> PixelGaussians:
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(1, count, *shape, generator=generator)

    return PixelGaussians(
        means=2 * rand(3) - 1,
        quats=torch.nn.functional.normalize(rand(4), dim=-1),
        scales=rand(3),
        opacities=rand(),
        sh=rand(1, 3),
        residual_sh=rand(1, 3),
        weights=0.05 + 0.9 * rand(),
    )


def provenance(count: int, generated_from: int | None = None) -> dict[str, torch.Tensor]:
    source = torch.arange(count)
    made = torch.zeros(count, dtype=torch.bool) if generated_from is None else source >= generated_from
    return {"source_view": source, "generated": made}


def test_merge_equals_a_loop_over_voxels() -> None:
    pixels = random_pixels(200)
    merged = merge_voxels(pixels, 0, voxel_size=VOXEL, **provenance(200, generated_from=100))
    voxels: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for i, mean in enumerate(pixels.means[0]):
        voxels[tuple(int(v) for v in torch.floor(mean / VOXEL))].append(i)
    assert len(merged) == len(voxels)
    for row, key in enumerate(sorted(voxels)):
        members = torch.tensor(voxels[key])
        w = pixels.weights[0, members]
        share = w / w.sum()
        assert torch.allclose(merged.means[row], share @ pixels.means[0, members], atol=FLOAT_NOISE)
        assert torch.allclose(merged.scales[row], share @ pixels.scales[0, members], atol=FLOAT_NOISE)
        assert torch.allclose(merged.sh[row, 0], share @ pixels.sh[0, members, 0], atol=FLOAT_NOISE)
        quat = share @ pixels.quats[0, members]
        assert torch.allclose(merged.quat_wxyz[row], quat / quat.norm(), atol=FLOAT_NOISE)
        assert torch.allclose(merged.opacities[row], (w * w).sum() / w.sum(), atol=FLOAT_NOISE)
        assert int(merged.source_view[row]) == int(members[w.argmax()])
        assert bool(merged.generated[row]) == bool(share[members >= 100].sum() > 0.5)


def test_a_lone_gaussian_keeps_everything_but_takes_its_weight_as_opacity() -> None:
    pixels = random_pixels(1)
    merged = merge_voxels(pixels, 0, voxel_size=VOXEL, **provenance(1))
    assert torch.allclose(merged.means, pixels.means[0], atol=FLOAT_NOISE)
    assert torch.allclose(merged.opacities, pixels.weights[0], atol=FLOAT_NOISE)


def test_order_of_the_gaussians_does_not_matter() -> None:
    pixels = random_pixels(80)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    a = merge_voxels(pixels, 0, voxel_size=VOXEL, **provenance(80))
    b = merge_voxels(
        pixels.select(order[None]), 0, voxel_size=VOXEL, source_view=order, generated=torch.zeros(80, dtype=torch.bool)
    )
    assert torch.allclose(a.means, b.means, atol=FLOAT_NOISE)
    assert torch.equal(a.source_view, b.source_view)


def test_generated_needs_more_than_half_of_the_weight() -> None:
    pixels = random_pixels(2)
    both = pixels.select(torch.tensor([[0, 0]]))  # two copies of one Gaussian: exactly half each
    merged = merge_voxels(both, 0, voxel_size=VOXEL, **provenance(2, generated_from=1))
    assert merged.generated.tolist() == [False]
    assert merged.source_view.tolist() == [0]  # the first of equals


def test_wild_means_neither_overflow_nor_join_others() -> None:
    means = torch.tensor([[0.1, 0.1, 0.1], [1e30, -1e30, 1e30], [torch.inf, 0.1, 0.1], [0.1, 0.1, 0.1]])
    group, count = voxel_groups(means, 1e-3)
    assert count == 3
    assert group[0] == group[3]
    assert len({int(g) for g in group}) == 3


def test_merge_is_differentiable_in_every_value() -> None:
    pixels = random_pixels(20)
    leaves = {n: getattr(pixels, n).clone().requires_grad_() for n in ("means", "quats", "scales", "sh", "weights")}
    live = PixelGaussians(**leaves, opacities=pixels.opacities, residual_sh=pixels.residual_sh)
    merged = merge_voxels(live, 0, voxel_size=VOXEL, **provenance(20))
    total = sum(getattr(merged, n).square().sum() for n in ("means", "scales", "opacities", "sh"))
    (total + merged.quat_wxyz[:, 0].sum()).backward()
    assert all(leaf.grad is not None and leaf.grad.abs().sum() > 0 for leaf in leaves.values())
