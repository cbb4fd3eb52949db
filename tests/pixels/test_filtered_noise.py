"""Noise of asynchronous pixels that their photoreceptor filters: variance, correlation, and its place in the model."""

import numpy as np
import pytest
from scipy import linalg

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.evs.photoreceptor import Photoreceptor
from hesim_render.pixels.evs.processes import BandNoise, _step
from hesim_render.pixels.evs.stage import EvsStage

#: Signals in DN: the dark, two at which the corner is below the noise's own bandwidth, and the largest corner.
SIGNALS = (0.0, 5.0, 33.0, 400.0)
#: Corner over the noise's bandwidth there, at most 1: 2 Hz in the dark and 398/400 Hz more for each DN, over 100 Hz.
SHARES = np.array([0.02, 0.06975, 0.34835, 1.0])
#: The same where the corner comes to it gradually: line/(line + 100 Hz).
GRADUAL = np.array([2.0, 6.975, 34.835, 400.0]) / np.array([102.0, 106.975, 134.835, 500.0])
APPROACHES = (("abrupt", SHARES), ("gradual", GRADUAL))
FILTERED = {
    "evs.noise_cutoff_hz": 100.0,
    "evs.photoreceptor": {
        "cutoff_hz": 400.0, "signal_dn": 400.0, "min_cutoff_hz": 2.0, "filters_noise": True,
    },
}  # fmt: skip


def sensor(width, height, changes=()):
    return hr.load_sensor("davis346", FILTERED | dict(changes)).crop(width, height)


def with_approach(approach):
    return {"evs.photoreceptor": FILTERED["evs.photoreceptor"] | {"approach": approach}}


def electrons(noise, signal_dn):
    reference = noise.spec.signal_reference
    return np.asarray(signal_dn) * noise.spec.window_us / (reference.k_dn_per_e * reference.t_ref_us)


@pytest.mark.parametrize("h", [1e-3, 0.03, 0.14, 0.16, 0.6, 2.0])
def test_a_step_of_the_noise_against_the_matrix_exponential(h):
    types, n = jit(), 400_000
    rng = np.random.default_rng(3)
    start = rng.standard_normal((2, n)).astype(np.float32)
    z = rng.standard_normal((2, n)).astype(np.float32)
    transition = linalg.expm(h * np.array([[0.0, 1.0], [-1.0, -2.0]]))
    fresh = np.eye(2) - transition @ transition.T
    zero = from_host(types.Float, np.zeros(n, np.float32))
    wide = from_host(types.Float, np.full(n, h, np.float32))
    # without new noise: the transition; each entry to float32
    kept = np.array([np.array(v) for v in _step(*(from_host(types.Float, v) for v in start), wide, (zero, zero))])
    np.testing.assert_allclose(kept, transition @ start, atol=3e-6)
    added = np.array([np.array(v) for v in _step(zero, zero, wide, tuple(from_host(types.Float, v) for v in z))])
    # the same deviates have these exact coefficients: u from the first one alone
    root = np.linalg.cholesky(fresh)
    for row, expected in zip(added, root, strict=True):
        found = np.linalg.lstsq(z.T, row, rcond=None)[0]
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * abs(expected).max())


