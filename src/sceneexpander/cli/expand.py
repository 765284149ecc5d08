"""Your own photos, one command: ``sceneexpander expand PHOTOS --prompt "..." --inserted PICTURE``.

``PHOTOS`` is a folder of photos, a scene folder with a ``scene.yaml``, a video, a COLMAP model, a ``transforms.json``, what else
`sceneexpander.ingest.sources` reads, or a ZIP archive of any of these. The picture beyond their boundary is your own (``--inserted``),
or made from the words (``--generator``). Runs in ``runs/NAME`` and prints where the report is. Methods and settings are those of the
project's params.yaml; ``key=value`` adds to them. ``--continue NAME`` goes on from a finished run, see `sceneexpander.cli.growing`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.cli import growing
from sceneexpander.cli.run_folder import (
    NO_PICTURE,
    SCENE_FILE,
    SOURCE_FILE,
    agree_to_requests,
    announce_forecasts,
    inserted_name,
    scratch_folder,
    shown_as_given,
)
from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, entry_point, printable
from sceneexpander.files import write_bytes_atomic
from sceneexpander.generation import backend_of
from sceneexpander.ingest import IngestConfig, make_round, read_picture, safe_name, scene_files
from sceneexpander.ingest.archives import is_archive, unpack_archive
from sceneexpander.ingest.sources import read_capture
from sceneexpander.ingest.sources.capture import name_some
from sceneexpander.ingest.sources.posed import write_posed_photos
from sceneexpander.ingest.survey import NoPicturesError, natural_key
from sceneexpander.pipeline.locks import run_lock
from sceneexpander.pipeline.preflight import check_scene
from sceneexpander.pipeline.processes import ended_by_signals
from sceneexpander.pipeline.project import find_project
from sceneexpander.pipeline.selection import MOST_ROUNDS, PARAMS, Selection, check_methods, check_name, read_selection
from sceneexpander.pipeline.workspace import make_workspace, merged_overrides, reproduce
from sceneexpander.plainfiles import require_plain_file
from sceneexpander.report.cameras import camera_lines

UNPACKED = ".unpacked"  # while a run is put together: what an archive holds


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What the user asked for. Round k takes the k-th of ``inserted`` and ``prompts``."""

    photos: Path
    inserted: tuple[Path, ...] = ()
    prompts: tuple[str, ...] = ()
    motions: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    name: str | None = None
    methods: tuple[str, ...] = ()  # empty: those of params.yaml
    overrides: tuple[str, ...] = ()
    unattended: bool = False  # requests that cost something are sent without asking
    dry_run: bool = False


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "expand",
        "Expand the scene of your own photos. Methods and settings are those of the project's params.yaml; key=value adds to them.",
        examples=[
            '~/pictures/terrace --inserted bench.png --prompt "Behind the white table is a wooden bench."',
            "~/scenes/terrace --name try_2 profile=smoke adapt.steps=50",
            '--continue terrace --generator reproject --motion "turn left 30 degrees"',
            "--continue terrace --propose",
            '--continue terrace --from-round 1 --as terrace_lake --inserted lake.png --prompt "To the left is a lake."',
        ],
    )
    parser.add_argument(
        "photos",
        type=Path,
        metavar="PHOTOS",
        nargs="?",
        help="folder of photos, scene folder with scene.yaml, video, COLMAP model, transforms.json, or one of these as ZIP",
    )
    parser.add_argument("--inserted", type=Path, action="append", default=[], help="picture to insert, one per round")
    parser.add_argument("--prompt", action="append", default=[], help="what to add, one per round")
    parser.add_argument("--motion", action="append", default=[], help="camera motion, e.g. 'turn right'")
    parser.add_argument("--object", action="append", default=[], help="new object, e.g. 'a wooden bench'")
    parser.add_argument("--generator", help="what makes the picture where none is given: reproject, openai, ...")
    parser.add_argument("--candidates", type=int, help="how many pictures it makes to choose from")
    parser.add_argument("--choose", help="auto (default), the number of a candidate, or a picture of your own")
    parser.add_argument("--yes", action="store_true", help="send requests that cost something without asking")
    parser.add_argument("--dry-run", action="store_true", help="print what would be asked for, and stop")
    parser.add_argument("--name", help="name of the run (default: the folder's)")
    parser.add_argument(
        "--methods", metavar="NAME,...", help="rows of its tables, e.g. captured,sceneexpander (default: params.yaml's)"
    )
    parser.add_argument("--continue", dest="continued", metavar="NAME", help="add a round to this finished run")
    parser.add_argument("--undo", action="store_true", help="with --continue: take its last round away")
    parser.add_argument("--propose", action="store_true", help="with --continue: print motions that show something new")
    parser.add_argument("--from-round", type=int, metavar="K", help="with --continue and --as: the round to go on from")
    parser.add_argument(
        "--as", dest="branch", metavar="NEWNAME", help="with --continue: a run of its own for what follows"
    )
    parser.add_argument("--anyway", action="store_true", help="with --continue: also after a round that failed")
    # No default: argparse would count settings, of which there may be none, among the arguments that are missing.
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", default=[], help="configuration, e.g. profile=smoke"
    )
    return parser


