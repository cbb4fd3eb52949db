"""Errors and derived figures of test reports, from numbers given by hand."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import special
from scipy.stats import binom, norm

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.report import drawings, emva, figures, latency, limits, modulated, pdf, run, s_curves, simulate, texts
from hesim_render.report.bench import EventBench
from hesim_render.report.definitions import FRAMES
from hesim_render.report.estimates import crossing, log_estimated, mean_error, quantile, whole_us_quantile
from hesim_render.report.latency import Answers
from hesim_render.report.s_curves import SCurve
from hesim_render.report.steady import Background, _rate, doubling

Z = 1.959963984540054


def test_the_error_of_a_mean_has_parts_of_pixels_and_of_jumps():
    """Squares of the sums over pixels and over jumps less those of each value; invalid values are left out."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((6, 9)) + 2 * rng.standard_normal(9) + rng.standard_normal((6, 1))
    valid = rng.random((6, 9)) < 0.8
    mean, count = values[valid].mean(), valid.sum()
    by_pixel = sum((values[valid[:, k], k] - mean).sum() ** 2 for k in range(9))
    by_jump = sum((values[j, valid[j]] - mean).sum() ** 2 for j in range(6))
    each = np.sum((values[valid] - mean) ** 2)
    assert by_pixel > each and by_jump > each
    assert mean_error(values, valid) == pytest.approx(np.sqrt(by_pixel + by_jump - each) / count)
    # values that are all alike but for one: neither part may be below that of single values
    alone = np.zeros((2, 2))
    alone[0] = 1, -1
    assert mean_error(alone, np.ones((2, 2), bool)) == pytest.approx(np.sqrt(2) / 4)
    assert np.isnan(mean_error(alone, np.eye(2, dtype=bool) & False))
    # two values are enough: those of two pixels and one jump, 3 apart, are 1.5/√2 off; one is not
    few = np.array([[2.0, 5.0], [7.0, 7.0]])
    assert mean_error(few, np.array([[True, True], [False, False]])) == pytest.approx(1.5 / np.sqrt(2))
    assert np.isnan(mean_error(few, np.array([[True, False], [False, False]])))


def test_a_quantile_has_the_interval_of_the_share_below_it():
    """20 jumps of 50 pixels, independent: 0.3 ± √(0.21/1000); whole µs are known to half of one on either side."""
    values = np.random.default_rng(2).permutation(1000).reshape(20, 50).astype(float)
    every = np.ones(values.shape, bool)
    value, error, low, high = quantile(values, every, 0.3)
    share = mean_error((values <= value).astype(float), every)
    assert value == pytest.approx(np.quantile(values, 0.3)) and share == pytest.approx(np.sqrt(0.21 / 1000), rel=0.6)
    ends = [np.quantile(values, 0.3 + z * share) for z in (-Z, Z)]
    assert (low, high) == pytest.approx(ends) and error == pytest.approx((ends[1] - ends[0]) / (2 * Z))
    told = whole_us_quantile((40.0, 3.0, 34.0, 47.0), 0.7)
    assert told["value"] == pytest.approx(28) and told["interval_95"] == pytest.approx([0.7 * 33.5, 0.7 * 47.5])
    assert told["standard_error"] == pytest.approx(0.7 * np.sqrt(9 + 1 / 12))
    assert whole_us_quantile((0.2, 0.1, 0.1, 0.3))["interval_95"][0] == 0
    told = log_estimated(np.log(5.0), 0.2, "lx")
    assert told["value"] == pytest.approx(5) and told["standard_error"] == pytest.approx(1.0)
    assert told["interval_95"] == pytest.approx([5 * np.exp(-0.2 * Z), 5 * np.exp(0.2 * Z)])


def test_a_crossing_lies_on_a_line_of_probits_with_its_error():
    x, share, error = (
        np.array([0.0, 1.0, 2.5, 4.0]),
        np.array([0.2, 0.5, 0.97, 1.0]),
        np.array([0.01, 0.02, 0.007, 0.0]),
    )
    place, sure = crossing(x, share, error, 0.9, 400)
    z = norm.ppf([0.5, 0.97, 0.9])
    assert place == pytest.approx(1 + 1.5 * (z[2] - z[0]) / (z[1] - z[0]))

    def at(a, b):
        z = norm.ppf([a, b])
        return 1 + 1.5 * (norm.ppf(0.9) - z[0]) / (z[1] - z[0])

    h = 1e-6
    slopes = [(at(0.5 + h, 0.97) - at(0.5 - h, 0.97)) / (2 * h), (at(0.5, 0.97 + h) - at(0.5, 0.97 - h)) / (2 * h)]
    assert sure == pytest.approx(np.hypot(slopes[0] * 0.02, slopes[1] * 0.007), rel=1e-4)
    # all of 400 answers count as 399.5
    place, _ = crossing(x[2:], np.array([0.6, 1.0]), error[2:], 0.9, 400)
    z = norm.ppf([0.6, 1 - 0.5 / 400, 0.9])
    assert place == pytest.approx(2.5 + 1.5 * (z[2] - z[0]) / (z[1] - z[0]))
    assert crossing(x, share + 0.9, error, 0.9, 400) is None and crossing(x, share * 0.5, error, 0.9, 400) is None


def test_jitter_is_that_of_a_normal_law_without_what_pixels_have_of_their_own():
    """Differences of successive latencies of a pixel: 4 µs, whatever each pixel's mean is; 99 pairs are too few."""
    rng = np.random.default_rng(3)
    times = 500 + 90 * rng.random(400) + 4 * rng.standard_normal((41, 400))
    told = latency._jitter(times, np.ones(times.shape, bool))
    apart = np.abs(np.diff(times[:40], axis=0)[::2])
    assert told["value"] == pytest.approx(np.quantile(apart, 0.6826895) / np.sqrt(2))
    assert told["value"] == pytest.approx(4, rel=0.05) and told["standard_error"] < 0.3
    answered = np.zeros(times.shape, bool)
    answered[:2, :99] = True
    assert "99 pairs" in latency._jitter(times, answered)["reason"]
    answered[2:4, :1] = True
    assert latency._jitter(times, answered)["value"] is not None
    assert "two are needed" in latency._jitter(times[:1], np.ones((1, 400), bool))["reason"]


