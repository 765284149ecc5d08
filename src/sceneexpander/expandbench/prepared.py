"""Everything about a scene and a grade that no row of the table changes: made once, kept, shared by rows and seeds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.state import ExpansionState, load_priors, save_priors
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.expandbench.grades import Grade
from sceneexpander.expandbench.scenes import BenchScene
from sceneexpander.expansion import LoadedModel, RoundInputs, captured_prediction, initial_state
from sceneexpander.files import directory_being_written
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.geometry.gauge import in_gauge_of
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.similarity import Similarity, align_views
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.reconstruction.views import reconstruct, views_priors

SEED = 0  # of the front-end and the warm-up: the same estimate for every row and seed


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedScene:
    """The pre-insertion scene: theta_0, its anchors, and the reconstruction from the captured views alone, as predicted."""

    state: ExpansionState
    anchors: Anchors
    captured: Reconstruction


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedCase:
    """A scene with a view inserted: what a round starts from, the baseline as predicted, and the truth about all views."""

    inputs: RoundInputs
    backbone: Reconstruction
    truth: SceneTruth


def prepare_scene(
    scene: BenchScene,
    loaded: LoadedModel,
    frontend: FrontendConfig,
    warmup: WarmupConfig,
    cache: Path,
) -> PreparedScene:
    """The pre-insertion scene, from ``cache`` (a folder of this scene, model and configuration) if it is there."""
    folder = cache / "captured"
    if not folder.exists():
        whole = Scene(name=scene.name, views=scene.captured, rounds=(RoundSpec(prompt="see more"),))
        state, _, _, _ = initial_state(whole, loaded, frontend, warmup, seed=SEED)
        anchors, reconstruction = captured_prediction(state, loaded)
        with directory_being_written(folder) as scratch:
            state.save(scratch / "state")
            anchors.save(scratch / "anchors")
            reconstruction.save(scratch / "reconstruction")
    return PreparedScene(
        state=ExpansionState.load(folder / "state"),
        anchors=Anchors.load(folder / "anchors"),
        captured=Reconstruction.load(folder / "reconstruction"),
    )


def prepare_case(
    scene: BenchScene,
    prepared: PreparedScene,
    grade: Grade,
    loaded: LoadedModel,
    frontend: FrontendConfig,
    cache: Path,
) -> PreparedCase:
    """The scene with a view of the given grade inserted, from ``cache`` (the scene's folder) if it is there."""
    view, truth = scene.insert(grade.misalignment)
    source = Provenance(backend="expandbench", prompt="", source=grade.name, sha256=view.records[0].sha256)
    inserted = InsertedView(round=1, view=view, chosen=0, provenance=(source,))
    folder = cache / grade.name
    if not folder.exists():
        views = prepared.state.views.append(view)
        known = _intended_cameras(scene, prepared) if grade.told else None  # the only truth that a method is ever given
        estimated, _ = views_priors(views, loaded, frontend, seed=SEED, known=known)
        priors = in_gauge_of(prepared.state.priors, estimated)
        backbone = reconstruct(views, priors, loaded, prepared.state.weights, method="backbone")
        with directory_being_written(folder) as scratch:
            save_priors(scratch / "priors", priors)
            backbone.save(scratch / "backbone")
    return PreparedCase(
        inputs=RoundInputs(
            state=prepared.state,
            inserted=inserted,
            anchors=prepared.anchors,
            joint_priors=load_priors(folder / "priors"),
        ),
        backbone=Reconstruction.load(folder / "backbone"),
        truth=truth,
    )


def _intended_cameras(scene: BenchScene, prepared: PreparedScene) -> KnownCameras:
    """The captured views' cameras as estimated, and the intended camera of the inserted view in their frame and scale."""
    priors = prepared.state.priors
    poses, intrinsics = _required(priors)
    placed = place_in(prepared.captured, scene, scene.intended.world_from_cam[None])
    return KnownCameras(
        world_from_cam=torch.cat([poses, placed.to(poses)]), intrinsics_px=torch.cat([intrinsics, intrinsics[:1]])
    )


def _required(priors: Priors) -> tuple[Tensor, Tensor]:
    if priors.world_from_cam is None or priors.intrinsics_px is None:
        raise ValueError("the benchmark needs a model that uses the geometric front-end")
    return priors.world_from_cam, priors.intrinsics_px


def placement_in(reconstruction: Reconstruction, scene: BenchScene) -> Similarity:
    """From the truth's frame and scale to a reconstruction's own: aligned on the captured views.

    Orientations and centres of the captured cameras that were estimated give the frame, the median ratio of their depths the scale.
    """
    truth = [scene.captured_truth[record.sha256] for record in scene.captured.records]
    depths = [torch.zeros_like(reconstruction.depth[0]) if t.depth is None else t.depth[1::2, 1::2] for t in truth]
    captured = len(truth)
    return align_views(
        torch.stack([t.world_from_cam for t in truth]),
        torch.stack(depths),
        reconstruction.world_from_cam[:captured].double(),
        reconstruction.depth[:captured],
        posed=reconstruction.posed[:captured],
    )


def place_in(
    reconstruction: Reconstruction, scene: BenchScene, world_from_cam: Float[Tensor, "view 4 4"]
) -> Float[Tensor, "view 4 4"]:
    """True camera poses where they stand in a reconstruction, see `placement_in`."""
    return placement_in(reconstruction, scene).poses(world_from_cam.double()).float()
