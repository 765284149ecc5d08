"""An image model on this machine, run by the ``diffusers`` library: one that edits a view, or one that fills what the scene leaves open.

Weights are read from safetensors files alone, and no code that comes with a model is run: a folder with either is refused.
"""

from __future__ import annotations

import importlib.util
import inspect
import io
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.candidates import CandidateSet
from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.errors import UserError
from sceneexpander.generation.backends.reproject import fill_unseen, motion_of, seen_from_motion
from sceneexpander.generation.config import ServiceConfig
from sceneexpander.generation.protocol import Forecast, GenerationContext, SceneSoFar
from sceneexpander.generation.service import Question, Reply, ServiceGenerator, plain_settings
from sceneexpander.generation.start import CENTRAL
from sceneexpander.ranges import Range, check_ranges
from sceneexpander.services.transport import ServiceError

Task = Literal["edit", "inpaint"]
Precision = Literal["float32", "float16", "bfloat16"]
TASKS: tuple[Task, ...] = ("edit", "inpaint")
PRECISIONS: tuple[Precision, ...] = ("float32", "float16", "bfloat16")
_UNSAFE = (".bin", ".ckpt", ".pt", ".pth", ".pkl", ".pickle", ".msgpack", ".h5", ".py")
_WANTED = ("*.json", "*.safetensors", "*.txt", "*.model")  # of a hub's repository: nothing that is run when it is read
_OPEN = 0.5  # of what covers a pixel: below it, the model fills it
_EDGE_BYTES = 2**20
_ROUND_PX = 16  # what the sides of a latent picture have to be divisible by
logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffusersConfig(ServiceConfig):
    """Settings of ``diffusers``.

    Attributes:
        model: folder of a pipeline, or its name on Hugging Face's hub.
        revision: of a model on the hub; null: the newest.
        task: ``edit``: the nearest view and the words; ``inpaint``: the scene so far from where the motion leads, what it does not
            show filled in by the words.
        seed: of the first candidate; the next ones count up.
        steps: of the sampler.
        device: as torch calls it; null: cuda if there is one.
        precision: of the weights.
        arguments: further ones of the pipeline, e.g. guidance_scale.
    """

    backend: str = "diffusers"
    model: str
    revision: str | None
    task: Task
    seed: Annotated[int, Range(0, 2**53)]
    steps: Annotated[int, Range(1, 1000)]
    device: str | None
    precision: Precision
    arguments: Mapping[str, str | int | float | bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ServiceConfig.__post_init__(self)
        check_ranges(self)
        for name, value, known in (("task", self.task, TASKS), ("precision", self.precision, PRECISIONS)):
            if value not in known:
                raise UserError(f"is {value!r}", where=f"generator.{name}", fix=f"use one of: {', '.join(known)}")


def make_diffusers(config: DiffusersConfig) -> DiffusersGenerator:
    """The generator with these settings."""
    return DiffusersGenerator(config)


@dataclass(frozen=True, slots=True)
class DiffusersGenerator:
    """A `ViewGenerator`: what all services share, and the canvas that ``inpaint`` starts from."""

    config: DiffusersConfig

    def check(self, context: GenerationContext) -> Forecast:
        """Look for packages and the model; nothing is loaded. See `ViewGenerator`."""
        if self.config.task == "inpaint":
            motion_of(context, "which inpainting starts from")
        return ServiceGenerator(self.config, DiffusersService(self.config)).check(context)

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """One picture per candidate that is not in the cache; see `ViewGenerator`."""
        service = DiffusersService(self.config)
        if self.config.task == "inpaint":
            rgb, alpha, _, _ = seen_from_motion(context, so_far, CENTRAL)
            service.canvas = fill_unseen(rgb, alpha), (alpha < _OPEN).float()
        return ServiceGenerator(self.config, service).generate(context, so_far)


@dataclass(slots=True)
class DiffusersService:
    """See `Service`. ``canvas``: (picture, 1 where it is to be filled) that ``inpaint`` starts from."""

    config: DiffusersConfig
    canvas: tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"]] | None = None
    _pipeline: Any = None

    def require(self) -> None:
        """The packages, and a folder that holds a pipeline."""
        for package in ("diffusers", "transformers"):
            if importlib.util.find_spec(package) is None:
                fix = "pip install 'sceneexpander[diffusers]'"
                raise UserError(
                    f"needs the package {package}, which is not installed", where="generator diffusers", fix=fix
                )
        folder = self._local()
        if folder is not None:
            check_folder(folder)

    def identity(self) -> Mapping[str, object]:
        """Model and all that its picture depends on."""
        names = ("model", "revision", "task", "seed", "steps", "precision", "arguments")
        folder = self._local()
        weights = "" if folder is None or not folder.is_dir() else folder_identity(folder)
        return plain_settings(self.config, *names) | {"weights": weights}

    def secrets(self) -> tuple[str, ...]:
        """None."""
        return ()

    def ask(self, question: Question) -> Reply:
        """Run the pipeline once."""
        config = self.config
        pipeline, device = self._loaded()
        accepted = set(inspect.signature(pipeline.__call__).parameters)
        seed = config.seed + question.number
        width, height = sampled_size(question.width, question.height, config.reference_side_px)
        arguments: dict[str, Any] = {
            "prompt": question.prompt,
            "num_inference_steps": config.steps,
            "generator": torch.Generator("cpu").manual_seed(seed),
        }
        if self.canvas is None:
            shown = [Image.open(io.BytesIO(item.png)).convert("RGB") for item in question.references]
            pictures = [picture.resize((width, height), Image.Resampling.LANCZOS) for picture in shown]
            arguments["image"] = pictures[0] if len(pictures) == 1 else pictures
        else:
            picture, mask = self.canvas
            arguments["image"] = Image.fromarray(to_uint8(picture)).resize((width, height), Image.Resampling.LANCZOS)
            flat = Image.fromarray((mask.numpy() * 255).astype(np.uint8))
            arguments["mask_image"] = flat.resize((width, height), Image.Resampling.NEAREST)
        arguments |= {name: value for name, value in (("width", width), ("height", height)) if name in accepted}
        missing = (set(arguments) | set(config.arguments)) - accepted
        if missing:
            problem = f"{type(pipeline).__name__} takes no {', '.join(sorted(missing))}"
            fix = f"use a model made to {config.task} pictures, and arguments that its pipeline has"
            raise ServiceError("failed_final", problem, fix=fix)
        try:
            made = pipeline(**arguments, **config.arguments)
        except torch.OutOfMemoryError:
            fix = "lower generator.reference_side_px, set generator.precision=bfloat16, or generator.device=cpu"
            raise ServiceError("failed_final", f"{device} has too little memory for it", fix=fix) from None
        except (RuntimeError, ValueError, TypeError) as error:
            raise ServiceError("failed_final", f"{type(pipeline).__name__}: {error}", fix=_LOOK) from None
        flagged = getattr(made, "nsfw_content_detected", None)
        if flagged and flagged[0]:
            raise ServiceError("refused", "the model's safety checker withheld the picture")
        buffer = io.BytesIO()
        made.images[0].save(buffer, format="PNG")
        parameters = {
            "seed": str(seed),
            "steps": str(config.steps),
            "task": config.task,
            "pipeline": type(pipeline).__name__,
            "revision": config.revision or "",
            "precision": config.precision,
            "device": device,
        } | {name: str(value) for name, value in config.arguments.items()}
        return Reply(data=buffer.getvalue(), model=Path(config.model).name, parameters=parameters)

    def _local(self) -> Path | None:
        """The model's folder, if that is what is named: a path that exists, or that cannot be a hub's ``owner/name``."""
        path = Path(self.config.model).expanduser()
        named = self.config.model.count("/") == 1 and not self.config.model.startswith((".", "/", "~"))
        return None if named and not path.exists() else path

    def _loaded(self) -> tuple[Any, str]:
        """(the pipeline, its device), loaded at the first call. Raises `ServiceError`."""
        config = self.config
        device = config.device or ("cuda" if torch.cuda.is_available() else "cpu")
        if self._pipeline is not None:
            return self._pipeline, device
        folder = self._local()
        try:
            if folder is None:
                from huggingface_hub import snapshot_download

                name, wanted = config.model, list(_WANTED)
                folder = Path(snapshot_download(name, revision=config.revision, allow_patterns=wanted))
            check_folder(folder)
            from diffusers import AutoPipelineForInpainting, DiffusionPipeline

            library: Any = DiffusionPipeline  # untyped
            pipeline = library.from_pretrained(
                str(folder),
                dtype=getattr(torch, config.precision),
                use_safetensors=True,
                trust_remote_code=False,
                local_files_only=True,
            )
            takes_mask = "mask_image" in inspect.signature(pipeline.__call__).parameters
            if config.task == "inpaint" and not takes_mask:
                pipeline = AutoPipelineForInpainting.from_pipe(pipeline)
            pipeline.to(device)
        except UserError as error:
            raise ServiceError("failed_final", f"{error.where}: {error.problem}", fix=error.fix or "") from None
        except torch.OutOfMemoryError:
            fix = "set generator.precision=bfloat16, or generator.device=cpu"
            raise ServiceError("failed_final", f"{device} has too little memory for the model", fix=fix) from None
        except Exception as error:  # noqa: BLE001 - libraries that read foreign files fail in their own ways
            problem = f"{config.model} cannot be loaded: {type(error).__name__}: {error}"
            raise ServiceError("failed_final", problem, fix=_LOOK) from None
        pipeline.set_progress_bar_config(disable=True)
        self._pipeline = pipeline
        return pipeline, device


_LOOK = "check generator.model, generator.revision, generator.device and the network, or try the model with diffusers itself"


def check_folder(folder: Path) -> None:
    """Raise `UserError` unless a folder holds a pipeline in files that run no code when they are read."""
    where = str(folder)
    if not (folder / "model_index.json").is_file():
        fix = "give the folder of a pipeline as diffusers saves it (save_pretrained), or owner/name on the hub"
        raise UserError("is no model of diffusers: it has no model_index.json", where=where, fix=fix)
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in _UNSAFE:
            problem = f"holds {path.relative_to(folder)}, which can run code when it is read"
            fix = "save the model with safe_serialization=True in a folder of its own, and remove that file"
            raise UserError(problem, where=where, fix=fix)


def folder_identity(folder: Path) -> str:
    """A digest that changes with a model: names and sizes of all files, small ones whole, large ones by their ends."""
    parts = []
    for path in sorted(item for item in folder.rglob("*") if item.is_file()):
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_EDGE_BYTES)
            file.seek(max(0, size - _EDGE_BYTES))
            parts.append(f"{path.relative_to(folder)} {size} {sha256_of_bytes(head + file.read(_EDGE_BYTES))}")
    return sha256_of_bytes("\n".join(parts).encode())


def sampled_size(width: int, height: int, long_side_px: int) -> tuple[int, int]:
    """(width, height) of the captured ratio with the given long side, as latent models want them."""
    scale = long_side_px / max(width, height)
    across, down = (max(_ROUND_PX, round(side * scale / _ROUND_PX) * _ROUND_PX) for side in (width, height))
    return across, down
