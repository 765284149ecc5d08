"""The scene so far, seen from elsewhere."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.candidates import CandidateSet
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.source_type import MADE_FROM_SCENE, read_source_type
from sceneexpander.errors import UserError
from sceneexpander.generation import ChoiceConfig, SceneSoFar, choose_view
from sceneexpander.generation.backends.reproject import ReprojectConfig, ReprojectGenerator, fill_unseen
from sceneexpander.ingest import decode_picture
from sceneexpander.ingest.load import image_tensor
from tests.worlds.rounds import HEIGHT, WIDTH, context_of, flat_scene, made_views


@pytest.fixture
def so_far() -> SceneSoFar:
    coarse = torch.rand(3, 3, 4, 6, generator=torch.Generator().manual_seed(0))
    images = [
        torch.nn.functional.interpolate(coarse, (s * HEIGHT, s * WIDTH), mode="bicubic").clamp(0, 1) for s in (1, 2)
    ]
    return flat_scene(made_views(*images), apart=0.0)


def generated(
    so_far: SceneSoFar, motion: str, folder: Path, *, start: str = "central", prompt: str = "x"
) -> CandidateSet:
    scene = Scene(name="s", views=so_far.views, rounds=(RoundSpec(prompt=prompt, motion=motion),))
    generator = ReprojectGenerator(ReprojectConfig(start=start))
    context = context_of(scene, folder / "scene")
    generator.check(context)
    return generator.generate(context, so_far)


def pixels(made: CandidateSet) -> torch.Tensor:
    return image_tensor(decode_picture(made.candidates[0].data, name="x", where="x").pixels)


def mean_difference(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).abs().mean())


def test_a_motion_shows_what_a_camera_there_would_see(so_far: SceneSoFar, tmp_path: Path) -> None:
    """The wall is 2 away and as wide as the picture: half a picture to the right is 1, half as far is twice as large."""
    photo = so_far.views.detail_images[0]
    height, width = photo.shape[-2:]
    sideways = pixels(generated(so_far, "move right 25 %", tmp_path))
    assert sideways.shape == photo.shape
    shift = width // 4
    seen = slice(4, width - shift - 4)
    assert mean_difference(sideways[:, :, seen], photo[:, :, shift:][:, :, seen]) < 0.03
    assert mean_difference(sideways[:, :, seen], photo[:, :, : width - shift][:, :, seen]) > 0.1, "not as it was"
    nearer = pixels(generated(so_far, "move forward 50 %", tmp_path))
    middle = photo[:, height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
    enlarged = torch.nn.functional.interpolate(middle[None], (height, width), mode="bicubic")[0]
    assert mean_difference(nearer, enlarged) < 0.03


def test_what_nobody_saw_is_continued_and_said(so_far: SceneSoFar, tmp_path: Path) -> None:
    made = generated(so_far, "move back 100 %", tmp_path)
    provenance = made.candidates[0].provenance
    assert float(provenance.parameters["filled"]) == pytest.approx(0.75, abs=0.03)
    picture = pixels(made)
    assert float(picture.amax(0).min()) > 0.05, "no hole is left black"
    assert provenance.parameters["motion"] == "move back 100 %"
    assert provenance.digital_source_type == MADE_FROM_SCENE
    again = generated(so_far, "move back 100 %", tmp_path)
    assert again.candidates[0].data == made.candidates[0].data, "the same bits every time"
    with Image.open(io.BytesIO(made.candidates[0].data)) as file:
        packet = file.info["XML:com.adobe.xmp"]
    assert read_source_type(packet if isinstance(packet, str) else packet.decode()) == MADE_FROM_SCENE


def test_a_candidate_becomes_the_inserted_view(so_far: SceneSoFar, tmp_path: Path) -> None:
    scene = Scene(name="s", views=so_far.views, rounds=(RoundSpec(prompt="move back"),))
    context = context_of(scene, tmp_path / "scene")
    made = ReprojectGenerator(ReprojectConfig()).generate(context, so_far)
    made.save(tmp_path / "candidates")
    loaded = CandidateSet.load(tmp_path / "candidates")
    assert loaded == made
    inserted = choose_view(context, loaded.candidates, so_far, ChoiceConfig(), seed=0).inserted
    assert inserted.view.images.shape == so_far.views.images[:1].shape
    assert inserted.view.detail_images.shape == so_far.views.detail_images[:1].shape
    assert inserted.provenance[0].parameters["kept"] == "1.0000"
    (tmp_path / "candidates" / "pictures" / "000.png").write_bytes(b"another picture")
    with pytest.raises(UserError, match="is not the picture that was made"):
        CandidateSet.load(tmp_path / "candidates")


def test_filling_keeps_what_is_seen_and_continues_it_smoothly() -> None:
    colours = torch.rand(3, 1, 1, generator=torch.Generator().manual_seed(1)).expand(3, 37, 53)
    alpha = torch.zeros(37, 53)
    alpha[10:20, 15:30] = 1
    filled = fill_unseen(colours * alpha, alpha)
    assert torch.allclose(filled, colours, atol=1e-5), "one colour goes on as that colour"
    ramp = torch.linspace(0, 1, 53).expand(3, 37, 53)
    alpha = torch.ones(37, 53)
    alpha[:, 20:30] = 0
    filled = fill_unseen(ramp * alpha, alpha)
    assert torch.equal(filled[:, alpha > 0], ramp[:, alpha > 0])
    assert float((filled - ramp).abs().max()) < 0.1


def test_metres_are_those_of_known_cameras(so_far: SceneSoFar, tmp_path: Path) -> None:
    """The photos' cameras are 0.2 apart in the scene and 0.4 m in the world: a metre is half a unit."""
    apart = flat_scene(so_far.views, apart=0.2)
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.arange(3) * 0.4
    known = KnownCameras(world_from_cam=poses, metric=True)
    metric = SceneSoFar(views=apart.views, reconstruction=apart.reconstruction, known=known)
    made = generated(metric, "move back 1 m", tmp_path)
    share = generated(metric, "move back 25 %", tmp_path)
    assert (
        made.candidates[0].provenance.parameters["world_from_cam"]
        == share.candidates[0].provenance.parameters["world_from_cam"]
    )
    with pytest.raises(UserError, match="in metres, which these photos do not tell"):
        generated(apart, "move back 1 m", tmp_path)


