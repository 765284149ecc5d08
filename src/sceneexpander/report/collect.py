"""Gather what is shown of one scene into one folder: pictures, videos and a single file of facts."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.cameras import CameraReport
from sceneexpander.artifacts.held_out import HeldOut
from sceneexpander.artifacts.held_out_seen import HeldOutSeen
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.judgement import FILE_NAME as JUDGEMENT
from sceneexpander.artifacts.metrics import MetricsRow, load_row
from sceneexpander.artifacts.page import (
    BaseModel,
    Judgement,
    LookPage,
    LooksPage,
    MethodPage,
    MissingMethod,
    Photo,
    Refinement,
    RoundPage,
    ScenePage,
    ShownView,
    StageRun,
    Steps,
    Still,
)
from sceneexpander.artifacts.proposals import Proposals
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.source_type import source_type_xmp
from sceneexpander.artifacts.store import ArtifactError, read_json, read_typed
from sceneexpander.artifacts.unavailable import unavailable_in
from sceneexpander.artifacts.views import ViewSet, to_uint8
from sceneexpander.catalogue import LOOKS, MAIN, STEPS
from sceneexpander.catalogue.methods import CAPTURED
from sceneexpander.evaluation.quality import find_failures
from sceneexpander.files import write_bytes_atomic
from sceneexpander.report.camera_map import camera_map
from sceneexpander.report.cameras import gathered_cameras
from sceneexpander.report.course import verdict
from sceneexpander.report.words import method_label
from sceneexpander.viewer.packed import PackedSplats
from sceneexpander.viewer.page import ShownMethod, viewer_page

LOOK_PICTURES = ("captured", "inserted", "depth")  # of every look, named with its step
_PICTURE_SIDE_PX = 720
_SERIES = ("loss", *(metric.name for metric in STEPS))
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodSource:
    """Artefacts of one method in one round.

    ``held_out``: its `HeldOutSeen`, if it was measured. ``report``: what its reconstructor says about itself, if it has one of its own.
    ``refinement``: what a fit of its Gaussians to their pictures changed, if there was one.
    """

    name: str
    reconstruction: Path
    renders: Path
    splats: Path
    metrics: Path
    held_out: Path | None = None
    report: Path | None = None
    refinement: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundSource:
    """Artefacts of one round.

    ``asked`` is its `RoundSpec`. ``log`` is the adaptation's, with its looks (``looks.json``, ``looks/``) and the verdict on the inserted
    view (``acceptance.json``) beside it, where there are any; ``statistics`` holds one file per stage run. ``cameras`` is the
    `CameraReport` of all views, the inserted one included; its folder does not exist where the model needs no cameras. ``judged`` is the
    `JudgedRound`.
    """

    number: int
    asked: Path
    inserted: Path
    methods: Sequence[MethodSource]
    log: Path
    statistics: Path
    cameras: Path | None = None
    proposals: Path | None = None
    judged: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneSource:
    """Artefacts of one scene. ``report`` is what the first reconstruction said about itself, ``cameras`` its `CameraReport` if any.

    ``settings``: the composed configuration, see `ScenePage`. ``held_out``: the `HeldOut` photos.
    """

    scene: Path
    report: Path
    statistics: Path
    rounds: Sequence[RoundSource]
    settings: Mapping[str, str]
    overrides: Sequence[str]
    cameras: Path | None = None
    held_out: Path | None = None


def collect_scene(source: SceneSource, folder: Path) -> None:
    """Fill ``folder`` with ``page.json`` and the media it names (paths relative to the folder).

    Raises:
        ArtifactError: an artefact is missing or damaged.
    """
    scene = Scene.load(source.scene)
    page = ScenePage(
        scene=scene.name,
        settings=source.settings,
        overrides=tuple(source.overrides),
        model=read_typed(BaseModel, read_json(source.report), source.report, extra=True),
        captured=_photos(scene.views, folder, "captured"),
        held_out=_held_out(source.held_out, folder),
        cameras=gathered_cameras(source.cameras),
        statistics=_statistics(source.statistics),
        rounds=tuple(_round(item, source, folder) for item in source.rounds),
    )
    _write_viewers(source, scene, folder)
    page.save(folder)


def _write_viewers(source: SceneSource, scene: Scene, folder: Path) -> None:
    """One page to walk through per round, in a file of its own beside the round's media."""
    pictures = dict(zip(scene.views.view_ids, scene.views.images, strict=True))
    for item in source.rounds:
        inserted = InsertedView.load(item.inserted).view
        pictures[inserted.view_ids[0]] = inserted.images[0]
        shown = []
        # The page opens with its last method.
        for method in sorted(item.methods, key=lambda method: method.name == MAIN):
            if unavailable_in(method.splats) is not None:
                continue
            splats = PackedSplats.load(method.splats)
            fit = MetricsRow.load(method.metrics).fit
            shown.append(ShownMethod(splats=splats, label=method_label(method.name, splats.model, fit)))
        known = {view for method in shown for view in method.splats.cameras.view_ids}
        page = viewer_page(
            scene.name,
            RoundSpec.load(item.asked).prompt,
            shown,
            {view: picture for view, picture in pictures.items() if view in known},
        )
        write_bytes_atomic(folder / _viewer_place(item.number), page.encode())