def entry(value, error):
    return {"value": value, "standard_error": error}


def test_figures_of_emva_1288_that_follow_from_others():
    """SNR_max = √well; threshold σ_d + 0.5 with the ADC's 1/12 DN² in σ_d; dynamic range of both."""
    entries = {
        "full_well_e": entry(12_000.0, 300.0), "temporal_dark_noise_e": entry(1.9, 0.11),
        "quantum_efficiency": entry(0.61, 0.02), "K": entry(0.21, 0.004),
    }  # fmt: skip
    found = emva._of_both(entries, None)
    assert found["snr_max"]["value"] == pytest.approx(20 * np.log10(np.sqrt(12_000)))
    assert found["snr_max"]["standard_error"] == pytest.approx(10 / np.log(10) * 300 / 12_000)
    dark = np.sqrt(1.9**2 + 1 / 12 / 0.21**2)
    error = 1.9 / dark * 0.11
    assert (found["threshold_e"]["value"], found["threshold_e"]["standard_error"]) == pytest.approx((dark + 0.5, error))
    photons = (dark + 0.5) / 0.61
    relative = np.hypot(error / (dark + 0.5), 0.02 / 0.61)
    told = found["threshold_photons"]
    assert (told["value"], told["standard_error"]) == pytest.approx((photons, photons * relative))
    told = found["dynamic_range"]
    assert told["value"] == pytest.approx(20 * np.log10(12_000 / (dark + 0.5)))
    assert told["standard_error"] == pytest.approx(20 / np.log(10) * np.hypot(error / (dark + 0.5), 300 / 12_000))
    none = {"value": None, "reason": "why"}
    found = emva._of_both({**entries, "full_well_e": none, "quantum_efficiency": none}, None)
    assert [found[name]["reason"] for name in ("snr_max", "threshold_photons", "dynamic_range")] == ["why"] * 3


def test_defects_are_a_share_of_the_pixels_with_its_interval(monkeypatch):
    """7 of 1440 pixels: as many or more have a chance of 2.5 % at one end, as many or fewer at the other."""
    section = {name: {"value": None, "reason": "none"} for name in FRAMES if name not in ("defect_pixels", "snr_max")}
    result = SimpleNamespace(defects=np.zeros((48, 30), bool))
    for name, outcome in (
        ("read_pair_set", None), ("evaluate", result), ("content", {**section, "bad_pixels": 7}), ("findings", []),
    ):  # fmt: skip
        monkeypatch.setattr(emva, name, lambda _, outcome=outcome: outcome)
    told = emva.frame_figures("captures").entries["defect_pixels"]
    low, high = told["interval_95"]
    assert told["value"] == 7 / 1440 and "7 of 1440" in told["note"]
    assert (binom.sf(6, 1440, low), binom.cdf(7, 1440, high)) == pytest.approx((0.025, 0.025), rel=1e-6)


def answers_at(lux, share, error):
    return Answers(lux, 0.5, None, 900, share, error, 30, {}, {}, 40)


def test_the_range_is_that_of_both_ends_less_what_chance_finds():
    """Shares (p − q)/(1 − q) with errors of as much more; 20 log₁₀ of the ratio, errors of both ends."""
    lux = [1.0, 4.0, 20.0, 90.0, 300.0]
    shares, chance = [0.5, 0.97, 1.0, 0.98, 0.6], [0.1, 0.05, 0.0, 0.02, 0.2]
    found = limits.dynamic_range([answers_at(x, s, 0.01) for x, s in zip(lux, shares, strict=True)], chance)
    own = [(s - q) / (1 - q) for s, q in zip(shares, chance, strict=True)]
    assert found.share == pytest.approx(own)
    assert found.error == pytest.approx([0.01 / (1 - q) for q in chance])
    low = crossing(np.log(lux[:2]), np.array(own[:2]), found.error[:2], 0.9, 1200)
    high = crossing(-np.log(lux[3:])[::-1], np.array(own[3:])[::-1], found.error[3:][::-1], 0.9, 1200)
    assert found.least_lux["value"] == pytest.approx(np.exp(low[0]))
    assert found.most_lux["value"] == pytest.approx(np.exp(-high[0]))
    decibel = 20 / np.log(10)
    assert found.range_db["value"] == pytest.approx(decibel * (-high[0] - low[0]))
    assert found.range_db["standard_error"] == pytest.approx(decibel * np.hypot(low[1], high[1]))


def test_a_background_that_doubles_follows_a_weighted_line_of_logarithms():
    celsius, rate, error = np.array([10.0, 25, 40, 60]), np.array([0.2, 0.5, 1.7, 5.0]), np.array([0.02, 0.1, 0.1, 0.2])
    every = [
        Background(5.0, c, 9.0, (entry(r, e), entry(2 * r, e)), 40, None)
        for c, r, e in zip(celsius, rate, error, strict=True)
    ]
    every += [Background(9.0, c, 9.0, (entry(1.0, 0.1),) * 2, 40, None) for c in (20.0, 22.0, None)]
    told = doubling(every, 0, False)
    (slope, _), cov = np.polyfit(celsius, np.log(rate), 1, w=rate / error, cov="unscaled")
    assert told["value"] == pytest.approx(np.log(2) / slope) and told["note"] == "at 5 lx"
    assert told["standard_error"] == pytest.approx(np.log(2) / slope * np.sqrt(cov[0, 0]) / slope)
    assert "two at one light" in doubling(every[4:], 0, False)["reason"]
    flat = [Background(5.0, c, 9.0, (entry(1.0, 0.2),) * 2, 40, None) for c in (10.0, 30.0)]
    assert "does not grow over 20 °C" in doubling(flat, 0, False)["reason"]
    assert _rate({"value": 0.0}, 60.0)["upper_limit"] == pytest.approx(3 / 60)
    assert _rate({"value": 1.0, "interval_95": [-0.2, 2.0]}, 60.0)["interval_95"] == [0.0, 2.0]


