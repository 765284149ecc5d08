"""``study.yaml`` and videos -> a folder with one page per participant, ready to be served."""

from __future__ import annotations

import csv
import hashlib
import io
import secrets
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from PIL import Image

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.store import sha256_of_file
from sceneexpander.artifacts.views import to_uint8
from sceneexpander.errors import UserError
from sceneexpander.files import directory_being_written, write_bytes_atomic
from sceneexpander.plainfiles import require_plain_file
from sceneexpander.study.design import PlannedScreen, make_numpy_generator, plan_screens
from sceneexpander.study.document import ANSWERS_NAME, LINKS_NAME, Participant, Screen, Study, StudyScene
from sceneexpander.study.page import PagePicture, study_page
from sceneexpander.study.spec import SceneSpec, StudySpec
from sceneexpander.study.videos import VideoFacts, copy_video, degrade_video

_PICTURE_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class _Material:
    """A scene with everything looked up."""

    name: str
    prompt: str
    picture: Image.Image | None
    videos: dict[str, Path]


def build_study(spec: StudySpec, base: Path, folder: Path, *, address: str = "http://127.0.0.1:8090") -> Study:
    """Make the folder of a study.

    Args:
        spec: what the researcher wrote.
        base: folder that paths in it are relative to.
        folder: to be made; must not exist, since a study that people have answered is not to be replaced.
        address: under which participants will reach the server, for their links.

    Raises:
        UserError: a file is missing or none that can be shown, or videos of a scene differ in size, length or frame rate.
    """
    if folder.exists():
        answered = ", and it holds answers" if (folder / ANSWERS_NAME).exists() else ""
        raise UserError(f"exists{answered}", where=folder, fix="name another --out, or move it away")
    if not address.startswith(("http://", "https://")) or any(letter in address for letter in " ?#"):
        raise UserError(
            f"is {address!r}", where="--address", fix="give http://NAME or https://NAME, with a port or a path"
        )
    materials = [_look_up(scene, base, spec.compared) for scene in spec.scenes]
    with directory_being_written(folder) as scratch:
        videos = scratch / "videos"
        scenes = [_copy_scene(material, videos) for material in materials]
        pictures = {material.name: material.picture for material in materials}
        chooser = make_numpy_generator(spec.seed, "study/catch videos")
        for number in range(1, spec.catch.scenes + 1):
            model = materials[int(chooser.integers(len(materials)))]
            method = spec.compared[int(chooser.integers(len(spec.compared)))]
            catch = _make_catch(f"catch_{number}", model, method, len(spec.compared), videos, spec.seed)
            scenes.append(catch)
            pictures[catch.name] = model.picture
        tokens = [secrets.token_urlsafe(24) for _ in range(spec.participants)]
        participants = enrol_participants(spec, scenes, tokens)
        study = Study(
            version=version("sceneexpander"),
            title=spec.title,
            seed=spec.seed,
            minimum_s=spec.minimum_s,
            catch=spec.catch,
            methods=spec.compared,
            scenes=tuple(scenes),
            participants=participants,
            video_sha256={path.stem: sha256_of_file(path) for path in sorted(videos.iterdir())},
            page_sha256={},
            key=secrets.token_hex(32),
        )
        shown = {name: PagePicture.of(picture) for name, picture in pictures.items() if picture is not None}
        digests = {}
        for participant in participants:
            page = study_page(study, participant, spec, shown).encode()
            write_bytes_atomic(scratch / "pages" / f"{participant.name}.html", page)
            digests[participant.name] = hashlib.sha256(page).hexdigest()
        study = replace(study, page_sha256=digests)
        study.save(scratch)
        _write_links(participants, tokens, address, scratch / LINKS_NAME)
    return study


