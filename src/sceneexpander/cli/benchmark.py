"""Measure how right a scene expansion is, in what was captured and in what was added: expandbench.

generate     write the benchmark's scenes: pictures for methods, and the exact truth
verify       check that every file is as it was written
leaderboard  score rows of this program and results of others, one table for all
place        bring the true cameras into the world of results, to render from there

See docs/expandbench.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, did_you_mean, entry_point

if TYPE_CHECKING:
    from sceneexpander.expandbench.dataset import SceneFacts
    from sceneexpander.expandbench.leaderboard import CaseScore, Rows

ACTIONS: dict[str, tuple[str, ...]] = {  # and the options that they take
    "generate": ("scenes", "grades", "shrink", "processes"),
    "verify": (),
    "leaderboard": ("scenes", "grades", "results", "rows", "seed", "out"),
    "place": ("results",),
}
_OPTIONS = ("scenes", "grades", "shrink", "processes", "results", "rows", "seed", "out")
_MOST_SHRUNK = 4


def make_parser() -> CommandParser:
    """The options of all actions."""
    parser = CommandParser(
        "expandbench",
        __doc__,
        examples=[
            "generate data/expandbench",
            "leaderboard data/expandbench --rows captured,baseline,default --results theirs=results/theirs --out results/board",
            "leaderboard data/expandbench --results theirs=results/theirs --scenes development --grades clean",
            "place data/expandbench --results theirs=results/theirs",
        ],
    )
    parser.add_argument("action", help=", ".join(ACTIONS))
    parser.add_argument("folder", type=Path, help="of the benchmark")
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", default=[], help="leaderboard: for every row, e.g. refine.visits=0"
    )
    parser.add_argument(
        "--scenes",
        help="comma-separated names, or development, or test; default: generate all, leaderboard the test scenes",
    )
    parser.add_argument(
        "--grades", help="comma-separated kinds of inserted picture; default: generate all, leaderboard clean,mixed_2"
    )
    parser.add_argument(
        "--shrink", type=int, help=f"generate: 1 to {_MOST_SHRUNK} times fewer pixels per side, to try things out"
    )
    parser.add_argument(
        "--processes", type=int, help="generate: scenes at the same time (default: one per core, 2 at most)"
    )
    parser.add_argument(
        "--results",
        action="append",
        metavar="NAME=FOLDER",
        help="leaderboard, place: a method's results; may be repeated",
    )
    parser.add_argument("--rows", help="leaderboard: comma-separated rows of conf/ablation, and captured, baseline")
    parser.add_argument("--seed", type=int, help="leaderboard: of the rows (default 0)")
    parser.add_argument(
        "--out", type=Path, help="leaderboard: folder for .md, .csv, .json (default FOLDER/leaderboard)"
    )
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Do one of the actions."""
    given = make_parser().parse_intermixed_args(arguments)
    if given.action not in ACTIONS:
        raise UserError("unknown action", where=given.action, fix=did_you_mean(given.action, ACTIONS))
    for name in _OPTIONS:
        if getattr(given, name) is not None and name not in ACTIONS[given.action]:
            raise UserError(f"means nothing to {given.action!r}", where=f"--{name}", fix="leave it out")
    if given.overrides and given.rows is None:
        raise UserError(
            "changes rows of this program, and none is asked for",
            where=given.overrides[0],
            fix="give --rows; results of others are --results NAME=FOLDER",
        )
    {"generate": _generate, "verify": _verify, "leaderboard": _leaderboard, "place": _place}[given.action](given)


def _generate(given: argparse.Namespace) -> None:
    from sceneexpander.expandbench.dataset import CONTENT, PICTURED, generate, scenes_named
    from sceneexpander.expandbench.scenes import SCENES

    shrink = given.shrink or 1
    if not 1 <= shrink <= _MOST_SHRUNK or given.shrink == 0:
        raise UserError(f"is {given.shrink}, must be from 1 to {_MOST_SHRUNK}", where="--shrink")
    if given.processes is not None and given.processes < 1:
        raise UserError(f"is {given.processes}, must be 1 or more", where="--processes")
    if given.folder.exists() and not given.folder.is_dir():
        raise UserError("is a file, expected a folder or nothing", where=given.folder)
    names = tuple(SCENES) if given.scenes is None else scenes_named(_split(given.scenes))
    grades = tuple(PICTURED) if given.grades is None else _grades(given.grades)
    done = 0

    def on_scene(facts: SceneFacts, made: bool) -> None:
        nonlocal done
        done += 1
        print(f"[{done}/{len(names)}] {facts.name}: {'made' if made else 'there'}", file=sys.stderr, flush=True)

    processes = given.processes or min(2, os.cpu_count() or 1)
    manifest = generate(given.folder, names, shrink=shrink, grades=grades, processes=processes, on_scene=on_scene)
    known = "" if not manifest.complete else ", as published" if manifest.content == CONTENT else ", not as published"
    print(f"expandbench {manifest.version}: {len(manifest.scenes)} scenes, content {manifest.content}{known}")


