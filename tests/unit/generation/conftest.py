"""A service and a round that the tests of this room share, as fixtures."""

from __future__ import annotations

from tests.support.loopback import service
from tests.worlds.rounds import context, so_far

__all__ = ["context", "service", "so_far"]
