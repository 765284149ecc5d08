"""The files that a page shows, as they are or reduced: a site of many scenes must stay small enough to be sent around."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from sceneexpander.artifacts.page import MethodPage, ScenePage
from sceneexpander.artifacts.store import read_typed, to_plain
from sceneexpander.catalogue import MAIN

SIDE_PX, SHEET_SIDE_PX, QUALITY = 400, 960, 78  # of reduced pictures
_SHEETS = ("sheet", "overlay", "coverage")  # with small things in them
_MAIN_LAYERS = ("rgb", "provenance")  # of reduced pages; of other methods the first alone
_LOOK_PICTURES = {"inserted", "depth"}
_PICTURES = {".png", ".jpg"}


def poster_of(method: MethodPage) -> str:
    """The still nearest to the inserted view."""
    return max(method.stills, key=lambda still: -abs(still.frame - method.inserted_frame)).pictures["rgb"]


def shown_places(page: ScenePage) -> Iterator[str]:
    """Every file that the page of a scene shows: fewer than were gathered, since tracked runs have more."""
    yield from (photo.picture for photo in (*page.captured, *page.held_out))
    for item in page.rounds:
        yield from (item.inserted, item.viewer)
        yield from (place for place in (item.sheet, item.overlay) if place is not None)
        if item.proposals is not None:
            yield from () if item.proposals.map is None else (item.proposals.map,)
            yield from (proposal.preview for proposal in item.proposals.proposals)
        for look in item.looks.looks if item.looks else ():
            yield from (place for kind, place in look.pictures.items() if kind in _LOOK_PICTURES)
        for method in item.methods:
            yield from (*method.videos.values(), *method.view_pictures.values(), *method.held_out_pictures.values())
            yield poster_of(method)


def copy_media(page: ScenePage, source: Path, target: Path) -> ScenePage:
    """Copy what a page shows. Returns the page, so that this and `copy_reduced` are called alike."""
    for place in dict.fromkeys(shown_places(page)):
        (target / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / place, target / place)
    return page


def copy_reduced(page: ScenePage, source: Path, target: Path) -> ScenePage:
    """Copy what a page shows as small JPEG, fewer videos, and nothing to walk through. Returns the page with the new names."""
    page = replace(
        page,
        rounds=tuple(replace(item, methods=tuple(_fewer(method) for method in item.methods)) for item in page.rounds),
    )
    walks = {item.viewer for item in page.rounds}
    renamed: dict[str, str] = {}
    target.mkdir(parents=True, exist_ok=True)
    for place in dict.fromkeys(shown_places(page)):
        if place in walks:
            continue
        (target / place).parent.mkdir(parents=True, exist_ok=True)
        if Path(place).suffix in _PICTURES:
            renamed[place] = str(Path(place).with_suffix(".jpg").as_posix())
            _save_reduced(source / place, target / renamed[place])
        else:
            shutil.copyfile(source / place, target / place)
    return read_typed(ScenePage, _with_names(to_plain(page), renamed), source)


def _fewer(method: MethodPage) -> MethodPage:
    layers = _MAIN_LAYERS if method.name == MAIN else _MAIN_LAYERS[:1]
    return replace(method, videos={layer: place for layer, place in method.videos.items() if layer in layers})


def _save_reduced(source: Path, target: Path) -> None:
    with Image.open(source) as picture:
        xmp = picture.info.get("xmp")  # what was generated says so wherever it goes
        small = picture.convert("RGB")
    side = SHEET_SIDE_PX if source.stem.startswith(_SHEETS) else SIDE_PX
    small.thumbnail((side, side), Image.Resampling.LANCZOS)
    small.save(target, "JPEG", quality=QUALITY, **({} if xmp is None else {"xmp": xmp}))


def _with_names(node: Any, renamed: dict[str, str]) -> Any:
    """Plain values with every file's new name, wherever it stands."""
    if isinstance(node, str):
        return renamed.get(node, node)
    if isinstance(node, dict):
        return {key: _with_names(value, renamed) for key, value in node.items()}
    if isinstance(node, list):
        return [_with_names(value, renamed) for value in node]
    return node
