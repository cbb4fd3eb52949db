"""What filling in costs, measured: a random sample of what was not rendered is rendered after all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from scipy import stats

#: Confidence of the stated bound.
CONFIDENCE = 0.99
#: Largest fraction of filled-in pairs beyond the tolerance that a run should have.
MOST_EXCEEDED = 0.01


@dataclass
class Audit:
    """Counts of audited pairs of a pixel and a time window.

    Parameters
    ----------
    tolerance : deviation that counts as exceeding, in units of the sensor's noise.
    skipped : pairs that were filled in without being rendered.
    checked : of those, pairs rendered for the audit alone.
    exceeded : of these, pairs that deviated by more than the tolerance.
    refined : chunks of time that were refined further because a control sample deviated.
    """

    tolerance: float
    skipped: int = 0
    checked: int = 0
    exceeded: int = 0
    refined: int = 0

    def add(self, skipped: int, checked: int, exceeded: int) -> None:
        self.skipped, self.checked, self.exceeded = (
            self.skipped + skipped,
            self.checked + checked,
            self.exceeded + exceeded,
        )

    @property
    def bound(self) -> float:
        """Upper limit of the exceeding fraction of filled-in pairs with 99 % confidence (Clopper and Pearson 1934).

        The sample is stratified over time, which makes the limit hold with a little more than that.
        """
        if self.skipped == 0:
            return 0.0
        if self.exceeded >= self.checked:
            return 1.0
        return float(stats.beta.ppf(CONFIDENCE, self.exceeded + 1, self.checked - self.exceeded))

    @property
    def content(self) -> bool:
        """Whether the run can state what it should: at most `MOST_EXCEEDED` of what was filled in is off."""
        return self.bound <= MOST_EXCEEDED

    def as_dict(self) -> dict[str, Any]:
        """For the manifest."""
        return {
            "tolerance_noise": self.tolerance,
            "filled_in": self.skipped,
            "checked": self.checked,
            "exceeded": self.exceeded,
            "exceeding_fraction_at_most": self.bound,
            "wanted_at_most": MOST_EXCEEDED,
            "confidence": CONFIDENCE,
            "chunks_refined_further": self.refined,
        }


def least_checked(fraction: float) -> int:
    """Checks, none of them exceeding, that bound the fraction: ln(1 - confidence)/ln(1 - fraction)."""
    return math.ceil(math.log(1 - CONFIDENCE) / math.log1p(-fraction))
