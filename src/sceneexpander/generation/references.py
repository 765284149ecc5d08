"""Which views an image service is shown, and as what."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.views import ViewSet, to_uint8
from sceneexpander.errors import UserError
from sceneexpander.generation.motion import parse_motion
from sceneexpander.generation.prompt import split_words
from sceneexpander.generation.protocol import GenerationContext, SceneSoFar
from sceneexpander.generation.start import CENTRAL, gaze_distance, moved_camera, start_view, view_distances
from sceneexpander.services.pictures import encode_picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """One view as it is sent. ``pixels_sha256`` is that of the pixels, which do not change with the encoder."""

    view_id: str
    png: bytes
    pixels_sha256: str
    record_sha256: str


def choose_references(
    context: GenerationContext, so_far: SceneSoFar, *, limit: int, long_side_px: int
) -> tuple[Reference, ...]:
    """The views nearest to where the round's motion leads (without a motion: to the photo in the middle), the nearest one first.

    Photos are sent as they were prepared: what is estimated about their lenses later must not make another request of the same one.
    """
    scene = so_far.reconstruction
    try:
        start = start_view(so_far, CENTRAL)
        target = scene.world_from_cam[start]
        motion, _ = split_words(context.spec)
        target = moved_camera(so_far, parse_motion(motion, where=""), start, where="")
    except UserError:
        # Words that only a service understands, or metres that nobody knows: then the middle is as good as any place.
        if not bool((scene.posed & ~scene.generated).any()):
            return tuple(
                _encoded(context, so_far.views, index, long_side_px) for index in range(min(limit, len(so_far.views)))
            )
        target = scene.world_from_cam[start]
    posed = scene.posed.nonzero()[:, 0]
    apart = view_distances(target[None], scene.world_from_cam[posed], scale=gaze_distance(so_far, start))[0]
    nearest = [int(posed[index]) for index in apart.argsort(stable=True)[:limit].tolist()]
    return tuple(_encoded(context, so_far.views, index, long_side_px) for index in nearest)


def _encoded(context: GenerationContext, views: ViewSet, index: int, long_side_px: int) -> Reference:
    view_id, source = views.view_ids[index], views
    if view_id in context.captured.view_ids:
        source, index = context.captured, context.captured.view_ids.index(view_id)
    sent = encode_picture(to_uint8(source.photo(index)), long_side_px=long_side_px)
    return Reference(
        view_id=view_id,
        png=sent.png,
        pixels_sha256=sent.pixels_sha256,
        record_sha256=source.records[index].sha256,
    )
