"""Photoreceptor bandwidth, refractory period and read-out limit of event pixels, against closed forms."""

import math
from fractions import Fraction

import drjit as dr
import numpy as np
import pytest
from scipy import integrate, optimize, stats

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs import photoreceptor
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.pixels.evs.model import EVS_TERMS, EvsNoise
from hesim_render.pixels.evs.processes import BandNoise
from hesim_render.pixels.evs.stage import EventReadout, EvsStage, scan_start_row
from hesim_render.recording.recording import Recording
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.reading import read_sensor
from hesim_render.sources.still import WindowByWindow

K, T_REF_US, WINDOW_US = 0.2, 10_000, 1000  # of reference-mono: I = 2 DN per electron of a window
CUTOFF_HZ = 300.0
#: Both poles, 1/µs: together they are −3 dB at the corner, 1/(1 + (2π f_c/a)²) = 1/√2.
RATE = 2 * np.pi * CUTOFF_HZ * 1e-6 / np.sqrt(np.sqrt(2) - 1)
FIXED = {"cutoff_hz": CUTOFF_HZ, "follows_light": False}
FOLLOWING = {"cutoff_hz": CUTOFF_HZ, "signal_dn": 100.0, "min_cutoff_hz": 3.0}


def model(side=16, **overrides):
    """reference-mono with x = I + 1 and no noise but what is asked for."""
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    coefficients = [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.0, "beta5": 0.0}]
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": side, "geometry.cols": side, "evs.coefficients": coefficients,
         "evs.contrast_threshold_on": 0.2, "evs.contrast_threshold_off": 0.23, **changes},
    )  # fmt: skip
    return EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.ones(1))


def asynchronous(side=16, **overrides):
    defaults = {"evs__reference": "last_event", "evs__noise_cutoff_hz": 300.0}
    return model(side, **{**defaults, **overrides})


def electrons(log_x, noise):
    """Electrons of a window at which ln x is `log_x`, on the device."""
    values = np.broadcast_to(np.expm1(log_x) * WINDOW_US / (K * T_REF_US), noise.layout.evs_shape)
    return from_host(jit().Float, values)


def logs(values):
    return from_host(jit().Float, np.atleast_1d(np.asarray(values, dtype=np.float32)))


def filtered(spec, times_us, log_x, side=16):
    """y at each time; `log_x` [time] or [time, pixel]."""
    low_pass = photoreceptor.Photoreceptor(model(side, evs__photoreceptor=spec))
    rows = [low_pass.follow(logs(row), int(t)) for t, row in zip(times_us, log_x, strict=True)]
    return np.array([np.array(row) for row in rows], dtype=float).squeeze()


def ramp_response(t_us, rate=RATE):
    """y of a unit slope that begins at 0."""
    t = np.maximum(t_us, 0.0)
    return t - 2 / rate + np.exp(-rate * t) * (t + 2 / rate)


# ---- photoreceptor ----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", (3, 20, 400))
def test_step_response_at_any_spacing(count):
    """A rise of 1 within 1 µs, then samples at random times: as good as single precision, however far apart."""
    times = np.r_[0, 1, np.unique(np.random.default_rng(count).integers(2, 8000, count))]
    level = np.where(times > 0, 1.0, 0.0)
    found = filtered(FIXED, times, 0.5 + level)
    expected = 0.5 + ramp_response(times) - ramp_response(times - 1.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-7)
    # one sample a second later, after thousands of time constants
    np.testing.assert_allclose(filtered(FIXED, [0, 1, 1_000_000], [0.5, 1.5, 1.5])[-1], 1.5, rtol=0, atol=5e-7)
    # the textbook form of a step
    np.testing.assert_allclose(expected - 0.5, 1 - (1 + RATE * times) * np.exp(-RATE * times), atol=RATE)