def read_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line, options that belong together checked.

    Raises:
        UserError: photos or --continue are missing, or an option has no meaning with the others.
    """
    parser = make_parser()
    given = parser.parse_intermixed_args(list(arguments))
    if given.continued is None:
        of_runs = {"--undo": given.undo, "--propose": given.propose, "--from-round": given.from_round is not None}
        of_runs |= {"--as": given.branch is not None, "--anyway": given.anyway}
        for option, used in of_runs.items():
            if used:
                raise UserError("belongs to a finished run", where=option, fix="name it with --continue")
        if given.photos is None:
            parser.error("the following arguments are required: PHOTOS")
        return given
    if given.photos is not None:
        raise UserError("a run goes on with its own photos and settings", where=str(given.photos), fix="leave it out")
    if given.name is not None:
        raise UserError("is the name of a new run", where="--name", fix="--as names what goes another way")
    if given.methods is not None:
        raise UserError("a run goes on with its own methods", where="--methods", fix="leave it out")
    words = {"--inserted": given.inserted, "--prompt": given.prompt, "--motion": given.motion, "--object": given.object}
    for option, values in words.items():
        if len(values) > 1:
            raise UserError("rounds are added one by one", where=option, fix="give it once")
    adding = [option for option, values in words.items() if values]
    adding += ["--generator"] * bool(_settings(given)) + ["--as"] * (given.branch is not None)
    if given.undo and (adding or given.propose or given.from_round is not None):
        raise UserError("only takes the last round away", where="--undo", fix="leave out the other options")
    if given.propose and adding:
        raise UserError("only prints motions", where="--propose", fix=f"leave out {adding[0]}")
    return given


def _settings(given: argparse.Namespace) -> tuple[str, ...]:
    """How pictures are obtained, as overrides."""
    options = {
        "generator": given.generator,
        "generator.candidates": given.candidates,
        "choose.candidate": given.choose,
    }
    return tuple(f"{key}={value}" for key, value in options.items() if value is not None)


def parse_arguments(arguments: Sequence[str]) -> Request:
    """The command line as a `Request`."""
    return request_of(read_arguments(arguments))


def request_of(given: argparse.Namespace) -> Request:
    """What was given for a folder of photos."""
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
        methods=() if given.methods is None else check_methods(given.methods.split(","), where="--methods"),
        overrides=(*_settings(given), *given.overrides),
        unattended=given.yes,
        dry_run=given.dry_run,
    )


def stage_scene(
    request: Request, name: str, target: Path, *, ingest: IngestConfig | None = None, recorded: bool = True
) -> None:
    """Put the scene together as a folder with ``scene.yaml``: a copy of a scene folder, or made from photos and options.

    A copy holds what ``scene.yaml`` names and nothing else, as plain files that can be written. Photos are read later; ``ingest`` says how,
    and what is taken of a video or of more posed pictures than are used. ``recorded``: every round needs a picture of the user's.

    Raises:
        UserError: the folder, a picture or an option is unusable.
    """
    photos = request.photos
    require_readable(photos)
    words = (request.prompts, request.motions, request.objects, request.inserted)
    if (photos / SCENE_FILE).is_file():
        if any(words):
            raise UserError(
                "says itself what to add", where=photos / SCENE_FILE, fix="leave out --prompt, --inserted and the like"
            )
        for path in scene_files(photos):
            _copy(path, target / path.relative_to(photos))
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
    ingest = IngestConfig() if ingest is None else ingest
    try:
        capture = read_capture(photos, ingest)
    except NoPicturesError:
        _refuse_several_scenes(photos)
        raise
    if any(shot.calibrated or shot.mask or shot.depth or isinstance(shot.picture, bytes) for shot in capture.shots):
        write_posed_photos(capture, target / "captured", ingest)
    else:
        for shot in capture.shots:
            if isinstance(shot.picture, Path):
                _copy(shot.picture, target / "captured" / shot.picture.name)
    rounds = []
    for k, spec in enumerate(specs):
        words_of_round = {"prompt": spec.prompt, "motion": spec.motion, "object": spec.new_object}
        facts = {key: text for key, text in words_of_round.items() if text}
        if k < len(request.inserted):
            source = request.inserted[k]
            require_plain_file(source)
            read_picture(source, max_megapixels=ingest.max_megapixels)
            copy = inserted_name(k + 1, source)
            _copy(source, target / copy)
            facts["inserted"] = copy.as_posix()
        elif recorded:
            raise UserError(f"round {k + 1} has no picture", where="--inserted", fix=NO_PICTURE)
        rounds.append(facts)
    # The copy holds nothing but photos: what else was there is told by the notes alone.
    content = {"name": name, "rounds": rounds, **({"notes": list(capture.notes)} if capture.notes else {})}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    (target / SCENE_FILE).write_text(text, encoding="utf-8")


def _refuse_several_scenes(folder: Path) -> None:
    """Raise `UserError` if the folder is one of scene folders, as a project's ``scenes/`` is."""
    names = sorted((path.parent.name for path in folder.glob(f"*/{SCENE_FILE}")), key=natural_key)
    if names:
        fix = f"expand one of them, or name them in 'scenes:' of the {PARAMS} beside a folder scenes/, and 'sceneexpander run'"
        raise UserError(
            f"is a folder of scene folders ({name_some([printable(name) for name in names])})", where=folder, fix=fix
        )


