"""``scene.yaml``: what a scene folder says about itself."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from sceneexpander.artifacts.scene import RoundSpec
from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.errors import UserError, did_you_mean, printable
from sceneexpander.ingest.decode import LIMIT_BYTES
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.survey import list_pictures
from sceneexpander.plainfiles import read_plain_file
from sceneexpander.yamlfile import read_user_yaml

SCENE_FILE = "scene.yaml"
_SCENE_KEYS = frozenset({"name", "source", "origin", "licence", "rounds", "order", "images", "notes"})
_ROUND_KEYS = frozenset({"prompt", "motion", "object", "inserted"})
_SENTENCES = frozenset({"prompt", "motion", "object"})


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFile:
    """The content of ``scene.yaml``, checked.

    ``images`` is the folder of the captured photos, or the file or folder that a capture of another kind is in, relative to the scene's.
    ``source`` is the kind (see `sceneexpander.ingest.sources`), ``origin`` where the data is from, for people.

    ``notes`` were made when the folder was put together from other files, which are not in it.
    """

    name: str | None
    source: str
    origin: str
    licence: str
    images: str
    order: tuple[str, ...]  # file names that come first, in this order; empty: natural order
    rounds: tuple[RoundSpec, ...]
    notes: tuple[str, ...] = ()


def read_scene_file(folder: Path) -> SceneFile:
    """Read and check ``folder/scene.yaml``.

    Raises:
        UserError: the file is missing or malformed, has unknown keys, lacks a prompt, or names a picture that is not in the folder.
    """
    path = folder / SCENE_FILE
    if not path.is_file() and not path.is_symlink() and not path.exists():
        raise UserError(
            f"has no {SCENE_FILE}", where=folder, fix="add one with a round's prompt, or pass the prompt yourself"
        )
    raw = read_user_yaml(require_inside(path, folder), sentences=_SENTENCES, numbers_as_text=True)
    content = _mapping(raw, _SCENE_KEYS, path, "the file")
    rounds = content.get("rounds")
    if not isinstance(rounds, list) or not rounds:
        raise UserError("has no rounds", where=path, fix="add 'rounds:' with at least one '- prompt: ...'")
    images = _text(content, "images", path, "the file")
    source, origin = _source_and_origin(content, path)
    return SceneFile(
        name=_text(content, "name", path, "the file") or None,
        source=source,
        origin=origin,
        licence=_text(content, "licence", path, "the file"),
        images=_existing(folder, images, f"{path}: 'images'") if images else "captured",
        order=_names(content.get("order"), path),
        notes=_notes(content.get("notes"), path),
        rounds=tuple(_round(folder, path, item, number) for number, item in enumerate(rounds, start=1)),
    )


def _mapping(value: object, known: frozenset[str], path: Path, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UserError(f"{what} holds {type(value).__name__}, expected keys and values", where=path)
    for key in value:
        if key not in known:
            shown = str(key)[:60]
            raise UserError(f"{what} has the unknown key {shown!r}", where=path, fix=did_you_mean(shown, known))
    return value


def _text(content: dict[str, Any], key: str, path: Path, what: str) -> str:
    value = content.get(key)
    if value is None:
        return ""
    if not isinstance(value, str):
        kind = type(value).__name__
        quote = "put it in quotes" if isinstance(value, bool) else None
        raise UserError(f"{key!r} of {what} is a {kind}, expected text", where=path, fix=quote)
    return " ".join(value.split())


def _source_and_origin(content: dict[str, Any], path: Path) -> tuple[str, str]:
    """The kind of the data, and where it is from. A kind is one word; a sentence under ``source`` says the latter, as it did in 0.1.0."""
    source, origin = (_text(content, key, path, "the file") for key in ("source", "origin"))
    if " " not in source:
        return source or "auto", origin
    if origin:
        problem = f"'source' is {printable(source[:60])!r}, no kind of data"
        raise UserError(problem, where=path, fix="leave it out: 'origin' says where the data is from")
    return "auto", source


def _names(value: object, path: Path) -> tuple[str, ...]:
    if value is None:
        return ()
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise UserError("'order' must be a list of file names", where=path)
    if len({same_name(item) for item in value}) != len(value):
        raise UserError("'order' names a file twice", where=path)
    return tuple(value)


def _notes(value: object, path: Path) -> tuple[str, ...]:
    if value is not None and not (isinstance(value, list) and all(isinstance(item, str) for item in value)):
        raise UserError("'notes' must be a list of texts", where=path)
    return tuple(printable(item) for item in value or ())


def same_name(name: str) -> str:
    """A form in which names that look the same are the same: some systems write ``ü`` as one character, others as two."""
    return unicodedata.normalize("NFC", name)


def _round(folder: Path, path: Path, item: object, number: int) -> RoundSpec:
    what = f"round {number}"
    content = _mapping(item, _ROUND_KEYS, path, what)
    prompt, motion, new_object = (_text(content, key, path, what) for key in ("prompt", "motion", "object"))
    inserted = _text(content, "inserted", path, what) or None
    spec = make_round(prompt, motion=motion, new_object=new_object, where=f"{path}: {what}")
    if inserted is None:
        return spec
    where = f"{path}: {what}"
    if Path(inserted).is_absolute():
        raise UserError(f"'inserted' is the absolute path {inserted}", where=where, fix="give it relative to the scene")
    inserted = _existing(folder, inserted, f"{where}: 'inserted'")
    digest = _recorded_sha256(folder, inserted, where=where)
    return RoundSpec(
        prompt=spec.prompt, motion=motion, new_object=new_object, inserted=inserted, inserted_sha256=digest
    )


def make_round(prompt: str, *, motion: str = "", new_object: str = "", where: str = "prompt") -> RoundSpec:
    """A round from the user's words. Without a sentence, the two fields of the template together are the sentence.

    Raises:
        UserError: there are no words at all.
    """
    prompt, motion, new_object = (_checked_words(text, where) for text in (prompt, motion, new_object))
    sentence = prompt or "; ".join(part for part in (motion, new_object) if part)
    if not sentence:
        option = "--prompt " if where.startswith("--") else "prompt: "
        raise UserError("has no prompt", where=where, fix=f'say what to add, e.g. {option}"Step back, a wooden bench."')
    return RoundSpec(prompt=sentence, motion=motion, new_object=new_object)


def _checked_words(text: str, where: str) -> str:
    if any("\ud800" <= letter <= "\udfff" or letter == "\0" for letter in text):
        raise UserError("holds a character that is not valid text", where=where, fix="write the sentence in UTF-8")
    return " ".join(text.split())


def _existing(folder: Path, name: str, where: str) -> str:
    """The name, relative to ``folder``, as the file system spells it. Raises `UserError` if there is nothing of that name."""
    require_inside(folder / name, folder, where=where)
    found = folder
    for part in PurePosixPath(name).parts:
        try:
            there = {path.name for path in found.iterdir()} if part != ".." else {part}
        except OSError:
            there = set()
        alike = [other for other in there if same_name(other) == same_name(part)]
        if part not in there and not alike:
            raise UserError(f"names {name}, which does not exist", where=where, fix=_suggestion(name, part, there))
        found = found / (part if part in there else alike[0])
    return found.relative_to(folder).as_posix()


def _suggestion(name: str, part: str, there: set[str]) -> str | None:
    if "\\" in name:
        return f"did you mean {name.replace(chr(92), '/')!r}? Folders are separated by /"
    shown = sorted(printable(other) for other in there if not other.startswith("."))[:20]
    return did_you_mean(part, shown) if shown else None


def _recorded_sha256(folder: Path, inserted: str, *, where: str) -> str:
    """Digest of the recorded picture, or of a folder of candidates (their digests, in natural order)."""
    target = folder / inserted
    require_inside(target, folder, where=where)
    if target.is_dir():
        pictures = [read_plain_file(path, limit_bytes=LIMIT_BYTES) for path in list_pictures(target, inside=folder)]
        return sha256_of_bytes("".join(map(sha256_of_bytes, pictures)).encode())
    data = read_plain_file(target, limit_bytes=LIMIT_BYTES, where=f"{where}: {inserted}")
    return sha256_of_bytes(data)
