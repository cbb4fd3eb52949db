"""Captures that break what the noise models suppose: each is named in the report; good ones are not."""

from dataclasses import replace
from types import SimpleNamespace

import broken_captures
import numpy as np
import pytest
from scipy.stats import binom, norm

from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration
from hesim_render.calibrate.aps import checks as frame_checks
from hesim_render.calibrate.aps import common_mode
from hesim_render.calibrate.evs import analysis as event_analysis
from hesim_render.calibrate.evs import checks as event_checks
from hesim_render.calibrate.evs import model as event_goodness
from hesim_render.calibrate.evs import output as event_output
from hesim_render.calibrate.evs.counts import read_static
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.calibrate.report.parts import findings as findings_of
from hesim_render.calibrate.summary import summary_lines
from hesim_render.core.html import _environment
from hesim_render.recording.capture_set import read_captures


def findings(section):
    """What the report says of the checks of a section, HTML."""
    parts = _environment().get_template("calibrate/report/parts.html").module
    return str(parts.findings_list(findings_of(section))).strip()


def frames_of(folder, report=None, **keys):
    """Section of the calibration of `broken_captures.frames`."""
    broken_captures.frames(folder / "set", **keys)
    calibrate_aps(folder / "set", folder / "c.yaml", report)
    return read_calibration(folder / "c.yaml")["aps"]


BROKEN_FRAMES = {
    "row noise": ({"row_noise": 1.5}, "row noise", "supply"),
    "black level over the session": ({"black_drift": 3.0}, "black level between", "in turn"),
    "black level of the dark frames": ({"black_drift": 3.0}, "dark line", "warm up"),
    "black level within an exposure": ({"black_drift": 3.0, "drift_over": "exposure"}, "black level, dark", "clamp"),
    "black level of lit frames": ({"black_drift": 3.0, "drift_over": "exposure"}, "black level, lit", "black clamp"),
    "light over the session": ({"light_ramp": 0.02}, "light between", "light drifted"),
    "light within an exposure": ({"light_ramp": 0.02, "ramp_over": "exposure"}, "light", "lamp"),
    "cubic variance": ({"cubic": 1e-7}, "curvature", "smaller range"),
}  # fmt: skip


@pytest.mark.parametrize("keys, check, advice", BROKEN_FRAMES.values(), ids=BROKEN_FRAMES)
def test_frames_that_break_the_model_are_named(tmp_path, keys, check, advice):
    page = tmp_path / "r.html" if "row_noise" in keys else None
    section = frames_of(tmp_path, page, **keys)
    assert page is None or findings(section) in page.read_text(encoding="utf-8")
    found = {f["check"]: f for f in section["findings"]}
    assert check in found and advice in found[check]["text"] and found[check]["p_value"] < 1e-6
    assert advice in findings(section) and "Look at this first" in findings(section)
    assert any(line.startswith(f"look at: {check}") for line in summary_lines({"aps": section}, "aps"))
    # what is whole is not blamed
    blamed = {"row noise"} if "row_noise" in keys else set()
    assert {"row noise"} & set(found) == blamed
    if "black_drift" in keys:
        assert "light" not in found
    if "light_ramp" in keys or "cubic" in keys:
        assert not any(name.startswith("black") or name == "dark line" for name in found)


@pytest.mark.slow
def test_the_sizes_of_drifts_are_told(tmp_path):
    section = frames_of(tmp_path / "a", black_drift=3.0, drift_over="exposure")
    # a ramp of 3 DN over 32 frames: 3·sqrt((1 − 1/32²)/12) rms; the mean over 4096 pixels is good to 0.03 DN
    assert section["drift"]["black_dn_rms"]["dark"] == pytest.approx(3 / np.sqrt(12), abs=0.05)
    section = frames_of(tmp_path / "b", light_ramp=0.02, ramp_over="exposure", size=96)
    assert section["drift"]["light_rms_rel"] == pytest.approx(0.02 / np.sqrt(12), abs=0.0015)
    section = frames_of(tmp_path / "c", light_ramp=0.02)
    deviation = section["drift"]["light_from_proportion_rel"]
    # the light of exposure k is 1 + 0.02 (k + ½)/5: from 1 to 20 ms it rises by 1.6 %
    assert deviation[20000] - deviation[1000] == pytest.approx(0.016, abs=0.003)


