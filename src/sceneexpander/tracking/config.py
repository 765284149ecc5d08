"""Where runs are recorded."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingConfig:
    """``uri`` is ``local`` (a database in the project folder), ``off``, or the address of a running MLflow."""

    uri: str = "local"
    experiment: str = "sceneexpander"

    def __post_init__(self) -> None:
        if self.uri not in ("local", "off") and not self.uri.startswith(("http://", "https://")):
            raise UserError(f"is {self.uri!r}", where="tracking.uri", fix="use local, off, or http://host:port")
        if not self.experiment.strip():
            raise UserError("is empty", where="tracking.experiment")
