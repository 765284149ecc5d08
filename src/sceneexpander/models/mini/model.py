"""`Mini`: the embedded reconstructor. Geometry first, a small network for what geometry cannot see."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file
from sceneexpander.geometry.camera import camera_vector_from_pose, pose_from_camera_vector
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.normals import face_camera, viewing_rays
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.layers.family import set_views_per_chunk
from sceneexpander.models.mini.config import MiniConfig
from sceneexpander.models.mini.inputs import MeasuredPriors, PreparedViews, measure, prepare
from sceneexpander.models.mini.network import Features, MiniNetwork
from sceneexpander.models.mini.splats import covered_by_others, pixel_aligned_gaussians
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction
from sceneexpander.models.weights import load_weights, resolve_weights

SIZE_MULTIPLE = 14  # as WorldMirror's, so that either can be given the same images
_CONFIG_KEY = "mini_config"
_BASE_CONF_LOGIT = (1.1, 2.0)  # log(conf - 1) of the base: this, plus this where confident


class Mini(nn.Module):
    """Residuals of WorldMirror's building blocks on the cameras and the dense depth of the geometric front-end.

    With zero residuals (a new model) the prediction *is* the front-end's: its depth exactly, its cameras, the normals of
    its depth. The network works at a fixed internal resolution; residuals are upsampled to the size of the images.
    Priors (poses, intrinsics, depth, evidence) are required. The world frame is the first view's camera, and stays so.
    """

    name = "mini"
    size_multiple = SIZE_MULTIPLE
    requires_priors = True
    trunk_prefixes = ("network.stem.", "network.trunk.", "network.camera_token", "network.register_token")

    def __init__(self, config: MiniConfig | None = None) -> None:
        super().__init__()
        self.config = MiniConfig() if config is None else config
        self.network = MiniNetwork(self.config)

    def predict(
        self,
        images: Float[Tensor, "view 3 height width"],
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """Reconstruct S views, see `Reconstructor.predict`.

        Raises:
            ValueError: H or W is no multiple of ``size_multiple``, or priors are missing or do not fit.
        """
        views, _, height, width = images.shape
        prepared = self.prepare(images, self.measure(priors, views, height, width))
        return self.predict_prepared(prepared, heads=heads, generated=generated)

    @torch.no_grad()
    def measure(self, priors: Priors | None, views: int, height: int, width: int) -> MeasuredPriors:
        """See `PreparesInputs.measure`. Raises `ValueError` as `predict` does."""
        if height % self.size_multiple or width % self.size_multiple:
            raise ValueError(f"image size {height} x {width} is no multiple of {self.size_multiple}")
        return measure(priors, views, height, width, self.config)

    @torch.no_grad()
    def prepare(
        self,
        images: Float[Tensor, "view 3 height width"],
        measured: MeasuredPriors,
        grids: Sequence[Float[Tensor, "height width 2"] | None] = (),
    ) -> PreparedViews:
        """See `PreparesInputs.prepare`."""
        return prepare(images, measured, self.config, grids)

    def predict_prepared(
        self,
        prepared: PreparedViews,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """See `PreparesInputs.predict_prepared`."""
        images = prepared.images
        features = self.network.features(prepared.working)
        if features.dense.dtype != torch.float32:
            # Depth and normals are differences of large numbers: what follows the features stays in float32 under autocast.
            with torch.autocast(images.device.type, enabled=False):
                return self._from_features(features.float(), prepared, heads, generated)
        return self._from_features(features, prepared, heads, generated)

    def _from_features(
        self,
        features: Features,
        prepared: PreparedViews,
        heads: frozenset[Head],
        generated: Bool[Tensor, "view"] | None,
    ) -> Prediction:
        images, priors = prepared.images, prepared.priors
        views, _, height, width = images.shape
        camera_vector, world_from_cam, intrinsics = self._cameras(
            features.camera_tokens, priors, prepared.scale, height, width
        )
        cameras = Cameras(world_from_cam, intrinsics, height, width)
        wants_depth = bool(heads & {Head.DEPTH, Head.POINTS, Head.GAUSSIANS})
        wants_normals = bool(heads & {Head.NORMALS, Head.GAUSSIANS})
        depth = depth_conf = normals = normals_conf = points = None
        gaussian_depth = gaussians = None
        if wants_depth:
            depth, depth_conf = self._depth(self.network.depth_head(features.dense), priors)
        if wants_normals:
            raw = self.network.normals_head(features.dense)
            base = priors.base_normals.movedim(-1, 1)
            upsampled = _upsample(torch.cat([base + raw[:, :3], raw[:, 3:]], dim=1), height, width)
            rays = viewing_rays(intrinsics.detach(), height, width)
            normals = face_camera(upsampled[:, :3].movedim(1, -1), rays)
            normals_conf = 1 + upsampled[:, 3].clamp(max=10).exp()
        if depth is not None and Head.POINTS in heads:
            points = cameras.unproject(depth)
        if depth is not None and depth_conf is not None and normals is not None and Head.GAUSSIANS in heads:
            flags = torch.zeros(views, dtype=torch.bool, device=images.device) if generated is None else generated
            transparent = covered_by_others(
                depth,
                priors.confident,
                cameras,
                priors.posed,
                most_views=self.config.cross_views,
            )
            gaussians, gaussian_depth = pixel_aligned_gaussians(
                images,
                depth,
                depth_conf,
                normals,
                cameras,
                transparent,
                _upsample(self.network.gaussian_head(features.dense), height, width),
                flags,
                self.config,
            )
        asked_depth, asked_normals = Head.DEPTH in heads, Head.NORMALS in heads
        return Prediction(
            camera_vector=camera_vector,
            world_from_cam=world_from_cam,
            intrinsics_px=intrinsics,
            depth=depth if asked_depth else None,
            depth_conf=depth_conf if asked_depth else None,
            normals=normals if asked_normals else None,
            normals_conf=normals_conf if asked_normals else None,
            points=points,
            points_conf=depth_conf if points is not None else None,
            gaussian_depth=gaussian_depth,
            gaussians=gaussians,
        )

    def save_memory(self, *, checkpoint_activations: bool, views_per_chunk: int) -> None:
        """See `SavesMemory.save_memory`."""
        self.network.checkpoint_activations = checkpoint_activations
        set_views_per_chunk(self, views_per_chunk)

    @classmethod
    def from_weights(cls, weights: str | Path) -> Mini:
        """The model of a weights file: ``builtin`` (shipped with the package) or a path. Its configuration is in the file.

        Raises:
            UserError: missing or damaged file, not weights of `Mini`, or tensors that do not fit.
        """
        path = resolve_weights(str(weights), model=cls.name).path
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        try:
            config = MiniConfig.from_dict(json.loads(metadata[_CONFIG_KEY]))
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"holds no configuration of mini ({error})", where=path, fix="use weights that this version wrote"
            ) from None
        model = cls(config)
        load_weights(model, path)
        return model

    def save_weights(self, path: Path) -> None:
        """Write the weights in half precision with the configuration, atomically."""
        tensors = {name: value.detach().half().contiguous() for name, value in self.state_dict().items()}
        with complete_file(path) as scratch:
            save_file(tensors, scratch, {_CONFIG_KEY: json.dumps(self.config.to_dict())})

    def _cameras(
        self, tokens: Float[Tensor, "view dim"], priors: MeasuredPriors, scene_scale: float, height: int, width: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(camera vectors, world_from_cam, intrinsics): the priors, refined by the camera head in normalised scale."""
        poses = priors.world_from_cam
        scale = poses.new_ones(9)
        scale[:3] = scene_scale
        start = camera_vector_from_pose(poses, priors.intrinsics_px, height, width)
        refined = self.network.camera_head(tokens[None], (start / scale)[None])[-1][0] * scale
        # Adam moves every weight by about the learning rate, which adds up over the width of a linear layer: without this gain
        # one step of test-time adaptation would turn cameras by a degree, and bundle adjustment is better than that.
        vector = start + self.config.camera_gain * (refined - start)
        # The first view is the world: only its fields of view may change.
        pose_part = torch.cat([start[:1, :7], vector[1:, :7]])
        fov = vector[:, 7:].clamp(0.05, 3.0)
        vector = torch.cat([pose_part, fov], dim=-1)
        world_from_cam, _ = pose_from_camera_vector(vector, height, width)
        # The prior's principal point is kept; an unchanged field of view gives its focal length exactly.
        ratio = torch.tan(start[:, 7:].clamp(0.05, 3.0) / 2) / torch.tan(fov / 2)
        gain = torch.ones_like(priors.intrinsics_px)
        gain[:, 0, 0], gain[:, 1, 1] = ratio[:, 1], ratio[:, 0]
        return vector, world_from_cam, priors.intrinsics_px * gain

    def _depth(
        self, raw: Float[Tensor, "view 3 out_height out_width"], priors: MeasuredPriors
    ) -> tuple[Float[Tensor, "view height width"], Float[Tensor, "view height width"]]:
        """(depth, confidence): log depth = log base + (1 - pull x confident) x residual.

        The pull is the network's to judge: under wrong cameras a base can agree with itself and be wrong everywhere.
        """
        limit = self.config.max_log_residual
        residual, logit, pull = _upsample(raw, *priors.depth.shape[-2:]).unbind(1)
        free = 1 - torch.sigmoid(pull + _logit(self.config.confident_pull)) * priors.confident
        depth = priors.depth * (free * limit * torch.tanh(residual / limit)).exp()
        base_logit = _BASE_CONF_LOGIT[0] + _BASE_CONF_LOGIT[1] * priors.confident
        return depth, 1 + (base_logit + logit).clamp(max=10).exp()


def _logit(share: float) -> float:
    """The number whose sigmoid is ``share``."""
    return math.log(share / (1 - share))


def _upsample(maps: Float[Tensor, "view channel rows columns"], height: int, width: int) -> Tensor:
    return functional.interpolate(maps, size=(height, width), mode="bilinear", align_corners=False)