def _viewer_place(number: int) -> str:
    return f"round_{number}/viewer.html"


def _held_out(source: Path | None, folder: Path) -> tuple[Photo, ...]:
    if source is None or not source.is_dir():
        return ()
    views = HeldOut.load(source).views
    return () if views is None else _photos(views, folder, "held_out")


def _photos(views: ViewSet, folder: Path, kind: str) -> tuple[Photo, ...]:
    photos = []
    for record, image in zip(views.records, views.detail_images, strict=True):
        picture = f"{kind}/{record.view_id}.jpg"
        _save_picture(folder / picture, image)
        photos.append(
            Photo(
                view_id=record.view_id,
                name=record.name,
                picture=picture,
                original=(record.original_width, record.original_height),
                sha256=record.sha256,
            )
        )
    return tuple(photos)


def _round(source: RoundSource, scene_source: SceneSource, folder: Path) -> RoundPage:
    inserted = InsertedView.load(source.inserted)
    chosen = inserted.provenance[inserted.chosen]
    base = f"round_{source.number}"
    kind = chosen.digital_source_type
    xmp = None if kind is None else source_type_xmp(kind, credit=f"{chosen.backend}: {Path(chosen.source).name}")
    _save_picture(folder / base / "inserted.jpg", inserted.view.detail_images[0], xmp)
    sheet = source.inserted / "sheet.png"
    if sheet.is_file():
        shutil.copyfile(sheet, folder / base / "sheet.png")
    overlay = source.inserted / "overlay.png"
    spec = RoundSpec.load(source.asked)
    cameras = gathered_cameras(source.cameras)
    looks = _looks(source.log.parent, folder, base)
    judgement = _read_if_any(Judgement, source.log.parent / "acceptance.json")
    missing = {item.name: lacking for item in source.methods if (lacking := unavailable_in(item.reconstruction))}
    methods = [_method(item, folder, f"{base}/{item.name}") for item in source.methods if item.name not in missing]
    if source.judged is not None:
        _copy(source.judged / JUDGEMENT, folder, f"{base}/{JUDGEMENT}")
    return RoundPage(
        number=source.number,
        prompt=spec.prompt,
        motion=spec.motion,
        new_object=spec.new_object,
        full_prompt=_told(chosen),
        backend=chosen.backend,
        origin=Path(chosen.source).name,
        source_type=kind,
        ranking=inserted.ranking,
        parameters=chosen.parameters,
        candidates=len(inserted.provenance),
        inserted=f"{base}/inserted.jpg",
        inserted_id=inserted.view.view_ids[0],
        viewer=_viewer_place(source.number),
        sheet=f"{base}/sheet.png" if sheet.is_file() else None,
        overlay=_copy(overlay, folder, f"{base}/overlay.png") if overlay.is_file() else None,
        misalignment=None if inserted.misalignment is None else inserted.misalignment.words,
        methods=tuple(methods),
        unavailable=tuple(
            MissingMethod(
                name=item.name,
                model=missing[item.name].model,
                reason=missing[item.name].reason,
                metrics=_copy(item.metrics, folder, f"{base}/{item.name}/metrics.json"),
            )
            for item in source.methods
            if item.name in missing
        ),
        steps=_steps(read_json(source.log)),
        looks=looks,
        cameras=cameras,
        problems=_problems(source, scene_source, folder, base),
        judgement=judgement,
        proposals=_proposals(source.proposals, folder, base),
        statistics=_statistics(source.statistics),
        warnings=(
            *_warnings(methods, chosen.parameters, cameras),
            *([judged.text] if (judged := verdict(judgement)) is not None and judged.refused else []),
            *(looks.warnings if looks else ()),
            *_failures(source, inserted.view.view_ids[0]),
        ),
    )


