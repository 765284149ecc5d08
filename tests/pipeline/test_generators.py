"""What an image service is asked for by the pipeline as users run it: each picture once, and nothing by looking."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.loopback import Service, picture, serving
from tests.worlds.project import SMOKE, Project

pytestmark = pytest.mark.pipeline

CHOICE = "choose_view@room-round0"
KEY = "sk-verysecret0123456789"
SWEEP = (
    "from pathlib import Path; from sceneexpander.cli.sweep import check_axes, check_inputs; "
    "check_inputs(check_axes(['--multirun', 'seed=0,1'], Path()).jobs, Path())"
)


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    with serving() as found:
        found.answers = [picture(seed) for seed in range(1, 12)]
        yield found


@pytest.fixture(scope="module")
def project(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Project:
    overrides = (
        *SMOKE,
        "generator=openai",
        f"generator.base_url={service.address}/v1",
        "generator.key_variable=TEST_KEY",
        "generator.timeout_s=60",
    )
    made = Project(tmp_path_factory.mktemp("generators") / "project", overrides)
    made.environment["TEST_KEY"] = KEY
    return made


def repro(project: Project, *options: str) -> list[str]:
    return re.findall(r"Running stage '([^']+)'", project.run("-m", "dvc", "repro", *options, CHOICE).stdout)


def test_every_picture_is_asked_for_once(project: Project, service: Service) -> None:
    project.run("-m", "stages.check")
    project.run("-c", SWEEP)
    assert service.asked == [], "looking sends nothing"
    assert "generate_view@room-round0" in repro(project)
    assert len(service.asked) == 2
    assert repro(project) == []
    project.run("-m", "stages.check")
    assert repro(project, "--force", "--single-item", "generate_view@room-round0") != []
    project.run("-m", "stages.generate_view", "room", "1", "0")
    assert len(service.asked) == 2, "forced, and with outputs gone, they come from the cache"
    params = project.folder / "params.yaml"
    params.write_text(params.read_text().replace("- profile=smoke", "- profile=smoke\n- choose.candidate=1"))
    assert set(repro(project)) == {"resolve@room", CHOICE}, "another choice reruns nothing before it"
    assert len(service.asked) == 2
    for path in project.folder.rglob("*"):
        if path.is_file() and not path.is_relative_to(project.folder / "src"):
            assert KEY.encode() not in path.read_bytes(), path


def test_a_killed_stage_goes_on_with_what_came(project: Project, service: Service) -> None:
    settings = project.folder / "outputs" / "room" / "rounds.json"
    settings.write_text(settings.read_text().replace('"take": 0', '"take": 1'))
    before = len(service.asked)
    service.answers[1].wait_s = 5.0
    command = [sys.executable, "-m", "stages.generate_view", "room", "1", "0"]
    process = subprocess.Popen(command, cwd=project.folder, env=project.environment, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while len(service.asked) < before + 2:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    project.run("-m", "stages.generate_view", "room", "1", "0")
    assert len(service.asked) == before + 3, "the first is kept, the second alone is asked for again"


def test_a_missing_key_is_one_line_and_leaves_what_there_is(project: Project, service: Service) -> None:
    before = len(service.asked)
    params, kept = project.folder / "params.yaml", (project.folder / "params.yaml").read_text()
    candidates = sorted(Path(project.folder / "outputs" / "room" / "round_1" / "candidates").rglob("*"))
    params.write_text(kept + "- generator.take=5\n" if kept.endswith("\n") else kept)
    environment = project.environment.pop("TEST_KEY")
    try:
        done = project.run("-m", "stages.check", check=False)
    finally:
        project.environment["TEST_KEY"] = environment
        params.write_text(kept)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert "TEST_KEY: is not set" in line
    assert "Traceback" not in done.stderr
    assert len(service.asked) == before
    assert sorted(Path(project.folder / "outputs" / "room" / "round_1" / "candidates").rglob("*")) == candidates
