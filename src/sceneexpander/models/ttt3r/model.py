"""TTT3R as a reconstructor: one pass over the views, the inserted one last."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import transform_points
from sceneexpander.models.derived import with_depth
from sceneexpander.models.layers.init import initialise_layers, materialise, normal_
from sceneexpander.models.layers.outputs import check_views
from sceneexpander.models.pixel_aligned import MIN_DEPTH
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction
from sceneexpander.models.ttt3r.cameras import (
    PlannedStep,
    chain_resets,
    intrinsics_from_points,
    plan_steps,
    world_from_camera_pose,
)
from sceneexpander.models.ttt3r.config import TTT3RConfig
from sceneexpander.models.ttt3r.heads import DenseMap
from sceneexpander.models.ttt3r.images import signed_rgb
from sceneexpander.models.ttt3r.network import RecurrentNetwork, StreamStep

TOKEN_STD = 0.02


class TTT3R(RecurrentNetwork):
    """CUT3R with the test-time rate, or with its own full update if the configuration says so (ttt3r spec 9).

    Views are read one after the other in the order given: a view has no influence on those before it, and an inserted view is
    simply the last time step. Known cameras and depths are not read. Geometry is the camera-frame pointmap placed by the predicted
    camera, as in the method's own demo.

    Args:
        config: sizes and update rule.
    """

    requires_priors = False

    def __init__(self, config: TTT3RConfig) -> None:
        super().__init__(config)
        self.name: str = config.update
        self.size_multiple = config.patch

    @classmethod
    def create(cls, config: TTT3RConfig, *, generator: torch.Generator) -> TTT3R:
        """A freshly initialised model whose numbers come from ``generator`` alone."""
        with torch.device("meta"):
            model = cls(config)
        materialise(model, device=generator.device)
        initialise_layers(model, generator=generator)
        tokens: list[Tensor] = [
            model.pose_token,
            model.masked_img_token,
            model.masked_ray_map_token,
            model.register_tokens.weight,
            model.pose_retriever.mem,
            model.pose_retriever.masked_token,
        ]
        for token in tokens:
            normal_(token, TOKEN_STD, generator=generator)
        return model

    def predict(
        self,
        images: Float[Tensor, "view 3 height width"],
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """See `Reconstructor.predict`; ``priors`` are ignored.

        Cameras need the camera-frame pointmap (for the focal length), so it is always computed; the world pointmap and the colours
        that the network could also give never are.

        Raises:
            UserError: if there is no view.
        """
        check_views(images)
        if not images.shape[0]:
            raise UserError("there are no views", where=self.name, fix="give at least one captured view")
        plan = plan_steps(images.shape[0], self.config.reset_every)
        poses, points_self, conf = self._read(images, plan)
        world_from_cam = chain_resets(world_from_camera_pose(poses), [step.reset for step in plan if step.kept])
        intrinsics = intrinsics_from_points(points_self)
        prediction = Prediction(
            camera_vector=camera_vector_from_pose(world_from_cam, intrinsics, *images.shape[-2:]),
            world_from_cam=world_from_cam,
            intrinsics_px=intrinsics,
        )
        if Head.POINTS in heads:
            points = transform_points(world_from_cam, points_self.flatten(1, 2)).view(points_self.shape)
            prediction = replace(prediction, points=points, points_conf=conf)
        depth = points_self[..., 2].clamp(min=MIN_DEPTH)
        return with_depth(prediction, depth, conf, images=images, heads=heads, generated=generated)

    def _read(
        self, images: Float[Tensor, "view 3 height width"], plan: list[PlannedStep]
    ) -> tuple[Float[Tensor, "view 7"], Float[Tensor, "view height width 3"], Float[Tensor, "view height width"]]:
        """(camera poses in their chunks, camera-frame points, confidence) of all views; only this is kept of a step."""
        steps = (StreamStep(image=signed_rgb(images[step.view][None]), reset=step.reset) for step in plan)
        poses, points, confidences = [], [], []
        for step, output in zip(plan, self.stream(steps, maps=frozenset({DenseMap.SELF})), strict=True):
            points_self, conf = output.maps.points_self, output.maps.conf_self
            if not step.kept or points_self is None or conf is None:
                continue
            poses.append(output.maps.camera_pose[0])
            points.append(points_self[0])
            confidences.append(conf[0])
        return torch.stack(poses), torch.stack(points), torch.stack(confidences)
