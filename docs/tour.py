"""SceneExpander as a library: the bundled scene, expanded by its inserted picture. ``python docs/tour.py FOLDER [key=value ...]``

At the scale of the profile ``smoke`` it takes a minute or two and nothing looks good; ``profile=cpu`` is the real thing.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import save_png
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.expansion import (
    MethodConfig,
    RoundInputs,
    captured_prediction,
    compose_procedure,
    initial_state,
    joint_reconstruction,
    load_model,
)
from sceneexpander.generation import GenerationContext, check_round
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest import load_scene
from sceneexpander.splatting import render
from sceneexpander.splatting.ply import write_ply

ROOT = Path(__file__).resolve().parents[1]
COURTYARD = ROOT / "scenes" / "courtyard"


def expand_courtyard(overrides: Sequence[str]) -> tuple[Reconstruction, Reconstruction]:
    """The scene with the inserted view as one more photo, and expanded by SceneExpander."""
    config = parse_dataclass(ProjectConfig, compose(ROOT / "conf", overrides))
    loaded = load_model(config.model, config.device)

    # The captured photos: cameras, depth, and what the frozen weights predict (the anchors of Algorithm 1).
    scene = load_scene(COURTYARD, config.scene)
    state, _, _, _ = initial_state(scene, loaded, config.frontend, config.warmup, seed=config.seed)
    anchors, _ = captured_prediction(state, loaded)

    # The picture beyond them, and where its camera is.
    request = GenerationContext(
        scene_folder=COURTYARD,
        scene=scene.name,
        round_number=1,
        spec=scene.round_spec(1),
        captured=state.views,
        cache=ROOT / ".cache",
    )
    _, inserted = check_round(request, config.generator, config.choose)
    if inserted is None:
        raise RuntimeError("the bundled scene brings its picture")
    priors, backbone, _ = joint_reconstruction(state, inserted, loaded, config.frontend, seed=config.seed)

    # Algorithm 1 between its corrections, then the fit of the Gaussians to the pictures.
    inputs = RoundInputs(state=state, inserted=inserted, anchors=anchors, joint_priors=priors)
    method = MethodConfig(adapt=config.adapt, corrections=config.corrections)
    expanded = compose_procedure(method, config.refine).run(inputs, loaded, seed=config.seed)
    return backbone, expanded.scene


def main(folder: Path, overrides: Sequence[str]) -> None:
    """Write the Gaussians and what every camera sees of them."""
    backbone, expanded = expand_courtyard(overrides)
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(expanded.gaussians, folder / "gaussians.ply")
    for name, scene in (("backbone", backbone), ("expanded", expanded)):
        height, width = scene.depth.shape[1:]
        with torch.no_grad():
            seen = render(scene.gaussians, Cameras(scene.world_from_cam, scene.intrinsics_px, height, width))
        for view, image in zip(scene.view_ids, seen.rgb, strict=True):
            save_png(folder / f"{name}_{view}.png", image.clamp(0, 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or ["profile=smoke"])
