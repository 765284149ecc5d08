"""OmniVGGT agrees with the recorded outputs of its reference implementation."""

from __future__ import annotations

import pytest

from sceneexpander.conformance.keys import check_keys
from sceneexpander.conformance.registry import find_cases
from tests.support.cases import assert_agrees
from tests.support.shared import shared_folder

pytestmark = pytest.mark.conformance

# Outputs that each case must at least compare.
CASES = {"case_a": 94, "case_b": 67, "preprocess": 14}


@pytest.mark.parametrize(("name", "least"), CASES.items())
def test_case_agrees_within_its_tolerance(name: str, least: int) -> None:
    # Float32 noise is a tenth of the tolerance; the smallest deliberate mistake that the fixtures name is ten times it.
    assert_agrees(f"omnivggt/{name}", least=least, worst=0.5)


def test_the_folder_of_cases_is_a_set_of_cases() -> None:
    found = find_cases(shared_folder("conformance/omnivggt"))
    assert {path.name for path, _ in found} == set(CASES)


def test_released_configuration_has_exactly_the_recorded_tensors() -> None:
    [check] = check_keys(shared_folder("specs") / "omnivggt_large.keys.json")
    assert check.ok, check.detail
    assert "all 1505" in check.detail
