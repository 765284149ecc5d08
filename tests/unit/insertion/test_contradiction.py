"""Agreement of a view's depth with captured depth maps, on a plane that both see."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.adaptation.pixel_weights import inserted_weights
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.agreement import Agreement, agreement
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.insertion.contradiction import LOST, fade_contradicted, pixel_trust
from sceneexpander.models.protocol import Prediction
from tests.worlds.two_views import HEIGHT, INTRINSICS, WIDTH, photo_and_generated


def setup(factor: float, shift: float = 0.0) -> tuple[torch.Tensor, ...]:
    """A captured view of a plane at depth 2; another view ``shift`` to the side that takes it to be at 2 x factor."""
    captured = torch.full((1, HEIGHT, WIDTH), 2.0)
    pose = torch.eye(4)
    pose[0, 3] = shift
    depth = torch.full((HEIGHT, WIDTH), 2.0 * factor)
    return depth, pose, INTRINSICS, captured, torch.eye(4)[None], INTRINSICS[None]


def compared(factor: float, shift: float = 0.0) -> Agreement:
    depth, pose, intrinsics, captured, captured_pose, captured_intrinsics = setup(factor, shift)
    points = unproject_to_world(depth[None], intrinsics[None], pose[None])[0]
    return agreement(points, captured, Cameras(captured_pose, captured_intrinsics, HEIGHT, WIDTH))


def test_the_same_surface_is_trusted() -> None:
    found = compared(1.0)
    assert bool(found.seen.all())
    assert torch.allclose(found.weight, torch.ones(HEIGHT, WIDTH))


def test_a_surface_in_free_space_is_not() -> None:
    found = compared(0.8)
    assert bool(found.seen[8:24, 10:30].all())
    assert float(found.weight[8:24, 10:30].max()) < 0.01
    assert float(found.conflict[16, 20]) < -0.2


def test_what_is_hidden_or_out_of_frame_is_not_contradicted() -> None:
    assert not bool(compared(1.5).seen.any())  # behind the plane
    found = compared(1.0, shift=1.0)
    outside = torch.arange(WIDTH) + 0.5 + 40 * 1.0 / 2.0 > WIDTH
    assert not bool(found.seen[:, outside].any())
    assert bool(found.seen[:, ~outside].all())
    assert bool((found.weight[:, outside] == 1).all())


def test_weights_have_mean_one_and_follow_confidence() -> None:
    depth, pose, intrinsics, captured, captured_pose, captured_intrinsics = setup(1.0)
    confidence = torch.full((2, HEIGHT, WIDTH), 1.25)
    confidence[1, :, 20:] = 10.0
    prediction = Prediction(
        camera_vector=torch.zeros(2, 9),
        world_from_cam=torch.stack([captured_pose[0], pose]),
        intrinsics_px=torch.stack([captured_intrinsics[0], intrinsics]),
        depth=torch.stack([captured[0], depth]),
        depth_conf=confidence,
    )
    weights = inserted_weights(prediction, captured)
    assert weights.shape == (1, HEIGHT, WIDTH)
    assert torch.isclose(weights.mean(), torch.tensor(1.0))
    assert torch.isclose(weights[0, 0, -1] / weights[0, 0, 0], torch.tensor(0.9 / 0.2))


def scene_of_two(factor: float, colour: float) -> tuple[Reconstruction, torch.Tensor]:
    """A captured view of a grey plane, and a generated one from the same camera that has it elsewhere or in another colour."""
    images = torch.full((2, 3, HEIGHT, WIDTH), 0.5)
    images[1] = colour
    depth = torch.full((2, HEIGHT, WIDTH), 2.0)
    depth[1] *= factor
    normals = torch.zeros(2, HEIGHT, WIDTH, 3)
    normals[..., 2] = -1
    return photo_and_generated(images, depth, torch.eye(4).repeat(2, 1, 1), normals=normals), images


def kept(factor: float, colour: float) -> torch.Tensor:
    """Share of its opacity that each generated Gaussian keeps, as a picture."""
    before, images = scene_of_two(factor, colour)
    after = fade_contradicted(before, images)
    captured = ~before.gaussians.generated
    assert torch.equal(after.gaussians.opacities[captured], before.gaussians.opacities[captured])
    return (after.gaussians.opacities / before.gaussians.opacities)[~captured].view(HEIGHT, WIDTH)[4:-4, 4:-4]


def test_what_agrees_with_the_photos_keeps_its_opacity() -> None:
    assert float(kept(1.0, 0.5).min()) > 0.99


def test_what_stands_where_a_photo_looks_through_fades() -> None:
    assert float(kept(0.7, 0.5).max()) < 0.1


def test_what_has_another_colour_than_the_photo_fades() -> None:
    assert float(kept(1.0, 0.9).max()) < 0.1


def test_what_no_photo_sees_stays() -> None:
    assert float(kept(1.6, 0.9).min()) == 1.0


def test_a_generated_view_without_a_camera_is_faint_wherever_it_stands() -> None:
    for factor, colour in ((1.0, 0.5), (0.7, 0.9), (1.6, 0.9)):
        before, images = scene_of_two(factor, colour)
        after = fade_contradicted(replace(before, posed=torch.tensor([True, False])), images)
        made, opacities = before.gaussians.generated, before.gaussians.opacities
        assert torch.equal(after.gaussians.opacities[made], LOST * opacities[made])
        assert torch.equal(after.gaussians.opacities[~made], opacities[~made])


def test_a_photo_without_a_camera_contradicts_nothing() -> None:
    before, images = scene_of_two(0.7, 0.9)
    lost = replace(before, posed=torch.tensor([False, True]))
    assert fade_contradicted(lost, images) is lost
    assert bool((pixel_trust(lost, images) == 1).all())


def test_without_generated_views_nothing_changes() -> None:
    made, images = scene_of_two(1.0, 0.5)
    alone = replace(
        made,
        generated=torch.zeros(2, dtype=torch.bool),
        gaussians=made.gaussians.select(made.gaussians.source_view == 0),
    )
    assert fade_contradicted(alone, images) is alone


def believed(factor: float, colour: float) -> torch.Tensor:
    """Trust in each pixel of the generated picture."""
    made, images = scene_of_two(factor, colour)
    trust = pixel_trust(made, images)
    assert bool((trust[0] == 1).all())
    return trust[1, 4:-4, 4:-4]


def test_pixels_are_believed_where_photos_agree_or_do_not_look() -> None:
    assert float(believed(1.0, 0.5).min()) > 0.99
    assert float(believed(1.6, 0.9).min()) == 1.0
    assert float(believed(0.7, 0.5).max()) < 0.1
    assert float(believed(1.0, 0.9).max()) < 0.1
