"""CPU and wall seconds of every stage of a run of the pipeline, from the statistics that the stages leave.

    python benchmarks/stage_costs.py outputs/courtyard

Stages that came from the cache show what they took when they ran. CPU seconds are those of the whole process, imports included; the
stages that gather what others made (resolve, collect, report, track) and DVC itself are not in it.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What one or more runs of a stage took."""

    runs: int
    cpu_s: float
    wall_s: float
    peak_rss_mb: float

    def joined(self, other: Cost) -> Cost:
        """Both together: times add up, of the memory the larger counts."""
        return Cost(
            runs=self.runs + other.runs,
            cpu_s=self.cpu_s + other.cpu_s,
            wall_s=self.wall_s + other.wall_s,
            peak_rss_mb=max(self.peak_rss_mb, other.peak_rss_mb),
        )


def costs_of(scene: Path) -> Iterator[tuple[str, Cost]]:
    """(stage, cost) of each run in the outputs of a scene, in the order in which they began."""
    found = []
    for path in scene.glob("**/stats/*.json"):
        facts = json.loads(path.read_text())
        cost = Cost(runs=1, cpu_s=facts["cpu_s"], wall_s=facts["wall_s"], peak_rss_mb=facts["peak_rss_mb"])
        found.append((facts["started"], path.stem.partition("-")[0], cost))
    yield from ((stage, cost) for _, stage, cost in sorted(found, key=lambda entry: entry[0]))


def table(scene: Path) -> str:
    """One row per stage, those that run once per method added up, and their sum."""
    by_stage: dict[str, Cost] = defaultdict(lambda: Cost(runs=0, cpu_s=0.0, wall_s=0.0, peak_rss_mb=0.0))
    for stage, cost in costs_of(scene):
        for name in (stage, "together"):
            by_stage[name] = by_stage[name].joined(cost)
    if not by_stage:
        raise SystemExit(f"error: {scene}: holds no statistics; run the pipeline first")
    by_stage["together"] = by_stage.pop("together")  # last
    lines = ["| stage | runs | CPU s | wall s | peak MB |", "|---|---|---|---|---|"]
    for stage, cost in by_stage.items():
        lines.append(f"| {stage} | {cost.runs} | {cost.cpu_s:.1f} | {cost.wall_s:.1f} | {cost.peak_rss_mb:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", default=Path("outputs/courtyard"))
    print(table(parser.parse_args().scene))
