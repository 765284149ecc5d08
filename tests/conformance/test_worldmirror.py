"""WorldMirror agrees with the recorded outputs of its reference implementation."""

from __future__ import annotations

import pytest

from sceneexpander.conformance.keys import check_keys
from sceneexpander.conformance.registry import find_cases
from tests.support.cases import assert_agrees
from tests.support.shared import shared_folder

pytestmark = pytest.mark.conformance

# Outputs that each case must at least compare: fewer would mean that a part was silently left out.
CASES = {"tiny_a": 68, "tiny_b": 79, "tiny_c": 63, "tiny_nvs": 72, "preprocess": 11, "losses": 27}


@pytest.mark.parametrize(("name", "least"), CASES.items())
def test_case_agrees_within_its_tolerance(name: str, least: int) -> None:
    # The largest error any earlier independent implementation measured is 0.14 of the tolerance; a convention that is
    # wrong gives 25 or more. The limit is exceeded only by something between the two that deserves a look. The losses are held
    # to a relative 1e-5 and preprocessing to one grey level, where the same margin holds.
    assert_agrees(f"worldmirror/{name}", least=least, worst=0.5)


def test_the_folder_of_cases_is_a_set_of_cases() -> None:
    found = find_cases(shared_folder("conformance/worldmirror"))
    assert {path.name for path, _ in found} == set(CASES)


def test_released_configuration_has_exactly_the_recorded_tensors() -> None:
    [check] = check_keys(shared_folder("specs") / "worldmirror_large.keys.json")
    assert check.ok, check.detail
    assert "all 1544" in check.detail
