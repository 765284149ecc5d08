"""What the fit of the Gaussians does to photos it sees and to one it does not: python scripts/refinement_check.py FOLDER ...

A folder is as in ``scenes/``. Each photo in turn is held out: its own Gaussians are removed, the others are fitted to the other photos, and
what they show at the held-out camera is compared with the held-out photo where they cover it. Cameras and depth are those of all
photos, so this measures the fit alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import entry_point
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.sizes import at_sizes
from sceneexpander.expansion import initial_state
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest import load_scene
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.refine import refine
from sceneexpander.pipeline.project import find_project
from sceneexpander.reconstruction.loaded import load_model
from sceneexpander.splatting import render

COVERED = 0.5  # alpha from which on a pixel counts


def at_photo_size(reconstruction: Reconstruction, views: ViewSet, posed: list[int]) -> tuple[float, float]:
    """(mean PSNR, mean open share) of the photos in their own pixels."""
    config = EvaluateConfig(st_lpips=False)
    found = [at_sizes(reconstruction, view, views.photo(view), None, config, ("own",))["own"] for view in posed]
    return sum(size.psnr_db or 0.0 for size in found) / len(found), sum(size.open_share for size in found) / len(found)


def shown(reconstruction: Reconstruction, views: ViewSet, view: int) -> float:
    """PSNR of one photo at the stored size over the pixels that are covered."""
    one = slice(view, view + 1)
    cameras = reconstruction.world_from_cam[one], reconstruction.intrinsics_px[one]
    seen = render(reconstruction.gaussians, Cameras(*cameras, views.height, views.width))
    return psnr(seen.rgb[0], views.images[view], seen.alpha[0] > COVERED)


def check(folder: Path, overrides: list[str]) -> None:
    """Print a line per scene and a line per held-out photo."""
    config = parse_dataclass(ProjectConfig, compose(find_project() / "conf", overrides))
    scene = load_scene(folder, config.scene)
    loaded = load_model(config.model, config.device)
    state, start, _, _ = initial_state(scene, loaded, config.frontend, config.warmup, seed=config.seed)
    views, settings = state.views, config.refine
    posed = start.posed.nonzero()[:, 0].tolist()
    result, _ = refine(start, views.images, settings, photos=views.photos, seed=config.seed)
    before, after = (sum(shown(r, views, v) for v in posed) / len(posed) for r in (start, result))
    print(f"{scene.name}: {len(posed)} photos, {len(start.gaussians)} Gaussians, fitted {before:.2f} -> {after:.2f} dB")
    for name, reconstruction in (("before", start), ("after", result)):
        own, open_share = at_photo_size(reconstruction, views, posed)
        print(f"  {name}, in the photos' own pixels: {own:.2f} dB, {100 * open_share:.1f} % open")
    changes = []
    for view in posed:
        before, after = held_out(start, views, view, settings, seed=config.seed)
        changes.append(after - before)
        print(f"  without {views.records[view].name}: {before:.2f} -> {after:.2f} dB", flush=True)
    print(f"  held out, mean: {sum(changes) / len(changes):+.2f} dB", flush=True)


def held_out(
    start: Reconstruction, views: ViewSet, view: int, config: RefineConfig, *, seed: int
) -> tuple[float, float]:
    """PSNR of a photo that took no part, before and after."""
    without = replace(start, gaussians=start.gaussians.select(start.gaussians.source_view != view))
    weights = torch.ones_like(start.depth)
    weights[view] = 0
    fitted, _ = refine(without, views.images, config, photos=views.photos, weights=weights, seed=seed)
    return shown(without, views, view), shown(fitted, views, view)


@entry_point
def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--set", default=[], action="append", metavar="KEY=VALUE", help="configuration override")
    options = parser.parse_args()
    for folder in options.folders:
        check(folder, options.set)


if __name__ == "__main__":
    main()
