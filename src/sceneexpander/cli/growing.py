"""A finished run goes on: another round, the last one taken back, another way from an earlier one.

``sceneexpander expand --continue NAME`` works on ``runs/NAME``, which belongs to one process at a time. Settings and methods stay those
of the run, so nothing that is there runs again; how a new round's picture is obtained is the round's own. A branch is a run whose scene has
the same name: stages before it are those of the first run, and come from the cache.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.metrics import MetricsRow, load_row
from sceneexpander.artifacts.page import ScenePage
from sceneexpander.artifacts.proposals import Proposals
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.catalogue import MAIN
from sceneexpander.catalogue.methods import CAPTURED
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
from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import written_out
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.evaluation.quality import find_failures
from sceneexpander.files import write_bytes_atomic
from sceneexpander.generation import backend_of
from sceneexpander.ingest import make_round, read_picture
from sceneexpander.pipeline.disk import remove_tree
from sceneexpander.pipeline.locks import RunLock, run_lock
from sceneexpander.pipeline.preflight import check_scene
from sceneexpander.pipeline.selection import MOST_ROUNDS, PARAMS, Selection, check_name, read_selection
from sceneexpander.pipeline.workspace import make_workspace, reproduce
from sceneexpander.plainfiles import require_plain_file


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundRequest:
    """A round that is to follow.

    Attributes:
        prompt: what to add.
        motion: of the camera.
        new_object: what appears.
        inserted: the picture; None: it is made.
        settings: overrides of how it is obtained, the round's own.
        from_round: the round that it follows, 0 the captured scene; None: the last.
        branch: name of the run that it begins; None: it is added to the run itself.
        unattended: requests that cost something are sent without asking.
        dry_run: print what would be asked for, and stop.
        anyway: also after a round that failed quality control.
    """

    prompt: str = ""
    motion: str = ""
    new_object: str = ""
    inserted: Path | None = None
    settings: tuple[str, ...] = ()
    from_round: int | None = None
    branch: str | None = None
    unattended: bool = False
    dry_run: bool = False
    anyway: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether nothing is asked for: then a run that was interrupted is brought to its end."""
        words = self.prompt, self.motion, self.new_object, self.inserted, self.branch
        return not any(words) and not self.settings and self.from_round is None


