"""The formulas of the statistical model, in NumPy and in Dr.Jit, against closed forms written out here.

The package has each formula once; the second copy is this one.
"""

import itertools
import json
import subprocess
import sys
from types import SimpleNamespace

import capture_sets
import numpy as np
import pytest
from scipy import integrate, stats

from hesim_render.calibrate import read_calibration
from hesim_render.core.backend import jit
from hesim_render.core.device_types import NUMPY, device_namespace
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.aps import formulas as aps
from hesim_render.pixels.evs import formulas as evs

BETA = (3.5, 0.21, 40.0, -3e-5, 1.5, 120.0)
EVENT_BETA = (0.8, 3.0, 0.1, 0.05, -0.3)
ELECTRONS = np.array([0.0, 0.3, 4.0, 77.0, 900.0, 4200.0])


def on_host(values):
    return np.asarray(values, dtype=np.float64)


#: Array library, how it takes values and gives them back, and the relative error of its floats.
LIBRARIES = {
    "numpy": SimpleNamespace(xp=lambda: NUMPY, take=on_host, rtol=1e-12),
    "drjit": SimpleNamespace(xp=device_namespace, take=lambda v: from_host(jit().Float, v), rtol=2e-6),
}


@pytest.fixture(params=LIBRARIES)
def library(request):
    return LIBRARIES[request.param]


def same(library, found, expected, atol=0.0):
    found = np.broadcast_to(on_host(found), np.shape(expected))
    np.testing.assert_allclose(found, expected, rtol=library.rtol, atol=atol)


@pytest.mark.parametrize("shot", (True, False))
def test_value_of_the_physical_form(library, shot):
    """A Poisson count of mean m has mean and variance m: K m + 0 and K² m, and K² σ_r² beside it."""
    response, dark, gain, read, t = np.linspace(0.9, 1.1, 6), np.linspace(0, 500, 6), 0.25, 6.0, 0.02
    pixels = aps.PixelProperties(library.take(response), library.take(dark), 64.0, None)
    value = aps.physical_value(library.take(ELECTRONS), t, pixels, gain, read, shot)
    light = response * ELECTRONS
    same(library, value.mean_dn, gain * (light + dark * t))
    same(library, value.variance_dn2, gain**2 * ((light if shot else 0) + dark * t + read**2))
    same(library, value.fixed_dn, 0 * light if shot else gain * light)
    counted = aps.physical_beta(gain, read, 300.0)
    assert aps.polynomial(counted, 50.0, t) == pytest.approx(gain**2 * (50.0 / gain + 300.0 * t + read**2), rel=1e-12)


def test_value_of_the_polynomial_form(library):
    """Mean I + t N_DP and variance β0 + β1 I + β2 t + β3 I² + β4 I t + β5 t², with I up to full scale in the gain."""
    gain, t, full_scale = 0.25, 0.02, 1023.0
    pixels = aps.PixelProperties(
        1.1, library.take(np.full(6, 200.0)), 64.0, tuple(library.take(np.full(6, b)) for b in BETA)
    )
    value = aps.calibrated_value(library.take(ELECTRONS), t, pixels, gain, full_scale, library.xp())
    signal = gain * 1.1 * ELECTRONS
    b0, b1, b2, b3, b4, b5 = BETA
    variance = b0 + b1 * signal + b2 * t + b3 * signal * np.minimum(signal, full_scale) + b4 * signal * t + b5 * t**2
    same(library, value.mean_dn, signal + gain * 200.0 * t)
    same(library, value.variance_dn2, variance)
    np.testing.assert_allclose(aps.polynomial([BETA] * 5, signal[:5], t), variance[:5], rtol=1e-12)
    # without a gain the light has no noise; a remainder below 0 is none
    nothing = aps.PixelProperties(1.0, 0.0, 0.0, tuple(library.take(np.full(6, b)) for b in (-1.0, 0, 0, 0, 0, 0)))
    value = aps.calibrated_value(library.take(ELECTRONS), t, nothing, gain, full_scale, library.xp())
    same(library, value.mean_dn, gain * ELECTRONS)
    same(library, value.variance_dn2, 0 * ELECTRONS)


def test_noise_equivalent_and_cumulant_of_frame_pixels(library):
    variance = 2.0 + 0.25**2 * ELECTRONS
    found = aps.noise_equivalent_e(library.take(variance), 0.25, 0.01, library.take(ELECTRONS), library.xp())
    same(library, found, np.hypot(np.sqrt(variance) / 0.25, 0.01 * ELECTRONS))
    # SciPy's Poisson has excess kurtosis 1/m: κ₄ of g counts is g⁴ m
    mean, gain = 7.0, 0.25
    fourth = stats.poisson.stats(mean, moments="k") * (gain**2 * mean) ** 2
    assert aps.fourth_cumulant_dn4(gain, gain**2 * mean) == pytest.approx(float(fourth), rel=1e-12)
    assert pytest.approx(np.var(np.arange(1000) / 1000 - 0.5), rel=1e-5) == aps.ADC_VARIANCE_DN2