@pytest.mark.parametrize("frequency_hz", (30.0, 300.0, 1000.0))
def test_sinusoid_is_attenuated_as_by_two_poles(frequency_hz):
    """|H| = 1/(1 + (ω/a)²), 1/√2 at the corner; phase −2 atan(ω/a)."""
    period_us = 1e6 / frequency_hz
    times = np.unique(np.rint(np.arange(0, 12 * period_us, period_us / 64)).astype(int))
    omega = 2 * np.pi / period_us
    found = filtered(FIXED, times, 1.0 + 0.5 * np.sin(omega * times))
    late = times > 6 * period_us  # e^(−6·2π·a/ω) is below 1e-6 at all three
    late &= times > 12 * period_us - 4 * period_us
    basis = np.stack([np.sin(omega * times), np.cos(omega * times), np.ones(times.size)], axis=1)
    sine, cosine, mean = np.linalg.lstsq(basis[late], found[late], rcond=None)[0]
    # straight lines between 64 samples a period have a fundamental smaller by sinc²(1/64)
    gain = 0.5 * np.sinc(1 / 64) ** 2 / (1 + (omega / RATE) ** 2)
    assert np.hypot(sine, cosine) == pytest.approx(gain, rel=5e-4)
    assert np.arctan2(cosine, sine) == pytest.approx(-2 * np.arctan(omega / RATE), abs=1e-3)
    assert mean == pytest.approx(1.0, abs=1e-3)
    if frequency_hz == CUTOFF_HZ:
        assert gain / 0.5 == pytest.approx(1 / np.sqrt(2), rel=1e-3)


