"""What the page, the runs and the console say about cameras: which views were used, which were not, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.artifacts.page import NAME, ScenePage

_FILM_LONG_SIDE_MM = 36.0
_FOCAL_SOURCES = {
    "known": "as given",
    "refined": "refined on the photos",
    "hint": "from the file",
    "exif": "from the file",
    "lines": "from straight lines in the photos",
    "swept": "the best of some guesses",
    "turned": "from turns of the camera",
    "assumed": "assumed",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCard:
    """One view as the page shows it: ``state`` is a class of the style sheet, ``doubts`` is what is not as it should be."""

    view_id: str
    name: str
    picture: str | None
    generated: bool
    state: str
    label: str
    doubts: tuple[str, ...]
    facts: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CamerasShown:
    """The cameras of one set of views on the page. ``lens`` is what most cards would say of theirs; those do not repeat it."""

    summary: str
    lens: str
    notes: tuple[str, ...]
    cards: tuple[CameraCard, ...]
    complete: bool  # every view was used


def gathered_cameras(folder: Path | None) -> CameraReport | None:
    """The report in a folder; None where there is none (models that need no cameras).

    Raises:
        ArtifactError: the report is damaged.
    """
    return None if folder is None or not folder.is_dir() else CameraReport.load(folder)


def cameras_shown(report: CameraReport | None, pictures: Mapping[str, str]) -> CamerasShown | None:
    """Cards of what was found out about the cameras; ``pictures`` are by view."""
    if report is None:
        return None
    lens, count = Counter(_lens(view) for view in report.views).most_common(1)[0]
    shared = lens if 2 * count > len(report.views) > 1 else ""
    return CamerasShown(
        summary=report.summary(),
        lens=shared,
        notes=report.notes,
        cards=tuple(_card(view, pictures.get(view.view_id), shared) for view in report.views),
        complete=report.posed == len(report.views),
    )


def _card(view: ViewCamera, picture: str | None, shared: str) -> CameraCard:
    state, label = ("out", "left out") if not view.posed else ("rough", "rough") if view.rough else ("used", "used")
    return CameraCard(
        view_id=view.view_id,
        name=view.name,
        picture=picture,
        generated=view.generated,
        state=state,
        label=label,
        doubts=tuple(text for text in (view.reason, *view.warnings) if text),
        facts=tuple(text for text in ("" if _lens(view) == shared else _lens(view), _evidence(view)) if text),
    )


def _lens(view: ViewCamera) -> str:
    source = view.focal_source
    words = [f"about {_FILM_LONG_SIDE_MM * view.focal_ratio:.0f} mm (35 mm equivalent)"]
    words += [_FOCAL_SOURCES.get(source, source)] if source else []
    if any(view.distortion):
        k1, k2 = view.distortion
        words.append(f"distortion taken out (k1 {k1:+.3f}, k2 {k2:+.3f})")
    return ", ".join(words)


def _evidence(view: ViewCamera) -> str:
    if not view.posed or not view.inliers:
        return ""
    return f"{view.inliers} points" + ("" if view.error_px is None else f", {view.error_px:.1f} px off")


def camera_lines(outputs: Path) -> list[str]:
    """A line for the captured photos of every gathered scene, and one for every round: which views were used, which left out and why.

    Args:
        outputs: the pipeline's ``outputs`` folder. Scenes whose model needs no cameras have no line.

    Raises:
        ArtifactError: a file of the gathered scene is damaged.
    """
    lines = []
    for path in sorted((outputs / "pages").glob(f"*/{NAME}")):
        page, scene = ScenePage.load(path.parent), path.parent.name
        places = [(scene, page.cameras), *((f"{scene}, round {item.number}", item.cameras) for item in page.rounds)]
        lines += [f"{place}: {report.summary()}" for place, report in places if report is not None]
    return lines
