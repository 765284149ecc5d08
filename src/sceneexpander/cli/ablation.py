"""The ablation with known truth: ``sceneexpander ablation [options] [key=value ...]``.

Measures the studies of `sceneexpander.expandbench.studies` and writes results/ablation.json and docs/ablation.md from them; with rows,
scenes, grades or seeds given, a table of one's own. Rows are the overlays of ``conf/ablation``. Finished cells are kept in
``.cache/expandbench``, so the command continues where it was stopped, and another choice of rows reuses what is there.
(``sceneexpander sweep --multirun ablation=...`` runs the same rows as whole pipelines on the scenes of params.yaml.)
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, did_you_mean, entry_point
from sceneexpander.expandbench.document import Measured, Results, written
from sceneexpander.expandbench.grades import GRADES, grade_named
from sceneexpander.expandbench.plot import plot
from sceneexpander.expandbench.report import report
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan, Settings, run
from sceneexpander.expandbench.scenes import ABLATION_TEST, DEVELOPMENT, SCENES
from sceneexpander.expandbench.studies import BEYOND, CONTROLS, STUDIES, TABLE, Study
from sceneexpander.expansion import MethodConfig
from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.environment import find_environment
from sceneexpander.pipeline.fingerprint import SourceTree
from sceneexpander.pipeline.project import find_project

GRADES_BY_DEFAULT = ("mixed_2",)
SPLITS = {"development": DEVELOPMENT, "test": ABLATION_TEST}
OWN_TABLE = ("scenes", "grades", "rows", "seeds")


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "ablation",
        "Measure what each part of the method does, on procedural worlds whose cameras and depths are known.",
        examples=[
            "",
            "--study rows,long",
            "--finished",
            "--rows paper,default --grades mixed_2 --seeds 0 adapt.steps=60",
        ],
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", default=[], help="for every row, e.g. adapt.steps=60"
    )
    parser.add_argument(
        "--study", help=f"comma-separated of {', '.join(study.name for study in STUDIES)}; default: all of them"
    )
    own = parser.add_argument_group("a table of your own instead of the studies")
    for name, known in (
        ("scenes", f" of {', '.join(SCENES)}, or development, or test (eight of them); default: development"),
        ("grades", f" of {', '.join(GRADES)}; default: mixed_2"),
        ("rows", "; default: all"),
        ("seeds", "; default: 0,1,2"),
    ):
        own.add_argument(f"--{name}", help=f"comma-separated{known}")
    parser.add_argument("--processes", type=int, choices=(1, 2), default=1, help="scenes worked on at the same time")
    parser.add_argument(
        "--any-code", action="store_true", help="also use results that another version of the code made"
    )
    parser.add_argument("--finished", action="store_true", help="run nothing: tables of the cells that are there")
    own.add_argument("--out", type=Path, help="without suffix; default: .cache/expandbench/table in the project")
    return parser


def make_plan(
    project: Path,
    rows: Sequence[str],
    scenes: Sequence[str],
    grades: Sequence[str],
    seeds: Sequence[str],
    more: Sequence[str],
    *,
    experiment: str = "expandbench",
) -> tuple[Plan, ProjectConfig]:
    """The plan, and the configuration that all its rows share. Raises `UserError` for anything unknown, and for a plan of nothing."""
    for option, values in (("rows", rows), ("scenes", scenes), ("grades", grades), ("seeds", seeds)):
        if not values:
            raise UserError("is empty", where=f"--{option}", fix="name one or more, or leave the option out")
    scenes = [name for scene in scenes for name in SPLITS.get(scene, (scene,))]
    for scene in scenes:
        if scene not in SCENES:
            raise UserError(f"unknown scene {scene!r}", where="--scenes", fix=did_you_mean(scene, [*SPLITS, *SCENES]))
    for grade in grades:
        grade_named(grade)
    if not all(seed.isdigit() for seed in seeds):
        raise UserError(f"is {','.join(seeds)!r}", where="--seeds", fix="give whole numbers, e.g. 0,1,2")
    shared = _composed(project, list(more), experiment)
    methods: dict[str, MethodConfig] = {}
    for row in rows:
        if row not in (CAPTURED, BASELINE):
            own = _composed(project, [f"ablation={row}", *more], experiment)
            methods[row] = MethodConfig(adapt=own.adapt, corrections=own.corrections)
            if replace(own, adapt=shared.adapt, corrections=shared.corrections) != shared:
                fix = "give what it changes as key=value, for all rows"
                raise UserError(f"row {row!r} changes what all rows of a table share", where="--rows", fix=fix)
    plan = Plan(scenes=tuple(scenes), grades=tuple(grades), rows=methods, seeds=tuple(int(seed) for seed in seeds))
    return plan, shared


def _composed(project: Path, overrides: Sequence[str], experiment: str = "expandbench") -> ProjectConfig:
    return _composed_from((project / "conf").resolve(), (f"experiment={experiment}", *overrides))


@cache  # studies have rows in common
def _composed_from(folder: Path, overrides: tuple[str, ...]) -> ProjectConfig:
    return parse_dataclass(ProjectConfig, compose(folder, list(overrides)))


def code_of(project: Path, module: str = "sceneexpander.expandbench.run") -> str:
    """What determines a cell beside its configuration: the code of the benchmark, all it imports, and the environment."""
    tree = SourceTree(packages={"sceneexpander": project / "src" / "sceneexpander"})
    return find_environment(project).identify(tree, module)


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the studies and write the page about them, or measure and print a table of one's own."""
    options = make_parser().parse_intermixed_args(arguments)
    project = find_project()
    if any(getattr(options, name) is not None for name in OWN_TABLE):
        if options.study is not None:
            raise UserError(
                "is a choice of tables already", where="--study", fix=f"leave out --{', --'.join(OWN_TABLE)}"
            )
        _own_table(project, options)
        return
    names = _split(options.study) if options.study is not None else [study.name for study in STUDIES]
    known = {study.name: study for study in STUDIES}
    for name in names:
        if name not in known:
            raise UserError(f"unknown study {name!r}", where="--study", fix=did_you_mean(name, known))
    if options.overrides and options.study is None:
        raise UserError("would change every study", where="key=value", fix="name one with --study, or rows with --rows")
    _studies(project, [known[name] for name in names], options)


