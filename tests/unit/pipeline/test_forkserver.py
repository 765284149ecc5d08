"""A forked stage is a process like any other: arguments, environment, exit code, signals, end; and it starts from what others loaded."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from sceneexpander.pipeline import dvc_adapter
from sceneexpander.pipeline.declared import read_pipeline
from sceneexpander.pipeline.forkserver import ForkServer, Order, read_order
from sceneexpander.pipeline.plain import PlainRunner

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="stages are forked on Linux only")

ROOT = Path(__file__).parents[3]
STAGE = """
import os, sys, time
from pathlib import Path
assert __name__ == "__main__"
what, *rest = sys.argv[1:]
if what == "facts":
    ours = sorted(name for name in STARTED if name.partition(".")[0] in ("sceneexpander", "stages"))
    print(Path(sys.argv[0]).name, rest, os.environ["WORD"], "torch" in STARTED, ours, len(os.listdir("/proc/self/task")))
    print(repr(sys.stdin.read()))
elif what == "exit":
    sys.exit(int(rest[0]))
elif what == "fail":
    raise RuntimeError("broken")
elif what == "sleep":
    from sceneexpander.errors import interruptible
    from sceneexpander.pipeline.processes import end_with_parent
    interruptible()
    end_with_parent()
    Path(rest[0]).write_text(f"{os.getpid()} {os.getppid()}")
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForkServer]:
    """Of a folder with a single stage of its own, beside the sources."""
    folder = tmp_path_factory.mktemp("forks")
    (folder / "stages").mkdir()
    (folder / "stages" / "__init__.py").write_text("")
    (folder / "stages" / "toy.py").write_text("import sys\nSTARTED = set(sys.modules)\n" + STAGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT / "src")]))
        server = ForkServer()
        # What runs in the background of a shell ignores interrupts, and so does all that it starts.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        yield server
        server.close()
        signal.signal(signal.SIGINT, before)


def toy(*arguments: str, **environment: str) -> Order:
    return Order(module="stages.toy", arguments=arguments, environment=environment)


def test_a_stage_gets_what_it_is_given_and_nothing_of_the_project(
    server: ForkServer, capfd: pytest.CaptureFixture[str]
) -> None:
    assert server.run(toy("facts", "a b", "c'd", WORD="x")) == 0
    assert server.run(toy("fail")) == 1
    written = capfd.readouterr()  # the server writes to where this process wrote to when it started
    facts, stdin = written.out.splitlines()
    assert "RuntimeError: broken" in written.err
    itself = [
        "sceneexpander",
        "sceneexpander.errors",
        "sceneexpander.pipeline",
        "sceneexpander.pipeline.processes",
        "stages",
    ]
    # One thread: another one would be missing after a fork, with whatever lock it held.
    assert facts == f"""toy.py {["a b", "c'd"]} x True {itself} 1"""
    assert stdin == "''"


def test_its_exit_code_is_the_stages(server: ForkServer) -> None:
    assert [server.run(toy("exit", str(code))) for code in (0, 2, 130)] == [0, 2, 130]


def test_a_stage_runs_the_code_that_is_there_when_it_starts(server: ForkServer) -> None:
    path = Path("stages/toy.py")
    before = path.read_text()
    try:
        path.write_text("import sys\nsys.exit(7)\n")
        assert server.run(toy("facts", WORD="")) == 7
    finally:
        path.write_text(before)


@dataclass(slots=True)
class Sleeper:
    """A stage that sleeps: its process, its server's, and its exit code once the block has ended."""

    stage: int
    server: int
    code: int = -1


@contextlib.contextmanager
def sleeper(server: ForkServer, note: Path) -> Iterator[Sleeper]:
    """Until something ends it."""
    with ThreadPoolExecutor(1) as pool:
        code = pool.submit(server.run, toy("sleep", str(note)))
        while not note.exists() or len(note.read_text().split()) < 2:
            time.sleep(0.01)
        found = Sleeper(*map(int, note.read_text().split()))
        yield found
        found.code = code.result(10)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, 137), (signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_stage_and_not_the_server(
    server: ForkServer, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    with sleeper(server, tmp_path / "note") as one:
        os.kill(one.server, signal.SIGINT)  # a terminal sends an interrupt to both
        os.kill(one.stage, number)
    assert one.code == code
    assert server.run(toy("exit", "5")) == 5


def test_stages_end_with_their_server_and_the_next_one_gets_a_new_server(
    server: ForkServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with sleeper(server, tmp_path / "note") as one:
        os.kill(one.server, signal.SIGKILL)
    assert one.code == 1
    assert "stages.toy: the process that starts stages is gone" in capfd.readouterr().err
    deadline = time.monotonic() + 10
    while Path(f"/proc/{one.stage}").exists():
        assert time.monotonic() < deadline, "the stage goes on without its server"
        time.sleep(0.01)
    assert server.run(toy("exit", "5")) == 5


PIPELINE = """
stages:
  toy:
    matrix: {name: [a, b]}
    cmd: python -m stages.toy parent '${item.name}'
    outs: ["${item.name}"]
"""


@pytest.fixture
def pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two stages of ours, each of which writes down who started it and as which stage."""
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "__init__.py").write_text("")
    (tmp_path / "stages" / "toy.py").write_text(
        "import os, sys\nfrom pathlib import Path\n"
        "Path(sys.argv[2]).write_text(Path(f'/proc/{os.getppid()}/cmdline').read_text() + ' ' + os.environ['DVC_STAGE'])\n"
    )
    (tmp_path / "dvc.yaml").write_text(PIPELINE)
    (tmp_path / "params.yaml").write_text("scenes: []\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT / "src")]))
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    return tmp_path


def check_forked(folder: Path) -> None:
    for name in "ab":
        started_by = (folder / name).read_text()
        assert "sceneexpander.pipeline.forkserver" in started_by
        assert started_by.endswith(f"toy@{name}")


def test_dvc_forks_its_stages(pipeline: Path) -> None:
    from dvc.repo import Repo

    Repo.init(pipeline, no_scm=True)
    try:
        assert dvc_adapter.reproduce(["--quiet"]) == 0
    finally:
        dvc_adapter._fork_server().close()
    check_forked(pipeline)


def test_the_plain_runner_forks_its_stages(pipeline: Path) -> None:
    runner = PlainRunner(pipeline, jobs=2)
    runner.run(read_pipeline(pipeline))
    assert not runner.failed
    check_forked(pipeline)


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("python -m stages.report", ()),
        ("python -m stages.adapt 'two words' '1'", ("two words", "1")),
        ("python -m stages.adapt '$HOME; ls `x`'", ("$HOME; ls `x`",)),
        ("python -m stages.adapt $HOME", None),
        ("python -m stages.adapt a; rm b", None),
        ("python -m stages.adapt a > b", None),
        ("python -m stages.adapt 'a", None),
        ("python -m other.module", None),
        ("python stages/adapt.py", None),
        ("python -m", None),
        ("cp a b", None),
        ("", None),
    ],
)
def test_only_what_a_shell_would_run_just_so_is_forked(command: str, arguments: tuple[str, ...] | None) -> None:
    order = read_order(command, {})
    assert (None if order is None else order.arguments) == arguments
