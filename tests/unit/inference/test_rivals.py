"""Other reconstructors beside ours: their own resolution, the common grid, and saying why there is no result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.geometry.camera import intrinsics_from_parts, resize_intrinsics, unproject_to_world
from sceneexpander.geometry.priors import Priors
from sceneexpander.inference.config import NEEDS_CHECKPOINT, RivalConfig, RivalsConfig
from sceneexpander.inference.rivals import (
    at_stored_size,
    reconstruct_rival,
    resized_depth,
    resized_priors,
    working_size,
)
from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig
from sceneexpander.models.protocol import Prediction
from sceneexpander.models.ttt3r import TTT3R, TTT3RConfig
from tests.support.shared import shared_folder
from tests.support.tiny_model import tiny_images

HEIGHT, WIDTH = 42, 56


def pictures(count: int = 3) -> ViewSet:
    """Captured views and a generated one last; the detail pictures are twice as large."""
    records = tuple(
        ViewRecord(
            view_id=f"v{i}",
            name=f"{i}.png",
            original_height=HEIGHT,
            original_width=WIDTH,
            sha256="0" * 64,
            stored_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
            generated=i == count - 1,
            round=int(i == count - 1),
        )
        for i in range(count)
    )
    detail = tiny_images(count, 2 * HEIGHT, 2 * WIDTH)
    stored = torch.nn.functional.interpolate(detail, size=(HEIGHT, WIDTH), mode="area")
    return ViewSet(records=records, images=stored, detail_images=detail)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Freshly drawn weights of the smallest configurations."""
    folder = tmp_path_factory.mktemp("weights")
    generator = torch.Generator().manual_seed(0)
    models = {
        "omnivggt": OmniVGGT.create(OmniVGGTConfig.tiny(), generator=generator),
        "ttt3r": TTT3R.create(TTT3RConfig.tiny(), generator=generator),
    }
    for name, model in models.items():
        save_file({key: value.clone() for key, value in model.state_dict().items()}, folder / f"{name}.safetensors")
    return {name: folder / f"{name}.safetensors" for name in models}


def tiny(weights: Path, **changes: object) -> RivalConfig:
    return replace(RivalConfig(variant="tiny", weights=str(weights), long_side_px=70), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size", "long_side", "multiple", "expected"),
    [
        ((252, 336), 518, 14, (392, 518)),
        ((252, 336), 512, 16, (384, 512)),
        ((336, 252), 512, 16, (512, 384)),
        ((336, 336), 512, 16, (512, 512)),
        ((10, 336), 512, 16, (16, 512)),
    ],
)
def test_the_working_size_keeps_the_framing(
    size: tuple[int, int], long_side: int, multiple: int, expected: tuple[int, int]
) -> None:
    assert working_size(*size, long_side, multiple) == expected


def test_depth_of_a_plane_survives_another_grid_and_edges_stay_edges() -> None:
    def plane(height: int, width: int) -> torch.Tensor:
        x = (torch.arange(width) + 0.5) / width
        y = (torch.arange(height) + 0.5) / height
        return 1 / (0.4 + 0.1 * x[None] + 0.2 * y[:, None])[None]

    moved = resized_depth(plane(48, 64), 36, 50)
    inside = (slice(None), slice(1, -1), slice(1, -1))
    torch.testing.assert_close(moved[inside], plane(36, 50)[inside], rtol=1e-5, atol=0)
    step = torch.ones(1, 48, 64)
    step[..., 32:] = 3
    values = resized_depth(step, 36, 50)
    assert set((values * 1e4).round().unique().tolist()) == {1e4, 3e4}, "no depth that nobody predicted"


def test_what_was_predicted_on_another_grid_stands_in_the_same_place() -> None:
    """A wall seen by a network at 48 x 64 pixels: the same world points, seen through the stored pixels."""
    views, intrinsics = 2, torch.stack([intrinsics_from_parts(*torch.tensor([50.0, 50.0, 32.5, 24.5]))] * 2)
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[1, 0, 3] = 0.5
    prediction = Prediction(
        camera_vector=torch.zeros(views, 9),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=torch.full((views, 48, 64), 2.0),
        depth_conf=torch.full((views, 48, 64), 3.0),
    )
    views_set = pictures(views)
    stored = at_stored_size(prediction, views_set.images, views_set.generated)
    assert stored.depth is not None
    assert stored.gaussians is not None
    torch.testing.assert_close(stored.intrinsics_px, resize_intrinsics(intrinsics, WIDTH / 64, HEIGHT / 48))
    corner = unproject_to_world(stored.depth, stored.intrinsics_px, poses)[1, 0, 0]
    # The corner of the first stored pixel's centre: half a stored pixel in, that is 32/56 and 24/42 of a working pixel.
    expected = torch.tensor([(32 / 56 - 32.5) / 50 * 2 + 0.5, (24 / 42 - 24.5) / 50 * 2, 2.0])
    torch.testing.assert_close(corner, expected)
    assert len(stored.gaussians) == views * HEIGHT * WIDTH
    assert stored.gaussians.generated.reshape(views, -1).all(1).tolist() == [False, True]


