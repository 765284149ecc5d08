"""An adaptation step and a reconstruction, run by the code that really runs them, on tensors without numbers."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from sceneexpander.adaptation.config import AdaptConfig, SubsetRule
from sceneexpander.adaptation.engine import autocast, set_up
from sceneexpander.adaptation.inputs import StepViews
from sceneexpander.adaptation.learner import Learner
from sceneexpander.adaptation.ledger import BUCKET_ELEMENTS
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.sampling import Batch, subset_sizes
from sceneexpander.models.protocol import ALL_HEADS, Head, Reconstructor, as_module
from sceneexpander.planning.cost import Cost, Meter

FLOAT_BYTES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """What to plan.

    Attributes:
        build: makes the model; called on fake tensors, so its weights are never allocated.
        prepared: makes the prepared input of models that prepare theirs, for that many views; None: images are enough.
        views: all views, the inserted one included.
        height: of the images, in pixels.
        width: of the images, in pixels.
        config: of the adaptation.
        resident_anchor: a third copy of the weights stays in memory: the frozen model that made the anchors.
        all_heads: student and teacher run every head, whether a loss reads it or not.
        gpu: plan for a GPU: weights in large buckets, theta_0 in host memory if the configuration says so.
    """

    build: Callable[[], Reconstructor]
    prepared: Callable[[Reconstructor, Tensor], object] | None
    views: int
    height: int
    width: int
    config: AdaptConfig
    resident_anchor: bool = False
    all_heads: bool = False
    gpu: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """Of an adaptation. ``flops`` is the average over steps with and without the inserted view."""

    parameters: int
    adapted: int
    step_views: int
    peak_bytes: int  # on the device
    steady_bytes: int  # between two steps
    host_bytes: int  # theta_0, where it lives on the host
    flops: float
    flops_with_insertion: int


def step_views(views: int, config: AdaptConfig) -> int:
    """The most views that a step can see: the largest subset of the captured ones, and the inserted one."""
    captured = views - 1
    chosen = captured if config.subset is SubsetRule.ALL else max(subset_sizes(captured))
    return chosen + 1


def adaptation_cost(request: PlanRequest) -> StepCost:
    """Simulate two whole steps, without and with the inserted view; the second finds moments and teacher in memory."""
    config = request.config
    seen = step_views(request.views, config)
    with _fake(), Meter() as meter:
        model = request.build()
        anchor_model = request.build() if request.resident_anchor else None  # only there
        learner = Learner(
            model,
            _anchors(request),
            config,
            seed=0,
            bucket_elements=BUCKET_ELEMENTS["cuda" if request.gpu else "cpu"],
        )
        images = torch.zeros(request.views, 3, request.height, request.width)
        counts = []
        for step, inserted in ((1, False), (2, True)):
            before = meter.flops
            batch = Batch(captured=tuple(range(seen - 1)), inserted=inserted)
            views = _step_views(request, model, images[: seen if inserted else seen - 1])
            learner.losses(views, batch).objective.backward()  # type: ignore[no-untyped-call]
            learner.ledger.apply(step)
            counts.append(meter.flops - before)
        del anchor_model
        start = FLOAT_BYTES * learner.ledger.adapted
        on_host = start if request.gpu and config.engine.start_on_host else 0
        share = config.insertion_probability
        return StepCost(
            parameters=sum(p.numel() for p in as_module(model).parameters()),
            adapted=learner.ledger.adapted,
            step_views=seen,
            # On a CPU theta_0 has nowhere else to go, so it was counted; on its way to the GPU one bucket of it is there.
            peak_bytes=meter.peak - on_host + (FLOAT_BYTES * learner.ledger.bucket_elements if on_host else 0),
            steady_bytes=meter.now - on_host,
            host_bytes=on_host,
            flops=share * counts[1] + (1 - share) * counts[0],
            flops_with_insertion=counts[1],
        )


def inference_cost(request: PlanRequest, heads: frozenset[Head] = ALL_HEADS) -> Cost:
    """Simulate one reconstruction of all views, without gradients."""
    config = request.config
    with _fake(), Meter() as meter:
        model = request.build()
        set_up(model, replace(config, engine=replace(config.engine, compile=False)))
        images = torch.zeros(request.views, 3, request.height, request.width)
        with torch.inference_mode(), autocast(config, images.device):
            _step_views(request, model, images).predict(model, heads)
        return Cost(peak_bytes=meter.peak, final_bytes=meter.now, flops=meter.flops)


@contextlib.contextmanager
def _fake() -> Iterator[None]:
    with FakeTensorMode(allow_non_fake_inputs=True):
        yield


@dataclass(frozen=True, slots=True, kw_only=True)
class AllHeads(StepViews):
    """Views on which every head runs."""

    def predict(self, model: Reconstructor, heads: frozenset[Head] = ALL_HEADS) -> object:  # type: ignore[override]
        return StepViews.predict(self, model, ALL_HEADS)


def _step_views(request: PlanRequest, model: Reconstructor, images: Tensor) -> StepViews:
    prepared = None if request.prepared is None else request.prepared(model, images)
    kind = AllHeads if request.all_heads else StepViews
    return kind(images=images, priors=None, prepared=prepared, grids=[])


def _anchors(request: PlanRequest) -> ViewGeometry:
    captured = request.views - 1
    return ViewGeometry(
        camera_vector=torch.zeros(captured, 9),
        depth=torch.zeros(captured, request.height, request.width),
        normals=torch.zeros(captured, request.height, request.width, 3),
    )
