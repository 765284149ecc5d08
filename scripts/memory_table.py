"""Write docs/memory_table.md: what adaptation and reconstruction need from 2 to 32 views (`python scripts/memory_table.py`).

Takes about ten minutes of one core: every cell is a simulated run of the released size.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from sceneexpander.cli.plan import Question, answer
from sceneexpander.errors import entry_point
from sceneexpander.files import write_bytes_atomic

VIEWS = (2, 3, 5, 9, 17, 25, 32)
OPTIONS = ("gpu24", "paper")
TARGET = Path(__file__).parents[1] / "docs" / "memory_table.md"
HEAD = """# Memory and operations by number of views

Written by `python scripts/memory_table.py`; do not edit. `worldmirror/large` (1263 M parameters), 518 x 518 pixels. GB are 10^9 bytes
of tensors on the GPU at most, TFLOP those of an average step or of a reconstruction with all heads. `gpu24` is `profile=gpu24`, `paper`
the plain way: see [memory.md](memory.md).

"""


@entry_point
def main() -> None:
    """Simulate and write."""
    columns = " | ".join(f"GB, {options}" for options in OPTIONS)
    lines = [
        f"| views | most in a step | {columns} | TFLOP, {OPTIONS[0]} | GB, reconstruction | TFLOP, reconstruction |"
    ]
    lines.append("|" + "---|" * (5 + len(OPTIONS)))
    for views in VIEWS:
        plans = [answer(replace(Question(views=views), options=options)) for options in OPTIONS]
        first = plans[0]
        cells = [f"{plan['peak_gb']:.1f}" for plan in plans]
        cells += [f"{first['flops_per_step'] / 1e12:.0f}", f"{first['inference_peak_gb']:.1f}"]
        cells += [f"{first['inference_flops'] / 1e12:.0f}"]
        lines.append(f"| {views} | {first['step_views']} | {' | '.join(cells)} |")
        print(lines[-1], file=sys.stderr, flush=True)
    write_bytes_atomic(TARGET, (HEAD + "\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    main()
