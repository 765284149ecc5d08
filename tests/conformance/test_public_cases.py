"""Every model against the small cases of the repository: what a clone without the large recordings can check.

The rasteriser's pictures are a window of its reference's. The networks' numbers were recorded with this implementation while it agreed with
every large recording of the references, see `docs/testing.md`: a convention that is changed by mistake shows here.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from sceneexpander.conformance.registry import find_cases
from sceneexpander.splatting.kernel_backend import load_kernel
from sceneexpander.splatting.rasterise import rasterise
from sceneexpander.splatting.settings import RasterSettings
from tests.support.public_cases import CASES, prepared_case

pytestmark = pytest.mark.conformance

# Outputs that each case compares: fewer would mean that a part was silently left out.
NETWORKS = {"worldmirror": 8, "omnivggt": 8, "ttt3r": 15}
MOST_BYTES = 300_000  # of all cases together


@pytest.mark.parametrize(("name", "count"), NETWORKS.items())
def test_a_network_predicts_what_was_recorded(name: str, count: int) -> None:
    with prepared_case(CASES / name) as folder:
        [(path, runner)] = find_cases(folder)
        checks = runner.run(path)
    assert len(checks) == count
    assert not [f"{check.name}: {check.ratio:.3g}" for check in checks if not check.ok]


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("name", ["case_a_window", "case_b_window"])
def test_the_rasteriser_shows_what_its_reference_shows(name: str, backend: str) -> None:
    if backend == "cpu" and load_kernel() is None:
        pytest.skip("no compiled kernel (no compiler at install)")
    with safe_open(CASES / "gaussians" / f"{name}.safetensors", "pt") as file:
        facts = file.metadata()
        case = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - safe_open is no mapping
    inputs = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    seen = rasterise(
        *(case[f"in.{key}"] for key in inputs),
        int(facts["height"]),
        int(facts["width"]),
        background=case.get("in.backgrounds"),
        settings=RasterSettings(
            near=float(facts["near"]),
            far=float(facts["far"]),
            eps2d=float(facts["eps2d"]),
            antialiased="antialiased" in facts["rasterize_mode"],
            max_alpha=0.99,
            backend=backend,  # type: ignore[arg-type]
        ),
    )
    assert seen.depth is not None
    assert len(case["in.means"]) > 50
    x, y, width, height = json.loads(facts["window"])
    rgb, alpha, depth = (value[..., y : y + height, x : x + width] for value in (seen.rgb, seen.alpha, seen.depth))
    torch.testing.assert_close(rgb.movedim(1, -1), case["out.rgb"], atol=2e-5, rtol=0)
    torch.testing.assert_close(alpha[..., None], case["out.alpha"], atol=2e-5, rtol=0)
    covered = case["out.alpha"] > 0.1
    assert bool(covered.any())
    torch.testing.assert_close(depth[..., None][covered], case["out.depth"][covered], atol=5e-5, rtol=0)


def test_the_cases_are_small() -> None:
    assert sum(path.stat().st_size for path in Path(CASES).rglob("*") if path.is_file()) < MOST_BYTES
