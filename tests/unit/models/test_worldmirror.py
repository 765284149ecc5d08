"""WorldMirror as a reconstructor: protocol, priors, heads that do not run, checkpointing, gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.camera import intrinsics_from_parts
from sceneexpander.geometry.gaussians import GaussianCounts
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import look_at
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Head, Prediction, Reconstructor
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from sceneexpander.models.worldmirror.config import GaussianConfig
from sceneexpander.models.worldmirror.model import BatchPriors
from sceneexpander.models.worldmirror.novel_view import predict_novel_views
from sceneexpander.models.worldmirror.priors import normalised_depth, pose_vector
from tests.support.tiny_worldmirror import TINY, random_images, tiny_worldmirror

FLOAT_NOISE = 1e-5  # float32, values of size one, a network a few layers deep


@pytest.fixture(scope="module")
def model() -> WorldMirror:
    return tiny_worldmirror()


def some_priors(views: int = 3, height: int = 28, width: int = 42) -> Priors:
    generator = torch.Generator().manual_seed(5)
    eye = torch.randn(views, 3, generator=generator)
    pose = look_at(eye, torch.tensor([0.0, 0.0, 5.0]).expand(views, 3), torch.tensor([0.0, -1.0, 0.0]).expand(views, 3))
    focal = 30 + 5 * torch.rand(views, generator=generator)
    half = torch.ones(views)
    return Priors(
        world_from_cam=pose,
        intrinsics_px=intrinsics_from_parts(focal, focal, half * width / 2, half * height / 2),
        depth=1 + torch.rand(views, height, width, generator=generator),
    )


def same(a: Prediction, b: Prediction, atol: float = 0.0) -> bool:
    pairs = [(a.depth, b.depth), (a.normals, b.normals), (a.camera_vector, b.camera_vector), (a.points, b.points)]
    return all(torch.allclose(x, y, atol=atol, rtol=0) for x, y in pairs if x is not None and y is not None)


def test_it_is_a_reconstructor_and_fills_every_field(model: WorldMirror) -> None:
    assert isinstance(model, Reconstructor)
    prediction = model.predict(random_images(3))
    assert prediction.depth is not None
    assert prediction.depth.shape == (3, 28, 42)
    assert (prediction.depth > 0).all()
    assert prediction.depth_conf is not None
    assert (prediction.depth_conf > 1).all()
    assert prediction.normals is not None
    assert prediction.normals.shape == (3, 28, 42, 3)
    assert torch.allclose(prediction.normals.norm(dim=-1), torch.ones(3, 28, 42), atol=FLOAT_NOISE)
    assert prediction.points is not None
    assert prediction.points.shape == (3, 28, 42, 3)
    assert prediction.gaussians is not None
    assert prediction.gaussians.sh.shape == (len(prediction.gaussians), 1, 3)
    assert prediction.gaussian_depth is not None
    assert prediction.gaussian_depth.shape == (3, 28, 42)
    # world_from_cam is the inverse of the predicted cam_from_world.
    assert torch.allclose(
        prediction.world_from_cam[:, :3, 3].norm(dim=-1), prediction.camera_vector[:, :3].norm(dim=-1), atol=1e-4
    )


@pytest.mark.parametrize("heads", [frozenset({Head.CAMERA}), GEOMETRY_HEADS, frozenset({Head.GAUSSIANS}), ALL_HEADS])
def test_heads_that_nobody_asked_for_do_not_run(model: WorldMirror, heads: frozenset[Head]) -> None:
    modules = {"depth_head": Head.DEPTH, "pts_head": Head.POINTS, "norm_head": Head.NORMALS}
    modules |= {"gs_head": Head.GAUSSIANS, "gs_renderer": Head.GAUSSIANS}
    ran: set[str] = set()
    handles = [
        part.register_forward_pre_hook(lambda _module, _args, name=name: ran.add(name))
        for name in modules
        for part in model.get_submodule(name).modules()
    ]
    prediction = model.predict(random_images(2), heads=heads)
    for handle in handles:
        handle.remove()
    assert ran == {name for name, head in modules.items() if head in heads}
    assert (prediction.depth is None) == (Head.DEPTH not in heads)
    assert (prediction.normals is None) == (Head.NORMALS not in heads)
    assert (prediction.points is None) == (Head.POINTS not in heads)
    assert (prediction.gaussians is None) == (Head.GAUSSIANS not in heads)


@pytest.mark.parametrize("field", ["world_from_cam", "intrinsics_px", "depth"])
def test_each_prior_takes_effect_and_none_is_none(model: WorldMirror, field: str) -> None:
    images, full = random_images(3), some_priors()
    without = model.predict(images, heads=GEOMETRY_HEADS)
    alone = replace(Priors(), **{field: getattr(full, field)})
    with_prior = model.predict(images, alone, heads=GEOMETRY_HEADS)
    assert not same(without, with_prior, atol=1e-3)
    assert same(without, model.predict(images, Priors(), heads=GEOMETRY_HEADS))


def test_a_prior_of_one_view_is_felt_by_the_others(model: WorldMirror) -> None:
    images, priors = random_images(3), some_priors()
    changed = priors.intrinsics_px.clone()
    changed[2, 0, 0] *= 2
    a = model.predict(images, priors, heads=GEOMETRY_HEADS)
    b = model.predict(images, replace(priors, intrinsics_px=changed), heads=GEOMETRY_HEADS)
    # Equal inputs give equal bits here, so anything above rounding is the other view speaking.
    assert (a.depth[0] - b.depth[0]).abs().max() > FLOAT_NOISE


def test_pose_prior_of_an_unposed_view_is_ignored_whatever_it_says(model: WorldMirror) -> None:
    images, priors = random_images(3), some_priors()
    posed = torch.tensor([True, True, False])
    garbage = priors.world_from_cam.clone()
    garbage[2, :3, 3] = 1e4
    a = model.predict(images, replace(priors, posed=posed), heads=GEOMETRY_HEADS)
    b = model.predict(images, replace(priors, posed=posed, world_from_cam=garbage), heads=GEOMETRY_HEADS)
    assert same(a, b)
    assert not same(
        a, model.predict(images, replace(priors, posed=torch.tensor([True, True, True])), heads=GEOMETRY_HEADS), 1e-4
    )


def test_priors_are_ignored_without_prior_prompting() -> None:
    plain = tiny_worldmirror(config=replace(TINY, prior_prompting=False))
    images = random_images(2)
    assert same(plain.predict(images), plain.predict(images, some_priors(2)))


def test_priors_of_the_caller_are_not_written_to(model: WorldMirror) -> None:
    priors = some_priors()
    priors.world_from_cam[0, 0, 3] = torch.nan
    before = priors.world_from_cam.clone()
    model.predict(random_images(3), priors, heads=GEOMETRY_HEADS)
    assert torch.equal(priors.world_from_cam, before) or torch.isnan(priors.world_from_cam[0, 0, 3])


def test_pose_vector_does_not_depend_on_scale_or_origin_of_the_world() -> None:
    pose = some_priors().world_from_cam[None]
    moved = pose.clone()
    moved[..., :3, 3] = 7 * pose[..., :3, 3] + 3
    assert torch.allclose(pose_vector(pose), pose_vector(moved), atol=FLOAT_NOISE)
    assert torch.allclose(pose_vector(pose[:, :1])[0, 0, :3], torch.full((3,), 0.5))


def test_pose_extent_of_many_views_ignores_an_outlier() -> None:
    pose = torch.eye(4).repeat(1, 24, 1, 1)
    pose[0, :, 0, 3] = torch.arange(24.0)
    far = pose.clone()
    far[0, -1, 0, 3] = 1e4
    assert torch.allclose(pose_vector(pose)[0, :23, 0], pose_vector(far)[0, :23, 0], atol=0.05)


def test_depth_prior_does_not_depend_on_scale_and_keeps_missing_at_zero() -> None:
    depth = some_priors().depth[None].clone()
    depth[..., :5, :5] = 0
    unit = normalised_depth(depth, 28, 42)
    assert torch.allclose(unit, normalised_depth(9 * depth, 28, 42), atol=FLOAT_NOISE)
    assert (unit[..., :5, :5] == 0).all()
    assert 0.9 < unit.max() <= 1


def test_checkpointing_changes_neither_values_nor_gradients() -> None:
    gradients = []
    for enabled in (False, True):
        model = tiny_worldmirror(checkpoint_activations=enabled)
        prediction = model.predict(random_images(2), some_priors(2))
        loss = prediction.depth.sum() + prediction.normals.sum() + prediction.camera_vector.sum()
        loss = loss + prediction.gaussians.means.sum() + prediction.points.clamp(-10, 10).sum()
        loss.backward()
        gradients.append({name: p.grad for name, p in model.named_parameters()})
    assert {n for n, g in gradients[0].items() if g is None} == {n for n, g in gradients[1].items() if g is None}
    for name, gradient in gradients[0].items():
        if gradient is not None:
            # The recomputation runs the same kernels on the same numbers.
            assert torch.equal(gradient, gradients[1][name]), name


def test_train_and_eval_give_the_same_numbers(model: WorldMirror) -> None:
    images = random_images(2)
    a = model.train().predict(images)
    b = model.eval().predict(images)
    assert same(a, b)


def test_geometry_losses_reach_every_trunk_and_head_parameter() -> None:
    model = tiny_worldmirror()
    prediction = model.predict(random_images(3), some_priors(), heads=GEOMETRY_HEADS)
    loss = prediction.camera_vector.square().sum()
    loss = loss + prediction.depth.log().square().sum() + prediction.depth_conf.log().sum()
    loss = (
        loss
        + (prediction.normals * torch.rand(prediction.normals.shape, generator=torch.Generator().manual_seed(0))).sum()
    )
    (loss + prediction.normals_conf.log().sum()).backward()
    idle = {name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())}
    not_asked = ("pts_head.", "gs_head.", "gs_renderer.")
    # Never used by the model (mask token), or detached before use (the camera head's first token).
    expected = {"visual_geometry_transformer.patch_embed.mask_token", "cam_head.init_token"}
    assert {name for name in idle if not name.startswith(not_asked)} == expected


def test_gaussian_positions_do_not_move_the_cameras() -> None:
    model = tiny_worldmirror()
    model.predict(random_images(2), heads=frozenset({Head.GAUSSIANS})).gaussians.means.sum().backward()
    assert all(p.grad is None for p in model.cam_head.parameters())
    assert model.gs_head.norm.weight.grad.abs().max() > 0


def test_batch_elements_do_not_see_each_other(model: WorldMirror) -> None:
    a, b = random_images(2, seed=1), random_images(2, seed=2)
    together = model(torch.stack([a, b]))
    for index, images in enumerate((a, b)):
        alone = model(images[None])
        assert torch.allclose(together.depth[index], alone.depth[0], rtol=1e-4)
        assert torch.allclose(together.gaussians.pixels.means[index], alone.gaussians.pixels.means[0], atol=1e-3)


def test_one_view_and_other_sizes_work(model: WorldMirror) -> None:
    assert model.predict(random_images(1, 14, 56)).depth.shape == (1, 14, 56)


def test_only_the_first_view_is_special(model: WorldMirror) -> None:
    images = random_images(3)
    order = torch.tensor([0, 2, 1])
    a, b = model.predict(images), model.predict(images[order])
    assert torch.allclose(a.depth[order], b.depth, rtol=1e-3)
    swapped = model.predict(images[torch.tensor([1, 0, 2])])
    assert not torch.allclose(a.depth[0], swapped.depth[1], rtol=1e-3)


@pytest.mark.wrong_shapes
def test_sizes_that_do_not_fit_are_refused(model: WorldMirror) -> None:
    with pytest.raises(ValueError, match="30 x 42 is not a multiple of 14"):
        model.predict(random_images(1, 30, 42))
    with pytest.raises(ValueError, match=r"must be \(view, 3, height, width\)"):
        model.predict(torch.zeros(3, 28, 42))


def test_generated_views_are_marked_on_their_gaussians() -> None:
    model = tiny_worldmirror(config=replace(TINY, gaussian=GaussianConfig(hidden=8, merge=False)))
    gaussians = model.predict(random_images(3), generated=torch.tensor([False, False, True])).gaussians
    assert len(gaussians) == 3 * 28 * 42
    assert torch.equal(gaussians.generated, gaussians.source_view == 2)


def test_confidence_filter_keeps_the_surest_share() -> None:
    config = replace(TINY, gaussian=GaussianConfig(hidden=8, merge=False, confidence_filter=True))
    model = tiny_worldmirror(config=config)
    output = model(random_images(2)[None]).gaussians
    kept = len(output.merged[0])
    assert kept == 1647  # ceil(0.7 * 2 * 28 * 42)
    by_view = torch.bincount(output.merged[0].source_view, minlength=2)
    threshold = output.conf.flatten().sort(descending=True).values[kept - 1]
    assert by_view.tolist() == (output.conf[0] >= threshold).flatten(1).sum(1).tolist()


def test_every_gaussian_that_is_gone_is_counted() -> None:
    # Voxels as wide as the scene: what the filter leaves falls into a handful of them.
    config = replace(TINY, gaussian=GaussianConfig(hidden=8, voxel_size=0.5, confidence_filter=True))
    prediction = tiny_worldmirror(config=config).predict(random_images(2))
    counts = prediction.gaussian_counts
    assert counts is not None
    assert (counts.made, counts.filtered) == (2 * 28 * 42, 2 * 28 * 42 - 1647)
    assert counts.kept == len(prediction.gaussians) < 1647
    assert counts.merged == 1647 - counts.kept
    assert counts.line() == (
        f"2352 Gaussians made, 705 left out by the confidence filter, {counts.merged} merged into others of the same voxel, "
        f"{counts.kept} kept"
    )
    with pytest.raises(ValueError, match=r"10 Gaussians cannot be 1 \+ 2 \+ 3"):
        GaussianCounts(made=10, filtered=1, merged=2, kept=3)


def test_novel_view_protocol_builds_gaussians_from_the_context_alone(model: WorldMirror) -> None:
    images = random_images(3)[None]
    is_target = torch.tensor([[False, False, True]])
    changed = images.clone()
    changed[:, 2] = 1 - changed[:, 2]
    a, b = predict_novel_views(model, images, is_target), predict_novel_views(model, changed, is_target)
    assert torch.equal(a.context.pixels.means, b.context.pixels.means)
    assert not torch.allclose(a.prediction.cameras.vector, b.prediction.cameras.vector, atol=1e-4)
    assert a.cameras.world_from_cam.shape == (1, 3, 4, 4)
    with pytest.raises(ValueError, match="context views must come first"):
        predict_novel_views(model, images, torch.tensor([[True, False, False]]))


def test_creation_depends_on_the_generator_alone() -> None:
    torch.manual_seed(1)
    a = tiny_worldmirror(3).state_dict()
    state = torch.get_rng_state()
    b = tiny_worldmirror(3).state_dict()
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert any(not torch.equal(a[name], value) for name, value in tiny_worldmirror(4).state_dict().items())


def test_a_batch_of_priors_may_be_partial(model: WorldMirror) -> None:
    images = random_images(3)[None]
    depth_only = BatchPriors(depth=some_priors(3, 50, 31).depth[None])
    assert model(images, depth_only, heads=GEOMETRY_HEADS).depth.shape == (1, 3, 28, 42)


def test_bad_configurations_are_refused() -> None:
    with pytest.raises(ValueError, match="do not match the dense heads' levels"):
        WorldMirrorConfig(collect=(4, 11, 17))
    with pytest.raises(ValueError, match="camera head cannot be left out"):
        WorldMirrorConfig(heads=frozenset({Head.DEPTH}))
    with pytest.raises(ValueError, match="not a multiple of the patch"):
        WorldMirrorConfig(image_size=500)