def _failures(source: RoundSource, inserted_id: str) -> list[str]:
    """Why no round should follow this one, a sentence each."""
    rows = {item.name: load_row(item.metrics) for item in source.methods if item.name in (MAIN, CAPTURED)}
    known = {name: row for name, row in rows.items() if isinstance(row, MetricsRow)}
    if MAIN not in known:
        return []
    failures = find_failures(known[MAIN], known.get(CAPTURED), inserted_id)
    return [f"The round failed quality control: {reason}." for reason in failures]


def _proposals(source: Path | None, folder: Path, base: str) -> Proposals | None:
    """Proposals with their pictures in the folder; None if there are none."""
    if source is None or not source.is_dir():
        return None
    found = Proposals.load(source)
    return replace(
        found,
        map=None if found.map is None else _copy(source / found.map, folder, f"{base}/proposals/{found.map}"),
        proposals=tuple(
            replace(item, preview=_copy(source / item.preview, folder, f"{base}/proposals/{item.preview}"))
            for item in found.proposals
        ),
    )


def _steps(log: Sequence[Mapping[str, Any]]) -> Steps:
    names = [name for name in _SERIES if log and name in log[0]]
    return Steps(
        inserted=tuple(bool(record["inserted"]) for record in log),
        values={name: tuple(float(record[name]) for record in log) for name in names},
    )


def _problems(source: RoundSource, scene: SceneSource, folder: Path, base: str) -> str | None:
    """Where everything that is not as it should be with the cameras lies, as a text for the tracked runs; None without any."""
    sets = (("the photos alone", scene.cameras), ("with the inserted view", source.cameras))
    found = [(title, cameras) for title, place in sets if (cameras := gathered_cameras(place)) is not None]
    if not any(cameras.problems() for _, cameras in found):
        return None
    place = f"{base}/cameras.txt"
    lines = [line for title, cameras in found for line in (f"{title}: {cameras.summary()}", *cameras.problems(), "")]
    write_bytes_atomic(folder / place, "\n".join(lines).encode())
    return place


def _told(how: Provenance) -> str:
    """What the generator was told, and from what a chat model made it."""
    if how.prompt_given is None:
        return how.prompt
    return f"{how.prompt}\n\nRewritten by {how.rewritten_by} from: {how.prompt_given}"


def _looks(source: Path, folder: Path, base: str) -> LooksPage | None:
    """What the adaptation saw of itself, with its pictures; None if it never looked."""
    facts = read_json(source / "looks.json") if (source / "looks.json").is_file() else None
    if facts is None or not facts["looks"]:
        return None
    looks = []
    for look in facts["looks"]:
        names = {kind: f"{kind}_{look['step']:04d}.jpg" for kind in LOOK_PICTURES}
        pictures = {
            kind: _copy(source / "looks" / name, folder, f"{base}/looks/{name}")
            for kind, name in names.items()
            if (source / "looks" / name).is_file()
        }
        values = {metric.name: look[metric.name] for metric in LOOKS if metric.name in look}
        looks.append(LookPage(step=look["step"], values=values, drift=look["drift"], pictures=pictures))
    sentences = tuple(f"{text[0].upper()}{text[1:]}." for text in facts["warnings"])
    return LooksPage(identity=facts["identity"], looks=tuple(looks), warnings=sentences)


