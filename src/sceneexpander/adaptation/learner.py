"""Student and teacher of an adaptation, and what a step computes with them."""

from __future__ import annotations

import torch
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, InsertedWeights
from sceneexpander.adaptation.engine import autocast, set_up
from sceneexpander.adaptation.inputs import StepViews, geometry_of, heads_of
from sceneexpander.adaptation.ledger import WeightLedger, teacher_of
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.objective import StepLosses, anchor_targets, step_losses
from sceneexpander.adaptation.pixel_weights import inserted_weights
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.models.protocol import Reconstructor, as_module


class Learner:
    """Student, teacher and the ledger of their weights: what a step computes, once its views are there."""

    def __init__(
        self,
        model: Reconstructor,
        anchors: ViewGeometry,
        config: AdaptConfig,
        *,
        seed: int,
        bucket_elements: int | None = None,
    ) -> None:
        self.model, self.anchors, self.config = model, anchors, config
        self.device = anchors.depth.device
        self.teacher: Reconstructor = teacher_of(model)
        for one in (model, self.teacher):
            set_up(one, config)
        self.ledger = WeightLedger(
            as_module(model), as_module(self.teacher), config, seed=seed, bucket_elements=bucket_elements
        )

    def losses(self, views: StepViews, batch: Batch) -> StepLosses:
        """Teacher and student on the views of a batch, and the terms that hold the student to teacher and anchors."""
        # First the teacher: its activations are gone when the student's, which are kept, are made.
        teacher, weights = self._teach(views, batch.captured) if batch.inserted else (None, None)
        with autocast(self.config, self.device):
            student = geometry_of(views.predict(self.model, heads_of(self.config)))
        targets = anchor_targets(self.anchors, batch, views.grids, student, self.config)
        return step_losses(student, targets, teacher, self.config, weights)

    def _teach(self, views: StepViews, captured: tuple[int, ...]) -> tuple[ViewGeometry, Tensor | None]:
        """The EMA teacher's prediction of the inserted view, from the step's very views, and how its pixels count (None: alike)."""
        with torch.inference_mode(), autocast(self.config, self.device):
            prediction = views.predict(self.teacher)
            taught = geometry_of(prediction).view(len(captured))
            weights = None
            if self.config.inserted_weights is InsertedWeights.CONSISTENT:
                weights = inserted_weights(prediction, self.anchors.depth[list(captured)])
        # As ordinary tensors, which a loss may keep.
        return taught.clone(), None if weights is None else weights.clone()
