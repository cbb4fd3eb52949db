"""The test report of a sensor: every figure on recordings of a generator written in NumPy alone
(`tests/support/bench_pixels.py`), coverage of the intervals, the files, and bad input.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy import special
from scipy.special import ndtr, ndtri
from scipy.stats import norm

from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.exchange import EVENT_FORMATS, EventStream
from hesim_render.exchange.triggers import TRIGGER_DTYPE
from hesim_render.report import figures, make_report, s_curves
from hesim_render.report.bench import EventBench
from hesim_render.report.definitions import EVENTS, FRAMES
from hesim_render.report.emva import frame_figures
from hesim_render.report.estimates import corrected, crossing, figure, mean_error
from hesim_render.report.latency import Answers
from hesim_render.report.limits import dynamic_range
from hesim_render.report.s_curves import s_curve
from hesim_render.report.texts import event_tables
from tests.support.bench_pixels import HALF_US, LUX, PIXELS, SHAPE, Pixels


def entry_of(found, key, name):
    """The entry of a figure; of those against light, that of the brightest step or steady recording."""
    every = [one for one in found.entries if (one.key, one.name) == (key, name)]
    return max(every, key=lambda one: one.lux or 0.0 if key != "background" else one.lux == 70.0)


def covered(seeds, folder):
    """Of each figure: how often its interval holds the truth, and errors in standard errors."""
    hits, scores = {}, {}
    for seed in seeds:
        pixels = Pixels(seed).everything()
        found = figures.event_figures(EventBench(pixels.write(folder / str(seed))))
        for (key, name), truth in pixels.truth.items():
            value = entry_of(found, key, name).value
            low, high = value.get("interval_95", (np.nan, np.nan))
            hits.setdefault((key, name), []).append(low <= truth <= high)
            scores.setdefault((key, name), []).append((value["value"] - truth) / value["standard_error"])
    return hits, scores


@pytest.fixture(scope="module")
def numpy_bench(tmp_path_factory):
    pixels = Pixels(3).everything()
    pixels.content["temperature_c"] = 25.0
    folder = pixels.write(tmp_path_factory.mktemp("bench") / "captures")
    out = folder.parent / "report"
    return pixels, make_report([folder], out), out


def test_figures_are_those_of_the_generator(numpy_bench):
    """19 intervals of 4.2 standard errors: one misses in 2000 cases; the seed is fixed."""
    pixels, found, _ = numpy_bench
    for (key, name), truth in pixels.truth.items():
        value = entry_of(found.events, key, name).value
        assert abs(value["value"] - truth) < 4.2 * value["standard_error"] < 0.5 * truth, (key, name, value, truth)
    assert entry_of(found.events, "dead", "ON").value["value"] == len(pixels.dead) / PIXELS
    assert entry_of(found.events, "threshold", "OFF").pixels == PIXELS - len(pixels.dead)
    assert entry_of(found.events, "threshold", "ON").lux == LUX
    assert entry_of(found.events, "bandwidth", "ON").temperature_c == 25.0
    assert "the captures end there" in entry_of(found.events, "dynamic_range", "ON").value["reason"]
    assert found.events.findings == []


@pytest.mark.slow
def test_intervals_hold_the_truth_of_a_hundred_benches(tmp_path):
    hits, scores = covered(range(20261124, 20261224), tmp_path)
    for name, every in hits.items():
        assert 90 <= sum(every) <= 99, (name, sum(every))
        assert abs(np.mean(scores[name])) < 0.6, name


def test_the_files_of_a_report(numpy_bench):
    _, found, out = numpy_bench
    whole = json.loads((out / "report.json").read_text())
    listed = {one["figure"] for one in whole["events"]["figures"]}
    assert listed == set(EVENTS) == set(whole["events"]["definitions"])
    for one in whole["events"]["figures"]:
        assert one["pixels"] > 0 and ("value" in one) and (one["value"] is not None or one["reason"])
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 6 and "http" not in page.replace("http://www.w3.org", "")
    for definition in EVENTS.values():
        assert definition.title in page
        assert definition.sentence.endswith(".") and ". " not in definition.sentence
    assert (out / "report.pdf").read_bytes()[:5] == b"%PDF-"
    assert 2 <= found.pages <= 4
    assert whole["frames"] is None


def test_rows_of_a_figure_against_light(numpy_bench):
    table = event_tables(numpy_bench[1].events)[1]
    row = next(row for row in table.rows if row[0] == "4, 25 °C")
    assert len(row) == len(table.head) == len(table.widths)
    assert all("(" in cell for cell in row[1:7]) and "±" in row[7]
    assert [figure(value) for value in (0.0, 12345.6, 2.5e7, 0.04321)] == ["0", "12350", "2.5e+07", "0.04321"]


def test_edges_of_triggers_stand_for_times(tmp_path, numpy_bench):
    """The same answers whether times are given or read from a trigger line; a last edge ends the last window."""
    pixels = numpy_bench[0]
    one = next(one for one in pixels.content["steps"] if one["file"] == "s5.npz")
    edges = np.zeros(14, TRIGGER_DTYPE)
    edges["t_us"] = 1000 + HALF_US * np.arange(14)
    edges["edge"], edges["channel"] = np.where(np.arange(14) % 2, -1, 1), 1
    with (tmp_path / "s5.raw").open("wb") as file:
        events = pixels.files["s5.npz"]
        stream = EventStream(lambda: EventStream.of(events, SHAPE), SHAPE, triggers=lambda: edges)
        EVENT_FORMATS["evt3"].write(stream, file, "s5.raw")
    content = {"sensor": "x", "steps": [{"file": "s5.raw", "lux": LUX, "contrast": one["contrast"], "trigger": 1}]}
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    read = EventBench(tmp_path).responses[0]
    written = next(r for r in EventBench(pixels.write(tmp_path / "same")).responses if r.steps.file == "s5.npz")
    assert read.window_us == HALF_US and list(read.rises[:3]) == [True, False, True]
    assert np.array_equal(read.latency_us[:12], written.latency_us)
    content["steps"][0]["window_us"] = 700
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    short = EventBench(tmp_path).responses[0]
    assert short.window_us == 700
    assert np.array_equal(short.latency_us, np.where(read.latency_us <= 700, read.latency_us, 0))
    with pytest.raises(SpecError, match=r"s5\.raw.*0 edges of triggers on line 4"):
        content["steps"][0]["trigger"] = 4
        (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
        _ = EventBench(tmp_path).responses


def test_what_cannot_be_told_says_why(tmp_path):
    pixels = Pixels(5)
    for k, part in enumerate((0.2, 0.5, 1.6, 2.0)):
        size = part * pixels.theta.mean()
        pixels.step_file(LUX, size, 4, lambda polarity, s=size: s > pixels.own[polarity], f"{k}.npz")
    for one in pixels.content["steps"]:
        one["reset"] = False
    found = figures.event_figures(EventBench(pixels.write(tmp_path / "coarse")))
    assert "the contrasts are too coarse: between" in entry_of(found, "threshold", "ON").value["reason"]
    assert "the threshold is not known" in entry_of(found, "dynamic_range", "OFF").value["reason"]
    assert "no recordings of modulated light" in entry_of(found, "bandwidth", "").value["reason"]
    assert "two steady recordings" in entry_of(found, "hot", "").value["reason"]
    assert "not all pixels were reset" in found.findings[0]
    steady = Pixels(6)
    steady.steady_file(2.0, None, (0.0, 1.0), 0.5, "a.npz")
    found = figures.event_figures(EventBench(steady.write(tmp_path / "steady")))
    assert entry_of(found, "background", "ON").value["upper_limit"] == pytest.approx(3 / PIXELS / 0.5)
    assert "no temperature is stated" in entry_of(found, "doubling", "ON").value["reason"]
    assert "no recordings of steps" in entry_of(found, "latency", "ON").value["reason"]


def test_noise_or_spread_alone(tmp_path):
    """Where one of both makes the whole width, the other is 0 with a limit, and the threshold is right."""
    for spread, noise, key in ((0.0, 0.1, "threshold_spread_percent"), (0.12, 1e-7, "pixel_noise")):
        pixels = Pixels(7)
        pixels.noise = noise * pixels.theta[0]
        pixels.own = pixels.theta[:, None] * (1 + spread * pixels.rng.standard_normal((2, PIXELS)))
        pixels.s_curves()
        curve = s_curve(EventBench(pixels.write(tmp_path / key)).responses, 0, ~np.isin(np.arange(PIXELS), pixels.dead))
        value = curve.entries[key]
        assert value["value"] == 0 and 0 < value["upper_limit"] < 4.0, value
        threshold = curve.entries["threshold"]
        assert abs(threshold["value"] - pixels.theta[0]) < 4 * threshold["standard_error"]


def test_closed_forms():
    assert corrected(0.55, 0.1) == pytest.approx(0.5)
    # Φ⁻¹ of 0.1587 and 0.9772 is −1 and 2: half is reached a third of the way
    share = np.array([0.15865525, 0.97724987])
    place, error = crossing(np.array([2.0, 5.0]), share, np.array([0.01, 0.0]), 0.5, 1e4)
    assert place == pytest.approx(3.0, abs=1e-6)
    assert error == pytest.approx(0.01 / 0.24197072 * 2 / 3 * 3 / 3, rel=1e-4)
    assert crossing(np.array([2.0, 5.0]), share, share, 0.99, 1e4) is None
    # a part that all pixels of a jump share counts once a jump
    rng = np.random.default_rng(2)
    values = rng.standard_normal((40, 500)) + 3 * rng.standard_normal((40, 1))
    assert mean_error(values, np.ones(values.shape, bool)) == pytest.approx(3 / np.sqrt(40), rel=0.4)


def answers_at(lux, share):
    reason = {"value": None, "reason": "none"}
    return Answers(lux, 0.5, None, 4000, share, 0.002, 8, reason, reason, 500)


def test_dynamic_range_in_closed_form():
    """Shares Φ(z) with z linear in ln L on both flanks, of which chance adds a part: 90 % lie between two lights."""
    lux = np.array([0.1, 0.5, 3.0, 100.0, 2e4, 5e4])
    z = np.array([-0.6, 0.9, 2.6, 2.7, 1.9, -0.4])
    chance = np.array([0.1, 0.07, 0.03, 0.02, 0.02, 0.05])
    share = chance + (1 - chance) * ndtr(z)
    found = dynamic_range([answers_at(*one) for one in zip(lux, share, strict=True)], chance.tolist())
    wanted = ndtri(0.9)
    least = np.exp(np.interp(wanted, z[1:3], np.log(lux[1:3])))
    most = np.exp(np.interp(-wanted, -z[4:], np.log(lux[4:])))
    assert found.share == pytest.approx(ndtr(z)) and found.error == pytest.approx(0.002 / (1 - chance))
    assert found.least_lux["value"] == pytest.approx(least) and found.most_lux["value"] == pytest.approx(most)
    assert found.range_db["value"] == pytest.approx(20 * np.log10(most / least))
    errors = [found.least_lux["standard_error"] / least, found.most_lux["standard_error"] / most]
    assert found.range_db["standard_error"] == pytest.approx(20 / np.log(10) * np.hypot(*errors))
    low = dynamic_range([answers_at(*one) for one in zip(lux[2:], share[2:], strict=True)], chance[2:].tolist())
    assert low.least_lux["reason"].startswith("at most 3 lx")
    decibels = 20 * np.log10(most / 3)
    assert low.range_db["reason"].startswith(f"at least {decibels:.4g} dB, from 3 to {figure(most, 3)} lx")
    high = dynamic_range([answers_at(*one) for one in zip(lux[:5], share[:5], strict=True)], chance[:5].tolist())
    decibels = 20 * np.log10(2e4 / least)
    assert high.range_db["reason"].startswith(f"at least {decibels:.4g} dB, from {figure(least, 3)} to 20000 lx")
    none = dynamic_range([answers_at(1.0, 0.5), answers_at(9.0, 0.7)], [0.0, 0.0])
    assert none.range_db["reason"] == "at no light are 90 % found; at most 70 %"


def test_steady_light_that_is_not_the_same():
    """Up to 1.3 times brighter or darker it is the same light; the nearest one is taken."""
    bench = SimpleNamespace(spec=SimpleNamespace(steady=[SimpleNamespace(lux=lux) for lux in (0.0, 10.0, 12.5, 40.0)]))
    for lux, own in ((12.9, 12.5), (9.9, 10.0), (31.0, 40.0), (16.0, 12.5), (7.8, 10.0)):
        assert figures._steady(bench, lux).lux == own
    for lux in (16.5, 7.6, 30.0, 53.0):
        assert figures._steady(bench, lux) is None


@pytest.mark.parametrize("ratio", (-3.5, -1.2, 0.8))
def test_the_likelihood_of_counts_is_an_integral_over_the_thresholds(ratio):
    """Against a sum over a fine grid, from noise far below the spread of the thresholds to noise above it."""
    sizes, trials = np.array([0.1, 0.17, 0.21, 0.3]), np.array([6.0, 8.0, 8.0, 4.0])
    hits = np.array([[0, 2, 5, 4], [0, 0, 8, 4], [1, 4, 4, 3], [0, 8, 8, 4]], float)
    fit = s_curves._Fit(sizes, hits, trials)
    values = np.array([0.19, np.log(0.03), ratio, special.logit(0.02)])
    theta, sigma, tau, chance = s_curves._natural(values)

    own = np.linspace(theta - 7 * tau, theta + 7 * tau, 100_001)
    share = np.clip(chance + (1 - chance) * ndtr((sizes[:, None] - own) / sigma), 1e-12, 1 - 1e-12)
    for counts, log in zip(fit._hits, fit._log(values), strict=True):
        each = counts @ np.log(share) + (trials - counts) @ np.log1p(-share)
        exact = np.sum(np.exp(each) * norm.pdf(own, theta, tau)) * (own[1] - own[0])
        assert log == pytest.approx(np.log(exact), abs=0.03)


def test_errors_of_an_s_curve_follow_from_the_scatter_of_scores():
    """H⁻¹ S H⁻¹ of the likelihood written out, of 150 pixels whose thresholds are no normal law."""
    rng, sizes, trials = np.random.default_rng(11), np.array([0.09, 0.15, 0.19, 0.22, 0.27, 0.36]), np.full(6, 12.0)
    own = 0.2 + 0.03 * (rng.exponential(1, 150) - 1)
    hits = rng.binomial(12, 0.02 + 0.98 * ndtr((sizes - own[:, None]) / 0.035)).astype(float)
    fit = s_curves._Fit(sizes, hits, trials)
    values, covariance = fit.values()
    z = np.linspace(-6, 6, 401)

    def log(moved):
        theta, sigma, tau, chance = s_curves._natural(moved)
        share = np.clip(chance + (1 - chance) * ndtr((sizes[:, None] - theta - tau * z) / sigma), 1e-12, 1 - 1e-12)
        each = hits @ np.log(share) + (trials - hits) @ np.log1p(-share)
        return np.log(np.exp(each) @ norm.pdf(z) * (z[1] - z[0]))

    steps = np.diag([5e-4, 0.02, 0.03, 0.05])
    size = np.diag(steps)
    score = np.stack([(log(values + step) - log(values - step)) / 2 for step in steps], axis=1) / size
    curve = np.array([[sum(u * v * log(values + u * a + v * b).sum() for u in (1, -1) for v in (1, -1)) / 4
                       for a in steps] for b in steps]) / np.outer(size, size)  # fmt: skip
    inverse = np.linalg.inv(-curve)
    score -= score.mean(axis=0)
    expected = inverse @ score.T @ score @ inverse
    error = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), error, rtol=0.1)
    np.testing.assert_allclose(covariance / np.outer(error, error), expected / np.outer(error, error), atol=0.15)


def test_a_ratio_at_its_end_counts_as_known():
    """Pixels without noise: the ratio of noise and spread is at its lower end, and the covariance leaves it out."""
    rng = np.random.default_rng(9)
    own, sizes = 0.2 + 0.02 * rng.standard_normal(400), np.array([0.14, 0.17, 0.19, 0.2, 0.21, 0.23, 0.27])
    fit = s_curves._Fit(sizes, 6.0 * (sizes > own[:, None]), np.full(7, 6.0))
    values, covariance = fit.values()
    assert values[2] < -5.9 and not covariance[2].any() and not covariance[:, 2].any()
    assert covariance[0, 0] == pytest.approx(0.02**2 / 400, rel=0.3)


def test_a_curve_may_be_as_steep_as_two_sizes_are_near():
    """No jump of 0.2 is answered, and all of 0.2002 are: the width is less than their distance."""
    sizes = np.array([0.12, 0.17, 0.2, 0.2002, 0.23, 0.3])
    fit = s_curves._Fit(sizes, np.tile(12.0 * (sizes > 0.2001), (40, 1)), np.full(6, 12.0))
    values, _ = fit.values()
    assert 0.2 < values[0] < 0.2002 and np.exp(values[1]) < 1e-4


def test_bad_input_is_one_clear_error(tmp_path, numpy_bench):
    _, _, report = numpy_bench
    captures = report.parent / "captures"
    bare = tmp_path / "bare"
    bare.mkdir()
    for given, told in (
        ([bare], r"holds neither bench\.yaml"),
        ([captures, captures], "is a second folder of events"),
        ([captures, "davis346"], "no such folder"),
        (["no-such-sensor"], "no sensor named"),
    ):
        with pytest.raises(SpecError, match=told):
            make_report(given, tmp_path / "out")
    with pytest.raises(RangeError, match="a sensor, or folders of captures"):
        make_report([], tmp_path / "out")
    with pytest.raises(RangeError, match="seed"):
        make_report([captures], tmp_path / "out", seed=-1)
    with pytest.raises(OutputError, match="exists"):
        make_report([captures], report)
    steps = {"file": "s1.npz", "lux": LUX, "contrast": 0.2}
    np.savez(bare / "other.npz", t=[5, 9], x=[1, 2], y=[3, 4], p=[True, False])
    for content, told in (
        ({"sensor": "x"}, "names no recording"),
        ({"sensor": "x", "steps": [steps]}, r"steps\.0.*begin_us and period_us, or trigger"),
        ({"sensor": "x", "rows": 4, "steps": [{**steps, "trigger": 0}]}, "rows and cols are given together"),
        ({"sensor": "x", "busy": ["../up.npz"]}, "leads out of the folder"),
        ({"sensor": "x", "busy": ["gone.npz"]}, "no such file: 'gone.npz'"),
        ({"sensor": "x", "busy": ["other.npz"]}, r"other\.npz.*does not state the size"),
        ({"sensor": "x", "steady": [{"file": "a", "lux": -1}]}, r"steady\.0\.lux"),
        ({"sensor": "x", "steady": [{"file": "a", "lux": 1, "interval_us": [4, 2]}]}, "a later end"),
        (
            {"sensor": "x", "rows": 9, "cols": 9, "steps": [
                {"file": "other.npz", "lux": 3.0, "contrast": 0.5, "begin_us": 4, "period_us": 800}]},
            "ends at 9 µs, before a rise and a fall",
        ),
    ):  # fmt: skip
        (bare / "bench.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(SpecError, match=told):
            bench = EventBench(bare)
            _ = [bench.tally(name) for name in bench.spec.busy], bench.responses


@pytest.mark.slow
def test_a_report_of_a_simulated_sensor(tmp_path):
    """The figures are those that the sensor has; the captures it leaves give the same report."""
    from hesim_render.sensor.sensor import load_sensor

    out = tmp_path / "report"
    found = make_report(["davis346"], out, size=(24, 30))
    sensor = load_sensor("davis346").crop(30, 24)
    for name, own in (("ON", sensor.evs.threshold_on_map), ("OFF", sensor.evs.threshold_off_map)):
        value = entry_of(found.events, "threshold", name).value
        assert abs(value["value"] - own.mean()) < 0.02 * own.mean()  # the noise lowers it
        spread = entry_of(found.events, "threshold_spread_percent", name).value
        assert abs(spread["value"] - 100 * own.std() / own.mean()) < 1.5
    assert found.events.entries[0].pixels <= 24 * 30
    frames, aps = found.frames.entries, sensor.spec.aps
    for key, truth in (
        ("K", aps.system_gain_dn_per_e), ("quantum_efficiency", 0.24 * 0.22), ("prnu_percent", 1.0), ("dsnu_e", 60.0),
        ("dark_current_e_per_s", aps.dark_current_e_per_s),
    ):  # fmt: skip
        assert abs(frames[key]["value"] - truth) < 4 * frames[key]["standard_error"] + 0.03 * truth, key
    assert set(FRAMES) == set(frames)
    again = make_report([out / "captures-events", out / "captures-frames"], tmp_path / "again")
    assert [one.value for one in again.events.entries] == [one.value for one in found.events.entries]
    noise, k, well = (frames[key]["value"] for key in ("temporal_dark_noise_e", "K", "full_well_e"))
    least = np.sqrt(noise**2 + 1 / 12 / k**2) + 0.5
    assert frames["dynamic_range"]["value"] == pytest.approx(20 * np.log10(well / least))
    assert frames["snr_max"]["value"] == pytest.approx(10 * np.log10(well))
    assert frame_figures(out / "captures-frames").pixels == 24 * 30


@pytest.mark.slow
def test_a_dark_noise_that_rounding_hides_is_read_from_grey_values(tmp_path):
    """The dark noise of `reference-mono`, 0.4 DN, is below what the variance shows; all else has its report."""
    from hesim_render.sensor.sensor import load_sensor

    found = make_report(["reference-mono"], tmp_path / "report", size=(12, 16))
    assert found.frames is not None and found.events is not None
    assert any("rounding hides the dark noise" in one for one in found.frames.findings)
    camera = load_sensor("reference-mono").spec.aps
    dark = found.frames.entries["temporal_dark_noise_e"]
    assert "grey values" in dark["note"] and dark["interval_95"][0] < camera.read_noise_e < dark["interval_95"][1]
    assert found.frames.entries["K"]["value"] == pytest.approx(camera.system_gain_dn_per_e, rel=0.1)
    threshold = entry_of(found.events, "threshold", "ON").value
    assert abs(threshold["value"] - 0.1) < 0.005  # contrast_threshold_on of its file
    band = entry_of(found.events, "bandwidth", "ON").value
    assert band["value"] is None
