"""OmniVGGT as a reconstructor: protocol, any subset of priors, derived outputs, files that contradict each other."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.camera import intrinsics_from_parts, unproject_to_world
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import look_at, rigid_inverse
from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig
from sceneexpander.models.omnivggt.preprocess import PreparedViews, load_views, resize_nearest, usable_depth
from sceneexpander.models.omnivggt.priors import batch_priors, encode_priors
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction, Reconstructor
from sceneexpander.models.registry import build_reconstructor
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from tests.support.tiny_omnivggt import tiny_omnivggt
from tests.support.tiny_worldmirror import random_images

VIEWS, HEIGHT, WIDTH = 3, 28, 42
SHAPE = (VIEWS, HEIGHT, WIDTH)
FLOAT_NOISE = 1e-5  # float32, values of size one, a network a few layers deep
FIELDS = ("world_from_cam", "intrinsics_px", "depth")


@pytest.fixture(scope="module")
def model() -> OmniVGGT:
    return tiny_omnivggt()


def all_priors() -> Priors:
    generator = torch.Generator().manual_seed(5)
    target, up = torch.tensor([0.0, 0.0, 5.0]), torch.tensor([0.0, -1.0, 0.0])
    poses = look_at(torch.randn(VIEWS, 3, generator=generator), target.expand(VIEWS, 3), up.expand(VIEWS, 3))
    focal, one = 30 + 5 * torch.rand(VIEWS, generator=generator), torch.ones(VIEWS)
    return Priors(
        world_from_cam=rigid_inverse(poses[:1]) @ poses,
        intrinsics_px=intrinsics_from_parts(focal, focal, one * WIDTH / 2, one * HEIGHT / 2),
        depth=1 + torch.rand(SHAPE, generator=generator),
    )


def some_priors(fields: tuple[str, ...]) -> Priors:
    full = all_priors()
    return Priors(**{name: getattr(full, name) for name in fields})


def run(model: OmniVGGT, priors: Priors | None = None) -> Prediction:
    with torch.no_grad():
        return model.predict(random_images(VIEWS), priors, heads=frozenset({Head.DEPTH}))


def difference(a: Prediction, b: Prediction) -> float:
    assert a.depth is not None
    assert b.depth is not None
    return max(float((a.depth / b.depth).log().abs().max()), float((a.camera_vector - b.camera_vector).abs().max()))


def test_it_is_a_reconstructor_and_fills_every_field(model: OmniVGGT) -> None:
    assert isinstance(model, Reconstructor)
    generated = torch.tensor([False, False, True])
    with torch.no_grad():
        out = model.predict(random_images(VIEWS), all_priors(), generated=generated)
    assert out.depth is not None and out.depth.shape == SHAPE and bool((out.depth > 0).all())  # noqa: PT018
    assert out.points is not None and out.points.shape == (*SHAPE, 3)  # noqa: PT018
    for conf in (out.depth_conf, out.points_conf, out.normals_conf):
        assert conf is not None
        assert conf.shape == SHAPE
        assert bool((conf > 1).all())
    assert out.normals is not None
    assert torch.allclose(out.normals.norm(dim=-1), torch.ones(SHAPE), atol=FLOAT_NOISE)
    points = unproject_to_world(out.depth, out.intrinsics_px, out.world_from_cam)
    in_camera = torch.einsum(
        "vji,vhwj->vhwi", out.world_from_cam[:, :3, :3], points - out.world_from_cam[:, None, None, :3, 3]
    )
    assert bool(((in_camera * out.normals).sum(-1) <= FLOAT_NOISE).all())
    assert out.gaussians is not None
    assert out.gaussian_depth is not None
    assert torch.equal(out.gaussian_depth, out.depth)
    # One Gaussian per pixel, at the pixel's own place, with the pixel's view.
    assert torch.allclose(out.gaussians.means, points.reshape(-1, 3), rtol=1e-4, atol=1e-4)
    assert torch.equal(out.gaussians.source_view, torch.arange(VIEWS).repeat_interleave(HEIGHT * WIDTH))
    assert torch.equal(out.gaussians.generated, generated.repeat_interleave(HEIGHT * WIDTH))
    assert bool(torch.isfinite(out.intrinsics_px).all())
    assert bool((out.gaussians.scales > 0).all())


@pytest.mark.parametrize(
    ("heads", "modules"),
    [
        ({Head.CAMERA}, set()),
        ({Head.NORMALS}, {"depth_head"}),
        ({Head.GAUSSIANS}, {"depth_head"}),
        ({Head.POINTS}, {"point_head"}),
        (ALL_HEADS, {"depth_head", "point_head"}),
    ],
)
def test_only_what_was_asked_for_is_run_and_returned(model: OmniVGGT, heads: set[Head], modules: set[str]) -> None:
    ran: set[str] = set()
    handles = [
        part.register_forward_pre_hook(lambda _module, _args, name=name: ran.add(name))
        for name in ("depth_head", "point_head")
        for part in model.get_submodule(name).modules()
    ]
    with torch.no_grad():
        out = model.predict(random_images(2), heads=frozenset(heads))
    for handle in handles:
        handle.remove()
    assert ran == modules
    given = {"depth": Head.DEPTH, "normals": Head.NORMALS, "points": Head.POINTS, "gaussians": Head.GAUSSIANS}
    assert {name for name in given if getattr(out, name) is not None} == {n for n, h in given.items() if h in heads}


def test_every_subset_of_priors_gives_its_own_answer(model: OmniVGGT) -> None:
    subsets = [s for n in range(1, 4) for s in itertools.combinations(FIELDS, n)]
    answers = [run(model), *(run(model, some_priors(subset)) for subset in subsets)]
    for (i, a), (j, b) in itertools.combinations(enumerate(answers), 2):
        # Equal inputs give equal bits, so anything above rounding is the prior speaking.
        assert difference(a, b) > 10 * FLOAT_NOISE, (i, j)
    assert difference(answers[0], run(model, Priors())) == 0


def test_the_network_sees_neither_scale_nor_the_choice_of_the_world(model: OmniVGGT) -> None:
    priors = all_priors()
    assert priors.world_from_cam is not None
    assert priors.depth is not None
    poses = priors.world_from_cam.clone()
    poses[:, :3, 3] *= 7
    turn = look_at(torch.tensor([3.0, 1.0, 2.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    moved = replace(priors, world_from_cam=turn @ poses, depth=4 * priors.depth)
    # Rounding of positions of size 30, through the network.
    assert difference(run(model, priors), run(model, moved)) < 1e-3


def test_views_without_a_prior_are_ignored_whatever_they_hold(model: OmniVGGT) -> None:
    priors = replace(all_priors(), posed=torch.tensor([True, True, False]))
    assert priors.world_from_cam is not None
    assert priors.depth is not None
    poses, depth = priors.world_from_cam.clone(), priors.depth.clone()
    poses[2] = torch.nan
    depth[1] = 0
    some = replace(priors, depth=depth)
    assert difference(run(model, some), run(model, replace(some, world_from_cam=poses))) == 0
    everyone = replace(some, posed=None)
    assert difference(run(model, some), run(model, everyone)) > 10 * FLOAT_NOISE
    encoded = encode_priors(batch_priors(some, random_images(VIEWS)), HEIGHT, WIDTH)
    assert encoded.camera_views == (0, 1)
    assert encoded.depth_views == (0, 2)


def test_missing_depth_is_masked_and_does_not_count_for_the_mean() -> None:
    depth = torch.full(SHAPE, 2.0)
    depth[:, :4] = 0
    depth[:, 4:6] = torch.nan
    encoded = encode_priors(batch_priors(Priors(depth=depth), random_images(VIEWS)), HEIGHT, WIDTH)
    assert encoded.depth is not None
    expected = torch.ones(1, VIEWS, 2, HEIGHT, WIDTH)
    expected[..., :6, :] = 0
    assert torch.allclose(encoded.depth, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"posed": torch.tensor([False, True, True])}, "first view"),
        ({"depth": torch.ones(VIEWS, HEIGHT, WIDTH + 1)}, r"prior depth has shape \(3, 28, 43\)"),
        ({"intrinsics_px": torch.ones(2, 3, 3)}, r"prior intrinsics_px has shape \(2, 3, 3\)"),
        ({"intrinsics_px": torch.full((VIEWS, 3, 3), torch.nan)}, "intrinsics_px of view 0 is not finite"),
    ],
)
@pytest.mark.wrong_shapes
def test_priors_that_contradict_the_images_are_named(model: OmniVGGT, change: dict[str, Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(model, replace(all_priors(), **change))


@pytest.mark.parametrize("size", [(28, 40), (30, 42), (0, 42)])
def test_sizes_that_do_not_fit_are_refused(model: OmniVGGT, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="not a multiple of 14"):
        model.predict(torch.zeros(2, 3, *size))


def test_checkpointing_changes_neither_values_nor_gradients() -> None:
    gradients = []
    for enabled in (False, True):
        model = tiny_omnivggt(checkpoint_activations=enabled)
        out = model.predict(random_images(VIEWS), some_priors(("world_from_cam", "intrinsics_px")))
        assert out.depth is not None and out.points is not None and out.gaussians is not None  # noqa: PT018
        loss = out.depth.log().sum() + out.camera_vector.sum() + out.points.clamp(-10, 10).sum()
        (loss + out.gaussians.scales.log().sum()).backward()
        gradients.append({name: p.grad for name, p in model.named_parameters()})
    plain, recomputed = gradients
    idle = {name for name, gradient in plain.items() if gradient is None}
    # For a prior that was not given, and detached before use (the camera head's first token).
    embed = "aggregator.depth_patch_embed.proj"
    assert idle == {f"{embed}.weight", f"{embed}.bias", "camera_head.empty_pose_tokens"}
    for name, gradient in plain.items():
        if gradient is not None:
            # The recomputation runs the same kernels on the same numbers.
            assert torch.equal(gradient, recomputed[name]), name


def test_a_fresh_model_depends_on_its_generator_alone_and_ignores_cameras() -> None:
    a, b = (OmniVGGT.create(OmniVGGTConfig.tiny(), generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert all(torch.equal(value, b.state_dict()[name]) for name, value in a.state_dict().items())
    cameras = some_priors(("world_from_cam", "intrinsics_px"))
    assert difference(run(a), run(a, cameras)) == 0


def test_weights_of_another_model_are_refused_naming_the_first_tensors(tmp_path: Path) -> None:
    other = WorldMirror.create(WorldMirrorConfig.tiny(), generator=torch.Generator().manual_seed(0))
    path = tmp_path / "other.safetensors"
    save_file(other.state_dict(), path)
    with pytest.raises(UserError) as error:
        build_reconstructor("omnivggt", variant="tiny", weights=str(path))
    line = error.value.line()
    assert "\n" not in line
    assert str(path) in line
    assert "aggregator.camera_adapters.0.bias" in line
    assert "cam_head." in line


def test_the_registry_builds_it_with_its_licence(tmp_path: Path) -> None:
    source = OmniVGGT.create(OmniVGGTConfig.tiny(), generator=torch.Generator().manual_seed(0))
    path = tmp_path / "tiny.safetensors"
    save_file(source.state_dict(), path)
    built = build_reconstructor("omnivggt", variant="tiny", weights=str(path))
    assert isinstance(built.model, OmniVGGT)
    assert built.licence.startswith("code MIT")
    assert difference(run(source), run(built.model)) == 0


# --- files ---


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images of 80 x 60, cameras of the first two, depth of the last."""
    for name in ("images", "cameras", "depths"):
        (tmp_path / name).mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (VIEWS, 60, 80, 3), dtype=np.uint8)
    for view in range(VIEWS):
        Image.fromarray(pixels[view]).save(tmp_path / "images" / f"{view}.png")
    for view in range(2):
        write_camera(tmp_path / "cameras" / f"{view}.txt", shift=view)
    np.save(tmp_path / "depths" / "2.npy", np.full((30, 40), 2.0, dtype=np.float32))
    return tmp_path