def test_variance_below_which_rounding_hides_the_noise():
    """At the limit a rounded Gaussian has q²/12 more than the Gaussian, to 5 %, wherever its mean lies; at half of it
    that fails by more than that, and an eighth of it moves means by 0.1 DN and more."""
    dn = np.arange(-20, 21)

    def rounded(variance, centre):
        law = np.diff(stats.norm.cdf(np.arange(-20.5, 21.0), centre, np.sqrt(variance)))
        mean = law @ dn
        return abs(mean - centre), abs(law @ (dn - mean) ** 2 - variance - 1 / 12) / variance

    worst = {v: np.max([rounded(v, c) for c in np.linspace(0, 0.5, 51)], axis=0) for v in (0.24, 0.12, 0.03)}
    assert worst[aps.QUANTISED_VARIANCE_DN2][1] < 0.05 < worst[0.12][1]
    assert worst[aps.QUANTISED_VARIANCE_DN2][0] < 0.005 and worst[0.03][0] > 0.1


def level(signal, law):
    """x and s² written out."""
    b1, b2, b3, b4, b5 = EVENT_BETA
    y = b3 * signal if law == "linear" else b3 * np.sqrt(signal)
    return b1 * signal + b2, y**2 + b4**2 + 2 * b5 * y * b4


@pytest.mark.parametrize("law", ("linear", "sqrt"))
def test_level_and_noise_of_event_pixels(library, law):
    dn_per_electron = 2.5
    k = evs.Coefficients.of(EVENT_BETA, dn_per_electron, law, NUMPY)
    electrons, xp = library.take(ELECTRONS), library.xp()
    x, variance = level(dn_per_electron * ELECTRONS, law)
    log, relative = evs.log_level(k, electrons, law, xp)
    same(library, log, np.log(x))
    same(library, relative, variance / x**2)
    for least in (0.0, 0.01):
        expected = np.maximum(np.sqrt(variance), least * x) / (EVENT_BETA[0] * dn_per_electron)
        same(library, evs.noise_equivalent(k, electrons, least, law, xp), expected)
    same(library, evs.static_threshold_over_noise(0.3, library.take(x), library.take(variance), xp),
         0.3 / np.sqrt(2 * variance / x**2))  # fmt: skip
    corner = evs.corner_hz(k, log, EVENT_BETA[0] * 800.0, 5.0, 3000.0, xp)
    same(library, corner, np.minimum(5.0 + 2995.0 * dn_per_electron * ELECTRONS / 800.0, 3000.0), atol=2e-3)
    # in series, the line goes on beyond its largest value
    series = evs.corner_hz(k, log, EVENT_BETA[0] * 800.0, 5.0, 3000.0, xp, 1700.0)
    line = 5.0 + 2995.0 * dn_per_electron * ELECTRONS / 800.0
    same(library, series, 1 / (1 / line + 1 / 1700.0), atol=2e-3)
    # with full anticorrelation s² touches 0 where the two noises are equal, and stays a variance
    opposed = evs.Coefficients.of((0.8, 3.0, 0.3, 0.11, -1.0), 1.0, "linear", NUMPY)
    touching = 0.11 / 0.3 + np.linspace(-1e-7, 1e-7, 999)
    assert np.min((opposed.light * touching + opposed.cross) * touching + opposed.dark) < 0  # by rounding
    assert np.all(on_host(evs.voltage_variance(opposed, library.take(touching), xp)) >= 0)


@pytest.mark.parametrize(("first_s", "second_s"), ((0.31, 0.07), (0.002, 1.7)))
def test_two_equal_poles_have_the_variance_and_the_delay_of_unequal_ones(first_s, second_s):
    """White noise behind 1/((1 + iωτ₁)(1 + iωτ₂)), and the mean time of its impulse response, by quadrature."""

    def both(one, two):
        power = integrate.quad(lambda w: 1 / ((1 + (w * one) ** 2) * (1 + (w * two) ** 2)), 0, np.inf, limit=500)[0]
        if one == two:
            response = lambda t: t / one**2 * np.exp(-t / one)  # noqa: E731
        else:
            response = lambda t: (np.exp(-t / one) - np.exp(-t / two)) / (one - two)  # noqa: E731
        ends = np.array([0, min(one, two), 5 * min(one, two), max(one, two), 60 * max(one, two)])
        delay = sum(integrate.quad(lambda t: t * response(t), *pair, limit=500)[0] for pair in itertools.pairwise(ends))
        return power, delay

    # corners in series: two equal poles of twice the corner in which one pole of τ has its own
    corner = evs.in_series(1 / first_s, 1 / second_s)
    np.testing.assert_allclose(both(1 / (2 * corner), 1 / (2 * corner)), both(first_s, second_s), rtol=1e-6)