def round_of(given: argparse.Namespace, settings: tuple[str, ...]) -> RoundRequest:
    """What the options of ``expand`` ask for, after ``--continue``."""
    return RoundRequest(
        prompt=next(iter(given.prompt), ""),
        motion=next(iter(given.motion), ""),
        new_object=next(iter(given.object), ""),
        inserted=next(iter(given.inserted), None),
        settings=settings,
        from_round=given.from_round,
        branch=given.branch,
        unattended=given.yes,
        dry_run=given.dry_run,
        anyway=given.anyway,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A folder of ``runs/`` with one scene."""

    folder: Path
    selection: Selection

    @property
    def scene(self) -> str:
        """Its scene's name; a branch has another one than its scene."""
        return self.selection.scenes[0]

    @property
    def outputs(self) -> Path:
        """What was made of the scene."""
        return self.folder / "outputs" / self.scene

    @property
    def source(self) -> Path:
        """The run's own copy of the scene folder."""
        return self.folder / "scenes" / self.scene

    @property
    def page(self) -> Path:
        """The report."""
        return self.folder / "outputs" / "report" / "index.html"

    @property
    def is_finished(self) -> bool:
        """Whether what was gathered for the page shows all of its rounds."""
        try:
            gathered = ScenePage.load(self.folder / "outputs" / "pages" / self.scene)
        except ArtifactError:
            return False
        return len(gathered.rounds) == self.selection.rounds and self.page.is_file()


def open_run(name: str, project: Path) -> Run:
    """The run of that name. Raises `UserError` if there is none, with a suggestion."""
    folder = project / "runs" / name
    known = sorted(path.parent.name for path in (project / "runs").glob(f"*/{PARAMS}"))
    if name not in known:
        fix = did_you_mean(name, known) if known else "expand a folder of photos first"
        raise UserError(f"there is no run {name!r}", where="--continue", fix=fix)
    selection = read_selection(folder)
    if len(selection.scenes) != 1:
        raise UserError("holds several scenes", where=folder, fix="continue a run that `expand` made")
    return Run(folder=folder, selection=selection)


def add_round(name: str, request: RoundRequest, *, project: Path) -> Path | None:
    """Add a round to a run, or begin a branch with it, and return the page; of a dry run None. Only the new round runs.

    Raises:
        UserError: there is no such run or round, words or picture are missing, the run is unfinished or its last round failed quality
            control, or somebody else works on it. Nothing has changed then.
        RuntimeError: a stage failed for another reason.
    """
    run = open_run(name, project)
    with run_lock(run.folder, what=run.folder) as lock:
        run = open_run(name, project)  # as it is, now that nobody else changes it
        if request.is_empty:
            if run.is_finished:
                raise UserError(
                    "says not what to add", where="--prompt", fix=f"{name} is finished; add --prompt or --undo"
                )
            return _bring_up_to_date(run, run.selection, run.source, project, lock)
        number = _follows(run, request)
        if request.branch is None:
            return _grow(run, run.folder, number, request, project, lock)
        folder = _branch_folder(request.branch, project)
        with run_lock(folder) as branch_lock:
            if folder.exists():
                raise UserError("exists already", where=folder, fix="choose another --as")
            return _grow(run, folder, number, request, project, branch_lock)


def undo_round(name: str, *, project: Path) -> Path:
    """Take the last round of a run away: from its folder, tables and page. Nothing before it runs again.

    Raises:
        UserError: there is no such run, it has one round only, or somebody else works on it.
    """
    run = open_run(name, project)
    with run_lock(run.folder, what=run.folder) as lock:
        run = open_run(name, project)
        rounds = run.selection.rounds - 1
        if rounds < 1:
            raise UserError("has one round only, nothing to undo", where=run.folder)
        with scratch_folder(run.folder) as scratch:
            scene = _copied_scene(run, scratch, rounds)
            return _bring_up_to_date(run, _first_rounds(run.selection, rounds), scene, project, lock)


def proposal_lines(name: str, from_round: int | None, *, project: Path) -> list[str]:
    """What the scene after a round proposes for the next camera motion, a line each.

    Raises:
        UserError: there is no such run or round, or it is not finished.
    """
    run = open_run(name, project)
    number = _known_round(run, from_round)
    if number == 0:
        problem = "0 is the captured scene, and proposals are made after rounds"
        raise UserError(problem, where="--from-round", fix="name round 1 or a later one")
    place = run.outputs / f"round_{number}" / "proposals"
    if not place.is_dir():
        raise UserError(f"has no proposals after round {number}", where=run.folder, fix=f"finish it: --continue {name}")
    found = Proposals.load(place)
    lines = [f"{found.covered:.0%} of the directions around round {number}'s scene show something"]
    for index, item in enumerate(found.proposals, start=1):
        lines.append(
            f'{index}. --motion "{item.motion}"  ({item.new:.0%} of the picture would be new): {place / item.preview}'
        )
    if not found.proposals:
        lines.append("no motion shows something new and enough of the scene beside it")
    return lines


def quality_line(run: Run, number: int) -> str | None:
    """Why no round should follow round ``number``; None if it passed, or is the captured scene."""
    folder = run.outputs / f"round_{number}"
    if number == 0 or not (folder / "metrics" / f"{MAIN}.json").is_file():
        return None
    row = load_row(folder / "metrics" / f"{MAIN}.json")
    before = folder / "metrics" / f"{CAPTURED}.json"
    earlier = load_row(before) if before.is_file() else None
    if not isinstance(row, MetricsRow):
        return None
    inserted = InsertedView.load(folder / "inserted").view.view_ids[0]
    reasons = find_failures(row, earlier if isinstance(earlier, MetricsRow) else None, inserted)
    return f"round {number} failed quality control: {'; '.join(reasons)}" if reasons else None


def last_quality_line(folder: Path) -> str | None:
    """`quality_line` of the last round of a finished run."""
    selection = read_selection(folder)
    return quality_line(Run(folder=folder, selection=selection), selection.rounds)


def _known_round(run: Run, number: int | None) -> int:
    last = run.selection.rounds
    if number is None:
        return last
    if not 0 <= number <= last:
        there = "only round 1" if last == 1 else f"rounds 1 to {last}"
        raise UserError(f"there is no round {number}", where="--from-round", fix=f"{run.folder.name} has {there}")
    return number


def _follows(run: Run, request: RoundRequest) -> int:
    """The round that the new one follows, which is finished and fit to go on from."""
    number = _known_round(run, request.from_round)
    name = run.folder.name
    if request.branch is None and number != run.selection.rounds:
        raise UserError("needs a name for what begins there", where="--from-round", fix="add --as NEWNAME")
    if not run.is_finished:
        problem = f"round {run.selection.rounds} of {name} is not finished"
        raise UserError(problem, where="--continue", fix=f"--continue {name} alone finishes it, --undo takes it away")
    if number >= MOST_ROUNDS:
        raise UserError(f"has {number} rounds, as many as are allowed", where=run.folder)
    failed = None if request.anyway else quality_line(run, number)
    if failed is not None:
        fix = "--undo takes it away, --anyway goes on all the same"
        raise UserError(failed, where=run.folder, fix=fix)
    return number


def _branch_folder(name: str, project: Path) -> Path:
    check_name(name, where="--as", fix="choose another --as")
    folder = project / "runs" / name
    if folder.exists():
        raise UserError("exists already", where=folder, fix="choose another --as")
    return folder


def _first_rounds(selection: Selection, rounds: int) -> Selection:
    own = selection.round_overrides[:rounds]
    return replace(
        selection,
        rounds=rounds,
        previous=selection.previous[:rounds],
        round_overrides=own if any(own) else (),
    )


def _grow(run: Run, folder: Path, number: int, request: RoundRequest, project: Path, lock: RunLock) -> Path | None:
    """Put the scene with the new round together beside the folder, check it whole, then let it take the place of the old one."""
    spec = make_round(request.prompt, motion=request.motion, new_object=request.new_object, where="--prompt")
    before = _first_rounds(run.selection, number)
    own = _own_settings(run, request, project)
    selection = replace(
        before,
        rounds=number + 1,
        previous=(*(before.previous or range(number)), number),
        round_overrides=(*(before.overrides_of(k) for k in range(1, number + 1)), own),
    )
    if not any(selection.round_overrides):
        selection = replace(selection, round_overrides=())
    if selection.previous == tuple(range(number + 1)):
        selection = replace(selection, previous=())
    folder.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(folder) as scratch:
        facts = {"prompt": spec.prompt, "motion": spec.motion, "object": spec.new_object}
        entry = {key: text for key, text in facts.items() if text}
        scene = _copied_scene(run, scratch, number)
        originals = {scene: run.source}
        if request.inserted is not None:
            picture = inserted_name(number + 1, request.inserted)
            (scene / picture).parent.mkdir(exist_ok=True)
            shutil.copyfile(request.inserted, scene / picture)
            entry["inserted"] = picture.as_posix()
            originals = {scene / picture: request.inserted, **originals}
        _write_rounds(scene, [*_read_rounds(scene)["rounds"], entry])
        with shown_as_given(originals):
            checked = check_scene(
                run.scene,
                scene,
                conf=project / "conf",
                overrides=selection.overrides,
                rounds=selection.rounds,
                round_overrides=selection.round_overrides,
                methods=selection.methods,
            )
        new = checked.forecasts[-1:]
        backend = _config(run, own, project).generator.backend
        announce_forecasts(new, backend, details=request.dry_run, first=number + 1)
        if request.dry_run:
            return None
        agree_to_requests(new, unattended=request.unattended)
        if folder != run.folder:
            _note_branch(run, folder, number)
        grown = Run(folder=folder, selection=selection)
        return _bring_up_to_date(grown, selection, scene, project, lock)


def _own_settings(run: Run, request: RoundRequest, project: Path) -> tuple[str, ...]:
    """How the new round's picture is obtained, as far as it is not how the run's are."""
    own = written_out(request.settings, absolute=True)
    recorded = backend_of(_config(run, own, project).generator).takes_recorded
    if request.inserted is None:
        if recorded:
            raise UserError("the new round has no picture", where="--inserted", fix=NO_PICTURE)
        return own
    require_plain_file(request.inserted)
    if not recorded:
        if any(item.startswith("generator") for item in own):
            raise UserError("would take the place of --inserted", where="--generator", fix="leave one of them out")
        own = ("generator=replay", *own)
    read_picture(request.inserted, max_megapixels=_config(run, own, project).scene.max_megapixels)
    return own


def _config(run: Run, own: Sequence[str], project: Path) -> ProjectConfig:
    return parse_dataclass(ProjectConfig, compose(project / "conf", [*run.selection.overrides, *own]))


def _copied_scene(run: Run, scratch: Path, rounds: int) -> Path:
    """The run's scene with its first rounds. Pictures of others stay: what is known of the truth may name them."""
    scene = scratch / run.scene
    shutil.copytree(run.source, scene)
    _write_rounds(scene, _read_rounds(scene)["rounds"][:rounds])
    return scene


def _read_rounds(scene: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((scene / SCENE_FILE).read_text(encoding="utf-8"))
    return content


def _write_rounds(scene: Path, rounds: list[dict[str, str]]) -> None:
    content = _read_rounds(scene) | {"rounds": rounds}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    write_bytes_atomic(scene / SCENE_FILE, text.encode())


def _note_branch(run: Run, folder: Path, number: int) -> None:
    """Whose photos the branch is of: ``expand PHOTOS --name BRANCH`` would put another scene there."""
    source = run.folder / SOURCE_FILE
    known = json.loads(source.read_text(encoding="utf-8")) if source.is_file() else {}
    known |= {"name": run.scene, "branch_of": run.folder.name, "round": number}
    folder.mkdir(exist_ok=True)
    write_bytes_atomic(folder / SOURCE_FILE, f"{json.dumps(known, indent=1)}\n".encode())


def _bring_up_to_date(run: Run, selection: Selection, scene: Path, project: Path, lock: RunLock) -> Path:
    make_workspace(run.folder, selection, project=project, scenes={run.scene: scene}, move_scenes=True)
    for place in run.outputs.glob("round_*"):
        ending = place.name.removeprefix("round_")
        if ending.isdecimal() and int(ending) > selection.rounds:
            remove_tree(place)
    reproduce(run.folder, project=project, lock=lock)
    return run.page
