"""``sceneexpander table``: the paper's two tables, filled with what was measured here."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sceneexpander.artifacts.judgement import FILE_NAME, JudgedRound
from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow, load_row
from sceneexpander.catalogue import Table
from sceneexpander.catalogue.methods import method_title
from sceneexpander.catalogue.paper import ABLATION, COMPARISON, HUMAN_COLUMNS
from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.evaluation.judged import with_judged
from sceneexpander.evaluation.paper_tables import Column, Values, paper_table
from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.project import find_project
from sceneexpander.plainfiles import require_folder

_STUDY = "rows"  # of the ablation: what users get
_QUOTED = (
    "Lines of the paper are quoted from it: other scenes, the WorldMirror checkpoint, its judge and its participants. They stand beside "
    "ours for the shape of the table and cannot be compared with them. Human scores of both are means of ranks turned into points."
)
_PHOTOS = (
    "PSNR, SSIM and LPIPS are of photos that the methods were given (and that Gaussians may have been fitted to), at the method's own "
    "cameras and the stored size; *held-out* are photos that nothing was made from."
)
_COMPARED = (
    ("psnr_captured_db", "PSNR", 3),
    ("ssim_captured", "SSIM", 3),
    ("lpips_captured", "LPIPS", 3),
    ("psnr_held_out_db", "held-out PSNR", 3),
    ("ssim_held_out", "held-out SSIM", 3),
    ("lpips_held_out", "held-out LPIPS", 3),
    ("judge_insertion", "GPT-IS", 2),
    ("judge_quality", "GPT-RQ", 2),
)
_ABLATED = (
    ("psnr_captured_db", "PSNR", 3),
    ("ssim_captured", "SSIM", 3),
    ("lpips_captured", "LPIPS", 3),
    ("psnr_new_region_db", "new-region PSNR", 3),
    ("psnr_half_way_db", "unseen-view PSNR", 3),
    ("judge_insertion", "GPT-IS", 2),
    ("judge_quality", "GPT-RQ", 2),
)
Case = tuple[str, int, int]  # scene, round, seed


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "table",
        "Fill the paper's two tables with what was measured here, as Markdown, CSV and LaTeX.",
        examples=[
            "",
            "runs/terrace runs/yard --study studies/first",
            "--ablation results/ablation.json --out tables",
        ],
    )
    parser.add_argument(
        "runs", nargs="*", type=Path, metavar="RUN", help="folders of runs or projects (default: this project)"
    )
    parser.add_argument("--study", type=Path, metavar="FOLDER", help="of a human study, for H-IS and H-RQ")
    parser.add_argument(
        "--ablation",
        type=Path,
        metavar="FILE",
        help="results of the ablation (default: the project's, if there are any)",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="to write into (default: results/tables)")
    return parser


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Rows of some runs, a judge's numbers among them, and what is to be said about them.

    Attributes:
        rows: with numbers, one per case and method.
        cases: all that any method has a row in, with numbers or without.
        unavailable: why methods could not be run, by name.
        judges: who was asked.
        lacking: per method how many of the samples asked of a judge are missing, of how many.
    """

    rows: Mapping[tuple[Case, str], MetricsRow]
    cases: frozenset[Case]
    unavailable: Mapping[str, str]
    judges: tuple[str, ...] = ()
    lacking: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def column(self, name: str, title: str, digits: int) -> Column:
        """One metric of all rows."""
        values: dict[str, dict[Case, float]] = defaultdict(dict)
        for (case, method), row in self.rows.items():
            value = row.value(name)
            if value is not None:
                values[method][case] = value
        return Column(
            name=name, title=title, digits=digits, better="lower" if "lpips" in name else "higher", values=values
        )


