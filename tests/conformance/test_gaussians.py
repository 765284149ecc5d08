"""Recorded images and gradients of gsplat's torch reference, for every CPU backend."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sceneexpander.splatting.conformance import run_case
from sceneexpander.splatting.kernel_backend import load_kernel

SHARED = Path(os.environ.get("SCENEEXPANDER_SHARED", Path(__file__).parents[3] / "shared"))
CASES = sorted((SHARED / "conformance" / "gaussians").glob("*.safetensors"))

pytestmark = [
    pytest.mark.conformance,
    pytest.mark.skipif(not CASES, reason=f"no recorded cases in {SHARED / 'conformance' / 'gaussians'}"),
]


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("case", CASES, ids=lambda path: path.stem)
def test_recorded_case(case: Path, backend: str) -> None:
    if backend == "cpu" and load_kernel() is None:
        pytest.skip("no compiled kernel (no compiler at install)")
    checks = run_case(case, backend=backend)  # type: ignore[arg-type]
    assert len(checks) >= 10  # 3 images, the loss, 6 gradients
    assert not [f"{c.name}: {c.error:.2e} > {c.tolerance:.2e}" for c in checks if not c.ok]
