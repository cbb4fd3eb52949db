"""The event stage: probabilities, ramps, statistics in time, and NumPy versions of both modes."""

import drjit as dr
import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.processes import BandNoise
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor

TICK_US = 1000
K, T_REF_US = 0.2, 10_000  # signal reference of reference-mono


def model(side=512, crop=None, **overrides):
    """reference-mono: every pixel an event pixel."""
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    spec = read_sensor("reference-mono", {"geometry.rows": side, "geometry.cols": side, **changes})
    layout = Layout.full(spec)
    return EvsNoise(spec.evs, layout.crop(*crop) if crop else layout, spec.device_seed, np.ones(1))


def asynchronous(side=128, **overrides):
    """The same with the level of the last event kept; without light noise is s/x = β4/β2."""
    coefficients = [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.08, "beta5": 0.0}]
    defaults = {"evs__reference": "last_event", "evs__noise_cutoff_hz": 300.0,
                "evs__coefficients": coefficients, "evs__contrast_threshold_on": 0.2,
                "evs__contrast_threshold_off": 0.23}  # fmt: skip
    return model(side, **{**defaults, **overrides})


def flat(value, noise):
    rows, cols = noise.layout.evs_shape
    return dr.full(jit().Float, value, rows * cols)


def electrons_at(log_x, window_us=1000):
    """Electrons of a window at which ln x is `log_x`, with β1 = β2 = 1."""
    return np.expm1(log_x) * window_us / (K * T_REF_US)


def on_device(values):
    return from_host(jit().Float, values)


#: Rates of both polarities of the comparators' own noise.
COMPARATORS = {"on_hz": 31.0, "off_hz": 47.0}

# ---- previous_sample -------------------------------------------------------------------------------

# Ten pairs of windows, static and moving, from the dark to bright light
PAIRS = [(0.0, 0.0), (0.5, 0.5), (0.5, 0.7), (2.0, 1.2), (5.0, 5.0), (10.0, 12.0), (10.0, 8.0), (40.0, 40.0),
         (200.0, 210.0), (2000.0, 1950.0)]  # fmt: skip


@pytest.mark.parametrize("noise_mode", ("per_instant", "independent"))
@pytest.mark.parametrize("pair", PAIRS)
def test_event_probabilities_against_q(pair, noise_mode):
    """262144 independent pixels a pair; 40 comparisons at 2.5e-8: a false alarm in a million runs."""
    noise = model(evs__noise_mode=noise_mode, evs__contrast_threshold_on=0.25, evs__contrast_threshold_off=0.3)
    b1, b2, b3, b4 = 1.0, 1.0, 2**0.5, 0.02
    levels = []
    for electrons in pair:
        signal = K * electrons * T_REF_US / 1000
        levels.append((b1 * signal + b2, b3**2 * signal + b4**2))
    (x0, s0), (x1, s1) = levels
    change, sigma = np.log(x1 / x0), np.sqrt(s0 / x0**2 + s1 / x1**2)
    stage = EvsStage(noise, seed=5)
    assert len(stage.step(flat(pair[0], noise), TICK_US)) == 0
    events = stage.step(flat(pair[1], noise), 2 * TICK_US)
    pixels = 512 * 512
    for polarity, p in ((1, stats.norm.sf((0.25 - change) / sigma)), (-1, stats.norm.sf((0.3 + change) / sigma))):
        found = np.sum(events["polarity"] == polarity)
        # the exact binomial tail, so that rare events need no approximation
        assert stats.binom.cdf(found, pixels, p) > 1.25e-8
        assert stats.binom.sf(found - 1, pixels, p) > 1.25e-8
    assert np.all(events["t_us"] == 2 * TICK_US)


def counts_of(stage, noise, electrons, ticks, t0_us=0):
    """ON and OFF events of each pixel in `ticks` steps."""
    rows, cols = noise.layout.evs_shape
    on, off = np.zeros(rows * cols, int), np.zeros(rows * cols, int)
    for k in range(ticks + 1):
        events = stage.step(electrons, t0_us + (k + 1) * TICK_US)
        pixel = events["y"].astype(int) * cols + events["x"]
        assert len(np.unique(pixel)) == len(pixel)  # at most one event per pixel and tick
        on[pixel[events["polarity"] > 0]] += 1
        off[pixel[events["polarity"] < 0]] += 1
    return on, off