@pytest.mark.parametrize("spec", (FIXED, FOLLOWING), ids=("fixed", "following"))
def test_filter_does_not_depend_on_the_samples(spec):
    """One polygon of ln x, sampled at its corners and at 1, 2, 5 and 20 times as many points.

    Rounding of ln x up to 4 in single precision: 2.4e-7 for each of some 400 steps, most of it forgotten again.
    """
    corners = np.arange(0, 20_001, 1000)
    level = np.random.default_rng(0).uniform(0.2, 4.0, (corners.size, 8))
    arms = []
    for split in (1, 2, 5, 20):
        times = np.arange(0, 20_001, 1000 // split)
        values = np.stack([np.interp(times, corners, column) for column in level.T], axis=1)
        arms.append(filtered(spec, times, values)[::split])
    for other in arms[1:]:
        np.testing.assert_allclose(other, arms[0], rtol=0, atol=1e-5)
    assert np.std(arms[0][-1]) > 0.1


@pytest.mark.parametrize("approach", ("abrupt", "gradual"))
@pytest.mark.parametrize("signal_dn", (0.2, 10.0, 40.0, 100.0, 5000.0))
def test_corner_follows_the_light(signal_dn, approach):
    """Small ripples at 30 Hz on constant light: the corner rises from that of the dark to its largest at signal_dn, or
    is half of it there, in series with its limit."""
    corner = 3.0 + (CUTOFF_HZ - 3.0) * signal_dn / 100.0
    corner = min(corner, CUTOFF_HZ) if approach == "abrupt" else 1 / (1 / corner + 1 / CUTOFF_HZ)
    rate = 2 * np.pi * corner * 1e-6 / np.sqrt(np.sqrt(2) - 1)
    period_us, omega = 32_000, 2 * np.pi / 32_000
    times = np.arange(0, 12 * period_us, 500)
    found = filtered({**FOLLOWING, "approach": approach}, times, np.log1p(signal_dn) + 0.01 * np.sin(omega * times))
    late = times >= 8 * period_us
    basis = np.stack([np.sin(omega * times), np.cos(omega * times), np.ones(times.size)], axis=1)
    sine, cosine, _ = np.linalg.lstsq(basis[late], found[late], rcond=None)[0]
    assert np.hypot(sine, cosine) == pytest.approx(0.01 / (1 + (omega / rate) ** 2), rel=4e-3)
    assert np.arctan2(cosine, sine) == pytest.approx(-2 * np.arctan(omega / rate), abs=4e-3)


@pytest.mark.parametrize(
    ("rise_us", "every_us", "approach"),
    ((1, 250, "abrupt"), (70, 250, "abrupt"), (2000, 250, "abrupt"), (70, 250, "gradual"), (9000, 60_000, "abrupt"),
     (9000, 60_000, "gradual")),
)  # fmt: skip
def test_large_change_of_light_against_the_differential_equation(rise_us, every_us, approach):
    """From 0.5 to 300 DN and back: z' = a(u)(u − z), y' = a(u)(z − y), a following u at every instant.

    The corner follows the light, is at its limit, and is near that of the dark. A corner held at its value at the begin
    of a jump would be wrong by 0.3. Single precision is 1e-5, whatever the length of a line and the change on it.
    """
    corners_us = np.array([0, 2040, 2040 + rise_us, 12_000, 12_000 + rise_us, 60_000])
    level = np.log1p([0.5, 0.5, 300.0, 300.0, 0.5, 0.5])
    times = np.union1d(corners_us, np.r_[2500:12_000:every_us, 14_250:60_000:every_us])
    found = filtered({**FOLLOWING, "approach": approach}, times, np.interp(times, corners_us, level))

    def slope(t, state):
        u = np.interp(t, corners_us, level)
        line = 0.01 + 0.99 * np.expm1(u) / 100.0
        rate = (np.minimum(line, 1.0) if approach == "abrupt" else line / (1 + line)) * RATE
        return [rate * (u - state[0]), rate * (state[0] - state[1])]

    exact, state = [level[:1]], [level[0]] * 2
    for begin, end in zip(corners_us[:-1], corners_us[1:], strict=True):
        inside = times[(times > begin) & (times <= end)]
        step = max((end - begin) / 100, 1e-2)
        solved = integrate.solve_ivp(slope, (begin, end), state, t_eval=inside, max_step=step, rtol=1e-9, atol=1e-11)
        exact.append(solved.y[1])
        state = solved.y[:, -1]
    exact = np.concatenate(exact)
    assert np.abs(found - exact).max() < 1.2e-5
    # bright light is followed faster than dark: it falls more slowly than it rose
    if every_us == 250:
        assert exact[times == 6000] > 5.5 and exact[times == 18_000] > 3.0


@pytest.mark.parametrize("spec", (FIXED, FOLLOWING), ids=("fixed", "following"))
def test_a_settled_filter_rests_until_the_light_changes(spec):
    low_pass = photoreceptor.Photoreceptor(model(evs__photoreceptor=spec))
    dim, bright = logs([1.0, 2.0]), logs([1.0, 3.0])
    low_pass.follow(dim, 0)
    assert low_pass.rests(dim, 700)
    before = np.array(low_pass.follow(bright, 1000))
    assert not low_pass.rests(bright, 1100)  # one pixel of two is on its way
    np.testing.assert_allclose(before[0], 1.0, atol=1e-7)
    plain = photoreceptor.Photoreceptor(model(evs__photoreceptor=spec))
    plain.follow(dim, 700)
    np.testing.assert_array_equal(np.array(plain.follow(bright, 1000)), before)
    settled = np.array(low_pass.follow(bright, 1_000_000))
    np.testing.assert_allclose(settled, [1.0, 3.0], atol=3e-7)
    assert low_pass.rests(bright, 9_000_000) and low_pass.nodes_us(9_000_000) == []
    assert not low_pass.rests(dim, 9_000_500)


def test_static_light_stays_silent_behind_the_photoreceptor():
    for build in (model, asynchronous):
        noise = build(evs__photoreceptor=FOLLOWING)
        stage = EvsStage(noise, seed=1)
        level = np.random.default_rng(0).uniform(0, 6, (16, 16))
        assert sum(len(stage.step(electrons(level, noise), t)) for t in range(0, 30_001, 1500)) == 0


@pytest.mark.parametrize("every_us", (100, 1700, 40_000))
def test_ramp_through_the_photoreceptor(every_us):
    """Event times are the roots of y = s(t − 2/a + e^(−at)(t + 2/a)) = kθ, whatever the samples.

    Between nodes y is a straight line: (ah)²/8 · y″ with y″ up to s·a/e and ah = 0.305 shifts a crossing by up to
    1.5 µs, rounding up adds up to 1, single precision of ln x 0.1.
    """
    noise = asynchronous(evs__photoreceptor=FIXED)
    stage = EvsStage(noise, seed=1)
    slope = 1e-4
    times = np.unique(np.r_[np.arange(0, 40_000, every_us), 40_000])
    events = np.concatenate([stage.step(electrons(0.5 + slope * t, noise), int(t)) for t in times])
    one = events[(events["x"] == 2) & (events["y"] == 5)]
    final = slope * ramp_response(40_000.0)
    expected = [
        optimize.brentq(lambda t, k=k: slope * ramp_response(t) - 0.2 * k, 0, 41_000)
        for k in range(1, int(final / 0.2) + 1)
    ]
    assert len(one) == len(expected) > 15
    late = one["t_us"] - np.array(expected)
    assert late.min() > -0.2 and late.max() < 2.7
    # far into the ramp the filter is a delay of 2/a
    assert expected[-1] == pytest.approx(0.2 * len(expected) / slope + 2 / RATE, abs=1e-3)
    plain = noise.without("bandwidth")
    assert plain.photoreceptor is None
    stage = EvsStage(plain, seed=1)
    first = np.concatenate([stage.step(electrons(0.5 + slope * t, plain), int(t)) for t in times])["t_us"].min()
    assert 2000 <= first <= 2001


def test_previous_sample_compares_filtered_levels():
    """A rise of 1 within one tick reaches the comparator as differences of ramp responses, tick by tick."""
    rise = ramp_response(1000.0 * np.arange(1, 8)) - ramp_response(1000.0 * np.arange(0, 7))
    change = np.diff(rise / 1000, prepend=0.0)
    theta = np.sort(change)[::-1]  # thresholds halfway between what the ticks give
    for upper, lower in zip(theta[:-1], theta[1:], strict=True):
        halfway = float(np.sqrt(upper * lower))
        noise = model(evs__photoreceptor=FIXED, evs__contrast_threshold_on=halfway)
        stage = EvsStage(noise, seed=1)
        stage.step(electrons(0.3, noise), 1000)
        fired = [len(stage.step(electrons(1.3, noise), 1000 * (2 + k))) > 0 for k in range(7)]
        np.testing.assert_array_equal(fired, change > halfway)


# ---- refractory period ------------------------------------------------------------------------------


@pytest.mark.parametrize("every_us", (130, 999, 50_000))
@pytest.mark.parametrize("direction", (1, -1))
def test_rate_saturates_at_one_over_period_plus_theta_over_slope(direction, every_us):
    """Noise-free ramp: events at θ/s, then every T + θ/s exactly, on whichever samples and across them."""
    noise = asynchronous(evs__refractory_period_us=700, evs__contrast_threshold_off=0.25)
    stage = EvsStage(noise, seed=1)
    slope = 2e-4
    times = np.unique(np.r_[np.arange(0, 49_500, every_us), 49_500])
    level = 12.0 * (direction < 0) + 0.5 + direction * slope * times
    events = np.concatenate([stage.step(electrons(v, noise), int(t)) for t, v in zip(times, level, strict=True)])
    wait = (0.2 if direction > 0 else 0.25) / slope
    expected = wait + (700 + wait) * np.arange(50)
    expected = expected[expected <= 49_500]
    one = events[(events["x"] == 1) & (events["y"] == 9)]
    assert np.all(one["polarity"] == direction)
    assert len(one) == len(expected) and len(events) == 256 * len(one)
    # single precision of ln x, 1e-6, is 0.005 µs of this slope and adds up from event to event
    assert np.abs(one["t_us"] - expected).max() < 1.5
    rate = (len(one) - 1) / (one["t_us"][-1] - one["t_us"][0])
    assert rate == pytest.approx(1 / (700 + wait), rel=1e-4)
    free = EvsStage(noise.without("refractory"), seed=1)
    many = np.concatenate([free.step(electrons(v, noise), int(t)) for t, v in zip(times, level, strict=True)])
    assert len(many) == 256 * int(9.9 / (0.2 if direction > 0 else 0.25))


def brute_force(times_us, level, theta_on, theta_off, period_us):
    """One pixel on a polygon of its level, event by event."""
    reference, ready, found = level[0], -np.inf, []
    for t0, t1, y0, y1 in zip(times_us[:-1], times_us[1:], level[:-1], level[1:], strict=True):
        now = t0
        while True:
            if ready > t1:
                break
            if ready > now:
                now = ready
                reference = y0 + (y1 - y0) * (now - t0) / (t1 - t0)
            if y1 - reference >= theta_on:
                target, sign = reference + theta_on, 1
            elif reference - y1 >= theta_off:
                target, sign = reference - theta_off, -1
            else:
                break
            now = max(now, t0 + (target - y0) / (y1 - y0) * (t1 - t0))
            found.append((now, sign))
            ready = now + period_us
    return found


def test_noisy_pixels_against_a_pixel_by_pixel_version():
    """64 pixels with band-limited noise: every event, on the same noise."""
    noisy = [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.15, "beta5": 0.0}]
    noise = asynchronous(8, evs__coefficients=noisy, evs__refractory_period_us=900)
    stage = EvsStage(noise, seed=4, is_reset=True)
    events = np.concatenate([stage.step(electrons(0.0, noise), t) for t in range(0, 300_001, 3000)])
    process = BandNoise(noise, seed=4)
    nodes = np.arange(0, 300_000, 1e6 / (16 * 300.0))
    path = np.array([np.array(process.start(0)), *(np.array(process.at(t)) for t in nodes[1:])], dtype=float) * 0.15
    path = np.vstack([path, np.array(process.at(300_000.0)) * 0.15])
    nodes = np.append(nodes, 300_000.0)
    total = differing = 0
    for pixel in range(64):
        expected = brute_force(nodes, path[:, pixel], 0.2, 0.23, 900)
        one = events[(events["y"] * 8 + events["x"]) == pixel]
        total += len(expected)
        # one crossing that only just touches may fall to either side in single precision, and shift what follows
        same = len(one) == len(expected) and np.all(np.abs(one["t_us"] - [t for t, _ in expected]) < 2)
        differing += not (same and np.array_equal(one["polarity"], [sign for _, sign in expected]))
        assert np.diff(one["t_us"]).min() >= 900
    assert total > 1500
    assert differing <= 1