def _look_up(scene: SceneSpec, base: Path, methods: Sequence[str]) -> _Material:
    videos = {method: base / path for method, path in scene.videos.items()}
    prompt, picture = scene.prompt, None
    if scene.picture is not None:
        picture = _open_picture(base / scene.picture)
    if scene.folder is not None:
        outputs = base / scene.folder
        made = outputs / f"round_{scene.round}"
        for method in methods:
            videos.setdefault(method, made / "renders" / method / "rgb.mp4")
        prompt = prompt or Scene.load(outputs / "scene").round_spec(scene.round).prompt
        if picture is None:
            picture = Image.fromarray(to_uint8(InsertedView.load(made / "inserted").view.images[0]))
    for path in videos.values():
        require_plain_file(path)
    return _Material(
        name=scene.name, prompt=prompt, picture=picture, videos={method: videos[method] for method in methods}
    )


def _open_picture(path: Path) -> Image.Image:
    facts = require_plain_file(path)
    if facts.st_size > _PICTURE_BYTES:
        raise UserError("is too large for a picture", where=path)
    try:
        with Image.open(path) as picture:
            return picture.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise UserError("cannot be read as a picture", where=path) from None


def _copy_scene(material: _Material, videos: Path) -> StudyScene:
    names: dict[str, str] = {}
    first: tuple[Path, VideoFacts] | None = None
    for method, source in material.videos.items():
        names[method] = secrets.token_hex(16)
        facts = copy_video(source, videos / f"{names[method]}.mp4")
        if first is None:
            first = source, facts
        elif facts != first[1]:
            raise UserError(
                f"is {facts}, but {first[0]} is {first[1]}",
                where=source,
                fix="videos of a scene must be alike in everything but the method",
            )
    return StudyScene(name=material.name, prompt=material.prompt, catch=False, videos=names)


def _make_catch(name: str, model: _Material, method: str, count: int, videos: Path, seed: int) -> StudyScene:
    names = {}
    for level in range(count):
        names[f"level_{level}"] = secrets.token_hex(16)
        noise = make_numpy_generator(seed, f"study/{name}")  # the same in all of them: only its share differs
        with tempfile.TemporaryDirectory(dir=videos) as scratch:
            made = Path(scratch) / "made.mp4"
            degrade_video(model.videos[method], made, level / (count - 1), noise)
            copy_video(made, videos / f"{names[f'level_{level}']}.mp4")
    return StudyScene(name=name, prompt=model.prompt, catch=True, videos=names)


def enrol_participants(spec: StudySpec, scenes: Sequence[StudyScene], tokens: Sequence[str]) -> tuple[Participant, ...]:
    """Participants and their screens.

    Args:
        spec: for methods, number of participants and seed.
        scenes: catch scenes included.
        tokens: one for each participant.
    """
    by_name = {scene.name: scene for scene in scenes}
    plans = plan_screens(
        [scene.name for scene in scenes if not scene.catch],
        [scene.name for scene in scenes if scene.catch],
        spec.compared,
        spec.participants,
        spec.seed,
    )
    width = max(2, len(str(spec.participants)))
    return tuple(
        Participant(
            name=f"p{index:0{width}}",
            token_sha256=hashlib.sha256(token.encode()).hexdigest(),
            screens=tuple(
                _make_screen(number, planned, by_name, spec.compared) for number, planned in enumerate(plan, start=1)
            ),
        )
        for index, (token, plan) in enumerate(zip(tokens, plans, strict=True), start=1)
    )


def _make_screen(
    number: int, planned: PlannedScreen, scenes: Mapping[str, StudyScene], methods: Sequence[str]
) -> Screen:
    scene = scenes[planned.scene]
    # Levels of a catch scene take the places that the design gives to methods.
    shown = dict(zip(methods, scene.videos.values(), strict=True)) if scene.catch else scene.videos
    videos = tuple(shown[method] for method in planned.methods)
    return Screen(name=f"s{number:02}", scene=scene.name, criterion=planned.criterion, videos=videos)


def _write_links(participants: Sequence[Participant], tokens: Sequence[str], address: str, path: Path) -> None:
    text = io.StringIO()
    lines = csv.writer(text)
    lines.writerow(("participant", "link"))
    for participant, token in zip(participants, tokens, strict=True):
        lines.writerow((participant.name, f"{address.rstrip('/')}/p/{token}/"))
    write_bytes_atomic(path, text.getvalue().encode())
    path.chmod(0o600)