@pytest.mark.slow
def test_row_noise_is_measured_and_taken_out_of_the_variance(tmp_path):
    """Four seeds of 1.5 DN and 64 rows: z of row noise, of β0 and β1 of four positions; 4.5 sigma (36 values, 2e-4)."""
    z = []
    for seed in range(4):
        section = frames_of(tmp_path / str(seed), row_noise=1.5, seed=seed)
        rows = section["row_noise_dn"]
        assert rows["unit"] == "DN" and rows["standard_error"] < 0.02
        z.append((rows["value"] - 1.5) / rows["standard_error"])
        beta, error = np.array(section["beta"], float), np.array(section["beta_standard_error"], float)
        z += list(((beta - [2.25, 0.25, 0, 0, 0, 0]) / error)[..., :2].ravel())
        chi2 = np.array(section["goodness"]["chi2_per_dof"])
        # 10,240 sample variances with their product with the row's: std of χ²/dof 0.016
        assert np.abs(chi2 - 1).max() < 0.08
        assert section["read_noise_e"]["value_dn"] == pytest.approx(1.5, abs=0.02)
    assert np.abs(z).max() < 4.5
    section = frames_of(tmp_path / "none", row_noise=0.0)
    assert section["row_noise_dn"]["value"] == 0 and section["row_noise_dn"]["upper_limit"] < 0.15


def test_row_noise_of_few_wide_and_narrow_rows_has_no_bias():
    """Rows of 8 pixels, 12 of them: what a pixel's variance holds of its row, and the frame's mean of the rows, count.

    2000 sets of 6 frames of 1 DN of pixel noise and 2 DN of row noise: V = 4 DN² is met to 4.5 of its standard errors
    (1e-5), and so is the pixels' own variance of 1 DN² after the rows were taken out. Without the terms V would be 12 %
    low and the pixels' variance off by 0.3 DN².
    """
    rng = np.random.default_rng(2)
    found, left = [], []
    used = np.ones((12, 8), bool)
    for _ in range(2000):
        stack = 100 + rng.normal(0, 1, (1, 6, 12, 8)) + rng.normal(0, 2, (1, 6, 12, 1))
        mean, variance = stack.mean(axis=1), stack.var(axis=1, ddof=1).astype(np.float32)
        ends = np.full(mean.shape, 100, np.uint16)
        moments = FrameMoments(np.array([1000]), 6, mean, variance, ends, ends, ends, stack.mean(axis=3),
                          np.zeros((1, 6, 2)), np.zeros(mean.shape, np.int8), stack.mean(axis=2))  # fmt: skip
        found.append(common_mode.row_noise(moments, used).variance)
        left.append(common_mode.without_rows(moments, used, 1023, 4.0).variance.mean())
    for values, true in ((found, 4.0), (left, 1.0)):
        assert abs(np.mean(values) - true) < 4.5 * np.std(values) / np.sqrt(2000)


def test_rows_of_which_a_part_is_clipped_lose_the_noise_that_the_others_have():
    """30 of 80 pixels at the ADC's end change the row's mean by 5/8 of its noise; pixels have 1 DN, rows 2 DN."""
    rng, left, used = np.random.default_rng(5), [], np.ones((12, 80), bool)
    for _ in range(60):
        stack = 100 + rng.normal(0, 1, (1, 6, 12, 80)) + rng.normal(0, 2, (1, 6, 12, 1))
        stack[..., 50:] = 1023
        mean, variance = stack.mean(axis=1), stack.var(axis=1, ddof=1).astype(np.float32)
        ends = mean.astype(np.uint16)
        moments = FrameMoments(np.array([1000]), 6, mean, variance, ends, ends, ends, stack.mean(axis=3),
                          np.zeros((1, 6, 2)), np.zeros(mean.shape, np.int8), stack.mean(axis=2))  # fmt: skip
        without = common_mode.without_rows(moments, used, 1023, 4.0).variance
        assert not without[..., 50:].any()
        left.append(without[..., :50].mean())
    # the rows' pixels are taken as alike, which is 3 % of 1 DN² too much
    assert np.mean(left) == pytest.approx(1.03, abs=4.5 * np.std(left) / np.sqrt(60) + 0.02)