def test_without_a_checkpoint_the_row_says_so() -> None:
    for method in ("omnivggt", "ttt3r"):
        made = reconstruct_rival(method, RivalConfig(), pictures(), Priors())
        assert made == Unavailable(method=method, model=method, reason=NEEDS_CHECKPOINT)


@pytest.mark.parametrize("method", ["omnivggt", "ttt3r"])
def test_with_one_there_is_a_whole_reconstruction_on_the_stored_grid(
    method: str, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    views = pictures()
    made = reconstruct_rival(method, tiny(checkpoints[method]), views, Priors())
    assert isinstance(made, Reconstruction)
    assert made.depth.shape == (3, HEIGHT, WIDTH)
    assert made.method == made.model == method
    assert made.generated.tolist() == [False, False, True]
    made.save(tmp_path)
    assert torch.equal(Reconstruction.load(tmp_path).depth, made.depth)
    row = evaluate(made, views, EvaluateConfig(), scene="room", round_number=1, seed=0)
    assert row.value("views_captured") == 2
    assert row.value("psnr_inserted_db") is not None


def test_omnivggt_is_told_what_the_front_end_knows(checkpoints: dict[str, Path]) -> None:
    views, poses = pictures(), torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 0.3, 0.9])
    intrinsics = torch.stack([intrinsics_from_parts(*torch.tensor([60.0, 60.0, WIDTH / 2, HEIGHT / 2]))] * 3)
    depth = torch.full((3, HEIGHT, WIDTH), 2.0)
    depth[:, :20] = 0  # missing
    known = Priors(world_from_cam=poses, intrinsics_px=intrinsics, depth=depth, posed=torch.tensor([True, True, False]))
    told = tiny(checkpoints["omnivggt"], priors="front_end")
    without = reconstruct_rival("omnivggt", tiny(checkpoints["omnivggt"]), views, known)
    with_priors = reconstruct_rival("omnivggt", told, views, known)
    assert isinstance(without, Reconstruction)
    assert isinstance(with_priors, Reconstruction)
    assert not torch.equal(without.depth, with_priors.depth)
    lost = replace(known, posed=torch.tensor([False, True, True]))
    refused = reconstruct_rival("omnivggt", told, views, lost)
    assert isinstance(refused, Unavailable)
    assert "first view" in refused.reason
    with pytest.raises(UserError, match=r"rivals\.omnivggt\.priors: the front-end did not run"):
        reconstruct_rival("omnivggt", told, views, Priors())


def test_resized_priors_mix_nothing_with_what_is_missing() -> None:
    depth = torch.full((1, 20, 30), 4.0)
    depth[:, :, 10:] = 0
    intrinsics = intrinsics_from_parts(*torch.tensor([30.0, 30.0, 15.0, 10.0]))[None]
    moved = resized_priors(Priors(depth=depth, intrinsics_px=intrinsics), 14, 28)
    assert moved.depth is not None
    assert moved.intrinsics_px is not None
    assert set(moved.depth.unique().tolist()) == {0.0, 4.0}
    assert moved.intrinsics_px[0, 0].tolist() == pytest.approx([28.0, 0.0, 14.0])


def test_weights_of_another_model_are_refused_in_one_line(checkpoints: dict[str, Path]) -> None:
    with pytest.raises(UserError) as caught:
        reconstruct_rival("ttt3r", tiny(checkpoints["omnivggt"]), pictures(), Priors())
    line = caught.value.line()
    assert "omnivggt.safetensors: does not fit the model" in line
    assert "missing (" in line
    assert "unexpected (aggregator." in line
    with pytest.raises(UserError, match="of another shape"):
        reconstruct_rival("omnivggt", replace(tiny(checkpoints["omnivggt"]), variant="large"), pictures(), Priors())


def test_a_setting_that_would_do_nothing_is_refused() -> None:
    with pytest.raises(UserError, match="ttt3r: reads no priors"):
        RivalsConfig(omnivggt=RivalConfig(), ttt3r=RivalConfig(priors="front_end"))


@pytest.mark.parametrize("method", ["omnivggt", "ttt3r"])
def test_recorded_weights_of_the_authors_architectures_run_through(method: str) -> None:
    """The recorded cases' own configurations and weights, where they lie beside the repository."""
    from sceneexpander.conformance import omnivggt, ttt3r
    from sceneexpander.inference.rivals import rival_reconstruction
    from sceneexpander.models.weights import load_weights

    folder = shared_folder(f"conformance/{method}/case_a")
    stored = json.loads((folder / "config.json").read_text())
    model: OmniVGGT | TTT3R
    if method == "omnivggt":
        model = OmniVGGT(omnivggt.config_from_case(stored))
    else:
        model = TTT3R(ttt3r.config_from_case(stored["model_config"], stored["runs"][0]))
    load_weights(model, folder / "weights.safetensors")
    views = pictures()
    made = rival_reconstruction(model, views, Priors(), method=method, weights_sha256="0" * 64, long_side_px=70)
    assert made.depth.shape == (3, HEIGHT, WIDTH)
    row = evaluate(made, views, EvaluateConfig(), scene="room", round_number=1, seed=0)
    assert row.method == method