def test_event_probabilities_against_the_normal_law():
    change, sigma = np.linspace(-0.4, 0.4, 9), 0.07
    on, off = evs.event_probabilities(0.12, 0.15, change, sigma)
    np.testing.assert_allclose(on, stats.norm.sf(0.12, change, sigma), rtol=1e-12)
    np.testing.assert_allclose(off, stats.norm.cdf(-0.15, change, sigma), rtol=1e-12)
    on, off = evs.event_probabilities(0.12, 0.15, change, 0.0)
    np.testing.assert_array_equal(on, change > 0.12)
    np.testing.assert_array_equal(off, change < -0.15)


def test_mean_over_thresholds_by_quadrature():
    u, relative, spread = np.linspace(0.3, 4, 7), 1.05, 0.2
    z = np.linspace(-9, 9, 20001)
    weight = stats.norm.pdf(z) / stats.norm.pdf(z).sum()
    mean = stats.norm.sf(u[:, None] * (relative + spread * z)) @ weight
    np.testing.assert_allclose(stats.norm.sf(evs.over_thresholds(u, relative, spread, NUMPY)), mean, rtol=1e-9)


def test_leak_probability_is_that_of_an_exponential_wait():
    for interval_s in (1e-9, 1e-3, 2.0):
        assert evs.leak_probability(0.7, interval_s) == pytest.approx(stats.expon.cdf(interval_s, scale=1 / 0.7))


CHILD = """
import json, sys
sys.modules["drjit"] = sys.modules["mitsuba"] = None
import numpy as np
from hesim_render.calibrate import calibrate_aps, calibrate_evs
from hesim_render.core.device_types import NUMPY
from hesim_render.pixels.aps import formulas as aps
from hesim_render.pixels.evs import formulas as evs
folder, out, beta, event_beta, electrons = sys.argv[1], sys.argv[2], *map(json.loads, sys.argv[3:])
calibrate_aps(folder, out)
calibrate_evs(folder, out)
pixels = aps.PixelProperties(1.0, 0.0, 0.0, tuple(beta))
value = aps.calibrated_value(np.array(electrons), 0.02, pixels, 0.25, 1023.0, NUMPY)
k = evs.Coefficients.of(tuple(event_beta), 1.0, "linear", NUMPY)
found = [value.variance_dn2, *evs.log_level(k, np.array(electrons), "linear", NUMPY)]
loaded = sorted(name for name in sys.modules if name.startswith("hesim_render.pixels."))
print(json.dumps({"found": [f.tolist() for f in found], "loaded": loaded}))
"""


def test_events_of_a_defect_show_where_the_comparison_gave_none():
    """Counted are a good pixel's own events, and in what is left those of the defect: own + (1 − ON − OFF) q."""
    on, off, q = np.array([0.0, 0.12, 0.3]), np.array([0.07, 0.25, 0.2]), np.array([0.02, 0.4, 0.9])
    rest = 1 - on - off
    for polarity, own in ((1, on), (-1, off)):
        np.testing.assert_allclose(evs.own_events(own + rest * q, on, off, polarity), q, rtol=1e-12)


@pytest.mark.slow
def test_calibration_fits_the_formulas_where_drjit_and_mitsuba_cannot_be_imported(tmp_path):
    """The formulas of both kinds of pixel, and both fits, run there; no sampler is loaded."""
    capture_sets.write_events(tmp_path / "set", size=64, trials=20000)
    capture_sets.write_frames(tmp_path / "set", size=64, frames=16, theta_hardware_v=0.75e-3)
    out = tmp_path / "calibration.yaml"
    given = [json.dumps(list(values)) for values in (BETA, EVENT_BETA, ELECTRONS)]
    command = [sys.executable, "-c", CHILD, str(tmp_path / "set"), str(out), *given]
    child = subprocess.run(command, check=True, capture_output=True, text=True)
    told = json.loads(child.stdout.splitlines()[-1])
    signal, t = 0.25 * ELECTRONS, 0.02
    b0, b1, b2, b3, b4, b5 = BETA
    variance = b0 + b2 * t + b5 * t**2 + signal * (b1 + b3 * np.minimum(signal, 1023.0) + b4 * t)
    x, noise = level(ELECTRONS, "linear")
    for found, expected in zip(told["found"], (variance, np.log(x), noise / x**2), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    formulas = {f"hesim_render.pixels.{name}" for name in ("aps", "aps.formulas", "evs", "evs.formulas")}
    # the type of events, and the rates that sensor files of data sheets need
    others = {"hesim_render.pixels.evs.events", "hesim_render.pixels.evs.noise_rates"}
    assert formulas <= set(told["loaded"]) <= formulas | others
    # the fits found the truth of the sets: six z values beyond 4.5 have a chance of 4e-5
    data = read_calibration(out)
    known = {"K": 0.25, "read_noise_e": 6.0, "dark_current_e_per_s": 2000.0}
    found = [(data["aps"][name], value) for name, value in known.items()]
    found += [(data["evs"][name], value) for name, value in (("A", 29.0), ("B", 6240.0), ("C", 0.03))]
    for parameter, value in found:
        assert abs(parameter["value"] - value) < 4.5 * parameter["standard_error"]