def test_the_corner_lies_where_the_swing_has_grown_by_the_root_of_two():
    hz, swing = np.log([1.0, 10.0, 30.0, 100.0]), np.log([0.4, 0.38, 0.5, 0.9])
    level = np.log(0.4 * np.sqrt(2))
    part = (level - swing[2]) / (swing[3] - swing[2])
    assert modulated._corner(hz, swing) == pytest.approx(hz[2] + part * (hz[3] - hz[2]))
    assert np.isnan(modulated._corner(hz[:3], swing[:3])) and np.isnan(modulated._corner(hz, swing * np.nan))
    one = SimpleNamespace(depth=0.6)
    assert modulated._swing(one) == pytest.approx(np.log(1.6 / 0.4))


def test_thresholds_by_counts_add_what_the_dead_time_swallows():
    """A/θ − c events a cycle less 2π² f T (1/√(1 − d²) − 1)/θ²: exact counts give θ back."""
    theta, constant, dead_us = 0.23, 1.4, 300.0
    pair = [SimpleNamespace(hz=2.0, depth=d) for d in (0.6, 0.9)]
    swing = [np.log((1 + d) / (1 - d)) for d in (0.6, 0.9)]
    lost = [2 * np.pi**2 * 2.0 * 300e-6 * (1 / np.sqrt(1 - d * d) - 1) for d in (0.6, 0.9)]
    exact = np.array([a / theta - constant - b / theta**2 for a, b in zip(swing, lost, strict=True)])
    parts = exact[:, None] * (1 + 0.01 * np.random.default_rng(5).standard_normal((2, 21)))
    parts[:, 0] = exact
    told = modulated._slope(pair, parts, dead_us)
    assert told["value"] == pytest.approx(theta)

    def solved(k):
        more, a, b = parts[1, k] - parts[0, k], swing[1] - swing[0], lost[1] - lost[0]
        return np.roots([more, -a, b]).max()

    each = np.array([solved(k) for k in range(1, 21)])
    assert told["standard_error"] == pytest.approx(np.sqrt(19 / 20 * np.sum((each - each.mean()) ** 2)))
    assert "swallows" in modulated._slope(pair, parts, 4000.0)["reason"]
    assert "no more events" in modulated._slope(pair, parts[::-1], dead_us)["reason"]


def test_the_widths_of_an_s_curve_and_their_errors_are_those_of_the_logarithms(monkeypatch):
    """θ, ln √(σ² + τ²), ln σ/τ and logit q: τ = width/√(1 + r²), σ = r τ."""
    values = np.array([0.21, np.log(0.05), np.log(0.7), special.logit(0.03)])
    theta, sigma, tau, chance = s_curves._natural(values)
    assert np.hypot(sigma, tau) == pytest.approx(0.05) and sigma / tau == pytest.approx(0.7)
    assert (theta, chance) == pytest.approx((0.21, 0.03))
    root = np.random.default_rng(6).standard_normal((4, 4)) * np.array([1e-3, 0.02, 0.05, 0.1])
    covariance = root.T @ root
    slopes = {}
    for name, k in (("sigma", 1), ("tau", 2)):
        steps = 1e-5 * np.eye(4)
        parts = [np.log(s_curves._natural(values + d)[k]) - np.log(s_curves._natural(values - d)[k]) for d in steps]
        slopes[name] = np.array(parts) / 2e-5
    fit = SimpleNamespace(values=lambda: (values, covariance), total=lambda _: 0.0)
    monkeypatch.setattr(s_curves, "_Fit", lambda *_: fit)
    monkeypatch.setattr(s_curves, "_problem", lambda *_: "")
    some = SimpleNamespace(size=0.2, of=lambda polarity: np.ones((7, 30)), steps=SimpleNamespace(lux=5.0))
    for polarity, sign in ((0, 1), (1, -1)):
        entries = s_curves.s_curve([some], polarity, np.ones(30, bool)).entries
        told = entries["threshold_spread_percent"]
        error = np.sqrt(slopes["tau"] @ covariance @ slopes["tau"])
        assert told["value"] == pytest.approx(100 * tau / 0.21) and told["unit"] == "%"
        assert told["standard_error"] == pytest.approx(told["value"] * error, rel=1e-4)
        told = entries["pixel_noise"]
        error = np.sqrt(slopes["sigma"] @ covariance @ slopes["sigma"])
        assert told["standard_error"] == pytest.approx(sigma * error, rel=1e-4)
        told = entries["contrast_sensitivity"]
        assert told["value"] == pytest.approx(100 * sign * (np.exp(sign * 0.21) - 1))
        assert told["standard_error"] == pytest.approx(100 * np.exp(sign * 0.21) * np.sqrt(covariance[0, 0]))
        assert entries["threshold"]["standard_error"] == pytest.approx(np.sqrt(covariance[0, 0]))


@pytest.mark.parametrize(("sign", "part"), [(1, 1), (-1, 2)])
def test_a_width_that_does_not_show_is_at_most_what_is_a_quarter_as_likely(sign, part):
    """ln σ/τ goes in steps of 0.1 until the likelihood is below 0.26 of its maximum; its law is normal, or even."""
    values = np.array([0.21, np.log(0.05), np.log(0.7), special.logit(0.03)])
    slope, unsure = np.array([0.0, 1.0, 0.4 * sign, 0.0]), np.diag([0.0, 4.0, 1.0, 0.0])
    own = s_curves._natural(values)[part]
    for deviation, farthest in ((0.8, 1.4), (np.inf, 8 - sign * np.log(0.7))):
        fit = SimpleNamespace(total=lambda v, deviation=deviation: -0.5 * ((v[2] - values[2]) / deviation) ** 2)
        found = s_curves._part(fit, values, unsure, slope, own, "1")
        there = 0.7 * np.exp(sign * farthest)
        expected = 0.05 * (there if sign > 0 else 1) / np.hypot(1, there)
        assert found["value"] == 0 and found["upper_limit"] == pytest.approx(expected, rel=1e-3)


