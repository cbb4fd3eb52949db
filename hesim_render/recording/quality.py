"""How good a recording is, in words: its stated error, and what its audit found."""

from collections.abc import Mapping
from typing import Any

#: Runs of many that are named as worse than asked for.
_MOST_NAMED = 5
#: Bounds above this share say nothing: too little was seen.
_SAYS_NOTHING = 0.25
#: Wanted shares of missed and extra events, for audits that do not say them.
_WANTED = {"missed": 0.02, "extra": 0.01}
_SEE_MORE = "a longer --duration or a larger --roi shows more"


def render_lines(render: dict[str, Any] | None) -> list[str]:
    """Lines about the error that a render has reached, from the manifest's ``settings.render``."""
    if render is None:
        return []
    wanted = f", asked for {render['quality']:g}" if "quality" in render else ""
    lines = []
    for name, error in render["error_noise"].items():
        if error is not None:
            lines.append(
                f"render, {name}: stated error {_short(error['rms'])} of the sensor's noise (rms{wanted}); "
                f"95 % of values below {_short(error['p95'])}, 99 % below {_short(error['p99'])}"
            )
    audit = render.get("audit") or {}
    for name in ("events", "frames"):
        part = audit.get(name)
        if part is not None:
            # a still scene is judged by values that serve frames and events alike, also where there are no frames
            of = f", {name}" if render["error_noise"].get(name) is not None else ""
            lines.append(
                f"audit{of}: true deviation {_deviation(part)}; "
                f"{_percent(part['off'])} of values are off by more than {audit['tolerance_noise']:g} times the noise "
                f"(with 99 % confidence at most {_percent(part['off_at_most'])}){_events(part)}"
            )
    return lines + _verdict(audit)


def is_short_of_wish(audit: Mapping[str, Any] | None) -> bool:
    """True if an audit found that a run misses the requested quality."""
    return audit is not None and audit.get("verdict") == "not met"


def verdict_lines(audits: Mapping[str, dict[str, Any] | None], noun: str) -> list[str]:
    """Lines about the audits of many runs, in the words for one: those that miss their quality, those not shown.

    Parameters
    ----------
    audits : what the audit of each run found, by the run's name; None where there was none.
    noun : what a run is called, in the plural.
    """
    short = {name: audit for name, audit in audits.items() if audit is not None and is_short_of_wish(audit)}
    unknown = sum(audit is not None and audit.get("verdict") == "not shown" for audit in audits.values())
    lines = []
    if short:
        names = ", ".join(list(short)[:_MOST_NAMED]) + (", …" if len(short) > _MOST_NAMED else "")
        quality = [audit["quality_needed"] for audit in short.values() if audit.get("quality_needed")]
        samples = [audit["samples_needed"] for audit in short.values() if audit.get("samples_needed")]
        remedies = [f"quality {min(quality):g} would do"] if quality else []
        remedies += [f"{max(samples)} samples would do"] if samples else []
        capped = sum(bool(audit.get("short_of_rays")) for audit in short.values())
        remedies += [f"no quality would do for {capped} of them, which need the exact mode"] if capped else []
        text = f"NOT MET: {len(short)} of {len(audits)} {noun} are worse than asked for ({names})"
        lines.append("; ".join([text, *remedies]))
    if unknown:
        lines.append(
            f"audit: too little was seen in {unknown} of {len(audits)} {noun} to confirm their quality, but nothing "
            "speaks against it"
        )
    return lines


def _deviation(part: dict[str, Any]) -> str:
    """Text about the deviation that was judged: of event pixels that of changes, beside that of their level."""
    rms = _short(part["deviation_noise"]["rms"])
    level = part.get("level_deviation")
    return f"rms {rms}" if level is None else f"of changes rms {rms}, of levels {_percent(level['rms'])}"


def _events(part: dict[str, Any]) -> str:
    """Text about missed and extra events, where any were seen. Bounds that say nothing are not stated as such."""
    true, result = part.get("true_events"), part.get("found_events")
    if not (true or result):
        return ""
    if _saw_too_little(part):
        none = part["missed"] == part["extra"] == 0
        verdict = "none was missed and none was extra" if none else (
            f"{_percent(part['missed'])} are missed, {_percent(part['extra'])} extra"
        )  # fmt: skip
        # units are drawn with repetition: in a small region it looks at the same event many times
        times = max(true or 0, result or 0)
        return f"; of noise-free events, which it saw {times:.0f} times, {verdict} (too few for a bound)"
    return (
        f"; of signal events {_percent(part['missed'])} missed (at most {_percent(part['missed_at_most'])}), "
        f"{_percent(part['extra'])} extra (at most {_percent(part['extra_at_most'])})"
    )


def _saw_too_little(part: dict[str, Any]) -> bool:
    """True if no share of the events speaks against a run, but one has a bound that says nothing."""
    wanted = {name: part.get(f"{name}_wanted_at_most", most) for name, most in _WANTED.items()}
    return all(part[name] <= most for name, most in wanted.items()) and any(
        part[f"{name}_at_most"] > _SAYS_NOTHING for name in wanted
    )


def _verdict(audit: dict[str, Any]) -> list[str]:
    """A line if the run misses its quality, or if the audit could not show that it reaches it."""
    if is_short_of_wish(audit):
        if audit.get("samples_needed"):
            off = max(audit.get(f"{name}_off", 0.0) for name in ("events", "frames"))
            return [
                f"NOT MET: by their stated error {_percent(off)} of the values are off by more than "
                f"{audit['tolerance_noise']:g} times the sensor's noise; --samples {audit['samples_needed']} would do"
            ]
        if audit.get("short_of_rays"):
            return [
                f"NOT MET: by their stated error {_percent(audit['short_of_rays'])} of the values are off by more than "
                f"{audit['tolerance_noise']:g} times the sensor's noise, with the most rays that a value may have; no "
                "--quality would do, but the exact mode (--samples) has no such limit"
            ]
        return [f"NOT MET: this run is worse than asked for; --quality {audit['quality_needed']:g} would do"]
    if audit.get("verdict") == "not shown":
        return [f"audit: nothing speaks against this run, but too little was seen to confirm its quality; {_SEE_MORE}"]
    return []


def _short(value: float) -> str:
    return f"{value:.2g}"


def _percent(share: float) -> str:
    percent = 100 * share
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"