@pytest.mark.slow
def test_leak_events_rest_the_pixel_too():
    """Poisson events behind a dead time: a renewal process of mean T + 1/r; mean and variance at z = 5.5.

    The count's law is asymptotic; over 600 waits the next term of its mean, (σ² + μ²)/2μ² − μ₀/μ, is added.
    """
    rate_per_us, period_us, duration_us = 2e-3, 500, 600_000
    noise = asynchronous(64, evs__leak_rate_hz=rate_per_us * 1e6, evs__refractory_period_us=period_us)
    stage = EvsStage(noise, seed=2)
    events = np.concatenate([stage.step(electrons(1.0, noise), t) for t in range(0, duration_us + 1, 50_000)])
    pixel = events["y"].astype(int) * 64 + events["x"]
    counts = np.bincount(pixel, minlength=4096)
    wait, spread = period_us + 1 / rate_per_us, 1 / rate_per_us
    # the pixel begins ready: its first wait has mean 1/r only
    mean = duration_us / wait + (spread**2 + wait**2) / (2 * wait**2) - spread / wait
    variance = duration_us * spread**2 / wait**3
    assert abs(counts.mean() - mean) < 5.5 * np.sqrt(variance / counts.size)
    assert abs(counts.var() / variance - 1) < 5.5 * np.sqrt(2 / counts.size) + 2 / 600
    order = np.lexsort((events["t_us"], pixel))
    same = np.diff(pixel[order]) == 0
    assert np.diff(events["t_us"][order])[same].min() == period_us
    assert np.all(events["polarity"] == 1)


