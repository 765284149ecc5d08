"""What every reconstructor is: images (+ optional priors) -> one typed prediction in one gauge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, Self, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import GaussianCounts, Gaussians
from sceneexpander.geometry.priors import Priors


class Head(StrEnum):
    """The outputs a caller can ask for; a reconstructor runs no head that nobody asked for."""

    CAMERA = "camera"
    DEPTH = "depth"
    NORMALS = "normals"
    POINTS = "points"
    GAUSSIANS = "gaussians"


ALL_HEADS = frozenset(Head)
GEOMETRY_HEADS = frozenset({Head.CAMERA, Head.DEPTH, Head.NORMALS})  # all that the paper's losses read


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Outputs of a reconstructor for S views of H x W pixels, all in one world frame and one scale.

    The world frame is approximately the first view's camera frame. Fields of heads that were not asked for are None.
    """

    camera_vector: Float[Tensor, "view 9"]  # cam_from_world t, quat xyzw, vertical fov, horizontal fov (rad)
    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    depth: Float[Tensor, "view height width"] | None = None  # z-depth, > 0
    depth_conf: Float[Tensor, "view height width"] | None = None  # > 1, larger is surer
    normals: Float[Tensor, "view height width 3"] | None = None  # camera frame, unit, facing the camera
    normals_conf: Float[Tensor, "view height width"] | None = None
    points: Float[Tensor, "view height width 3"] | None = None  # world frame
    points_conf: Float[Tensor, "view height width"] | None = None
    gaussian_depth: Float[Tensor, "view height width"] | None = None  # depth that placed the Gaussians
    gaussians: Gaussians | None = None  # after the model's own merge
    gaussian_counts: GaussianCounts | None = None  # None: one Gaussian per pixel, all kept

    def cameras_of(self, height: int, width: int) -> Cameras:
        """The cameras, for pictures of this size (that of the views)."""
        return Cameras(self.world_from_cam, self.intrinsics_px, height, width)


@runtime_checkable
class Reconstructor(Protocol):
    """A feed-forward reconstructor. Also an ``nn.Module`` (parameters, state_dict); numerics do not depend on train()/eval()."""

    name: str  # as tables print it
    size_multiple: int  # H and W must be multiples of this
    requires_priors: bool  # True: poses, intrinsics, depth and evidence of the geometric front-end are needed

    def predict(
        self,
        images: Float[Tensor, "view 3 height width"],
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """Reconstruct S views. RGB in [0, 1]. Differentiable in the parameters.

        Args:
            images: the views; the first one defines the world frame.
            priors: see `Priors`. A model that needs priors it does not get raises `ValueError`.
            heads: outputs to compute.
            generated: which views are generated, copied onto the Gaussians as provenance (default: none).
        """
        ...


class Measured(Protocol):
    """What a reconstructor makes of the priors of some views alone."""

    def select(self, views: Sequence[int]) -> Self:
        """Some of the views, in the given order; the first of them becomes the world frame."""
        ...


@runtime_checkable
class PreparesInputs(Protocol):
    """A reconstructor that measures its inputs before its network runs.

    What is measured does not depend on the weights: one preparation serves student and teacher, and one measurement of the
    priors serves every step. ``predict(images, priors)`` is the three in a row.
    """

    def measure(self, priors: Priors | None, views: int, height: int, width: int) -> Any:
        """A `Measured` of all views, once."""
        ...

    def prepare(
        self,
        images: Float[Tensor, "view 3 height width"],
        measured: Any,
        grids: Sequence[Float[Tensor, "height width 2"] | None] = (),
    ) -> Any:
        """The network's input for the views that ``measured`` holds.

        Args:
            images: their pictures, as they were measured.
            measured: of the priors.
            grids: how the first views are warped after that (see `geometry.lookup.warp_maps`; None: not): picture, depth and all that
                was measured per pixel move together, cameras stay.
        """
        ...

    def predict_prepared(
        self, prepared: Any, *, heads: frozenset[Head] = ALL_HEADS, generated: Bool[Tensor, "view"] | None = None
    ) -> Prediction:
        """As `Reconstructor.predict`, from a prepared input."""
        ...


@runtime_checkable
class SavesMemory(Protocol):
    """A reconstructor that can trade time for memory without changing its numbers."""

    def save_memory(self, *, checkpoint_activations: bool, views_per_chunk: int) -> None:
        """Choose how activations are kept.

        Args:
            checkpoint_activations: recompute them in the backward pass.
            views_per_chunk: views that a dense head works on at once; 0: the model's own choice.
        """
        ...


@runtime_checkable
class HasTrunk(Protocol):
    """A reconstructor that says which of its parameters come before the heads."""

    trunk_prefixes: tuple[str, ...]  # of their names


def as_module(model: object) -> nn.Module:
    """The same object, seen as the module it is."""
    if not isinstance(model, nn.Module):
        raise TypeError(f"{type(model).__name__} is not an nn.Module")
    return model
