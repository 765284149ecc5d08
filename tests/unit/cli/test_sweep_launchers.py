"""Sweeps through Hydra's real launchers, over a pipeline of two small stages: locks, cache, failures and retries are the real ones."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest

from sceneexpander.artifacts.store import to_plain, write_json_atomic
from sceneexpander.cli import sweep as module
from sceneexpander.cli.sweep import Job, Sweep, job_state, run_sweep

ROOT = Path(__file__).parents[3]
PIPELINE = """
stages:
  common:
    cmd: echo ran >> "$SCENEEXPANDER_ROOT/common.log" && sleep 1 && mkdir -p outputs && echo made > outputs/common
    deps: [conf/config.yaml]
    outs: [outputs/common]
  own:
    cmd: python stages/own.py
    deps: [outputs/common]
    params: [overrides]
    outs: [outputs/report]
"""
# One job refuses as long as there is a file; another has the process killed that its launcher started, the first time.
OWN = """
import os, pathlib, signal, sys
root, settings = pathlib.Path(os.environ["SCENEEXPANDER_ROOT"]), pathlib.Path("params.yaml").read_text()
if "seed=1" in settings and (root / "broken").exists():
    sys.exit("broken")
if "seed=2" in settings and not (root / "killed").exists():
    (root / "killed").write_text("")
    pid = os.getppid()
    while "processes.py" not in (line := pathlib.Path(f"/proc/{pid}/cmdline").read_text()):
        pid = int(pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    words = line.split(chr(0))
    os.kill(int(words[words.index("-I") + 2]), signal.SIGKILL)
    signal.pause()
pathlib.Path("outputs/report").mkdir(parents=True)
pathlib.Path("outputs/report/index.html").write_text(settings)
with open(root / "own.log", "a") as file:
    file.write("x")
"""
RAY = pytest.mark.skipif(
    importlib.util.find_spec("hydra_plugins.hydra_ray_launcher") is None, reason="needs the extra 'cluster'"
)
WHOLE = pytest.mark.skipif(
    "SCENEEXPANDER_TEST_LAUNCHERS" not in os.environ, reason="takes minutes: SCENEEXPANDER_TEST_LAUNCHERS=1"
)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    for name in ("src", "stages", "scenes", ".dvc"):
        (folder / name).mkdir(parents=True)
    (folder / "conf").symlink_to(ROOT / "conf")
    (folder / "scenes" / "courtyard").symlink_to(ROOT / "scenes" / "courtyard")
    (folder / "stages" / "own.py").write_text(OWN)
    (folder / "dvc.yaml").write_text(PIPELINE)
    (folder / "pyproject.toml").write_text("")
    (folder / "params.yaml").write_text(
        "scenes: [courtyard]\nrounds: [{k: 1, prev: 0}]\nmethods: [captured]\noverrides: [profile=smoke]\n"
    )
    return folder


def run_command(project: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sceneexpander.cli", "sweep", *arguments],
        cwd=project,
        env={**os.environ, "SCENEEXPANDER_ROOT": str(project), "RAY_USAGE_STATS_ENABLED": "0"},
        capture_output=True,
        text=True,
        timeout=600,
    )


JOB = module.run_job


def run_cheaply(folder: Path, job: Job, project: Path, *, sweep: str | None = None) -> None:
    """The real bookkeeping of a job whose pipeline is one line. Launchers find this function in other processes by its name."""

    def pipeline(folder: Path, job: Job, project: Path, sweep: str | None) -> None:
        if "seed=1" in job.overrides and (project / "broken").exists():
            raise RuntimeError("is broken")
        with (project / "log").open("a") as file:
            file.write(f"{job.overrides[0]} {os.getpid()}\n")

    with patch.object(module, "_run_job", pipeline):
        JOB(folder, job, project, sweep=sweep)


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Hydra sets logging up for a process of its own."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.parametrize("launcher", ["serial", "parallel"])
def test_a_job_that_fails_stops_no_other_and_is_all_that_is_tried_again(
    launcher: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def in_this_process(command: list[str], *, cwd: Path, env: dict[str, str]) -> int:
        monkeypatch.setattr(sys, "argv", ["sweep"])
        try:
            module.run_hydra([int(number) for number in command[3:]], Path(env[module.INNER_ENV]), project)
        except RuntimeError:
            return 1
        return 0

    project, folder = tmp_path / "project", tmp_path / "a sweep"
    project.mkdir()
    (project / "conf").symlink_to(ROOT / "conf")
    (project / "broken").touch()
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(module, "run_job", run_cheaply)
    monkeypatch.setattr(module, "run_group", in_this_process)
    jobs = tuple(Job(overrides=(f"seed={number}",)) for number in range(3))
    write_json_atomic(folder / "sweep.json", to_plain(Sweep(hydra=(f"hydra/launcher={launcher}",), jobs=jobs)))
    assert run_sweep(folder, project) == 1
    assert [job_state(folder, number).done for number in range(3)] == [True, False, True]
    said = capsys.readouterr().err.splitlines()
    assert said[-3:] == [
        "error: 1 of 3 jobs are not done:",
        "  1 seed=1: is broken",
        f"again, only these: sceneexpander sweep --retry '{folder}'",
    ]
    first = (project / "log").read_text().splitlines()
    (project / "broken").unlink()
    assert run_sweep(folder, project) == 0
    assert [line.split()[0] for line in (project / "log").read_text().splitlines()[len(first) :]] == ["seed=1"]
    elsewhere = {line.split()[1] for line in first} - {str(os.getpid())}
    assert bool(elsewhere) == (launcher == "parallel")


@WHOLE
@pytest.mark.parametrize(
    "launcher",
    [["parallel"], ["submitit_local"], pytest.param(["ray", "+hydra.launcher.ray.init.num_cpus=2"], marks=RAY)],
    ids=["joblib", "submitit", "ray"],
)
def test_jobs_that_fail_or_are_killed_stop_no_others_and_are_all_that_is_tried_again(
    launcher: list[str], project: Path
) -> None:
    (project / "broken").write_text("")
    folder = project / "sweep, of 3"
    kind, *more = launcher
    done = run_command(
        project, "--multirun", "seed=0,1,2", f"hydra/launcher={kind}", *more, f"hydra.sweep.dir='{folder}'"
    )
    assert done.returncode == 1, done.stderr
    assert "1 of 3 jobs are not done:" in done.stderr, done.stderr
    assert "1 seed=1: the pipeline failed" in done.stderr
    assert f"again, only these: sceneexpander sweep --retry '{folder}'" in done.stderr
    assert (project / "killed").exists()
    pages = {number: folder / str(number) / "outputs" / "report" / "index.html" for number in range(3)}
    assert [number for number, page in pages.items() if page.is_file()] == [0, 2]
    assert "seed=2" in pages[2].read_text()
    assert (project / "common.log").read_text().split() == ["ran"], "what jobs have in common runs once"
    before = (project / "own.log").read_text()
    (project / "broken").unlink()
    again = run_command(project, "--retry", str(folder))
    assert again.returncode == 0, again.stderr
    assert pages[1].is_file()
    assert (project / "own.log").read_text() == before + "x", "only what was missing ran"
    assert (project / "common.log").read_text().split() == ["ran"]
