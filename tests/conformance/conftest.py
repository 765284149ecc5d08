"""Recordings that are not there are said, whatever pytest is asked to keep quiet about."""

from __future__ import annotations

from collections import Counter

from _pytest.terminal import TerminalReporter

from tests.support.shared import ABSENT


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    skipped = terminalreporter.stats.get("skipped", [])
    absent = Counter(
        report.nodeid.partition("::")[0] for report in skipped if ABSENT in str(getattr(report, "longrepr", ""))
    )
    if absent:
        terminalreporter.section("NOT RUN: the references' large recordings are absent", sep="=", red=True, bold=True)
        for path, count in sorted(absent.items()):
            terminalreporter.write_line(f"{path}: {count} cases not run")
        terminalreporter.write_line(
            f"{absent.total()} cases not run; set SCENEEXPANDER_SHARED to the folder that holds conformance/ and specs/. "
            "The small cases of the repository did run."
        )
