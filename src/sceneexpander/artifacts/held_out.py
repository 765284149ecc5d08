"""Photos that nothing is made from: what results are measured on that no method has seen."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, refusing, require_tensor, save_artifact
from sceneexpander.artifacts.views import ViewSet

SCHEMA = "held-out/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class TiePoints:
    """Where a held-out photo and a captured one show the same points, in stored pixels of pinhole pictures."""

    held_out: str  # view ids
    captured: str
    held_out_xy: Float[Tensor, "match 2"]
    captured_xy: Float[Tensor, "match 2"]

    def __post_init__(self) -> None:
        for xy in (self.held_out_xy, self.captured_xy):
            if xy.ndim != 2 or xy.shape != (len(self.held_out_xy), 2) or not torch.isfinite(xy).all():
                raise ValueError(f"tie points of {self.held_out} and {self.captured} are {tuple(xy.shape)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """Held-out photos, made by ``prepare``; ``match_held_out`` adds what ties them to the captured ones.

    Attributes:
        views: the photos; None: none was held out.
        given: ids of the scene's photos, captured or held out, whose poses came with them.
        given_world_from_cam: those poses, in the capture's own world and unit (double precision).
        lens_of: per held-out photo the id of a captured one that the same lens took; empty: none.
        ties: matches with captured photos.
    """

    views: ViewSet | None = None
    given: tuple[str, ...] = ()
    given_world_from_cam: Float[Tensor, "given 4 4"] | None = None
    lens_of: tuple[str, ...] = ()
    ties: tuple[TiePoints, ...] = ()

    def __post_init__(self) -> None:
        count = 0 if self.views is None else len(self.views)
        if self.lens_of and len(self.lens_of) != count:
            raise ValueError(f"{len(self.lens_of)} lenses for {count} held-out photos")
        poses = 0 if self.given_world_from_cam is None else len(self.given_world_from_cam)
        if poses != len(self.given):
            raise ValueError(f"{poses} given poses for {len(self.given)} photos")

    def __len__(self) -> int:
        return 0 if self.views is None else len(self.views)

    def ties_of(self, view_id: str) -> tuple[TiePoints, ...]:
        """Matches of one held-out photo."""
        return tuple(tie for tie in self.ties if tie.held_out == view_id)

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        if self.views is not None:
            self.views.save(folder / "views")
        tensors = {} if self.given_world_from_cam is None else {"given": self.given_world_from_cam}
        for number, tie in enumerate(self.ties):
            tensors |= {f"{number}.held_out_xy": tie.held_out_xy, f"{number}.captured_xy": tie.captured_xy}
        facts = _Facts(
            any=self.views is not None,
            given=self.given,
            lens_of=self.lens_of,
            pairs=tuple((tie.held_out, tie.captured) for tie in self.ties),
        )
        save_artifact(folder, SCHEMA, {f.name: getattr(facts, f.name) for f in fields(facts)}, tensors)

    @classmethod
    def load(cls, folder: Path) -> HeldOut:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        content, tensors = load_artifact(folder, SCHEMA)
        facts = read_typed(_Facts, content, folder / FACTS_NAME)
        with refusing(folder):
            return cls(
                views=ViewSet.load(folder / "views") if facts.any else None,
                given=facts.given,
                given_world_from_cam=require_tensor(tensors, "given", folder) if facts.given else None,
                lens_of=facts.lens_of,
                ties=tuple(
                    TiePoints(
                        held_out=held_out,
                        captured=captured,
                        held_out_xy=require_tensor(tensors, f"{number}.held_out_xy", folder),
                        captured_xy=require_tensor(tensors, f"{number}.captured_xy", folder),
                    )
                    for number, (held_out, captured) in enumerate(facts.pairs)
                ),
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """What is not a tensor or an artefact of its own."""

    any: bool
    given: tuple[str, ...]
    lens_of: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