def read_runs(runs: Sequence[Path]) -> Measured:
    """What the pipeline has measured in some folders, and what a judge said there.

    Raises:
        UserError: a folder holds no metrics, or two of them have the same scene, round, seed and method.
    """
    rows: dict[tuple[Case, str], MetricsRow] = {}
    cases: set[Case] = set()
    unavailable: dict[str, str] = {}
    judged: dict[str, JudgedRound] = {}
    for run in runs:
        require_folder(run, expected="the folder of a run")
        paths = sorted((run / "outputs").glob("*/round_*/metrics/*.json"))
        if not paths:
            raise UserError("holds no metrics", where=run, fix="run the pipeline there first")
        for path in paths:
            row = load_row(path)
            case = (row.scene, row.round, row.seed)
            cases.add(case)
            if isinstance(row, UnavailableRow):
                unavailable[row.method] = row.reason
                continue
            if (case, row.method) in rows:
                raise UserError(
                    f"has {row.method!r} in round {row.round} of {row.scene!r} with seed {row.seed} a second time",
                    where=path,
                    fix="name one run of each",
                )
            judgement = _judgement(run, path, row)
            if judgement is not None:
                judged[f"{run} {row.scene} {row.round}"] = judgement
            rows[case, row.method] = with_judged(row, judgement)
    return Measured(
        rows=rows,
        cases=frozenset(cases),
        unavailable=unavailable,
        judges=tuple(dict.fromkeys(item.judge for item in judged.values() if item.judge is not None)),
        lacking=_lacking(tuple(judged.values())),
    )


def _judgement(run: Path, path: Path, row: MetricsRow) -> JudgedRound | None:
    """What the judge said of the round: asked by the command, or by the pipeline."""
    places = (run / "judged" / row.scene / f"round_{row.round}", path.parent.parent / "judged")
    return next((JudgedRound.load(place) for place in places if (place / FILE_NAME).is_file()), None)


def _lacking(judged: Sequence[JudgedRound]) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = {}
    for item in judged:
        for score in item.scores:
            missing, asked = found.get(score.method, (0, 0))
            found[score.method] = (missing + len(score.samples) - len(score.scores), asked + len(score.samples))
    return found


def human_columns(folder: Path | None) -> tuple[tuple[Column, ...], str]:
    """H-IS and H-RQ of a study, and a sentence about it. Raises `UserError` if the study is damaged or nobody's answers count."""
    titles = dict(zip(HUMAN_COLUMNS, ("H-IS", "H-RQ"), strict=True))
    if folder is None:
        return tuple(Column(name=name, title=title, digits=2) for name, title in titles.items()), ""
    # Only now: a table without a study needs none of it.
    from sceneexpander.study.results import collect_rankings, load_rankings
    from sceneexpander.study.spec import Criterion

    ranked, excluded = collect_rankings(*load_rankings(folder))
    columns = []
    for name, criterion in zip(HUMAN_COLUMNS, (Criterion.INSERTION, Criterion.QUALITY), strict=True):
        by_scene = ranked.scores[criterion].mean(0)
        values: Values = {
            method: {scene: float(by_scene[row, column]) for row, scene in enumerate(ranked.scenes)}
            for column, method in enumerate(ranked.methods)
        }
        columns.append(Column(name=name, title=titles[name], digits=2, values=values))
    people = f"{len(ranked.participants)} participants included, {len(excluded)} excluded"
    return tuple(
        columns
    ), f"Human scores: {people}, {len(ranked.scenes)} scenes, points from 1 to {len(ranked.methods)}."


