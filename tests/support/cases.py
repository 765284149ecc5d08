"""Running recorded cases and insisting that they agree."""

from __future__ import annotations

from sceneexpander.conformance.registry import find_cases
from tests.support.shared import shared_folder


def assert_agrees(folder: str, *, least: int, worst: float) -> None:
    """Every output of the case below ``conformance/`` is within its tolerance, and none uses more than ``worst`` of it.

    Args:
        folder: the case, relative to the folder of recorded cases.
        least: outputs that must be compared: fewer would mean that a part was silently left out.
        worst: largest error, in units of the tolerance, that does not deserve a look.
    """
    [(path, runner)] = find_cases(shared_folder(f"conformance/{folder}"))
    checks = runner.run(path)
    assert len(checks) >= least
    assert not [f"{check.name}: {check.ratio:.3g}" for check in checks if not check.ok]
    assert max(check.ratio for check in checks) < worst
