"""Time and memory of an adaptation step: `python benchmarks/adaptation.py [--model mini] [--steps 8] [--json]`.

Three things on the same views in one run, alternating step by step, one thread, process CPU time:

- ours: `sceneexpander.adaptation.loop.Run.step`, everything included (augmentation, losses, update, log);
- floor: the student's pass forward and backward, and the teacher's forward in steps with the inserted view, nothing else;
- naive: the method written down plainly. Student, teacher and the frozen model are resident, every head runs, theta_0 is a fourth copy,
  the drift term goes through autograd, and AdamW, EMA and restoration loop over the tensors.

Peak memory is the highest resident set of a process of its own for each, over what it held before the model was made.
"""

from __future__ import annotations

import argparse
import copy
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from plan_memory import resident, return_freed_memory

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.inputs import AdaptationInputs, StepViews, geometry_of
from sceneexpander.adaptation.loop import Run
from sceneexpander.adaptation.objective import anchor_targets, step_losses
from sceneexpander.adaptation.sampling import Batch, sample_batch
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.models.mini import Mini
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Reconstructor, as_module
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig

CONFIG = AdaptConfig(observe_every=0, restore_interval=10)
SIZES = {"mini": (9, 252, 336), "worldmirror/tiny": (9, 112, 112), "worldmirror/mid": (4, 112, 168)}


@dataclass(frozen=True)
class Setting:
    """A model with its views."""

    model: Reconstructor
    inputs: AdaptationInputs


