"""The embedded reconstructor: what it does without training, what its parts promise, and that the shipped weights help."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.frontend.dense import DenseConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gauge import priors_relative_to
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.models.mini import Mini
from sceneexpander.models.mini.inputs import working_size
from sceneexpander.models.mini.pairs import PairGeometry, splat_log_depth
from sceneexpander.models.mini.splats import covered_by_others
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Head, Reconstructor
from sceneexpander.models.registry import build_reconstructor
from sceneexpander.synthetic.views import make_views
from sceneexpander.training.augment import augment, mirror_sample
from sceneexpander.training.buffer import samples_folder
from sceneexpander.training.generate import (
    Conditions,
    GeneratorConfig,
    in_scale_of_base,
    input_photos,
    own_cameras_sample,
    sample_of_scene,
    training_sample,
)
from sceneexpander.training.losses import (
    confidence_loss,
    depth_loss,
    log_depth_error,
    render_loss,
    scale_loss,
)
from sceneexpander.training.measure import geometry_row
from sceneexpander.training.sample import Sample
from sceneexpander.training.scores import scene_samples
from sceneexpander.training.trainer import LossWeights, TrainConfig, Trainer
from tests.worlds.small_mini import TINY, make_model, scene


@pytest.fixture(scope="module")
def held_out() -> list[Sample]:
    """A few scenes with held-out textures and the real dense base, cameras slightly off."""
    samples = []
    for seed in (41, 42, 43):
        views = make_views(seed, views=4, height=112, width=168, split="test", supersample=1.0)
        conditions = Conditions(rotation_deg=0.05, baseline_fraction=0.005)
        samples.append(sample_of_scene(views, 3, conditions, torch.Generator().manual_seed(seed)))
    return samples


def test_a_new_model_returns_the_base_depth_exactly_and_the_prior_cameras() -> None:
    images, priors = scene(3, 56, 84)
    prediction = make_model().predict(images, priors)
    assert isinstance(make_model(), Reconstructor)
    assert prediction.depth is not None
    assert torch.equal(prediction.depth, priors.depth)
    assert torch.equal(prediction.intrinsics_px, priors.intrinsics_px)
    # The pose goes through a quaternion and back in float32.
    torch.testing.assert_close(prediction.world_from_cam, priors.world_from_cam, atol=2e-6, rtol=0)


def test_a_perturbed_model_changes_depth_and_cameras_but_not_the_world_frame() -> None:
    images, priors = scene(3, 56, 84)
    prediction = make_model(perturbed=True).predict(images, priors)
    assert prediction.depth is not None
    assert not torch.allclose(prediction.depth, priors.depth, rtol=1e-3)
    assert not torch.allclose(prediction.world_from_cam[1:], priors.world_from_cam[1:], atol=1e-4)
    torch.testing.assert_close(prediction.world_from_cam[0], torch.eye(4), atol=1e-6, rtol=0)


def test_confident_pixels_move_a_tenth_as_far_unless_the_network_says_otherwise() -> None:
    images, priors = scene(2, 56, 56)
    model = make_model()
    with torch.no_grad():
        model.network.depth_head[-1].bias[0] = 0.3  # the same residual everywhere
    depth = model.predict(images, priors, heads=frozenset({Head.DEPTH})).depth
    assert depth is not None
    moved = (depth / priors.depth).log()
    confident = priors.evidence[:, 0] > 0.5
    expected = 2 * torch.tanh(torch.tensor(0.15))
    torch.testing.assert_close(moved[~confident], expected.expand_as(moved[~confident]), atol=1e-5, rtol=0)
    torch.testing.assert_close(moved[confident], (0.1 * expected).expand_as(moved[confident]), atol=1e-5, rtol=0)
    with torch.no_grad():
        model.network.depth_head[-1].bias[2] = -100  # nothing holds them
    freed = model.predict(images, priors, heads=frozenset({Head.DEPTH})).depth
    assert freed is not None
    torch.testing.assert_close((freed / priors.depth).log(), expected.expand_as(moved), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("views", "height", "width"), [(1, 14, 28), (2, 70, 42), (4, 126, 84), (6, 42, 98)])
def test_any_number_of_views_and_any_size_of_whole_patches(views: int, height: int, width: int) -> None:
    images, priors = scene(views, height, width)
    prediction = make_model(perturbed=True).predict(images, priors)
    assert prediction.depth is not None
    assert prediction.normals is not None
    assert prediction.depth.shape == (views, height, width)
    assert (prediction.depth > 0).all()
    assert prediction.depth_conf is not None
    assert (prediction.depth_conf > 1).all()
    assert prediction.points is not None
    assert prediction.points.shape == (views, height, width, 3)
    assert prediction.gaussians is not None
    assert len(prediction.gaussians) == views * height * width
    torch.testing.assert_close(prediction.normals.norm(dim=-1), torch.ones(views, height, width))


def test_normals_face_the_camera_even_when_the_head_disagrees() -> None:
    images, priors = scene(2, 56, 84)
    model = make_model()
    with torch.no_grad():
        model.network.normals_head[-1].bias[2] = 3.0  # pushes every normal away from the camera
    prediction = model.predict(images, priors)
    assert prediction.normals is not None
    assert prediction.depth is not None
    assert prediction.points is not None
    to_points = prediction.points - prediction.world_from_cam[:, None, None, :3, 3]
    rays = torch.einsum("vji,vhwj->vhwi", prediction.world_from_cam[:, :3, :3], to_points)
    cosine = (torch.nn.functional.normalize(rays, dim=-1) * prediction.normals).sum(-1)
    assert cosine.max() < 1e-5


def test_analytic_normals_of_a_plane_are_its_normal() -> None:
    intrinsics = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])[None]
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.4, -1.0]), dim=0)
    y, x = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    rays = torch.stack([(x - 20) / 50, (y - 15) / 50, torch.ones_like(x)], -1)
    depth = (-2.0 / (rays @ normal))[None]
    found = normals_from_depth(depth, intrinsics)
    # Differences of exact points of a plane lie in it; borders use one-sided differences, equally exact.
    torch.testing.assert_close(found, normal.expand_as(found), atol=1e-4, rtol=0)


def test_points_are_the_unprojected_depth() -> None:
    images, priors = scene(2, 56, 84)
    prediction = make_model(perturbed=True).predict(images, priors)
    assert prediction.points is not None
    assert prediction.depth is not None
    pixel, depth = project_points(prediction.points.flatten(1, 2), prediction.intrinsics_px, prediction.world_from_cam)
    torch.testing.assert_close(depth, prediction.depth.flatten(1), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(pixel[0, 0], torch.tensor([0.5, 0.5]), atol=1e-3, rtol=0)


def test_heads_that_nobody_asked_for_do_not_run() -> None:
    images, priors = scene(2, 56, 56)
    model = make_model()
    called = []
    for name in ("depth_head", "normals_head", "gaussian_head"):
        model.network.get_submodule(name).register_forward_hook(lambda *_, name=name: called.append(name))
    prediction = model.predict(images, priors, heads=frozenset({Head.CAMERA}))
    assert called == []
    assert prediction.depth is None
    assert prediction.gaussians is None
    prediction = model.predict(images, priors, heads=GEOMETRY_HEADS)
    assert called == ["depth_head", "normals_head"]
    assert prediction.points is None
    assert prediction.gaussians is None
    model.predict(images, priors, heads=ALL_HEADS)
    assert called[2:] == ["depth_head", "normals_head", "gaussian_head"]


def test_every_head_sends_gradients_into_the_trunk() -> None:
    images, priors = scene(2, 56, 56)
    model = make_model(perturbed=True)
    outputs = {
        "camera": lambda p: p.camera_vector[1:].sum(),
        "depth": lambda p: p.depth.log().sum(),
        "confidence": lambda p: p.depth_conf.sum(),
        "normals": lambda p: p.normals[..., 0].sum(),
        "points": lambda p: p.points.sum(),
        "scales": lambda p: p.gaussians.scales.sum(),
        "opacities": lambda p: p.gaussians.opacities.sum(),
    }
    for name, output in outputs.items():
        model.zero_grad()
        output(model.predict(images, priors)).backward()
        weight = model.network.trunk.frame_blocks[0].attn.qkv.weight
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_training_and_evaluation_mode_agree_bit_for_bit() -> None:
    images, priors = scene(2, 56, 56)
    model = make_model(perturbed=True)
    first = model.train().predict(images, priors)
    second = model.eval().predict(images, priors)
    assert first.depth is not None
    assert second.depth is not None
    assert torch.equal(first.depth, second.depth)
    assert torch.equal(first.camera_vector, second.camera_vector)


def test_permuting_the_views_after_the_first_permutes_the_outputs() -> None:
    images, priors = scene(4, 56, 56)
    model = make_model(perturbed=True)
    order = torch.tensor([0, 3, 1, 2])
    plain = model.predict(images, priors, heads=GEOMETRY_HEADS)
    permuted = model.predict(images[order], priors.select(order), heads=GEOMETRY_HEADS)
    assert plain.depth is not None
    assert permuted.depth is not None
    # Attention sums over the views in another order.
    torch.testing.assert_close(permuted.depth, plain.depth[order], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(permuted.camera_vector, plain.camera_vector[order], rtol=1e-4, atol=1e-5)


def test_depth_scales_with_the_priors() -> None:
    images, priors = scene(3, 56, 56)
    model = make_model(perturbed=True)
    assert priors.depth is not None
    assert priors.world_from_cam is not None
    poses = priors.world_from_cam.clone()
    poses[:, :3, 3] *= 7
    larger = replace(priors, depth=priors.depth * 7, world_from_cam=poses)
    small, large = model.predict(images, priors), model.predict(images, larger)
    assert small.depth is not None
    assert large.depth is not None
    torch.testing.assert_close(large.depth, small.depth * 7, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(large.camera_vector[:, :3], small.camera_vector[:, :3] * 7, rtol=1e-3, atol=1e-4)


def test_gaussians_know_their_view_and_whether_it_was_generated() -> None:
    images, priors = scene(3, 28, 42)
    generated = torch.tensor([False, False, True])
    gaussians = make_model().predict(images, priors, generated=generated).gaussians
    assert gaussians is not None
    count = 28 * 42
    assert gaussians.source_view.tolist() == [0] * count + [1] * count + [2] * count
    assert torch.equal(gaussians.generated, generated.repeat_interleave(count))


def test_a_guess_gives_way_to_a_view_that_sees_the_place() -> None:
    poses = torch.eye(4).repeat(2, 1, 1)
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]).repeat(2, 1, 1)
    posed = torch.ones(2, dtype=torch.bool)
    confident = torch.stack([torch.zeros(40, 40), torch.ones(40, 40)])
    sure = torch.full((40, 40), 2.0)
    for guess, expected in ((1.0, 1.0), (2.0, 1.0), (3.0, 0.0)):  # in front of the surface, on it, hidden behind it
        depth = torch.stack([torch.full((40, 40), guess), sure])
        covered = covered_by_others(depth, confident, Cameras(poses, intrinsics, 40, 40), posed, most_views=4)
        assert covered[0].unique().tolist() == [expected]
        assert covered[1].unique().tolist() == [0.0]


def test_cross_view_channels_tell_front_from_behind() -> None:
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.1
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]).repeat(2, 1, 1)
    images = torch.full((2, 3, 40, 40), 0.5)
    posed = torch.ones(2, dtype=torch.bool)
    confident = torch.ones(2, 40, 40)
    log_depth = torch.log(torch.stack([torch.full((40, 40), 3.0), torch.full((40, 40), 2.0)]))
    geometry = PairGeometry(log_depth, confident, Cameras(poses, intrinsics, 40, 40), posed)
    channels = geometry.compare(images, (0, 1), most_views=4)
    behind, in_front = channels[:, 2, 20, 20], channels[:, 3, 20, 20]
    ratio = torch.log(torch.tensor(1.5))
    torch.testing.assert_close(behind, torch.stack([ratio, torch.zeros(())]), atol=1e-5, rtol=0)
    torch.testing.assert_close(in_front, torch.stack([torch.zeros(()), ratio]), atol=1e-5, rtol=0)
    posed[1] = False
    unposed = PairGeometry(log_depth, confident, Cameras(poses, intrinsics, 40, 40), posed)
    assert unposed.compare(images, (0, 1), most_views=4).abs().max() == 0


@pytest.mark.parametrize("views", [(0, 1, 3), (0, 2, 3, 4), (2, 1, 4)])
def test_what_is_measured_once_serves_every_subset(views: tuple[int, ...]) -> None:
    images, priors = scene(5, 56, 84)
    model = make_model(perturbed=True)
    measured = model.measure(priors, 5, 56, 84)
    for _ in range(2):  # the second time from what is kept
        shared = model.predict_prepared(
            model.prepare(images[list(views)], measured.select(views)), heads=GEOMETRY_HEADS
        )
        direct = model.predict(images[list(views)], priors_relative_to(priors.select(views), 0), heads=GEOMETRY_HEADS)
        for name in ("camera_vector", "depth", "depth_conf", "normals", "normals_conf"):
            torch.testing.assert_close(getattr(shared, name), getattr(direct, name), rtol=1e-4, atol=1e-5)


def test_splatted_depth_keeps_the_nearest_point() -> None:
    intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
    points = torch.tensor([[0.01, 0.01, 4.0], [0.01, 0.01, 2.0], [0.0, 0.0, -1.0]])
    found = splat_log_depth(points, Cameras(torch.eye(4)[None], intrinsics[None], 10, 10))
    assert int(found.isfinite().sum()) == 1
    assert found[5, 5].exp().item() == pytest.approx(2.0)


def test_the_working_grid_keeps_the_aspect_and_bounds_the_cost() -> None:
    assert working_size(252, 336, 192) == (144, 192)
    assert working_size(1400, 1050, 192) == (192, 144)
    assert working_size(14, 700, 192) == (32, 192)  # at least two patches


@pytest.mark.parametrize("missing", ["world_from_cam", "intrinsics_px", "depth", "evidence"])
def test_missing_priors_are_named(missing: str) -> None:
    images, priors = scene(2, 28, 28)
    with pytest.raises(ValueError, match=missing):
        make_model().predict(images, replace(priors, **{missing: None}))
    with pytest.raises(ValueError, match="front-end"):
        make_model().predict(images)


def test_sizes_that_are_no_whole_patches_are_refused() -> None:
    images, priors = scene(2, 28, 28)
    with pytest.raises(ValueError, match="multiple of 14"):
        make_model().predict(images[..., :27], priors)


def test_pixels_without_a_base_depth_get_one() -> None:
    images, priors = scene(2, 28, 28)
    assert priors.depth is not None
    depth = priors.depth.clone()
    depth[0, :14] = 0
    found = make_model().predict(images, replace(priors, depth=depth)).depth
    assert found is not None
    assert (found > 0).all()
    with pytest.raises(ValueError, match="no positive"):
        make_model().predict(images, replace(priors, depth=torch.zeros_like(depth)))


def test_weights_survive_half_precision_and_a_wrong_file_is_refused(tmp_path: Path) -> None:
    images, priors = scene(2, 56, 56)
    model = make_model(perturbed=True)
    model.save_weights(tmp_path / "mini.safetensors")
    loaded = Mini.from_weights(tmp_path / "mini.safetensors")
    assert loaded.config == TINY
    assert all(parameter.dtype == torch.float32 for parameter in loaded.parameters())
    first, second = model.predict(images, priors).depth, loaded.predict(images, priors).depth
    assert first is not None
    assert second is not None
    # Half precision keeps 11 bits of every weight.
    torch.testing.assert_close(second, first, rtol=5e-3, atol=0)
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match="no configuration"):
        Mini.from_weights(tmp_path / "other.safetensors")


@pytest.fixture(scope="module")
def larger_held_out() -> list[Sample]:
    """As `held_out`, of the smallest size that the shipped weights were trained at: smaller pictures have another base."""
    samples = []
    for seed in range(41, 47):
        views = make_views(seed, views=4, height=168, width=224, split="test", supersample=1.0)
        conditions = Conditions(rotation_deg=0.05, baseline_fraction=0.005)
        samples.append(sample_of_scene(views, 3, conditions, torch.Generator().manual_seed(seed)))
    return samples


def test_the_shipped_weights_are_small_and_better_than_the_base(larger_held_out: list[Sample]) -> None:
    model = Mini.from_weights("builtin")
    path = Path(__file__).parents[3] / "src/sceneexpander/models/mini/weights/mini.safetensors"
    assert path.stat().st_size <= 25e6
    rows = [geometry_row(model, sample) for sample in larger_held_out]
    for name in ("abs_rel", "normals_deg"):
        network, base = (sum(row[f"{who}/{name}"] for row in rows) / len(rows) for who in ("network", "base"))
        assert network <= base, (name, network, base)
    within, base_within = (sum(row[f"{who}/within"] for row in rows) / len(rows) for who in ("network", "base"))
    assert within >= base_within


def test_a_stored_sample_is_the_sample(held_out: list[Sample], tmp_path: Path) -> None:
    sample = held_out[0]
    sample.save(tmp_path / "s.safetensors")
    back = Sample.load(tmp_path / "s.safetensors")
    assert back.inputs == sample.inputs == 3
    assert len(back.images) == 4
    torch.testing.assert_close(back.images, sample.images, atol=0.5 / 255 + 1e-6, rtol=0)
    finite = sample.valid
    assert torch.equal(back.valid, finite)
    torch.testing.assert_close(back.log_depth[finite], sample.log_depth[finite], atol=2e-3, rtol=1e-3)


def test_a_mirrored_sample_is_still_true(held_out: list[Sample]) -> None:
    sample = mirror_sample(held_out[0])
    depth = torch.where(sample.valid, sample.log_depth, 0.0).exp()
    found = normals_from_depth(depth[:1], sample.intrinsics_px[:1], smoothing=0)
    inner = sample.valid[:1].clone()
    agreement = (found * sample.normals[:1]).sum(-1)[inner]
    # Differences across edges disagree with the exact normals; most pixels are not on edges.
    assert agreement.median() > 0.99
    assert sample.visible_from(1, [0]).float().mean() == pytest.approx(
        held_out[0].visible_from(1, [0]).float().mean().item(), abs=0.01
    )


def test_another_first_view_changes_only_the_frame(held_out: list[Sample]) -> None:
    sample = held_out[0]
    moved = sample.select_inputs([1, 0, 2])
    torch.testing.assert_close(moved.world_from_cam[0], torch.eye(4), atol=1e-5, rtol=0)
    relative = rigid_inverse(sample.world_from_cam[1]) @ sample.world_from_cam[0]
    torch.testing.assert_close(moved.world_from_cam[1], relative, atol=1e-5, rtol=0)
    assert torch.equal(moved.images[1], sample.images[0])


def test_truth_takes_the_scale_of_the_base(held_out: list[Sample]) -> None:
    sample = held_out[0]
    farther = replace(sample, prior_log_depth=sample.prior_log_depth + 0.7)
    scaled = in_scale_of_base(farther)
    again = in_scale_of_base(sample)
    torch.testing.assert_close(
        scaled.log_depth[sample.valid] - again.log_depth[sample.valid],
        torch.tensor(0.7).expand(int(sample.valid.sum())),
    )
    error = (scaled.prior_log_depth - scaled.log_depth[: sample.inputs])[
        sample.valid[: sample.inputs] & sample.priors_confident()
    ]
    assert float(error.median()) == pytest.approx(0.0, abs=1e-6)
    # Cameras move with the depth: a pixel of one view still falls on the same pixel of another.
    ratio = scaled.world_from_cam[1:, :3, 3] / again.world_from_cam[1:, :3, 3]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.7).exp(), rtol=1e-4, atol=0)
    torch.testing.assert_close(scaled.visible_from(0, [1]), sample.visible_from(0, [1]))


def test_own_cameras_are_those_of_the_front_end_and_truth_stays_true(held_out: list[Sample]) -> None:
    sample = held_out[0]
    photos = torch.nn.functional.interpolate(sample.input_images, scale_factor=2, mode="bilinear", antialias=True)
    own = own_cameras_sample(
        sample, photos, torch.Generator().manual_seed(0), FrontendConfig(dense=DenseConfig(threads=1))
    )
    assert own.wrong_focal
    assert torch.equal(own.images, sample.images)
    assert not torch.equal(own.prior_intrinsics_px, sample.prior_intrinsics_px)
    shift = own.log_depth - sample.log_depth
    assert float(shift[sample.valid].std()) < 1e-5, "one factor for the whole scene"
    assert torch.equal(own.prior_world_from_cam[0], torch.eye(4))


def test_photos_of_a_sample_are_its_views_drawn_larger() -> None:
    for seed in range(30):
        scene = make_views(seed, views=4, height=84, width=112)
        if scene.disconnected is not None and scene.disconnected < 2:
            break
    sample = sample_of_scene(scene, 3, Conditions(), torch.Generator().manual_seed(0))
    photos = input_photos(scene, sample, supersample=1.0)
    assert photos.shape == (3, 3, 168, 224)
    shrunk = torch.nn.functional.avg_pool2d(photos, 2)
    for view in range(3):
        difference = [float((shrunk[view] - other).abs().mean()) for other in sample.input_images]
        assert difference.index(min(difference)) == view, "in the order of the sample, the lonely view last"
        assert min(difference) < 0.05  # exposure, noise and JPEG are drawn anew


def test_a_share_of_the_training_scenes_runs_the_whole_front_end() -> None:
    config = GeneratorConfig(sizes=((112, 168),), view_shares=(0.0, 0.0, 1.0), own_cameras_share=1.0)
    own = training_sample(3, 11, config)
    simulated = training_sample(3, 11, replace(config, own_cameras_share=0.0))
    assert torch.equal(own.images, simulated.images)
    assert own.wrong_focal
    assert not torch.equal(own.prior_world_from_cam, simulated.prior_world_from_cam)


def test_the_first_view_of_an_augmented_sample_has_a_pose(held_out: list[Sample]) -> None:
    sample = replace(held_out[0], posed=torch.tensor([False, False, True]))
    for seed in range(8):
        assert bool(augment(sample, torch.Generator().manual_seed(seed)).posed[0])


def test_kept_samples_of_a_scored_scene_are_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sceneexpander.training.scores.HEIGHT", 112)
    monkeypatch.setattr("sceneexpander.training.scores.WIDTH", 168)
    first = scene_samples(5, noisy=True, front_end=False, kept=tmp_path)
    assert first.own_cameras is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["5_noisy.safetensors", "5_true.safetensors"]

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr("sceneexpander.training.scores.sample_of_scene", refuse)
    again = scene_samples(5, noisy=True, front_end=False, kept=tmp_path)
    assert torch.equal(again.true_cameras.prior_log_depth, first.true_cameras.prior_log_depth)


def test_confidence_loss_is_least_where_confidence_is_one_over_the_error() -> None:
    error = torch.full((1, 2, 2), 0.1)
    valid = torch.ones(1, 2, 2, dtype=torch.bool)
    losses = [float(confidence_loss(error, torch.full((1, 2, 2), c), valid)) for c in (5.0, 10.0, 20.0)]
    assert losses[1] < min(losses[0], losses[2])


def test_between_two_possible_depths_the_likelier_one_is_asked_for() -> None:
    valid, confident = torch.ones(1, 1, 10, dtype=torch.bool), torch.zeros(1, 1, 10)
    possible = torch.tensor([0.0] * 6 + [1.0] * 4)[None, None]  # logarithms
    losses = [float(depth_loss(guess - possible, valid, confident)) for guess in (0.0, 0.5, 1.0)]
    assert losses[0] < losses[2] < losses[1]


def test_the_scale_of_a_view_without_a_pose_counts_apart_from_its_shape(held_out: list[Sample]) -> None:
    sample = held_out[0]
    lost = replace(sample, posed=torch.arange(sample.inputs) < sample.inputs - 1)
    valid = lost.valid[: lost.inputs]
    truth = torch.where(valid, lost.log_depth[: lost.inputs], 0.0)
    scaled = truth.clone()
    scaled[-1] += 0.3
    assert float(log_depth_error(scaled, lost, valid).abs().max()) < 1e-5
    assert float(scale_loss(scaled, lost, valid)) == pytest.approx(0.3 / lost.inputs, abs=1e-4)
    assert float(scale_loss(truth, lost, valid)) == pytest.approx(0, abs=1e-6)
    assert float(scale_loss(scaled, sample, valid)) == 0


def test_render_loss_is_zero_for_equal_pictures_only() -> None:
    picture = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    assert float(render_loss(picture, picture)) == pytest.approx(0, abs=1e-6)
    assert float(render_loss(picture, picture.flip(-1))) > 0.05


def test_training_lowers_the_loss_and_resumes_exactly(held_out: list[Sample], tmp_path: Path) -> None:
    config = TrainConfig(seed=0, batch=2, warmup_steps=1, learning_rate=2e-3, weights=LossWeights())
    batch = [sample.halved() for sample in held_out[:2]]

    def trainer(folder: str) -> Trainer:
        return Trainer(config, TINY, tmp_path / folder, tmp_path / "samples")

    unbroken = trainer("a")
    losses = [sum(v for k, v in unbroken.train_step(batch).items() if k in ("depth", "normals")) for _ in range(12)]
    assert losses[-1] < losses[0]
    first = trainer("b")
    for _ in range(6):
        first.train_step(batch)
    first.save()
    second = trainer("b")
    assert second.resume()
    assert second.step == 6
    for _ in range(6):
        second.train_step(batch)
    for name, value in unbroken.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name
        assert torch.equal(unbroken.ema[name], second.ema[name]), name


def test_broken_samples_and_folders_are_named(tmp_path: Path) -> None:
    broken = tmp_path / "00000001.safetensors"
    broken.write_bytes(b"junk")
    with pytest.raises(UserError, match=r"00000001.*cannot be read as a sample"):
        Sample.load(broken)
    with pytest.raises(UserError, match=r"00000001.*no folder for samples"):
        samples_folder(broken)
    assert samples_folder(tmp_path / "new" / "one").is_dir()


def test_free_cameras_give_the_camera_heads_answer_its_full_weight() -> None:
    plain, free = (build_reconstructor("mini", variant=v, weights="builtin").model for v in ("default", "free_cameras"))
    assert isinstance(plain, Mini)
    assert isinstance(free, Mini)
    assert free.config == replace(plain.config, camera_gain=1.0)
    assert plain.config.camera_gain < 0.1
    images, priors = scene(3, 56, 84)
    for model in (plain, free):
        with torch.no_grad():
            head = model.network.camera_head.get_submodule(model.network.camera_head.names.predictor)
            head.get_submodule("fc2").bias[:3].add_(0.01)
    moved = [
        float((model.predict(images, priors).world_from_cam[1:] - priors.world_from_cam[1:]).abs().max().detach())
        for model in (plain, free)
    ]
    assert moved[1] > 10 * moved[0] > 0
