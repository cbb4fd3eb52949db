"""Lines, curves and spectra of EMVA 1288 captures: against polyfit, sums written out, and waves of known size."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law
from scipy.stats import f as f_law
from scipy.stats import gamma

from hesim_render.calibrate.aps import light_curve, noise_spectrum, pair_levels, pairs, spatial
from hesim_render.calibrate.aps.light_curve import require_steady_light
from hesim_render.calibrate.aps.pair_levels import Levels, SpatialStack, pair_statistics
from hesim_render.core.errors import SpecError
from hesim_render.recording import pair_set
from hesim_render.recording.pair_set import PairSet, Series

X = np.array([1.0, 2.5, 4.0, 7.0, 11.0])


def test_line_through_the_origin_with_unknown_errors_is_a_jackknife():
    """Slope by least squares; its error is that of leaving each point out, with the leverages of HC3."""
    y = 3 * X + np.array([0.2, -0.5, 0.4, 0.1, -0.6])
    found = light_curve.through_origin(X, y, None)
    slope = np.linalg.lstsq(X[:, None], y, rcond=None)[0][0]
    without = [np.delete(X, k) @ np.delete(y, k) / (np.delete(X, k) @ np.delete(X, k)) for k in range(X.size)]
    assert found.slope == pytest.approx(slope) and found.groups == 5 and np.isnan(found.chi2_per_dof)
    assert found.error == pytest.approx(np.sqrt(np.sum((np.array(without) - slope) ** 2)))


@pytest.mark.parametrize("size", [0.5, 4.0])
def test_line_through_the_origin_with_known_errors(size):
    """Its variance is xᵀ C x/(x·x)²; scatter that is too large for chance (1 %) counts as error."""
    own, shared = np.array([0.3, 0.5, 0.4, 0.8, 0.9]), 0.11
    covariance = np.diag(own**2) + shared
    y = 3 * X + size * np.array([0.2, -0.5, 0.4, 0.1, -0.6])
    found = light_curve.through_origin(X, y, covariance)
    chi2 = np.sum((y - found.slope * X) ** 2 / np.diag(covariance)) / 4
    error = np.sqrt(X @ covariance @ X) / (X @ X)
    is_far = chi2_law.sf(4 * chi2, 4) < 0.01
    assert is_far is np.bool_(size == 4.0)
    assert found.chi2_per_dof == pytest.approx(chi2) and found.groups is None
    assert found.error == pytest.approx(error * (np.sqrt(chi2) if is_far else 1))


@pytest.mark.parametrize("count", [6, 14])
def test_straight_lines_are_those_of_polyfit(count):
    """Errors are scaled by the scatter: from 8 degrees of freedom on always, below only where it is larger."""
    rng = np.random.default_rng(2)
    x, error = np.linspace(0.01, 0.4, count), rng.uniform(0.5, 2, count)
    y = 40 + 17 * x + 0.3 * error * rng.standard_normal(count)
    found = light_curve.straight(x, y, error)
    (slope, value), plain = np.polyfit(x, y, 1, w=1 / error, cov="unscaled")
    residual = y - value - slope * x
    scale = np.sum((residual / error) ** 2) / (count - 2)
    assert scale < 0.5
    plain = plain * (scale if count >= 10 else 1)
    assert (found.value, found.slope) == pytest.approx((value, slope))
    assert (found.error, found.slope_error) == pytest.approx((np.sqrt(plain[1, 1]), np.sqrt(plain[0, 0])))
    assert found.rms == pytest.approx(np.sqrt(np.sum(residual**2) / (count - 2))) and found.groups == count - 1
    at = np.array([0.0, 0.3, 0.9])
    wanted = np.sqrt(plain[1, 1] + 2 * at * plain[0, 1] + at**2 * plain[0, 0])
    np.testing.assert_allclose(found.error_at(at), wanted)
    one = light_curve.straight(np.full(count, 0.2), y, error)
    weight = 1 / error**2
    assert one.value == pytest.approx(np.average(y, weights=weight)) and np.isnan(one.slope_error)
    assert one.groups == count and one.error_at(at) == pytest.approx(np.full(3, one.error))
    scale = np.sum(weight * (y - one.value) ** 2) / (count - 1)
    assert one.error == pytest.approx(np.sqrt((scale if count >= 9 else max(scale, 1)) / weight.sum()))


def test_linearity_is_judged_from_5_to_95_per_cent_of_saturation():
    """The line is weighted by 1/y², with an offset; levels at both bounds count."""
    light = np.array([9.0, 10, 30, 60, 110, 190, 191])
    signal = np.array([4.9, 5.0, 14.8, 30.4, 55.0, 95.0, 95.1])
    used, found = light_curve.linearity_error(light, signal, 100.0)
    assert used.tolist() == [False, True, True, True, True, True, False]
    slope, value = np.polyfit(light[used], signal[used], 1, w=1 / signal[used])
    np.testing.assert_allclose(found, 100 * (signal[used] / (value + slope * light[used]) - 1), rtol=1e-6)
    assert light_curve.linearity_error(light[:3], signal[:3], 100.0)[1].size == 0


def test_the_mean_curve_has_its_terms_in_units_of_light():
    """A bend and an offset far beyond the errors are found in photons; f(E) gives the same curve."""
    light = np.linspace(50, 4000, 24)
    error = np.full(24, 0.02)
    terms, offset = np.array([0.22, -4e-6, 0.0]), 31.0
    shifted = light + offset
    signal = shifted * (terms[0] + terms[1] * shifted) + 0.02 * np.random.default_rng(4).standard_normal(24)
    found = light_curve.mean_curve(light, signal, error)
    assert found.bends and found.terms[2] == 0
    spread = np.sqrt(np.diag(found.covariance))
    assert np.all(spread[:3] > 0) and spread[3] == 0 and found.offset_error == spread[0]
    assert abs(found.offset - offset) < 4 * spread[0] and spread[0] < 1.0
    assert np.all(np.abs(found.terms - terms)[:2] < 4 * spread[1:3]) and spread[2] < 1e-7
    np.testing.assert_allclose(found.at(light), signal, atol=0.1)
    gradient = np.stack([found.terms[0] + 2 * found.terms[1] * (light + found.offset), light + found.offset,
                         (light + found.offset) ** 2, (light + found.offset) ** 3])  # fmt: skip
    np.testing.assert_allclose(found.error(light), np.sqrt(np.diag(gradient.T @ found.covariance @ gradient)))
    n = found.nonlinearity(0.21, 1023)
    electrons = 0.21 * (np.array([500.0, 3000.0]) + found.offset)
    u = electrons / 1023
    np.testing.assert_allclose(electrons * (1 + n[0] + n[1] * u + n[2] * u**2), found.at(np.array([500.0, 3000.0])))
    # light that scatters by 0.3 % in its brighter half
    rough = signal * (1 + 3e-3 * np.where(np.arange(24) % 2 == 0, 1, -1))
    assert light_curve.mean_curve(light, rough, error).light_rms == pytest.approx(3e-3, rel=0.2)


@pytest.mark.parametrize("power", [2, 3])
@pytest.mark.parametrize("part", [0.5, 2.0])
def test_a_bend_counts_where_the_f_test_finds_it(power, part):
    """A bend whose chance is half the level of the test, or twice as large, and scatter that no other term tells."""
    light = np.linspace(20, 900, 9)
    h = light / light.max()
    basis = np.linalg.qr(np.stack([h, h**power, h**0, h ** (5 - power)], axis=1), mode="complete")[0]
    bend, rest = basis[:, 1], basis[:, 4:] @ [0.5, -0.3, 0.7, 0.2, -0.6]
    f = f_law.isf(part * light_curve.ALARM, 1, 7)
    signal = 40 * h + bend * np.sqrt(f * rest @ rest / 7) + rest
    found = light_curve.mean_curve(light, signal, np.full(9, 8.0))
    assert (found.terms[power - 1] != 0) == (part < 1)
    assert found.terms[3 - power + 1] == 0 and found.offset == 0


def test_a_long_series_is_read_as_a_stack_of_one_exposure():
    told = []
    series = SimpleNamespace(where="list", files=["a", "b", "c"], exposure_s=0.0123457)
    set_of_pairs = SimpleNamespace(shape=(2, 5), frames=lambda one: iter(one.files))
    stack = SpatialStack(set_of_pairs, series, lambda what, part: told.append(part))
    assert list(stack) == ["a", "b", "c"] and told == pytest.approx([1 / 3, 2 / 3, 1])
    assert stack.shape == (1, 3, 2, 5) and stack.exposures_us.tolist() == [12346]


@pytest.mark.parametrize(("saturation", "top"), [(1, 20.0), (3, 45.0)])
def test_the_signal_at_saturation_is_that_of_its_level_or_the_last(saturation, top):
    result = SimpleNamespace(signal=np.array([7.0, 20.0, 45.0]), saturation=saturation)
    assert pairs.PairCalibration.top_dn.fget(result) == top
    result.lit, result.black = SimpleNamespace(mean=np.array([30.0, 71.0, 64.0])), SimpleNamespace(value=9.5)
    assert pairs.PairCalibration.brightest_dn.fget(result) == 61.5


def test_statistics_of_a_pair_are_those_of_its_definition():
    """Half the mean square of what rows, columns and frames do not share, with its degrees of freedom; both ends."""
    rng = np.random.default_rng(3)
    first, second = (
        np.clip(np.rint(30 + 9 * rng.standard_normal((7, 11)) + 6 * rng.standard_normal((7, 1))), 0, 63).astype(
            np.uint16
        )
        for _ in range(2)
    )
    first[2, 3], second[2, 3], first[4, 4], second[0, 0] = 0, 0, 63, 63
    mean, change, variance, error, row, row_error, col, col_error, squares, low, high = pair_statistics(
        first, second, 63
    )
    difference = first.astype(float) - second
    assert mean == pytest.approx((first.mean() + second.mean()) / 2) and change == pytest.approx(difference.mean())
    by_row, by_col = difference.mean(axis=1) - change, difference.mean(axis=0) - change
    rest = difference - change - by_row[:, None] - by_col
    assert variance == pytest.approx(np.sum(rest**2) / (2 * 6 * 10), rel=1e-5)
    of_rows = np.sum(rest**2, axis=1) / (2 * 11 * (6 / 7) * (10 / 11))
    assert error == pytest.approx(of_rows.std(ddof=1) / np.sqrt(7), rel=1e-5)
    for found, sure, means, across in ((row, row_error, by_row, 11), (col, col_error, by_col, 7)):
        whole = np.sum(means**2) / (2 * (means.size - 1))
        assert found == pytest.approx(whole - variance / across, rel=1e-5)
        assert sure == pytest.approx(whole * np.sqrt(2 / (means.size - 1)), rel=1e-5)
    assert squares == pytest.approx(np.mean(rest**4) / (2 * (6 / 7) * (10 / 11)) ** 2, rel=1e-5)
    ends = [np.mean((first == v) | (second == v)) for v in (0, 63)]
    assert (low, high) == pytest.approx(ends) and ends[0] > 0 and ends[1] >= 2 / 77


def test_levels_are_clear_up_to_one_pixel_in_ten_thousand():
    low, high = np.array([1e-4, 1.1e-4, 0, 0]), np.array([0, 0, 1e-4, 1.1e-4])
    none = np.zeros(4)
    assert Levels(*[none] * 11, low, high).clear.tolist() == [True, False, True, False]


def test_the_least_variance_has_what_rows_and_columns_share():
    one = Levels(*[np.zeros(2)] * 13)
    one = replace(one, variance=np.array([0.21, 0.19]), row=np.array([-0.02, 0.04]), col=np.array([0.05, 0.01]))
    assert one.least_variance == pytest.approx(0.24)


@pytest.mark.parametrize("code", [31, 37])
def test_a_grey_value_that_no_frame_has_is_named(code):
    """Three levels about 30, 36 and 42 with a noise of 1.7: the value that is moved to the next one is missing; those
    that only the last frames lack, or no frame reaches, are not.
    """
    rng = np.random.default_rng(8)
    frames = {}
    for level in (30.0, 36.0, 42.0):
        two = np.rint(level + 1.7 * rng.standard_normal((2, 60, 71))).astype(np.uint16)
        two[two == code] = code + 1
        frames[level] = two
    frames[42.0][frames[42.0] == 43] = 42
    series = tuple(Series(True, level, None, (), Path(), None) for level in frames)
    given = SimpleNamespace(spec=SimpleNamespace(full_scale_dn=255), frames=lambda one: iter(frames[one.exposure_s]))
    found = pair_levels.pair_levels(given, series)
    # 43 is one step from the brightest level, and the other frames have next to none
    assert found.missing == (code, 43)
    frames[36.0][0, 0, :2] = 43
    assert pair_levels.pair_levels(given, series).missing == (code,)


@pytest.mark.parametrize(("row", "col", "cols"), [(3, 5, 32), (0.5, 0.5, 32), (21, 7, 33), (10, 0.5, 32)])
def test_interference_is_found_at_its_frequency_and_size(row, col, cols):
    """A sine of 0.8 DN rms with a phase of its own in each of 40 frames, over white noise of 1.3 DN."""
    rng, rows, frames = np.random.default_rng(7), 24, 40
    cycles = row if row == 0.5 else row / rows, col if col == 0.5 else col / cols
    at_row, at_col = np.mgrid[:rows, :cols]
    stack = 1.3 * rng.standard_normal((frames, rows, cols))
    for k, phase in enumerate(rng.uniform(0, 2 * np.pi, frames)):
        stack[k] += 0.8 * np.sqrt(2) * np.cos(2 * np.pi * (cycles[0] * at_row + cycles[1] * at_col) + phase)

    class Stack(list):
        shape = (1, frames, rows, cols)

    found = noise_spectrum.noise_spectrum(Stack(stack), stack.mean(axis=0))
    (line,) = found.lines
    folded = cycles[0] - 1 if cycles[0] > 0.5 else cycles[0]
    assert (abs(line.cycles_per_row) if col == 0.5 else line.cycles_per_row, line.cycles_per_col) == pytest.approx(
        (abs(folded), cycles[1]) if col == 0.5 else (folded, cycles[1])
    )
    # a phase that is alone on its frequency makes cos² of the power: it scatters by √(1/2/40)
    assert line.rms_dn == pytest.approx(0.8, rel=0.25 if row == 0.5 else 0.05)
    parts = 1 if row == 0.5 else 2
    assert line.power((rows, cols)) == pytest.approx(line.rms_dn**2 * rows * cols / parts)
    assert found.correlation_error == pytest.approx(1 / np.sqrt(39 * rows * cols))
    assert abs(found.correlation) < 4 * found.correlation_error and not found.correlated


@pytest.mark.parametrize("cols", [31, 32])
def test_correlation_of_neighbours_is_that_of_a_filter(cols):
    """x + a x', of the pixel before: correlation a/(1 + a²), whatever rows share."""
    rng, a, frames = np.random.default_rng(9), -0.07, 60
    white = rng.standard_normal((frames, 40, cols + 1))
    stack = white[:, :, 1:] + a * white[:, :, :-1] + 3 * rng.standard_normal((frames, 40, 1))

    class Stack(list):
        shape = (1, frames, 40, cols)

    found = noise_spectrum.noise_spectrum(Stack(stack), stack.mean(axis=0))
    assert found.correlation == pytest.approx(a / (1 + a * a), abs=5 * found.correlation_error)
    assert found.correlated and found.lines == []


