"""Pictures that are there already: recorded with the scene (``replay``), or anywhere on the disk (``file``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.candidates import Candidate, CandidateSet
from sceneexpander.artifacts.inserted import Provenance
from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.errors import UserError
from sceneexpander.generation.config import GeneratorConfig, picture_path
from sceneexpander.generation.prompt import fill_prompt
from sceneexpander.generation.protocol import Forecast, GenerationContext, SceneSoFar
from sceneexpander.ingest.decode import LIMIT_BYTES
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.survey import list_pictures
from sceneexpander.plainfiles import read_plain_file


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayConfig(GeneratorConfig):
    """Settings of ``replay``: none."""

    backend: str = "replay"


@dataclass(frozen=True, slots=True)
class ReplayGenerator:
    """Recorded candidates: the picture, or the folder of pictures, that the round names in ``scene.yaml``."""

    config: ReplayConfig

    def check(self, context: GenerationContext) -> Forecast:
        """All recorded pictures, in natural order. See `ViewGenerator`."""
        if context.spec.inserted is None:
            raise UserError(
                "has no recorded picture",
                where=context.where,
                fix="add 'inserted: FILE' to the round in scene.yaml, or have one made, e.g. with generator=reproject",
            )
        folder = context.scene_folder if context.recorded is None else context.recorded
        target = require_inside(folder / context.spec.inserted, folder, where=context.where)
        paths = list_pictures(target, inside=folder) if target.is_dir() else [target]
        candidates = [stored_candidate(path, context, "replay", folder=folder) for path in paths]
        digests = [candidate.provenance.sha256 for candidate in candidates]
        digest = sha256_of_bytes("".join(digests).encode()) if target.is_dir() else digests[0]
        if context.spec.inserted_sha256 not in (None, digest):
            problem = f"{context.spec.inserted} changed since the scene was prepared"
            raise UserError(problem, where=context.where, fix="prepare it again")
        return Forecast(prompt=fill_prompt(context.spec), stored=tuple(candidates))

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """The same pictures."""
        return CandidateSet(round=context.round_number, candidates=self.check(context).stored)


@dataclass(frozen=True, slots=True, kw_only=True)
class FileConfig(GeneratorConfig):
    """Settings of ``file``. ``{round}`` in the path ``file`` becomes the round's number."""

    backend: str = "file"
    file: str | None = None

    def named_file(self, round_number: int) -> Path | None:
        """The picture."""
        return picture_path(self.file, round_number) if self.file else None


@dataclass(frozen=True, slots=True)
class FileGenerator:
    """The user's own picture, from anywhere on the disk."""

    config: FileConfig

    def check(self, context: GenerationContext) -> Forecast:
        """The one picture. Relative paths start at the working directory. See `ViewGenerator`."""
        path = self.config.named_file(context.round_number)
        if path is None:
            raise UserError("is not set", where="generator.file", fix="give the path of your picture")
        picture = own_picture(path, context, where="generator.file")
        return Forecast(prompt=fill_prompt(context.spec), stored=(picture,))

    def generate(self, context: GenerationContext, so_far: SceneSoFar) -> CandidateSet:
        """The same picture."""
        return CandidateSet(round=context.round_number, candidates=self.check(context).stored)


def own_picture(path: Path, context: GenerationContext, *, where: str) -> Candidate:
    """The picture at a path that the user set. Raises `UserError` if it is no file."""
    if os.path.isdir(path):
        raise UserError(f"{path} is a folder", where=where, fix="give the path of one picture")
    return stored_candidate(path, context, "file", folder=path.parent)


def stored_candidate(path: Path, context: GenerationContext, backend: str, *, folder: Path) -> Candidate:
    """A picture file as a candidate; ``folder`` is what its recorded name is relative to."""
    data = read_plain_file(path, limit_bytes=LIMIT_BYTES)
    provenance = Provenance(
        backend=backend,
        prompt=fill_prompt(context.spec),
        source=path.relative_to(folder).as_posix(),
        sha256=sha256_of_bytes(data),
        reference_sha256=tuple(record.sha256 for record in context.captured.records),
    )
    return Candidate(data=data, name=path.name, provenance=provenance)