@pytest.mark.slow
def test_counts_are_over_dispersed_with_noise_per_instant():
    """Successive ΔV correlate by −½: an ON is likelier followed by an OFF. 6 comparisons at z = 5.5."""
    ticks, theta = 40, 0.25
    changes = {"evs__contrast_threshold_on": theta, "evs__contrast_threshold_off": theta}
    electrons = 50.0
    x, s2 = 101.0, 2 * 100 + 0.02**2
    level = theta / (np.sqrt(2 * s2) / x)
    p = stats.norm.sf(level)
    for noise_mode in ("per_instant", "independent"):
        noise = model(evs__noise_mode=noise_mode, **changes)
        on, off = counts_of(EvsStage(noise, seed=1), noise, flat(electrons, noise), ticks)
        correlation = -0.5 if noise_mode == "per_instant" else 0.0
        pair = stats.multivariate_normal([0, 0], [[1, correlation], [correlation, 1]])
        same = pair.cdf([-level, -level])  # two ONs in a row
        opposite = p - pair.cdf([-level, level])  # an ON, then an OFF
        both = on + off
        variance_on = ticks * p * (1 - p) + 2 * (ticks - 1) * (same - p * p)
        variance_both = ticks * 2 * p * (1 - 2 * p) + 2 * (ticks - 1) * (2 * same + 2 * opposite - 4 * p * p)
        for counts, mean, variance in ((on, ticks * p, variance_on), (both, 2 * ticks * p, variance_both)):
            assert abs(counts.mean() - mean) < 5.5 * np.sqrt(variance / counts.size)
            kurtosis = stats.kurtosis(counts) + 2
            assert abs(counts.var() / variance - 1) < 5.5 * np.sqrt(kurtosis / counts.size)
        dispersion = both.var() / (2 * ticks * p * (1 - 2 * p))
        assert (dispersion > 1.05) if noise_mode == "per_instant" else (abs(dispersion - 1) < 0.02)


def numpy_previous_sample(noise, electrons, ticks, rng):
    """The mode once more, in NumPy: ON and OFF counts of each pixel."""
    spec, b = noise.spec, noise.spec.coefficients[0]
    signal = K * electrons * T_REF_US / spec.window_us
    x = b.beta1 * signal + b.beta2
    s = np.sqrt(b.beta3**2 * signal + b.beta4**2 + 2 * b.beta5 * b.beta3 * b.beta4 * np.sqrt(signal))
    leak = 1 - np.exp(-spec.leak_rate_hz * TICK_US * 1e-6)
    on, off = np.zeros(electrons.shape, int), np.zeros(electrons.shape, int)
    last = np.log(x) + s / x * rng.standard_normal(x.shape)
    for _ in range(ticks):
        if spec.noise_mode == "per_instant":
            level = np.log(x) + s / x * rng.standard_normal(x.shape)
            change, last = level - last, level
        else:
            change = np.sqrt(2) * s / x * rng.standard_normal(x.shape)
        falls = change < -noise.threshold_off_map
        off += falls
        on += (change > noise.threshold_on_map) | (~falls & (rng.random(x.shape) < leak))
    return on, off


def same_law_p(a, b):
    """Two-sample χ² of two equally large sets of counts."""
    a, b = (np.bincount(v.ravel(), minlength=100) for v in (a, b))
    kept = a + b > 20
    return stats.chi2.sf(np.sum((a - b)[kept] ** 2 / (a + b)[kept]), kept.sum() - 1)