def test_the_start_can_be_chosen(so_far: SceneSoFar, tmp_path: Path) -> None:
    apart = flat_scene(so_far.views, apart=0.2)
    for start, expected in (("central", "1.png"), ("2.png", "2.png")):
        made = generated(apart, "move back", tmp_path, start=start)
        assert made.candidates[0].provenance.parameters["start"] == expected
    with pytest.raises(UserError, match=r"there is no photo '3.png'; did you mean '.\.png'\?"):
        generated(apart, "move back", tmp_path, start="3.png")


def test_refusals(so_far: SceneSoFar, tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match="says no camera motion, which is all that reproject goes by; say one with --motion"
    ):
        generated(so_far, "", tmp_path, prompt="Behind the table is a bench.")
    with pytest.raises(UserError, match="leads to where the photos show only 0% of the picture; move or turn less"):
        generated(so_far, "turn around", tmp_path)


def test_it_says_that_it_invents_no_object(so_far: SceneSoFar, tmp_path: Path) -> None:
    scene = Scene(
        name="s", views=so_far.views, rounds=(RoundSpec(prompt="Move back, a bench."), RoundSpec(prompt="Move back"))
    )
    generator = ReprojectGenerator(ReprojectConfig())
    (note,) = generator.check(context_of(scene, tmp_path / "s", 1)).warnings
    assert "invents no object: 'a bench' will not be in the picture" in note
    assert generator.check(context_of(scene, tmp_path / "s", 2)).warnings == ()