@pytest.mark.parametrize("frames", [4, 60])
def test_a_filter_of_the_read_out_makes_no_lines_and_hides_none(frames):
    """Noise behind filters along rows, along columns and across has the power |H|² and a gamma law about it: no line in
    it, 1 % of false alarms. A sine of 0.9 DN where |H|² is lowest is one, and nothing else is.
    """
    rng, rows, cols = np.random.default_rng(4), 48, 70
    white = 1.7 * rng.standard_normal((frames, rows, cols))
    row, col = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)
    turn = np.exp(-2j * np.pi * row), np.exp(-2j * np.pi * col)
    response = (1 + 0.6 * turn[1]) * (1 + 0.3 * turn[0]) * (1 + 0.2 * turn[0] * turn[1])
    stack = np.fft.irfft2(np.fft.rfft2(white) * response, s=(rows, cols))
    power = 1.7**2 * np.abs(response) ** 2
    assert power.max() > 20 * power.min()

    class Stack(list):
        shape = (1, frames, rows, cols)

    assert noise_spectrum.noise_spectrum(Stack(stack), stack.mean(axis=0)).lines == []
    at_row, at_col = np.mgrid[:rows, :cols]
    for k, phase in enumerate(rng.uniform(0, 2 * np.pi, frames)):
        stack[k] += 0.9 * np.sqrt(2) * np.cos(2 * np.pi * (21 / rows * at_row + 31 / cols * at_col) + phase)
    (line,) = noise_spectrum.noise_spectrum(Stack(stack), stack.mean(axis=0)).lines
    assert (line.cycles_per_row, line.cycles_per_col) == pytest.approx((21 / rows, 31 / cols))
    # the frames' mean takes part of it, and noise of the same frequency beats with it
    beat = np.sqrt(2 * power[21, 31] / (0.9**2 * rows * cols / 2) / frames)
    assert line.rms_dn == pytest.approx(0.9, rel=4 * beat + 1 / frames)