def write_camera(path: Path, *, shift: float = 0.0, numbers: int = 21, centre: float = 40.0, mirror: int = 1) -> None:
    pose = f"{mirror} 0 0 {shift}\n0 1 0 0\n0 0 1 0\n"
    path.write_text(" ".join((pose + f"70 0 {centre}\n0 70 30\n0 0 1\n").split()[:numbers]))


def load(folder: Path) -> PreparedViews:
    files = sorted((folder / "images").iterdir())
    return load_views(files, cameras=folder / "cameras", depths=folder / "depths", target=42)


def test_files_are_matched_by_their_stems(folder: Path) -> None:
    prepared = load(folder)
    priors = prepared.priors
    assert priors.camera_views == (0, 1)
    assert priors.depth_views == (2,)
    assert priors.intrinsics_px is not None
    # 80 x 60 becomes 42 x 28: 31.5 rows round to two patches.
    assert torch.allclose(priors.intrinsics_px[0, 0, 0], torch.tensor([70 * 42 / 80, 0, 21.0]))
    assert torch.allclose(priors.intrinsics_px[0, 0, 1], torch.tensor([0, 70 * 28 / 60, 14.0]))
    with torch.no_grad():
        batch = tiny_omnivggt()(prepared.images[None], priors)
    assert batch.depth.shape == (1, *SHAPE)