def _copy(source: Path, target: Path) -> None:
    """Copy the content of a file, through a link too."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def _is_text(text: str) -> bool:
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def _at(items: Sequence[str], index: int) -> str:
    return items[index] if index < len(items) else ""


def require_readable(place: Path) -> None:
    """Raise `UserError` unless ``place`` leads to a folder or a plain file."""
    try:
        if place.is_dir():
            return
    except (OSError, ValueError):
        pass  # the next call says what is wrong
    require_plain_file(place)


def run_name(request: Request) -> str:
    """The name of the run and of its scene: the one that was asked for, or the folder's, in plain letters.

    Raises:
        UserError: the pipeline itself uses this name.
    """
    given = request.name if request.name is not None else _place_name(request.photos)
    name = safe_name(given, fallback="scene")
    check_name(name, where="--name" if request.name is not None else request.photos, fix="choose another --name")
    return name


def _place_name(place: Path) -> str:
    """Of a file its name without the ending; of a ``transforms.json`` that of its folder."""
    place = place.resolve()
    if place.is_dir():
        return place.name
    return place.parent.name if place.suffix.casefold() == ".json" else place.stem


def check_source(folder: Path, request: Request) -> None:
    """Raise `UserError` if the run in ``folder`` is of other photos, or has grown since: two folders may have one name, or names reduced
    to one, and rounds that were added would be lost.
    """
    try:
        known: dict[str, Any] = json.loads((folder / SOURCE_FILE).read_text(encoding="utf-8"))
        photos, branch_of = Path(known["photos"]), known.get("branch_of")
        rounds = int(known.get("rounds", MOST_ROUNDS))  # earlier versions did not note it
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError("is damaged", where=folder / SOURCE_FILE, fix="choose another --name") from None
    if branch_of is not None:
        fix = "choose another --name, or go on with --continue"
        raise UserError(f"is a branch of the run {branch_of}", where=folder, fix=fix)
    if photos != _identity(request):
        raise UserError(f"holds another folder's scene ({photos})", where=folder, fix="choose another --name")
    if (folder / PARAMS).is_file() and read_selection(folder).rounds > rounds:
        fix = "go on with --continue, take them back with --undo, or choose another --name"
        raise UserError("has rounds that were added to it", where=folder, fix=fix)


def _identity(request: Request) -> Path:
    return request.photos.resolve()


def _check_words(request: Request) -> None:
    named = {"--prompt": request.prompts, "--motion": request.motions, "--object": request.objects}
    named |= {"--name": (request.name or "",)}
    for option, texts in named.items():
        if not all(map(_is_text, texts)):
            raise UserError("holds a byte that is not valid text", where=option, fix="write it in UTF-8")


def expand(request: Request, *, project: Path) -> Path | None:
    """Check the request, run the pipeline in ``runs/NAME`` and return the report page; of a dry run None.

    Raises:
        UserError: the input is unusable (nothing has run then), somebody else works on this run, or a stage refused the input.
        RuntimeError: a stage failed for another reason.
    """
    _check_words(request)
    require_readable(request.photos)
    name = run_name(request)
    folder = project / "runs" / name
    base = read_selection(project)
    methods = request.methods or base.methods
    overrides = merged_overrides(base.overrides, request.overrides, project=project)
    config = parse_dataclass(ProjectConfig, compose(project / "conf", overrides))
    recorded = backend_of(config.generator).takes_recorded
    if request.inserted and not recorded:
        problem = f"is {config.generator.backend!r} and would take the place of --inserted"
        raise UserError(problem, where="generator.backend", fix="leave one of them out (here or in params.yaml)")
    # The lock comes first: nothing may change in a folder that another process works on.
    with run_lock(folder) as lock:
        check_source(folder, request)
        with scratch_folder(folder) as scratch:
            scene = scratch / name
            with shown_as_given({scratch / UNPACKED: request.photos}):
                source = request
                if is_archive(request.photos):
                    source = replace(request, photos=unpack_archive(request.photos, scratch / UNPACKED))
                with shown_as_given(_originals(scene, source)):
                    stage_scene(source, name, scene, ingest=config.scene, recorded=recorded)
                    checked = check_scene(name, scene, conf=project / "conf", overrides=overrides, methods=methods)
            announce_forecasts(checked.forecasts, config.generator.backend, details=request.dry_run)
            if request.dry_run:
                return None
            agree_to_requests(checked.forecasts, unattended=request.unattended)
            selection = Selection(scenes=(name,), rounds=checked.rounds, methods=methods, overrides=overrides)
            folder.mkdir(exist_ok=True)
            facts = {"photos": os.fsdecode(_identity(request)), "name": name, "rounds": checked.rounds}
            write_bytes_atomic(folder / SOURCE_FILE, f"{json.dumps(facts, indent=1)}\n".encode())
            make_workspace(folder, selection, project=project, scenes={name: scene}, move_scenes=True)
        reproduce(folder, project=project, lock=lock)
    return folder / "outputs" / "report" / "index.html"


def choice_lines(folder: Path, name: str, rounds: int) -> list[str]:
    """What became of the candidates of a finished run, where there were several, and how to take another."""
    lines = []
    for number in range(1, rounds + 1):
        place = folder / "outputs" / name / f"round_{number}" / "inserted"
        if not place.is_dir():
            continue
        inserted = InsertedView.load(place)
        if len(inserted.provenance) > 1:
            reason = f" ({inserted.ranking[0].reason})" if inserted.ranking else ""
            lines.append(f"round {number}: candidate {inserted.chosen} of {len(inserted.provenance)} was taken{reason}")
            lines.append(f"all of them: {place / 'sheet.png'}; the same command with --choose NUMBER takes another")
    return lines


def _originals(scene: Path, request: Request) -> dict[Path, Path]:
    """Where the parts of a scene that was put together come from."""
    if (request.photos / SCENE_FILE).is_file():
        return {scene: request.photos}
    pictures = {scene / inserted_name(k, path): path for k, path in enumerate(request.inserted, start=1)}
    return {**pictures, scene / "captured": request.photos, scene: request.photos}


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    given = read_arguments(sys.argv[1:] if arguments is None else arguments)
    project = find_project()
    if given.propose:
        for line in growing.proposal_lines(given.continued, given.from_round, project=project):
            print(printable(line))
        return
    try:
        with ended_by_signals():
            if given.continued is None:
                page = expand(request_of(given), project=project)
            elif given.undo:
                page = growing.undo_round(given.continued, project=project)
            else:
                page = growing.add_round(given.continued, growing.round_of(given, _settings(given)), project=project)
            if page is None:
                return
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    folder = page.parents[2]
    selection = read_selection(folder)
    chosen = choice_lines(folder, selection.scenes[0], selection.rounds)
    failed = growing.last_quality_line(folder)
    for line in [*camera_lines(page.parents[1]), *chosen, *([] if failed is None else [failed])]:
        print(printable(line))
    print(f"report: {page}")


if __name__ == "__main__":
    main()
