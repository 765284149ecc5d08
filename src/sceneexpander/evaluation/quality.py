"""Whether a scene is fit to go on from after a round: rounds build on each other, so what is broken stays broken."""

from __future__ import annotations

from sceneexpander.artifacts.metrics import MetricsRow

LARGEST_LOSS_DB = 3.0  # of an earlier region's PSNR in one round; set by hand
_EARLIER = {"psnr_captured_db": "the captured views", "psnr_earlier_inserted_db": "the views inserted earlier"}


def find_failures(row: MetricsRow, before: MetricsRow | None, inserted_id: str) -> tuple[str, ...]:
    """Why no round should follow this one; empty: nothing speaks against it.

    A round fails when its inserted view has no camera, or when the captured views, or those inserted in earlier rounds, render more than
    `LARGEST_LOSS_DB` worse than before it.

    Args:
        row: of the adapted scene after the round.
        before: of the scene before it, measured alike; None if it was not.
        inserted_id: the view inserted in it.
    """
    found = []
    if any(view.view_id == inserted_id and not view.posed for view in row.views):
        found.append("no camera could be estimated for its inserted view")
    for name, what in _EARLIER.items():
        now = row.value(name)
        then = None if before is None else before.value(name)
        if now is not None and then is not None and then - now > LARGEST_LOSS_DB:
            found.append(f"{what} lost {then - now:.1f} dB (at most {LARGEST_LOSS_DB:g} are allowed)")
    return tuple(found)