def spoil_image_size(folder: Path) -> None:
    Image.new("RGB", (60, 80)).save(folder / "images" / "1.png")
    (folder / "cameras" / "1.txt").unlink()


@pytest.mark.parametrize(
    ("spoil", "file", "words"),
    [
        (lambda f: write_camera(f / "cameras/7.txt"), "cameras/7.txt", "belongs to no image"),
        (lambda f: write_camera(f / "cameras/1.txt", numbers=20), "cameras/1.txt", "20 numbers"),
        (lambda f: write_camera(f / "cameras/1.txt", centre=320), "cameras/1.txt", "outside the 80 x 60 image"),
        (lambda f: write_camera(f / "cameras/1.txt", mirror=-1), "cameras/1.txt", "not a rotation"),
        (lambda f: (f / "cameras/1.txt").write_text("pose"), "cameras/1.txt", "cannot be read as a camera"),
        (lambda f: (f / "cameras/0.txt").unlink(), "images/0.png", "no camera while other views"),
        (
            lambda f: np.save(f / "depths/2.npy", np.ones((40, 30))),
            "depths/2.npy",
            "30 x 40 while its image is 80 x 60",
        ),
        (
            lambda f: np.save(f / "depths/2.npy", np.ones((3, 30, 40))),
            "depths/2.npy",
            r"no depth map (shape (3, 30, 40))",
        ),
        (lambda f: (f / "depths/2.npy").write_bytes(b"x"), "depths/2.npy", "cannot be read as a depth map"),
        (lambda f: (f / "images/2.png").write_bytes(b"x"), "images/2.png", "cannot be read as an image"),
        (spoil_image_size, "images/1.png", "while 0.png becomes 42 x 28"),
    ],
)
def test_files_that_contradict_each_other_are_named(
    folder: Path, spoil: Callable[[Path], object], file: str, words: str
) -> None:
    spoil(folder)
    with pytest.raises(UserError) as error:
        load(folder)
    line = error.value.line()
    assert line.startswith(f"{folder / file}: ")
    assert words in line
    assert "\n" not in line