def test_ends_of_the_range_are_as_sure_as_the_fewest_answers(monkeypatch):
    """Steps times pixels of the light that has the fewest of them decides how near to 1 a share can be known."""
    counts = []
    monkeypatch.setattr(limits, "crossing", lambda *given: counts.append(given[-1]) or (0.3, 0.01))
    sizes = [(40, 30), (7, 50), (90, 4), (25, 60)]  # 1200, 350, 360, 1500
    answers = [Answers(2.0**k, 0.5, None, c, 0.95, 0.01, p, {}, {}, 40) for k, (c, p) in enumerate(sizes)]
    limits.dynamic_range(answers, [0.0] * 4)
    each = {one.count * one.pixels for one in answers}
    assert counts == [min(each)] * 2 and len(each) == 4


def test_frames_name_the_lights_of_their_figures():
    """Signals of 4 to 99 % of 3000 DN: linearity takes 5 to 95 %, the gain up to 70 %, without unclear levels."""
    signal = np.array([120.0, 160.0, 900.0, 2090.0, 2120.0, 2840.0, 2870.0])
    clear = np.array([True, True, True, True, False, True, True])
    pairs = SimpleNamespace(has_photons=True, spatial_lit=SimpleNamespace(photons=47.0), shape=(7, 11))
    result = SimpleNamespace(pairs=pairs, top_dn=3000.0, light=signal * 1.5, clear=clear, signal=signal)
    found = emva.FrameFigures(result, {}, [])
    lights = found.lights
    assert found.pixels == 77
    assert lights["K"] == "180 to 3140 photons" and lights["linearity_error_percent"] == "240 to 4260 photons"
    assert lights["full_well_e"] == "up to 4300 photons" and lights["prnu_percent"] == "47 photons, and dark"


def test_a_steady_recording_belongs_to_the_nearest_light_within_a_third():
    def lights(*lux):
        spec = SimpleNamespace(steady=[SimpleNamespace(lux=one) for one in lux])
        return SimpleNamespace(spec=spec)

    assert figures._steady(lights(0.0, 71.0, 55.0, 100.0), 60.0).lux == 55.0
    assert figures._steady(lights(60 * 1.29, 0.0), 60.0).lux == 60 * 1.29
    assert figures._steady(lights(60 / 1.29), 60.0).lux == 60 / 1.29
    assert figures._steady(lights(60 * 1.34, 60 / 1.34), 60.0) is None


def test_intervals_are_drawn_as_a_density():
    """The area of each bar is the number of its intervals, each of a whole number of µs."""
    counts = np.random.default_rng(5).poisson(40 / (1 + np.arange(3000) / 60))
    dead = SimpleNamespace(key="dead_time", value={"value": 130.0})
    axes = Figure().subplots()
    drawings._intervals(axes, SimpleNamespace(intervals=counts, entries=[dead]))
    (bars,) = axes.patches
    density, edges = bars.get_data()[:2]
    for value, first, last in zip(density, edges[:-1], edges[1:], strict=True):
        number = counts[int(first) : int(last)].sum()
        assert value * (last - first) == pytest.approx(number) if number else np.isnan(value)
    assert edges[0] == 1 and edges[-1] < 3000 and axes.lines[0].get_xdata()[0] == 130.0


def test_each_page_of_the_pdf_is_a4_and_has_its_number_in_the_lower_margin():
    """Right-aligned with the text, in the middle of the margin; a thin line below each row of a table."""
    made, pages = pdf.Document(io.BytesIO(), "t"), []
    made._pages = SimpleNamespace(savefig=pages.append, close=lambda: None)
    for k in range(90):
        made.text(f"line {k}")
    made.table(SimpleNamespace(title="A table", head=("name",), rows=[("a",), ("b",)], widths=(1.0,)))
    made.close()
    assert len(pages) == 2
    for number, page in enumerate(pages, 1):
        assert page.get_size_inches() * 25.4 == pytest.approx((210, 297), abs=0.1)
        mark = next(text for text in page.texts if text.get_text() == str(number))
        assert mark.get_ha() == "right" and 6 <= mark.get_fontsize() <= 8
        assert np.array(mark.get_position()) * (595, 842) == pytest.approx((595 - 42, 21))
        assert [text for text in page.texts if text.get_text().startswith(("line", "name"))]
    for line in pages[1].artists:
        assert np.array(line.get_xdata()) * 595 == pytest.approx([42, 595 - 42]) and line.get_linewidth() < 0.5
    lows = [842 * line.get_ydata()[0] for line in pages[1].artists]
    tops = {text.get_text(): 842 * text.get_position()[1] for text in pages[1].texts}
    # each line lies between the foot of its row, 6.3 · 1.32 below its top, and the next row
    for low, above, below in zip(lows, ("name", "a", "b"), ("a", "b", None), strict=True):
        assert low <= tops[above] - 6.3 * 1.32 and (below is None or low > tops[below])