# ---- read-out limit ---------------------------------------------------------------------------------


def make_events(t_us, y=0, x=0):
    events = np.zeros(len(t_us), EVENT_DTYPE)
    events["t_us"], events["y"], events["x"], events["polarity"] = t_us, y, x, 1
    return events[np.lexsort((events["x"], events["y"], events["t_us"]))]


def queue(events, rate_hz, capacity, rows):
    """The buffer once more, event by event."""
    start = [(int(t) * 2654435769 % 2**32) * rows >> 32 for t in events["t_us"]]
    order = sorted(
        range(len(events)),
        key=lambda k: (events["t_us"][k], (int(events["y"][k]) - start[k]) % rows, events["x"][k]),
    )
    waiting, clock, kept = 0, 0, np.zeros(len(events), bool)
    for k in order:
        now = int(events["t_us"][k]) * rate_hz // 10**6
        waiting, clock = max(waiting - (now - clock), 0), now
        if waiting < capacity:
            waiting += 1
            kept[k] = True
    return kept


@pytest.mark.parametrize("capacity", (1, 7, 300))
def test_buffer_against_an_event_by_event_version(capacity):
    """Bursts and lulls, in one piece and in many."""
    rng = np.random.default_rng(capacity)
    t_us = np.concatenate([rng.integers(0, 40_000, 2000), rng.integers(10_000, 11_000, 3000)])
    events = make_events(t_us, rng.integers(0, 48, 5000), rng.integers(0, 64, 5000))
    kept = queue(events, 130_000, capacity, 48)
    assert 200 < kept.sum() < 4900
    whole = EventReadout(130_000, capacity, 48)
    np.testing.assert_array_equal(whole.take(events), events[kept])
    assert whole.dropped == np.sum(~kept)
    pieces = EventReadout(130_000, capacity, 48)
    cuts = np.searchsorted(events["t_us"], np.arange(0, 40_000, 777))
    joined = np.concatenate([pieces.take(part) for part in np.split(events, cuts)])
    np.testing.assert_array_equal(joined, events[kept])
    assert pieces.dropped == whole.dropped