def test_the_error_of_the_row_noise_is_its_scatter():
    """600 sets of 5 frames of 30 rows: the scatter is known to 2.9 %, so that 12 % are four of its standard errors."""
    rng = np.random.default_rng(7)
    found, used = [], np.ones((30, 64), bool)
    for _ in range(600):
        stack = 100 + rng.normal(0, 3, (1, 5, 30, 64)) + rng.normal(0, 0.7, (1, 5, 30, 1))
        mean, variance = stack.mean(axis=1), stack.var(axis=1, ddof=1).astype(np.float32)
        ends = np.full(mean.shape, 100, np.uint16)
        moments = FrameMoments(np.array([1000]), 5, mean, variance, ends, ends, ends, stack.mean(axis=3),
                          np.zeros((1, 5, 2)), np.zeros(mean.shape, np.int8), stack.mean(axis=2))  # fmt: skip
        found.append(common_mode.row_noise(moments, used))
    assert np.median([each.error for each in found]) == pytest.approx(
        np.std([each.variance for each in found]), rel=0.12
    )


def test_pixels_with_noise_of_their_own_are_told(tmp_path):
    """A tenth of the pixels with a fifth more noise, which no brightness tells."""
    broken_captures.frames(tmp_path / "set", restless=0.1)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    found = read_calibration(tmp_path / "c.yaml")["aps"]["findings"]
    assert "scatter" in [f["check"] for f in found]


def test_groups_of_brightness_hold_enough_pixels_and_events():
    """Busy pixels first: their events must not count for the dim ones behind them."""
    rng = np.random.default_rng(0)
    signal = rng.permutation(np.linspace(0, 100, 5000))
    events = np.where(signal < 20, 5.0, 0.004)
    group = event_goodness._groups(signal, events)
    pixels, total = np.bincount(group), np.bincount(group, events)
    assert pixels.min() >= 200 and total.min() >= 10 and pixels.size > 4
    order = np.argsort(signal)
    assert np.all(np.diff(group[order]) >= 0)


