"""Every choice of the adaptation, with the paper's symbol, value and what it leaves open."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from sceneexpander.ranges import LearningRate, Range, Share, Steps, Weight, check_ranges


class DepthDistance(StrEnum):
    """d_D of Eq. (anchor): the paper names both."""

    L1 = "l1"
    SCALE_INVARIANT = "scale_invariant"


class DriftForm(StrEnum):
    """L_reg: sum or mean over all adapted weights of (theta - theta_0)^2. They differ by the number of weights."""

    SUM = "sum"
    MEAN = "mean"


class Gauge(StrEnum):
    """The first view given to the model defines the world frame.

    ``keep_first`` never drops it from a subset. ``realign`` may, and then re-expresses the anchors (frame and scale) in the new
    first view's frame.
    """

    KEEP_FIRST = "keep_first"
    REALIGN = "realign"


class SubsetRule(StrEnum):
    """Which captured views a step sees: ``paper`` draws n-1, n-2 or n-3 of them, ``all`` takes every one."""

    PAPER = "paper"
    ALL = "all"


class InsertedWeights(StrEnum):
    """How much each pixel of the inserted view counts in Eq. (gen): all alike (the paper), or by agreement and confidence."""

    UNIFORM = "uniform"
    CONSISTENT = "consistent"


class Spend(StrEnum):
    """When the steps of Algorithm 1 are run: always (the paper), or only where they have something to repair.

    ``where_moved``: where the unadapted model gives the captured views another depth beside the inserted view than without it, see
    `sceneexpander.insertion.acceptance.captured_moved`.
    """

    ALWAYS = "always"
    WHERE_MOVED = "where_moved"


class Precision(StrEnum):
    """Precision of forward passes; weights, EMA and optimiser state are always float32."""

    FP32 = "fp32"
    BF16 = "bf16"


class MomentsForm(StrEnum):
    """How AdamW's moments are kept: 8 bytes per weight, or 2 (see `sceneexpander.adaptation.moments`)."""

    FP32 = "fp32"
    INT8 = "int8"


class Trainable(StrEnum):
    """Which weights adapt: all, as in the paper; the heads alone; or low-rank changes of the trunk's linear layers (LoRA)."""

    ALL = "all"
    HEADS = "heads"
    LORA = "lora"


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineConfig:
    """How the steps are computed, not what: memory against time. Only ``moments: int8`` changes results beyond rounding."""

    checkpoint_activations: bool = False  # recompute activations in the backward pass
    # views that a dense head works on at once; 0: the model's own choice
    views_per_chunk: Annotated[int, Range(0, 1000)] = 0
    compile: bool = False  # torch.compile of the transformer blocks; the first steps are slow
    start_on_host: bool = False  # keep theta_0 in host memory; of use on a GPU
    moments: MomentsForm = MomentsForm.FP32

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateauConfig:
    """Stop early once the loss no longer falls: see `sceneexpander.adaptation.plateau`."""

    window: Steps = 0  # steps that are averaged; 0: never stop early
    tolerance: Annotated[float, Range(0, 1, high_open=True)] = 0.02  # least relative fall from one window to the next

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Geometry-perturbation augmentation of captured views. Magnitudes are ours: the paper only says "weak"."""

    identity: Share = 0.25  # probabilities of the four modes, per view; they must sum to 1
    global_affine: Share = 0.25
    blockwise: Share = 0.25
    global_and_block: Share = 0.25
    rotation_deg: Annotated[float, Range(0, 180)] = 3.0  # uniform in +- this
    translation: Share = 0.03  # share of the image size
    scale: Annotated[float, Range(0, 2)] = 0.03  # log-scale, +- this
    shear_deg: Annotated[float, Range(0, 60)] = 2.0
    grid: Annotated[int, Range(1, 64)] = 3  # blocks per side
    block_strength: Annotated[float, Range(0, 10)] = 0.5  # block magnitudes relative to the global ones
    feather: Annotated[float, Range(0, 0.5)] = 1 / 6  # blending width as a share of a block's side

    def __post_init__(self) -> None:
        check_ranges(self)
        total = self.identity + self.global_affine + self.blockwise + self.global_and_block
        if abs(total - 1) > 1e-6:
            raise ValueError(f"the four mode probabilities must sum to 1, they sum to {total}")

    @property
    def enabled(self) -> bool:
        """Whether any view is ever changed."""
        return self.identity < 1


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptConfig:
    """Algorithm 1. Defaults are the paper's values where it gives them (T, p, lr, alpha, beta, lambda, r)."""

    steps: Steps = 400  # T
    learning_rate: LearningRate = 1e-5
    weight_decay: Annotated[float, Range(0, 10)] = 0.01  # AdamW's own default; the paper does not state it
    insertion_probability: Share = 0.5  # p
    ema_momentum: Annotated[float, Range(0, 1, high_open=True)] = 0.999  # mu
    restore_interval: Steps = 10  # K; 0 switches restoration off
    restore_rate: Share = 1e-3  # r
    lambda_anchor: Weight = 1.0
    lambda_gen: Weight = 5e-2
    lambda_reg: Weight = 1e-4
    alpha_depth: Weight = 0.2
    alpha_normal: Weight = 0.2
    beta_depth: Weight = 1.0
    beta_normal: Weight = 1.0
    camera_huber: Annotated[float, Range(0, 1000, low_open=True)] = 1.0  # beta of the smooth-L1 camera distance
    depth_distance: DepthDistance = DepthDistance.L1
    drift: DriftForm = DriftForm.SUM
    gauge: Gauge = Gauge.KEEP_FIRST
    subset: SubsetRule = SubsetRule.PAPER
    # Beyond the paper, but inside the loop; what is done around it has a section of its own (`CorrectionsConfig`).
    # weight of opacities and sizes of Gaussians among the anchors, which the paper's losses never see; 0: they are not made
    alpha_gaussian: Weight = 0.0
    inserted_weights: InsertedWeights = InsertedWeights.UNIFORM  # see the module pixel_weights
    spend: Spend = Spend.ALWAYS
    # with spend=where_moved: least mean change of the captured views' log depth by the insertion that is worth the steps
    spend_above: Annotated[float, Range(0, 10)] = 0.002
    warp_targets: bool = False  # move the anchors of a warped view with its pixels
    precision: Precision = Precision.FP32
    checkpoint_every: Steps = 25  # steps between resume points; 0: none
    trainable: Trainable = Trainable.ALL
    lora_rank: Annotated[int, Range(1, 1024)] = 8  # of the changes, if trainable is lora
    plateau: PlateauConfig = field(default_factory=PlateauConfig)
    observe_every: Steps = 60  # steps between looks, see `sceneexpander.adaptation.observe`; 0: none
    engine: EngineConfig = field(default_factory=EngineConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
