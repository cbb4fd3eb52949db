"""The words on how good a recording is: bounds where they say something, and how to see more where they do not."""

import pytest

from hesim_render.recording import quality
from hesim_render.recording.quality import is_short_of_wish, render_lines, verdict_lines

SHARES = {
    "off": 0.001,
    "off_at_most": 0.013,
    "missed": 0.004,
    "missed_at_most": 0.018,
    "extra": 0.002,
    "extra_at_most": 0.009,
}


def lines(verdict="met", needed=None, true=370.0, found=371.0, **shares):
    part = {"deviation_noise": {"rms": 0.31}, "true_events": true, "found_events": found, **SHARES, **shares}
    audit = {"events": part, "tolerance_noise": 1.5, "verdict": verdict, "quality_needed": needed}
    error = {"events": {"rms": 0.29, "p95": 0.6, "p99": 0.8}, "frames": None}
    return render_lines({"error_noise": error, "quality": 0.5, "audit": audit})


def test_bounds_are_told_where_enough_was_seen():
    assert lines() == [
        "render, events: stated error 0.29 of the sensor's noise (rms, asked for 0.5); 95 % of values below 0.6, 99 % "
        "below 0.8",
        "audit, events: true deviation rms 0.31; 0.1 % of values are off by more than 1.5 times the noise "
        "(with 99 % confidence at most 1.3 %); of signal events 0.4 % missed (at most 1.8 %), 0.2 % extra "
        "(at most 0.9 %)",
    ]
    assert render_lines(None) == []


def test_changes_of_event_pixels_stand_beside_their_levels():
    *_, last = lines(level_deviation={"rms": 0.0134})
    assert last.startswith("audit, events: true deviation of changes rms 0.31, of levels 1.3 %; 0.1 % of values are")


def test_the_audit_of_a_still_scene_speaks_of_frames_only_where_there_are_some():
    part = {"deviation_noise": {"rms": 0.31}, **SHARES}
    audit = {"frames": part, "tolerance_noise": 1.5, "verdict": "met"}
    one = {"rms": 0.29, "p95": 0.6, "p99": 0.8}
    for frames, start in ((None, "audit: true deviation"), (one, "audit, frames: true deviation")):
        *_, last = render_lines({"error_noise": {"events": one, "frames": frames}, "audit": audit})
        assert last.startswith(start)


def test_a_few_of_the_runs_that_miss_their_quality_are_named(monkeypatch):
    """As many as fit into a line, and whether there are more; the remedy is that of the worst one."""
    monkeypatch.setattr(quality, "_MOST_NAMED", 3)
    names = ["n", "b", "z", "c"]
    for count, named in ((2, "n, b"), (3, "n, b, z"), (4, "n, b, z, …")):
        audits = {
            name: {"verdict": "not met", "quality_needed": 0.4 - 0.07 * k, "samples_needed": 300 + 11 * k}
            for k, name in enumerate(names[:count])
        }
        audits |= {"good": {"verdict": "met"}, "unseen": {"verdict": "not shown"}, "none": None}
        first, second = verdict_lines(audits, "clips")
        least, most = 0.4 - 0.07 * (count - 1), 300 + 11 * (count - 1)
        assert first == (
            f"NOT MET: {count} of {count + 3} clips are worse than asked for ({named}); quality {least:g} would do; "
            f"{most} samples would do"
        )
        assert second.startswith(f"audit: too little was seen in 1 of {count + 3} clips")
    assert verdict_lines({"good": {"verdict": "met"}}, "clips") == []


@pytest.mark.parametrize(("shares", "told"), [
    ({"missed": 0.0, "extra": 0.0}, "events, which it saw 7 times, none was missed and none was extra (too few"),
    ({"missed": 0.012, "extra": 0.0}, "events, which it saw 7 times, 1.2 % are missed, 0 % extra (too few"),
    ({"missed": 0.0, "extra": 0.0, "extra_at_most": 0.04}, "none was missed"),  # one of both bounds is enough
])  # fmt: skip
def test_a_bound_that_says_nothing_is_no_threat(shares, told):
    """Bounds of 100 % follow from a few events, in which nothing was wrong."""
    text = lines("not shown", true=6.0, found=7.0, **{"missed_at_most": 1.0, "extra_at_most": 1.0} | shares)
    assert told in text[1] and text[1].endswith("(too few for a bound)")
    assert "at most 100 %" not in text[1]
    assert text[2:] == [
        "audit: nothing speaks against this run, but too little was seen to confirm its quality; a longer --duration "
        "or a larger --roi shows more"
    ]


def test_a_wide_bound_is_still_told():
    assert "of signal events 0 % missed (at most 24 %)" in lines("not shown", missed=0.0, missed_at_most=0.24)[1]


def test_what_speaks_against_a_run_keeps_its_figures():
    text = lines("not met", 0.21, missed=0.3, missed_at_most=1.0, extra_at_most=1.0)
    assert "of signal events 30 % missed (at most 100 %), 0.2 % extra (at most 100 %)" in text[1]
    assert text[2:] == ["NOT MET: this run is worse than asked for; --quality 0.21 would do"]
    # no true event was seen, and all of the run's are too many
    text = lines("not met", 0.21, true=0.0, found=2.0, missed=0.0, missed_at_most=1.0, extra=1.0, extra_at_most=1.0)
    assert "100 % extra (at most 100 %)" in text[1]
    assert "of signal events" not in lines(true=0.0, found=0.0)[1]


def test_verdicts_of_many_runs_are_counted():
    met, short = {"verdict": "met"}, {"verdict": "not met", "quality_needed": 0.3}
    assert verdict_lines({"a": met, "b": None}, "clips") == []
    audits = {f"c{k}": short | {"quality_needed": 0.9 - 0.1 * k} for k in range(6)}
    audits |= {"m": met, "o": {"verdict": "not shown"}}
    assert verdict_lines(audits, "runs") == [
        "NOT MET: 6 of 8 runs are worse than asked for (c0, c1, c2, c3, c4, …); quality 0.4 would do",
        "audit: too little was seen in 1 of 8 runs to confirm their quality, but nothing speaks against it",
    ]
    exact = {"verdict": "not met", "samples_needed": 64}
    assert verdict_lines({"a": exact, "b": exact | {"samples_needed": 90}}, "clips") == [
        "NOT MET: 2 of 2 clips are worse than asked for (a, b); 90 samples would do"
    ]
    assert is_short_of_wish(exact) and not is_short_of_wish(met) and not is_short_of_wish(None)


def test_a_run_whose_values_have_the_most_rays_names_no_quality():
    capped = {"verdict": "not met", "quality_needed": None, "short_of_rays": 0.313}
    part = {"deviation_noise": {"rms": 4.3}, **SHARES}
    audit = {"frames": part, "tolerance_noise": 1.5, **capped}
    error = {"frames": {"rms": 0.29, "p95": 0.6, "p99": 0.8}}
    (line,) = (
        line for line in render_lines({"error_noise": error, "quality": 0.5, "audit": audit}) if "NOT MET" in line
    )
    assert line.endswith(
        "by their stated error 31 % of the values are off by more than 1.5 times the sensor's noise, with the most "
        "rays that a value may have; no --quality would do, but the exact mode (--samples) has no such limit"
    )
    many = {"a": capped, "b": {"verdict": "not met", "quality_needed": 0.3}, "c": capped, "d": {"verdict": "met"}}
    (line,) = verdict_lines(many, "clips")
    assert line.endswith("quality 0.3 would do; no quality would do for 2 of them, which need the exact mode")
