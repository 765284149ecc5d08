"""Planned against measured peak memory of an adaptation step, on the CPU: `python benchmarks/plan_memory.py [--json]`.

Each case runs in a process of its own: the model is made with random weights, one small step creates moments and teacher, then one
step with the inserted view runs at full size. Measured is the process's highest resident memory over what it held before the
model was made; planned is what `sceneexpander.planning` says. Takes about two minutes of one core.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from sceneexpander.adaptation.config import AdaptConfig, EngineConfig, MomentsForm, Precision
from sceneexpander.adaptation.inputs import StepViews
from sceneexpander.adaptation.learner import Learner
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.models.protocol import as_module
from sceneexpander.planning import PlanRequest, adaptation_cost, step_views
from sceneexpander.planning.models import planned_model

SAVING = EngineConfig(checkpoint_activations=True, views_per_chunk=1, moments=MomentsForm.INT8)
PLAIN = AdaptConfig(restore_interval=1)


@dataclass(frozen=True)
class Case:
    """A model, an image size and options."""

    model: str
    views: int
    height: int
    width: int
    config: AdaptConfig


CASES = {
    "mini, bundled scene's size": Case("mini", 9, 252, 336, PLAIN),
    "mini, activations recomputed": Case("mini", 9, 252, 336, replace(PLAIN, engine=SAVING)),
    "worldmirror/mid": Case("worldmirror/mid", 4, 168, 224, PLAIN),
    "worldmirror/mid, activations recomputed": Case("worldmirror/mid", 4, 168, 224, replace(PLAIN, engine=SAVING)),
    "worldmirror/mid, bf16": Case("worldmirror/mid", 4, 168, 224, replace(PLAIN, precision=Precision.BF16)),
}


def request_of(case: Case) -> PlanRequest:
    """What to plan."""
    model = planned_model(case.model)
    return PlanRequest(
        build=model.build,
        prepared=model.prepared,
        views=case.views,
        height=case.height,
        width=case.width,
        config=case.config,
        gpu=False,
    )


def resident(key: str) -> int:
    """VmRSS or VmHWM in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"/proc/self/status has no {key}")


def return_freed_memory() -> None:
    """Let freed memory leave the process, or peaks would be those of the allocator's habits."""
    libc = ctypes.CDLL("libc.so.6")
    libc.mallopt(-3, 64 * 1024)  # M_MMAP_THRESHOLD
    libc.mallopt(-1, 64 * 1024)  # M_TRIM_THRESHOLD


def measure(case: Case) -> int:
    """Peak bytes of this process over its state before the model."""
    return_freed_memory()
    torch.manual_seed(0)
    # A small run of the same kind first: pages of the libraries are not memory of the step.
    small = "mini" if case.model == "mini" else "worldmirror/tiny"
    run_steps(replace(case, model=small, height=56, width=56))
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    before = resident("VmRSS")
    return run_steps(case) - before


def run_steps(case: Case) -> int:
    """Two steps, a small one and one at full size; the resident peak during the second."""
    request = request_of(case)
    model = request.build()
    for parameter in as_module(model).parameters():
        parameter.data.normal_(std=0.02)
    seen = step_views(case.views, case.config)
    learner = Learner(model, anchors(seen - 1, 28, 28), case.config, seed=0)
    for number, (height, width) in enumerate(((28, 28), (case.height, case.width)), start=1):
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts again here
        images = torch.rand(seen, 3, height, width)
        prepared = None if request.prepared is None else filled(request.prepared(model, images))
        learner.anchors = anchors(seen - 1, height, width)
        views = StepViews(images=images, priors=None, prepared=prepared, grids=[])
        batch = Batch(captured=tuple(range(seen - 1)), inserted=True)
        learner.losses(views, batch).objective.backward()  # type: ignore[no-untyped-call]
        learner.ledger.update(number)
    return resident("VmHWM")


def filled(prepared: Any) -> Any:
    """The shapes of a plan with numbers that a network can bear."""
    priors = prepared.priors
    for name in ("depth", "confident"):
        getattr(priors, name).fill_(1.0)
    priors.world_from_cam.copy_(torch.eye(4))
    priors.intrinsics_px.copy_(torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]))
    priors.base_normals[..., 2] = -1.0
    return prepared


def anchors(captured: int, height: int, width: int) -> ViewGeometry:
    """Targets of the right shapes."""
    normals = torch.zeros(captured, height, width, 3)
    normals[..., 2] = -1
    return ViewGeometry(
        camera_vector=torch.ones(captured, 9), depth=torch.ones(captured, height, width), normals=normals
    )


def main() -> None:
    """Run every case and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--case", help="measure one case in this process and print its bytes")
    parser.add_argument("--only", help="cases whose name begins so")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.case is not None:
        print(measure(CASES[options.case]))
        return
    rows = []
    for name, case in CASES.items():
        if options.only and not name.startswith(options.only):
            continue
        done = subprocess.run([sys.executable, __file__, "--case", name], capture_output=True, text=True, check=True)
        found = int(done.stdout)
        planned = adaptation_cost(request_of(case)).peak_bytes
        rows.append({"case": name, "planned_gb": planned / 1e9, "measured_gb": found / 1e9, "ratio": planned / found})
        if not options.json:
            row = rows[-1]
            print(
                f"{name:42s} planned {row['planned_gb']:6.3f} GB  measured {row['measured_gb']:6.3f} GB  "
                f"ratio {row['ratio']:.3f}",
                flush=True,
            )
    if options.json:
        print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
