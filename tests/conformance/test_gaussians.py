"""Recorded images and gradients of gsplat's torch reference, for every CPU backend."""

from __future__ import annotations

import pytest

from sceneexpander.splatting.conformance import run_case
from sceneexpander.splatting.kernel_backend import load_kernel
from tests.support.shared import shared_folder

pytestmark = pytest.mark.conformance


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("name", ["case_a", "case_b"])
def test_recorded_case(name: str, backend: str) -> None:
    case = shared_folder("conformance/gaussians") / f"{name}.safetensors"
    if backend == "cpu" and load_kernel() is None:
        pytest.skip("no compiled kernel (no compiler at install)")
    checks = run_case(case, backend=backend)  # type: ignore[arg-type]
    assert len(checks) >= 10  # 3 images, the loss, 6 gradients
    assert not [f"{c.name}: {c.error:.2e} > {c.tolerance:.2e}" for c in checks if not c.ok]


def test_the_folder_of_cases_is_a_set_of_cases() -> None:
    assert sorted(path.stem for path in shared_folder("conformance/gaussians").glob("*.safetensors")) == [
        "case_a",
        "case_b",
    ]
