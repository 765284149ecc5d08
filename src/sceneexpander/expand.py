"""Your own photos, one command: ``python -m sceneexpander.expand PHOTOS --inserted PICTURE --prompt "..."``.

``PHOTOS`` is a folder of photos, or a scene folder with a ``scene.yaml``. Runs unattended in ``runs/NAME`` and prints where the report is.
The methods are those that the project selects.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from sceneexpander.errors import UserError, entry_point
from sceneexpander.ingest import make_round, read_picture, safe_name, survey_pictures
from sceneexpander.plainfiles import require_folder
from sceneexpander.preflight import check_scene
from sceneexpander.project import find_project
from sceneexpander.workspace import Selection, make_workspace, merged_overrides, read_selection, reproduce

SCENE_FILE = "scene.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What the user asked for. Round k takes the k-th of ``inserted`` and ``prompts``."""

    photos: Path
    inserted: tuple[Path, ...] = ()
    prompts: tuple[str, ...] = ()
    motions: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    name: str | None = None
    overrides: tuple[str, ...] = ()


def parse_arguments(arguments: Sequence[str]) -> Request:
    """The command line as a `Request`."""
    parser = argparse.ArgumentParser(prog="python -m sceneexpander.expand", description=__doc__)
    parser.add_argument("photos", type=Path, help="folder of photos, or a scene folder with scene.yaml")
    parser.add_argument("--inserted", type=Path, action="append", default=[], help="picture to insert, one per round")
    parser.add_argument("--prompt", action="append", default=[], help="what to add, one per round")
    parser.add_argument("--motion", action="append", default=[], help="camera motion, e.g. 'turn right'")
    parser.add_argument("--object", action="append", default=[], help="new object, e.g. 'a wooden bench'")
    parser.add_argument("--name", help="name of the run (default: the folder's)")
    parser.add_argument("overrides", nargs="*", help="configuration, e.g. profile=smoke adapt.steps=50")
    given = parser.parse_intermixed_args(list(arguments))
    for override in given.overrides:
        if "=" not in override:
            raise UserError("is not a setting", where=override, fix="write key=value, e.g. profile=smoke")
    return Request(
        photos=given.photos,
        inserted=tuple(given.inserted),
        prompts=tuple(given.prompt),
        motions=tuple(given.motion),
        objects=tuple(given.object),
        name=given.name,
        overrides=tuple(given.overrides),
    )


def stage_scene(request: Request, name: str, target: Path) -> None:
    """Put the scene together as a folder with ``scene.yaml``: a copy of a scene folder, or made from photos and options.

    Raises:
        UserError: the folder, a picture or an option is unusable.
    """
    photos = request.photos
    require_folder(photos, expected="a folder of photos")
    words = (request.prompts, request.motions, request.objects, request.inserted)
    if (photos / SCENE_FILE).is_file():
        if any(words):
            raise UserError(
                "says itself what to add", where=photos / SCENE_FILE, fix="leave out --prompt, --inserted and the like"
            )
        shutil.copytree(photos, target, symlinks=False)
        return
    count = max(len(item) for item in words)
    specs = [
        make_round(
            _at(request.prompts, k),
            motion=_at(request.motions, k),
            new_object=_at(request.objects, k),
            where="--prompt",
        )
        for k in range(max(count, 1))
    ]
    captured = target / "captured"
    captured.mkdir(parents=True)
    survey = survey_pictures(photos)
    for path in survey.pictures:
        shutil.copyfile(path, captured / path.name)
    rounds = []
    for k, spec in enumerate(specs):
        if k >= len(request.inserted):
            raise UserError(
                f"round {k + 1} has no picture", where="--inserted", fix="give one --inserted PICTURE for each round"
            )
        source = request.inserted[k]
        read_picture(source, max_megapixels=200.0)
        # The content decides what it is: an ending is for people, and may be as odd or long as the whole name.
        ending = source.suffix.lower() if re.fullmatch(r"\.[A-Za-z0-9]{1,8}", source.suffix) else ""
        copy = Path("inserted") / f"round_{k + 1}{ending}"
        (target / copy).parent.mkdir(exist_ok=True)
        shutil.copyfile(source, target / copy)
        words_of_round = {"prompt": spec.prompt, "motion": spec.motion, "object": spec.new_object}
        rounds.append({**{key: text for key, text in words_of_round.items() if text}, "inserted": copy.as_posix()})
    # The copy holds nothing but photos: what else was there is told by the notes alone.
    content = {"name": name, "rounds": rounds, **({"notes": list(survey.notes)} if survey.notes else {})}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    (target / SCENE_FILE).write_text(text, encoding="utf-8")


def _at(items: Sequence[str], index: int) -> str:
    return items[index] if index < len(items) else ""


def expand(request: Request, *, project: Path) -> Path:
    """Check the request, run the pipeline in ``runs/NAME`` and return the report page.

    Raises:
        UserError: the input is unusable (nothing has run then), or a stage refused it.
        RuntimeError: a stage failed for another reason.
    """
    require_folder(request.photos, expected="a folder of photos")
    name = safe_name(request.name or request.photos.resolve().name, fallback="scene")
    folder = project / "runs" / name
    with tempfile.TemporaryDirectory(prefix="sceneexpander-") as scratch:
        scene = Path(scratch) / name
        stage_scene(request, name, scene)
        overrides = merged_overrides((), request.overrides)
        methods = read_selection(project).methods
        rounds = check_scene(name, scene, conf=project / "conf", overrides=overrides, methods=methods)
        selection = Selection(scenes=(name,), rounds=rounds, methods=methods, overrides=overrides)
        make_workspace(folder, selection, project=project, scenes={name: scene})
    reproduce(folder, project=project)
    return folder / "outputs" / "report" / "index.html"


@entry_point
def main() -> None:
    """Command line."""
    request = parse_arguments(sys.argv[1:])
    try:
        page = expand(request, project=find_project())
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    print(f"report: {page}")


if __name__ == "__main__":
    main()