@pytest.mark.parametrize(
    ("pixels", "events", "each"),
    [
        (8000, 0.125, 400),  # a twentieth of 1000 events
        (16_000, 0.25, 400),  # 100 of 4000 are enough
        (1600, 2**-5, 320),  # at least 10 of 50
        (1000, 1.0, 200),  # 50 events of 50 pixels: at least 200 pixels
    ],
)
def test_groups_of_like_pixels_by_hand(pixels, events, each):
    group = event_goodness._groups(np.arange(pixels)[::-1], np.full(pixels, events))
    assert np.bincount(group).tolist() == [each] * (pixels // each)
    # a scatter is that of 100 events: by the hundred of the sum in which a group ends, and the rest joins the last
    assert event_goodness._wider(np.array([50.0, 50, 100, 100, 100])).tolist() == [0, 0, 1, 2, 2]
    assert event_goodness._wider(np.full(7, 40.0)).tolist() == [0, 0, 1, 1, 1, 1, 1]
    assert event_goodness._wider(np.full(12, 40.0)).tolist() == [0, 0, 1, 1, 1, 2, 2, 3, 3, 3, 3, 3]


@pytest.fixture(scope="module")
def good_events(tmp_path_factory):
    """Captures of good counts, and their calibration."""
    folder = tmp_path_factory.mktemp("good") / "set"
    broken_captures.events(folder, size=48)
    captures = read_captures(folder)
    return captures, event_analysis.analyse(captures, read_static(captures))


def test_maps_for_the_report_are_the_counts_of_the_captures(good_events, monkeypatch):
    """Mean probability of both polarities on a coarser grid, counts by brightness and by contrast, thresholds."""
    captures, result = good_events
    monkeypatch.setattr(event_output, "_FIGURE_PX", 20)
    maps = event_output.maps(captures, result)
    with np.load(captures.folder / "evs_static.npz") as data, np.load(captures.folder / "evs_steps.npz") as steps:
        on, off, trials = data["n_on"], data["n_off"], int(data["n_trials"])
        probability = np.mean([on / trials, off / trials], axis=0)[::3, ::3]
        np.testing.assert_allclose(maps["figure_probability"], probability, rtol=1e-6)
        good = ~result.bad
        for map_on, map_off, name in ((on, off, "lit"), (data["dark_n_on"], data["dark_n_off"], "dark")):
            counted, top = maps[f"figure_on_off_{name}"], float(maps[f"figure_on_off_{name}_top"])
            wide = (top + 0.5) / counted.shape[0]
            assert wide == int(wide) and counted.shape[0] == counted.shape[1]
            # rows are OFF, columns ON
            inside = good & (map_on < top) & (map_off < top)
            assert counted.sum() == inside.sum() >= 0.995 * good.sum()
            own = np.zeros_like(counted)
            np.add.at(own, (map_off[inside] // int(wide), map_on[inside] // int(wide)), 1)
            np.testing.assert_array_equal(counted, own)
        rates = maps["figure_rates"]
        dim = rates[:, 0] > 0  # the dark capture is a brightness of its own
        assert rates[dim, 1].sum() == on[good].sum() and rates[dim, 2].sum() == off[good].sum()
        assert rates[~dim, 1].sum() == data["dark_n_on"][good].sum()
        assert rates[:, 3].sum() == 2 * trials * good.sum()
        per_step = [steps["contrast"], *(steps[key][:, good].sum(axis=1) for key in ("n_on", "n_off"))]
        np.testing.assert_allclose(maps["figure_steps"], np.stack(per_step, axis=1))
        assert maps["figure_steps_trials"] == 200 * good.sum()
    line, fit_on, fit_off = maps["figure_steps_fit"].T
    thresholds = result.thresholds
    assert np.interp(thresholds.theta_on, line, fit_on) == pytest.approx(0.5, abs=0.02)
    assert np.interp(-thresholds.theta_off, line, fit_off) == pytest.approx(0.5, abs=0.02)
    signal, p_on, p_off = maps["figure_rates_fit"].T
    for k, p in ((1, p_on), (2, p_off)):
        wanted = rates[:, k] / rates[:, 3]
        error = np.sqrt(wanted / rates[:, 3]) + 0.04 * wanted
        assert np.all(np.abs(np.interp(rates[:, 0], signal, p) - wanted) < 6 * error)


@pytest.mark.parametrize(("on", "off", "named"), [
    (0.0031, 0.0002, []),  # the leak, and nothing
    (0.0131, 0.0002, ["ON"]), (0.0031, 0.0102, ["OFF"]), (0.0131, 0.0102, ["ON", "OFF"]), (0.0030, -0.05, []),
])  # fmt: skip
def test_a_floor_is_what_steps_of_the_other_direction_give_beyond_leak(on, off, named):
    """Of ON events the leak of 0.003 ± 0.0004 is taken off, of OFF events nothing; errors of 0.001 each."""
    fit = SimpleNamespace(
        free=np.ones(6, bool), values=np.array([1, 1, 1, 1, 0, 0.003]), covariance=np.diag([0, 0, 0, 0, 0, 0.0004**2])
    )
    levels = event_checks.CurveLevels((on, 0.001), (off, 0.001), (1.0, 0.001))
    found = event_checks._floor(SimpleNamespace(together=fit), levels)
    if not named:
        assert found is None
        return
    values = {"ON": on, "OFF": off}
    assert " and ".join(f"{values[name]:.2g} ({name})" for name in named) in found.text
    away = {"ON": abs(on - 0.003) / np.hypot(0.001, 0.0004), "OFF": abs(off) / 0.001}
    assert found.p_value == pytest.approx(min(4 * norm.sf(away[name]) for name in named), rel=1e-6, abs=0)


def test_searches_that_end_elsewhere_are_told(good_events):
    """Starts of which three end 20 standard errors away, put into a calibration of good counts.

    Where their counts are far less likely these searches were lost: they say nothing about the counts.
    """
    captures, result = good_events
    assert event_checks.check_events(result, "voltage")[0] == []
    values = result.ends.values.copy()
    values[:3, 1] += 20 * result.ends.standard_error[1]
    apart = replace(result.ends, values=values)
    (found,), _ = event_checks.check_events(replace(result, ends=apart), "voltage")
    assert found.check == "starts" and found.text.startswith("3 of 200 searches") and found.p_value is None
    below = result.ends.log_likelihood_below.copy()
    below[:3] = 27.0
    lost = replace(result, ends=replace(apart, log_likelihood_below=below))
    assert event_checks.check_events(lost, "voltage")[0] == []
    study = event_output.content(captures, lost)["multi_start"]
    assert study["lost"] == 3 and max(study["largest_difference_in_standard_errors"]) < 0.3
    assert event_output.maps(captures, lost)["figure_starts"].shape == (197, 4)


def test_a_flat_field_has_a_chi2(tmp_path):
    """Terms that one round of weights tells and the next does not made the fit go to and fro: χ²/dof of 3858."""
    section = frames_of(tmp_path, flat=True)
    # 10,240 sample variances: std 0.015 of each
    assert np.abs(np.array(section["goodness"]["chi2_per_dof"]) - 1).max() < 0.08
    assert section["findings"] == []


def _every_p(monkeypatch, alarm):
    """Findings at a chance of `alarm` each, however small what they tell."""
    for module in (frame_checks, common_mode):
        monkeypatch.setattr(module, "ALARM", alarm)
    for name in ("_LEAST_PART", "_LEAST_ERRORS", "_LEAST_SHIFT", "_LEAST_DEVIATION", "_WIDE"):
        monkeypatch.setattr(frame_checks, name, 0.0)


GOOD_FRAMES = {"Gaussian": {}, "Poisson": {"poisson": True}, "flat": {"flat": True},
               "few electrons": {"poisson": True, "gain": 2.0},
               "row noise beside a ramp over rows": {"row_noise": 1.5, "down": True}}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("keys", GOOD_FRAMES.values(), ids=GOOD_FRAMES.keys())
def test_good_frames_give_false_alarms_at_the_stated_rate(tmp_path, monkeypatch, keys):
    """With each check at 2 % on 250 seeds. 16 or more of 250 have a chance of 5e-5 at 2 %; 45 checks are looked at."""
    _every_p(monkeypatch, 0.02)
    seeds, count = 250, {}
    for seed in range(seeds):
        for finding in frames_of(tmp_path, size=32, count=16, seed=1000 + seed, **keys)["findings"]:
            count[finding["check"]] = count.get(finding["check"], 0) + 1
    if "row_noise" in keys:
        assert count.pop("row noise") == seeds
    assert binom.sf(15, seeds, 0.02) < 1e-4
    assert max(count.values()) < 16, count


@pytest.mark.parametrize(
    "keys",
    [pytest.param(keys, id=name, marks=pytest.mark.slow) for name, keys in GOOD_FRAMES.items()],
)
def test_good_frames_are_not_blamed(tmp_path, keys):
    """4 seeds, 9 checks of a chance of 1e-4: a false alarm in 0.4 % of changed seeds."""
    for seed in range(4):
        section = frames_of(tmp_path, size=32, count=16, seed=seed, **keys)
        assert [f["check"] for f in section["findings"]] == (["row noise"] if "row_noise" in keys else [])
        assert ("all agree" in findings(section)) == ("row_noise" not in keys)


def test_drift_of_black_and_of_light_are_told_apart_to_the_number():
    """Means of a dim and a bright half written out: black moves both, light each by its signal."""
    rng = np.random.default_rng(1)
    frames, size, levels = 400, 64, np.array([50.0, 450.0])
    black, light = rng.normal(0, 0.4, frames), rng.normal(0, 0.01, frames)
    half = np.repeat(np.array([[0, 1]], np.int8), size, 0).repeat(size // 2, 1)
    noise = rng.normal(0, 3.0 / np.sqrt(size * size / 2), (frames, 2))
    means = levels * (1 + light[:, None]) + black[:, None] + noise
    flat = np.full((1, size, size), 9.0, np.float32)
    empty = np.zeros((1, size, size), np.uint16)
    rows = np.zeros((1, frames, size))
    moments = FrameMoments(
        np.array([1000]), frames, flat, flat, empty, empty, empty, rows, means[None], half[None], rows
    )
    drift = common_mode.frame_drift(moments, 0, 0.0, levels[half])
    assert drift.black.variance == pytest.approx(black[1:].var(ddof=1), rel=0.05)
    assert drift.light.variance == pytest.approx(light[1:].var(ddof=1), rel=0.02)
    assert drift.light.p_value < 1e-100 and drift.black.p_value < 1e-100
    # a dim half of less than 80 % of the bright one is needed to tell them apart
    for dim, is_apart in ((0.802, False), (0.798, True)):
        signal = np.array([dim * 450.0, 450.0])[half]
        assert (common_mode.frame_drift(moments, 0, 0.0, signal).light is not None) is is_apart


def events_of(folder, report=None, **keys):
    """Section of the calibration of `broken_captures.events`."""
    broken_captures.events(folder / "set", **keys)
    calibrate_evs(folder / "set", folder / "c.yaml", report)
    return read_calibration(folder / "c.yaml")["evs"]


BROKEN_EVENTS = {
    "noise of a t law": ({"noise": "t"}, {"S-curve width", "S-curve floor", "event counts"}, "longer tails"),
    "a floor in both polarities": ({"floor": 2e-4}, {"S-curve floor"}, "come by themselves"),
    "an S-curve that tops at 0.9": ({"ceiling": 0.9}, {"S-curve ceiling", "S-curve width"}, "read-out"),
}


@pytest.mark.parametrize(
    "keys, checks, advice",
    [
        pytest.param(*given, id=name, marks=() if name == "a floor in both polarities" else pytest.mark.slow)
        for name, given in BROKEN_EVENTS.items()
    ],
)
def test_events_that_break_the_model_are_named(tmp_path, keys, checks, advice):
    section = events_of(tmp_path, size=64, **keys)
    found = {f["check"]: f for f in section["findings"]}
    assert checks <= set(found) and advice in findings(section)
    assert all(found[check]["p_value"] < 1e-6 for check in checks)
    if "floor" in keys:
        for name in ("floor_on", "floor_off"):
            level = section["s_curve"][name]
            assert abs(level["value"] - 2e-4) < 4.5 * level["standard_error"] < 1e-4  # two values: 1e-5
    if "ceiling" in keys:
        level = section["s_curve"]["ceiling"]
        assert abs(level["value"] - 0.9) < 4.5 * level["standard_error"] < 2e-3


GOOD_EVENTS = {"plain": {"mismatch": 0.0}, "mismatch": {}, "wide mismatch": {"mismatch": 0.15},
               "leak": {"leak": 2e-4}, "asymmetry": {"rho": 0.01}}  # fmt: skip


@pytest.mark.parametrize(
    "keys",
    [
        pytest.param(keys, id=name, marks=pytest.mark.slow if name != "plain" else ())
        for name, keys in GOOD_EVENTS.items()
    ],
)
def test_good_events_are_not_blamed(tmp_path, keys):
    """4 checks of a chance of 1e-4 each: a false alarm of all in 0.2 % of changed seeds."""
    page = tmp_path / "r.html"
    section = events_of(tmp_path, page, size=64, **keys)
    assert section["findings"] == [] and "all agree" in findings(section)
    assert findings(section) in page.read_text(encoding="utf-8")
    # floors and ceiling: 4.5 standard errors, and the chance of one event in far steps
    for name, true in (("floor_on", keys.get("leak", 0.0)), ("floor_off", 0.0), ("ceiling", 1.0 + keys.get("leak", 0))):
        level = section["s_curve"][name]
        assert abs(level["value"] - true) < 4.5 * level["standard_error"] + 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("keys", GOOD_EVENTS.values(), ids=GOOD_EVENTS.keys())
def test_good_events_give_false_alarms_at_the_stated_rate(tmp_path, monkeypatch, keys):
    """With each check at 5 % on 60 seeds. 11 or more of 60 have a chance of 1e-4 at 5 %; 20 checks are looked at."""
    monkeypatch.setattr(event_checks, "ALARM", 0.05)
    for name in ("_LEAST_FLOOR", "_LEAST_LOSS"):
        monkeypatch.setattr(event_checks, name, 0.0)
    seeds, count = 60, {}
    for seed in range(seeds):
        for finding in events_of(tmp_path, size=64, seed=1000 + seed, **keys)["findings"]:
            count[finding["check"]] = count.get(finding["check"], 0) + 1
    assert binom.sf(10, seeds, 0.05) < 2e-4
    assert max(count.values(), default=0) < 11, count


def test_a_calibration_that_was_never_checked_is_not_called_clean():
    assert findings({}) == ""
    assert "all agree" in findings({"findings": []})