def _verify(given: argparse.Namespace) -> None:
    from sceneexpander.expandbench.dataset import AGAIN, check_scene, read_manifest

    manifest = read_manifest(given.folder)
    for name, content in manifest.scenes.items():
        if check_scene(given.folder, name).content != content:
            raise UserError("is another than the manifest says", where=given.folder / name, fix=AGAIN)
    whole = "all scenes" if manifest.complete else f"{len(manifest.scenes)} scenes, not all of the version"
    print(f"expandbench {manifest.version}: {whole}, content {manifest.content}, every file as it was written")


def _leaderboard(given: argparse.Namespace) -> None:
    from sceneexpander.expandbench.dataset import read_facts, read_manifest, scenes_named
    from sceneexpander.expandbench.leaderboard import GRADES_BY_DEFAULT, document, measure_methods

    if not given.rows and not given.results:
        raise UserError("no method is given", where="leaderboard", fix="give --rows, --results, or both")
    results = _results(given.results or [])
    manifest = read_manifest(given.folder)
    scenes = manifest.splits.get("test", ()) if given.scenes is None else scenes_named(_split(given.scenes))
    if not scenes:
        raise UserError("holds no test scene", where=given.folder, fix="name scenes with --scenes")
    grades = GRADES_BY_DEFAULT if given.grades is None else _grades(given.grades)
    rows = None
    if given.rows is not None:
        rows = _rows(given, shrink=read_facts(given.folder, scenes[0]).shrink)
        if twice := set(rows.rows) & set(results):
            raise UserError(f"{min(twice)!r} is a row as well", where="--results", fix="give it another name")
    total = len(scenes) * len(grades) * (len(results) + (len(rows.rows) if rows is not None else 0))
    done = 0

    def on_case(case: CaseScore) -> None:
        nonlocal done
        done += 1
        print(
            f"[{done}/{total}] {case.method} {case.scene} {case.grade}{': ' if case.problem else ''}{case.problem}",
            file=sys.stderr,
            flush=True,
        )

    board = measure_methods(given.folder, scenes, grades, results, rows, on_case=on_case)
    out = given.out or given.folder / "leaderboard"
    board.save(out)
    print(document(board))
    print(f"written: {out / 'leaderboard'}.md, .csv, .json")


def _place(given: argparse.Namespace) -> None:
    from sceneexpander.expandbench.leaderboard import place_cameras

    if not given.results:
        raise UserError("is missing", where="--results", fix="give NAME=FOLDER")
    for place in _results(given.results).values():
        written = place_cameras(given.folder, place)
        print(f"{place}: the true cameras of {len(written)} cases, {written[0].name}")


def _rows(given: argparse.Namespace, *, shrink: int) -> Rows:
    from sceneexpander.cli.ablation import code_of, make_plan
    from sceneexpander.expandbench.leaderboard import Rows, own_rows
    from sceneexpander.expandbench.run import Settings
    from sceneexpander.expandbench.scenes import DEVELOPMENT
    from sceneexpander.pipeline.project import find_project

    project, names = find_project(), _split(given.rows)
    seed = given.seed or 0
    if seed < 0:
        raise UserError(f"is {seed}, must be 0 or more", where="--seed")
    plan, shared = make_plan(project, names, DEVELOPMENT[:1], ("clean",), (str(seed),), given.overrides)
    settings = Settings(
        model=shared.model,
        frontend=shared.frontend,
        warmup=shared.warmup,
        refine=shared.refine,
        cache=project / ".cache" / "expandbench",
        code=code_of(project, "sceneexpander.expandbench.leaderboard"),
        shrink=shrink,
    )
    return Rows(rows=own_rows(names, plan.rows), settings=settings, seed=seed)


def _results(given: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for word in given:
        name, equals, place = word.partition("=")
        if not equals or not name or not place:
            raise UserError("is not NAME=FOLDER", where=word)
        if name in found:
            raise UserError("is named twice", where=name)
        found[name] = Path(place)
    return found


def _grades(text: str) -> tuple[str, ...]:
    from sceneexpander.expandbench.dataset import PICTURED

    names = tuple(dict.fromkeys(_split(text)))
    for name in names:
        if name not in PICTURED:
            raise UserError(f"unknown grade {name!r}", where="--grades", fix=did_you_mean(name, PICTURED))
    if not names:
        raise UserError("is empty", where="--grades", fix="name one or more, or leave the option out")
    return names


def _split(text: str) -> list[str]:
    return [value for value in text.split(",") if value]


if __name__ == "__main__":
    main()