@pytest.mark.parametrize(("approach", "shares"), APPROACHES)
def test_variance_and_correlation_are_those_of_each_pixels_own_corner(approach, shares):
    noise = sensor(128, 64, with_approach(approach)).evs
    types, width = jit(), 128 * 64
    signal = np.repeat(SIGNALS, width // len(SIGNALS))
    log, _ = noise.log_level(from_host(types.Float, electrons(noise, signal)))
    photoreceptor = Photoreceptor(noise)
    photoreceptor.start(log, 0)
    band = BandNoise(noise, 7, photoreceptor)
    np.testing.assert_allclose(band.share(width), np.repeat(shares, width // len(SIGNALS)), rtol=1e-4)
    poles = 2 * np.pi * 100 * shares / np.sqrt(np.sqrt(2) - 1)
    values = [np.array(band.start(0))]
    period_us = 1e6 / 1600
    lags, every = (1, 4, 16, 64), 0.5
    for number in range(1, 200):
        for node in range(2 * number - 1, 2 * number + 1):
            at = band.at(node * period_us * every)
        values.append(np.array(at))
    values = np.array(values).reshape(len(values), len(SIGNALS), -1)
    # 2048 pixels a group; the slowest one has independent pixels only: standard error of the variance 3 %
    variance = values.var(axis=2).mean(axis=0)
    np.testing.assert_allclose(variance, 1, atol=0.1)
    for lag in lags:
        tau_s = lag * period_us * 1e-6
        # the nodes are exact, and their amplitude is above 1 by what the interpolation between them takes away
        h = poles * period_us * 1e-6
        exact = 3 / (2 + (1 + h) * np.exp(-h))
        found = (values[lag:] * values[:-lag]).mean(axis=(0, 2)) / exact
        # of 4 × 4 means of at least 2048 independent products, 4.5 standard errors: false alarms below 1e-4
        np.testing.assert_allclose(found, (1 + poles * tau_s) * np.exp(-poles * tau_s), atol=0.1)


@pytest.mark.parametrize(("approach", "shares"), APPROACHES)
def test_the_variance_falls_with_the_corner_below_the_noises_bandwidth(approach, shares):
    apart = {"evs.contrast_threshold_on": 0.31}  # renders are as exact as the lower threshold asks for: OFF, 0.2
    noise = sensor(4, 1, apart | with_approach(approach)).evs
    plain = hr.load_sensor("davis346", apart).crop(4, 1).evs
    counted = from_host(jit().Float, electrons(noise, SIGNALS))
    ratio = np.array(noise.log_level(counted)[1]) / np.array(plain.log_level(counted)[1])
    np.testing.assert_allclose(ratio, shares, rtol=1e-4)
    # renders are asked for the noise that is there
    position = np.zeros(4, np.int64)
    some = electrons(noise, SIGNALS)
    nominal, filtered = (each.noise_equivalent_e(some, position) for each in (plain, noise))
    theta = 0.05 * 0.2
    x = some * float(noise.table.slope[0]) + float(noise.table.base[0])
    floor = theta * x / float(noise.table.slope[0])
    np.testing.assert_allclose(filtered, np.maximum(nominal * np.sqrt(shares), floor), rtol=1e-4)
    assert noise.without("bandwidth").noise_share(some, position) == 1.0


@pytest.mark.slow
def test_events_of_filtered_noise_do_not_depend_on_sampling_or_on_a_stop():
    changes = {"evs.coefficients.0.beta4": 7.0, "evs.refractory_period_us": 300}
    noise = sensor(16, 16, changes).evs
    types = jit()

    def run(times, cut=None):
        stage, found = EvsStage(noise, 5), []
        for t in times:
            dn = 25.0 * (26.0 / 25.0) ** (t / 80_000) - 5.0  # ln x, with its base of 5, on a straight line
            found.append(stage.step(from_host(types.Float, electrons(noise, np.full(256, dn))), t))
            if t == cut:
                state, stage = stage.state(), EvsStage(noise, 5)
                stage.resume(state)
        return np.concatenate(found)

    whole = run(range(0, 80_001, 10_000))
    assert len(whole) > 300
    np.testing.assert_array_equal(run(range(0, 80_001, 10_000), cut=40_000), whole)
    finer = run(range(0, 80_001, 2_500))
    # rounding in float32 moves few of them
    assert abs(len(finer) - len(whole)) < 0.02 * len(whole)
    assert np.mean(np.isin(finer["t_us"] * 256 + finer["y"] * 16 + finer["x"],
                           whole["t_us"] * 256 + whole["y"] * 16 + whole["x"])) > 0.8  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"evs.photoreceptor": {"cutoff_hz": 400.0, "follows_light": False, "filters_noise": True}},
         "filters_noise needs follows_light"),
        ({"evs.photoreceptor": {"cutoff_hz": 400.0, "follows_light": False, "approach": "gradual"}},
         "'gradual' needs follows_light"),
        ({"evs.noise_cutoff_hz": 500.0}, "above photoreceptor.cutoff_hz"),
        ({"evs.reference": "previous_sample", "evs.tick_us": 1000}, "belongs to reference 'last_event'"),
    ],
)  # fmt: skip
def test_what_filtered_noise_needs(changes, text):
    with pytest.raises(SpecError, match=text):
        hr.load_sensor("davis346", FILTERED | changes)
