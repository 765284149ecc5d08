"""CPU seconds of the other reconstructors by number of views, one thread, and what TTT3R keeps between views.

    python benchmarks/rivals_forward.py [--views 2 4 8]

Mid-size configurations with random weights at 168 x 224 (OmniVGGT) and 160 x 224 (TTT3R) pixels. No timings of the reference
implementations were recorded, so there is nothing to compare with: the figures show how each grows with the number of views.
"""

from __future__ import annotations

import argparse
import time

import torch

from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig
from sceneexpander.models.protocol import Head, Reconstructor
from sceneexpander.models.ttt3r import TTT3R, TTT3RConfig
from sceneexpander.models.ttt3r.images import signed_rgb
from sceneexpander.models.ttt3r.network import StreamStep

WIDTH = 224
NEEDED = frozenset({Head.CAMERA, Head.DEPTH})


def seconds(model: Reconstructor, images: torch.Tensor) -> float:
    """The shorter of two calls, process CPU time."""
    times = []
    for _ in range(2):
        begin = time.process_time()
        model.predict(images, heads=NEEDED)
        times.append(time.process_time() - begin)
    return min(times)


def kept_bytes(model: TTT3R, images: torch.Tensor) -> list[int]:
    """Size of state and memory after each view."""
    steps = (StreamStep(image=signed_rgb(image[None])) for image in images)
    return [
        sum(value.numel() * value.element_size() for value in (output.after.tokens, output.after.memory))
        for output in model.stream(steps, maps=frozenset())
    ]


@torch.inference_mode()
def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[2, 4, 8])
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    omnivggt = OmniVGGT.create(
        OmniVGGTConfig(dim=384, encoder_depth=12, encoder_heads=6, trunk_depth=8, trunk_heads=6, collect=(1, 3, 5, 7)),
        generator=generator,
    )
    ttt3r = TTT3R.create(
        TTT3RConfig(
            encoder_dim=384,
            encoder_depth=12,
            encoder_heads=6,
            ray_heads=6,
            dim=384,
            depth=8,
            heads=6,
            state_heads=6,
        ),
        generator=generator,
    )
    print(f"torch {torch.__version__}, 1 thread, float32, process CPU seconds (the shorter of two calls)")
    for model, height in ((omnivggt, 168), (ttt3r, 160)):
        count = sum(parameter.numel() for parameter in model.parameters())
        for views in options.views:
            images = torch.rand(views, 3, height, WIDTH, generator=generator)
            spent = seconds(model, images)
            print(
                f"{model.name:9s} {count:,} parameters, {views:2d} views: {spent:6.2f} s, {spent / views:.2f} s a view"
            )
    sizes = kept_bytes(ttt3r, torch.rand(max(options.views), 3, 160, WIDTH, generator=generator))
    print(f"ttt3r keeps {min(sizes):,} to {max(sizes):,} bytes after 1 to {len(sizes)} views")


if __name__ == "__main__":
    main()
