"""What the files of views say of their lenses, as the front-end takes it."""

from __future__ import annotations

from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.frontend.lenses import ViewOptics


def optics_of(views: ViewSet) -> tuple[ViewOptics, ...]:
    """Per view how its stored picture lies on the original, and what its file says of the lens."""
    return tuple(_optics(record) for record in views.records)


def _optics(record: ViewRecord) -> ViewOptics:
    said, lens, focal_px = record.lens, "", None
    if said is not None and not record.generated:
        focal_px = said.focal_px
        long_side = max(record.original_height, record.original_width)
        # Photos of one lens at two zooms are not of one focal; two digits leave room for rounding in the files.
        ratio = "" if focal_px is None else f"{focal_px / long_side:.2f}"
        millimetres = "" if said.focal_mm is None else f"{said.focal_mm:.1f} mm"
        lens = " ".join(part for part in (said.camera, said.lens, millimetres, ratio) if part)
    return ViewOptics(
        original_size=(record.original_height, record.original_width),
        image_from_original=record.stored_from_original,
        lens=lens,
        focal_px=focal_px,
        generated=record.generated,
    )
