import pytest
import torch

from sceneexpander.adaptation.augmentation import (
    Mode,
    _block_weights,
    draw_mode,
    draw_warp,
    identity_grid,
    random_affine,
    warp_grid,
)
from sceneexpander.adaptation.config import AugmentConfig
from sceneexpander.geometry.lookup import warp_maps

STILL = AugmentConfig(rotation_deg=0, translation=0, scale=0, shear_deg=0)


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("mode", list(Mode))
def test_zero_magnitudes_change_nothing(mode: Mode) -> None:
    grid = warp_grid(mode, STILL, 20, 30, _generator())
    torch.testing.assert_close(grid, identity_grid(20, 30), atol=1e-6, rtol=0)


def test_the_identity_grid_samples_every_pixel_at_its_centre() -> None:
    image = torch.rand(3, 17, 23, generator=_generator())
    torch.testing.assert_close(warp_maps(image, identity_grid(17, 23)), image, atol=1e-5, rtol=0)


def test_identity_mode_has_no_warp() -> None:
    config = AugmentConfig(identity=1, global_affine=0, blockwise=0, global_and_block=0)
    assert draw_warp(config, 8, 8, _generator()) is None


def test_modes_come_with_their_probabilities() -> None:
    config = AugmentConfig(identity=0.1, global_affine=0.2, blockwise=0.3, global_and_block=0.4)
    generator = _generator(7)
    draws = [draw_mode(config, generator) for _ in range(4000)]
    for mode, p in zip(Mode, (0.1, 0.2, 0.3, 0.4), strict=True):
        assert abs(draws.count(mode) / 4000 - p) <= 3 * (p * (1 - p) / 4000) ** 0.5


@pytest.mark.parametrize(("length", "blocks", "feather"), [(30, 3, 1 / 6), (17, 3, 0.5), (9, 1, 0.2), (12, 4, 0.0)])
def test_block_weights_are_a_partition_of_unity(length: int, blocks: int, feather: float) -> None:
    weights = _block_weights(length, blocks, feather)
    assert weights.min() >= 0
    torch.testing.assert_close(weights.sum(0), torch.ones(length))


def test_seams_of_the_blockwise_warp_are_smooth() -> None:
    config = AugmentConfig()
    height, width = 120, 160
    smooth = warp_grid(Mode.BLOCK, config, height, width, _generator(3))
    hard = warp_grid(Mode.BLOCK, AugmentConfig(feather=0.0), height, width, _generator(3))

    def largest_jump(grid: torch.Tensor) -> float:
        offset = grid - identity_grid(height, width)
        return float(torch.maximum(offset.diff(dim=0).abs().max(), offset.diff(dim=1).abs().max()))

    assert largest_jump(smooth) < 0.35 * largest_jump(hard)


@pytest.mark.parametrize("mode", [Mode.GLOBAL, Mode.BLOCK, Mode.GLOBAL_AND_BLOCK])
def test_warps_are_weak_but_real(mode: Mode) -> None:
    moves = []
    for seed in range(30):
        grid = warp_grid(mode, AugmentConfig(), 60, 80, _generator(seed))
        moves.append(float((grid - identity_grid(60, 80)).norm(dim=-1).mean()))
    assert 0.005 < sum(moves) / len(moves) < 0.1  # in half-widths: a few pixels of 80


def test_rotation_is_a_rotation_for_any_aspect() -> None:
    # Only rotation on: distances in pixels are preserved, which fails if the aspect is forgotten.
    config = AugmentConfig(rotation_deg=10, translation=0, scale=0, shear_deg=0)
    height, width = 40, 120
    grid = warp_grid(Mode.GLOBAL, config, height, width, _generator(5))
    pixels = (grid + 1) / 2 * torch.tensor([width, height])
    steps = pixels.diff(dim=1).norm(dim=-1)
    torch.testing.assert_close(steps, torch.ones_like(steps), atol=1e-4, rtol=0)
    assert float((pixels[:, 0, 1] - pixels[:, -1, 1]).abs().max()) > 0.5, "the test must see a rotation"


def test_probabilities_must_sum_to_one() -> None:
    with pytest.raises(ValueError, match="sum to 1"):
        AugmentConfig(identity=0.5)


def test_blocks_move_as_strongly_as_configured() -> None:
    def mean_move(strength: float) -> float:
        config = AugmentConfig(block_strength=strength)
        moves = [
            (warp_grid(Mode.BLOCK, config, 60, 80, _generator(seed)) - identity_grid(60, 80)).norm(dim=-1).mean()
            for seed in range(5)
        ]
        return float(torch.stack(moves).mean())

    assert mean_move(1.0) == pytest.approx(2 * mean_move(0.5), rel=0.1)
    assert mean_move(0.0) < 1e-6


def test_every_kind_of_motion_is_in_an_affine_map_as_strongly_as_configured() -> None:
    limits = {"rotation_deg": 5.0, "translation": 0.05, "scale": 0.1, "shear_deg": 5.0}
    for kind, limit in limits.items():
        config = AugmentConfig(**{**dict.fromkeys(limits, 0.0), kind: limit})
        maps = random_affine(config, 400, 1.0, 1.5, _generator(1))
        linear, shift = maps[:, :, :2], maps[:, :, 2]
        off = (linear - torch.eye(2)).abs().amax((1, 2))
        angle = torch.deg2rad(torch.tensor(limit))
        # The largest of 400 uniform draws is within a few per cent of the limit.
        expected = {"rotation_deg": angle.sin(), "scale": torch.tensor(limit).expm1(), "shear_deg": angle.tan()}
        if kind == "translation":
            assert float(off.max()) < 1e-6
            assert shift.abs().amax(0).tolist() == pytest.approx([2 * limit * 1.5, 2 * limit], rel=0.03)
        else:
            assert float(off.max()) == pytest.approx(float(expected[kind]), rel=0.04)
            assert float(shift.abs().max()) == 0