@pytest.mark.parametrize("noise_mode", ("per_instant", "independent"))
def test_numpy_version_of_previous_sample_agrees(noise_mode):
    """Counts of ON, OFF, both and their difference per pixel, mismatch and leak on; 8 × 1e-7."""
    noise = model(evs__noise_mode=noise_mode, evs__contrast_threshold_on=0.3, evs__contrast_threshold_off=0.32,
                  evs__threshold_mismatch_rel=0.1, evs__leak_rate_hz=5.0)  # fmt: skip
    electrons = np.broadcast_to(np.geomspace(5, 500, 512), (512, 512))
    ours = counts_of(EvsStage(noise, seed=2), noise, on_device(electrons), 30)
    theirs = [c.ravel() for c in numpy_previous_sample(noise, electrons, 30, np.random.default_rng(3))]
    for combine in (lambda on, off: on, lambda on, off: off, np.add, lambda on, off: on - off + 40):
        assert same_law_p(combine(*ours), combine(*theirs)) > 1e-7


@pytest.mark.parametrize("arms", ((1, 2, 4, 8),))
def test_previous_sample_rate_does_not_follow_the_slices(arms):
    """A window integrated from 1 to 8 slices, read once a tick: noise rates within 2 %.

    At least 200,000 events an arm: 0.24 % standard error, 0.35 % of a difference of over-dispersed
    counts; 2 % is 5 of those, three comparisons: a false alarm in a million runs.
    """
    noise = model(evs__contrast_threshold_on=0.35, evs__contrast_threshold_off=0.35)
    flux_e_per_s = 50_000.0
    totals = []
    for slices in arms:
        stage = EvsStage(noise, seed=100 + slices)
        total = 0
        for tick in range(40):
            window = flat(0.0, noise)
            for _ in range(slices):
                window += flat(flux_e_per_s, noise) * (TICK_US * 1e-6 / slices)
            total += len(stage.step(window, (tick + 1) * TICK_US))
        totals.append(total)
    assert min(totals) > 200_000
    for total in totals[1:]:
        assert abs(total / totals[0] - 1) < 0.02


def test_leak_of_previous_sample():
    """Binomial per tick with 1 − exp(−rate·Δt); z = 5.5, twice."""
    noise = model(evs__leak_rate_hz=20.0).without("shot", "dark_current")
    on, off = counts_of(EvsStage(noise, seed=1), noise, flat(10.0, noise), 50)
    p = 1 - np.exp(-0.02)
    assert off.sum() == 0
    assert abs(on.mean() - 50 * p) < 5.5 * np.sqrt(50 * p * (1 - p) / on.size)
    assert abs(on.var() / (50 * p * (1 - p)) - 1) < 5.5 * np.sqrt(3.0 / on.size)
    # where the signal fires, the leak is not seen
    busy = model(64, evs__leak_rate_hz=900.0).without("shot", "dark_current")
    for electrons, sign in ((4.0, -1), (25.0, 1)):
        stage = EvsStage(busy, seed=1)
        stage.step(flat(10.0, busy), 0)
        assert np.all(stage.step(flat(electrons, busy), TICK_US)["polarity"] == sign)


def test_comparator_noise_of_previous_sample():
    """At most one event a tick: the comparison first, then leak, then the comparators' noise; z = 5.5, four times."""
    noise = model(evs__leak_rate_hz=20.0, evs__comparator_noise=COMPARATORS).without("shot", "dark_current")
    on, off = counts_of(EvsStage(noise, seed=1), noise, flat(10.0, noise), 50)
    leak, own_on, own_off = -np.expm1(np.array([-0.020, -0.031, -0.047]))
    for counts, p in ((on, leak + (1 - leak) * own_on), (off, (1 - leak) * own_off)):
        assert abs(counts.mean() - 50 * p) < 5.5 * np.sqrt(50 * p * (1 - p) / counts.size)
        assert abs(counts.var() / (50 * p * (1 - p)) - 1) < 5.5 * np.sqrt(3.0 / counts.size)
    quiet = noise.without("comparator_noise", "leak")
    assert quiet.comparator_noise_hz == (0.0, 0.0)
    assert len(EvsStage(quiet, seed=1).step(flat(10.0, quiet), 0)) == 0
    # where the signal fires, they are not seen
    busy = model(64, evs__comparator_noise={"on_hz": 900.0, "off_hz": 800.0}).without("shot", "dark_current")
    for electrons, sign in ((4.0, -1), (25.0, 1)):
        stage = EvsStage(busy, seed=1)
        stage.step(flat(10.0, busy), 0)
        assert np.all(stage.step(flat(electrons, busy), TICK_US)["polarity"] == sign)


