"""What the first round of a run and those that follow share: names in its folder, asking before anything is sent, errors about copies."""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from sceneexpander.errors import UserError, printable
from sceneexpander.generation import Forecast
from sceneexpander.pipeline.disk import remove_tree

NO_PICTURE = "give one --inserted PICTURE for each round, or have them made: --generator reproject, openai, ..."
SCENE_FILE = "scene.yaml"
SOURCE_FILE = "source.json"  # in a run's folder: which photos it is of


def inserted_name(number: int, source: Path) -> Path:
    """Where the picture of a round lies in a scene folder.

    The content decides what it is: an ending is for people, and may be as odd or long as the whole name.
    """
    ending = source.suffix.lower() if re.fullmatch(r"\.[A-Za-z0-9]{1,8}", source.suffix) else ""
    return Path("inserted") / f"round_{number}{ending}"


@contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """A folder on the run's disk, so that what is put together there need not be copied again. Earlier ones of killed runs go."""
    for left in folder.parent.glob(f".{folder.name}.*.part"):
        remove_tree(left)
    scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent))
    try:
        yield scratch
    finally:
        remove_tree(scratch)


def announce_forecasts(forecasts: Sequence[Forecast], backend: str, *, details: bool, first: int = 1) -> None:
    """Print what a run would ask of a generator for rounds from ``first`` on; without ``details`` only what a user must know."""
    for number, forecast in enumerate(forecasts, start=first):
        if details:
            print(f"round {number}: generator {backend}")
            print(f"  prompt: {printable(forecast.prompt)}")
            print(f"  requests: {forecast.requests}, {_cost_words(forecast.cost_usd)}")
        for note in (*forecast.notes, *forecast.warnings) if details else forecast.warnings:
            print(f"  {printable(note)}" if details else f"round {number}: {printable(note)}")


def _cost_words(cost_usd: float | None) -> str:
    return "price not known (generator.price_usd)" if cost_usd is None else f"about {cost_usd:.2f} USD"


def agree_to_requests(forecasts: Sequence[Forecast], *, unattended: bool) -> None:
    """Ask before anything is sent that may cost something.

    Raises:
        UserError: the user does not want it, or there is nobody to ask.
    """
    costs = [forecast.cost_usd for forecast in forecasts if forecast.requests]
    requests = sum(forecast.requests for forecast in forecasts)
    if unattended or all(cost == 0 for cost in costs):
        return
    total = None if any(cost is None for cost in costs) else sum(cost or 0.0 for cost in costs)
    what = f"{requests} request{'s' * (requests != 1)} to paid services, {_cost_words(total)}"
    if not sys.stdin.isatty():
        raise UserError(f"would send {what}", where="expand", fix="add --yes to send them without asking")
    if input(f"{what}. Send? [y/N] ").strip().casefold() not in ("y", "yes"):
        raise UserError("nothing was sent", where="expand", fix="--dry-run shows what would be")


@contextmanager
def shown_as_given(originals: Mapping[Path, Path]) -> Iterator[None]:
    """Errors about a copy name the file that it was copied from. ``originals`` by copy, what lies inside others first."""
    try:
        yield
    except UserError as error:
        where, problem = error.where or "", error.problem
        for copy, original in originals.items():
            where, problem = where.replace(str(copy), str(original)), problem.replace(str(copy), str(original))
        raise UserError(problem, where=where or None, fix=error.fix) from None
