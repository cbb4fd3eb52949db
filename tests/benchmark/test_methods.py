"""Baselines of flow, intensity and high dynamic range, and their measures, on light in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.benchmark import optical_flow
from hesim_render.benchmark.exposure_merge import flux_of, flux_scores, merged_exposures
from hesim_render.benchmark.intensity import intensity_scores, leaky_sum
from hesim_render.benchmark.optical_flow import flow_scores, of_pictures, plane_fit
from hesim_render.benchmark.predictions import Predictions
from hesim_render.core.errors import SpecError
from hesim_render.measure.pictures import ssim
from hesim_render.pixels.evs.events import EVENT_DTYPE


@pytest.mark.parametrize("angle_deg", [0, 25, 130, 270])
def test_planes_through_the_events_of_an_edge_have_its_speed(angle_deg):
    """An edge crosses at 2 px/ms: the event of a pixel comes when the edge is there, to 1 µs; noise of 100 µs below."""
    rows, cols, speed = 24, 32, 0.002
    way = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    y, x = np.indices((rows, cols))
    time = (way[0] * x + way[1] * y) / speed
    time = time - time.min() + 5000

    def events_at(when, polarity=1):
        order = np.argsort(when, axis=None)
        made = np.zeros(order.size, EVENT_DTYPE)
        made["t_us"], made["x"], made["y"] = np.rint(when.ravel()[order]), x.ravel()[order], y.ravel()[order]
        made["polarity"] = polarity
        return made

    found = plane_fit(events_at(time), (rows, cols))
    inner = found[3:-3, 3:-3]
    assert np.isfinite(inner).all() and np.abs(inner - speed * way).max() < 0.01 * speed
    # events of the other polarity have planes of their own; those of both are not mixed
    np.testing.assert_array_equal(plane_fit(events_at(time, -1), (rows, cols)), found)
    far = events_at(time, -1)[: time.size // 9]
    far["t_us"] -= 4_000
    both = np.concatenate([far, events_at(time)])
    np.testing.assert_array_equal(plane_fit(both, (rows, cols))[3:-3, 3:-3], inner)
    rng = np.random.default_rng(3)
    noisy = plane_fit(events_at(time + rng.normal(0, 100, time.shape)), (rows, cols))[3:-3, 3:-3]
    # the slope of a plane through 25 times of σ 100 µs has σ 100/√50 = 14 µs/px, 3 % of 500 µs/px
    off = noisy / speed - way
    assert np.sqrt(np.mean(off**2)) < 0.05 and np.abs(off.mean(axis=(0, 1))).max() < 0.015
    # events without order in time lie in no plane, and a pixel without events has no flow
    shuffled = plane_fit(events_at(rng.uniform(0, 20_000, time.shape)), (rows, cols))
    assert np.isfinite(shuffled).all(axis=-1).mean() < 0.1
    assert np.isnan(plane_fit(events_at(time)[:0], (rows, cols))).all()


def test_planes_through_a_part_of_a_window_are_those_of_least_squares():
    """A bent front of which two of five pixels have no event, also at the sides: `lstsq` of each window by itself."""
    rng, shape = np.random.default_rng(7), (17, 23)
    y, x = np.indices(shape)
    time = 400.0 * x - 250.0 * y + 9.0 * (x - 8) * (y - 5) + rng.normal(0, 120, shape)
    time[rng.random(shape) < 0.4] = np.nan
    time[9:, 14:] += rng.normal(0, 2500, (8, 9))  # no plane
    time[:5, :6] = time[:5, :6] / 1e4  # faster than anything
    velocity, count = optical_flow._planes(time)
    seen = set()
    for row, col in np.ndindex(shape):
        window = np.s_[max(row - 2, 0) : row + 3, max(col - 2, 0) : col + 3]
        there = np.isfinite(time[window])
        t, n = time[window][there], there.sum()
        design = np.column_stack([x[window][there], y[window][there], np.ones(n)])
        found = velocity[row, col]
        if n < optical_flow._FEWEST or np.isnan(time[row, col]) or np.linalg.matrix_rank(design) < 3:
            assert np.isnan(found).all() and count[row, col] == 0
            continue
        (a, b, c), *_ = np.linalg.lstsq(design, t, rcond=None)
        residual, spread = np.sum((t - design @ (a, b, c)) ** 2), np.sum((t - t.mean()) ** 2)
        ratio, steep = np.sqrt(residual / spread) / optical_flow._MOST_RESIDUAL, np.hypot(a, b) * optical_flow._FASTEST
        if ratio < 0.99 and steep > 1.01:
            np.testing.assert_allclose(found, np.array([a, b]) / (a * a + b * b), rtol=1e-6)
            assert count[row, col] == pytest.approx(n)
        elif ratio > 1.01 or steep < 0.99:
            assert np.isnan(found).all() and count[row, col] == 0
        seen.add((bool(ratio < 1), bool(steep > 1)))
    assert seen >= {(True, True), (False, True), (True, False)}


def test_flow_is_measured_as_the_papers_have_it():
    truth = np.zeros((2, 2, 2), np.float32)
    truth[0, 0], truth[0, 1] = (3, 4), (100, 0)
    flow = truth.astype(float).copy()
    flow[0, 0] += (0, 4)  # off by 4 px of 5: an outlier
    flow[0, 1] += (4, 0)  # off by 4 px of 100: none
    flow[1, 0] = np.nan  # counts as 0, which is right
    found = flow_scores(flow, truth, np.array([[True, True], [True, False]]))
    assert found["epe_px"] == pytest.approx(8 / 3) and found["outliers"] == pytest.approx(1 / 3)
    angles = [np.degrees(np.arccos((1 + 9 + 32) / np.sqrt(26 * 74))), 0, 0]
    angles[1] = np.degrees(np.arccos((1 + 10400) / np.sqrt(10001 * 10817)))
    assert found["angle_deg"] == pytest.approx(np.mean(angles)) and found["density"] == pytest.approx(2 / 3)
    assert np.isnan(flow_scores(flow, truth, np.zeros((2, 2), bool))["epe_px"])


@pytest.mark.parametrize("method", ["farneback", "dis"])
def test_flow_of_pictures_finds_a_shift(method):
    pytest.importorskip("cv2")
    y, x = np.indices((64, 80))

    def picture(shift_x, shift_y):
        a, b = x - shift_x, y - shift_y
        wave = np.sin(a / 3.1) + np.sin(b / 4.3) + np.sin((a + b) / 6.7) + np.sin((a - b) / 9.1)
        return np.rint(127 + 30 * wave).astype(np.uint8)

    flow = of_pictures(method, picture(0, 0), picture(1.5, -0.75))[16:-16, 16:-16]
    assert np.abs(flow - (1.5, -0.75)).mean() < 0.1


def test_a_leaky_sum_adds_steps_that_fade():
    events = np.array([(1000, 1, 0, 1), (2000, 1, 0, 1), (3000, 3, 2, -1), (9000, 0, 0, 1)], EVENT_DTYPE)
    found = leaky_sum(events, (3, 5), 5000, (0.2, 0.3), leak_us=10_000)
    expected = np.zeros((3, 5))
    expected[0, 1], expected[2, 3] = 0.2 * (np.exp(-0.4) + np.exp(-0.3)), -0.3 * np.exp(-0.2)
    assert found == pytest.approx(expected)
    rng = np.random.default_rng(1)
    truth = rng.normal(0, 1, (20, 24))
    # scale and offset do not count; noise does: of variance 1 on 1, the fit leaves √(1 - ρ²) with ρ² = 1/2
    same = intensity_scores(7 * truth - 3, truth)
    assert same["log_rmse"] < 1e-9 and same["correlation"] == pytest.approx(1) and same["ssim"] == pytest.approx(1)
    noisy = intensity_scores(truth + rng.normal(0, 1, truth.shape), truth)
    assert noisy["log_rmse"] == pytest.approx(np.sqrt(0.5), abs=0.08) and noisy["ssim"] < 0.8
    # of what is finite in both, the residuals of a line and, over the truth's inner 99 %, SSIM
    picture = 2.5 * truth + 0.7 + rng.normal(0, 0.8, truth.shape)
    picture[3, 4], truth[7, 2] = np.nan, -np.inf
    some = np.isfinite(picture) & np.isfinite(truth)
    line = np.polyval(np.polyfit(picture[some], truth[some], 1), picture)
    low, high = np.quantile(truth[some], [0.005, 0.995])
    scores = intensity_scores(picture, truth)
    assert scores["log_rmse"] == pytest.approx(np.sqrt(np.mean((line - truth)[some] ** 2)), rel=1e-9)
    assert scores["correlation"] == pytest.approx(np.corrcoef(picture[some], truth[some])[0, 1])
    one, other = (np.where(some, (values - low) / (high - low), 0) for values in (line, truth))
    assert scores["ssim"] == pytest.approx(ssim(one, other))
    assert "ssim" not in intensity_scores(picture[:10], truth[:10])
    truth[7, 2] = 0.3
    flat = intensity_scores(np.zeros(truth.shape), truth)
    assert flat["log_rmse"] == pytest.approx(truth.std()) and np.isnan(flat["correlation"])


def test_a_merge_of_exposures_has_the_least_error_on_still_light():
    """Poisson electrons of a ramp over five decades, in exposures of 0.2, 2 and 20 ms; the longest one saturates.

    Standard deviation of 40,000 values each: 0.4 %.
    """
    sensor = hr.load_sensor("reference-mono").crop(200, 200)
    aps, mosaic = sensor.spec.aps, SimpleNamespace(black_level_dn=64, white_level_dn=4064)
    rng = np.random.default_rng(2)
    flux = np.geomspace(1e3, 1e8, 200)[None, :] * np.ones((200, 1))
    exposures = []
    for exposure_us in (200, 2000, 20_000):
        electrons = rng.poisson(flux * exposure_us * 1e-6) + rng.normal(0, aps.read_noise_e, flux.shape)
        raw = np.clip(np.rint(electrons * aps.system_gain_dn_per_e + 64), 0, 4064)
        exposures.append(flux_of(raw, exposure_us, aps, mosaic))
    merge = merged_exposures(exposures)
    valid = np.ones(flux.shape, bool)
    # where no exposure clips, the variance is the inverse of the sum of the inverse variances
    dim = flux < 5e5
    expected = 1 / sum(s**2 / (flux * s + aps.read_noise_e**2) for s in (2e-4, 2e-3, 2e-2))
    off = (merge - flux) / np.sqrt(expected)
    assert np.sqrt(np.mean(off[dim] ** 2)) < 1.15  # rounding to 5 e⁻
    bright = (flux > 2e6) & (flux < 8e7)
    assert np.abs(merge[bright] / flux[bright] - 1).mean() < 0.03  # the longest one would be far off here
    scores = {name: flux_scores(found, flux, valid) for name, found in (
        ("merge", merge), ("short", exposures[0].flux), ("long", exposures[-1].flux))}  # fmt: skip
    assert scores["merge"]["psnr_mu_db"] > max(scores[n]["psnr_mu_db"] for n in ("short", "long")) + 3
    assert scores["merge"]["log2_rmse"] < scores["short"]["log2_rmse"] < 2
    assert np.isnan(flux_scores(merge, flux * 0, valid)["psnr_mu_db"])


def test_flux_is_freed_of_the_dark_current_at_the_sensors_temperature():
    """200 e⁻/s at 20 °C double twice up to 34 °C: frames without light have no flux, and the scatter that is stated."""
    keys = {
        "aps.dark_current_e_per_s": 200.0, "aps.dark_current_doubling_c": 7.0, "aps.dark_current_reference_c": 20.0,
        "aps.temperature_c": 34.0, "aps.read_noise_e": 3.0, "aps.dsnu_e": 0.0,
    }  # fmt: skip
    sensor = hr.load_sensor("reference-mono", keys).crop(120, 70)
    aps = sensor.spec.aps
    mosaic = SimpleNamespace(black_level_dn=aps.black_level_dn, white_level_dn=2**aps.bit_depth - 1)
    for exposure_us in (20_000, 90_000):
        raw = sensor.aps.sample(np.zeros((70, 120), np.float32), exposure_us, 5, 0)
        found = flux_of(raw, exposure_us, aps, mosaic)
        seconds = exposure_us * 1e-6
        variance = (3.0**2 + 800 * seconds) / seconds**2
        assert abs(found.flux.mean()) < 5 * np.sqrt(variance * 1.3 / 8400)
        np.testing.assert_allclose(found.dark_variance, variance, rtol=1e-9)
        rounding = 1 / 12 / aps.system_gain_dn_per_e**2 / seconds**2
        assert found.flux.var() == pytest.approx(variance + rounding, rel=0.08)


def test_results_of_a_user_are_read_and_refused(tmp_path):
    folder = tmp_path / "deblur" / "clip"
    folder.mkdir(parents=True)
    np.save(folder / "000002.npy", np.full((3, 4), 7, np.uint16))
    np.save(folder / "000009.npy", np.zeros((3, 4)))
    found = Predictions(tmp_path, ["deblur"], ["clip"])
    assert found.read("deblur", "clip", 2, (3, 4)).tolist() == [[7.0] * 4] * 3
    assert found.read("deblur", "clip", 3, (3, 4)) is None and found.unused == ["deblur/clip/000009.npy"]
    with pytest.raises(SpecError, match=r"000009.npy: holds float64 \[3, 4\]; expected numbers \[4, 4\]"):
        found.read("deblur", "clip", 9, (4, 4))
    with pytest.raises(SpecError, match=r"'deblur' is no task.*did you mean 'deblurr'"):
        Predictions(tmp_path, ["deblurr"], ["clip"])
    with pytest.raises(SpecError, match="'clip' is no clip of these"):
        Predictions(tmp_path, ["deblur"], ["s0"])
    with pytest.raises(SpecError, match="expected TASK/CLIP"):
        Predictions(tmp_path / "deblur", ["deblur"], ["clip"])
    with pytest.raises(SpecError, match="no such folder"):
        Predictions(tmp_path / "none", ["deblur"], ["clip"])
