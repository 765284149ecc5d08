"""What a round leaves of the regions that were there before it: the captured views and those inserted in earlier rounds."""

from __future__ import annotations

from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.measure import Measure, Subject, Values, shows_enough


class EarlierRegions(Measure):
    """Views that are older than the round, at their own cameras and the stored size, against their pictures.

    The mean over those inserted in earlier rounds, and the worst of all of them; views without a camera take no part.
    """

    metrics = metrics_named("psnr_earlier_inserted_db", "psnr_worst_earlier_db")

    def of_scene(self, subject: Subject) -> Values:
        """Nothing inserted earlier in a first round."""
        made = subject.reconstruction
        round_of = {record.view_id: record.round for record in subject.views.records}
        captured: list[float] = []
        inserted: list[float] = []
        for view in subject.seen:
            later = round_of[made.view_ids[view.index]] >= subject.round_number
            if not bool(made.posed[view.index]) or (view.generated and later) or not shows_enough(view):
                continue
            value = view.likeness.psnr_db
            (inserted if view.generated else captured).append(value)
        return {
            "psnr_earlier_inserted_db": sum(inserted) / len(inserted) if inserted else None,
            "psnr_worst_earlier_db": min((*captured, *inserted), default=None),
        }
