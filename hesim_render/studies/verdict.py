"""Verdicts of a comparison: at each level of light one sentence that ranks the filter sets, and says what got worse."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hesim_render.studies.table import Cell, Table

#: What is ranked, and what may be worse for it, without the ends of their columns; both know the noise.
_RANKED, _COST = "ysnr_noise_aware", "delta_e_mean_noise_aware"
#: Names of a candidate, but for those that are the same in every row.
_OWN = ("filter_set", "sensor", "crosstalk")
#: Candidates that a sentence names; the tables have the others.
_MOST_NAMED = 6
#: A cost within this part of the least one is no cost.
_ALIKE = 0.05
#: Figures of a design without an interval that differ by no more than this part count as equal.
_EQUAL = 0.01
#: Figures of a design, and whether more of it is better.
DESIGN_FIGURES = {
    "delta_e_mean": ("mean ΔE2000 without noise", False), "mtf50_cy_per_px": ("MTF50, cy/px", True),
    "false_colour": ("false colour, C*ab", False), "zone_plate_colour": ("zone plate, C*ab", False),
    "picture_error_simulated": ("rms error with noise", False),
}  # fmt: skip
#: Beginnings of the names of ratios, by lux.
DESIGN_RATIOS = {"ysnr_noise_aware_ratio_": "noise-aware YSNR", "ysnr_ratio_": "YSNR with the matrix of colour"}


def grouped(rows: Table, keys: Sequence[str]) -> list[tuple[tuple[Cell, ...], Table]]:
    """The rows by the values of some columns, in the order in which these first occur."""
    result: dict[tuple[Cell, ...], list[dict[str, Cell]]] = {}
    for row in rows:
        result.setdefault(tuple(row[name] for name in keys), []).append(row)
    return [(values, Table(group)) for values, group in result.items()]


def levels_of(rows: Table) -> list[str]:
    """Columns that tell the levels of a group apart."""
    of_sensor: dict[Cell, set[Cell]] = {}
    for row in rows:
        of_sensor.setdefault(row["sensor"], set()).add(row.get("nominal_exposure_us"))
    # where each sensor has its own exposure, it is no level
    return ["illuminance_lux", "equal", *(["nominal_exposure_us"] if max(map(len, of_sensor.values())) > 1 else [])]


def level_name(keys: Sequence[str], values: Sequence[Cell]) -> str:
    """A level in words."""
    named = dict(zip(keys, values, strict=True))
    text = f"{named['illuminance_lux']:g} lx, equal {named['equal']}"
    return text + (f", {named['nominal_exposure_us']:g} µs" if named.get("nominal_exposure_us") else "")


@dataclass(frozen=True)
class _Ranked:
    """A candidate at one level: its figure with an interval, which closed forms do not have."""

    name: str
    value: float
    low: float
    high: float
    cost: float | None
    clips: bool

    @property
    def has_interval(self) -> bool:
        return self.low < self.high

    def __str__(self) -> str:
        interval = f" ({self.low:.3g} to {self.high:.3g})" if self.has_interval else ""
        return f"{self.name}: {self.value:.3g}{interval}{' CLIPPED' if self.clips else ''}"


def ranking(table: Table) -> list[str]:
    """One sentence for each light level, with the order of the noise-aware YSNR and what is worse for it.

    ``>`` stands between two whose 95 % intervals do not meet, ``~`` where they do, a comma where one has no interval:
    then the sentence says that nothing tells which difference counts. Where white clips, the candidate is flagged;
    where the grey card does, it has no figure and is named at the end.

    Parameters
    ----------
    table : of a study.

    Returns
    -------
    The sentences; none without noise figures, or where there is one candidate alone.
    """
    if _RANKED not in table.columns:
        return []
    own = [name for name in _OWN if name in table.columns and len({row[name] for row in table}) > 1]
    levels = levels_of(table)
    result = []
    for outer, group in grouped(table, ("surfaces", "illuminant")):
        for values, some in grouped(group, levels):
            sentence = _sentence(some, own)
            if sentence:
                result.append(f"{', '.join(map(str, outer))}, {level_name(levels, values)}: {sentence}")
    return result


def _sentence(rows: Table, own: Sequence[str]) -> str | None:
    """The verdict of one level."""
    if len(rows) < 2:
        return None
    ranked = sorted((_ranked(row, own) for row in rows if row[_RANKED] is not None), key=lambda one: -one.value)
    saturated = [_name(row, own) for row in rows if row[_RANKED] is None and row.get("white_clipped")]
    named = ranked[:_MOST_NAMED]
    order = str(named[0]) if named else "none"
    for before, after in itertools.pairwise(named):
        alike = " ~ " if before.low <= after.high else " > "
        order += f"{alike if before.has_interval and after.has_interval else ', '}{after}"
    if len(ranked) > _MOST_NAMED:
        order += f", and {len(ranked) - _MOST_NAMED} more"
    if len(named) > 1 and not all(one.has_interval for one in named):
        order += " (no intervals to judge the differences by)"
    text = f"noise-aware YSNR {order}"
    known = [(one.cost, one) for one in ranked if one.cost is not None]
    if known:
        least, best = min(known, key=lambda pair: pair[0])
        first = ranked[0]
        if first.cost is not None and first.cost > (1 + _ALIKE) * least:
            text += (
                f"; but the noise-aware ΔE2000 of {first.name} is larger: {first.cost:.3g}, that of {best.name} "
                f"{least:.3g}"
            )
        elif first.cost is not None:
            text += f"; {first.name} has {'the least' if first is best else 'as good a'} noise-aware ΔE2000 as well"
    if saturated:
        text += f"; not ranked, as even the grey card saturates: {', '.join(saturated)}"
    return text


def _name(row: Mapping[str, Cell], own: Sequence[str]) -> str:
    parts = ((name, row[name]) for name in own)
    return " ".join(f"{name} {value:g}" if isinstance(value, float) else str(value) for name, value in parts) or "it"


def _ranked(row: Mapping[str, Cell], own: Sequence[str]) -> _Ranked:
    """A row with the interval of its simulation, where there is one."""

    def number(column: str) -> float | None:
        value = row.get(column)
        return float(value) if isinstance(value, int | float) and value == value else None

    simulated, low, high = (number(f"{_RANKED}_{end}") for end in ("simulated", "low", "high"))
    value = number(_RANKED) if simulated is None else simulated
    assert value is not None
    return _Ranked(
        _name(row, own), value, value if low is None else low, value if high is None else high, number(_COST),
        bool(row.get("white_clipped")),
    )  # fmt: skip


def design_verdict(verdict: Mapping[str, Any]) -> list[str]:
    """Sentences on a designed set against another one: its cost with the interval, what got better, what got worse.

    Parameters
    ----------
    verdict : of a design, see `studies.design_run.Design`.
    """
    low, high = verdict["cost_difference_low"], verdict["cost_difference_high"]
    costs = f"{verdict['cost']:.4g} and {verdict['cost_against']:.4g}, difference {low:.3g} to {high:.3g}"
    word = "has a lower cost than" if high < 0 else "has a higher cost than" if low > 0 else "is as good as"
    better: list[str] = []
    worse: list[str] = []
    for start, title in DESIGN_RATIOS.items():
        for key, value in verdict.items():
            if key.startswith(start) and abs(value - 1) > _EQUAL:
                text = f"{title} at {key.removeprefix(start).removesuffix('_lux')} lx {value:.3g} times"
                (better if value > 1 else worse).append(text)
    for key, (title, more_is_better) in DESIGN_FIGURES.items():
        if key in verdict:
            own, other = verdict[key], verdict[f"{key}_against"]
            if abs(own - other) > _EQUAL * abs(other):
                (better if (own > other) == more_is_better else worse).append(f"{title} {own:.3g} against {other:.3g}")
    sentences = [f"The designed set {word} {verdict['against']} ({costs})."]
    sentences += [f"{name}: {', '.join(texts)}." for name, texts in (("Better", better), ("Worse", worse)) if texts]
    if verdict["clipped_lux"]:
        lights = ", ".join(f"{lux:g}" for lux in verdict["clipped_lux"])
        sentences.append(f"White saturates at {lights} lx: take a shorter exposure.")
    return sentences
