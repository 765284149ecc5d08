"""Static pages from the gathered scenes: no server, no network, no build step. One scene is one page, several are a site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow, Row, load_row
from sceneexpander.artifacts.page import ScenePage
from sceneexpander.catalogue import ARROWS, MAIN, Metric, Table
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.table import comparison_table
from sceneexpander.files import write_bytes_atomic
from sceneexpander.report.media import copy_media, copy_reduced, poster_of
from sceneexpander.report.page import course_of, fill_scene, timeline

INDEX = "index.html"
FULL_SCENES = 3  # pages of more scenes show reduced pictures: ten of them stay below 50 MB
_HEADLINE = metrics_named("psnr_at_photo_size_db", "psnr_at_picture_size_db")
COMPARED = metrics_named(
    "psnr_at_photo_size_db", "ssim_at_photo_size", "psnr_at_picture_size_db", "camera_rotation_deg", "depth_abs_rel"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Copied:
    """A scene whose files are in the site."""

    page: ScenePage
    source: Path

    @property
    def name(self) -> str:
        return self.source.name

    def rows(self) -> list[Row]:
        """Of all rounds and methods. The scene goes by its folder, of which there is one in a site."""
        return [
            replace(load_row(self.source / place), scene=self.name, round=item.number)
            for item in self.page.rounds
            for place in (*(made.metrics for made in item.methods), *(none.metrics for none in item.unavailable))
        ]


def write_page(scenes: Sequence[Path], folder: Path, *, missing: Sequence[str] = ()) -> None:
    """Fill ``folder`` with ``index.html`` and ``media/<scene>/``; of several scenes it is an index of ``scenes/<scene>.html``.

    Args:
        scenes: folders made by `collect_scene`, in the order of the page.
        folder: an existing (scratch) folder.
        missing: names of scenes that there should be as well.
    """
    alone = len(scenes) + len(missing) == 1
    full = len(scenes) <= FULL_SCENES
    copied = []
    for source in scenes:
        copy = copy_media if full else copy_reduced
        page = copy(ScenePage.load(source), source, folder / "media" / source.name)
        copied.append(_Copied(page=page, source=source))
        media = f"media/{source.name}" if alone else f"../media/{source.name}"
        filled = {"scene": fill_scene(page, source, media=media, walks=full), "home": "" if alone else f"../{INDEX}"}
        place = folder / INDEX if alone else folder / "scenes" / f"{source.name}.html"
        write_bytes_atomic(place, render("page.html.j2", filled))
    if not alone:
        write_bytes_atomic(folder / INDEX, render("site.html.j2", _index(copied, missing)))


def render(template: str, filled: dict[str, Any]) -> bytes:
    import jinja2
    from markupsafe import Markup

    templates = files("sceneexpander.report") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (templates / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Only these two texts, which ship with the package, go in as they are.
    css, js = (Markup((templates / name).read_text(encoding="utf-8")) for name in ("page.css", "page.js"))  # noqa: S704
    return environment.get_template(template).render(css=css, js=js, **filled).encode()


def _index(copied: Sequence[_Copied], missing: Sequence[str]) -> dict[str, Any]:
    rows = [row for scene in copied for row in scene.rows()]
    cards = [_card(scene) for scene in copied]
    return {
        "scenes": cards,
        "growing": [card for card in cards if len(card["timeline"]) > 1],
        "missing": missing,
        "comparison": comparison_table(rows, COMPARED),
        "arrows": ARROWS,
        "matrices": [(metric, _matrix(copied, metric)) for metric in _HEADLINE],
    }


def _card(scene: _Copied) -> dict[str, Any]:
    page, media = scene.page, f"media/{scene.name}"
    last = page.rounds[-1]
    main = next((method for method in last.methods if method.name == MAIN), None)
    numbers: list[str] = []
    if main is not None:
        row = MetricsRow.load(scene.source / main.metrics)
        known = [(metric, row.value(metric.name)) for metric in _HEADLINE]
        numbers = [f"{metric.title} {metric.text_with_unit(value)}" for metric, value in known if value is not None]
    return {
        "name": page.scene,
        "page": f"scenes/{scene.name}.html",
        "media": media,
        "poster": f"{media}/{poster_of(main) if main is not None else last.inserted}",
        "numbers": numbers,
        "failed": any(
            text.startswith("The round failed quality control") for item in page.rounds for text in item.warnings
        ),
        "timeline": timeline(page, course_of(page, scene.source)),
    }


def _matrix(copied: Sequence[_Copied], metric: Metric) -> Table:
    """One number of every method (columns) in every scene (lines), as means over its rounds."""
    tables = [comparison_table(scene.rows(), [metric]) for scene in copied]
    values = [{line[0]: line[-1] if len(line) > 3 else "" for line in table.lines} for table in tables]
    methods = list(dict.fromkeys(name for found in values for name in found))
    lines = [
        (scene.page.scene, *(found.get(name, "") for name in methods))
        for scene, found in zip(copied, values, strict=True)
    ]
    return Table(header=("scene", *methods), lines=tuple(lines))
