"""What the fit of the Gaussians does to photos it sees and to one it does not: python scripts/refinement_check.py FOLDER ...

A folder is as in ``scenes/``. Each photo in turn (or those of ``--hold-out``, by name) is held out: its own Gaussians are removed, the
others are fitted to the other photos, and what they show at the held-out camera is compared with the held-out photo, at the stored size
and in the photo's own pixels, over the pixels that are covered before the fit and after it: the fit closes surfaces, and what it covers
in addition is not what was easy to show. Cameras and depth are those of all photos, so this measures the fit alone. With ``--optimise``
per-scene 3DGS (the section ``optimise``) goes on from the fitted scene, as its baseline in the pipeline does, and is compared on the same
pixels.
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
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest import load_scene
from sceneexpander.optimisation.optimise import optimise
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


def shown(views: ViewSet, view: int, *scenes: Reconstruction, own_pixels: bool = False) -> tuple[float, list[float]]:
    """The share of a photo's pixels that every scene covers, and each scene's PSNR over them, at the stored size or in the photo's pixels.

    Colours are divided by alpha: what is compared is what is there, not the black behind it.
    """
    photo = views.photo(view) if own_pixels else views.images[view]
    height, width = photo.shape[1:]
    seen = []
    for scene in scenes:
        lens = resize_intrinsics(scene.intrinsics_px[view], width / views.width, height / views.height)
        seen.append(render(scene.gaussians, Cameras(scene.world_from_cam[view][None], lens[None], height, width)))
    covered = torch.stack([found.alpha[0] > COVERED for found in seen]).all(0)
    colours = [found.rgb[0] / found.alpha[0].clamp(min=COVERED) for found in seen]
    return float(covered.double().mean()), [psnr(colour, photo, covered) for colour in colours]


def check(folder: Path, config: ProjectConfig, names: list[str] | None, *, with_3dgs: bool) -> None:
    """Print a line per scene and two lines per held-out photo."""
    scene = load_scene(folder, config.scene)
    loaded = load_model(config.model, config.device)
    state, start, _, _ = initial_state(scene, loaded, config.frontend, config.warmup, seed=config.seed)
    views = state.views
    posed = start.posed.nonzero()[:, 0].tolist()
    result, _ = refine(start, views.images, config.refine, photos=views.photos, seed=config.seed)
    before, after = (
        sum(found) / len(posed) for found in zip(*(shown(views, v, start, result)[1] for v in posed), strict=True)
    )
    print(f"{scene.name}: {len(posed)} photos, {len(start.gaussians)} Gaussians, fitted {before:.2f} -> {after:.2f} dB")
    for name, reconstruction in (("before", start), ("after", result)):
        own, open_share = at_photo_size(reconstruction, views, posed)
        print(f"  {name}, in the photos' own pixels: {own:.2f} dB, {100 * open_share:.1f} % open", flush=True)
    for view in posed:
        name = views.records[view].name
        if names is not None and name not in names:
            continue
        scenes = held_out(start, views, view, config, with_3dgs=with_3dgs)
        for size in (False, True):
            share, found = shown(views, view, *scenes.values(), own_pixels=size)
            told = ", ".join(f"{title} {value:.2f}" for title, value in zip(scenes, found, strict=True))
            where = "in its own pixels" if size else "at the stored size"
            print(f"  without {name}, {where}: {told} dB on {100 * share:.0f} % of it", flush=True)


def held_out(
    start: Reconstruction, views: ViewSet, view: int, config: ProjectConfig, *, with_3dgs: bool
) -> dict[str, Reconstruction]:
    """Scenes that a photo took no part in, by what was done: nothing, the fit, and 3DGS after it."""
    posed = start.posed.clone()
    posed[view] = False
    gaussians = start.gaussians.select(start.gaussians.source_view != view)
    without = replace(start, gaussians=gaussians, posed=posed)
    fitted, _ = refine(without, views.images, config.refine, photos=views.photos, seed=config.seed)
    scenes = {"before": without, "fitted": fitted}
    if with_3dgs:
        scenes["3DGS"] = optimise(
            fitted,
            views.images,
            config.optimise,
            photos=views.photos,
            valid=views.valid,
            method="3dgs",
            seed=config.seed,
        ).reconstruction
    return scenes


@entry_point
def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--hold-out", nargs="*", metavar="PHOTO", help="names of photos; default: each in turn")
    parser.add_argument("--optimise", action="store_true", help="3DGS too")
    parser.add_argument("--set", default=[], action="append", metavar="KEY=VALUE", help="configuration override")
    options = parser.parse_intermixed_args()
    config = parse_dataclass(ProjectConfig, compose(find_project() / "conf", options.set))
    for folder in options.folders:
        check(folder, config, options.hold_out, with_3dgs=options.optimise)


if __name__ == "__main__":
    main()