def _studies(project: Path, studies: Sequence[Study], options: argparse.Namespace) -> None:
    """Measure one study after the other; the results file and the page are written after each."""
    place, page = project / "results" / "ablation.json", project / "docs" / "ablation.md"
    measured: dict[str, Measured] = {}
    model = ""
    for study in studies:
        more = [*study.overrides, *options.overrides]
        seeds = [str(seed) for seed in study.seeds]
        plan, shared = make_plan(
            project, study.rows, study.scenes, study.grades, seeds, more, experiment=study.experiment
        )
        cells = _measured(project, plan, shared, options, study.name)
        if cells:
            model = shared.model.name
            measured[study.name] = Measured(cells=tuple(cells), rows=plan.rows, visits=shared.refine.visits)
            results = _merged(place, measured, model)
            results.save(place)
            if study.name == "grades":
                plot(cells, page.with_suffix(".svg"))
            write_bytes_atomic(page, written(results, page).encode())
    if not measured:
        raise _nothing(project)
    print(f"written: {place}, {page}")


def _merged(place: Path, measured: Mapping[str, Measured], model: str) -> Results:
    """What was measured now beside the studies that the file has of the same version and reconstructor."""
    release = version("sceneexpander")
    before = Results.load(place) if place.is_file() else None
    kept = before.studies if before is not None and (before.version, before.model) == (release, model) else {}
    return Results(version=release, model=model, machine=platform.machine(), studies={**kept, **measured})


def _own_table(project: Path, options: argparse.Namespace) -> None:
    rows = (*TABLE, *BEYOND, *CONTROLS)
    defaults = {"scenes": ("development",), "grades": GRADES_BY_DEFAULT, "rows": rows, "seeds": ("0", "1", "2")}
    given = {name: getattr(options, name) for name in OWN_TABLE}
    scenes, grades, chosen, seeds = (defaults[n] if given[n] is None else _split(given[n]) for n in OWN_TABLE)
    plan, shared = make_plan(project, chosen, scenes, grades, seeds, options.overrides)
    cells = _measured(project, plan, shared, options, "table")
    if not cells:
        raise _nothing(project)
    out: Path = options.out or project / ".cache" / "expandbench" / "table"
    text = report(cells, plan, model=shared.model.name, visits=shared.refine.visits)
    measured = Measured(cells=tuple(cells), rows=plan.rows, visits=shared.refine.visits)
    write_json_atomic(out.with_suffix(".json"), measured.to_plain())
    write_bytes_atomic(out.with_suffix(".md"), text.encode())
    drawn = plot(cells, out.with_suffix(".svg"))
    print(text)
    print(f"written: {out}" + (".json, .md, .svg" if drawn else ".json, .md"))


def _measured(
    project: Path, plan: Plan, shared: ProjectConfig, options: argparse.Namespace, title: str
) -> list[CellResult]:
    settings = Settings(
        model=shared.model,
        frontend=shared.frontend,
        warmup=shared.warmup,
        refine=shared.refine,
        cache=project / ".cache" / "expandbench",
        code=code_of(project),
        any_code=options.any_code,
        finished_only=options.finished,
    )
    done = 0

    def on_cell(cell: CellResult) -> None:
        nonlocal done
        done += 1
        print(
            f"{title} [{done}/{len(plan)}] {cell.scene} {cell.grade or '-'} {cell.row} seed {cell.seed}: "
            f"{cell.numbers.values['psnr_captured_db']:.2f} dB ({cell.seconds:.0f} s)",
            file=sys.stderr,
            flush=True,
        )

    return run(plan, settings, processes=options.processes, on_cell=on_cell)


def _nothing(project: Path) -> UserError:
    return UserError(
        "holds no finished cell of this plan, and a table without any would take the place of one that is there",
        where=project / ".cache" / "expandbench",
        fix="leave out --finished, or add --any-code",
    )


def _split(text: str) -> list[str]:
    return [value for value in text.split(",") if value]


if __name__ == "__main__":
    main()
