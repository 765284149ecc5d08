"""Worlds that the tests of this room share, as fixtures."""

from __future__ import annotations

from tests.worlds.reports import gathered, source

__all__ = ["gathered", "source"]
