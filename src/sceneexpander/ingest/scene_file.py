"""``scene.yaml``: what a scene folder says about itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.scene import RoundSpec
from sceneexpander.artifacts.store import sha256_of_bytes, sha256_of_file
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.ingest.listing import list_pictures, require_inside

SCENE_FILE = "scene.yaml"
_SCENE_KEYS = frozenset({"name", "source", "licence", "rounds", "order", "images"})
_ROUND_KEYS = frozenset({"prompt", "motion", "object", "inserted"})


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFile:
    """The content of ``scene.yaml``, checked. ``images`` is the folder of the captured photos, relative to the scene's."""

    name: str | None
    source: str
    licence: str
    images: str
    order: tuple[str, ...]  # file names that come first, in this order; empty: natural order
    rounds: tuple[RoundSpec, ...]


def read_scene_file(folder: Path) -> SceneFile:
    """Read and check ``folder/scene.yaml``.

    Raises:
        UserError: the file is missing or malformed, has unknown keys, lacks a prompt, or names a picture that is not in the folder.
    """
    import yaml

    path = folder / SCENE_FILE
    if not path.is_file():
        raise UserError(
            f"has no {SCENE_FILE}", where=folder, fix="add one with a round's prompt, or pass the prompt yourself"
        )
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise UserError(f"is not valid YAML ({error})", where=path) from None
    content = _mapping(raw, _SCENE_KEYS, path, "the file")
    rounds = content.get("rounds")
    if not isinstance(rounds, list) or not rounds:
        raise UserError("has no rounds", where=path, fix="add 'rounds:' with at least one '- prompt: ...'")
    return SceneFile(
        name=_text(content, "name", path, "the file") or None,
        source=_text(content, "source", path, "the file"),
        licence=_text(content, "licence", path, "the file"),
        images=_text(content, "images", path, "the file") or "captured",
        order=_names(content.get("order"), path),
        rounds=tuple(_round(folder, path, item, number) for number, item in enumerate(rounds, start=1)),
    )


def _mapping(value: object, known: frozenset[str], path: Path, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UserError(f"{what} holds {type(value).__name__}, expected keys and values", where=path)
    for key in value:
        if key not in known:
            raise UserError(f"{what} has the unknown key {key!r}", where=path, fix=did_you_mean(str(key), known))
    return value


def _text(content: dict[str, Any], key: str, path: Path, what: str) -> str:
    value = content.get(key)
    if value is None:
        return ""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = str(value)  # YAML reads a bare 7 as a number
    if not isinstance(value, str):
        raise UserError(f"{key!r} of {what} is a {type(value).__name__}, expected text", where=path)
    return " ".join(value.split())


def _names(value: object, path: Path) -> tuple[str, ...]:
    if value is None:
        return ()
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise UserError("'order' must be a list of file names", where=path)
    if len(set(value)) != len(value):
        raise UserError("'order' names a file twice", where=path)
    return tuple(value)


def _round(folder: Path, path: Path, item: object, number: int) -> RoundSpec:
    what = f"round {number}"
    content = _mapping(item, _ROUND_KEYS, path, what)
    prompt, motion, new_object = (_text(content, key, path, what) for key in ("prompt", "motion", "object"))
    inserted = _text(content, "inserted", path, what) or None
    spec = make_round(prompt, motion=motion, new_object=new_object, where=f"{path}: {what}")
    if inserted is None:
        return spec
    digest = _recorded_sha256(folder, inserted, where=f"{path}: {what}")
    return RoundSpec(
        prompt=spec.prompt, motion=motion, new_object=new_object, inserted=inserted, inserted_sha256=digest
    )


def make_round(prompt: str, *, motion: str = "", new_object: str = "", where: str = "prompt") -> RoundSpec:
    """A round from the user's words. Without a sentence, the two fields of the template together are the sentence.

    Raises:
        UserError: there are no words at all.
    """
    prompt, motion, new_object = (" ".join(text.split()) for text in (prompt, motion, new_object))
    sentence = prompt or "; ".join(part for part in (motion, new_object) if part)
    if not sentence:
        raise UserError(
            "has no prompt", where=where, fix='say what to add, e.g. prompt: "Behind the table is a bench."'
        )
    return RoundSpec(prompt=sentence, motion=motion, new_object=new_object)


def _recorded_sha256(folder: Path, inserted: str, *, where: str) -> str:
    """Digest of the recorded picture, or of a folder of candidates (their digests, in natural order)."""
    target = folder / inserted
    if Path(inserted).is_absolute():
        raise UserError(f"'inserted' is the absolute path {inserted}", where=where, fix="give it relative to the scene")
    require_inside(target, folder, where=where)
    if target.is_dir():
        digests = "".join(sha256_of_file(path) for path in list_pictures(target, inside=folder))
        return sha256_of_bytes(digests.encode())
    if not target.is_file():
        raise UserError(f"'inserted' names {inserted}, which does not exist", where=where)
    return sha256_of_file(target)