# ---- last_event ------------------------------------------------------------------------------------


def test_noiseless_ramp_gives_intervals_theta_over_slope():
    """ln x rises, then falls, at irregular sample times, some far longer than an interval."""
    noise = asynchronous(16, evs__contrast_threshold_on=0.2, evs__contrast_threshold_off=0.25).clean()
    stage = EvsStage(noise, seed=1)
    slope_per_us = 1.75e-5
    up_us = np.unique(np.r_[0, np.random.default_rng(1).integers(1, 200_000, 60), 200_000])
    level = 1.0 + slope_per_us * np.minimum(up_us, 200_000)
    events = np.concatenate(
        [stage.step(flat(electrons_at(v), noise), int(t)) for t, v in zip(up_us, level, strict=True)]
    )
    crossings = 0.2 * np.arange(1, 18) / slope_per_us
    assert crossings[-1] < 200_000 < crossings[-1] + 0.2 / slope_per_us
    one = events[(events["x"] == 3) & (events["y"] == 7)]
    assert np.all(one["polarity"] == 1)
    # rounded up to a microsecond, and 0.1 for ln x in single precision
    late = one["t_us"] - crossings
    assert late.min() > -0.1 and late.max() < 1.1
    assert len(events) == 17 * 256
    # down again, in one step: the first OFF comes 0.25 below the level of the last ON
    down_us = 300_000
    events = stage.step(flat(electrons_at(1.0), noise), down_us)
    last_on, top = 1.0 + 17 * 0.2, level[-1]
    expected = 200_000 + (top - (last_on - 0.25 * np.arange(1, 14))) / (top - 1.0) * 100_000
    expected = expected[expected < down_us]
    one = events[(events["x"] == 0) & (events["y"] == 0)]
    assert np.all(one["polarity"] == -1)
    assert len(one) == len(expected) == 13
    late = one["t_us"] - expected
    assert late.min() > -0.1 and late.max() < 1.1


@pytest.mark.slow
def test_ramp_does_not_depend_on_the_samples():
    noise = asynchronous(16).clean()
    log_of_t = [1.0 + 2e-5 * t for t in range(0, 64_001, 250)]
    arms = []
    for every in (1, 4, 64):
        stage = EvsStage(noise, seed=1)
        parts = [stage.step(flat(electrons_at(v), noise), 250 * every * k) for k, v in enumerate(log_of_t[::every])]
        arms.append(np.concatenate(parts))
    for other in arms[1:]:
        np.testing.assert_array_equal(other[["x", "y", "polarity"]], arms[0][["x", "y", "polarity"]])
        assert np.max(np.abs(other["t_us"] - arms[0]["t_us"])) <= 1


def test_band_noise():
    """Variance, and correlation (1 + aτ)exp(−aτ) at several lags.

    262144 pixels, 8 comparisons at z = 5.5: a false alarm in 3 million runs.
    """
    noise = asynchronous(512)
    process = BandNoise(noise, seed=3)
    period_us = 1e6 / (16 * 300.0)
    a_per_us = 2 * np.pi * 300e-6 / np.sqrt(np.sqrt(2) - 1)
    first = np.array(process.start(0), dtype=float)
    gain = first.var()
    # the amplitude makes up for what linear interpolation loses: (2 + ρ)/3 on average
    rho = (1 + a_per_us * period_us) * np.exp(-a_per_us * period_us)
    assert abs(gain * (2 + rho) / 3 - 1) < 5.5 * np.sqrt(2 / first.size)
    for node in range(1, 41):
        now = np.array(process.at(node * period_us), dtype=float)
        if node in (1, 2, 4, 8, 40):
            lag = a_per_us * node * period_us
            correlation = np.mean(first * now) / gain
            assert abs(correlation - (1 + lag) * np.exp(-lag)) < 5.5 * np.sqrt(2 / first.size)
    assert abs(now.var() / gain - 1) < 5.5 * np.sqrt(4 / first.size)
    middle = np.array(process.at(40.5 * period_us), dtype=float)
    assert abs(middle.var() / gain - (1 + rho) / 2) < 5.5 * np.sqrt(4 / first.size)


