"""A finding: a sign that captures do not follow the model, in one line that says what to look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: Probability that one check gives a finding for captures that follow the model.
ALARM = 1e-4


@dataclass(frozen=True)
class Finding:
    """Result of a check that failed.

    Attributes
    ----------
    check : name of the check.
    text : the deviation, the parameters that it affects, and what to look at.
    p_value : probability of such a deviation if all follows the model; None where no probability applies.
    """

    check: str
    text: str
    p_value: float | None

    def described(self) -> dict[str, Any]:
        return {"check": self.check, "p_value": self.p_value, "text": self.text}