def test_temporal_variances_of_a_series_are_unbiased():
    """600 series of 5 frames: pixels 4, rows 2.2, columns 0.8, whole frames 1.3 DN²; the errors of rows and columns are
    their scatter."""
    rng, frames, rows, cols = np.random.default_rng(11), 5, 8, 13
    found, errors = [], []
    for _ in range(600):
        stack = 2 * rng.standard_normal((frames, rows, cols)) + np.sqrt(2.2) * rng.standard_normal((frames, rows, 1))
        stack += np.sqrt(1.3) * rng.standard_normal((frames, 1, 1)) + rng.standard_normal((rows, cols))
        stack += np.sqrt(0.8) * rng.standard_normal((frames, 1, cols))
        moments = SimpleNamespace(
            variance=stack.var(axis=0, ddof=1)[None], frames=frames, row_means=stack.mean(axis=2)[None],
            col_means=stack.mean(axis=1)[None],
        )  # fmt: skip
        temporal, levels = spatial.temporal_of(moments)
        np.testing.assert_allclose(levels, stack.mean(axis=(1, 2)))
        found.append((temporal.pixel, temporal.row, temporal.col, temporal.frame))
        errors.append((temporal.row_error, temporal.col_error))
    found = np.array(found)
    sure = found.std(axis=0, ddof=1) / np.sqrt(600)
    assert np.all(np.abs(found.mean(axis=0) - (4, 2.2, 0.8, 1.3)) < 3.5 * sure)
    expected = found[:, 1:3].std(axis=0, ddof=1)
    assert np.sqrt(np.mean(np.square(errors), axis=0)) == pytest.approx(expected, rel=0.1)