@pytest.mark.parametrize("capacity", (1, 2, 5))
@pytest.mark.parametrize("load", (0.5, 1.0, 1.6))
def test_poisson_events_saturate_the_bus(load, capacity):
    """Poisson arrivals, one event per clock tick, room for `capacity`: the stationary law of the buffer.

    With A arrivals between two ticks the buffer goes w → max(min(w + A, B) − 1, 0); the bus is busy with
    probability 1 − P(w + A = 0). For B = 1 that is 1 − exp(−load). Batch means of 100 stretches; 9 × z = 6 of
    Student's law with 99 degrees of freedom (3e-8): a false alarm in 3 million runs.
    """
    clock_us, ticks = 10, 100_000
    rng = np.random.default_rng(int(10 * load) + capacity)
    t_us = np.sort(rng.integers(0, clock_us * ticks, rng.poisson(load * ticks)))
    kept = EventReadout(1e6 / clock_us, capacity, 1).take(make_events(t_us, 0, rng.integers(0, 64, t_us.size)))
    states = np.arange(capacity + 1)
    move = np.zeros((capacity + 1, capacity + 1))
    for w in states:
        arrivals = stats.poisson.pmf(np.arange(capacity - w), load)
        for a, p in enumerate(arrivals):
            move[w, max(w + a - 1, 0)] += p
        move[w, max(capacity - 1, 0)] += 1 - arrivals.sum()
    values, vectors = np.linalg.eig(move.T)
    law = np.real(vectors[:, np.argmax(values.real)])
    law /= law.sum()
    busy = 1 - law[0] * np.exp(-load)
    if capacity == 1:
        assert busy == pytest.approx(1 - np.exp(-load), rel=1e-12)
    batches = np.bincount(kept["t_us"] // (clock_us * ticks // 100), minlength=100) / (ticks / 100)
    assert abs(batches.mean() - busy) < 6 * batches.std(ddof=1) / 10


def test_one_flash_of_all_pixels():
    """A tick sees every pixel fire: as many as fit get through, from a row that moves; all are counted."""
    noise = model(64, evs__readout_max_events_per_s=1e6, evs__readout_buffer_events=640)
    stage = EvsStage(noise, seed=1)
    stage.step(electrons(1.0, noise), 1000)
    rows = np.zeros(64, int)
    for k in range(400):
        t_us = 2000 + 1000 * k
        events = stage.step(electrons(1.0 + 0.5 * (k % 2 == 0), noise), t_us)
        assert len(events) == 640
        start = int(scan_start_row(np.array([t_us]), 64)[0])
        np.testing.assert_array_equal(np.unique(events["y"]), np.sort((start + np.arange(10)) % 64))
        order = np.lexsort((events["x"], events["y"], events["t_us"]))
        np.testing.assert_array_equal(order, np.arange(640))
        rows += np.bincount(events["y"], minlength=64) // 64
    assert stage.dropped == 400 * (4096 - 640)
    # 400 starts of 10 rows: 62.5 for each row; a golden-section sequence is even to a few
    assert np.abs(rows - 62.5).max() < 4
    free = noise.without("readout_limit")
    stage = EvsStage(free, seed=1)
    stage.step(electrons(1.0, noise), 1000)
    assert len(stage.step(electrons(1.5, noise), 2000)) == 4096 and stage.dropped == 0


def test_default_buffer_is_what_one_tick_reads():
    assert model(evs__readout_max_events_per_s=2e6).readout_buffer_events == 2000
    assert asynchronous(evs__tick_us=None, evs__readout_max_events_per_s=3e6).readout_buffer_events == 3000
    assert model(evs__readout_max_events_per_s=1.0).readout_buffer_events == 1


class Flicker(WindowByWindow):
    """A source of flux that goes up and down between slices."""

    is_static = False

    def slice_edges_us(self, begin_us, end_us):
        edges = np.arange(1000.0, end_us, 1000.0)
        return edges[edges > begin_us]

    sample_times_us = slice_edges_us

    def mean_flux(self, pixel, begin_us, end_us):
        level = 40_000.0 if int(np.min(begin_us)) // 1000 % 2 else 20_000.0
        flux = dr.full(jit().Float, level, pixel.size)
        return flux, flux


def test_recording_tells_what_was_lost(tmp_path):
    sensor = hr.load_sensor("reference-mono", {"evs.readout_max_events_per_s": 1e5}).crop(16, 16)
    _, evs = noise_models(sensor, without=[f"evs.{t}" for t in EVS_TERMS if t != "readout_limit"])
    capture = Capture(Flicker(), sensor, None, evs, 10_000, seed=1)
    with RecordingWriter(tmp_path / "r", sensor, seed=1, duration_us=10_000) as writer:
        for item in capture.run():
            writer.add_events(item)
        writer.set_events_dropped(capture.events_dropped)
        recording = writer.finish()
    counts = recording.manifest["counts"]
    assert counts["events"] == recording.events.size == 9 * 100
    assert counts["events_dropped"] == 9 * (256 - 100)
    copy = Recording.load(recording.save(tmp_path / "copy"))
    assert copy.manifest["counts"] == counts
    with RecordingWriter(None, sensor, seed=1, duration_us=10_000) as writer:
        writer.set_events_dropped(5)
        assert writer.finish().manifest["counts"]["events_dropped"] == 5


# ---- all --------------------------------------------------------------------------------------------

ALL = {
    "evs__photoreceptor": FOLLOWING, "evs__refractory_period_us": 500, "evs__readout_max_events_per_s": 1e5,
    "evs__leak_rate_hz": 5.0, "evs__threshold_mismatch_rel": 0.1,
    "evs__coefficients": [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.1, "beta5": 0.0}],
}  # fmt: skip


