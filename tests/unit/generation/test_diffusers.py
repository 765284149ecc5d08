"""An image model on this machine: a pipeline with random weights, built and saved here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import override
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError
from sceneexpander.generation import GenerationContext, SceneSoFar, make_generator
from sceneexpander.generation.backends.diffusers import folder_identity, sampled_size
from sceneexpander.ingest.decode import decode_picture
from tests.worlds.rounds import HEIGHT, WIDTH, context_of, flat_scene, made_views

CONF = Path(__file__).parents[3] / "conf"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """InstructPix2Pix with next to no layers, as diffusers saves it."""
    # In the lock file: that it is missing must fail here, not skip.
    from diffusers import (
        AutoencoderKL,
        EulerDiscreteScheduler,
        StableDiffusionInstructPix2PixPipeline,
        UNet2DConditionModel,
    )
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    folder = tmp_path_factory.mktemp("model")
    torch.manual_seed(0)
    letters = [chr(code) for code in range(33, 127)]
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    (folder / "vocab.json").write_text(json.dumps({token: index for index, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=77)
    text = CLIPTextConfig(
        vocab_size=len(tokens), hidden_size=8, intermediate_size=8, num_hidden_layers=1, num_attention_heads=1,
        bos_token_id=0, eos_token_id=1, pad_token_id=1,
    )  # fmt: skip
    blocks = {"block_out_channels": (8, 8), "norm_num_groups": 2, "layers_per_block": 1}
    pipeline = StableDiffusionInstructPix2PixPipeline(
        vae=AutoencoderKL(
            down_block_types=["DownEncoderBlock2D"] * 2, up_block_types=["UpDecoderBlock2D"] * 2, latent_channels=4, **blocks
        ),
        text_encoder=CLIPTextModel(text),
        tokenizer=tokenizer,
        unet=UNet2DConditionModel(
            sample_size=8, in_channels=8, out_channels=4, cross_attention_dim=8, attention_head_dim=2,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
            **blocks,
        ),
        scheduler=EulerDiscreteScheduler(steps_offset=1),
        safety_checker=None, feature_extractor=None, requires_safety_checker=False,
    )  # fmt: skip
    saved = folder / "pipeline"
    pipeline.save_pretrained(saved, safe_serialization=True)
    return saved


@pytest.fixture
def context(tmp_path: Path) -> GenerationContext:
    spec = RoundSpec(prompt="turn left 10 degrees, a bench")
    images = torch.rand(3, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    detail = torch.nn.functional.interpolate(images, scale_factor=2)
    scene = Scene(name="place", views=made_views(images, detail), rounds=(spec,))
    return context_of(scene, tmp_path / "place")


@pytest.fixture
def so_far(context: GenerationContext) -> SceneSoFar:
    return flat_scene(context.captured)


def config_of(model: Path | str, *overrides: str) -> ProjectConfig:
    given = [
        "generator=diffusers", override("generator.model", str(model)), "generator.precision=float32", "generator.steps=2",
        "generator.device=cpu", "generator.reference_side_px=96",
    ]  # fmt: skip
    return parse_dataclass(ProjectConfig, compose(CONF, [*given, *overrides]))


def pixels(data: bytes) -> np.ndarray:
    return decode_picture(data, name="made", where="here").pixels


def test_the_seed_makes_the_picture(model: Path, context: GenerationContext, so_far: SceneSoFar) -> None:
    made = make_generator(config_of(model).generator).generate(context, so_far)
    first, second = (pixels(item.data) for item in made.candidates)
    assert first.shape == (64, 96, 3), "the captured ratio"
    assert not np.array_equal(first, second)
    elsewhere = replace(context, cache=context.cache.with_name("other"))
    again = make_generator(config_of(model, "generator.seed=1", "generator.candidates=1").generator)
    (repeated,) = again.generate(elsewhere, so_far).candidates
    assert np.array_equal(pixels(repeated.data), second), "seed 1 is candidate 1 of seed 0"
    record = made.candidates[1].provenance
    assert record.parameters["seed"] == "1"
    assert record.parameters["pipeline"] == "StableDiffusionInstructPix2PixPipeline"
    assert record.digital_source_type == "trainedAlgorithmicMedia"
    assert make_generator(config_of(model).generator).check(context).requests == 0, "kept, like paid answers"


def test_inpainting_starts_from_where_the_motion_leads(
    model: Path, context: GenerationContext, so_far: SceneSoFar, tmp_path: Path
) -> None:
    from diffusers import DiffusionPipeline, StableDiffusionInpaintPipeline, UNet2DConditionModel

    parts = dict(DiffusionPipeline.from_pretrained(model, use_safetensors=True).components)
    torch.manual_seed(0)
    parts["unet"] = UNet2DConditionModel.from_config({**parts["unet"].config, "in_channels": 9})
    folder = tmp_path / "inpaint"
    StableDiffusionInpaintPipeline(**parts, requires_safety_checker=False).save_pretrained(folder)
    generator = make_generator(config_of(folder, "generator.task=inpaint", "generator.candidates=1").generator)
    (made,) = generator.generate(context, so_far).candidates
    assert pixels(made.data).shape == (64, 96, 3)
    assert made.provenance.parameters["pipeline"] == "StableDiffusionInpaintPipeline"
    still = replace(context, spec=RoundSpec(prompt="a bench"))
    with pytest.raises(UserError, match="says no camera motion"):
        generator.check(still)
    edits = make_generator(config_of(model, "generator.task=inpaint").generator)
    with pytest.raises(UserError, match="InstructPix2Pix"):
        edits.generate(replace(context, cache=tmp_path / "cache"), so_far)


@pytest.mark.parametrize("name", ["unet/diffusion_pytorch_model.bin", "pipeline.py", "vae/weights.ckpt"])
def test_a_model_that_could_run_code_is_refused_before_anything_is_loaded(
    model: Path, context: GenerationContext, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "model"
    (folder / name).parent.mkdir(parents=True)
    (folder / "model_index.json").write_bytes((model / "model_index.json").read_bytes())
    (folder / name).write_bytes(b"")
    with pytest.raises(UserError, match="can run code") as caught:
        make_generator(config_of(folder).generator).check(context)
    assert name in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["+generator.arguments.sharpness=3"], "takes no sharpness"),
        (["generator.device=abacus"], "cannot be loaded"),
        (["+generator.arguments.guidance_scale=much"], "StableDiffusionInstructPix2PixPipeline: "),
    ],
)
def test_what_the_pipeline_cannot_do_is_one_line(
    model: Path, context: GenerationContext, so_far: SceneSoFar, overrides: list[str], problem: str
) -> None:
    with pytest.raises(UserError) as caught:
        make_generator(config_of(model, *overrides).generator).generate(context, so_far)
    assert problem in caught.value.problem
    assert "\n" not in str(caught.value)
    assert caught.value.fix


def test_damaged_weights_and_no_model_are_one_line(
    model: Path, context: GenerationContext, so_far: SceneSoFar, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r"no model_index\.json"):
        make_generator(config_of(tmp_path).generator).check(context)
    folder = tmp_path / "model"
    for path in model.rglob("*"):
        if path.is_file():
            copy = folder / path.relative_to(model)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes()[:100] if path.suffix == ".safetensors" else path.read_bytes())
    with pytest.raises(UserError, match="cannot be loaded"):
        make_generator(config_of(folder).generator).generate(context, so_far)
    assert folder_identity(folder) != folder_identity(model), "other weights are another question"


def test_the_sampled_size_keeps_the_ratio() -> None:
    assert sampled_size(224, 168, 1024) == (1024, 768)
    assert sampled_size(168, 224, 512) == (384, 512)
    assert Image.new("RGB", sampled_size(100, 7, 64)).size == (64, 16)
