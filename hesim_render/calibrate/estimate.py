"""One form for every number of a calibration: value, standard error and interval, or the reason why not.

A finding is a sign that captures do not follow the model, in one line that says what to look at.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import t as student

#: Half width of a 95 % interval of a normal law, in standard errors.
Z_95 = 1.959963984540054
#: Probability that one check gives a finding for captures that follow the model.
ALARM = 1e-4


def estimated(value: float, standard_error: float, unit: str = "", groups: int | None = None) -> dict[str, Any]:
    """A parameter of ``calibration.yaml`` with its 95 % interval; not identifiable where either number is not finite.

    Parameters
    ----------
    value : the estimate, in `unit`.
    standard_error : its standard error, in `unit`.
    unit : name of the unit, empty for a pure number.
    groups : number of groups of the jackknife that gave the standard error; its own scatter widens the interval, by
        Student's law with groups − 1 degrees of freedom (Tukey 1958). Without it the error counts as known.
    """
    if not (np.isfinite(value) and np.isfinite(standard_error)):
        return not_identifiable("the estimate is not finite")
    value, standard_error = float(value), float(standard_error)
    half = standard_error * (Z_95 if groups is None else float(student.ppf(0.975, groups - 1)))
    return {
        "value": value,
        "standard_error": standard_error,
        "interval_95": [value - half, value + half],
        "unit": unit,
    }


def not_identifiable(reason: str) -> dict[str, Any]:
    """Entry of a parameter that the data do not determine, with the reason."""
    return {"value": None, "reason": reason}


@dataclass(frozen=True)
class Spread:
    """Relative standard deviation over pixels, such as the mismatch of thresholds.

    Attributes
    ----------
    value : relative standard deviation, 0 where it is not significant.
    error : standard error, NaN where the value is not significant.
    limit : upper limit of 95 % where the value is not significant.
    groups : of the jackknife that gave the error, or None.
    """

    value: float
    error: float
    limit: float
    groups: int | None = None

    @property
    def relative_error(self) -> float:
        """Standard error over the value; 0 where the value is 0."""
        return self.error / self.value if self.value > 0 else 0.0

    def described(self) -> dict[str, Any]:
        """As `estimated`, or 0 with its limit."""
        if self.value > 0:
            return estimated(self.value, self.error, "relative std", self.groups)
        note = "the pixels scatter no more than counting makes them"
        return {"value": 0.0, "upper_limit": self.limit, "note": note}


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
