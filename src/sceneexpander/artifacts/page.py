"""What is shown of one scene, gathered in one folder: the facts behind the report and the tracked runs.

Places of files are relative to the folder. Pictures and videos lie beside the facts.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.artifacts.cameras import CameraReport
from sceneexpander.artifacts.proposals import Proposals
from sceneexpander.artifacts.store import ArtifactError, check_inside, read_json, read_typed, write_json_atomic

SCHEMA = "page/1"
NAME = "page.json"
_FIX = "rerun the stage that gathers it: dvc repro collect"


@dataclass(frozen=True, slots=True, kw_only=True)
class Host:
    """The machine that a stage ran on."""

    machine: str
    cpus: int | None
    torch: str
    gpu: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRun:
    """One run of a stage: when it started (seconds since 1970), wall time, time of all its processors, highest memory in MiB."""

    started: float
    wall_s: float
    peak_rss_mb: float
    cpu_s: float | None = None
    host: Host | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Warmup:
    """What per-scene training before the first round did: held-out error before and after, and whether it was kept."""

    steps: int
    before: float
    after: float
    accepted: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseModel:
    """What the first reconstruction says about its model."""

    model: str
    weights_sha256: str
    licence: str
    warmup: Warmup | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Photo:
    """One captured view; ``name`` is the original file's, ``original`` its (width, height)."""

    view_id: str
    name: str
    picture: str
    original: tuple[int, int]
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownView:
    """One view of a method's reconstruction."""

    view_id: str
    generated: bool
    posed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Still:
    """One frame of the tour, a picture by layer."""

    frame: int
    pictures: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Refinement:
    """What a fit of the Gaussians to their pictures changed: photometric loss before and after; the old ones stay if it did not fall."""

    steps: int
    before: float
    after: float

    @property
    def kept(self) -> bool:
        """Whether the fitted Gaussians were kept."""
        return self.after < self.before


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodPage:
    """One method in one round.

    Attributes:
        name: as in the catalogue.
        model: the reconstructor's name.
        weights_sha256: of the weights that it was made with.
        licence: of weights of its own; None without any.
        refinement: of its Gaussians, if there was one.
        views: of its reconstruction, in order.
        videos: by layer.
        stills: some frames.
        view_pictures: every view at its own camera, by view.
        held_out_pictures: what the scene shows at the cameras found for held-out photos, by view.
        frames: of each video.
        fps: frames per second.
        inserted_frame: at which the tour stands at the inserted camera.
        inserted_camera: where that camera comes from.
        width: of the videos.
        height: of the videos.
        gaussians: how many.
        metrics: the `MetricsRow`.
        map: cameras and surfaces from above, SVG.
    """

    name: str
    model: str
    weights_sha256: str
    licence: str | None
    refinement: Refinement | None
    views: tuple[ShownView, ...]
    videos: Mapping[str, str]
    stills: tuple[Still, ...]
    view_pictures: Mapping[str, str]
    frames: int
    fps: int
    inserted_frame: int
    inserted_camera: str
    width: int
    height: int
    gaussians: int
    metrics: str
    map: str
    held_out_pictures: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingMethod:
    """A method that could not be run, and why; ``metrics`` is its `UnavailableRow`."""

    name: str
    model: str
    reason: str
    metrics: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LookPage:
    """One look of an adaptation: numbers by name, how far each module's weights moved, pictures by kind."""

    step: int
    values: Mapping[str, float]
    drift: Mapping[str, float]
    pictures: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LooksPage:
    """All looks of an adaptation. ``identity`` is that of its live log."""

    identity: str
    looks: tuple[LookPage, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """The steps of an adaptation: whether each saw the inserted view, and a value per step for every number."""

    inserted: tuple[bool, ...] = ()
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.values.items():
            if len(values) != len(self.inserted):
                raise ValueError(f"{name} has {len(values)} values for {len(self.inserted)} steps")


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How the inserted view fits, found before anything was adapted; ``reasons`` speak against it. None: nothing to measure."""

    overlap: float
    depth_conflict: float | None
    colour_conflict: float | None
    cameras_moved_deg: float
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundPage:
    """One round.

    Attributes:
        number: counted from 1.
        prompt: the sentence of the user.
        motion: how the camera is to move, as far as that was said.
        new_object: what is to be inserted, as far as that was said.
        full_prompt: what the generator was told.
        backend: of the generator.
        origin: file or model that the picture came from.
        source_type: IPTC's term for how it came to be; None: not known.
        ranking: of the candidates; empty where there was nothing to choose.
        parameters: of the generator's call.
        candidates: how many pictures there were to choose from.
        inserted: the inserted picture.
        inserted_id: its view.
        viewer: the page to walk through.
        sheet: contact sheet of the candidates.
        overlay: how the inserted view goes with the scene, as a picture; misalignment: the same in words.
        methods: that could be run.
        unavailable: that could not.
        steps: of the adaptation.
        looks: of the adaptation; None if it never looked.
        cameras: of all views, estimated together; None for models that need none.
        problems: a text of everything that is not as it should be with the cameras.
        judgement: of the inserted view; None if it was not judged.
        proposals: for the next motion, of the last round; None for others.
        statistics: of its stages, by stage and method.
        warnings: sentences for people.
    """

    number: int
    prompt: str
    motion: str
    new_object: str
    full_prompt: str
    backend: str
    origin: str
    source_type: str | None
    ranking: tuple[CandidateScore, ...]
    parameters: Mapping[str, str]
    candidates: int
    inserted: str
    inserted_id: str
    viewer: str
    sheet: str | None
    overlay: str | None = None
    misalignment: str | None = None
    methods: tuple[MethodPage, ...]
    unavailable: tuple[MissingMethod, ...]
    steps: Steps
    looks: LooksPage | None
    cameras: CameraReport | None
    problems: str | None
    judgement: Judgement | None
    proposals: Proposals | None
    statistics: Mapping[str, StageRun]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenePage:
    """One scene and its rounds.

    Attributes:
        scene: its name for people.
        settings: the composed configuration, dotted keys, values as JSON.
        overrides: Hydra overrides as they were given.
        model: of the first reconstruction.
        captured: the photos.
        held_out: photos that nothing was made from.
        cameras: of the photos alone; None for models that need none.
        statistics: of the stages that are in no round.
        rounds: in order.
    """

    scene: str
    settings: Mapping[str, str]
    overrides: tuple[str, ...]
    model: BaseModel
    captured: tuple[Photo, ...]
    cameras: CameraReport | None
    statistics: Mapping[str, StageRun]
    rounds: tuple[RoundPage, ...]
    held_out: tuple[Photo, ...] = ()

    def save(self, folder: Path) -> None:
        """Write beside what it names."""
        write_json_atomic(folder / NAME, {**{f.name: getattr(self, f.name) for f in fields(self)}, "schema": SCHEMA})

    @classmethod
    def load(cls, folder: Path) -> ScenePage:
        """Read what `save` wrote. Raises `ArtifactError` for another schema, a damaged file, or one that leads out of the folder."""
        path = folder / NAME
        content = read_json(path)
        if not isinstance(content, dict) or content.pop("schema", None) != SCHEMA:
            raise ArtifactError(f"is not of schema {SCHEMA!r}", where=path, fix=_FIX)
        page = read_typed(cls, content, path, fix=_FIX)
        for place in page.places():
            check_inside(place, folder)
        return page

    def places(self) -> Iterator[str]:
        """Every file that it names."""
        yield from (photo.picture for photo in (*self.captured, *self.held_out))
        for item in self.rounds:
            yield from (item.inserted, item.viewer)
            yield from (place for place in (item.sheet, item.overlay, item.problems) if place is not None)
            if item.proposals is not None:
                yield from () if item.proposals.map is None else (item.proposals.map,)
                yield from (proposal.preview for proposal in item.proposals.proposals)
            yield from (missing.metrics for missing in item.unavailable)
            yield from (place for look in (item.looks.looks if item.looks else ()) for place in look.pictures.values())
            for method in item.methods:
                yield method.metrics
                yield from (*method.videos.values(), *method.view_pictures.values(), *method.held_out_pictures.values())
                yield from (place for still in method.stills for place in still.pictures.values())


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested settings as dotted keys with text values."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{path}.")
        else:
            flat[path] = value if isinstance(value, str) else json.dumps(value)
    return flat