def comparison(measured: Measured, study: Path | None = None) -> tuple[Table, tuple[str, ...]]:
    """The paper's main table, and sentences about it."""
    human, about_people = human_columns(study)
    models: dict[str, list[str]] = defaultdict(list)
    for (_, method), row in measured.rows.items():
        models[method].append(row.model)
    done = {method: sum(own == method for _, own in measured.rows) for method in models}
    table = paper_table(
        COMPARISON,
        [*(measured.column(*own) for own in _COMPARED), *human],
        titles={method: method_title(method, " / ".join(dict.fromkeys(names))) for method, names in models.items()},
        cases=done,
        of=len(measured.cases),
        seeds={method: [case[2] for case, own in measured.rows if own == method] for method in models},
    )
    scenes = sorted({case[0] for case in measured.cases})
    notes = [
        _PHOTOS,
        f"{len(measured.cases)} cases (scene, round, seed) of {len(scenes)} scenes: {', '.join(scenes)}.",
        f"Judge: {', '.join(measured.judges)}."
        if measured.judges
        else "No judge was asked: GPT-IS and GPT-RQ are not measured.",
        *(
            f"{method}: {missing} of {asked} of the judge's answers are missing; means are over those that are there."
            for method, (missing, asked) in measured.lacking.items()
            if missing
        ),
        about_people or "No human study was given: H-IS and H-RQ are not measured.",
        *(f"{method}: {reason}." for method, reason in measured.unavailable.items()),
        _QUOTED,
    ]
    return table, tuple(notes)


def ablation(place: Path | None) -> tuple[Table, tuple[str, ...]]:
    """The paper's ablation table, and sentences about it. Raises `ArtifactError` for a file that holds no results."""
    values: dict[str, dict[str, dict[tuple[str, str, int], float]]] = defaultdict(lambda: defaultdict(dict))
    cases: set[tuple[str, str, int]] = set()
    done: dict[str, set[tuple[str, str, int]]] = defaultdict(set)
    note = "No ablation was measured: `sceneexpander ablation` does."
    if place is not None:
        from sceneexpander.expandbench.document import Results

        results = Results.load(place)
        if _STUDY not in results.studies:
            raise UserError(f"holds no study {_STUDY!r}", where=place, fix=f"sceneexpander ablation --study {_STUDY}")
        wanted = {row.name for row in ABLATION}
        for cell in results.studies[_STUDY].cells:
            if cell.row in wanted:
                case = (cell.scene, cell.grade, cell.seed)
                cases.add(case)
                done[cell.row].add(case)
                for name, value in cell.numbers.values.items():
                    values[name][cell.row][case] = value
        note = (
            f"Procedural scenes with known truth ({len({case[0] for case in cases})}), reconstructor {results.model}, sceneexpander "
            f"{results.version}; *new region*: what no captured view sees, *unseen view*: half-way to it, both at true cameras."
        )
    table = paper_table(
        ABLATION,
        [
            Column(
                name=name,
                title=title,
                digits=digits,
                better="lower" if "lpips" in name else "higher",
                values=values[name],
            )
            for name, title, digits in _ABLATED
        ],
        titles={},
        cases={row: len(found) for row, found in done.items()},
        of=len(cases),
        seeds={row: [case[2] for case in found] for row, found in done.items()},
    )
    return table, (note, "Rows of the ablation are not judged.", _QUOTED)


def write_table(table: Table, notes: Sequence[str], folder: Path, name: str, title: str) -> str:
    """Write ``name`` with the endings md, csv and tex; returns the Markdown."""
    text = f"# {title}\n\n{table.markdown()}\n" + "\n".join(f"- {note}" for note in notes) + "\n"
    comments = "".join(f"% {note}\n" for note in notes)
    for ending, content in (("md", text), ("csv", table.csv()), ("tex", comments + table.latex())):
        write_bytes_atomic(folder / f"{name}.{ending}", content.encode())
    return text


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Write and print both tables."""
    given = make_parser().parse_args(arguments)
    project = find_project()
    place: Path | None = given.ablation
    if place is None and (project / "results" / "ablation.json").is_file():
        place = project / "results" / "ablation.json"
    folder: Path = given.out or project / "results" / "tables"
    for name, title, (table, notes) in (
        ("paper_comparison", "Quantitative comparison", comparison(read_runs(given.runs or [project]), given.study)),
        ("paper_ablation", "Ablation", ablation(place)),
    ):
        print(write_table(table, notes, folder, name, title))
    print(f"written: {folder}/paper_comparison and paper_ablation (.md, .csv, .tex)")


if __name__ == "__main__":
    main()
