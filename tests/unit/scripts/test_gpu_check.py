"""The GPU check without a GPU: its parts run on the CPU, and no part can take the others down."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import gpu_check
import gpu_parts
import pytest
import torch
from gpu_check import GSPLAT_BUILD, Part, Report, run_parts, text_of
from gpu_findings import Finding, Log, Outcome, Skipped, Status, read_findings

from sceneexpander.artifacts.store import read_json

# A part without torch: what it does is its name.
FAKE_PART = """
import json, os, signal, subprocess, sys, time
name, folder = sys.argv[1:3]
def found(value, at_most=None):
    with open(f"{folder}/{name}.jsonl", "a") as file:
        file.write(json.dumps({"name": "n", "value": value, "unit": "", "at_least": None, "at_most": at_most}) + "\\n")
found(1.0)
if name == "hangs":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    open(f"{folder}/child", "w").write(str(child.pid))
    with open(f"{folder}/{name}.jsonl", "a") as file:
        file.write('{"name": "torn')
    time.sleep(60)
if name == "dies":
    os.kill(os.getpid(), signal.SIGKILL)
if name == "raises":
    raise RuntimeError("CUDA out of memory")
if name == "wrong":
    found(2.0, at_most=1.0)
print(json.dumps({"skipped": "not here"} if name in ("skips", "gsplat_build") else {"done": True}))
"""


def run_fakes(
    folder: Path, *names: str, limit_s: float = 30, budget_s: float = 60, gsplat: bool = False
) -> list[Outcome]:
    script = folder / "fake_part.py"
    script.write_text(FAKE_PART)
    parts = [Part(name=name, limit_s=limit_s, gsplat=gsplat) for name in names]
    command = (sys.executable, str(script))
    return list(run_parts(parts, folder, device="cuda", smoke=False, budget_s=budget_s, command=command))


def test_what_fails_is_said_and_the_rest_runs(tmp_path: Path) -> None:
    outcomes = run_fakes(tmp_path, "dies", "raises", "wrong", "skips", "good")
    assert [outcome.status for outcome in outcomes] == [Status.FAILED] * 3 + [Status.SKIPPED, Status.PASSED]
    reasons = [outcome.reason for outcome in outcomes]
    assert reasons == [
        "signal 9: it said nothing",
        "exit code 1: RuntimeError: CUDA out of memory",
        "out of bounds: n",
        "not here",
        "",
    ]


def test_a_part_that_hangs_is_ended_with_its_children_and_keeps_what_it_found(tmp_path: Path) -> None:
    begin = time.monotonic()
    hanging, good = run_fakes(tmp_path, "hangs", "good", limit_s=2.5)
    assert time.monotonic() - begin < 20
    assert (hanging.status, good.status) == (Status.TIMED_OUT, Status.PASSED)
    assert [finding.value for finding in hanging.findings] == [1.0]
    child = int((tmp_path / "child").read_text())
    assert not _alive(child)


def _alive(process: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text() and os.kill(process, 0) is None
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_without_gsplat_what_needs_it_is_skipped_with_the_reason(tmp_path: Path) -> None:
    built, part = run_fakes(tmp_path, "good", gsplat=True)
    assert built.part == GSPLAT_BUILD
    assert part.status is Status.SKIPPED
    assert part.reason == "needs gsplat, which skipped: not here"


def test_a_part_that_finds_no_time_left_is_skipped(tmp_path: Path) -> None:
    (outcome,) = run_fakes(tmp_path, "good", budget_s=1)
    assert outcome.status is Status.SKIPPED
    assert outcome.reason == "no time left of 1 s"


def test_the_limits_fit_the_budget_with_time_for_the_pipeline() -> None:
    before = sum(part.limit_s for part in gpu_check.PARTS if part.name not in ("adapt_plain", "pipeline"))
    assert before <= gpu_check.BUDGET_S <= 540
    assert {part.name for part in gpu_check.PARTS} | {GSPLAT_BUILD} == set(gpu_parts.PARTS)


@pytest.mark.parametrize(
    ("finding", "holds"),
    [
        (Finding(name="n", value=0.5, at_least=0.4, at_most=0.6), True),
        (Finding(name="n", value=0.7, at_most=0.6), False),
        (Finding(name="n", value="nan", at_most=0.6), False),
        (Finding(name="n", value=False, at_least=1), False),
        (Finding(name="n", value="H200"), True),
    ],
)
def test_bounds_are_kept_by_finite_numbers_only(finding: Finding, holds: bool) -> None:
    assert finding.holds is holds


def test_the_page_says_what_is_out_of_bounds_what_was_skipped_and_where_it_ran() -> None:
    wrong = Outcome(
        part="forward",
        status=Status.FAILED,
        reason="out of bounds: peak",
        seconds=3.0,
        findings=(Finding(name="peak", value=30.0, unit="GB", at_most=24), Finding(name="GPU", value="A100")),
    )
    skipped = Outcome(part="gsplat", status=Status.SKIPPED, reason="not installed", seconds=0.0, findings=())
    report = Report(device="cuda", smoke=False, seconds=3.0, outcomes=(wrong, skipped))
    page = text_of(report)
    assert not report.passed
    assert "peak: 30 GB  (at most 24)  <-- OUT OF BOUNDS" in page
    assert "not installed" in page
    assert page.startswith("GPU check, A100")
    assert "SMOKE MODE" in text_of(Report(device="cpu", smoke=True, seconds=1.0, outcomes=()))


def test_without_a_gpu_it_refuses_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as ended:
        gpu_check.main([])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_the_report_is_written_as_parts_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = Outcome(part="machine", status=Status.FAILED, reason="why", seconds=1.0, findings=())
    monkeypatch.setattr(gpu_check, "run_parts", lambda *_, **__: iter([outcome]))
    with pytest.raises(SystemExit) as ended:
        gpu_check.main(["--smoke", "--out", str(tmp_path)])
    assert ended.value.code == 1
    assert read_json(tmp_path / "gpu_check.json")["outcomes"][0]["reason"] == "why"
    assert "why" in (tmp_path / "gpu_check.txt").read_text()


def setting_in(folder: Path, part: str) -> gpu_parts.Setting:
    return gpu_parts.Setting(
        device=torch.device("cpu"),
        seconds=120,
        folder=folder / part,
        log=Log(folder / f"{part}.jsonl"),
        smoke=True,
    )


# Those that take longest are run below tests/pipeline.
ELSEWHERE = (GSPLAT_BUILD, "options", "adapt_paper", "adapt_plain", "pipeline")


@pytest.mark.parametrize("part", [name for name in gpu_parts.PARTS if name not in ELSEWHERE])
def test_the_part_runs_on_a_cpu_and_keeps_its_bounds(part: str, tmp_path: Path) -> None:
    setting = setting_in(tmp_path, part)
    gpu_parts.PARTS[part](setting)
    findings = list(read_findings(setting.log.path))
    assert findings
    assert [finding for finding in findings if not finding.holds] == []


def test_gsplat_is_not_built_on_a_cpu(tmp_path: Path) -> None:
    with pytest.raises(Skipped, match="gsplat"):
        gpu_parts.PARTS[GSPLAT_BUILD](setting_in(tmp_path, GSPLAT_BUILD))