def test_spatial_variances_are_those_of_means_less_noise_and_pixels():
    rng, rows, cols, frames = np.random.default_rng(12), 9, 14, 6
    image = rng.standard_normal((rows, cols)) + 2 * rng.standard_normal((rows, 1)) + 1.5 * rng.standard_normal(cols)
    temporal = spatial.Temporal(1.9, 0.7, 0.4, 0.2, 0.0, 0.0)
    found = spatial.spatial_variance(image, temporal, frames)
    by_row, by_col = image.mean(axis=1), image.mean(axis=0)
    rest = image - by_row[:, None] - by_col + image.mean()
    pixel = np.sum(rest**2) / (8 * 13) - 1.9 / 6
    assert found.pixel == pytest.approx(pixel)
    assert found.row == pytest.approx(by_row.var(ddof=1) - pixel / cols - 1.9 / 6 / cols - 0.7 / 6)
    assert found.col == pytest.approx(by_col.var(ddof=1) - pixel / rows - 1.9 / 6 / rows - 0.4 / 6)
    assert found.noise == pytest.approx((1.9 / 6 / cols + 0.7 / 6, 1.9 / 6 / rows + 0.4 / 6, 1.9 / 6))
    assert found.freedom == (8, 13, 104) and found.total == pytest.approx(found.row + found.col + found.pixel)


