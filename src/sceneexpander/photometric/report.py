"""What a fit to pictures did."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FitReport:
    """Error before and after, in the measure of the fit (`warm_up`, `fit_gaussian_head`, `refine`); what it changed is kept if it fell.

    ``after`` is infinite if the steps led to something that cannot be rendered.
    """

    steps: int
    before: float
    after: float

    @property
    def accepted(self) -> bool:
        """Whether what was fitted was kept."""
        return self.after < self.before