def _method(source: MethodSource, folder: Path, base: str) -> MethodPage:
    renders = Renders.load(source.renders)
    reconstruction = Reconstruction.load(source.reconstruction)
    target = folder / base
    target.mkdir(parents=True, exist_ok=True)
    videos = {
        layer: _copy(source.renders / name, folder, f"{base}/{layer}.mp4") for layer, name in renders.videos.items()
    }
    stills = tuple(
        Still(
            frame=index,
            pictures={
                layer: _copy(source.renders / name, folder, f"{base}/{layer}_{index:04d}{Path(name).suffix}")
                for layer, name in pictures.items()
            },
        )
        for index, pictures in renders.stills
    )
    views = {
        view: _copy(source.renders / name, folder, f"{base}/view_{view}{Path(name).suffix}")
        for view, name in renders.views
    }
    held_out = {}
    if source.held_out is not None and source.held_out.is_dir():
        for view, name in HeldOutSeen.load(source.held_out).pictures.items():
            held_out[view] = _copy(source.held_out / name, folder, f"{base}/held_out_{view}{Path(name).suffix}")
    licence = _read_if_any(_Licence, source.report)
    return MethodPage(
        name=source.name,
        model=reconstruction.model,
        weights_sha256=reconstruction.weights_sha256,
        licence=None if licence is None else licence.licence,
        refinement=_read_if_any(Refinement, source.refinement),
        views=tuple(
            ShownView(view_id=view, generated=bool(generated), posed=bool(posed))
            for view, generated, posed in zip(
                reconstruction.view_ids, reconstruction.generated, reconstruction.posed, strict=True
            )
        ),
        videos=videos,
        stills=stills,
        view_pictures=views,
        held_out_pictures=held_out,
        frames=renders.frames,
        fps=renders.fps,
        inserted_frame=renders.inserted_frame,
        inserted_camera=renders.inserted_camera,
        width=renders.width,
        height=renders.height,
        gaussians=renders.gaussians,
        metrics=_copy(source.metrics, folder, f"{base}/metrics.json"),
        map=camera_map(reconstruction),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Licence:
    """What a method with weights of its own says about them."""

    licence: str


def _warnings(methods: Sequence[MethodPage], parameters: Mapping[str, str], cameras: CameraReport | None) -> list[str]:
    found = []
    # What the cameras' own report says is not repeated for every method.
    said = {view.view_id for view in cameras.views if not view.posed} if cameras is not None else set()
    for method in methods:
        lost = [view.view_id for view in method.views if not view.posed and view.view_id not in said]
        if lost:
            found.append(f"{method.name}: no camera could be estimated for {', '.join(lost)}; a placeholder was used.")
    if parameters.get("warning"):
        found.append(f"Inserted picture: {parameters['warning']}.")
    return found


def _statistics(folder: Path) -> dict[str, StageRun]:
    if not folder.is_dir():
        return {}
    return {
        path.stem: read_typed(StageRun, read_json(path), path, extra=True) for path in sorted(folder.glob("*.json"))
    }


def _read_if_any(schema: type[T], path: Path | None) -> T | None:
    """What a file holds that only some runs have; None without it."""
    return read_typed(schema, read_json(path), path, extra=True) if path is not None and path.is_file() else None


def _copy(source: Path, folder: Path, place: str) -> str:
    if not source.is_file():
        raise ArtifactError("is missing", where=source, fix="rerun the stage that makes it")
    target = folder / place
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return place


def _save_picture(path: Path, image: Tensor, xmp: bytes | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(to_uint8(image))
    picture.thumbnail((_PICTURE_SIDE_PX, _PICTURE_SIDE_PX))
    picture.save(path, format="JPEG", quality=88, **({} if xmp is None else {"xmp": xmp}))
