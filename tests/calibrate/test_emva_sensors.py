"""EMVA 1288 captures of sensors of many properties: hot pixels, column noise, few bits, light that drifts."""

import re
from types import SimpleNamespace

import emva_camera
import numpy as np
import pytest

from hesim_render.calibrate.aps import pair_levels
from hesim_render.calibrate.aps.pairs import _relative, evaluate
from hesim_render.calibrate.aps.pairs_findings import findings
from hesim_render.calibrate.aps.pairs_output import calibrate_pairs, content
from hesim_render.calibrate.aps.sensor_file import write_sensor
from hesim_render.calibrate.aps.spatial import Temporal, outliers, pattern_of, spatial_variance
from hesim_render.sensor.sensor import load_sensor

CAMERA = emva_camera.Camera()


def test_hot_pixels_are_in_no_profile_of_their_rows_and_columns():
    """Pixels of +500 DN move the mean of a column by 4 DN; the others, of as much noise as pattern, do not."""
    rng, (rows, cols) = np.random.default_rng(11), (120, 90)
    own = 0.8 * rng.standard_normal(cols) + 0.3 * rng.standard_normal((rows, cols))
    hot = rng.integers(0, rows * cols, 40)
    own.flat[hot] += 500.0
    noise = 0.09
    image = own + np.sqrt(noise) * rng.standard_normal((rows, cols))
    found = pattern_of(image, (noise / cols, noise / rows, noise))
    assert abs(found.whole.mean()) < 1e-4
    deviation = found.whole - own
    deviation -= deviation.mean()
    # noise of a column's mean is 0.03 DN; by means over all pixels 1 DN
    assert deviation.mean(axis=0).std() < 0.04 and deviation.mean(axis=1).std() < 0.04
    assert np.flatnonzero(outliers(image, (noise / cols, noise / rows, noise))).tolist() == sorted(set(hot.tolist()))


def test_stuck_pixels_are_defects_and_not_saturation():
    """Six white pixels and a dead row, a 40th of the frame: the figures are those of the others."""
    camera = CAMERA.but(rows=40, white=6, dead_row=7)
    result = evaluate(emva_camera.in_memory(camera, 12))
    found = content(result)
    assert abs(found["K"]["value"] / camera.gain - 1) < 0.02
    assert result.clear.sum() >= 15 and found["bad_pixels"] >= 6 + camera.cols
    (named,) = [f["text"] for f in found["findings"] if f["check"] == "stuck pixels"]
    assert re.match(r"[56] pixels are at full scale in the dark, 5[12] at 0 DN in the light", named)


@pytest.mark.parametrize("lag", (0.0, 0.02))
def test_light_that_stays_for_the_next_frame_is_named(lag):
    """Lit and dark pairs in turn: the first in the dark has up to 100 DN of the light before; no values lack."""
    camera = CAMERA.but(rows=64, cols=90, lag=lag, row_noise=0.0)
    found = content(evaluate(emva_camera.in_memory(camera, 14)))
    named = [f["text"] for f in found["findings"] if f["check"] == "image lag"]
    assert len(named) == (lag > 0) and all(re.match(r"the first dark frame of a pair is \d+ DN bri", n) for n in named)
    assert found["K"]["value"] == pytest.approx(camera.gain, rel=0.03)


def test_pixels_are_cut_off_where_the_brightest_level_is(tmp_path):
    """EMVA's saturation is a level that the full well leaves whole; pixels of the sensor file end above it."""
    camera = CAMERA.but(full_well=7100.0, prnu=(0.001, 0.001, 0.004))
    result = calibrate_pairs(emva_camera.in_memory(camera, 13), tmp_path / "c.yaml")
    well = content(result)["full_well_e"]
    assert well["limited_by"] == "full well" and well["value"] < 0.98 * 7100
    # K is known to 2 %
    assert well["cut_off_e"] == pytest.approx(7100, rel=0.03)
    sensor = load_sensor(write_sensor(tmp_path / "s.yaml", tmp_path / "c.yaml", result))
    assert sensor.spec.aps.full_well_e == pytest.approx(well["cut_off_e"])