def test_depth_outside_its_range_is_missing() -> None:
    depth = np.array([[1.0, np.nan, np.inf, 101.0, 1e-6, -2.0, 99.0]])
    assert usable_depth(depth).tolist() == [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 99.0]]


def test_nearest_resize_aligns_corners() -> None:
    row = np.arange(4, dtype=np.float32)[None]
    assert resize_nearest(row, 1, 6).tolist() == [[0.0, 0.0, 1.0, 2.0, 2.0, 3.0]]
    assert resize_nearest(row, 2, 2).tolist() == [[0.0, 2.0]] * 2


def test_nearest_resize_takes_the_pixels_that_the_official_loader_takes() -> None:
    """The rule in integers and IEEE doubles: the factor is rounded, then its inverse, then the product with the index."""
    sizes = [*range(14, 600, 9), 194, 202, 518, 1008]
    for target in (14, 70, 98, 392, 518):
        for size in sizes:
            expected = [min(int(index * (1.0 / (target / size))), size - 1) for index in range(target)]
            ramp = np.arange(size, dtype=np.float32)
            assert resize_nearest(ramp[None], 1, target)[0].tolist() == expected, (size, target)
            assert resize_nearest(ramp[:, None], target, 1)[:, 0].tolist() == expected, (size, target)


def test_nearest_resize_keeps_the_rounding_of_the_official_loader() -> None:
    ramp = np.arange(202, dtype=np.float32)[None]
    # 49 * 202 / 98 is 101 exactly; by way of the rounded factor it is a little less.
    assert resize_nearest(ramp, 1, 98)[0, 49] == 100.0