def numpy_last_event(noise, log_x, spread, duration_us, nodes, rng, wanted_hz=300.0):
    """The mode once more, in NumPy: noise of two equal poles, stepped finely; times, pixels, polarities.

    `log_x(t)` and `spread(t)` give arrays over pixels. The noise is integrated in `nodes` steps per 1/cutoff
    by its own exact law, and crossings are found on straight lines between the steps.
    """
    a = 2 * np.pi * wanted_hz / np.sqrt(np.sqrt(2) - 1) * 1e-6
    step_us = 1e6 / (nodes * wanted_hz)
    h = a * step_us
    move = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    root = np.linalg.cholesky(np.eye(2) - move @ move.T)
    amplitude = np.sqrt(3 / (2 + (1 + h) * np.exp(-h)))
    theta_on, theta_off = np.ravel(noise.threshold_on_map), np.ravel(noise.threshold_off_map)
    pixels = len(log_x(0.0))
    state = rng.standard_normal((2, pixels))
    level = log_x(0.0) + spread(0.0) * amplitude * state[0]
    reference = level.copy()
    found = []
    for k in range(1, int(duration_us / step_us) + 1):
        begin, end = (k - 1) * step_us, k * step_us
        state = move @ state + root @ rng.standard_normal((2, pixels))
        after = log_x(end) + spread(end) * amplitude * state[0]
        while True:
            on, off = after - reference >= theta_on, reference - after >= theta_off
            hit = np.flatnonzero(on | off)
            if len(hit) == 0:
                break
            reference = reference + np.where(on, theta_on, 0) - np.where(off, theta_off, 0)
            part = (reference[hit] - level[hit]) / (after[hit] - level[hit])
            found.append((begin + part * (end - begin), hit, np.where(on[hit], 1, -1)))
        level = after
    return [np.concatenate(v) for v in zip(*found, strict=True)]


def test_numpy_version_of_last_event_agrees():
    """Noise, mismatch and a slow rise of light: counts per pixel, times, and waits between events; 5 × 1e-6.

    The wedge of light makes the noise differ between pixels. Both sides sample the light at the nodes.
    """
    noise = asynchronous(128, evs__threshold_mismatch_rel=0.1, evs__contrast_threshold_off=0.22)
    wedge = np.broadcast_to(np.linspace(0.0, 0.3, 128), (128, 128)).ravel()
    duration_us, period_us = 100_000, 1e6 / (16 * 300.0)

    def log_x(t):
        return wedge + 1e-5 * t

    def spread(t):
        return 0.08 * np.exp(-log_x(t))

    stage = EvsStage(noise, seed=4, is_reset=True)
    # 6 nodes are 1250 µs, whole microseconds
    times = range(0, duration_us + 1, 1250)
    events = np.concatenate([stage.step(on_device(electrons_at(log_x(t))), t) for t in times])
    t_us, pixel, polarity = numpy_last_event(noise, log_x, spread, duration_us, 16, np.random.default_rng(5))
    ours_pixel = events["y"].astype(int) * 128 + events["x"]
    assert len(events) > 30_000
    for sign in (1, -1):
        a = np.bincount(ours_pixel[events["polarity"] == sign], minlength=wedge.size)
        b = np.bincount(pixel[polarity == sign], minlength=wedge.size)
        assert same_law_p(a, b) > 1e-6
    assert stats.ks_2samp(events["t_us"][::20], t_us[::20]).pvalue > 1e-6
    waits = []
    for times_us, places in ((events["t_us"], ours_pixel), (t_us, pixel)):
        order = np.lexsort((times_us, places))
        wait, same = np.diff(times_us[order]), np.diff(places[order]) == 0
        waits.append(wait[same])
    assert stats.ks_2samp(waits[0][::5], waits[1][::5]).pvalue > 1e-6
    assert period_us * 6 == pytest.approx(1250)


