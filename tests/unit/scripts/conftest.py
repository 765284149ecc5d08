"""The scripts import each other, and the benchmarks, as neighbours: as they do when one of them is run."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "benchmarks")]
