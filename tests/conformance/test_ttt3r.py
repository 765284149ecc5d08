"""TTT3R and CUT3R agree with the recorded outputs of their reference implementation."""

from __future__ import annotations

import pytest

from sceneexpander.conformance.keys import check_keys
from sceneexpander.conformance.registry import find_cases
from tests.support.shared import shared_folder

pytestmark = pytest.mark.conformance

# Outputs that each case must at least compare: fewer would mean that a part was silently left out.
CASES = {"case_a": 134, "case_b": 122, "preprocess_post": 18}


@pytest.mark.parametrize(("name", "least"), CASES.items())
def test_case_agrees_within_its_tolerance(name: str, least: int) -> None:
    [(path, runner)] = find_cases(shared_folder(f"conformance/ttt3r/{name}"))
    checks = runner.run(path)
    assert len(checks) >= least
    assert not [f"{check.name}: {check.ratio:.3g}" for check in checks if not check.ok]
    # The float32 noise of the reference itself reaches 0.2 of the tolerance (0.25 with float16 rounding), and the smallest
    # mistake on record 2. The limit is exceeded only by something between the two that deserves a look.
    assert max(check.ratio for check in checks) < 0.6
    # Without the rounding to float16 every element-wise check would still pass: only the mean error of the tokens notices.
    assert any(check.name == "ttt3r.inter.enc_tokens.mean_error" for check in checks) == name.startswith("case")


def test_the_folder_of_cases_is_a_set_of_cases() -> None:
    found = find_cases(shared_folder("conformance/ttt3r"))
    assert {path.name for path, _ in found} == set(CASES)


def test_released_configuration_has_exactly_the_recorded_tensors() -> None:
    [check] = check_keys(shared_folder("specs") / "ttt3r_cut3r_512_dpt.keys.json")
    assert check.ok, check.detail
    assert "all 1248" in check.detail
