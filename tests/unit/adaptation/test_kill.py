"""kill -9 at random moments: what is on the disk is whole, and the resumed run ends with the same bits."""

from __future__ import annotations

import multiprocessing
import random
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from sceneexpander.adaptation.loop import StepRecord, adapt
from sceneexpander.artifacts.store import sha256_of_tensors, write_json_atomic
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.adaptation import FAST, inputs_for

STEPS = 100
KILLS = 20


def run_adaptation(folder: Path, steps: Connection) -> None:
    """A whole adaptation with a resume point after every step, in a process of its own."""

    def on_step(record: StepRecord) -> None:
        steps.send(record.step)

    config = replace(FAST, steps=STEPS, checkpoint_every=1, observe_every=7)
    result = adapt(
        TinyReconstructor(), inputs_for(), config, seed=0, checkpoint_folder=folder / "checkpoint", on_step=on_step
    )
    hashes = {"student": sha256_of_tensors(result.student)}
    log = {"records": list(result.records), "looks": list(result.looks)}
    write_json_atomic(folder / "done.json", {**hashes, **log})


@pytest.fixture(scope="module")
def context() -> multiprocessing.context.ForkServerContext:
    """Processes that start with the libraries loaded: twenty starts would otherwise take a minute."""
    made = multiprocessing.get_context("forkserver")
    made.set_forkserver_preload([__name__])
    return made


def _start(context: multiprocessing.context.ForkServerContext, folder: Path) -> tuple[BaseProcess, Connection]:
    folder.mkdir(exist_ok=True)
    reader, writer = context.Pipe(duplex=False)
    process = context.Process(target=run_adaptation, args=(folder, writer))
    process.start()
    writer.close()
    return process, reader


def _steps(reader: Connection, until: int | None = None) -> list[int]:
    """The steps that the process reports, until that one or its end; a resumed run tells its earlier ones again."""
    steps: list[int] = []
    try:
        while until is None or not steps or steps[-1] < until:
            steps.append(reader.recv())
    except EOFError:
        pass
    return steps


def test_kill_9_at_random_moments_changes_nothing(
    context: multiprocessing.context.ForkServerContext, tmp_path: Path
) -> None:
    process, reader = _start(context, tmp_path / "unbroken")
    assert _steps(reader) == list(range(1, STEPS + 1))
    process.join(60)
    broken, draw = tmp_path / "broken", random.Random(3)  # noqa: S311 - when to kill is no secret
    reached: list[int] = []
    for _ in range(KILLS):
        process, reader = _start(context, broken)
        # Some steps, then some moment of the next: by the clock alone a fast machine would be done before the kill.
        steps = _steps(reader, until=max(reached, default=0) + draw.randint(1, 3))
        time.sleep(draw.uniform(0, 0.01))
        process.kill()  # SIGKILL; nothing when the process has just ended by itself
        steps += _steps(reader)
        process.join(60)
        reached += steps[-1:]
        checkpoint = broken / "checkpoint"
        if checkpoint.exists():
            assert {path.name for path in checkpoint.iterdir()} == {"artifact.json", "tensors.safetensors"}
        if (broken / "done.json").exists():
            break
    assert len(set(reached)) >= 5, "the kills must come at different steps"
    process, reader = _start(context, broken)
    _steps(reader)
    process.join(60)
    assert process.exitcode == 0
    assert {path.name for path in broken.iterdir()} == {"checkpoint", "done.json"}, "no leftovers of killed writers"
    assert (broken / "done.json").read_bytes() == (tmp_path / "unbroken" / "done.json").read_bytes()
