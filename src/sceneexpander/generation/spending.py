"""What was spent on a scene's pictures, over all rounds and runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneexpander.errors import UserError
from sceneexpander.generation.protocol import GenerationContext
from sceneexpander.services.transport import Budget, ServiceError

_ROUNDING_USD = 1e-9


@dataclass(slots=True, kw_only=True)
class SceneBudget(Budget):
    """The budget of a run, and of the scene.

    Attributes:
        ledger: a line for every request that was ever sent for the scene, in whatever round.
        max_scene_requests: most requests for the scene; None: no limit.
        max_scene_cost_usd: most that these may cost; None: no limit.
    """

    ledger: Path
    max_scene_requests: int | None
    max_scene_cost_usd: float | None

    def spend(self) -> None:
        """Count one request. Raises `ServiceError` if it is one too many."""
        price, prices = self.price_usd or 0.0, read_spent(self.ledger)
        fix = "raise it and start again: what came is kept"
        if self.max_scene_requests is not None and len(prices) + 1 > self.max_scene_requests:
            problem = f"{len(prices)} requests were sent for the scene so far: one more is beyond generator.max_scene_requests"
            raise ServiceError("failed_final", problem, fix=fix)
        if self.max_scene_cost_usd is not None and sum(prices) + price > self.max_scene_cost_usd + _ROUNDING_USD:
            problem = f"pictures for {sum(prices):.2f} USD were asked for so far: one more is beyond generator.max_scene_cost_usd"
            raise ServiceError("failed_final", problem, fix=fix)
        Budget.spend(self)
        # Before the request: one that is killed on its way is paid for, too.
        self.ledger.parent.mkdir(parents=True, exist_ok=True)
        with self.ledger.open("a", encoding="utf-8") as file:
            file.write(f"{price!r}\n")


def spent_ledger(context: GenerationContext) -> Path:
    """The file that remembers the requests sent for a scene."""
    return context.cache / "spent" / f"{context.scene}.txt"


def read_spent(ledger: Path) -> list[float]:
    """Prices (USD, 0 where none was configured) of all requests in a ledger. Raises `UserError` for a damaged one."""
    if not ledger.is_file():
        return []
    try:
        return [float(line) for line in ledger.read_text(encoding="utf-8").split()]
    except ValueError:
        fix = "remove it to start counting anew"
        raise UserError("is damaged, so what was spent is not known", where=ledger, fix=fix) from None
