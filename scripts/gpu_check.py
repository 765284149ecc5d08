"""Does all of it work on this machine's GPU? ``python scripts/gpu_check.py [--out gpu_check] [--only PART ...] [--smoke]``

Under nine minutes on one CUDA machine, nothing is downloaded: weights are random, pictures are made or the bundled scene's. Every part runs
in a process of its own with its own time limit, so one that fails, hangs or runs out of memory takes nothing from the others. gsplat,
which its first use may compile, is built beside the parts that do not need it. Writes ``gpu_check.json`` and ``gpu_check.txt``.
Exit code 0: nothing failed or ran out of time; 1: something did. What was skipped, and why, is said.

``--smoke`` runs every part on the CPU at the smallest sizes, in about three minutes: it shows that the parts run, and nothing about a GPU.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gpu_findings import Finding, Outcome, Status, read_findings

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.errors import UserError, entry_point
from sceneexpander.files import write_bytes_atomic

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = "gpu-check/1"
BUDGET_S = 520.0
LEAST_S = 5.0  # with less left nothing is started
GRACE_S = 3.0  # that a part has, once it is told to end
WIDTH = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the check: how long it may take, and whether it draws with gsplat."""

    name: str
    limit_s: float
    gsplat: bool = False


GSPLAT_BUILD = "gsplat_build"
# What depends on gsplat comes late, when it has had its time to be built; the pipeline gets what is left.
PARTS = (
    Part(name="machine", limit_s=30),
    Part(name="adapt_gpu24", limit_s=75),
    Part(name="adapt_paper", limit_s=60),
    Part(name="forward", limit_s=45),
    Part(name="agreement", limit_s=45),
    Part(name="resume", limit_s=40),
    Part(name="options", limit_s=90),
    Part(name="gsplat", limit_s=45, gsplat=True),
    Part(name="optimise_default", limit_s=45, gsplat=True),
    Part(name="optimise_mcmc", limit_s=45, gsplat=True),
    Part(name="adapt_plain", limit_s=75),
    Part(name="pipeline", limit_s=240, gsplat=True),
)
_BUILD = Part(name=GSPLAT_BUILD, limit_s=360)


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The whole check."""

    device: str
    smoke: bool
    seconds: float
    outcomes: tuple[Outcome, ...]
    schema: str = SCHEMA

    @property
    def passed(self) -> bool:
        """Whether nothing failed or ran out of time. What was skipped does not count."""
        return all(outcome.status in (Status.PASSED, Status.SKIPPED) for outcome in self.outcomes)


class RunningPart:
    """A part in a process group of its own.

    Args:
        part: what runs.
        command: how.
        folder: where it leaves its findings and its output.
        limit_s: seconds after which it is ended.
    """

    def __init__(self, part: Part, command: Sequence[str], folder: Path, *, limit_s: float) -> None:
        self.part, self.folder, self.limit_s = part, folder, limit_s
        self._begin = time.monotonic()
        self._output = folder / f"{part.name}.txt"
        with self._output.open("wb") as file:
            self._process = subprocess.Popen(
                command, cwd=ROOT, env=_environment(), stdout=file, stderr=subprocess.STDOUT, start_new_session=True
            )

    def finish(self, limit_s: float | None = None) -> Outcome:
        """Wait for its end, for the rest of its limit or ``limit_s`` if that is less, and say how it ended."""
        left = self._begin + self.limit_s - time.monotonic()
        in_time = True
        try:
            self._process.wait(max(left if limit_s is None else min(left, limit_s), 0))
        except subprocess.TimeoutExpired:
            in_time = False
        finally:
            self.stop()
        findings = tuple(read_findings(self.folder / f"{self.part.name}.jsonl"))
        status, reason = self._ended(findings, in_time=in_time)
        return Outcome(
            part=self.part.name,
            status=status,
            reason=reason,
            seconds=round(time.monotonic() - self._begin, 1),
            findings=findings,
        )

    def stop(self) -> None:
        """End whatever of it still runs."""
        for number in (signal.SIGTERM, signal.SIGKILL):  # the second for what it started and left behind
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)

    def _ended(self, findings: tuple[Finding, ...], *, in_time: bool) -> tuple[Status, str]:
        lines = self._output.read_text(errors="replace").strip().splitlines() or ["it said nothing"]
        if not in_time:
            return Status.TIMED_OUT, f"ended after {time.monotonic() - self._begin:.0f} s"
        if self._process.returncode != 0:
            code = self._process.returncode
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            return Status.FAILED, f"{how}: {lines[-1]}"
        try:
            said = json.loads(lines[-1])
        except ValueError:
            return Status.FAILED, f"its last line is {lines[-1]!r}"
        if "skipped" in said:
            return Status.SKIPPED, str(said["skipped"])
        if "timed_out" in said:
            return Status.TIMED_OUT, str(said["timed_out"])
        wrong = [finding.name for finding in findings if not finding.holds]
        return (Status.FAILED, f"out of bounds: {', '.join(wrong)}") if wrong else (Status.PASSED, "")


def run_parts(
    parts: Sequence[Part], folder: Path, *, device: str, smoke: bool, budget_s: float, command: Sequence[str] = ()
) -> Iterator[Outcome]:
    """Run parts one after another, gsplat's building beside them, within a budget of seconds.

    Args:
        parts: what to run, in order.
        folder: where parts leave what they find.
        device: ``cpu`` or ``cuda``.
        smoke: at the smallest sizes.
        budget_s: for everything; a part that finds no time left is skipped.
        command: of a part, its arguments follow; default: `gpu_parts.py`.
    """
    ends = time.monotonic() + budget_s
    folder.mkdir(parents=True, exist_ok=True)

    def start(part: Part) -> RunningPart:
        limit = min(part.limit_s, ends - time.monotonic())
        base = command or (sys.executable, str(ROOT / "scripts" / "gpu_parts.py"))
        arguments = [*base, part.name, str(folder), device, f"{limit:.1f}", *(["--smoke"] if smoke else [])]
        return RunningPart(part, arguments, folder, limit_s=limit)

    building = start(_BUILD) if any(part.gsplat for part in parts) else None
    built: Outcome | None = None
    try:
        for part in parts:
            if part.gsplat and building is not None and built is None:
                built = building.finish(ends - time.monotonic())
                yield built
            reason = ""
            if part.gsplat and not smoke and built is not None and built.status is not Status.PASSED:
                reason = f"needs gsplat, which {built.status}: {built.reason}"
            elif ends - time.monotonic() < LEAST_S:
                reason = f"no time left of {budget_s:.0f} s"
            if reason:
                yield Outcome(part=part.name, status=Status.SKIPPED, reason=reason, seconds=0.0, findings=())
                continue
            running = start(part)
            try:
                yield running.finish()
            finally:
                running.stop()
    finally:
        if building is not None:
            building.stop()


def text_of(report: Report) -> str:
    """The report for a reader."""
    found = [finding for outcome in report.outcomes for finding in outcome.findings if finding.name == "GPU"]
    gpu = str(found[0].value) if found else report.device
    where = "SMOKE MODE on a CPU: shows that the parts run, and nothing about a GPU" if report.smoke else gpu
    lines = [f"GPU check, {where}, {report.seconds:.0f} s", ""]
    for outcome in report.outcomes:
        line = f"{outcome.part:17s} {outcome.status:10s} {outcome.seconds:6.1f} s  {outcome.reason}"
        lines.append(line.rstrip() if len(line) <= WIDTH + 60 else line[: WIDTH + 57] + "...")
    for outcome in report.outcomes:
        if outcome.findings:
            lines += ["", outcome.part]
            lines += [f"  {_line_of(finding)}" for finding in outcome.findings]
    return "\n".join(lines) + "\n"


def _line_of(finding: Finding) -> str:
    value = f"{finding.value:.4g}" if isinstance(finding.value, float) else str(finding.value)
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("at least", finding.at_least), ("at most", finding.at_most))
        if bound is not None
    ]
    text = f"{finding.name}: {value} {finding.unit}".rstrip() + (f"  ({', '.join(bounds)})" if bounds else "")
    return text if finding.holds else f"{text}  <-- OUT OF BOUNDS"


def _environment() -> dict[str, str]:
    folders = [str(ROOT / name) for name in ("scripts", "benchmarks", "src", ".")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(folders), "SCENEEXPANDER_ROOT": str(ROOT), "PYTHONUTF8": "1"}


def _require_cuda() -> None:
    import torch

    if not torch.cuda.is_available():
        raise UserError(
            f"no CUDA device is available to torch {torch.__version__}",
            where="--device cuda",
            fix="run it where there is one, or try its parts on the CPU with --smoke",
        )


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Run the parts, print and write the report."""
    names = [part.name for part in PARTS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gpu_check"), help="folder of the report (default: gpu_check)")
    parser.add_argument("--only", nargs="+", choices=names, metavar="PART", help=f"some of: {', '.join(names)}")
    parser.add_argument(
        "--budget", type=float, default=BUDGET_S, help=f"seconds for everything (default: {BUDGET_S:g})"
    )
    parser.add_argument("--patience", type=float, default=1.0, help="times the limit of every part (default: 1)")
    parser.add_argument("--smoke", action="store_true", help="on the CPU at the smallest sizes")
    given = parser.parse_args(arguments)
    if not given.smoke:
        _require_cuda()
    device = "cpu" if given.smoke else "cuda"
    out = given.out.resolve()
    chosen = [
        replace(part, limit_s=given.patience * part.limit_s)
        for part in PARTS
        if given.only is None or part.name in given.only
    ]
    begin = time.monotonic()
    outcomes: list[Outcome] = []
    report = Report(device=device, smoke=given.smoke, seconds=0.0, outcomes=())
    for outcome in run_parts(chosen, out / "parts", device=device, smoke=given.smoke, budget_s=given.budget):
        outcomes.append(outcome)
        print(f"{outcome.part}: {outcome.status} ({outcome.seconds:.0f} s) {outcome.reason}".rstrip(), flush=True)
        seconds = round(time.monotonic() - begin, 1)
        report = Report(device=device, smoke=given.smoke, seconds=seconds, outcomes=tuple(outcomes))
        # After every part: what was found is there even if this process is ended.
        write_json_atomic(out / "gpu_check.json", report)
        write_bytes_atomic(out / "gpu_check.txt", text_of(report).encode())
    print(f"report: {out / 'gpu_check.txt'}")
    raise SystemExit(0 if report.passed else 1)


if __name__ == "__main__":
    main()
