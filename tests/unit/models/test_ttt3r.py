"""TTT3R: the recurrence, its rate, resets, and the reconstructor made of them."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.camera import project_points
from sceneexpander.models.layers.rope import RopeTable, apply_rope, grid_rope
from sceneexpander.models.protocol import Head, Reconstructor
from sceneexpander.models.registry import build_reconstructor
from sceneexpander.models.ttt3r import TTT3R, TTT3RConfig
from sceneexpander.models.ttt3r.blocks import CrossAttention
from sceneexpander.models.ttt3r.cameras import (
    chain_resets,
    focal_from_points,
    intrinsics_from_points,
    plan_steps,
    world_from_camera_pose,
)
from sceneexpander.models.ttt3r.images import preprocess_image, ray_map
from sceneexpander.models.ttt3r.network import StepOutput, StreamStep
from sceneexpander.models.weights import load_weights
from tests.support.tiny_worldmirror import make_sizeable, random_images

HEIGHT, WIDTH = 32, 48
FLOAT_NOISE = 1e-5  # float32, values of size one, a network a few layers deep
# Without the rounding to float16, which can turn a difference in the last bit into one of 1e-3.
TINY = replace(TTT3RConfig.tiny(), encoder_rope_fp16=False)


def tiny(config: TTT3RConfig = TINY) -> TTT3R:
    """The same numbers for every configuration that differs in switches only."""
    generator = torch.Generator().manual_seed(0)
    model = TTT3R.create(config, generator=generator)
    make_sizeable(model, generator=generator)
    return model


@pytest.fixture(scope="module")
def model() -> TTT3R:
    return tiny()


def views(count: int, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    return random_images(count, height, width)


def steps_of(images: Tensor, **flags: bool) -> list[StreamStep]:
    return [StreamStep(image=image[None] * 2 - 1, **flags) for image in images]


@torch.inference_mode()
def streamed(model: TTT3R, steps: list[StreamStep]) -> list[StepOutput]:
    return list(model.stream(steps, maps=frozenset()))


def poses(outputs: list[StepOutput]) -> Tensor:
    return torch.cat([output.maps.camera_pose for output in outputs])


@torch.inference_mode()
def test_it_is_a_reconstructor_and_fills_every_field(model: TTT3R) -> None:
    assert isinstance(model, Reconstructor)
    assert model.name == "ttt3r"
    images, generated = views(3), torch.tensor([False, False, True])
    prediction = model.predict(images, generated=generated)
    maps = {"depth": 3, "depth_conf": 3, "normals": 4, "normals_conf": 3, "points": 4, "points_conf": 3}
    for name, axes in maps.items():
        value = getattr(prediction, name)
        assert value.shape == (3, HEIGHT, WIDTH, 3)[:axes], name
        assert torch.isfinite(value).all(), name
    assert prediction.depth is not None
    assert (prediction.depth > 0).all()
    assert prediction.normals is not None
    assert torch.allclose(prediction.normals.norm(dim=-1), torch.ones(3, HEIGHT, WIDTH), atol=FLOAT_NOISE)
    assert prediction.camera_vector.shape == (3, 9)
    assert torch.isfinite(prediction.camera_vector).all()
    assert prediction.gaussians is not None
    assert len(prediction.gaussians) == 3 * HEIGHT * WIDTH
    assert torch.equal(prediction.gaussians.generated, prediction.gaussians.source_view == 2)


@torch.inference_mode()
def test_only_what_is_asked_for_is_given(model: TTT3R) -> None:
    prediction = model.predict(views(1), heads=frozenset({Head.CAMERA, Head.POINTS}))
    assert prediction.points is not None
    assert prediction.depth is None
    assert prediction.normals is None
    assert prediction.gaussians is None


@torch.inference_mode()
def test_an_inserted_view_only_appends(model: TTT3R) -> None:
    images = views(4)
    heads = frozenset({Head.DEPTH, Head.POINTS})
    before, after = model.predict(images[:3], heads=heads), model.predict(images, heads=heads)
    assert before.points is not None
    assert after.points is not None
    # Every step runs on its own: the numbers are the same but for reductions over a batch of views.
    assert torch.allclose(before.points, after.points[:3], atol=FLOAT_NOISE)
    assert torch.allclose(before.camera_vector, after.camera_vector[:3], atol=FLOAT_NOISE)


def test_the_order_of_the_views_matters(model: TTT3R) -> None:
    a, b, c = views(3)
    same = poses(streamed(model, steps_of(torch.stack([a, b, c]))))
    swapped = poses(streamed(model, steps_of(torch.stack([b, a, c]))))
    assert (same[2] - swapped[2]).abs().max() > 1e-3


def test_the_rate_differs_from_the_full_update_from_the_third_view_on(model: TTT3R) -> None:
    plain = tiny(replace(TINY, update="cut3r"))
    assert plain.name == "cut3r"
    steps = steps_of(views(4))
    ours, theirs = poses(streamed(model, steps)), poses(streamed(plain, steps))
    assert torch.allclose(ours[:2], theirs[:2], atol=FLOAT_NOISE)
    assert ((ours[2:] - theirs[2:]).abs().amax(dim=1) > 1e-3).all()


def test_the_state_moves_by_the_rate_of_each_token(model: TTT3R) -> None:
    first, second = streamed(model, steps_of(views(2)))
    assert torch.equal(first.after.tokens, first.decoded.state_tokens)
    rate = second.decoded.rate[..., None]
    assert ((rate > 0) & (rate < 1)).all()
    mixed = rate * second.decoded.state_tokens + (1 - rate) * first.after.tokens
    assert torch.allclose(second.after.tokens, mixed, atol=FLOAT_NOISE)
    assert torch.equal(second.after.memory, second.decoded.memory)


def test_the_alignment_is_the_mean_of_the_logits() -> None:
    generator = torch.Generator().manual_seed(3)
    attention = CrossAttention(16, 2)
    tokens, context = (torch.randn(2, count, 16, generator=generator) for count in (6, 9))
    rope = grid_rope(2, 3, specials=0, head_dim=8, base=100.0, like=tokens)
    context_rope = grid_rope(2, 4, specials=1, origin=-1, head_dim=8, base=100.0, like=tokens)
    read, alignment = attention(tokens, context, rope, context_rope)

    def heads(values: Tensor, table: RopeTable) -> Tensor:
        return apply_rope(values.unflatten(-1, (2, 8)), table).transpose(1, 2)

    query, key = heads(attention.projq(tokens), rope), heads(attention.projk(context), context_rope)
    logits = query @ key.transpose(-1, -2) / math.sqrt(8)
    assert torch.allclose(alignment, logits.mean((1, 3)), atol=1e-6)
    value = attention.projv(context).unflatten(-1, (2, 8)).transpose(1, 2)
    expected = attention.proj((logits.softmax(-1) @ value).transpose(1, 2).flatten(2))
    assert torch.allclose(read, expected, atol=1e-6)


@torch.inference_mode()
def test_a_stream_keeps_nothing_but_its_state(model: TTT3R) -> None:
    past: list[weakref.ref[Tensor]] = []

    def lazily() -> Iterator[StreamStep]:
        for image in views(5):
            signed = image[None] * 2 - 1
            past.append(weakref.ref(signed))
            yield StreamStep(image=signed)

    stream = model.stream(lazily(), maps=frozenset())
    for index in range(5):
        output = next(stream)
        assert len(past) == 3 * index + 1  # views are read one at a time
        past += [weakref.ref(output.features), weakref.ref(output.decoded.levels[1])]
        # Of what belongs to earlier steps nothing is alive, however many there were.
        assert all(reference() is None for reference in past[: 3 * index])
        assert output.after.tokens.shape == (1, 20, 32)
        assert output.after.memory.shape == (1, 8, 64)


def test_a_reset_forgets_everything(model: TTT3R) -> None:
    a, b, c = steps_of(views(3))
    fresh = streamed(model, [c])
    after_reset = streamed(model, [a, replace(b, reset=True), c])
    assert torch.allclose(after_reset[2].maps.camera_pose, fresh[0].maps.camera_pose, atol=FLOAT_NOISE)
    assert torch.allclose(after_reset[1].after.tokens, after_reset[0].before.tokens, atol=FLOAT_NOISE)
    remembered = streamed(model, [a, b, c])[2].maps.camera_pose
    assert (remembered - fresh[0].maps.camera_pose).abs().max() > 1e-3


@torch.inference_mode()
def test_periodic_resets_chain_the_cameras() -> None:
    config = replace(TINY, reset_every=2)
    images = views(3)
    heads = frozenset({Head.CAMERA})
    chained = tiny(config).predict(images, heads=heads)
    first, second = tiny().predict(images[:2], heads=heads), tiny().predict(images[1:], heads=heads)
    assert torch.allclose(chained.world_from_cam[:2], first.world_from_cam, atol=FLOAT_NOISE)
    expected = first.world_from_cam[1] @ second.world_from_cam[1]
    assert torch.allclose(chained.world_from_cam[2], expected, atol=FLOAT_NOISE)


def test_the_plan_reads_the_last_view_of_a_chunk_again() -> None:
    assert [step.view for step in plan_steps(5, 2)] == [0, 1, 1, 2, 3, 3, 4]
    assert [step.view for step in plan_steps(5, 2) if step.kept] == [0, 1, 2, 3, 4]
    assert [step.view for step in plan_steps(3, None)] == [0, 1, 2]


def test_chained_poses_multiply_over_all_resets() -> None:
    shift = torch.eye(4).repeat(4, 1, 1)
    shift[:, 0, 3] = torch.tensor([1.0, 10.0, 100.0, 1000.0])
    chained = chain_resets(shift, [True, False, True, False])
    assert chained[:, 0, 3].tolist() == [1.0, 11.0, 101.0, 1101.0]


def test_steps_without_update_or_image_leave_the_state(model: TTT3R) -> None:
    image, again = steps_of(views(2))
    rays = ray_map(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), HEIGHT, WIDTH)[None]
    outputs = streamed(model, [image, replace(again, update=False), StreamStep(rays=rays)])
    for output in outputs[1:]:
        assert torch.equal(output.after.tokens, outputs[0].after.tokens)
        assert torch.equal(output.after.memory, outputs[0].after.memory)
    both = streamed(model, [image, replace(again, rays=rays)])
    assert (both[1].maps.camera_pose - outputs[1].maps.camera_pose).abs().max() > 1e-3


def test_sizes_may_change_within_a_stream(model: TTT3R) -> None:
    steps = steps_of(views(1)) + steps_of(views(1, 48, 16))
    assert [output.features.shape[1] for output in streamed(model, steps)] == [6, 3]


def test_scenes_of_a_batch_do_not_meet(model: TTT3R) -> None:
    a, b = views(3), random_images(3, HEIGHT, WIDTH, seed=9)
    both = [StreamStep(image=torch.stack(pair) * 2 - 1) for pair in zip(a, b, strict=True)]
    together = streamed(model, both)[2].maps.camera_pose
    alone = torch.cat([streamed(model, steps_of(images))[2].maps.camera_pose for images in (a, b)])
    assert torch.allclose(together, alone, atol=FLOAT_NOISE)


def test_gradients_reach_the_first_view_through_the_rate(model: TTT3R) -> None:
    images = views(3).requires_grad_()
    prediction = model.predict(images, heads=frozenset({Head.POINTS}))
    assert prediction.points is not None
    prediction.points[2].square().mean().backward()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert (images.grad.flatten(1).abs().amax(dim=1) > 0).all()
    used = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    assert all(torch.isfinite(grad).all() for grad in used.values())
    for name in ("register_tokens.weight", "dec_blocks_state.0.cross_attn.projq.weight", "pose_retriever.mem"):
        assert used[name].abs().max() > 0
    unread = {name.split(".")[1] for name, p in model.downstream_head.named_parameters(prefix="head") if p.grad is None}
    assert unread == {"dpt_cross", "dpt_rgb", "final_transform", "dpt_self"}  # of dpt_self the unused coarsest unit
    model.zero_grad(set_to_none=True)


@pytest.mark.wrong_shapes
def test_bad_input_is_refused(model: TTT3R) -> None:
    with pytest.raises(UserError, match="there are no views"):
        model.predict(torch.zeros(0, 3, HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="must be"):
        model.predict(torch.zeros(3, HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="30 x 48 is not a multiple of 16"):
        model.predict(views(1, 30, 48))
    with pytest.raises(ValueError, match="an image, a ray map or both"):
        StreamStep()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"update": "none"}, "update must be"),
        ({"depth": 1}, "depth must be"),
        ({"reset_every": 0}, "reset_every"),
        ({"heads": 5}, "not divisible"),
    ],
)
def test_bad_configurations_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TTT3R(replace(TINY, **change))  # type: ignore[arg-type]


def test_the_released_size_has_the_published_number_of_parameters() -> None:
    with torch.device("meta"):
        released = TTT3R(TTT3RConfig.large())
    assert sum(parameter.numel() for parameter in released.parameters()) == 793_307_858
    assert len(released.state_dict()) == 1248
    # 12 names are second names of the same parameters.
    assert len(list(released.named_parameters())) == 1248 - 12


@torch.inference_mode()
def test_weights_survive_a_file_and_keep_their_second_names_shared(model: TTT3R, tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    save_file({name: value.clone() for name, value in model.state_dict().items()}, path)
    built = build_reconstructor("ttt3r", variant="tiny", weights=str(path))
    assert "CC BY-NC-SA 4.0" in built.licence
    assert "MIT" in built.licence
    assert isinstance(built.model, TTT3R)
    loaded = built.model.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in model.state_dict().items())
    assert len(list(built.model.named_parameters())) == len(loaded) - 12
    assert torch.isfinite(built.model.predict(views(2), heads=frozenset({Head.CAMERA})).camera_vector).all()


def test_weights_of_another_model_or_size_are_refused_in_one_line(model: TTT3R, tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"cam_head.token_norm.weight": torch.ones(3)}, path)
    with pytest.raises(UserError) as other_model:
        load_weights(model, path)
    line = other_model.value.line()
    assert "\n" not in line
    assert "missing (dec_blocks.0.attn.proj.bias, " in line
    assert "1 unexpected (cam_head.token_norm.weight)" in line
    smaller = tiny(replace(TINY, memory_slots=4))
    save_file({name: value.clone() for name, value in smaller.state_dict().items()}, path)
    with pytest.raises(
        UserError, match=r"1 of another shape \(pose_retriever.mem \(1, 4, 64\) instead of \(1, 8, 64\)\)"
    ):
        load_weights(model, path)


def test_the_focal_length_of_a_picture_with_outliers_is_found() -> None:
    generator = torch.Generator().manual_seed(2)
    depth = 1 + torch.rand(HEIGHT, WIDTH, generator=generator)
    u, v = torch.meshgrid(torch.arange(WIDTH) - WIDTH // 2, torch.arange(HEIGHT) - HEIGHT // 2, indexing="xy")
    points = torch.stack([u / 40.0 * depth, v / 40.0 * depth, depth], dim=-1)[None]
    assert focal_from_points(points).item() == pytest.approx(40, rel=1e-5)
    # Points of the right camera fall on the centres of their own pixels.
    pixels, _ = project_points(points.flatten(1, 2), intrinsics_from_points(points), torch.eye(4)[None])
    assert torch.allclose(pixels[0, 0], torch.tensor([0.5, 0.5]), atol=1e-3)
    spoilt = points.clone()
    spoilt[:, :4, :, :2] *= 2
    spoilt[:, 0, 0, 2] = 0
    # One row in eight is wrong by a factor of two: a plain mean would be off by several per cent.
    assert focal_from_points(spoilt).item() == pytest.approx(40, rel=0.01)


def test_camera_poses_are_world_from_cam_with_the_scalar_first() -> None:
    half = math.sqrt(0.5)
    pose = world_from_camera_pose(torch.tensor([1.0, 2.0, 3.0, half, 0.0, 0.0, half]))
    expected = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert torch.allclose(pose, expected, atol=1e-6)


def test_pictures_are_fitted_to_patches() -> None:
    assert preprocess_image(Image.new("RGB", (1000, 1000))).shape == (3, 384, 512)
    assert preprocess_image(Image.new("L", (400, 300))).shape == (3, 384, 512)
    turned = Image.new("RGB", (400, 300))
    turned.getexif()[0x0112] = 6  # the camera was held upright
    assert preprocess_image(turned).shape == (3, 512, 384)
    with pytest.raises(ValueError, match="leaves no patch"):
        preprocess_image(Image.new("RGB", (1000, 10)))
