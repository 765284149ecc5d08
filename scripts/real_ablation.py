"""Rows of the ablation on scene folders without known truth: python scripts/real_ablation.py FOLDER ... --rows paper,default

A folder is as in ``scenes/`` (photos in captured/, a scene.yaml whose first round names an inserted picture). Prints one line per row and
seed: what preservation and insertion can be measured without truth. The pre-insertion scene and the baseline are always there.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet, save_png
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, entry_point
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.expansion import (
    MethodConfig,
    RoundInputs,
    captured_prediction,
    compose_procedure,
    initial_state,
    joint_reconstruction,
)
from sceneexpander.generation import GenerationContext, check_round
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest import load_scene
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.pipeline.project import find_project
from sceneexpander.reconstruction.loaded import load_model
from sceneexpander.splatting import render


def composed(row: str, overrides: list[str]) -> ProjectConfig:
    """The configuration of a row."""
    return parse_dataclass(ProjectConfig, compose(find_project() / "conf", [f"ablation={row}", *overrides]))


def line(name: str, reconstruction: Reconstruction, views: ViewSet) -> str:
    """The numbers of one row."""
    row = evaluate(reconstruction, views, EvaluateConfig(), scene="-", round_number=1, seed=0)
    shown = metrics_named("psnr_captured_db", "ssim_captured", "psnr_from_others_db", "psnr_inserted_db")
    numbers = "  ".join(f"{metric.title} {metric.text_with_unit(row.value(metric.name))}" for metric in shown)
    return f"{name:24s} {numbers}"


def pictures(reconstruction: Reconstruction, path: Path) -> None:
    """All views as the reconstruction shows them, in a row."""
    height, width = reconstruction.depth.shape[1:]
    shown = render(
        reconstruction.gaussians, Cameras(reconstruction.world_from_cam, reconstruction.intrinsics_px, height, width)
    )
    save_png(path, torch.cat(list(shown.rgb), dim=-1))


def run(folder: Path, rows: list[str], overrides: list[str], seeds: list[int], out: Path | None) -> None:
    """Print all lines of one scene."""
    config = composed("default", overrides)
    loaded = load_model(config.model, config.device)
    scene = load_scene(folder, config.scene)
    state, _, _, _ = initial_state(scene, loaded, config.frontend, config.warmup, seed=config.seed)
    anchors, captured = captured_prediction(state, loaded)
    context = GenerationContext(
        scene_folder=folder,
        scene=scene.name,
        round_number=1,
        spec=scene.round_spec(1),
        captured=state.views,
        cache=Path(".cache"),
    )
    _, inserted = check_round(context, config.generator, config.choose)
    if inserted is None:
        raise UserError("has no picture for round 1", where=folder, fix="record one in its scene.yaml")
    priors, backbone, _ = joint_reconstruction(state, inserted, loaded, config.frontend, seed=config.seed)
    inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    views = state.views.append(inserted.view)
    print(
        f"{scene.name}: {len(state.views)} photos of {views.height} x {views.width}, inserted view posed: {bool(backbone.posed[-1])}"
    )
    made: dict[str, Reconstruction] = {}
    for seed in seeds:  # of the adaptation and of the fit: lines of one seed differ in nothing but the row
        for name, reconstruction, shown in (("captured", captured, state.views), ("baseline", backbone, views)):
            made[name], _ = fit_to_views(reconstruction, shown, config.refine, seed=seed, device=config.device)
            print(line(f"{name} seed {seed}", made[name], views), flush=True)
        for row in rows:
            own = composed(row, overrides)
            method = MethodConfig(adapt=replace(own.adapt, checkpoint_every=0), corrections=own.corrections)
            # Fitted to the pictures that the round worked with, and measured on the ones that were given.
            made[row] = compose_procedure(method, own.refine).run(inputs, loaded, seed=seed).scene
            print(line(f"{row} seed {seed}", made[row], views), flush=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for name, reconstruction in made.items():
            pictures(reconstruction, out / f"{scene.name}-{name}.png")
        save_png(out / f"{scene.name}-photos.png", torch.cat(list(views.images), dim=-1))


@entry_point
def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--rows", default="paper,default")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--set", default=[], action="append", metavar="KEY=VALUE", help="configuration override")
    parser.add_argument("--out", type=Path, help="folder for pictures")
    options = parser.parse_intermixed_args()
    rows = [row for row in options.rows.split(",") if row]
    for folder in options.folders:
        run(folder, rows, options.set, [int(seed) for seed in options.seeds.split(",")], options.out)


if __name__ == "__main__":
    main()
