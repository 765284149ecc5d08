"""``study.json``: the whole study, with the key from videos to methods. Whoever has it is not blind."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import read_json, read_typed, sha256_of_file, to_plain, write_json_atomic
from sceneexpander.errors import UserError
from sceneexpander.study.spec import CatchRule, Criterion

SCHEMA = "study/1"
STUDY_NAME, ANSWERS_NAME, LINKS_NAME = "study.json", "answers.sqlite", "links.csv"
REBUILD = "build the study again, or take the file from a copy"


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyScene:
    """A scene and its videos by method. Of a catch scene the "methods" are levels, the best one first."""

    name: str
    prompt: str
    catch: bool
    videos: dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """One screen of a participant; ``videos`` are the names of A, B, C, ..."""

    name: str
    scene: str
    criterion: Criterion
    videos: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Participant:
    """Screens in their order. The token itself is in the participant's link and nowhere else."""

    name: str
    token_sha256: str
    screens: tuple[Screen, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What `build_study` made.

    Attributes:
        version: of the package that built it.
        title: heading of the pages.
        seed: of the orders.
        minimum_s: seconds for which a screen must have been open.
        catch: screens with a known answer.
        methods: in the order of the tables.
        scenes: catch scenes included.
        participants: with their screens.
        video_sha256: by name of the video.
        page_sha256: by name of the participant.
        key: secret, hexadecimal; seals answers and makes completion codes.
    """

    version: str
    title: str
    seed: int
    minimum_s: float
    catch: CatchRule
    methods: tuple[str, ...]
    scenes: tuple[StudyScene, ...]
    participants: tuple[Participant, ...]
    video_sha256: dict[str, str]
    page_sha256: dict[str, str]
    key: str

    @property
    def digest(self) -> str:
        """SHA-256 of everything that is in it."""
        return _digest(to_plain(self))

    def scene(self, name: str) -> StudyScene:
        """The scene of a name."""
        return next(scene for scene in self.scenes if scene.name == name)

    def sign(self, *parts: str) -> str:
        """Keyed digest (HMAC-SHA-256) of texts, hexadecimal."""
        return hmac.new(bytes.fromhex(self.key), json.dumps(parts).encode(), "sha256").hexdigest()

    def save(self, folder: Path) -> None:
        """Write ``study.json``, readable by its owner alone."""
        path = folder / STUDY_NAME
        write_json_atomic(path, {**to_plain(self), "schema": SCHEMA, "digest": self.digest})
        path.chmod(0o600)

    @classmethod
    def load(cls, folder: Path, *, files: bool = False) -> Study:
        """Read what `save` wrote.

        Args:
            folder: of the study.
            files: compare pages and videos with their digests as well.

        Raises:
            UserError: a file is missing, was changed, or is of another kind; names it.
        """
        path = folder / STUDY_NAME
        if not path.exists():
            raise UserError(
                "holds no study.json", where=folder, fix="build it first: sceneexpander study build study.yaml"
            )
        content = read_json(path)
        if not isinstance(content, dict) or content.pop("schema", None) != SCHEMA:
            raise UserError(f"is not of schema {SCHEMA!r}", where=path, fix=REBUILD)
        recorded = content.pop("digest", None)
        if recorded != _digest(content):
            raise UserError("was changed after it was built", where=path, fix=REBUILD)
        study = read_typed(cls, content, path, fix=REBUILD)
        study._check(path)
        if files:
            _compare(folder / "videos", ".mp4", study.video_sha256)
            _compare(folder / "pages", ".html", study.page_sha256)
        return study

    def _check(self, path: Path) -> None:
        """What no study that was built can lack, whoever computed its digest."""
        scenes = {scene.name: scene for scene in self.scenes}
        for participant in self.participants:
            for screen in participant.screens:
                scene = scenes.get(screen.scene)
                if scene is None or sorted(screen.videos) != sorted(scene.videos.values()):
                    raise UserError(
                        f"{participant.name}, {screen.name}: shows other videos than its scene has",
                        where=path,
                        fix=REBUILD,
                    )
        for scene in self.scenes:
            if not scene.catch and sorted(scene.videos) != sorted(self.methods):
                raise UserError(f"scene {scene.name!r} has other methods than the study", where=path, fix=REBUILD)


def _digest(plain: object) -> str:
    return hashlib.sha256(json.dumps(plain, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _compare(folder: Path, ending: str, digests: Mapping[str, str]) -> None:
    for name, digest in digests.items():
        path = folder / f"{name}{ending}"
        if not path.is_file():
            raise UserError("does not exist", where=path, fix=REBUILD)
        if sha256_of_file(path) != digest:
            raise UserError("was changed after it was built", where=path, fix=REBUILD)