@pytest.mark.slow
def test_last_event_rate_does_not_follow_the_slices():
    """Static light sampled at 1, 2, 4 and 8 kHz: noise rates within 2 %.

    Above 300,000 events an arm. Counts of a pixel are clustered; from their own spread the standard error
    of a difference is asserted to be below 0.4 %: 2 % is 5 of those, a false alarm in 600,000 runs.
    """
    noise = asynchronous(
        512, evs__coefficients=[{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.071, "beta5": 0.0}]
    )
    duration_us = 40_000
    totals, errors = [], []
    for slices in (1, 2, 4, 8):
        stage = EvsStage(noise, seed=50 + slices)
        step_us = 1000 // slices
        counts = np.zeros(512 * 512, int)
        for t_us in range(0, duration_us + 1, step_us):
            events = stage.step(flat(0.0, noise), t_us)
            counts += np.bincount(events["y"].astype(int) * 512 + events["x"], minlength=counts.size)
        totals.append(counts.sum())
        errors.append(counts.std() / counts.mean() / 512)
    assert min(totals) > 300_000
    assert np.sqrt(2) * max(errors) < 0.004
    for total in totals[1:]:
        assert abs(total / totals[0] - 1) < 0.02


def test_same_seed_gives_the_same_noise_whatever_the_slices():
    """The nodes belong to the sensor: with one seed even the events are the same, to rounding."""
    noise = asynchronous(128, evs__leak_rate_hz=3.0)
    arms = []
    for step_us in (1000, 125):
        stage = EvsStage(noise, seed=9)
        parts = [stage.step(flat(0.0, noise), t) for t in range(0, 30_001, step_us)]
        arms.append(np.concatenate(parts))
    few, many = (len(a) for a in arms)
    assert few > 5000
    assert abs(few - many) <= 0.001 * few  # a crossing that just touches may fall to either side
    common = np.intersect1d(*(a[["t_us", "x", "y"]] for a in arms))
    assert len(common) > 0.98 * few


def test_leak_of_last_event():
    """Poisson counts, uniform times, whatever the sampling; z = 5.5 and a KS test at 1e-6."""
    noise = asynchronous(128, evs__leak_rate_hz=40.0).without("dark_current")
    arms = []
    for step_us in (10_000, 700):
        stage = EvsStage(noise, seed=6)
        parts = [stage.step(flat(1.0, noise), t) for t in range(0, 140_001, step_us)]
        arms.append(np.concatenate(parts))
    events = arms[0]
    np.testing.assert_array_equal(arms[1], events)
    assert np.all(events["polarity"] == 1)
    counts = np.bincount(events["y"].astype(int) * 128 + events["x"], minlength=128 * 128)
    mean = 40 * 0.14
    assert abs(counts.mean() - mean) < 5.5 * np.sqrt(mean / counts.size)
    assert abs(counts.var() / mean - 1) < 5.5 * np.sqrt((2 + 1 / mean) / counts.size)
    assert stats.kstest(events["t_us"] / 140_000, "uniform").pvalue > 1e-6


@pytest.mark.parametrize("dead_us", (None, 4000))
def test_comparator_noise_of_last_event(dead_us):
    """Poisson counts of both polarities, also over a stop; rates r/(1 + rT) behind a dead time T. z = 5.5, ten times.

    Behind the dead time, the variance of a renewal count is asymptotic: no more than that of Poisson's law is asked.
    """
    changes = {"evs__comparator_noise": COMPARATORS, "evs__leak_rate_hz": 11.0, "evs__refractory_period_us": dead_us}
    noise = asynchronous(128, **changes).without("dark_current")
    stage, parts = EvsStage(noise, seed=6), []
    for t_us in range(0, 240_001, 20_000):
        parts.append(stage.step(flat(1.0, noise), t_us))
        if t_us == 100_000:
            state, stage = stage.state(), EvsStage(noise, seed=6)
            stage.resume(state)
    events = np.concatenate(parts)
    events = events[events["t_us"] > 20_000]  # behind several dead times
    pixel = events["y"].astype(int) * 128 + events["x"]
    slower = 1 + (31 + 47 + 11) * 1e-6 * (dead_us or 0)
    for sign, rate_hz in ((1, 31 + 11), (-1, 47)):
        counts = np.bincount(pixel[events["polarity"] == sign], minlength=128 * 128)
        mean = rate_hz * 0.22 / slower
        assert abs(counts.mean() - mean) < 5.5 * np.sqrt(mean / counts.size)
        if dead_us is None:
            assert abs(counts.var() / mean - 1) < 5.5 * np.sqrt((2 + 1 / mean) / counts.size)
        else:
            assert counts.var() < mean
    order = np.lexsort((events["t_us"], pixel))
    within = np.diff(events["t_us"][order])[np.diff(pixel[order]) == 0]
    assert within.min() == dead_us if dead_us else within.min() < 10
    silent = noise.without("comparator_noise")
    stage = EvsStage(silent, seed=6)
    assert all(np.all(stage.step(flat(1.0, silent), t)["polarity"] == 1) for t in (0, 50_000))


