"""Round 0: the state that the first insertion starts from."""

from __future__ import annotations

from collections.abc import Callable

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.frontend.sfm import SparseReconstruction
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.photometric.report import FitReport
from sceneexpander.photometric.warmup import warm_up
from sceneexpander.reconstruction.cameras import announce_cameras, report_cameras, straighten_views
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.views import device_priors, reconstruct, views_priors


def initial_state(
    scene: Scene,
    loaded: LoadedModel,
    frontend: FrontendConfig,
    warmup: WarmupConfig,
    *,
    seed: int,
    on_step: Callable[[int, float], None] | None = None,
    memory: MatchMemory | None = None,
) -> tuple[ExpansionState, Reconstruction, SparseReconstruction | None, FitReport | None]:
    """Round 0: the captured views, their geometry, theta_0 (after the optional warm-up), and what the model makes of them.

    The state's views are pinhole pictures: what the lens bent is straightened, here and for all that follows.
    ``memory`` learns the photos' keypoints and matches.
    """
    priors, sparse = views_priors(scene.views, loaded, frontend, seed=seed, known=scene.known, memory=memory)
    views = scene.views
    if sparse is not None:
        views = straighten_views(views, sparse)
        announce_cameras(report_cameras(views, sparse), strict=frontend.strict)
    loaded.reset()
    report = warm_up(
        loaded.model,
        views.images.to(loaded.device),
        device_priors(priors, loaded),
        warmup,
        seed=seed,
        on_step=on_step,
    )
    weights = WeightsChange.between(loaded.base, loaded.state())
    state = ExpansionState(views=views, priors=priors, weights=weights, known=scene.known)
    return state, reconstruct(state.views, priors, loaded, weights, method="captured"), sparse, report
