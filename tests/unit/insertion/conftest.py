"""Worlds that the tests of this room share, as fixtures."""

from __future__ import annotations

from tests.worlds.realigned import world

__all__ = ["world"]
