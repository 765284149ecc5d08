"""The parts of `gpu_check.py`, each run in a process of its own: ``python scripts/gpu_parts.py PART FOLDER DEVICE SECONDS [--smoke]``.

Numbers of the models are drawn at random: what is checked is that and how fast the code computes, never what a trained model gives.
In smoke mode the same code runs on the CPU at the smallest sizes; there "the device" and "the CPU" are one, and time has no bounds.
"""

from __future__ import annotations

import argparse
import copy
import json
import multiprocessing
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from gpu_findings import Log, Skipped
from optimisation import scene as make_room
from splat_scene import Scene, make_scene
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, EngineConfig, MomentsForm, Precision
from sceneexpander.adaptation.engine import autocast
from sceneexpander.adaptation.inputs import AdaptationInputs, StepViews, ViewSource, geometry_of, heads_of
from sceneexpander.adaptation.loop import Run, StepRecord, adapt
from sceneexpander.adaptation.sampling import Batch, sample_batch
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.store import read_json
from sceneexpander.catalogue.methods import CORRECTED
from sceneexpander.cli.plan import Question, request_of
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Reconstructor, as_module
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from sceneexpander.optimisation.config import DensityConfig, OptimiseConfig
from sceneexpander.optimisation.optimise import optimise
from sceneexpander.pipeline.processes import end_with_parent
from sceneexpander.pipeline.selection import Selection
from sceneexpander.pipeline.workspace import make_workspace, workspace_environment
from sceneexpander.planning import Meter, PlanRequest, adaptation_cost, inference_cost
from sceneexpander.planning.simulate import AllHeads
from sceneexpander.splatting import RasterSettings, rasterise
from sceneexpander.splatting.settings import Backend

ROOT = Path(__file__).resolve().parents[1]
GIGA = 1e9
SEED = 0
PAPER_STEPS, FLOOR_STEPS = 20, 4
RUNTIME_BYTES = 1_500_000_000  # of the GPU's runtime and the allocator's gaps, beside the tensors
PLAN_TOLERANCE = 0.15  # of measured peaks, as in benchmarks/plan_memory.py
FLOOR_SHARE = 0.9  # a step may take a tenth more than the passes that it cannot do without
GSPLAT_MAX_ALPHA = 0.999  # built into release 1.5.3
MODELS: dict[str, Callable[[], WorldMirrorConfig]] = {
    "large": WorldMirrorConfig.large,
    "mid": WorldMirrorConfig.mid,
    "tiny": WorldMirrorConfig.tiny,
    # Every part of the model, as little of it as there can be.
    "smallest": lambda: replace(WorldMirrorConfig.tiny(), encoder_depth=1, camera_depth=1, camera_steps=2),
}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Where a part runs, how long it may take, and where it leaves what it found."""

    device: torch.device
    seconds: float
    folder: Path
    log: Log
    smoke: bool = False
    started: float = field(default_factory=time.monotonic)

    @property
    def timed(self) -> bool:
        """Whether times mean anything."""
        return self.device.type == "cuda"

    def used(self, share: float) -> bool:
        """Whether that share of the time is over."""
        return time.monotonic() - self.started > share * self.seconds

    def synchronise(self) -> None:
        """Wait for the device."""
        if self.timed:
            torch.cuda.synchronize(self.device)

    def clock(self, function: Callable[[], object]) -> float:
        """Seconds of one call, until the device has done it."""
        self.synchronise()
        begin = time.perf_counter()
        function()
        self.synchronise()
        return time.perf_counter() - begin


@dataclass(slots=True)
class Peak:
    """Bytes of tensors at once at most, and of the allocator (CUDA)."""

    allocated: int = 0
    reserved: int = 0


@contextmanager
def measured_peak(setting: Setting) -> Iterator[Peak]:
    """The peak of whatever runs inside: by the allocator on CUDA, tensor by tensor on a CPU."""
    peak = Peak()
    if not setting.timed:
        with Meter() as meter:
            yield peak
        peak.allocated = peak.reserved = meter.peak
        return
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(setting.device)
    before = torch.cuda.memory_allocated(setting.device)
    yield peak
    peak.allocated = torch.cuda.max_memory_allocated(setting.device) - before
    peak.reserved = torch.cuda.max_memory_reserved(setting.device)


def random_model(size: str, device: torch.device) -> WorldMirror:
    """WorldMirror with numbers drawn on the device. Gaussians are not merged: how many that leaves no plan can know."""
    return WorldMirror.create(config_of(size), generator=torch.Generator(device).manual_seed(SEED))


def config_of(size: str) -> WorldMirrorConfig:
    """A model's sizes, its Gaussians left unmerged."""
    config = MODELS[size]()
    return replace(config, gaussian=replace(config.gaussian, merge=False))


