"""A finding: a sign that captures are not as the model supposes, in one line that says what to look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: Chance with which one check gives a finding of captures that are as the model supposes.
ALARM = 1e-4


@dataclass(frozen=True)
class Finding:
    """What a check saw.

    Attributes
    ----------
    check : its name. text : what was seen, what it spoils, and what to look at.
    p_value : chance of it where all is as the model supposes; None where it is no matter of chance.
    """

    check: str
    text: str
    p_value: float | None

    def described(self) -> dict[str, Any]:
        return {"check": self.check, "p_value": self.p_value, "text": self.text}
