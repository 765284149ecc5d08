"""Let people rank the videos of methods that they are not told, and compute what they said.

build    study.yaml and videos -> a folder with one page per participant and their links
serve    the pages, on this machine only, and collect answers
results  scores, intervals and tests
agree    Kendall's tau between people and metrics or a judge
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, did_you_mean, entry_point

ACTIONS: dict[str, tuple[str, ...]] = {  # and the options that they take
    "build": ("out", "address"),
    "serve": ("host", "port", "allow_host"),
    "results": ("out", "seed"),
    "agree": ("out", "seed", "measures"),
}
_HOST, _PORT = "127.0.0.1", 8090


def make_parser() -> CommandParser:
    """The options of all actions."""
    parser = CommandParser(
        "study",
        __doc__,
        examples=[
            "build study.yaml --out studies/first",
            "serve studies/first --allow-host study.example.org",
            "results studies/first",
            "agree studies/first --measures outputs --measures judge.csv",
        ],
    )
    parser.add_argument("action", help=", ".join(ACTIONS))
    parser.add_argument("path", type=Path, help="build: study.yaml; else the folder of the study")
    parser.add_argument("--out", type=Path, help="folder to be written; results and agree: FOLDER/results by default")
    parser.add_argument(
        "--address", help=f"build: where participants reach the server (default http://{_HOST}:{_PORT})"
    )
    parser.add_argument("--host", help=f"serve: address to listen on (default {_HOST})")
    parser.add_argument("--port", type=int, help=f"serve: default {_PORT}")
    parser.add_argument(
        "--allow-host",
        action="append",
        metavar="NAME[:PORT]",
        help="serve: answer to this name too, as the address bar shows it behind a tunnel or a proxy; may be repeated",
    )
    parser.add_argument(
        "--measures", type=Path, action="append", help="agree: CSV or a folder of outputs; may be repeated"
    )
    parser.add_argument("--seed", type=int, help="results, agree: of bootstrap and permutations (default 0)")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Do one of the actions."""
    given = make_parser().parse_args(arguments)
    if given.action not in ACTIONS:
        raise UserError("unknown action", where=given.action, fix=did_you_mean(given.action, ACTIONS))
    for names in ACTIONS.values():
        for name in names:
            if getattr(given, name) is not None and name not in ACTIONS[given.action]:
                option = "--" + name.replace("_", "-")
                raise UserError(f"means nothing to {given.action!r}", where=option, fix="leave it out")
    if given.seed is not None and not 0 <= given.seed < 2**63:
        raise UserError(f"is {given.seed}, must be from 0 to 2^63 - 1", where="--seed")
    {"build": _build, "serve": _serve, "results": _results, "agree": _agree}[given.action](given)


def _build(given: argparse.Namespace) -> None:
    from sceneexpander.study.build import build_study
    from sceneexpander.study.spec import read_spec

    spec = read_spec(given.path)
    folder = given.out or given.path.parent / "study"
    address = given.address or f"http://{_HOST}:{_PORT}"
    study = build_study(spec, given.path.parent, folder, address=address)
    screens = len(study.participants[0].screens)
    guess = f"; guessing passes a catch screen in {100 * spec.worst_guess:.0f} %" if spec.catch.scenes else ""
    print(f"study: {folder}: {len(study.participants)} participants, {screens} screens each{guess}")
    print(f"links, one for each participant and for nobody else: {folder / 'links.csv'}")


def _serve(given: argparse.Namespace) -> None:
    from sceneexpander.study.server import bind, make_server
    from sceneexpander.viewer.gate import check_authority

    host = given.host or _HOST
    port = _PORT if given.port is None else given.port
    if not 0 <= port <= 65_535:
        raise UserError(f"is {port}, must be from 0 to 65535", where="--port")
    server = make_server(given.path, [check_authority(name) for name in given.allow_host or ()])
    listener = bind(host, port)
    shown = f"[{host}]" if ":" in host else host
    print(f"study: http://{shown}:{listener.getsockname()[1]} (stop with Ctrl-C; answers are kept)", flush=True)
    with contextlib.suppress(KeyboardInterrupt):  # uvicorn has ended what it was doing
        server.run(sockets=[listener])


def _results(given: argparse.Namespace) -> None:
    from sceneexpander.study.results import compute_results, load_rankings, save_results, score_table

    study, answers = load_rankings(given.path)
    results, ranked = compute_results(study, answers, seed=given.seed or 0)
    folder = given.out or given.path / "results"
    save_results(results, ranked, folder)
    print(score_table(results).markdown())
    print(f"{len(results.included)} included, {len(results.excluded)} excluded: {folder / 'results.md'}")


def _agree(given: argparse.Namespace) -> None:
    from sceneexpander.study.agreement import agreement_table, compute_agreement, read_measures, save_agreement
    from sceneexpander.study.results import collect_rankings, load_rankings

    if not given.measures:
        raise UserError("is missing", where="--measures", fix="give a CSV file or a folder of outputs")
    study, answers = load_rankings(given.path)
    ranked, _ = collect_rankings(study, answers)
    measured = [item for path in given.measures for item in read_measures(path)]
    found = compute_agreement(ranked, measured, seed=given.seed or 0)
    folder = given.out or given.path / "results"
    save_agreement(found, ranked, folder)
    print(agreement_table(found, len(ranked.scenes)).markdown())


if __name__ == "__main__":
    main()
