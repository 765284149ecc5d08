"""The bundled photos with cameras that are told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.scene import KnownCameras, Scene
from sceneexpander.generation import ChoiceConfig, GenerationContext, check_round
from sceneexpander.generation.backends.stored import ReplayConfig
from sceneexpander.ingest import IngestConfig, load_scene

COURTYARD = Path(__file__).parents[2] / "scenes" / "courtyard"


PHOTOS = 3


def scene_folder(folder: Path, **save: Any) -> Path:
    """The first photos of the bundled scene and its inserted picture."""
    (folder / "captured").mkdir(parents=True)
    for path in sorted((COURTYARD / "captured").glob("*.jpg"))[:PHOTOS]:
        with Image.open(path) as picture:
            picture.save(folder / "captured" / path.name, quality=95, **save)
    with Image.open(COURTYARD / "inserted" / "round_1.png") as picture:
        picture.save(folder / "new.png")
    (folder / "scene.yaml").write_text('rounds:\n  - prompt: "A bench."\n    inserted: new.png\n')
    return folder


def read(folder: Path) -> tuple[Scene, InsertedView]:
    scene = load_scene(folder, IngestConfig(long_side_px=224, detail_scale=2))
    context = GenerationContext(
        scene_folder=folder,
        scene="s",
        round_number=1,
        spec=scene.round_spec(1),
        captured=scene.views,
        cache=folder / "cache",
    )
    _, inserted = check_round(context, ReplayConfig(), ChoiceConfig())
    assert inserted is not None
    return scene, inserted


def known_cameras(scene: Scene) -> KnownCameras:
    """The truth of the photos, in stored pixels."""
    truth = json.loads((COURTYARD / "truth" / "cameras.json").read_text())
    poses = {Path(view["file"]).name: view["world_from_cam"] for view in truth["captured"]}
    world_from_cam = torch.tensor([poses[record.name] for record in scene.views.records], dtype=torch.float32)
    stored = []
    for record in scene.views.records:
        affine = torch.cat([torch.tensor(record.stored_from_original), torch.tensor([[0.0, 0.0, 1.0]])])
        stored.append(affine @ torch.tensor(truth["intrinsics_px"], dtype=torch.float32))
    return KnownCameras(world_from_cam=world_from_cam, intrinsics_px=torch.stack(stored))
