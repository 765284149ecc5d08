"""The back-ends by name. New ones are added to `BACKENDS`; nothing else knows them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.generation.config import GeneratorConfig
from sceneexpander.generation.protocol import Candidate, GenerationContext, ViewGenerator
from sceneexpander.ingest.decode import LIMIT_BYTES
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.survey import list_pictures
from sceneexpander.plainfiles import read_plain_file

FILE_BACKEND = "file"


def make_generator(context: GenerationContext) -> ViewGenerator:
    """The back-end that the configuration names. Raises `UserError` for an unknown name."""
    name = context.config.backend
    if name not in BACKENDS:
        raise UserError(f"unknown back-end {name!r}", where="generator.backend", fix=did_you_mean(name, BACKENDS))
    return BACKENDS[name](context)


@dataclass(frozen=True, slots=True)
class ReplayGenerator:
    """Recorded candidates: the picture, or the folder of pictures, that the round names in ``scene.yaml``."""

    context: GenerationContext

    def generate(self, references: ViewSet, prompt: str) -> list[Candidate]:
        """All recorded pictures, in natural order. See `ViewGenerator`."""
        context = self.context
        where = f"round {context.round_number} of {context.scene_folder}"
        if context.spec.inserted is None:
            raise UserError(
                "has no recorded picture",
                where=where,
                fix="add 'inserted: FILE' to the round in scene.yaml, or give one with generator.backend=file",
            )
        target = require_inside(context.scene_folder / context.spec.inserted, context.scene_folder, where=where)
        paths = list_pictures(target, inside=context.scene_folder) if target.is_dir() else [target]
        candidates = [_stored(path, context.scene_folder, "replay", prompt, references) for path in paths]
        digests = [candidate.provenance.sha256 for candidate in candidates]
        digest = sha256_of_bytes("".join(digests).encode()) if target.is_dir() else digests[0]
        if context.spec.inserted_sha256 not in (None, digest):
            raise UserError(
                f"{context.spec.inserted} changed since the scene was prepared", where=where, fix="prepare it again"
            )
        return candidates


@dataclass(frozen=True, slots=True)
class FileGenerator:
    """The user's own picture, from anywhere on the disk."""

    context: GenerationContext

    def generate(self, references: ViewSet, prompt: str) -> list[Candidate]:
        """The one picture. Relative paths start at the working directory. See `ViewGenerator`."""
        path = picture_file(self.context.config, self.context.round_number)
        if path is None:
            raise UserError("is not set", where="generator.file", fix="give the path of your picture")
        if os.path.isdir(path):
            raise UserError(f"{path} is a folder", where="generator.file", fix="give the path of one picture")
        return [_stored(path, path.parent, "file", prompt, references)]


def picture_file(config: GeneratorConfig, round_number: int) -> Path | None:
    """The picture outside of the scene folder that a round takes; None if it takes none, or none is named."""
    if config.backend != FILE_BACKEND or not config.file:
        return None
    named = config.file if os.path.isfile(config.file) else config.file.replace("{round}", str(round_number))
    return Path(os.path.expanduser(named))  # unlike Path's own, no error for a "~name" that is nobody's home


BACKENDS: dict[str, Callable[[GenerationContext], ViewGenerator]] = {
    "replay": ReplayGenerator,
    FILE_BACKEND: FileGenerator,
}


def _stored(path: Path, folder: Path, backend: str, prompt: str, references: ViewSet) -> Candidate:
    data = read_plain_file(path, limit_bytes=LIMIT_BYTES)
    provenance = Provenance(
        backend=backend,
        prompt=prompt,
        source=path.relative_to(folder).as_posix(),
        sha256=sha256_of_bytes(data),
        reference_sha256=tuple(record.sha256 for record in references.records),
    )
    return Candidate(data=data, name=path.name, provenance=provenance)