def test_outliers_lie_eight_deviations_from_what_is_around_them():
    """Rows and columns are no outliers; the spread is that of most pixels, or the noise if that is more."""
    row, col = np.mgrid[:60, :80]
    image = np.random.default_rng(13).standard_normal((60, 80)) + 5.0 * (row % 9) + 3.0 * (col % 4)
    image[20, 30] += 11.0
    image[41, 7] -= 11.0
    image[50, 60] += 5.5
    assert np.argwhere(spatial.outliers(image, (0.0, 0.0, 0.5))).tolist() == [[20, 30], [41, 7]]
    assert not spatial.outliers(image, (0.0, 0.0, 3.0)).any()  # 8 · 1.73 is more than 11 and a deviation


def test_only_frequencies_that_stand_out_of_an_image_are_its_waves():
    """Pixels with a spread of 2 DN, far more than the noise of their mean, are no wave; a sine of 1.1 DN is one, less
    what noise adds to its power."""
    rng, (rows, cols), noise = np.random.default_rng(6), (60, 88), 0.09
    pixels = 2 * rng.standard_normal((rows, cols))
    pixels += pixels.mean() - pixels.mean(axis=0) - pixels.mean(axis=1, keepdims=True)
    np.testing.assert_array_equal(spatial._waves(pixels, noise, None, 12), 0)
    at_row, at_col = np.mgrid[:rows, :cols]
    sine = 1.1 * np.cos(2 * np.pi * (7 / rows * at_row + 13 / cols * at_col) + 0.4)
    found = spatial._waves(pixels + sine, noise, None, 12)
    share = np.fft.rfft2(pixels + sine)[7, 13]
    power = np.abs(share) ** 2 / (rows * cols)
    wanted = np.zeros((rows, cols // 2 + 1), complex)
    wanted[7, 13] = share * np.sqrt(1 - noise / power)
    np.testing.assert_allclose(found, np.fft.irfft2(wanted, (rows, cols)), atol=1e-9)
    assert np.corrcoef(found.ravel(), sine.ravel())[0, 1] > 0.99
    # interference of that size at that frequency is noise of the mean of 12 frames: what is left of it is no wave
    hum = noise_spectrum.InterferenceLine(7 / rows, 13 / cols, 1.1 / np.sqrt(2) * np.sqrt(12))
    np.testing.assert_array_equal(spatial._waves(pixels + sine, noise, SimpleNamespace(lines=[hum]), 12), 0)


def test_a_line_at_one_place_is_a_weighted_mean_without_a_slope():
    y, error = np.array([3.0, 5.0, 8.0]), np.array([0.1, 0.2, 0.4])
    found = light_curve.straight(np.full(3, 7.0), y, error)
    weight = 1 / error**2
    mean = np.average(y, weights=weight)
    scale = light_curve._scale(float(np.sum(weight * (y - mean) ** 2)) / 2, 2)
    assert (found.value, found.error) == pytest.approx((mean, np.sqrt(scale / weight.sum())))
    assert found.slope == 0 and np.isnan(found.slope_error) and found.groups == 3
    assert found.rms == pytest.approx(np.sqrt(np.sum((y - mean) ** 2) / 2))
    np.testing.assert_allclose(found.error_at(np.array([2.0, 90.0])), found.error)
    x = np.array([1.0, 2.0, 4.0])
    line = light_curve.straight(x, y, error)
    np.testing.assert_allclose([line.slope, line.value], np.polyfit(x, y, 1, w=1 / error))
    assert line.error_at(np.zeros(1))[0] == pytest.approx(line.error) and line.groups == 2


def test_the_spectrum_of_frames_has_one_degree_of_freedom_less_than_frames(monkeypatch):
    """Three frames: power over two, a floor of two, and lines beyond the gamma law of two; by a plain transform."""
    stack = np.random.default_rng(5).normal(0, 2.0, (3, 20, 27)) + 100
    asked = []

    def floor(inside, shape, frames, highest):
        asked.append((inside, shape, frames, highest))
        return np.full(inside.shape, 4.0)

    class Stack(list):
        shape = (1, 3, 20, 27)

    monkeypatch.setattr(noise_spectrum, "_floor", floor)
    found = noise_spectrum.noise_spectrum(Stack(stack), stack.mean(axis=0))
    ((inside, shape, frames, highest),) = asked
    power = np.sum(np.abs(np.fft.fft2(stack - stack.mean(axis=0))) ** 2, axis=0) / (2 * 20 * 27)
    np.testing.assert_allclose(inside, power[1:, 1:14])
    assert shape == (20, 27) and frames == 2 and highest == pytest.approx(gamma.isf(1e-4 / (19 * 13), 2) / 2)
    assert found.lines == [] and found.correlation_error == pytest.approx(1 / np.sqrt(2 * 20 * 27))
    turn = np.cos(2 * np.pi * np.arange(1, 14) / 27)
    assert found.correlation == pytest.approx(np.sum(inside * turn) / inside.sum() + 1 / 26)


@pytest.mark.parametrize(("level", "off", "is_clear", "is_refused"), [
    (0.5, 1.021, True, True), (0.5, 0.979, True, True), (0.5, 1.019, True, False), (0.5, 1.021, False, False),
    (0.021, 1.021, True, True), (0.019, 1.021, True, False),
])  # fmt: skip
def test_light_that_is_off_by_two_percent_is_refused(level, off, is_clear, is_refused):
    """From a fiftieth of the largest signal on, and only of levels that are clear of saturation."""
    light = np.array([level, 1.0])
    signal, clear = light * [off, 1.0], np.array([is_clear, True])
    errors = [SimpleNamespace(error=lambda text, k=k: SpecError(f"{k}: {text}")) for k in range(2)]
    curve, pairs = SimpleNamespace(at=lambda light: light), SimpleNamespace(lit=errors)
    if not is_refused:
        require_steady_light(pairs, curve, light, signal, clear)
        return
    with pytest.raises(SpecError, match=r"^0: the light drifts between exposures: this pair is 2\.1 % off"):
        require_steady_light(pairs, curve, light, signal, clear)


def test_noise_told_by_grey_values_joins_the_fit_as_a_measurement(monkeypatch):
    """β₀ + t β₂ = σ² less what rows and columns share: the sum of both informations, written out."""
    monkeypatch.setattr(pairs, "replace", lambda fit, **changed: SimpleNamespace(**changed))
    root = np.random.default_rng(3).standard_normal((6, 6)) * [0.3, 0.02, 0.9, 0.01, 0.02, 0.03]
    fit = SimpleNamespace(
        beta=np.array([0.3, 0.2, 1.1, 0.01, 0.0, 0.02]), covariance=root.T @ root, identified=np.ones(6, bool)
    )
    result = SimpleNamespace(
        fit=fit, rounded_noise=SimpleNamespace(value=0.61, low=0.57, high=0.66), row=(0.03, 0.021), col=(-0.02, 0.034),
        pairs=SimpleNamespace(spatial_dark=SimpleNamespace(exposure_s=0.23)),
    )  # fmt: skip
    found = pairs._with_dark_noise(result)
    line = np.array([1, 0, 0.23, 0, 0, 0])
    own = (2 * 0.61 * (0.66 - 0.57) / (2 * 1.959964)) ** 2 + 0.021**2 + 0.034**2
    known = np.linalg.inv(fit.covariance)
    covariance = np.linalg.inv(known + np.outer(line, line) / own)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(
        found.beta, covariance @ (known @ fit.beta + line * (0.61**2 - 0.03) / own), rtol=1e-5, atol=1e-9
    )
    assert pairs._with_dark_noise(SimpleNamespace(fit=fit, rounded_noise=None)) is fit


@pytest.mark.parametrize(
    ("frame", "bits"),
    [
        ([[16, 4080], [16 * 4095, 48]], 4),  # 12 bits at the left of 16
        ([[16, 4081], [16 * 4095, 48]], 0),  # one pixel that is not: too large for its bits, see the test of mistakes
        ([[16, 4080], [2048, 48]], 0),  # as large as 12 bits are
    ],
)
def test_values_are_to_the_left_where_no_pixel_has_a_bit_below(frame, bits, monkeypatch):
    """The ADC's 12 bits lie at either end of 16, and the brightest frame tells at which."""
    monkeypatch.setattr(pair_set, "read_grey", lambda file, shape: np.array(frame, np.uint16))
    given = SimpleNamespace(
        spec=SimpleNamespace(bit_depth=12, full_scale_dn=4095), shape=(1, 1), tile=(2, 2),
        lit=[SimpleNamespace(files=["a"])],
    )  # fmt: skip
    assert PairSet._left_bits.func(given) == bits
