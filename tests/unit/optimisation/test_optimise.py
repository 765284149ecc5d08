"""The whole optimisation on a made scene: it gets better, repeats bit for bit, and goes on where it was stopped."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.views import AtStoredSize, measure_views
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.gaussians import ROWS
from sceneexpander.optimisation.checkpoint import OptimisationCheckpoint
from sceneexpander.optimisation.config import DensityConfig, OptimiseConfig, RatesConfig
from sceneexpander.optimisation.optimise import _run_key, optimise, photometric_loss, scene_extent, unusable
from tests.worlds.spoiled import TRUTH, VIEWS, spoiled
from tests.worlds.wall import own_pictures

SHORT = OptimiseConfig(
    steps=12, sh_degree=1, checkpoint_every=4, density=DensityConfig(start=0.0, stop=1.0, every=3, gradient=1e-6)
)


def psnr(reconstruction: Reconstruction, views: ViewSet = VIEWS) -> float:
    rows = measure_views(reconstruction, views, EvaluateConfig(), [AtStoredSize()], generated=False)
    return sum(row.values["psnr_captured_db"] for row in rows) / len(rows)


def run(config: OptimiseConfig, start: Reconstruction | None = None, **more: object) -> Reconstruction:
    arguments = {"method": "gaussian_splatting", "seed": 0, **more}
    return optimise(start or spoiled(), VIEWS.images, config, **arguments).reconstruction  # type: ignore[arg-type]


def assert_same(a: Reconstruction, b: Reconstruction) -> None:
    for name in ROWS:
        assert torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)), name
    assert torch.equal(a.world_from_cam, b.world_from_cam)
    assert torch.equal(a.depth, b.depth)


def test_pixels_that_do_not_show_the_place_teach_nothing() -> None:
    misleading, valid = VIEWS.images.clone(), torch.ones(TRUTH.depth.shape, dtype=torch.bool)
    height = misleading.shape[2] // 2
    misleading[:, :, :height], valid[:, : height + 6] = 0.0, False
    density = DensityConfig(start=0.0, every=20, max_gaussians=4500)
    config = OptimiseConfig(steps=60, sh_degree=0, density=density, rates=RatesConfig(colours=0.02))
    results = []
    for mask in (valid, None):
        found = optimise(spoiled(), misleading, config, method="gaussian_splatting", seed=0, valid=mask).reconstruction
        shown = own_pictures(found).images
        # What a bar hides keeps its colours unless the bar is believed to be there.
        results.append(float(shown[:, :, : height - 8].mean()))
    assert results[0] > results[1] + 0.05


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_it_gets_much_better(strategy: str) -> None:
    density = DensityConfig(strategy=strategy, start=0.0, every=20, max_gaussians=4500)  # type: ignore[arg-type]
    config = OptimiseConfig(steps=150, sh_degree=0, density=density, rates=RatesConfig(colours=2e-2))
    result = run(config)
    assert psnr(spoiled()) < 17
    assert psnr(result) > 26
    assert len(TRUTH.gaussians) < len(result.gaussians) <= 4500
    assert result.method == "gaussian_splatting"
    assert result.view_ids == TRUTH.view_ids
    assert float(((result.depth - TRUTH.depth).abs() / TRUTH.depth).median()) < 0.02


def test_children_keep_the_origin_of_their_parents() -> None:
    result = run(replace(SHORT, density=replace(SHORT.density, max_gaussians=10_000))).gaussians
    assert len(result) > len(TRUTH.gaussians)
    assert torch.equal(result.generated, TRUTH.generated[result.source_view])
    assert set(result.source_view.tolist()) == {0, 1, 2}


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_same_seed_gives_the_same_bits_and_another_does_not(strategy: str) -> None:
    config = replace(SHORT, density=replace(SHORT.density, strategy=strategy), start_gaussians=2000)  # type: ignore[arg-type]
    first, again, other = run(config), run(config), run(config, seed=1)
    assert_same(first, again)
    assert not torch.equal(first.gaussians.means[:100], other.gaussians.means[:100])


def test_the_number_of_threads_does_not_matter() -> None:
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(run(replace(SHORT, steps=4)))
    finally:
        torch.set_num_threads(threads)
    assert_same(*results)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_stopped_and_resumed_gives_the_bits_of_an_unbroken_run(strategy: str, tmp_path: Path) -> None:
    density = replace(SHORT.density, strategy=strategy)  # type: ignore[arg-type]
    config = replace(SHORT, density=density, rates=RatesConfig(poses=1e-3))
    whole = run(config)

    class Stopped(Exception):
        pass

    def stop(step: int, loss: float) -> None:
        if step == 10:
            raise Stopped

    with pytest.raises(Stopped):
        run(config, checkpoint_folder=tmp_path / "points", on_step=stop)
    steps: list[int] = []
    resumed = run(config, checkpoint_folder=tmp_path / "points", on_step=lambda step, loss: steps.append(step))
    assert steps == list(range(9, 13)), "goes on after the resume point of step 8"
    assert_same(whole, resumed)


def test_a_resume_point_of_another_run_is_not_taken(tmp_path: Path) -> None:
    run(SHORT, checkpoint_folder=tmp_path / "points")
    assert (tmp_path / "points").is_dir()
    steps: list[int] = []
    other = replace(SHORT, ssim_weight=0.1)
    run(other, checkpoint_folder=tmp_path / "points", on_step=lambda step, loss: steps.append(step))
    assert steps[0] == 1
    (tmp_path / "points" / "artifact.json").write_text("{")
    assert OptimisationCheckpoint.load(tmp_path / "points", "any") is None


def test_cameras_stay_unless_they_may_move_and_then_they_move_the_right_way() -> None:
    # Uneven, or the drawing order of what lies in one plane would depend on the last bit of the camera.
    bumps = 0.2 * torch.randn(len(TRUTH.gaussians), generator=torch.Generator().manual_seed(1))
    means = TRUTH.gaussians.means + torch.stack([0 * bumps, 0 * bumps, bumps], -1)
    world = replace(TRUTH, gaussians=replace(TRUTH.gaussians, means=means))
    pictures = own_pictures(world).images
    turned = world.world_from_cam.clone()
    angle = torch.tensor(0.02)
    turn = torch.eye(4)
    turn[0, 0] = turn[2, 2] = angle.cos()
    turn[0, 2], turn[2, 0] = angle.sin(), -angle.sin()
    turned[1] = turned[1] @ turn
    start = replace(world, world_from_cam=turned)

    def error(reconstruction: Reconstruction) -> float:
        """In pixels."""
        poses = (reconstruction.world_from_cam[1], world.world_from_cam[1])
        a, b = (project_points(means[1200:2300], world.intrinsics_px[1], pose)[0] for pose in poses)
        return float((a - b).norm(dim=-1).mean())

    fixed = dict.fromkeys(("means", "means_final", "scales", "rotations", "opacities", "colours"), 1e-09)
    still = OptimiseConfig(steps=90, sh_degree=0, rates=RatesConfig(**fixed), density=DensityConfig(every=1000))
    free = replace(still, rates=RatesConfig(poses=1e-3, **fixed))
    results = [optimise(start, pictures, config, method="m", seed=0).reconstruction for config in (still, free)]
    assert torch.equal(results[0].world_from_cam[0], turned[0])
    torch.testing.assert_close(results[0].world_from_cam, turned)
    assert error(results[0]) > 0.8
    assert error(results[1]) < 0.3 * error(results[0])
    torch.testing.assert_close(results[1].world_from_cam[0], turned[0])


def test_a_view_without_a_camera_has_no_say() -> None:
    unposed = replace(spoiled(), posed=torch.tensor([True, True, False]))
    noise = VIEWS.images.clone()
    noise[2] = torch.rand(noise[2].shape, generator=torch.Generator().manual_seed(5))
    results = [
        optimise(unposed, images, SHORT, method="m", seed=0).reconstruction.gaussians.means
        for images in (VIEWS.images, noise)
    ]
    assert torch.equal(*results)
    assert unusable(unposed) is None
    alone = replace(unposed, posed=torch.tensor([True, False, False]))
    assert unusable(alone) == "needs 2 views with known cameras"
    with pytest.raises(ValueError, match="needs 2 views"):
        optimise(alone, noise, SHORT, method="m", seed=0)
    with pytest.raises(ValueError, match="do not fit"):
        optimise(unposed, noise[..., 1:], SHORT, method="m", seed=0)


def test_the_extent_is_that_of_the_known_cameras() -> None:
    assert scene_extent(TRUTH) == pytest.approx(1.1 * (2.2 - 2.5 / 3), rel=1e-5)
    near = replace(TRUTH, posed=torch.tensor([True, True, False]))
    assert scene_extent(near) == pytest.approx(0.3, rel=1e-5), "a tenth of the depth"


def test_the_loss_is_nothing_for_the_picture_itself_and_its_gradient_is_right() -> None:
    image = VIEWS.images[0]
    assert float(photometric_loss(image, image, 0.2)) == pytest.approx(0, abs=1e-6)
    small = image[:, :14, :15].double()

    def loss(picture: Tensor) -> Tensor:
        return photometric_loss(picture, small.flip(-1), 0.7)

    assert torch.autograd.gradcheck(loss, (small.clone().requires_grad_(),), eps=1e-6, atol=1e-5)


def test_the_key_of_resume_points_covers_every_tensor() -> None:
    start = spoiled()

    def others(owner: object) -> list[dict[str, Tensor]]:
        """Another value for each tensor of ``owner``, one at a time."""
        values = {f.name: getattr(owner, f.name) for f in fields(owner)}  # type: ignore[arg-type]
        tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
        return [{name: ~v if v.dtype == torch.bool else v * 2 + 1} for name, v in tensors.items()]

    variants = [start, *(replace(start, **other) for other in others(start))]
    variants += [replace(start, gaussians=replace(start.gaussians, **other)) for other in others(start.gaussians)]
    keys = {_run_key(variant, VIEWS.images, None, None, OptimiseConfig(), 0) for variant in variants}
    keys |= {_run_key(start, VIEWS.images / 2, None, None, OptimiseConfig(), 0)}
    keys |= {_run_key(start, VIEWS.images, None, start.depth > 0, OptimiseConfig(), 0)}
    keys |= {_run_key(start, VIEWS.images, [*VIEWS.images], None, OptimiseConfig(), 0)}
    keys |= {_run_key(start, VIEWS.images, None, None, OptimiseConfig(steps=7), 0)}
    keys |= {_run_key(start, VIEWS.images, None, None, OptimiseConfig(), 1)}
    assert len(keys) == len(variants) + 5
    assert _run_key(spoiled(), VIEWS.images.clone(), None, None, OptimiseConfig(), 0) in keys
