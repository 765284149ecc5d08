"""What the stages that obtain a round's picture start from."""

from __future__ import annotations

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.generation import GenerationContext, SceneSoFar
from sceneexpander.pipeline.project import GENERATED_FOLDER
from stages import layout
from stages.runner import Cell, project_root


def generation_context(cell: Cell) -> GenerationContext:
    """The round as it is known before anything runs."""
    asked = layout.asked(cell.scene, cell.round)
    scene = Scene.load(layout.prepared(cell.scene))
    return GenerationContext(
        scene_folder=layout.source(cell.scene),
        scene=cell.scene,
        round_number=cell.round,
        spec=RoundSpec.load(asked),
        captured=scene.views,
        cache=project_root() / GENERATED_FOLDER,
        recorded=asked / layout.RECORDED,
    )


def scene_so_far(cell: Cell) -> SceneSoFar:
    """The views before the round, and what was reconstructed of them, its Gaussians fitted to them."""
    state = ExpansionState.load(layout.state(cell.scene, cell.previous))
    reconstruction = Reconstruction.load(layout.reconstruction(cell.scene, cell.round, "captured"))
    return SceneSoFar(views=state.views, reconstruction=reconstruction, known=state.known)
