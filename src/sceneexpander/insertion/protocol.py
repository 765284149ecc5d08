"""What a round starts from, and the three places of it where a correction may act (beyond the paper).

A correction is a frozen dataclass: its fields are its section of the configuration (``corrections.NAME``), switched off by default, and
its one method says where it acts. Switched off, it gives back what it was given.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.geometry.priors import Priors
from sceneexpander.insertion.report import CorrectionsReport
from sceneexpander.reconstruction.loaded import LoadedModel


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundInputs:
    """What a round starts from.

    ``joint_priors`` have the gauge of the state's (`in_gauge_of`). ``toned`` is the inserted view in the photos' tone, which the
    adaptation takes instead of the given one (None: as given); ``report`` says what corrections changed.
    """

    state: ExpansionState
    inserted: InsertedView
    anchors: Anchors
    joint_priors: Priors
    toned: ViewSet | None = None
    report: CorrectionsReport = field(default_factory=CorrectionsReport)

    @property
    def inserted_view(self) -> ViewSet:
        """The inserted view as the adaptation takes it."""
        return self.inserted.view if self.toned is None else self.toned

    @property
    def views(self) -> ViewSet:
        """All views as the adaptation takes them, the inserted one last."""
        return self.state.toned_views.append(self.inserted_view)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundContext:
    """What a correction works with.

    Attributes:
        loaded: the model; which weights it holds is not said, `predict` and `reconstruct` take them as an argument.
        seed: of the round; draw with `child_generator` and a name of your own.
        doubted: whether the round weighs generated pictures by what photos say of them, see `Contradiction`.
    """

    loaded: LoadedModel
    seed: int
    doubted: bool


@runtime_checkable
class InputsCorrection(Protocol):
    """Acts before Algorithm 1, on what the round starts from: cameras, pictures."""

    def correct_inputs(self, inputs: RoundInputs, context: RoundContext) -> RoundInputs:
        """The inputs that Algorithm 1 and everything after it take."""


@runtime_checkable
class WeightsCorrection(Protocol):
    """Acts after Algorithm 1, on the adapted weights. The round without steps leaves it out."""

    def correct_weights(self, weights: WeightsChange, inputs: RoundInputs, context: RoundContext) -> WeightsChange:
        """The weights that the scene is made with, and that the next round starts from."""


@runtime_checkable
class SceneCorrection(Protocol):
    """Acts on the expanded scene, before its Gaussians are fitted to the pictures."""

    def correct_scene(self, scene: Reconstruction, inputs: RoundInputs, context: RoundContext) -> Reconstruction:
        """The scene with other Gaussians; its views are ``inputs.views``, in order."""


Correction = InputsCorrection | WeightsCorrection | SceneCorrection
