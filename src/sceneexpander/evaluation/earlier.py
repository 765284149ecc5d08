"""What a round leaves of the regions that were there before it: the captured views and those inserted in earlier rounds."""

from __future__ import annotations

import torch

from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.measure import Measure, Subject, Values
from sceneexpander.evaluation.sizes import PSNR_CAP_DB
from sceneexpander.evaluation.views import see_view


class EarlierRegions(Measure):
    """Views that are older than the round, at their own cameras and the stored size, against their pictures.

    The mean over those inserted in earlier rounds, and the worst of all of them; views without a camera take no part.
    """

    metrics = metrics_named("psnr_earlier_inserted_db", "psnr_worst_earlier_db")

    @torch.no_grad()
    def of_scene(self, subject: Subject) -> Values:
        """Nothing inserted earlier in a first round."""
        made, records = subject.reconstruction, subject.views.records
        place_of = {record.view_id: place for place, record in enumerate(records)}
        captured: list[float] = []
        inserted: list[float] = []
        for index, view_id in enumerate(made.view_ids):
            place = place_of[view_id]
            generated = bool(made.generated[index])
            if not bool(made.posed[index]) or (generated and records[place].round >= subject.round_number):
                continue
            view = see_view(made, index, subject.views, place, subject.config)
            value = min(psnr(view.render.rgb[0], view.picture, view.valid), PSNR_CAP_DB)
            (inserted if generated else captured).append(value)
        return {
            "psnr_earlier_inserted_db": sum(inserted) / len(inserted) if inserted else None,
            "psnr_worst_earlier_db": min((*captured, *inserted), default=None),
        }
