"""The whole configuration as one type: each section is the configuration type of the room that reads it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.generation import ChoiceConfig, GeneratorConfig
from sceneexpander.inference.config import RivalsConfig
from sceneexpander.ingest import IngestConfig
from sceneexpander.insertion.config import CorrectionsConfig
from sceneexpander.judge.config import JudgeConfig
from sceneexpander.optimisation.config import OptimiseConfig
from sceneexpander.photometric.config import RefineConfig, WarmupConfig
from sceneexpander.ranges import Range, check_ranges
from sceneexpander.reconstruction.loaded import ModelConfig
from sceneexpander.rendering import RenderConfig
from sceneexpander.tracking import TrackingConfig
from sceneexpander.typed import shorten

_DEVICE = re.compile(r"cpu|cuda(:[0-9]{1,3})?")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectConfig:
    """Everything that can be chosen. ``threads``: of torch; 0: one for each processor that there is."""

    seed: Annotated[int, Range(0, 2**63 - 1)]
    device: str  # "cpu", "cuda", "cuda:1"
    threads: Annotated[int, Range(0, 256)]
    scene: IngestConfig
    generator: GeneratorConfig
    choose: ChoiceConfig
    model: ModelConfig
    frontend: FrontendConfig
    warmup: WarmupConfig
    adapt: AdaptConfig
    corrections: CorrectionsConfig
    refine: RefineConfig
    rivals: RivalsConfig
    optimise: OptimiseConfig
    render: RenderConfig
    evaluate: EvaluateConfig
    judge: JudgeConfig
    tracking: TrackingConfig

    def __post_init__(self) -> None:
        check_ranges(self)
        if not _DEVICE.fullmatch(self.device):
            raise UserError(f"is {shorten(self.device)!r}", where="device", fix="use cpu, cuda or cuda:N")
