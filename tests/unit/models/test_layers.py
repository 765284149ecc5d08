"""The shared building blocks: rotary positions, attention, dense head, camera head, trunk."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from sceneexpander.models.layers.activations import signed_expm1
from sceneexpander.models.layers.attention import Attention
from sceneexpander.models.layers.block import Block
from sceneexpander.models.layers.camera_head import CameraHead, CameraHeadNames
from sceneexpander.models.layers.dpt import DptConfig, DptHead, add_uv_embedding
from sceneexpander.models.layers.init import initialise_layers
from sceneexpander.models.layers.quaternion import quat_xyzw_from_matrix
from sceneexpander.models.layers.rope import RopeTable, apply_rope, grid_positions, grid_rope, rope_angles
from sceneexpander.models.layers.trunk import AlternatingTrunk, per_view_tokens
from sceneexpander.models.layers.vit import DinoEncoder

FLOAT_NOISE = 1e-5  # float32 sums of a few dozen terms of size one


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=generator(seed))


def table(rows: int, columns: int, head_dim: int, specials: int = 0) -> RopeTable:
    return grid_rope(rows, columns, specials=specials, head_dim=head_dim, base=100.0, like=torch.zeros(1))


def test_special_tokens_are_not_rotated_and_patches_start_at_one() -> None:
    positions = grid_positions(2, 3, specials=2)
    assert positions.tolist() == [[0, 0], [0, 0], [1, 1], [1, 2], [1, 3], [2, 1], [2, 2], [2, 3]]
    heads = randn(1, 8, 2, 16)
    turned = apply_rope(heads, table(2, 3, 16, specials=2))
    assert torch.equal(turned[:, :2], heads[:, :2])
    assert (turned[:, 2:] - heads[:, 2:]).abs().amax(dim=(0, 2, 3)).min() > 0.1


def test_rope_keeps_lengths_and_depends_on_relative_position_only() -> None:
    query, key = randn(16, seed=1), randn(16, seed=2)
    rope = table(5, 5, 16)
    queries = apply_rope(query.expand(1, 25, 1, 16), rope)[0, :, 0].view(5, 5, 16)
    keys = apply_rope(key.expand(1, 25, 1, 16), rope)[0, :, 0].view(5, 5, 16)
    assert torch.allclose(queries.norm(dim=-1), query.norm().expand(5, 5), atol=FLOAT_NOISE)
    # Same offset (+1 row, -2 columns) from two places.
    assert torch.allclose(queries[0, 2] @ keys[1, 0], queries[3, 4] @ keys[4, 2], atol=FLOAT_NOISE)
    assert (queries[0, 2] @ keys[1, 0] - queries[0, 2] @ keys[2, 0]).abs() > 1e-3


def test_rope_rotates_rows_in_the_first_half_pairing_channel_j_with_j_plus_quarter() -> None:
    # Head width 8: rows use channels 0..3, columns 4..7; frequencies 1 and 100^(-1/2).
    heads = torch.eye(8).expand(1, 3, 8, 8)  # 8 heads, head h is the unit vector of channel h
    rope = table(3, 1, 8)
    turned = apply_rope(heads, rope)[0, 2]  # at row 3, column 1
    assert torch.allclose(turned[0, [0, 2]], torch.tensor([math.cos(3), math.sin(3)]), atol=1e-6)
    assert torch.allclose(turned[2, [0, 2]], torch.tensor([-math.sin(3), math.cos(3)]), atol=1e-6)
    assert torch.allclose(turned[5, [5, 7]], torch.tensor([math.cos(0.1), math.sin(0.1)]), atol=1e-6)


def test_rope_refuses_odd_widths() -> None:
    with pytest.raises(ValueError, match="divisible by 4, got 6"):
        rope_angles(grid_positions(1, 1, specials=0), 6, 100.0)


def test_rope_table_made_in_inference_mode_serves_training() -> None:
    with torch.inference_mode():
        table(7, 3, 8)
    heads = randn(1, 21, 1, 8).requires_grad_()
    apply_rope(heads, table(7, 3, 8)).sum().backward()
    assert heads.grad is not None


def test_attention_equals_its_formula() -> None:
    attention = Attention(16, 2, qk_norm=True)
    initialise_layers(attention, generator=generator())
    nn.init.normal_(attention.q_norm.weight, generator=generator(1))
    tokens, rope = randn(2, 6, 16), table(2, 3, 8)
    qkv = attention.qkv(tokens).view(2, 6, 3, 2, 8)
    query = apply_rope(attention.q_norm(qkv[:, :, 0]), rope)
    key = apply_rope(attention.k_norm(qkv[:, :, 1]), rope)
    scores = torch.einsum("bqhd,bkhd->bhqk", query, key) / math.sqrt(8)
    mixed = torch.einsum("bhqk,bkhd->bqhd", scores.softmax(-1), qkv[:, :, 2]).reshape(2, 6, 16)
    assert torch.allclose(attention(tokens, rope), attention.proj(mixed), atol=FLOAT_NOISE)


def test_attention_without_positions_does_not_care_about_order() -> None:
    attention = Attention(16, 4)
    initialise_layers(attention, generator=generator())
    tokens, order = randn(1, 5, 16), torch.tensor([3, 0, 4, 1, 2])
    assert torch.allclose(attention(tokens)[:, order], attention(tokens[:, order]), atol=FLOAT_NOISE)


def test_block_with_zero_gains_is_the_identity() -> None:
    block = Block(16, 2, layer_scale=0.0)
    tokens = randn(2, 3, 16)
    assert torch.equal(block(tokens), tokens)


def test_block_names_are_those_of_the_checkpoints() -> None:
    names = {name for name, _ in Block(8, 2).named_parameters()}
    expected = {"ls1.gamma", "ls2.gamma"}
    for layer in ("norm1", "attn.qkv", "attn.proj", "norm2", "mlp.fc1", "mlp.fc2"):
        expected |= {f"{layer}.weight", f"{layer}.bias"}
    assert names == expected


def test_uv_embedding_equals_its_formula_at_a_pixel() -> None:
    width, height, channels, aspect = 5, 3, 8, 2.0
    embedded = add_uv_embedding(torch.zeros(1, channels, height, width), aspect)
    u = aspect / math.sqrt(5) * (width - 1) / width  # last column
    v = -1 / math.sqrt(5) * (height - 1) / height  # first row
    w = [1.0, 100**-0.5]
    expected = [f(u * k) for f in (math.sin, math.cos) for k in w] + [f(v * k) for f in (math.sin, math.cos) for k in w]
    assert torch.allclose(embedded[0, :, 0, -1], 0.1 * torch.tensor(expected), atol=1e-6)


def dpt(config: DptConfig) -> DptHead:
    head = DptHead(16, 2, config)
    initialise_layers(head, generator=generator())
    return head


def collected(levels: int, views: int = 3) -> list[torch.Tensor]:
    return [randn(views, 1 + 6, 16, seed=j) for j in range(levels)]


def test_dpt_chunks_change_nothing() -> None:
    small, whole = (
        DptConfig(features=8, out_channels=(8, 8, 8, 8), views_per_chunk=2),
        DptConfig(features=8, out_channels=(8, 8, 8, 8)),
    )
    one, other = dpt(small), dpt(whole)
    tokens = collected(4)
    a = one(tokens, specials=1, grid=(2, 3), size=(28, 42))
    b = other(tokens, specials=1, grid=(2, 3), size=(28, 42))
    assert a.shape == (3, 2, 28, 42)
    assert torch.allclose(a, b, atol=FLOAT_NOISE)


def test_dpt_ignores_special_tokens_and_reads_every_level() -> None:
    head = dpt(DptConfig(features=8, out_channels=(8, 8, 8), factors=(4, 2, 1)))
    tokens = collected(3)
    before = head(tokens, specials=1, grid=(2, 3), size=(20, 30))
    tokens[0][:, 0] += 5
    assert torch.equal(head(tokens, specials=1, grid=(2, 3), size=(20, 30)), before)
    for level in range(3):
        changed = [t.clone() for t in tokens]
        changed[level][:, 3] += randn(16, seed=9)
        assert (head(changed, specials=1, grid=(2, 3), size=(20, 30)) - before).abs().max() > 1e-4


def test_dpt_skip_is_rectified_only_when_asked() -> None:
    config = {"features": 8, "out_channels": (8, 8), "factors": (2, 1)}
    rectified, plain = dpt(DptConfig(**config)), dpt(DptConfig(**config, rectified_skip=False))
    tokens = collected(2)
    a = rectified(tokens, specials=1, grid=(2, 3), size=(8, 12))
    b = plain(tokens, specials=1, grid=(2, 3), size=(8, 12))
    assert (a - b).abs().max() > 1e-3


def test_dpt_refuses_widths_that_cannot_carry_positions() -> None:
    with pytest.raises(ValueError, match="divisible by 4"):
        DptConfig(features=12, out_channels=(8, 8, 8, 8))
    with pytest.raises(ValueError, match="3 level widths for 4 levels"):
        DptConfig(out_channels=(8, 8, 8))


def camera_head(names: CameraHeadNames | None = None) -> CameraHead:
    head = CameraHead(16, depth=1, heads=2, names=names)
    initialise_layers(head, generator=generator())
    return head


def test_camera_head_with_zero_predictor_returns_its_start_exactly() -> None:
    head = camera_head()
    nn.init.zeros_(head.param_predictor.fc2.weight)
    nn.init.zeros_(head.param_predictor.fc2.bias)
    start = torch.rand(2, 3, 9, generator=generator(1))
    steps = head(randn(2, 3, 16), start)
    assert len(steps) == 4
    assert all(torch.equal(step, start) for step in steps)


def test_camera_head_gradient_flows_through_the_last_increment_only() -> None:
    head = camera_head()
    tokens = randn(1, 2, 16)
    steps = head(tokens)
    # The last vector is (detached previous) + increment: the learned first token must get nothing from it.
    steps[-1].sum().backward()
    assert head.init_token.grad is None or head.init_token.grad.abs().max() == 0
    assert head.param_predictor.fc2.weight.grad.abs().max() > 0


def test_camera_head_fields_of_view_are_never_negative() -> None:
    head = camera_head()
    nn.init.constant_(head.param_predictor.fc2.bias, -5.0)
    assert (head(randn(1, 2, 16))[-1][..., 7:] == 0).all()


def test_camera_head_views_see_each_other_and_names_are_arguments() -> None:
    names = CameraHeadNames(init_token="empty_pose_tokens", blocks="trunk", out_norm="trunk_norm")  # noqa: S106
    head = camera_head(names)
    assert {"empty_pose_tokens", "trunk_norm.weight"} <= set(head.state_dict())
    assert torch.allclose(head(randn(1, 3, 16))[-1], camera_head()(randn(1, 3, 16))[-1], atol=FLOAT_NOISE)
    tokens = randn(1, 3, 16)
    before = head(tokens)[-1][:, 0]
    tokens[:, 2] += randn(16, seed=9)
    assert (head(tokens)[-1][:, 0] - before).abs().max() > 1e-4


def trunk() -> AlternatingTrunk:
    model = AlternatingTrunk(16, depth=3, heads=2, collect=(0, 2), layer_scale=0.5)
    initialise_layers(model, generator=generator())
    return model


def test_trunk_frame_half_is_per_view_and_global_half_is_not() -> None:
    model, rope = trunk(), table(2, 2, 8)
    tokens = randn(1, 3, 4, 16)
    first = model.alternate(tokens, rope)[0]
    tokens[:, 2] += randn(16, seed=9)
    second = model.alternate(tokens, rope)[0]
    assert torch.equal(first[:, :2, :, :16], second[:, :2, :, :16])
    assert (first[:, :2, :, 16:] - second[:, :2, :, 16:]).abs().max() > 1e-3


def test_trunk_hook_between_frame_and_global_is_part_of_what_is_collected() -> None:
    model, rope = trunk(), table(2, 2, 8)
    tokens, seen = randn(1, 2, 4, 16), []

    def add_to_first_token(index: int, frames: torch.Tensor) -> torch.Tensor:
        seen.append(index)
        changed = frames.clone()
        changed[:, :, 0] += 1
        return changed

    plain, hooked = model.alternate(tokens, rope), model.alternate(tokens, rope, after_frame=add_to_first_token)
    assert seen == [0, 1, 2]
    assert torch.allclose(hooked[0][:, :, 0, :16], plain[0][:, :, 0, :16] + 1, atol=1e-6)


def test_trunk_refuses_impossible_collections() -> None:
    with pytest.raises(ValueError, match=r"not ascending within 0\.\.2"):
        AlternatingTrunk(16, depth=3, heads=2, collect=(0, 3))


def test_first_view_has_its_own_token() -> None:
    token = torch.arange(2.0).view(1, 2, 1, 1)
    assert per_view_tokens(token, 2, 3)[..., 0, 0].tolist() == [[0, 1, 1], [0, 1, 1]]
    assert per_view_tokens(token, 1, 1)[..., 0, 0].tolist() == [[0]]


def test_position_table_is_untouched_at_its_own_size() -> None:
    encoder = DinoEncoder(8, depth=1, heads=2, image_size=42)
    nn.init.normal_(encoder.pos_embed, generator=generator())
    assert encoder.position_table(3, 3) is encoder.pos_embed
    assert encoder.position_table(2, 4).shape == (1, 9, 8)
    assert torch.equal(encoder.position_table(2, 4)[:, 0], encoder.pos_embed[:, 0])


def test_quaternion_of_a_scaled_matrix_is_not_normalised() -> None:
    assert torch.allclose(quat_xyzw_from_matrix(torch.eye(3)), torch.tensor([0, 0, 0, 1.0]))
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    assert torch.allclose(quat_xyzw_from_matrix(half_turn).abs(), torch.tensor([1.0, 0, 0, 0]))
    assert quat_xyzw_from_matrix(0.9 * torch.eye(3)).norm() < 0.99


def test_signed_expm1_is_odd_with_unit_slope() -> None:
    x = torch.tensor([-2.0, -1e-3, 0.0, 1e-3, 2.0])
    y = signed_expm1(x)
    assert torch.allclose(y, -y.flip(0))
    assert y[3] == pytest.approx(1e-3, rel=1e-3)
