"""Where runs are recorded."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.errors import UserError

SERVER_ADDRESSES = ("http://", "https://")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingConfig:
    """``uri`` is ``local`` (a database in the project folder, or the server that the shell names), ``off``, or a server's address."""

    uri: str = "local"
    experiment: str = "sceneexpander"

    def __post_init__(self) -> None:
        if self.uri not in ("local", "off") and not self.uri.startswith(SERVER_ADDRESSES):
            raise UserError(f"is {self.uri!r}", where="tracking.uri", fix="use local, off, or http://host:port")
        if not self.experiment.strip():
            raise UserError("is empty", where="tracking.experiment")