def test_pages_of_the_pdf_hold_their_lines(monkeypatch):
    """No line over the margins of 42 pt or over another one; a table that goes on has its head on each page."""
    lines = []
    made = pdf.Document(io.BytesIO(), "t")

    def note(text, x, y, size, bold=False):
        made._page()
        lines.append((made.count, x, y, size, text))

    monkeypatch.setattr(made, "_line", note)
    made.text("A title", 15.0, True)
    made.text("some words of a paragraph " * 40)
    for k in range(330):
        made.text(f"line {k}", (8.0, 10.5, 6.3, 15.0, 8.0, 9.1, 12.4)[k % 7])
    cells = [(f"cell {k}", "a long text of a cell that takes several lines " * (1 + k % 3)) for k in range(44)]
    made.table(SimpleNamespace(title="A table", head=("name", "what"), rows=cells, widths=(1.0, 3.0)))
    places = []
    made.drawings([lambda axes: places.append((made.count, axes.get_position().bounds))] * 5)
    made.close()
    assert made.count >= 7
    for page in range(1, made.count + 1):
        own = [line for line in lines if line[0] == page]
        assert all(y <= 842 - 42 and y - 1.32 * size >= 42 - 1e-6 for _, _, y, size, _ in own)
        columns = {}
        for _, x, y, size, _ in own:
            columns.setdefault(x, []).append((y, size))
        for column in columns.values():
            assert all(
                y - 1.32 * size >= below - 1e-6 for (y, size), (below, _) in zip(column, column[1:], strict=False)
            )
        of_table = [text for _, _, _, _, text in own if text.startswith("cell")]
        assert bool(of_table) == ("name" in [text for *_, text in own])
    assert {x for _, x, *_ in lines} == {42.0, 42 + 511 / 4}
    assert [text for *_, text in lines if text.startswith("cell")] == [name for name, _ in cells]
    # three in a row of 511 pt, inside of it; the other two below
    lefts, bottoms = ([bounds[k] for _, bounds in places] for k in (0, 1))
    assert np.diff(lefts[:3]) * 595 == pytest.approx([511 / 3] * 2) and lefts[3:] == lefts[:2]
    assert all(
        left * 595 > 42 and (left + bounds[2]) * 595 < 553 for left, (_, bounds) in zip(lefts, places, strict=True)
    )
    assert all(bottom * 842 > 42 for bottom in bottoms)
    assert bottoms[:3] == [bottoms[0]] * 3 and bottoms[3:] == [bottoms[3]] * 2
    if places[0][0] == places[3][0]:
        assert (bottoms[0] - bottoms[3]) * 842 == pytest.approx(158)


@pytest.mark.parametrize(("end_us", "count"), [(2_300, 2), (3_299, 2), (3_300, 3), (4_299, 3), (2_299, None)])
def test_jumps_are_those_that_a_whole_half_period_follows(end_us, count):
    """A rise at 300 µs, a fall 1000 µs later, and so on."""
    steps = SimpleNamespace(file="s", trigger=None, begin_us=300, period_us=2_000)
    given = SimpleNamespace(path=lambda name: name), steps, SimpleNamespace(span_us=lambda: (0, end_us))
    if count is None:
        with pytest.raises(SpecError, match="before a rise and a fall"):
            EventBench._jumps(*given)
        return
    times, rises = EventBench._jumps(*given)
    assert times.tolist() == [300, 1_300, 2_300][:count] and rises.tolist() == [True, False, True][:count]


@pytest.mark.parametrize("celsius", [(None, None), (31.0, 31.0), (20.0, 41.5)])
def test_background_is_drawn_by_polarity_and_temperature(celsius):
    """One line of each, with the intervals of its values; the temperature is named where there are several."""

    def rate(value):
        return {"value": value, "interval_95": [0.7 * value, 1.6 * value]}

    given = [
        Background(lux, c, 3.0, (rate(lux + k), rate(2 * lux + k)), 40, None)
        for k, c in enumerate(celsius) for lux in (5.0, 60.0)
    ]  # fmt: skip
    axes = Figure().subplots()
    drawings._background(axes, SimpleNamespace(backgrounds=given))
    names = [f", {c:g} °C" for c in celsius] if len(set(celsius)) > 1 else [""]
    found = {bars.get_label(): bars for bars in axes.containers}
    assert list(found) == [name + about for about in names for name in ("ON", "OFF")]
    for label, bars in found.items():
        k = [about for about in names].index(label.replace("OFF", "").replace("ON", ""))
        own = [one for one in given if len(names) == 1 or one.temperature_c == celsius[k]]
        wanted = [one.rates[label.startswith("OFF")]["value"] for one in own]
        line, _, (segments,) = bars
        np.testing.assert_allclose(line.get_xydata(), np.stack([[one.lux for one in own], wanted], axis=1))
        ends = np.array(segments.get_segments())[:, :, 1]
        np.testing.assert_allclose(ends, np.outer(wanted, [0.7, 1.6]))
    assert len({bars[0].get_color() for bars in axes.containers}) == 2


def test_pixels_that_are_hot_or_dead_in_either_polarity_are_left_out(monkeypatch):
    """Pixels 1, 3 and 6 of nine, one of each kind."""
    hot, dead = np.arange(9) == 3, (np.arange(9) == 1, np.arange(9) == 6)
    seen = []

    class Enough(Exception):
        pass

    def curve(light, polarity, good):
        seen.append((light, polarity, good))
        if polarity:
            raise Enough

    for name, value in (("_hot", hot), ("_dead", dead), ("_lights", ["one"])):
        monkeypatch.setattr(figures, name, lambda bench, value=value: value)
    monkeypatch.setattr(figures, "s_curve", curve)
    with pytest.raises(Enough):
        figures.event_figures(None)
    assert [each[:2] for each in seen] == [("one", 0), ("one", 1)]
    assert all(np.flatnonzero(~good).tolist() == [1, 3, 6] for _, _, good in seen)


def test_what_an_s_curve_lacks_is_said():
    """Each beside its limit: 20 pixels, 4 contrasts, a largest share of 3/4, a least of 1/4, 2 points on the slope."""
    size, share = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.24, 0.5, 0.7, 0.76])
    assert s_curves._problem(size, share, 20) == ""
    assert s_curves._problem(size, share, 19).startswith("19 pixels answer; 20")
    assert s_curves._problem(size[1:], share[1:] - 0.3, 20).startswith("steps of 3 contrasts at this light; 4")
    assert s_curves._problem(size, np.minimum(share, 0.74), 20).startswith("the largest step is answered in 0.74")
    assert s_curves._problem(size, np.maximum(share, 0.26), 20).startswith("the smallest step is answered in 0.26")
    steep = s_curves._problem(size, np.array([0.01, 0.02, 0.96, 0.98]), 20)
    assert steep and "0.2" in steep and "0.3" in steep
    assert s_curves._problem(size, np.array([0.01, 0.04, 0.96, 0.98]), 20) == ""


