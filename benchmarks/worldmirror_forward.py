"""CPU seconds of WorldMirror's forward pass at a mid-size configuration, one thread.

    python benchmarks/worldmirror_forward.py [--runs 2] [--backward]

Prints the ratio to numbers that were recorded for the reference implementation in ANOTHER run, on another and noisy machine
(single readings of process CPU time). Such a ratio is an indication only; a fair one needs both on one machine, alternating.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from sceneexpander.models.protocol import GEOMETRY_HEADS
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig

# The mid-size configuration and CPU seconds of the reference's recorded timing (B=1, 6 views, 168 x 224).
MID_SIZE = WorldMirrorConfig.mid()
VIEWS, HEIGHT, WIDTH = 6, 168, 224
PARAMETERS = 198_609_322
RECORDED = {
    "trunk forward": 1.9,
    "full forward": 10.8,
    "trunk forward + backward": 6.45,
    "full forward + backward": 33.4,
}


def cpu_seconds(function: Callable[[], object], runs: int) -> float:
    """Median process CPU time of ``runs`` calls after one warm-up."""
    function()
    times = []
    for _ in range(runs):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return statistics.median(times)


def report(name: str, function: Callable[[], object], runs: int) -> None:
    """Time one thing and print its line at once: on a busy machine the whole takes minutes."""
    seconds = cpu_seconds(function, runs)
    recorded = RECORDED.get(name)
    against = "" if recorded is None else f"   recorded {recorded:6.2f} s   ratio {seconds / recorded:.2f}"
    print(f"{name:26s} {seconds:6.2f} s{against}", flush=True)


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=2, help="timed calls after the warm-up")
    parser.add_argument("--backward", action="store_true", help="also time forward + backward (minutes)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    model = WorldMirror.create(MID_SIZE, generator=generator)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count == PARAMETERS, f"{count} parameters, recorded {PARAMETERS}"
    images = torch.rand(1, VIEWS, 3, HEIGHT, WIDTH, generator=generator)

    def backward(everything: bool) -> None:
        model.zero_grad(set_to_none=True)
        if not everything:
            torch.stack([tokens.mean() for tokens in model.encode(images).collected]).sum().backward()  # type: ignore[no-untyped-call]
            return
        out = model(images)
        maps = (
            out.depth,
            out.depth_conf,
            out.points,
            out.points_conf,
            out.normals,
            out.normals_conf,
            out.gaussians.depth,
        )
        merged = out.gaussians.merged[0]
        splats = (merged.means, merged.quat_wxyz, merged.scales, merged.opacities, merged.sh, out.cameras.vector)
        torch.stack([value.mean() for value in (*maps, *splats)]).sum().backward()  # type: ignore[no-untyped-call]

    print(
        f"torch {torch.__version__}, 1 thread, float32, {count:,} parameters, {VIEWS} views {HEIGHT}x{WIDTH}; CPU seconds"
    )
    print(
        "'recorded' is the reference implementation in another run on another machine: an indication, not a comparison"
    )
    with torch.inference_mode():
        report("trunk forward", lambda: model.encode(images), options.runs)
        report("full forward", lambda: model(images), options.runs)
        report("cameras, depth, normals", lambda: model(images, heads=GEOMETRY_HEADS), options.runs)
    if options.backward:
        report("trunk forward + backward", lambda: backward(False), options.runs)
        report("full forward + backward", lambda: backward(True), options.runs)


if __name__ == "__main__":
    main()