def test_noise_follows_the_current_signal():
    """In light that rises from 0 the noise falls with x, and so does its rate."""
    noise = asynchronous(64)
    rates = []
    for log_x in (0.0, 0.3, 0.6):
        stage = EvsStage(noise, seed=1)
        events = [stage.step(flat(electrons_at(log_x), noise), t) for t in range(0, 50_001, 5000)]
        rates.append(sum(map(len, events)))
    assert rates[0] > 2 * rates[1] > 8 * rates[2]


# ---- both ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", (model, asynchronous))
def test_static_scene_is_silent_without_noise(build):
    noise = build(64, evs__leak_rate_hz=100.0, evs__threshold_mismatch_rel=0.2).clean()
    stage = EvsStage(noise, seed=1)
    electrons = on_device(np.random.default_rng(0).uniform(0, 1000, 64 * 64))
    for t_us in (0, 1000, 1700, 50_000):
        events = stage.step(electrons, t_us)
        assert events.dtype == EVENT_DTYPE and len(events) == 0


@pytest.mark.parametrize("build", (model, asynchronous))
def test_crop_gives_the_full_sensors_events(build):
    changes = {"evs__threshold_mismatch_rel": 0.1, "evs__leak_rate_hz": 30.0}
    full, crop = build(128, **changes), build(128, crop=(48, 32), **changes)
    top, left = crop.layout.row0, crop.layout.col0
    image = np.random.default_rng(0).uniform(0, 20, (128, 128))
    inside = np.s_[top : top + 32, left : left + 48]
    stages = EvsStage(full, seed=3), EvsStage(crop, seed=3), EvsStage(crop, seed=3), EvsStage(crop, seed=4)
    total = 0
    for t_us in range(0, 20_001, 1000):
        image = image * np.random.default_rng(t_us).uniform(0.9, 1.1, image.shape)
        whole, part, again, other = (
            stage.step(on_device(image if stage is stages[0] else image[inside]), t_us) for stage in stages
        )
        kept = (whole["y"] >= top) & (whole["y"] < top + 32) & (whole["x"] >= left) & (whole["x"] < left + 48)
        expected = whole[kept]
        expected["x"] -= left
        expected["y"] -= top
        np.testing.assert_array_equal(part, expected)
        np.testing.assert_array_equal(again, part)
        assert t_us == 0 or not np.array_equal(other, part)
        order = np.lexsort((whole["x"], whole["y"], whole["t_us"]))
        np.testing.assert_array_equal(order, np.arange(len(whole)))
        assert t_us == 0 or (whole["t_us"].min() > t_us - 1000 and whole["t_us"].max() <= t_us)
        total += len(part)
    assert total > 100


@pytest.mark.parametrize("build", (model, asynchronous))
def test_wrong_input(build):
    stage = EvsStage(build(16), seed=1)
    with pytest.raises(RangeError, match="event pixels"):
        stage.step(dr.zeros(jit().Float, 17), 0)
    stage.step(flat(1.0, stage.noise), 100)
    with pytest.raises(RangeError, match="t_us"):
        stage.step(flat(1.0, stage.noise), 100)
