"""The ablation table with known truth: ``python -m sceneexpander.ablation [options] [key=value ...]``.

Rows are the overlays of ``conf/ablation``; each is measured on the scenes and grades of expandbench with every seed. Finished cells are
kept in ``.cache/expandbench``, so the command continues where it was stopped, and another choice of rows reuses what is there.
Writes the table as JSON and Markdown. (``python -m sceneexpander.sweep --multirun ablation=...`` runs the same rows as whole
pipelines on the scenes of params.yaml.)
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.artifacts.store import to_plain, write_bytes_atomic, write_json_atomic
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.environment import find_environment
from sceneexpander.errors import UserError, did_you_mean, entry_point
from sceneexpander.expandbench.grades import GRADES, grade_named
from sceneexpander.expandbench.plot import plot
from sceneexpander.expandbench.report import report
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan, Settings, run
from sceneexpander.expandbench.scenes import SCENES
from sceneexpander.fingerprint import SourceTree
from sceneexpander.project import find_project

TABLE = ("anchor", "subset_aug", "self_distill", "self_distill_p1", "full")  # the paper's, after the baseline
BEYOND = (
    "no_realign",
    "no_tone",
    "no_trust",
    "no_close_gaps",
    "none",
    "splat",
)  # "none": nothing left out of the default
CONTROLS = ("control_no_adaptation", "control_no_insertion", "control_no_anchor")
GRADES_BY_DEFAULT = ("mixed_2",)
SCHEMA = "ablation/1"


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m sceneexpander.ablation", description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="for every row, e.g. adapt.steps=60")
    for name, known, default in (
        ("scenes", SCENES, tuple(SCENES)),
        ("grades", GRADES, GRADES_BY_DEFAULT),
        ("rows", (), (*TABLE, *BEYOND, *CONTROLS)),
        ("seeds", (), ("0", "1", "2")),
    ):
        shown = f" of {', '.join(known)}" if known else ""
        parser.add_argument(
            f"--{name}", default=",".join(default), help=f"comma-separated{shown}; default: %(default)s"
        )
    parser.add_argument("--processes", type=int, choices=(1, 2), default=1, help="scenes worked on at the same time")
    parser.add_argument(
        "--any-code", action="store_true", help="also use results that another version of the code made"
    )
    parser.add_argument("--finished", action="store_true", help="run nothing: tables of the cells that are there")
    parser.add_argument("--out", type=Path, help="without suffix; default: results/ablation in the project")
    return parser.parse_args(given)


def make_plan(
    project: Path,
    rows: Sequence[str],
    scenes: Sequence[str],
    grades: Sequence[str],
    seeds: Sequence[str],
    more: Sequence[str],
) -> tuple[Plan, ProjectConfig]:
    """The plan, and the configuration that all its rows share. Raises `UserError` for anything unknown, and for a plan of nothing."""
    for option, values in (("rows", rows), ("scenes", scenes), ("grades", grades), ("seeds", seeds)):
        if not values:
            raise UserError("is empty", where=f"--{option}", fix="name one or more, or leave the option out")
    for scene in scenes:
        if scene not in SCENES:
            raise UserError(f"unknown scene {scene!r}", where="--scenes", fix=did_you_mean(scene, SCENES))
    for grade in grades:
        grade_named(grade)
    if not all(seed.isdigit() for seed in seeds):
        raise UserError(f"is {','.join(seeds)!r}", where="--seeds", fix="give whole numbers, e.g. 0,1,2")
    configs: dict[str, AdaptConfig] = {}
    for row in rows:
        if row not in (CAPTURED, BASELINE):
            configs[row] = _composed(project, [f"ablation={row}", *more]).adapt
    plan = Plan(scenes=tuple(scenes), grades=tuple(grades), rows=configs, seeds=tuple(int(seed) for seed in seeds))
    return plan, _composed(project, list(more))


def _composed(project: Path, overrides: Sequence[str]) -> ProjectConfig:
    values = compose(project / "conf", ["experiment=expandbench", *overrides])
    return parse_dataclass(ProjectConfig, values)


def code_of(project: Path) -> str:
    """What determines a cell beside its configuration: the code of the benchmark, all it imports, and the environment."""
    tree = SourceTree(packages={"sceneexpander": project / "src" / "sceneexpander"})
    return find_environment(project).identify(tree, "sceneexpander.expandbench.run")


@entry_point
def main() -> None:
    """Run the plan, print the tables, write them."""
    options = arguments()
    project = find_project()
    split = {
        name: [v for v in getattr(options, name).split(",") if v] for name in ("rows", "scenes", "grades", "seeds")
    }
    plan, shared = make_plan(project, **split, more=options.overrides)
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
            f"[{done}/{len(plan)}] {cell.scene} {cell.grade or '-'} {cell.row} seed {cell.seed}: "
            f"{cell.numbers.psnr_db:.2f} dB ({cell.seconds:.0f} s)",
            file=sys.stderr,
            flush=True,
        )

    cells = run(plan, settings, processes=options.processes, on_cell=on_cell)
    if not cells:
        raise UserError(
            "holds no finished cell of this plan, and a table without any would take the place of one that is there",
            where=settings.cache,
            fix="leave out --finished, or add --any-code",
        )
    out: Path = options.out or project / "results" / "ablation"
    text = report(cells, plan, model=shared.model.name)
    content = {
        "schema": SCHEMA,
        "model": shared.model.name,
        "machine": platform.machine(),
        "versions_of_code": len({cell.code for cell in cells}),
        "rows": {name: to_plain(config) for name, config in plan.rows.items()},
        "cells": [to_plain(cell) for cell in cells],
    }
    write_json_atomic(out.with_suffix(".json"), content)
    write_bytes_atomic(out.with_suffix(".md"), text.encode())
    drawn = plot(cells, out.with_suffix(".svg"))
    print(text)
    print(f"written: {out}" + (".json, .md, .svg" if drawn else ".json, .md"))


if __name__ == "__main__":
    main()
