"""Fit the confidence of the dense base on procedural scenes: `python scripts/fit_confidence.py [--scenes 400] [--samples FOLDER]`.

Writes src/sceneexpander/frontend/confidence.json and prints how well probabilities hold on scenes that were left out of the fit.
The default takes about half an hour on two cores; the training buffer of `train_mini.py` can be given as the folder of samples.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.progress import track

from sceneexpander.errors import UserError, entry_point
from sceneexpander.files import write_bytes_atomic
from sceneexpander.frontend.confidence import FEATURES, RIGHT
from sceneexpander.frontend.confidence import __file__ as module_file
from sceneexpander.training.buffer import sample_path, samples_folder
from sceneexpander.training.confidence import calibration, fit_confidence, pixels_of_sample
from sceneexpander.training.generate import GeneratorConfig, training_sample
from sceneexpander.training.sample import Sample

EVERY_PIXEL = 97  # of which one is used; neighbours say the same
LEFT_OUT = 5  # every fifth scene is for the check alone


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=400, help="training scenes to use, more than 1")
    parser.add_argument("--seed", type=int, default=0, help="of the stream that missing scenes are drawn from")
    parser.add_argument(
        "--samples", type=Path, default=Path("outputs/confidence_samples"), help="where scenes lie or are kept"
    )
    parser.add_argument("--out", type=Path, default=Path(module_file).with_name("confidence.json"))
    return parser.parse_args()


def collect(folder: Path, scenes: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(features, log errors) of the scenes with at least two posed views; missing ones are made."""
    stored = sorted(samples_folder(folder).glob("*.safetensors"))[:scenes]
    for index in track(range(len(stored), scenes), description="scenes"):
        path = sample_path(folder, index)
        training_sample(index, seed, GeneratorConfig()).save(path)
        stored.append(path)
    samples = (Sample.load(path) for path in stored)
    return [pixels_of_sample(sample, EVERY_PIXEL) for sample in samples if int(sample.posed.sum()) > 1]


@entry_point
def main() -> None:
    """Entry point."""
    arguments = parse_arguments()
    if arguments.scenes < LEFT_OUT:
        raise UserError(
            f"must be at least {LEFT_OUT}, is {arguments.scenes}", where="--scenes", fix="ask for more scenes"
        )
    pixels = collect(arguments.samples, arguments.scenes, arguments.seed)
    fitted = fit_confidence([pair for k, pair in enumerate(pixels) if k % LEFT_OUT])
    features, error = (np.concatenate(parts, axis=-1) for parts in zip(*pixels[::LEFT_OUT], strict=True))
    print(f"{len(pixels)} scenes, {len(FEATURES)} features; on {len(pixels[::LEFT_OUT])} scenes left out:")
    print("probability   right   share of pixels")
    for probability, right, share in calibration(fitted(features), np.abs(error) < RIGHT):
        print(f"{probability:11.3f}  {right:6.3f}  {share:16.3f}")
    write_bytes_atomic(arguments.out, (fitted.as_json()).encode())


if __name__ == "__main__":
    main()
