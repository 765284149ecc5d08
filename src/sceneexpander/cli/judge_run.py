"""``sceneexpander judge RUN``: have a vision-language model judge finished scenes.

Nothing in RUN is changed but the folder ``judged``, and nothing is run again. Answers that are there already are not asked for again. To
have the pipeline itself ask, and the page show it, set ``judge=openai`` in params.yaml. See docs/judge.md.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import chdir
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import key_of, written_out
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, entry_point
from sceneexpander.pipeline.project import JUDGED_FOLDER, find_project
from sceneexpander.pipeline.selection import Selection, read_selection
from sceneexpander.plainfiles import require_folder

if TYPE_CHECKING:
    from sceneexpander.artifacts.judgement import JudgedRound
    from sceneexpander.judge.ask import Judge
    from sceneexpander.judge.config import ChatJudgeConfig
    from sceneexpander.judge.rounds import Work

_BACKEND = "judge=openai"


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What was asked for on the command line."""

    run: Path
    overrides: tuple[str, ...] = ()
    sheets: Path | None = None
    unattended: bool = False
    dry_run: bool = False


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "judge",
        __doc__.partition("\n")[2],
        examples=[
            "runs/terrace --dry-run --sheets sheets",
            "runs/terrace judge.chat.base_url=http://127.0.0.1:8000/v1 judge.chat.key_variable=null judge.chat.model=qwen3-vl-8b",
        ],
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, runs/NAME, or a project folder")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="write every request as a picture to look at")
    parser.add_argument("--yes", action="store_true", help="send requests without asking")
    parser.add_argument("--dry-run", action="store_true", help="print what would be asked for, and stop")
    parser.add_argument("overrides", nargs="*", metavar="key=value", default=[], help="configuration: judge.KEY=VALUE")
    return parser


def parse_arguments(arguments: Sequence[str]) -> Request:
    """The command line as a `Request`."""
    given = make_parser().parse_intermixed_args(list(arguments))
    for override in given.overrides:
        if "=" not in override or key_of(override).partition(".")[0] != "judge":
            raise UserError("is not a setting of the judge", where=override, fix="write judge.KEY=VALUE")
    return Request(
        run=given.run,
        overrides=tuple(given.overrides),
        sheets=given.sheets,
        unattended=given.yes,
        dry_run=given.dry_run,
    )


def judge_run(request: Request, *, project: Path) -> list[JudgedRound] | None:
    """Judge all rounds that the run's params.yaml selects; None if only what would be asked was wanted.

    Raises:
        UserError: nothing was rendered there, the judge cannot be asked, or the user does not want it.
    """
    from sceneexpander.judge.ask import make_judge
    from sceneexpander.judge.rounds import judge_round

    config = judge_config(request.overrides, project=project)
    require_folder(request.run, expected="the folder of a run")
    sheets = None if request.sheets is None else request.sheets.absolute()
    sys.path.insert(0, str(project))  # stages/ lies beside the package, not in it
    with chdir(request.run):
        selection = read_selection(Path())
        works = _works(selection, config)
        judge = make_judge(config, project / JUDGED_FOLDER)
        assert judge is not None  # noqa: S101 - by the type of its settings
        if sheets is not None:
            _write_sheets(judge, works, sheets)
        requests = _count(judge, works)
        print(f"{requests} requests to {judge.title}, {_cost_words(config, requests)}")
        if request.dry_run:
            return None
        if requests:
            judge.require()
            agree(requests, unattended=request.unattended)
        judged = []
        for work in works:
            fresh = make_judge(
                config, project / JUDGED_FOLDER
            )  # each round has a budget of its own, as in the pipeline
            assert fresh is not None  # noqa: S101 - as above
            judged.append(judge_round(fresh, work))
            _save(judged[-1], fresh)
        return judged


def judge_config(overrides: Sequence[str], *, project: Path) -> ChatJudgeConfig:
    """The section ``judge`` of the configuration with these overrides; OpenAI's protocol unless they say otherwise."""
    from sceneexpander.judge.config import ChatJudgeConfig

    named = any(key_of(item) == "judge" for item in overrides)
    items = written_out([*([] if named else [_BACKEND]), *overrides], absolute=True)
    config = parse_dataclass(ProjectConfig, compose(project / "conf", items)).judge
    if not isinstance(config, ChatJudgeConfig):
        raise UserError("names nobody", where="judge", fix=f"leave it out, or use {_BACKEND}")
    return config


def _works(selection: Selection, config: ChatJudgeConfig) -> list[Work]:
    layout: Any = import_module("stages.layout")
    work_of = import_module("stages.judge").work_of
    works = []
    for scene in selection.scenes:
        for number in range(1, selection.rounds + 1):
            methods = [name for name in selection.methods if layout.renders(scene, number, name).is_dir()]
            if not methods:
                where = (Path.cwd() / layout.round_folder(scene, number)).as_posix()
                raise UserError("holds nothing rendered", where=where, fix="run the pipeline first")
            works.append(work_of(scene, number, methods, config))
    return works


def _count(judge: Judge, works: Sequence[Work]) -> int:
    from sceneexpander.judge.rounds import questions_of

    return judge.missing_requests([question for work in works for _, question in questions_of(judge, work)])


def _write_sheets(judge: Judge, works: Sequence[Work], folder: Path) -> None:
    from sceneexpander.judge.rounds import questions_of
    from sceneexpander.judge.sheet import request_sheet

    folder.mkdir(parents=True, exist_ok=True)
    for work in works:
        for name, question in questions_of(judge, work):
            request_sheet(question).save(folder / f"{work.scene}_round_{work.round}_{name}.png")
    print(f"what would be shown: {folder}")


def _cost_words(config: ChatJudgeConfig, requests: int) -> str:
    price = config.chat.price_usd
    return "price not known (judge.chat.price_usd)" if price is None else f"about {price * requests:.2f} USD"


def agree(requests: int, *, unattended: bool) -> None:
    """Ask before anything is sent. Raises `UserError` if the user does not want it, or there is nobody to ask."""
    if unattended:
        return
    if not sys.stdin.isatty():
        raise UserError(f"would send {requests} requests", where="judge", fix="add --yes to send them without asking")
    if input("Send? [y/N] ").strip().casefold() not in ("y", "yes"):
        raise UserError("nothing was sent", where="judge", fix="--dry-run --sheets FOLDER shows what would be")


def _save(judged: JudgedRound, judge: Judge) -> None:
    from sceneexpander.files import directory_being_written

    with directory_being_written(Path("judged") / judged.scene / f"round_{judged.round}") as folder:
        judged.save(folder, judge.chat.requests)


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    request = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    judged = judge_run(request, project=find_project())
    if judged is None:
        return
    from sceneexpander.report.judged import comparisons_table, judged_table

    methods = dict.fromkeys(score.method for item in judged for score in item.scores)
    for table in (judged_table(judged, list(methods)), comparisons_table(judged)):
        if table is not None:
            print(table.markdown())
    print(f"answers and reasons: {os.fspath(request.run / 'judged')}")


if __name__ == "__main__":
    main()