def test_chance_is_the_share_of_windows_of_still_light_with_an_event():
    """Windows of 100 µs from the begin on, a last part of one left out; pixels that are not good do not count."""
    times, x, y, on = np.array([
        (50, 0, 0, 1), (110, 1, 0, 1), (115, 1, 0, 1), (160, 1, 0, 0), (249, 2, 1, 1), (250, 0, 1, 1), (349, 0, 1, 1),
        (350, 2, 0, 1), (370, 2, 0, 1),
    ]).T  # fmt: skip
    events = np.zeros(times.size, [("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])
    events["t_us"], events["x"], events["y"], events["polarity"] = times, x, y, 2 * on - 1

    class Stream(list):
        def span_us(self):
            return 50, 390

    bench = SimpleNamespace(stream=lambda file: Stream([events[:4], events[4:]]), pixels=6, shape=(2, 3))
    good = np.array([1, 1, 1, 1, 0, 1], bool)
    steady = SimpleNamespace(file="a")
    # three windows of five pixels: (0, 0) and (0, 1) in the first, (1, 2) in the second, (1, 0) in the third
    assert limits.false_share(bench, steady, 100, 0, good) == pytest.approx(4 / 15)
    assert limits.false_share(bench, steady, 100, 1, good) == pytest.approx(1 / 15)
    good[0] = False
    assert limits.false_share(bench, steady, 100, 0, good) == pytest.approx(3 / 12)
    assert np.isnan(limits.false_share(bench, steady, 341, 0, good))


def test_tables_against_light_have_the_figures_of_each_light_and_temperature():
    """Values with three digits and their intervals, shares in per cent with 1.96 errors, upper limits, gaps."""

    def entry(value):
        return {"value": value, "interval_95": [0.9 * value, 1.2 * value], "unit": "µs"}

    def steady(lux, celsius, on):
        return SimpleNamespace(lux=lux, temperature_c=celsius, rates=[entry(on), {"value": 0.0, "upper_limit": 0.0123}])

    def answer(lux, celsius, latency):
        jitter = {"value": None, "reason": "too few"}
        return SimpleNamespace(lux=lux, temperature_c=celsius, contrast=0.4567, latency=entry(latency), jitter=jitter)

    found = SimpleNamespace(lux=np.array([5.0, 80.0]), share=np.array([0.1234, 0.987]), error=np.array([0.02, 0.0031]))
    measured = SimpleNamespace(
        latencies=([answer(80.0, 25.0, 1234.5), answer(5.0, 25.0, 23456.0)], [answer(5.0, 40.0, 7.0)]),
        backgrounds=[steady(5.0, 40.0, 3.21987), steady(5.0, 25.0, 0.5)], ranges=[found, None],
        entries=[
            SimpleNamespace(
                key=key, name="", value=value, lux=lux, contrast=contrast, temperature_c=celsius, pixels=count
            )
            for key, value, lux, contrast, celsius, count in (
                ("dead_time", entry(0.71236), None, None, 31.5, 7), ("hot", entry(3.0), None, None, None, 5),
                ("latency", {"value": None, "reason": "no jumps"}, None, 0.3456, None, 11),
                ("latency", entry(5.0), 3.0, None, None, 1), ("jitter", entry(5.0), None, None, None, 1),
            )
        ],
    )  # fmt: skip
    figures_, light, definitions = texts.event_tables(measured)
    assert [row[1:] for row in figures_.rows] == [
        ("0.7124", "0.6411 to 0.8548", "µs", "31.5 °C", "7"),
        ("3", "2.7 to 3.6", "µs", "steady, all", "5"),
        ("–", "", "no jumps", "steps of 34.6 %", "11"),
    ]
    assert light.title == "Against light (latency of steps of 45.7 %)" and len(light.head) == len(light.widths) == 9
    assert light.rows == [
        ("5, 25 °C", "0.5 (0.45 to 0.6)", "< 0.0123", "23500 (21100 to 28100)", "–", "", "", "12.3 ± 3.9", ""),
        ("80, 25 °C", "", "", "1230 (1110 to 1480)", "–", "", "", "98.7 ± 0.61", ""),
        ("5, 40 °C", "3.22 (2.9 to 3.86)", "< 0.0123", "", "", "7 (6.3 to 8.4)", "–", "12.3 ± 3.9", ""),
    ]
    for table in (figures_, light, definitions):
        assert sum(table.widths) == pytest.approx(1) and {len(row) for row in table.rows} == {len(table.head)}


def test_simulated_captures_are_seven_tenths_of_the_progress_of_a_report(monkeypatch, tmp_path):
    told = []

    def simulated(sensor, events, frames, size, seed, progress):
        progress("event pixels", 0.5)
        raise SpecError("enough")

    monkeypatch.setattr(simulate, "simulate_captures", simulated)
    with pytest.raises(SpecError, match="enough"):
        run.make_report(["gen2"], tmp_path / "r", progress=lambda what, part: told.append((what, part)))
    assert told[-1] == ("event pixels", pytest.approx(0.35))


def test_a_share_that_is_the_level_has_reached_it():
    place, _ = crossing(np.array([1.0, 2.5]), np.array([0.3, 0.9]), np.array([0.02, 0.02]), 0.9, 400)
    assert place == pytest.approx(2.5)


def test_an_s_curve_goes_from_chance_to_one():
    curve = SCurve(9.0, None, None, None, 0.1, {}, 0.3, 0.05, 40)
    np.testing.assert_allclose(curve.at(np.array([-9.0, 0.3, 0.35, 9.0])), [0.1, 0.55, 0.1 + 0.9 * norm.cdf(1), 1])


@pytest.mark.parametrize(("events", "frames"), [(True, True), (True, False), (False, True), (False, False)])
def test_captures_are_simulated_of_the_kinds_of_pixels_that_a_sensor_has(events, frames, monkeypatch, tmp_path):
    """Nine tenths of the progress are those of events, where there are both."""
    shown = []

    def instrument(kind):
        def made(sensor, folder, seed, progress):
            progress(kind, 0.5)
            assert folder == tmp_path / kind and seed == 7 and (folder.is_dir() or kind == "frames")
            return SimpleNamespace(record=lambda: (kind, sensor))

        return made

    spec = SimpleNamespace(
        evs=events or None, aps=frames or None, evs_grid=SimpleNamespace(rows_per_tile=1, cols_per_tile=2)
    )
    layout = SimpleNamespace(tile_shape=(2, 6), shape=(31, 47))
    sensor = SimpleNamespace(spec=spec, name="mine", layout=layout, crop=lambda cols, rows: (cols, rows))
    monkeypatch.setattr(simulate, "load_sensor", lambda name: sensor)
    monkeypatch.setattr(simulate, "Instrument", instrument("events"))
    monkeypatch.setattr(simulate, "FrameInstrument", instrument("frames"))
    paths = tmp_path / "events", tmp_path / "frames"
    given = ("s", *paths, (7, 9), 7, lambda what, part: shown.append((what, part)))
    if not (events or frames):
        with pytest.raises(RangeError, match="a sensor with frame or event pixels"):
            simulate.simulate_captures(*given)
        return
    made = simulate.simulate_captures(*given)
    # 7 rows of pixels of one a tile of 2 rows, 9 columns of two a tile of 6; frame pixels in whole tiles
    assert made == (("events", (30, 14)) if events else None, ("frames", (42, 14)) if frames else None, "mine")
    parts = {"events": 0.45 if frames else 0.5, "frames": 0.95 if events else 0.5}
    kinds = [kind for kind, there in (("events", events), ("frames", frames)) if there]
    assert shown == [(kind, pytest.approx(parts[kind])) for kind in kinds]
    # a sensor smaller than that is taken whole, without the rest of a tile
    assert simulate._region(sensor, (90, 90), (1, 2)) == (42, 30)


def test_answers_are_the_first_events_of_the_right_polarity_within_the_window():
    """Jumps up at 100, down at 180 and up at 300 µs: the window is the shortest time between two, or as stated."""
    events = np.array(
        [(99, 1, 1, 1), (100, 0, 1, 1), (130, 1, 0, 1), (140, 1, 0, 1), (150, 1, 1, -1), (178, 2, 1, 1), (180, 0, 0, 1),
         (181, 0, 0, -1), (261, 2, 0, -1), (345, 2, 1, 1), (360, 2, 1, 1), (380, 0, 1, 1), (381, 1, 1, 1)],
        [("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")],
    )  # fmt: skip
    jumps = np.array([100, 180, 300]), np.array([True, False, True])
    bench = SimpleNamespace(
        stream=lambda file: [events[:4], events[4:10], events[10:]], _jumps=lambda steps, stream: jumps, pixels=6,
        shape=(2, 3), path=str,
    )  # fmt: skip
    found = EventBench.answers_to(bench, SimpleNamespace(file="a", window_us=None))
    assert found.window_us == 80
    first, second, third = np.zeros((3, 6), int)
    first[[0, 1, 5]] = 80, 30, 78  # the jump at 180 µs begins after the event at that time
    second[0] = 1
    third[[5, 3]] = 45, 80
    np.testing.assert_array_equal(found.latency_us, [first, second, third])
    short = EventBench.answers_to(bench, SimpleNamespace(file="a", window_us=50))
    assert short.window_us == 50
    np.testing.assert_array_equal(short.latency_us, [np.where(row <= 50, row, 0) for row in (first, second, third)])


def modulation(bursts=None, hz=2000.0, file="a"):
    return SimpleNamespace(file=file, hz=hz, bursts=bursts, depth=0.5, lux=9.0)


def bench_of(rows, span_us, group):
    """A bench of 2 by 3 pixels with events (t_us, x, y, polarity), in two blocks."""
    events = np.array(rows, [("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])

    class Stream(list):
        def span_us(self):
            return span_us

    half = len(events) // 2
    return SimpleNamespace(
        stream=lambda file: Stream([events[:half], events[half:]]), pixels=6, shape=(2, 3), path=str,
        tally=lambda file: SimpleNamespace(group=np.array(group)),
    )  # fmt: skip


def test_cycles_with_an_answer_are_counted_after_two_warm_ones():
    """500 µs a cycle from 40 µs on: three whole ones begin at 1040 µs. A polarity or a burst's length decides."""
    rows = [(1039, 0, 0, 1), (1040, 0, 0, 1), (1100, 0, 0, 1), (1539, 1, 0, 1), (1540, 2, 0, 1), (1600, 0, 1, -1),
            (2000, 2, 0, -1), (2539, 2, 1, 1), (2541, 0, 0, 1), (2541, 1, 1, -1)]  # fmt: skip
    bench, good = bench_of(rows, (40, 2560), [0, 0, 1, 1, 2, 5]), np.array([1, 1, 1, 0, 1, 1], bool)
    assert modulated._cycles(bench, modulation()) == (1040.0, 500.0, 3)
    # a cycle of 300 Hz from 6706.67 to 10,040 µs, whose quotient in double precision is below 1
    assert modulated._cycles(bench_of(rows, (40, 10_040), [0] * 6), modulation(hz=300.0))[2] == 1
    share = np.array([1, 1, 1, 0, 0, 1]) / 3
    expected = np.full(modulated.GROUPS + 1, share[good].mean())
    for group, left in ((0, [2, 4, 5]), (1, [0, 1, 4, 5]), (2, [0, 1, 2, 5]), (5, [0, 1, 2, 4])):
        expected[1 + group] = share[left].mean()
    np.testing.assert_allclose(modulated._answered(bench, modulation(), good), expected)
    counts = np.array([[2, 1, 1, 0, 0, 1], [0, 0, 1, 1, 0, 0]]) / 3
    np.testing.assert_allclose(modulated._counts(bench, modulation(), good)[:, 0], counts[:, good].mean(axis=1))
    bursts = SimpleNamespace(period_us=700, begin_us=1040, length_us=60)
    assert modulated._cycles(bench, modulation(bursts)) == (1040.0, 700.0, 2)
    # within 60 µs of 1040 and 1740 µs, of either polarity
    assert modulated._answered(bench, modulation(bursts), good)[0] == pytest.approx(np.mean([0.5, 0, 0, 0, 0]))
    short = bench_of(rows, (40, 1539), [0] * 6)
    none = modulated._answered(short, modulation(), good), modulated._counts(short, modulation(), good)
    assert none[0].shape == expected.shape and none[1].shape == (2, *expected.shape)
    assert np.isnan(none[0]).all() and not none[1].any()


def test_the_swing_that_half_answer_lies_between_those_around_it():
    parts = [(0.8, np.array([0.9, 0.2])), (0.2, np.array([0.1, 0.1])), (0.4, np.array([0.4, 0.15]))]
    expected = crossing(np.log([0.2, 0.4, 0.8]), np.array([0.1, 0.4, 0.9]), np.zeros(3), 0.5, 1e4)
    assert modulated._half(parts, 0) == pytest.approx(np.exp(expected[0])) and 0.4 < np.exp(expected[0]) < 0.5
    assert np.isnan(modulated._half(parts, 1))
    assert np.isnan(modulated._half([*parts, (1.0, np.array([np.nan, 1.0]))], 0))


@pytest.mark.parametrize(
    ("shares", "reason"),
    [
        ({100: 0.2, 300: 0.2, 900: 0.2}, "answered at fewer than two frequencies"),
        ({100: 0.8, 300: 0.8, 900: 0.2}, "above 300 Hz"),
        ({100: 0.8, 300: 0.8, 900: 0.8}, "above 900 Hz"),
    ],
)
def test_what_bandwidth_lacks_is_said(shares, reason, monkeypatch):
    monkeypatch.setattr(modulated, "_answered", lambda bench, one, good: np.full(21, shares[int(one.hz)] * one.depth))
    each = [(float(hz), depth) for hz in shares for depth in (0.3, 0.9)]
    every = [SimpleNamespace(**{**vars(modulation(hz=hz)), "depth": depth}) for hz, depth in each]
    bench = SimpleNamespace(spec=SimpleNamespace(modulation=every))
    found = modulated.bandwidth(bench, np.array([True, True, False]))
    assert reason in found.entry["reason"] and found.pixels == 2 and found.hz.tolist() == [100, 300, 900]
    bench.spec.modulation = []
    assert modulated.bandwidth(bench, np.ones(3, bool)) is None


@pytest.mark.parametrize(("step", "start", "ticks"), [(1, 0, False), (2, 5, True), (3, 0, True), (50, 7, True)])
def test_pixels_with_ticks_have_times_that_are_multiples_of_one(step, start, ticks):
    times = start + step * np.array([0, 4, 10, 15, 22])
    events = np.zeros(5, [("t_us", "i8")])
    events["t_us"] = times
    spec = SimpleNamespace(steps=[SimpleNamespace(file="a")] * 4)
    bench = SimpleNamespace(spec=spec, stream=lambda file: [events[:3], events[2:], events[:0]])
    assert figures._has_ticks(bench) == ticks
    bench.stream = lambda file: [events[:1]]
    assert not figures._has_ticks(bench)  # nothing tells


@pytest.mark.parametrize("kinds", [("events",), ("frames",), ("events", "frames")])
def test_a_report_has_each_table_once_and_a_page_for_each_kind_of_pixels(kinds, monkeypatch, tmp_path):
    told = []

    class Pages:
        count = 3

        def __init__(self, file, title):
            told.append(title)

        def __getattr__(self, name):
            return lambda *given: told.append((name, *given[:1]))

    for name in ("events", "frames"):
        kind = name.removesuffix("s")
        monkeypatch.setattr(run, f"{kind}_tables", lambda _, name=name: [f"{name} {k}" for k in range(3)])
        monkeypatch.setattr(run, f"{kind}_drawings", lambda _: [])
    for name in ("_about", "_json", "filled"):
        monkeypatch.setattr(run, name, lambda *given, **more: "about")
    monkeypatch.setattr(run, "Document", Pages)
    given = [SimpleNamespace(findings=[name]) if name in kinds else None for name in ("events", "frames")]
    assert run._write(tmp_path, "mine", *given) == 3
    assert [one[1] for one in told[1:] if one[0] == "table"] == [f"{name} {k}" for name in kinds for k in range(3)]
    texts = ["Test report: mine", "about", *(f"Note: {name}" for name in kinds)]
    assert [one[1] for one in told[1:] if one[0] == "text"] == texts
    # frames alone have a page of figures, and both kinds begin pages of their own
    assert told.count(("new_page",)) == (0 if kinds == ("events",) else 1) and told[-1] == ("close",)


@pytest.mark.parametrize("has_photons", (True, False))
def test_figures_of_frames_have_the_light_they_were_measured_in(has_photons):
    """Levels of 10 to 100 % of saturation, of which the last is not clear; a long series at half of it."""
    light = np.linspace(12.3456, 123.456, 10) * (1.0 if has_photons else 1e-6)
    result = SimpleNamespace(
        light=light, signal=np.linspace(20.0, 200.0, 10), top_dn=200.0, clear=np.arange(10) < 9,
        pairs=SimpleNamespace(
            has_photons=has_photons,
            spatial_lit=SimpleNamespace(photons=61.728 if has_photons else None, exposure_s=6.1728e-5),
        ),
    )  # fmt: skip
    lights = emva.FrameFigures(result, {}, []).lights
    assert set(lights) == set(FRAMES)
    if has_photons:
        assert lights["K"] == "12.3 to 86.4 photons" and lights["full_well_e"] == "up to 123 photons"
        assert lights["prnu_percent"] == "61.7 photons, and dark" and lights["dsnu_e"] == "dark"
        assert lights["linearity_error_percent"] == "12.3 to 111 photons"
    else:
        assert lights["K"] == "0.0123 to 0.0864 ms" and lights["prnu_percent"] == "0.0617 ms, and dark"
