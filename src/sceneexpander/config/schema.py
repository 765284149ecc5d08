"""The whole configuration as one type: each section is the configuration type of the room that reads it."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.warmup import WarmupConfig
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.expansion import ModelConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.generation import GeneratorConfig
from sceneexpander.inference.config import RivalsConfig
from sceneexpander.ingest import IngestConfig
from sceneexpander.optimisation.config import OptimiseConfig
from sceneexpander.optimisation.refine import RefineConfig
from sceneexpander.rendering import RenderConfig
from sceneexpander.tracking import TrackingConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectConfig:
    """Everything that can be chosen. ``threads`` are torch's; 0 leaves them at its own choice."""

    seed: int
    device: str  # "cpu", "cuda", "cuda:1"
    threads: int
    scene: IngestConfig
    generator: GeneratorConfig
    model: ModelConfig
    frontend: FrontendConfig
    warmup: WarmupConfig
    adapt: AdaptConfig
    refine: RefineConfig
    rivals: RivalsConfig
    optimise: OptimiseConfig
    render: RenderConfig
    evaluate: EvaluateConfig
    tracking: TrackingConfig

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise UserError(f"must be >= 0, is {self.seed}", where="seed")
        if self.threads < 0:
            raise UserError(f"must be >= 0, is {self.threads}", where="threads")
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise UserError(f"is {self.device!r}", where="device", fix="use cpu, cuda or cuda:N")