def test_switched_off_they_leave_no_trace():
    """With the terms off by name, events are bit for bit those of a file without the keys."""
    plain = asynchronous(
        **{k: ALL[k] for k in ("evs__leak_rate_hz", "evs__threshold_mismatch_rel", "evs__coefficients")}
    )
    limited = asynchronous(**ALL).without("bandwidth", "refractory", "readout_limit")
    level = np.random.default_rng(0).uniform(0, 3, (20, 16, 16))
    arms = []
    for noise in (plain, limited, asynchronous(**ALL)):
        stage = EvsStage(noise, seed=3)
        arms.append(np.concatenate([stage.step(electrons(v, noise), 2000 * k) for k, v in enumerate(level)]))
    np.testing.assert_array_equal(arms[0], arms[1])
    assert 0 < len(arms[2]) < len(arms[0])
    clean = asynchronous(**ALL).clean()
    assert clean.photoreceptor is clean.refractory_period_us is clean.readout_max_events_per_s is None


def test_all_together_do_not_depend_on_the_samples():
    """One seed, light that follows a polygon, sampled once or five times a side: the same events to rounding."""
    noise = asynchronous(32, **{**ALL, "evs__readout_max_events_per_s": None})
    corners = np.arange(0, 60_001, 3000)
    level = np.random.default_rng(1).uniform(0, 0.4, (corners.size, 32, 32))
    arms = []
    for split in (1, 5):
        stage, parts = EvsStage(noise, seed=9), []
        for t in range(0, 60_001, 3000 // split):
            k, part = min(t // 3000, 19), t / 3000 - min(t // 3000, 19)
            parts.append(stage.step(electrons(level[k] + part * (level[k + 1] - level[k]), noise), t))
        arms.append(np.concatenate(parts))
    few, many = (len(a) for a in arms)
    assert few > 3000
    # s/x is taken as linear in time between samples: up to 0.4²/8 = 2 % off where ln x changes by 0.4
    assert abs(few - many) <= 0.02 * few


@pytest.mark.parametrize(
    ("changes", "message"),
    (
        ({"evs.refractory_period_us": 500}, "last_event"),
        ({"evs.readout_buffer_events": 5}, "readout_max_events_per_s"),
        ({"evs.photoreceptor": {"cutoff_hz": 300.0}}, "needs signal_dn and min_cutoff_hz"),
        ({"evs.photoreceptor": {**FOLLOWING, "min_cutoff_hz": 400.0}}, "above cutoff_hz"),
        ({"evs.photoreceptor": {**FIXED, "signal_dn": 10.0}}, "leave signal_dn"),
        ({"evs.photoreceptor": FOLLOWING, "evs.coefficients.0.beta1": 0.0}, "beta1 above 0"),
        ({"evs.photoreceptor": {"corner": 3.0}}, "corner"),
    ),
)
def test_keys_that_do_not_fit(changes, message):
    with pytest.raises(SpecError, match=message):
        read_sensor("reference-mono", changes)


@pytest.mark.parametrize("rows", [1, 7, 480])
def test_the_scan_begins_at_rows_of_the_golden_section(rows):
    t_us = np.array([0, 1, 2, 3, 5, 1_000_003, 2**33 + 7])
    exact = [Fraction(int(t) * 2654435769, 2**32) % 1 * rows for t in t_us]
    assert scan_start_row(t_us, rows).tolist() == [math.floor(place) for place in exact]