def request_for(size: str, views: int, side: int, options: str, *overrides: str) -> PlanRequest:
    """What to plan: a profile's way to adapt, or the paper's, with square pictures."""
    question = Question(views=views, width=side, height=side, options=options, overrides=overrides)
    return replace(request_of(question), build=lambda: WorldMirror(config_of(size)))


def random_images(views: int, side: int) -> Tensor:
    """Smooth random pictures (view, 3, side, side) in [0, 1]."""
    draw = torch.Generator().manual_seed(SEED)
    coarse = torch.rand(views, 3, max(side // 14, 2), max(side // 14, 2), generator=draw)
    return torch.nn.functional.interpolate(coarse, size=(side, side), mode="bilinear")


def inputs_for(model: Reconstructor, views: int, side: int) -> AdaptationInputs:
    """Random pictures, the last one inserted, and the model's own predictions as anchors."""
    images = random_images(views, side).to(next(as_module(model).parameters()).device)
    with torch.no_grad():
        frozen = model.predict(images[:-1], None, heads=GEOMETRY_HEADS)
    if frozen.depth is None or frozen.depth_conf is None or frozen.normals is None or frozen.normals_conf is None:
        raise RuntimeError("the model left out a head that was asked for")
    anchors = Anchors(
        weights_sha256="random",
        view_ids=tuple(str(view) for view in range(views - 1)),
        camera_vector=frozen.camera_vector,
        depth=frozen.depth,
        depth_conf=frozen.depth_conf,
        normals=frozen.normals,
        normals_conf=frozen.normals_conf,
    )
    return AdaptationInputs(
        captured=images[:-1], inserted=images[-1], anchors=anchors, captured_priors=None, joint_priors=None
    )


def check_machine(setting: Setting) -> None:
    """What the numbers of the other parts were measured on."""
    log = setting.log
    log.add("torch", torch.__version__)
    log.add("CUDA of torch", torch.version.cuda or "none")
    log.add("processors", os.cpu_count() or 0)
    log.add("gsplat", _gsplat_version() or "not installed")
    log.add("CUDA compiler", shutil.which("nvcc") or "none")
    if not setting.timed:
        return
    facts = torch.cuda.get_device_properties(setting.device)
    free, total = torch.cuda.mem_get_info(setting.device)
    log.add("GPU", facts.name)
    log.add("compute capability", f"{facts.major}.{facts.minor}")
    log.add("memory", round(total / GIGA, 1), "GB")
    log.add("free memory", round(free / GIGA, 1), "GB")
    log.add("bfloat16", torch.cuda.is_bf16_supported())
    log.add("TF32 products", torch.backends.cuda.matmul.allow_tf32)


def check_forward(setting: Setting) -> None:
    """A reconstruction with all heads, in float32 and bfloat16, against its plan."""
    size, views, side = ("smallest", 2, 28) if setting.smoke else ("large", 9, 518)
    for precision in ("fp32", "bf16"):
        cost = inference_cost(request_for(size, views, side, "gpu", f"adapt.precision={precision}"))
        _require_memory(setting, cost.peak_bytes)
        seconds: list[float] = []
        dtype = torch.bfloat16 if precision == "bf16" else None
        low = nullcontext() if dtype is None else torch.autocast(setting.device.type, dtype=dtype)
        with measured_peak(setting) as peak:
            model = random_model(size, setting.device)
            images = random_images(views, side).to(setting.device)
            with torch.inference_mode(), low:
                for _ in range(2):  # the first allocates
                    made = None
                    begin = time.perf_counter()
                    made = model.predict(images, None, heads=ALL_HEADS)
                    setting.synchronise()
                    seconds.append(time.perf_counter() - begin)
        if made is None or made.depth is None or made.gaussians is None:
            raise RuntimeError("a head is missing")
        finite = all(bool(torch.isfinite(x).all()) for x in (made.camera_vector, made.depth, made.gaussians.means))
        setting.log.add(f"{precision}: all outputs are finite", finite, at_least=1)
        _add_memory(setting, f"{precision}: ", cost.peak_bytes, peak)
        _add_speed(setting, f"{precision}: ", seconds[-1], cost.flops)
        del model, made


def check_adaptation(setting: Setting, options: str) -> None:
    """Steps of the adaptation at the paper's setting with a set of options: memory against the plan, time against the floor."""
    size, views, side, steps = ("smallest", 3, 28, 2) if setting.smoke else ("large", 9, 518, PAPER_STEPS)
    request = request_for(size, views, side, options)
    plan = adaptation_cost(request if setting.timed else replace(request, gpu=False))
    _require_memory(setting, plan.peak_bytes)
    config = request.config
    # The largest batch that can be drawn has to be among the steps, or the peak would be that of a smaller one.
    seed = next(k for k in range(1000) if _largest_within(views, config, k, plan.step_views, steps // 2 + 1))
    seconds: list[float] = []
    records: list[StepRecord] = []
    with measured_peak(setting) as peak:
        model = random_model(size, setting.device)
        resident = random_model(size, setting.device) if request.resident_anchor else None
        run = Run(model, inputs_for(resident or model, views, side), config, seed)
        if request.all_heads:
            run.source = _AllHeadsSource(run.source)
        while len(records) < steps and not (len(records) > 1 and setting.used(0.6)):
            seconds.append(setting.clock(lambda: records.append(run.step(len(records) + 1))))
    ledger = run.learner.ledger
    log = setting.log
    log.add("steps", len(records), f"of {steps}", at_least=min(steps, 2))
    log.add("seed", seed)
    largest = max(record.captured + record.inserted for record in records)
    log.add("most views in a step", largest, f"planned {plan.step_views}", at_least=plan.step_views)
    log.add("adapted weights as planned", ledger.adapted == plan.adapted, at_least=1)
    _add_memory(setting, "", plan.peak_bytes, peak)
    if options == "gpu24":
        log.add("fits 24 GB", round(peak.reserved / GIGA, 3), "GB", at_most=24)
    waiting = sum(4 * bucket.start.numel() for bucket in ledger.buckets if bucket.start.device.type == "cpu")
    if setting.timed:
        log.add("theta_0 on the host", round(waiting / GIGA, 3), f"GB, planned {plan.host_bytes / GIGA:.3f}")
    log.add("loss of the first step", records[0].loss)
    log.add("loss of the last step", records[-1].loss)
    log.add("first step", round(seconds[0], 3), "s")
    usual = seconds[2:] or seconds[-1:]
    _add_speed(setting, "a step: ", statistics.mean(usual), plan.flops)
    _add_floor(setting, run, len(records))


def _add_floor(setting: Setting, run: Run, done: int) -> None:
    """Whole steps in turns with nothing but their passes: student forward and backward, and the teacher forward where it is needed."""
    heads = heads_of(run.config)
    ours = floor = 0.0
    taken = 0
    for step in range(done + 1, done + 1 + (1 if setting.smoke else FLOOR_STEPS)):
        if taken and setting.used(0.9):
            break
        batch = sample_batch(len(run.inputs.captured), run.config, seed=run.seed, step=step)
        views = run.source.views(batch, step)

        def passes(views: StepViews = views, batch: Batch = batch) -> None:
            with autocast(run.config, run.learner.device):
                student = geometry_of(views.predict(run.learner.model, heads))
            (student.depth.mean() + student.normals.mean() + student.camera_vector.mean()).backward()  # type: ignore[no-untyped-call]
            if batch.inserted:
                with torch.inference_mode(), autocast(run.config, run.learner.device):
                    views.predict(run.learner.teacher, GEOMETRY_HEADS)

        floor += setting.clock(passes)
        for parameter in as_module(run.learner.model).parameters():
            parameter.grad = None
        del views
        ours += setting.clock(lambda step=step: run.step(step))  # type: ignore[misc]
        taken += 1
    bound = FLOOR_SHARE if setting.timed else None
    setting.log.add("share of the floor in a step", round(floor / ours, 3), f"over {taken} steps", at_least=bound)


@dataclass(frozen=True, kw_only=True)
class _Variant:
    """A way to compute the same steps. ``exact``: no other numbers; else how much the losses may differ, relatively."""

    config: AdaptConfig
    exact: bool = False
    loss: float = 1e-3


def check_options(setting: Setting) -> None:
    """Every option of the engine by itself, against the plain way: losses, changes of the weights, time, memory."""
    size, views, side, steps = ("smallest", 3, 28, 2) if setting.smoke else ("mid", 9, 224, 8)
    plain = AdaptConfig(observe_every=0, checkpoint_every=0, restore_interval=0)

    def with_engine(**engine: object) -> AdaptConfig:
        return replace(plain, engine=replace(EngineConfig(), **engine))  # type: ignore[arg-type]

    variants = {
        "repeated": _Variant(config=plain),
        "start_on_host": _Variant(config=with_engine(start_on_host=True), exact=True),
        "checkpoint_activations": _Variant(config=with_engine(checkpoint_activations=True), exact=True),
        "views_per_chunk": _Variant(config=with_engine(views_per_chunk=1)),
        "moments int8": _Variant(config=with_engine(moments=MomentsForm.INT8), loss=0.02),
        "bf16": _Variant(config=replace(plain, precision=Precision.BF16), loss=0.2),
        "compile": _Variant(config=with_engine(compile=True), loss=0.01),
    }
    model = random_model(size, setting.device)
    inputs = inputs_for(model, views, side)
    reference = _Steps.of(setting, model, inputs, plain, steps)
    reference.add_to(setting.log, "plain")
    noise = 0.0
    for name, variant in variants.items():
        if setting.used(0.95):
            setting.log.add(name, "not run: no time left")
            continue
        made = _Steps.of(setting, model, inputs, variant.config, steps)
        made.add_to(setting.log, name)
        change = made.change_from(reference)
        if name == "repeated":
            noise = change
        # A device may add in another order from run to run; an exact option may differ no more than plain steps do from themselves.
        bound = 2 * noise + (1e-6 if setting.timed else 0.0) if variant.exact else None
        setting.log.add(f"{name}: change of the weights against plain", change, "relative", at_most=bound)
        setting.log.add(f"{name}: losses against plain", made.loss_from(reference), "relative", at_most=variant.loss)
    if not setting.timed:
        setting.log.add("compile", "ran without being compiled, in smoke mode")


@dataclass(frozen=True, kw_only=True)
class _Steps:
    """Some steps from the same model: losses, the change of its weights, seconds of each, peak bytes."""

    losses: Tensor
    change: Tensor
    seconds: tuple[float, ...]
    peak: Peak

    @classmethod
    def of(
        cls, setting: Setting, model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, steps: int
    ) -> _Steps:
        """Run them on a copy of the model."""
        start = torch.cat([p.detach().flatten() for p in as_module(model).parameters()]).cpu()
        records: list[StepRecord] = []
        seconds: list[float] = []
        # Compiling takes minutes of a CPU; there the same calls run as they are.
        compiling = nullcontext() if setting.timed else torch.compiler.set_stance("force_eager")
        with compiling, measured_peak(setting) as peak:
            student = copy.deepcopy(model)
            run = Run(student, inputs, config, SEED)
            for step in range(1, steps + 1):
                seconds.append(setting.clock(lambda step=step: records.append(run.step(step))))  # type: ignore[misc]
        end = torch.cat([p.detach().flatten() for p in as_module(student).parameters()]).cpu()
        return cls(
            losses=torch.tensor([record.loss for record in records]),
            change=end - start,
            seconds=tuple(seconds),
            peak=peak,
        )

    def add_to(self, log: Log, name: str) -> None:
        """Time and memory."""
        log.add(f"{name}: first step", round(self.seconds[0], 3), "s")
        log.add(f"{name}: a step", round(statistics.median(self.seconds[1:]), 4), "s")
        log.add(f"{name}: peak", round(self.peak.allocated / GIGA, 3), "GB")

    def change_from(self, other: _Steps) -> float:
        """Norm of the difference of the weights' changes, relative to the other's."""
        return float((self.change - other.change).norm() / other.change.norm())

    def loss_from(self, other: _Steps) -> float:
        """Largest relative difference of a step's loss."""
        return float(((self.losses - other.losses).abs() / other.losses.abs()).max())


def check_agreement(setting: Setting) -> None:
    """The same model and steps on the CPU and on the device, in float32."""
    for size, views, side in (("smallest", 3, 28),) if setting.smoke else (("tiny", 5, 112), ("mid", 4, 112)):
        model = random_model(size, torch.device("cpu"))
        inputs = inputs_for(model, views, side)
        other = copy.deepcopy(model).to(setting.device)
        with torch.inference_mode():
            expected = model.predict(inputs.captured, None, heads=ALL_HEADS)
            made = other.predict(inputs.captured.to(setting.device), None, heads=ALL_HEADS)
        for name in ("camera_vector", "depth", "normals"):
            want, got = getattr(expected, name), getattr(made, name).cpu()
            setting.log.add(f"{size}: {name}", float((got - want).norm() / want.norm()), "relative", at_most=1e-3)
        config = AdaptConfig(observe_every=0, checkpoint_every=0, restore_interval=0)
        runs = [Run(model, inputs, config, SEED), Run(other, _on_device(inputs, setting.device), config, SEED)]
        for step in (1, 2, 3):
            ours, theirs = (run.step(step) for run in runs)
            for name in ("loss", "gradient_norm"):
                want, got = getattr(ours, name), getattr(theirs, name)
                setting.log.add(f"{size}: {name} of step {step}", abs(got - want) / abs(want), "relative", at_most=1e-2)


def check_resume(setting: Setting) -> None:
    """An adaptation killed after a resume point ends as one that was left alone."""
    size, views, side, steps = ("smallest", 3, 28, 4) if setting.smoke else ("tiny", 9, 224, 12)
    folder = setting.folder / "resume-point"
    # The child first: a process that uses CUDA must not be forked.
    context = multiprocessing.get_context("spawn") if setting.timed else multiprocessing.get_context("fork")
    reader, writer = context.Pipe(duplex=False)
    arguments = (size, views, side, steps, str(setting.device), folder, writer)
    child = context.Process(target=_adapt, args=arguments)
    child.start()
    writer.close()
    try:
        while int(reader.recv()) < steps // 2 + 1:
            pass
    finally:
        if child.pid is not None and child.is_alive():
            os.kill(child.pid, signal.SIGKILL)
        child.join()
    setting.log.add("killed by", -(child.exitcode or 0), f"signal {signal.SIGKILL}", at_least=9, at_most=9)
    setting.log.add("a resume point was left", folder.is_dir() and any(folder.iterdir()), at_least=1)
    again: list[int] = []
    resumed = _adapt(size, views, side, steps, str(setting.device), folder, None, again)
    unbroken = _adapt(size, views, side, steps, str(setting.device), None, None, [])
    setting.log.add("steps in the log of the resumed run", len(again), f"of {steps}", at_least=steps, at_most=steps)
    names = sorted(unbroken)
    start = random_model(size, setting.device).state_dict()
    want = torch.cat([(unbroken[name] - start[name].cpu()).flatten() for name in names])
    got = torch.cat([(resumed[name] - start[name].cpu()).flatten() for name in names])
    bound = 0.05 if setting.timed else 0.0  # atomic additions of a GPU do not repeat
    difference = float((got - want).norm() / want.norm())
    setting.log.add("change of the weights against the unbroken run", difference, "relative", at_most=bound)


def _adapt(
    size: str,
    views: int,
    side: int,
    steps: int,
    device: str,
    folder: Path | None,
    told: Connection | None,
    log: list[int] | None = None,
) -> dict[str, Tensor]:
    """A whole adaptation with a resume point after every second step; the steps are told as they are done."""
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)

    def on_step(record: StepRecord) -> None:
        if told is not None:
            told.send(record.step)
        if log is not None:
            log.append(record.step)

    model = random_model(size, torch.device(device))
    config = AdaptConfig(steps=steps, observe_every=0, checkpoint_every=2)
    inputs = inputs_for(model, views, side)
    return adapt(model, inputs, config, seed=SEED, checkpoint_folder=folder, on_step=on_step).student


def check_gsplat_build(setting: Setting) -> None:
    """gsplat draws one picture. Its first use may compile it, which takes minutes."""
    version = _gsplat_version()
    if version is None:
        raise Skipped("gsplat is not installed: pip install 'sceneexpander[gpu]'")
    setting.log.add("gsplat", version)
    if not setting.timed:
        raise Skipped("gsplat draws on CUDA only")
    scene = make_scene("T")
    seconds = setting.clock(lambda: _drawn(scene, setting.device, "gsplat", antialiased=False))
    setting.log.add("first picture, building included", round(seconds, 1), "s")


def check_gsplat(setting: Setting) -> None:
    """Pictures and gradients of gsplat against the CPU kernel; in smoke mode the torch rasteriser stands in for gsplat."""
    names = ("T",) if setting.smoke else ("T", "S", "M")
    backend: Backend = "torch" if setting.smoke else "gsplat"
    for name in names:
        dense = make_scene(name)
        # Two surfaces on one place: rasterisers round depths differently and so order some pairs otherwise. Among few there are hardly any.
        for label, scene, bound in ((name, dense, 0.1), (f"{name} thinned", _thinned(dense, 37), 0.005)):
            for antialiased in (False, True):
                title = f"{label}, {'antialiased' if antialiased else 'classic'}: "
                _compare_pictures(setting, title, scene, backend, antialiased=antialiased, bound=bound)

        def draw(dense: Scene = dense) -> None:
            _drawn(dense, setting.device, backend, antialiased=False)

        seconds = min(setting.clock(draw) for _ in range(1 if setting.smoke else 4))
        setting.log.add(f"{name}: forward, backward, transfers", round(1000 * seconds, 2), "ms")


def _compare_pictures(
    setting: Setting, title: str, scene: Scene, backend: Backend, *, antialiased: bool, bound: float
) -> None:
    want = _drawn(scene, torch.device("cpu"), "auto", antialiased=antialiased)
    got = _drawn(scene, setting.device, backend, antialiased=antialiased)
    for part in ("rgb", "alpha", "depth"):
        error = (got[part] - want[part]).square().mean().clamp(min=1e-20)
        decibel = float(10 * torch.log10(want[part].max().square() / error))
        setting.log.add(f"{title}{part}", round(decibel, 1), "dB PSNR", at_least=45)
    for part in ("means", "quats", "scales", "opacities", "colours", "screen"):
        difference = float((got[part] - want[part]).norm() / want[part].norm())
        setting.log.add(f"{title}gradient of {part}", difference, "relative", at_most=bound)


def _thinned(scene: Scene, every: int) -> Scene:
    """Every so many Gaussians, enlarged to cover as much."""
    kept = {name: getattr(scene, name)[::every] for name in ("means", "quats", "scales", "opacities", "colours")}
    return replace(scene, **(kept | {"scales": kept["scales"] * every**0.5}))


def _drawn(scene: Scene, device: torch.device, backend: Backend, *, antialiased: bool) -> dict[str, Tensor]:
    """A picture of a made scene and the gradients of its loss, on the host."""
    leaves = [leaf.detach().to(device).requires_grad_() for leaf in scene.leaves()]
    screen = torch.zeros(1, len(leaves[0]), 2, device=device, requires_grad=True)
    means, quats, scales, opacities, colours = leaves
    out = rasterise(
        means,
        quats,
        scales,
        opacities,
        colours,
        scene.viewmat[None].to(device),
        scene.intrinsics[None].to(device),
        scene.height,
        scene.width,
        screen_offsets=screen,
        settings=RasterSettings(backend=backend, antialiased=antialiased, max_alpha=GSPLAT_MAX_ALPHA),
    )
    if out.depth is None:
        raise RuntimeError("no depth was drawn")
    (out.rgb.movedim(1, -1)[0] * scene.target.to(device)).mean().backward()  # type: ignore[no-untyped-call]
    values = {"rgb": out.rgb, "alpha": out.alpha, "depth": torch.where(out.alpha > 0.5, out.depth, 0)}
    for name, leaf in zip(
        ("means", "quats", "scales", "opacities", "colours", "screen"), [*leaves, screen], strict=True
    ):
        if leaf.grad is None:
            raise RuntimeError(f"no gradient reached {name}")
        values[name] = leaf.grad
    return {name: value.detach().cpu() for name, value in values.items()}


def check_optimisation(setting: Setting, strategy: str) -> None:
    """The per-scene optimisation with one strategy: on the device, on the CPU, and stopped and resumed on the device."""
    count, steps = (400, 6) if setting.smoke else (50_000, 300)
    start, images = make_room(count)
    config = OptimiseConfig(
        steps=steps,
        sh_degree=1,
        start_gaussians=count,
        checkpoint_every=max(steps // 4, 1),
        density=DensityConfig(
            strategy="mcmc" if strategy == "mcmc" else "default",
            start=0.1,
            stop=0.8,
            every=max(steps // 10, 1),
            max_gaussians=2 * count,
        ),
    )
    tail = max(steps // 10, 1)
    results = {}
    for place in dict.fromkeys((str(setting.device), "cpu")):
        seconds = setting.clock(
            lambda place=place: results.update(  # type: ignore[misc]
                {place: optimise(start, images, config, method="made", seed=SEED, device=place)}
            )
        )
        made = results[place]
        setting.log.add(f"{place}: steps per second", round(steps / seconds, 1))
        setting.log.add(f"{place}: Gaussians at the end", len(made.reconstruction.gaussians), f"from {count}")
        first, last = statistics.mean(made.losses[:tail]), statistics.mean(made.losses[-tail:])
        # A few steps of a smoke run need not bring anything.
        bound = None if setting.smoke else 1.0
        setting.log.add(f"{place}: loss at the end over at the start", round(last / first, 3), at_most=bound)
    ends = {place: statistics.mean(made.losses[-tail:]) for place, made in results.items()}
    share = ends[str(setting.device)] / ends["cpu"]
    setting.log.add("loss at the end, device over CPU", round(share, 3), at_least=0.7, at_most=1.3)

    class _Stopped(Exception):
        pass

    def stop(step: int, loss: float) -> None:
        if step == steps // 2 + 1:
            raise _Stopped

    folder, done = setting.folder / f"optimise-{strategy}", []
    with suppress(_Stopped):
        optimise(
            start,
            images,
            config,
            method="made",
            seed=SEED,
            device=setting.device,
            checkpoint_folder=folder,
            on_step=stop,
        )
    again = optimise(
        start,
        images,
        config,
        method="made",
        seed=SEED,
        device=setting.device,
        checkpoint_folder=folder,
        on_step=lambda step, loss: done.append(step),
    )
    setting.log.add("steps that the resumed run had left", len(done), f"of {steps}", at_least=1, at_most=steps - 1)
    share = statistics.mean(again.losses[-tail:]) / ends[str(setting.device)]
    bound = 0.3 if setting.timed else 1e-6  # gsplat's strategies draw from a generator that no resume point holds
    setting.log.add("loss at the end, resumed over unbroken", share, at_least=1 - bound, at_most=1 + bound)


def check_pipeline(setting: Setting) -> None:
    """``sceneexpander run`` on the bundled scene in a folder of its own: every stage, with the methods that need no weights."""
    profile = ("profile=smoke", "frontend.sfm.max_features=800") if setting.smoke else ("profile=gpu",)
    default = Selection(scenes=("courtyard",), rounds=1)
    methods = tuple(dict.fromkeys((*default.methods, CORRECTED, "gaussian_splatting")))
    folder = setting.folder / "project"
    make_workspace(folder, replace(default, methods=methods, overrides=profile), project=ROOT)
    environment = workspace_environment(folder, folder)
    command = [sys.executable, "-m", "sceneexpander.cli", "run"]
    output = setting.folder / "pipeline.txt"
    with output.open("w") as file:
        done = subprocess.Popen(command, cwd=folder, env=environment, stdout=file, stderr=subprocess.STDOUT)
        left = setting.seconds - (time.monotonic() - setting.started) - 5
        try:
            code = done.wait(left)
        except subprocess.TimeoutExpired:
            done.terminate()
            done.wait()
            code = None
    total = 0.0
    for path in sorted((folder / "outputs").rglob("stats/*.json")):
        stats = read_json(path)
        seconds = float(stats["wall_s"])
        total += seconds
        memory = f", {stats['peak_gpu_mb']} MB of the GPU" if "peak_gpu_mb" in stats else ""
        setting.log.add(path.stem, round(seconds, 1), f"s{memory}")
    setting.log.add("stages together", round(total, 1), "s")
    for path in sorted((folder / "outputs").rglob("metrics/*.json")):
        decibel = read_json(path).get("values", {}).get("psnr_captured_db")
        if isinstance(decibel, float):
            setting.log.add(f"{path.stem}: captured views", round(decibel, 2), "dB PSNR", at_least=5)
    if code is None:
        raise TimeoutError(f"stopped after {left:.0f} s; what ran is above")
    if code != 0:
        raise RuntimeError(f"exit code {code}: {' / '.join(output.read_text(errors='replace').splitlines()[-3:])}")
    page = folder / "outputs" / "report" / "index.html"
    setting.log.add("the report is there", page.is_file(), at_least=1)


PARTS: Mapping[str, Callable[[Setting], None]] = {
    "machine": check_machine,
    "gsplat_build": check_gsplat_build,
    "forward": check_forward,
    "agreement": check_agreement,
    "adapt_gpu24": lambda setting: check_adaptation(setting, "gpu24"),
    "adapt_paper": lambda setting: check_adaptation(setting, "paper"),
    "adapt_plain": lambda setting: check_adaptation(setting, "gpu"),
    "options": check_options,
    "resume": check_resume,
    "gsplat": check_gsplat,
    "optimise_default": lambda setting: check_optimisation(setting, "default"),
    "optimise_mcmc": lambda setting: check_optimisation(setting, "mcmc"),
    "pipeline": check_pipeline,
}


class _AllHeadsSource(ViewSource):
    """Views on which every head runs, as in the plain way to run the method."""

    def __init__(self, source: ViewSource) -> None:
        super().__init__(source.model, source.inputs, source.config, seed=source.seed)

    def views(self, batch: Batch, step: int) -> StepViews:
        """See `ViewSource.views`."""
        made = super().views(batch, step)
        return AllHeads(images=made.images, priors=made.priors, prepared=made.prepared, grids=made.grids)


def _largest_within(views: int, config: AdaptConfig, seed: int, wanted: int, steps: int) -> bool:
    batches = (sample_batch(views - 1, config, seed=seed, step=step) for step in range(1, steps + 1))
    return any(len(batch.captured) + batch.inserted == wanted for batch in batches)


def _require_memory(setting: Setting, planned: int) -> None:
    if not setting.timed:
        return
    free, _ = torch.cuda.mem_get_info(setting.device)
    if planned + RUNTIME_BYTES > free:
        raise Skipped(f"{planned / GIGA:.1f} GB are planned, {free / GIGA:.1f} GB are free")


def _add_memory(setting: Setting, label: str, planned: int, peak: Peak) -> None:
    setting.log.add(f"{label}planned peak", round(planned / GIGA, 3), "GB")
    setting.log.add(f"{label}measured peak", round(peak.allocated / GIGA, 3), "GB")
    if setting.timed:
        setting.log.add(f"{label}of the allocator", round(peak.reserved / GIGA, 3), "GB")
    low, high = 1 - PLAN_TOLERANCE, 1 + PLAN_TOLERANCE
    setting.log.add(f"{label}planned over measured", round(planned / peak.allocated, 3), at_least=low, at_most=high)


def _add_speed(setting: Setting, label: str, seconds: float, flops: float) -> None:
    setting.log.add(f"{label}time", round(seconds, 4), "s")
    setting.log.add(f"{label}speed", round(flops / seconds / 1e12, 3), "TFLOP/s")


def _on_device(inputs: AdaptationInputs, device: torch.device) -> AdaptationInputs:
    anchors = inputs.anchors
    moved = {
        name: getattr(anchors, name).to(device)
        for name in ("camera_vector", "depth", "depth_conf", "normals", "normals_conf")
    }
    return replace(
        inputs,
        captured=inputs.captured.to(device),
        inserted=inputs.inserted.to(device),
        anchors=replace(anchors, **moved),
    )


def _gsplat_version() -> str | None:
    try:
        return version("gsplat")
    except PackageNotFoundError:
        return None


def main() -> None:
    """Run one part; how it ended is the last line that it prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=sorted(PARTS))
    parser.add_argument("folder", type=Path)
    parser.add_argument("device")
    parser.add_argument("seconds", type=float)
    parser.add_argument("--smoke", action="store_true")
    given = parser.parse_args()
    end_with_parent()  # its session is its own, so no signal to the check's terminal reaches it
    device = torch.device(given.device)
    if device.type == "cuda":
        # Compiled for this GPU alone, gsplat is there sooner.
        major, minor = torch.cuda.get_device_capability(device)
        os.environ.setdefault("TORCH_CUDA_ARCH_LIST", f"{major}.{minor}")
    setting = Setting(
        device=device,
        seconds=given.seconds,
        folder=given.folder / given.part,
        log=Log(given.folder / f"{given.part}.jsonl"),
        smoke=given.smoke,
    )
    setting.folder.mkdir(parents=True, exist_ok=True)
    try:
        PARTS[given.part](setting)
    except Skipped as reason:
        print(json.dumps({"skipped": str(reason)}))
    except TimeoutError as reason:
        print(json.dumps({"timed_out": str(reason)}))
    else:
        print(json.dumps({"done": True}))


if __name__ == "__main__":
    main()
