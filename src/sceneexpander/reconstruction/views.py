"""Views given to the model as they are: what it is told about them, what it predicts, and the artefacts made of that."""

from __future__ import annotations

import logging
from dataclasses import fields, replace

import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.frontend.known_check import find_contradictions
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.prior import FrontendConfig, SettledCameras, build_priors
from sceneexpander.frontend.sfm import SparseReconstruction
from sceneexpander.geometry.gauge import in_gauge_of
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.inference.artefact import as_reconstruction
from sceneexpander.models.protocol import Prediction
from sceneexpander.reconstruction.cameras import announce_cameras, report_cameras
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.optics import known_of, optics_of

_log = logging.getLogger(__name__)


def views_priors(
    views: ViewSet,
    loaded: LoadedModel,
    frontend: FrontendConfig,
    *,
    seed: int,
    known: KnownCameras | None = None,
    memory: MatchMemory | None = None,
    settled: SettledCameras | None = None,
) -> tuple[Priors, SparseReconstruction | None]:
    """What the model is told about the views: the front-end's estimate; for a model that asks for none, what is ``known``.

    ``known`` cameras belong to the first views, see `known_of`; what the views' files say of their lenses is always told. Whatever is known
    is compared with the pictures first, and left out where they contradict it.
    ``memory`` spares it pictures and pairs that it has seen before, and learns those that it has not; ``settled`` cameras are kept.
    """
    known = known_of(views, known)
    if not loaded.uses_front_end:
        return (Priors() if known is None else _known_priors(views, known, frontend, seed=seed)), None
    if any(
        record.distortion != (0.0, 0.0) for record in views.records
    ):  # straightened before; what is left is nothing to look for
        frontend = replace(frontend, sfm=replace(frontend.sfm, distortion_rounds=0))
    return build_priors(
        views.images,
        frontend,
        generator=child_generator(seed, "frontend"),
        feature_images=views.detail_images,
        known_intrinsics_px=None if known is None else known.intrinsics_px,
        known_world_from_cam=None if known is None else known.world_from_cam,
        known_depth=None if known is None else known.depth,
        names=[record.name for record in views.records],
        optics=optics_of(views),
        valid=views.valid,
        memory=memory,
        settled=settled,
    )


def _settled_cameras(state: ExpansionState) -> SettledCameras | None:
    """Those of the views that earlier rounds inserted; None in the first round."""
    priors = state.priors
    if priors.world_from_cam is None or priors.intrinsics_px is None or not bool(state.views.generated.any()):
        return None
    posed = torch.ones_like(state.views.generated) if priors.posed is None else priors.posed
    return SettledCameras(
        world_from_cam=priors.world_from_cam,
        intrinsics_px=priors.intrinsics_px,
        posed=posed,
        kept=state.views.generated,
    )


def _known_priors(views: ViewSet, known: KnownCameras, frontend: FrontendConfig, *, seed: int) -> Priors:
    """Known cameras and depth as they are, in the frame of the first view that has a pose."""
    poses, intrinsics = known.world_from_cam, known.intrinsics_px
    contradictions = find_contradictions(
        views.images,
        frontend.sfm,
        generator=child_generator(seed, "known"),
        feature_images=views.detail_images,
        intrinsics_px=intrinsics,
        world_from_cam=poses,
        names=[record.name for record in views.records],
        valid=views.valid,
    )
    for note in contradictions.notes:
        _log.warning("%s", note)
    if contradictions.intrinsics:
        intrinsics = None
    posed = None
    if poses is not None:
        posed = torch.isfinite(poses).all(-1).all(-1) & ~contradictions.poses
        poses = torch.where(posed[:, None, None], poses, torch.eye(4).to(poses))
        if not bool(posed.any()):
            poses = posed = None
    return Priors(world_from_cam=poses, intrinsics_px=intrinsics, depth=known.depth, posed=posed)


@torch.no_grad()
def predict(views: ViewSet, priors: Priors, loaded: LoadedModel, weights: WeightsChange) -> Prediction:
    """All heads on the views, with the given weights."""
    loaded.apply(weights)
    return loaded.model.predict(
        views.images.to(loaded.device), device_priors(priors, loaded), generated=views.generated.to(loaded.device)
    )


def reconstruct(
    views: ViewSet, priors: Priors, loaded: LoadedModel, weights: WeightsChange, *, method: str
) -> Reconstruction:
    """A reconstruction artefact of the views."""
    return as_reconstruction(
        predict(views, priors, loaded, weights),
        views,
        # A model without the front-end predicts the cameras that it is not told.
        priors if loaded.uses_front_end else replace(priors, posed=None),
        method=method,
        model=loaded.model.name,
        weights_sha256=loaded.fingerprint(weights),
    )


def captured_prediction(state: ExpansionState, loaded: LoadedModel) -> tuple[Anchors, Reconstruction]:
    """Eq. (anchor_ref): what the model believed before the insertion; as anchors and as a reconstruction.

    The views of the state are all views so far: from round 2 on, those inserted before are anchored too (and stay marked as generated).
    """
    reconstruction = reconstruct(state.toned_views, state.priors, loaded, state.weights, method="captured")
    anchors = Anchors(
        weights_sha256=reconstruction.weights_sha256,
        view_ids=reconstruction.view_ids,
        camera_vector=reconstruction.camera_vector,
        depth=reconstruction.depth,
        depth_conf=reconstruction.depth_conf,
        normals=reconstruction.normals,
        normals_conf=reconstruction.normals_conf,
    )
    return anchors, reconstruction


def joint_reconstruction(
    state: ExpansionState,
    inserted: InsertedView,
    loaded: LoadedModel,
    frontend: FrontendConfig,
    *,
    seed: int,
    memory: MatchMemory | None = None,
) -> tuple[Priors, Reconstruction, SparseReconstruction | None]:
    """The baseline: the unadapted model given all views as they are, the inserted one last and treated like any other.

    In every round: its weights are those of round 0, and no picture is in another tone. The priors come back in the frame and scale of
    the state's, so that what was known before can be compared with them; the front-end's own findings are in their own scale.
    ``memory`` is that of round 0.
    """
    views = state.views.append(inserted.view)
    priors, sparse = views_priors(
        views, loaded, frontend, seed=seed, known=state.known, memory=memory, settled=_settled_cameras(state)
    )
    priors = in_gauge_of(state.priors, priors)
    if sparse is not None:
        announce_cameras(
            report_cameras(views, sparse), strict=False
        )  # a generated view may be left out: that is a result
    return priors, reconstruct(views, priors, loaded, state.unadapted, method="backbone"), sparse


def device_priors(priors: Priors, loaded: LoadedModel) -> Priors | None:
    """The priors where the model is; None for a model that is told nothing."""
    given = any(getattr(priors, field.name) is not None for field in fields(priors))
    return priors.to(loaded.device) if given else None
