"""Common parts of the sections of the calibration report: lines of tables, findings."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.summary import beside
from hesim_render.core.drawing import points
from hesim_render.core.html import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Headings of the tables of parameters.
HEAD = ("parameter", "value", "95 % interval", "unit, or why not")


#: Mean number of events for which no event is counted with a probability of 5 %: −ln 0.05.
UPPER_OF_NONE = 3.0


def counted(
    axes: "Axes", x: NDArray, events: NDArray, trials: NDArray, colour: str, label: str = "", size: float = 3.4
) -> None:
    """Rates as points. Where nothing was counted, a triangle points down from the 95 % limit: a logarithmic axis has no
    0.
    """
    some = events > 0
    points(axes, x[some], events[some] / trials[some], colour, label, size)
    axes.plot(
        x[~some], UPPER_OF_NONE / trials[~some], color=colour, linestyle="none", marker=11, alpha=0.7,
        label=f"_{label} none counted",
    )  # fmt: skip


def lowest(events: NDArray, trials: NDArray) -> float:
    """Lowest value that `counted` draws."""
    return float((np.where(events > 0, events, UPPER_OF_NONE) / trials).min())


def scale_from_dark(axes: "Axes", darkest_lit: float) -> None:
    """A logarithmic axis of light, with the dark on it."""
    axes.set_xscale("symlog", linthresh=10 ** np.floor(np.log10(darkest_lit)), linscale=0.5)


#: Figures that a report begins with.
_FIRST = {
    "K": "system gain K", "quantum_efficiency": "quantum efficiency", "read_noise_e": "read noise", "dsnu_e": "DSNU",
    "prnu_percent": "PRNU", "theta_on": "threshold θ₊", "theta_off": "threshold θ₋",
    "threshold_mismatch_rel": "mismatch of the thresholds", "leak_per_trial": "leak per trial", "leak_rate_hz": "leak",
}  # fmt: skip


def headline(section: Mapping[str, Any]) -> list[str]:
    """What a report says first: the main figures with their intervals, saturation, and what is not known and why."""
    known, unknown = [], []
    for key, name in _FIRST.items():
        item = section.get(key)
        if not isinstance(item, Mapping):
            continue
        if item["value"] is None:
            unknown.append(f"Not known is the {name}: {item['reason']}.")
        elif "upper_limit" in item:
            known.append(f"{name} below {item['upper_limit']:.3g} {item.get('unit', '')}".rstrip())
        else:
            text = f"{name} {item['value']:.4g} {item.get('unit', '')}".rstrip()
            low, high = item.get("interval_95", (None, None))
            known.append(text if low is None else f"{text} ({low:.4g} to {high:.4g})")
    sentences = [f"With 95 % intervals: {', '.join(known)}."] if known else []
    well = section.get("full_well_e")
    if well is not None and well["value"] is not None:
        low, high = well["interval_95"]
        sentences.append(
            f"Saturation is reached at {well['value']:.4g} e- ({low:.4g} to {high:.4g}); the limit is the "
            f"{well['limited_by']}."
        )
    elif well is not None:
        sentences.append(f"Not known is the saturation capacity: {well['reason']}.")
    return sentences + unknown


def findings(section: Mapping[str, Any]) -> list[tuple[str, str, str]] | None:
    """The findings of a section: check, chance and text of each; None for a calibration without checks."""
    if "findings" not in section:
        return None
    return [(result["check"], _chance(result["p_value"]), result["text"]) for result in section["findings"]]


def _chance(p_value: float | None) -> str:
    text = p_text(p_value)
    return f" (p {text if text[:1] == '<' else '= ' + text})" if text else ""


def plain_text(value: Any) -> str:
    """A value of ``capture.yaml``, groups and lists as words and commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain_text(item)}" for key, item in value.items() if item is not None)
    if isinstance(value, list | tuple):
        return ", ".join(plain_text(item) for item in value)
    return str(value)


def p_text(p_value: float | None) -> str:
    """A p-value for a table."""
    if p_value is None:
        return ""
    return f"{p_value:.2g}" if p_value >= 1e-300 else "< 1e-300"


def with_interval(value: float | None, standard_error: float | None) -> str:
    """A value with half of its 95 % interval."""
    return "not identifiable" if value is None else f"{value:.4g} ± {1.96 * (standard_error or 0.0):.2g}"


def goodness_row(goodness: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """How well the law fits, as `parameter_row`."""
    why = f"{goodness['dof']} degrees of freedom, p = {p_text(goodness['p_value'])}"
    return "χ²/dof", f"{goodness['chi2_per_dof']:.3f}", "", why


def law_row(law: str, other: str, advantage: float, is_decisive: bool) -> tuple[str, str, str, str]:
    """Which shot law holds, and by how much more likely than the `other` the counts are with it, as `parameter_row`."""
    return "shot law", law, "", f"ln L above {other}: {advantage:.1f}{'' if is_decisive else ', not decisive'}"


def parameter_row(name: str, item: Any) -> tuple[str, str, str, str]:
    """Name, value, interval and unit (or why there is no value) of one parameter, as texts for a table.

    Parameters
    ----------
    item : a number, or what `estimated` and `not_identifiable` give, with the ``truth`` of a virtual session.
    """
    if not isinstance(item, dict):
        return name, number(item), "", ""
    truth = beside(item, item.get("truth"))
    if item["value"] is None:
        return name, "not identifiable", truth, item["reason"]
    interval = item.get("interval_95")
    between = f"{interval[0]:.5g} to {interval[1]:.5g}" if interval else ""
    why = "; ".join(filter(None, (item.get("unit"), item.get("note"))))
    return name, f"{item['value']:.5g}", "; ".join(filter(None, (between, truth))), why