def test_hot_pixels_do_not_widen_the_range_of_grey_values_that_are_expected():
    """Three in a thousand pixels, up to 700 DN: the others spread over a few DN, all of which occur."""
    rng = np.random.default_rng(5)
    first, second = np.rint(60 + 1.4 * rng.standard_normal((2, 96, 128))).astype(np.uint16)
    for frame in (first, second):
        frame.flat[:36] = np.linspace(100, 700, 36)
    absent, expected = pair_levels._gaps(first, second, 4095)
    assert absent == 0 and expected == pytest.approx(5, abs=1)
    # two read-outs at 60 and 90 DN have one gap, between them
    for frame in (first, second):
        frame[:, 64:] += 30
    absent, expected = pair_levels._gaps(first, second, 4095)
    assert absent == 0 and expected > 30
    absent, expected = pair_levels._gaps(6 * (first // 6), 6 * (second // 6), 4095)
    assert absent > 0.7 * expected


def test_the_error_of_a_spatial_variance_follows_the_noise_of_each_pixel():
    """800 mean images of a device with hot pixels, whose noise is a hundred times that of the others."""
    rng, (rows, cols), frames = np.random.default_rng(8), (31, 22), 9
    own, noise = rng.standard_normal((rows, cols)), np.full((rows, cols), 3.0)
    own[rng.integers(0, rows, 5), rng.integers(0, cols, 5)] += 40.0
    noise[own > 20] = 300.0
    values, errors = [], []
    for _ in range(800):
        image = own + np.sqrt(noise / frames) * rng.standard_normal((rows, cols))
        variance = noise * rng.chisquare(frames - 1, noise.shape) / (frames - 1)
        temporal = Temporal(float(variance.mean()), 0.0, 0.0, 0.0, 0.0, 0.0)
        found = spatial_variance(image, temporal, frames, variance)
        values.append(found.pixel)
        errors.append(found.errors(fixed=True)[2])
    # five pixels decide: 800 draws tell a standard deviation to 3 %
    assert np.std(values, ddof=1) == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.12)


def test_dark_and_light_pattern_together_have_the_variance_of_the_lit_one():
    """The noise of the dark mean is in both, with opposite signs, and must not cancel itself: 15 % would be lacking.

    40 devices, whose mean variance scatters by 0.5 %; few frames, and much noise in the dark.
    """
    rng, (rows, cols), level, frames = np.random.default_rng(10), (60, 84), 100.0, 4
    line = SimpleNamespace(at=lambda x: np.asarray(x), gradient=lambda x: np.ones((1, np.size(x))), offset=0.0)
    made, true = [], []
    for _ in range(40):
        dark, light = 0.9 * rng.standard_normal((rows, cols)), 0.012 * rng.standard_normal((rows, cols))
        images = 40 + dark, 40 + dark + level * (1 + light)
        series = []
        for image, variance in zip(images, (2.9, 0.4), strict=True):
            mean = image + np.sqrt(variance / frames) * rng.standard_normal((rows, cols))
            spatial = spatial_variance(mean, Temporal(variance, 0.0, 0.0, 0.0, 0.0, 0.0), frames)
            series.append(SimpleNamespace(mean=mean, spatial=spatial, spectrum=None, frames=frames))
        relative, noise = _relative(series[1], series[0], line, np.array([1.0, 200.0]))
        pattern = pattern_of(series[0].mean, series[0].spatial.noise).whole + level * pattern_of(relative, noise).whole
        made.append(pattern.var())
        true.append((dark + level * light).var())
    assert np.mean(made) == pytest.approx(np.mean(true), rel=0.02)


@pytest.mark.parametrize("factor", (0.994, 1.006))
def test_a_long_series_in_other_light_than_the_pairs_is_named(factor):
    """0.6 % more or less, as of a lamp that drifts; in the same light nothing is said."""
    pairs = emva_camera.in_memory(CAMERA, 3)
    brighter = CAMERA.but(photons_per_us=factor * CAMERA.photons_per_us)
    long = {lit: brighter.bench(3)(lit, CAMERA.long_us, CAMERA.long_frames) for lit in (True, False)}

    class Changed(type(pairs)):
        def frames(self, series):
            return iter(long[series.lit]) if len(series.files) > 2 else pairs.frames(series)

    def named(captures):
        return [f for f in findings(evaluate(captures)) if f.check == "light of the long series"]

    assert named(pairs) == []
    (found,) = named(Changed(**{name: getattr(pairs, name) for name in type(pairs).__dataclass_fields__}))
    assert re.search(f"the long series has 0.[567]\\d? % {'more' if factor > 1 else 'less'} light", found.text)


def test_dark_variances_just_above_the_limit_of_the_standard_are_fitted():
    """8 bit, 0.25 to 0.29 DN² in the dark as measured: the polynomial of the variance has them, in place of what the
    lit levels alone tell of its constant."""
    camera = CAMERA.but(
        rows=96, cols=128, bits=8, gain=0.05, black=8.3, read_noise=8.3, row_noise=0.0, dark_current=1500.0,
        exposures_us=tuple(float(t) for t in np.linspace(60, 9000, 18).round()), long_us=4000.0,
    )  # fmt: skip
    result = evaluate(emva_camera.in_memory(camera, 5))
    assert 0.24 < result.dark.variance.min() < 0.27 < result.dark.variance.max() < 0.323
    # rounding of values that spread over less than a step changes a variance by 2 % at most
    assert result.fit.beta[0] == pytest.approx((0.05 * 8.3) ** 2, rel=0.04)
    assert np.sqrt(result.fit.covariance[0, 0]) < 0.015 * result.fit.beta[0]


@pytest.mark.parametrize("rms", (0.0, 0.12))
def test_a_dark_level_that_changes_is_named_and_the_noise_of_small_frames_is_not(rms):
    """Pixels of 2 DN move the mean of a pair of 24 by 30 by 0.05 DN; a level that scatters by 0.12 DN is named."""
    camera = CAMERA.but(rows=24, cols=30, gain=0.2, read_noise=10.0, row_noise=0.0, dark_current=20.0)
    pairs, rng = emva_camera.in_memory(camera, 9), np.random.default_rng(9)
    moved = {series: 1 + round(20 * rms * rng.standard_normal()) for series in pairs.dark}

    class Changed(type(pairs)):
        def frames(self, series):
            """A level moves by its share of the pixels, a grey value each."""
            count = moved.get(series, 0) * camera.rows * camera.cols // 20
            for frame in pairs.frames(series):
                frame = frame.copy()
                frame.flat[: abs(count)] += np.uint16(1) if count > 0 else np.uint16(65535)
                yield frame

    changed = Changed(**{name: getattr(pairs, name) for name in type(pairs).__dataclass_fields__})
    found = [f.text for f in findings(evaluate(changed if rms else pairs)) if f.check == "black level"]
    assert len(found) == (rms > 0)
    if rms:
        assert 0.07 < float(re.search(r"changes by ([\d.]+) DN", found[0])[1]) < 0.18