def made_priors(views: int, height: int, width: int, draw: torch.Generator) -> Priors:
    """Cameras in a row before a wavy wall, with evidence of every kind."""
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = 0.2 * torch.arange(views)
    intrinsics = torch.tensor([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    coarse = 2 + torch.rand(views, 1, height // 28, width // 28, generator=draw)
    depth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")[:, 0]
    evidence = torch.rand(views, len(EVIDENCE_CHANNELS), height, width, generator=draw)
    evidence[:, 0] = (evidence[:, 0] > 0.6).float()
    return Priors(world_from_cam=poses, intrinsics_px=intrinsics.repeat(views, 1, 1), depth=depth, evidence=evidence)


def setting(name: str) -> Setting:
    """The model and smooth random pictures of its benchmark size."""
    views, height, width = SIZES[name]
    draw = torch.Generator().manual_seed(0)
    images = torch.nn.functional.interpolate(
        torch.rand(views, 3, height // 14, width // 14, generator=draw), size=(height, width), mode="bilinear"
    )
    priors = None
    if name == "mini":
        model: Reconstructor = Mini.from_weights("builtin")
        priors = made_priors(views, height, width, draw)
    else:
        config = WorldMirrorConfig.tiny() if name.endswith("tiny") else WorldMirrorConfig.mid()
        model = WorldMirror.create(config, generator=draw)
    captured = None if priors is None else priors.select(range(views - 1))
    with torch.no_grad():
        frozen = model.predict(images[:-1], captured, heads=GEOMETRY_HEADS)
    assert frozen.depth is not None and frozen.depth_conf is not None  # noqa: PT018 - heads that were asked for
    assert frozen.normals is not None and frozen.normals_conf is not None  # noqa: PT018
    anchors = Anchors(
        weights_sha256="0",
        view_ids=tuple(str(i) for i in range(views - 1)),
        camera_vector=frozen.camera_vector,
        depth=frozen.depth,
        depth_conf=frozen.depth_conf,
        normals=frozen.normals,
        normals_conf=frozen.normals_conf,
    )
    inputs = AdaptationInputs(
        captured=images[:-1], inserted=images[-1], anchors=anchors, captured_priors=captured, joint_priors=priors
    )
    return Setting(model, inputs)


class Naive:
    """Algorithm 1 as one would first write it."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs) -> None:
        self.student, self.inputs = model, inputs
        self.teacher = copy.deepcopy(model)
        self.frozen = copy.deepcopy(model)  # made the anchors; stays
        self.start = [p.detach().clone() for p in as_module(model).parameters()]
        ours = Run(copy.deepcopy(model), inputs, CONFIG, 0)
        self.source, self.anchors = ours.source, ours.learner.anchors  # the same views and targets as ours
        self.optimiser = torch.optim.AdamW(as_module(model).parameters(), lr=CONFIG.learning_rate, foreach=False)

    def step(self, step: int) -> None:
        """One step."""
        batch = sample_batch(len(self.inputs.captured), CONFIG, seed=0, step=step)
        views = unprepared(self, batch, step)
        student = geometry_of(views.predict(self.student, ALL_HEADS))
        teacher = None
        if batch.inserted:
            with torch.no_grad():
                teacher = geometry_of(views.predict(self.teacher, ALL_HEADS)).view(len(batch.captured))
        targets = anchor_targets(self.anchors, batch, views.grids, student, CONFIG)
        loss = step_losses(student, targets, teacher, CONFIG).objective
        for parameter, start in zip(as_module(self.student).parameters(), self.start, strict=True):
            loss = loss + CONFIG.lambda_reg * (parameter - start).square().sum()
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        with torch.no_grad():
            pairs = zip(as_module(self.teacher).parameters(), as_module(self.student).parameters(), strict=True)
            for old, new in pairs:
                old.mul_(CONFIG.ema_momentum).add_(new, alpha=1 - CONFIG.ema_momentum)
            if step % CONFIG.restore_interval == 0:
                for parameter, start in zip(as_module(self.student).parameters(), self.start, strict=True):
                    mask = torch.rand(parameter.shape) < CONFIG.restore_rate
                    parameter.copy_(torch.where(mask, start, parameter))


def unprepared(naive: Naive, batch: Batch, step: int) -> StepViews:
    """The step's views without anything measured in advance."""
    prepared = naive.source.views(batch, step)
    priors = naive.inputs.joint_priors if batch.inserted else naive.inputs.captured_priors
    chosen = [*batch.captured, len(naive.inputs.captured)] if batch.inserted else list(batch.captured)
    picked = None if priors is None else priors.select(chosen)
    return StepViews(images=prepared.images, priors=picked, prepared=None, grids=prepared.grids)


class Floor:
    """Only what cannot be left out: the passes."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs) -> None:
        self.naive = Naive(model, inputs)
        self.views: tuple[StepViews, bool] | None = None

    def prepare(self, step: int) -> None:
        """Make the views; not counted."""
        batch = sample_batch(len(self.naive.inputs.captured), CONFIG, seed=0, step=step)
        self.views = unprepared(self.naive, batch, step), batch.inserted

    def step(self, _: int) -> None:
        """The passes of one step."""
        assert self.views is not None
        views, inserted = self.views
        student = geometry_of(views.predict(self.naive.student))
        (student.depth.mean() + student.normals.mean() + student.camera_vector.mean()).backward()  # type: ignore[no-untyped-call]
        as_module(self.naive.student).zero_grad()
        if inserted:
            with torch.inference_mode():
                views.predict(self.naive.teacher, GEOMETRY_HEADS)


def cpu(function: Callable[[int], object], step: int) -> float:
    """CPU seconds of one call."""
    begin = time.process_time()
    function(step)
    return time.process_time() - begin


def times(name: str, steps: int) -> dict[str, float]:
    """Mean CPU seconds per step of the three."""
    made = setting(name)
    ours = Run(copy.deepcopy(made.model), made.inputs, CONFIG, 0)
    naive, floor = Naive(copy.deepcopy(made.model), made.inputs), Floor(copy.deepcopy(made.model), made.inputs)
    total = {"ours": 0.0, "naive": 0.0, "floor": 0.0}
    for step in range(1, steps + 3):
        floor.prepare(step)
        # In turns, and turned around every other step: the machine's speed drifts.
        order = [("ours", ours.step), ("floor", floor.step), ("naive", naive.step)]
        for label, function in order if step % 2 else reversed(order):
            seconds = cpu(function, step)
            total[label] += seconds if step > 2 else 0.0  # the first steps allocate
    return {label: seconds / steps for label, seconds in total.items()}


def peak(name: str, kind: str) -> int:
    """Peak bytes of three steps, over the state before the models were made."""
    return_freed_memory()
    small = setting("mini" if name == "mini" else "worldmirror/tiny")
    Run(small.model, small.inputs, CONFIG, 0).step(1)  # library pages are not memory of the step
    del small
    before = resident("VmRSS")
    made = setting(name)
    runner = Run(made.model, made.inputs, CONFIG, 0) if kind == "ours" else Naive(made.model, made.inputs)
    Path("/proc/self/clear_refs").write_text("5")
    inserted = [k for k in range(1, 30) if sample_batch(len(made.inputs.captured), CONFIG, seed=0, step=k).inserted]
    for step in inserted[:2]:
        runner.step(step)
    return resident("VmHWM") - before


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", choices=sorted(SIZES), default="mini")
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--peak", choices=("ours", "naive"), help="measure memory in this process and print its bytes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.peak is not None:
        print(peak(options.model, options.peak))
        return
    command = [sys.executable, __file__, "--model", options.model, "--peak"]
    bytes_of = {
        kind: int(subprocess.run([*command, kind], capture_output=True, text=True, check=True).stdout)
        for kind in ("ours", "naive")
    }
    seconds = times(options.model, options.steps)
    result = {
        "model": options.model,
        "views_height_width": SIZES[options.model],
        "steps": options.steps,
        "cpu_seconds_per_step": seconds,
        "over_floor": seconds["ours"] / seconds["floor"],
        "naive_over_ours_time": seconds["naive"] / seconds["ours"],
        "peak_bytes": bytes_of,
        "naive_over_ours_memory": bytes_of["naive"] / bytes_of["ours"],
    }
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(
        f"{options.model}: ours {seconds['ours']:.3f} s, floor {seconds['floor']:.3f} s, naive {seconds['naive']:.3f} s per step\n"
        f"ours / floor {result['over_floor']:.3f}   naive / ours {result['naive_over_ours_time']:.2f} in time, "
        f"{result['naive_over_ours_memory']:.2f} in peak memory ({bytes_of['naive'] / 1e9:.2f} / {bytes_of['ours'] / 1e9:.2f} GB)"
    )


if __name__ == "__main__":
    main()
