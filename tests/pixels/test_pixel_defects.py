"""Pixels that misbehave: stuck, hot and flickering event pixels, telegraph noise of frames, against closed forms."""

import numpy as np
import pytest
from scipy import stats

import hesim_render as hr
from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps
from hesim_render.calibrate.aps.telegraph import _suspects, fit_two_levels
from hesim_render.calibrate.evs.counts import read_static
from hesim_render.calibrate.flicker import dynamics, unsteady
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.calibrate.summary import summary_lines
from hesim_render.capture.lab import write_captures
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal
from hesim_render.pixels.aps.model import APS_TERMS
from hesim_render.pixels.evs import formulas as evs_formulas
from hesim_render.pixels.evs.defects import DefectEvents, PixelDefects
from hesim_render.pixels.evs.events import Origin
from hesim_render.pixels.evs.model import EVS_TERMS
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.pixels.poisson_points import PoissonPoints, Telegraph
from hesim_render.recording.capture_set import read_captures

SIDE = 96
SILENT = [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.0, "beta5": 0.0}]


def sensor(**overrides):
    """reference-mono without noise of its events, SIDE × SIDE."""
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    size = {"geometry.rows": SIDE, "geometry.cols": SIDE, "evs.coefficients": SILENT}
    return hr.load_sensor("reference-mono", {**size, **changes})


def step_through(stage, times_us, electrons=50.0):
    """Events of a stage in constant light."""
    rows, cols = stage.noise.layout.evs_shape
    light = from_host(jit().Float, np.full(rows * cols, electrons, np.float32))
    return np.concatenate([stage.step(light, t) for t in times_us])


def place(events):
    return events["y"].astype(int) * SIDE + events["x"]


# ---- points and telegraph signals as pure functions of time -------------------------------------------


def test_points_are_a_poisson_process():
    """Counts, waiting times and marks; 7 scores and 2 Kolmogorov tests at 1e-5: false alarm 1e-4."""
    rate = np.full(400, 30.0)
    points = PoissonPoints(3, Stream.HOT_EVENTS, np.arange(400, dtype=np.uint32), rate)
    which, t_us, mark = points.between(1234.5, 10e6 + 1234.5)
    counts = np.bincount(which, minlength=400)
    assert abs(counts.mean() - 300) < 4.5 * np.sqrt(300 / 400)
    assert abs(counts.var(ddof=1) / 300 - 1) < 4.5 * np.sqrt(2 / 399)
    order = np.lexsort((t_us, which))
    waiting = np.diff(t_us[order])[np.diff(which[order]) == 0]
    assert stats.kstest(waiting * 30e-6, "expon").pvalue > 1e-5
    assert stats.kstest(mark, "uniform").pvalue > 1e-5
    # independent from stretch to stretch, and of the waiting time
    halves = [np.bincount(which[use], minlength=400) for use in (t_us < 5e6, t_us >= 5e6)]
    assert abs(np.corrcoef(*halves)[0, 1]) < 4.5 / np.sqrt(400)
    same = np.diff(which[order]) == 0
    assert abs(np.corrcoef(mark[order][1:][same], waiting)[0, 1]) < 4.5 / np.sqrt(waiting.size)
    # each point has a mark of its own, which is also that of the last point
    assert abs(np.corrcoef(mark[order][1:][same], mark[order][:-1][same])[0, 1]) < 4.5 / np.sqrt(waiting.size)
    np.testing.assert_array_equal(points.last_mark(which, t_us), mark)


def test_points_do_not_depend_on_how_they_are_asked_for():
    key, rate = np.array([7, 900_000, 12], np.uint32), np.array([1e3, 2.0, 0.01])
    whole = PoissonPoints(1, Stream.HOT_EVENTS, key, rate).between(-5e5, 3e6)
    parts, edges = [], np.sort(np.r_[-5e5, 3e6, np.random.default_rng(0).uniform(-5e5, 3e6, 37)])
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        parts.append(PoissonPoints(1, Stream.HOT_EVENTS, key, rate).between(begin, end))
    joined = [np.concatenate(values) for values in zip(*parts, strict=True)]
    joined = [values[np.lexsort((joined[1], joined[0]))] for values in joined]
    order = np.lexsort((whole[1], whole[0]))
    for ours, theirs in zip(whole, joined, strict=True):
        np.testing.assert_array_equal(ours[order], theirs)
    one = PoissonPoints(1, Stream.HOT_EVENTS, key[1:2], rate[1:2]).between(-5e5, 3e6)
    np.testing.assert_array_equal(np.sort(one[1]), np.sort(whole[1][whole[0] == 1]))


def test_telegraph_signal_is_the_markov_process():
    """Share, and chance of a state after a state at several lags, p + (1 − p) e^(−λΔt); 12 scores: false alarm 1e-4."""
    n, high_s, low_s = 40_000, 0.02, 0.06
    share, rate = high_s / (high_s + low_s), 1 / high_s + 1 / low_s
    every = np.arange(n)
    signal = Telegraph(9, Stream.TELEGRAPH, every.astype(np.uint32), np.full(n, rate), np.full(n, share))
    first = signal.is_high(every, np.full(n, 1e6))
    scores = [(first.mean() - share) / np.sqrt(share * (1 - share) / n)]
    for lag_s in (1e-4, 3e-3, 0.015, 0.04, 0.5):
        later = signal.is_high(every, np.full(n, 1e6 + lag_s * 1e6))
        stay = np.exp(-rate * lag_s)
        for start, chance in ((first, share + (1 - share) * stay), (~first, share * (1 - stay))):
            scores.append((later[start].mean() - chance) / np.sqrt(chance * (1 - chance) / start.sum()))
    assert np.abs(scores).max() < 4.7
    assert np.std(scores) > 0.3
    # given the present, the past tells nothing: three times
    middle, last = (signal.is_high(every, np.full(n, 1e6 + t)) for t in (1e4, 2e4))
    stay = np.exp(-rate * 0.01)
    for past in (first, ~first):
        use, chance = past & middle, share + (1 - share) * stay
        assert abs(last[use].mean() - chance) < 4.5 * np.sqrt(chance * (1 - chance) / use.sum())


# ---- event pixels --------------------------------------------------------------------------------------

DEFECTS = {
    "stuck_share": 0.05, "hot_share": 0.05, "hot_rate_hz": 200.0, "flickering_share": 0.05,
    "flickering_rate_hz": 300.0, "flickering_firing_s": 0.02, "flickering_quiet_s": 0.06,
}  # fmt: skip


def test_shares_and_rates_are_the_files():
    """Numbers of each kind are binomial, rates log-normal; 5 scores: false alarm 1e-4."""
    noise = sensor(evs__defects={**DEFECTS, "hot_rate_spread_decades": 0.5}).evs
    found, n = noise.defects, SIDE * SIDE
    hot = found.change_hz == 0
    for count in (found.stuck.size, hot.sum(), (~hot).sum()):
        assert abs(count - 0.05 * n) < 4.3 * np.sqrt(0.05 * 0.95 * n)
    decades = np.log10(found.on_hz[hot] / 200.0)
    assert abs(decades.mean()) < 4.3 * 0.5 / np.sqrt(hot.sum())
    assert abs(decades.std() / 0.5 - 1) < 4.3 / np.sqrt(2 * hot.sum())
    # a device of a seed stays that device: the deviates are those of its own stream, signs included
    own = device_normal(noise.device_seed, Stream.EVENT_DEFECT_RATE, found.key[hot])
    np.testing.assert_allclose(decades, 0.5 * own.astype(float), atol=1e-6)
    assert np.all(found.on_hz[~hot] == 300) and not found.off_hz.any()
    np.testing.assert_allclose(found.firing_share[~hot], 0.25)
    np.testing.assert_allclose(found.change_hz[~hot], 50 + 1 / 0.06)
    assert np.unique(np.concatenate([found.stuck, found.place])).size == found.stuck.size + found.place.size
    # of the device: a crop has those of the whole, another device others
    whole = sensor(evs__defects=DEFECTS)
    part = whole.crop(32, 32, 16, 48).evs
    seen = set(part.layout.full_index.ravel()[part.defects.stuck])
    inside = {k for k in whole.evs.defects.stuck if 48 <= k // SIDE < 80 and 16 <= k % SIDE < 48}
    assert seen == inside and inside
    other = sensor(evs__defects=DEFECTS, device_seed=99).evs.defects.stuck
    assert not np.array_equal(other, whole.evs.defects.stuck)


@pytest.mark.parametrize("reference", (pytest.param("previous_sample", marks=pytest.mark.slow), "last_event"))
def test_hot_and_flickering_pixels_fire_as_their_closed_forms(reference):
    """Mean and variance of counts over pixels, and no event elsewhere; 4 scores: false alarm 1e-4.

    At a tick there is an event with 1 − e^(−rΔt); counts of hot pixels are binomial or Poisson.
    """
    ticks = 1000
    extra = {} if reference == "previous_sample" else {"evs__noise_cutoff_hz": 300.0}
    noise = sensor(evs__defects=DEFECTS, evs__reference=reference, **extra).evs
    found = noise.defects
    times = range(1000, 1000 * (ticks + 1) + 1, 1000 if reference == "previous_sample" else 25_000)
    events = step_through(
        EvsStage(noise, 5), [*times, 1000 * (ticks + 1)] if times[-1] != 1000 * (ticks + 1) else times
    )
    assert np.all(events["polarity"] == 1)
    counts = np.bincount(place(events), minlength=SIDE * SIDE)
    hot = found.place[found.change_hz == 0]
    flickering = found.place[found.change_hz > 0]
    assert counts.sum() == counts[hot].sum() + counts[flickering].sum()
    if reference == "previous_sample":
        chance = -np.expm1(-0.2)
        mean, variance = ticks * chance, ticks * chance * (1 - chance)
    else:
        mean = variance = 200.0 * ticks * 1e-3
    n = hot.size
    assert abs(counts[hot].mean() - mean) < 4.2 * np.sqrt(variance / n)
    assert abs(counts[hot].var(ddof=1) / variance - 1) < 4.2 * np.sqrt(2 / n)
    # a telegraph signal of rate λ averaged over T ≫ 1/λ: variance 2 r² p (1 − p) T/λ; ticks of λΔt = 0.07 change 0.1 %
    rate, total_s = 300.0, ticks * 1e-3
    if reference == "previous_sample":
        rate = -np.expm1(-0.3) * 1e3
    switch = 50 + 1 / 0.06
    mean = rate * 0.25 * total_s
    spread = 2 * rate**2 * 0.25 * 0.75 / switch * (total_s - (1 - np.exp(-switch * total_s)) / switch)
    own = mean if reference == "last_event" else mean * (1 - rate * 1e-3)
    n = flickering.size
    # the state may change within a tick, which lowers a tick's chance by up to 0.3·λΔt/2·(1 − p)·0.15 < 0.3 %
    assert abs(counts[flickering].mean() - mean) < 4.2 * np.sqrt((spread + own) / n) + 3e-3 * mean
    assert abs(counts[flickering].var(ddof=1) / (spread + own) - 1) < 4.2 * np.sqrt(2.3 / n)


def test_share_and_rate_of_a_flickering_pixel():
    assert evs_formulas.firing_share(0.2, 0.5) == pytest.approx(2 / 7)
    assert evs_formulas.change_rate_hz(0.2, 0.5) == pytest.approx(7.0)


def test_every_flickering_pixel_has_quiet_times_and_those_of_a_single_one_are_its_own():
    """800 Hz during 0.2 s, then none during 0.5 s: a gap of 0.1 s by chance has e⁻⁸⁰."""
    rates = [*(np.full(3, value) for value in (500.0, 300.0, 2 / 7)), np.array([7.0, 0.9, 7.0])]
    defects = PixelDefects(np.empty(0, int), np.array([4, 7, 9]), np.array([40, 70, 90], np.uint32), *rates)
    t_us, pixel, polarity = DefectEvents(defects, 5).between(0, 20e6)
    for one in (4, 7, 9):
        assert np.diff(t_us[pixel == one]).max() > 1e5, one
    assert abs(np.mean(polarity > 0) - 5 / 8) < 4.5 * np.sqrt(15 / 64 / t_us.size)
    quick = np.isin(pixel, (4, 9))  # some 57 spells of firing
    assert abs(quick.sum() / (2 * 20 * 800 * 2 / 7) - 1) < 0.4


def test_at_a_tick_the_first_event_of_a_pixel_counts():
    rates = [np.full(3, value) for value in (600.0, 500.0, 1.0, 0.0)]
    defects = PixelDefects(np.array([2]), np.array([0, 1, 4]), np.array([40, 70, 90], np.uint32), *rates)
    events, given = DefectEvents(defects, 5), np.array([0, 0, 1, -1, -1, 0], np.int8)
    for begin_us in range(0, 200_000, 10_000):
        _, place_, polarity = events.between(begin_us, begin_us + 10_000)
        first = {int(where): int(sign) for where, sign in zip(place_[::-1], polarity[::-1], strict=True)}
        expected = [Origin.DEFECT * first[0], Origin.DEFECT * first[1], 0, -1, -1, 0]
        assert events.at_tick(given, begin_us, begin_us + 10_000).tolist() == expected


def test_moments_of_flicker_are_their_sums():
    n, r, p, c = 40, 0.3, 0.2, 0.9
    lag = np.abs(np.subtract.outer(np.arange(2 * n), np.arange(2 * n)))
    covariance = r**2 * p * (1 - p) * c**lag
    np.fill_diagonal(covariance, r * p * (1 - r * p))
    mean, variance, neighbour = evs_formulas.flicker_moments(r, p, c, n)
    assert mean == pytest.approx(n * r * p)
    assert variance == pytest.approx(covariance[:n, :n].sum(), rel=1e-12)
    assert neighbour == pytest.approx(covariance[:n, n:].sum(), rel=1e-12)


def test_stuck_pixels_see_nothing_and_the_others_what_they_saw():
    plain, broken = sensor(), sensor(evs__defects={"stuck_share": 0.1})
    light = [from_host(jit().Float, np.full(SIDE * SIDE, value, np.float32)) for value in (50.0, 80.0, 50.0)]

    def events(given):
        stage = EvsStage(given.evs, 1)
        return np.concatenate([stage.step(values, 1000 * (k + 1)) for k, values in enumerate(light)])

    all_of_them, fewer = events(plain), events(broken)
    assert all_of_them.size == 2 * SIDE * SIDE
    stuck = broken.evs.defects.stuck
    np.testing.assert_array_equal(fewer, all_of_them[~np.isin(place(all_of_them), stuck)])
    moving = {"evs.reference": "last_event", "evs.noise_cutoff_hz": 300.0}
    asynchronous = hr.load_sensor("reference-mono", {
        "geometry.rows": SIDE, "geometry.cols": SIDE, "evs.coefficients": SILENT,
        "evs.defects": {"stuck_share": 0.1}, **moving,
    })  # fmt: skip
    found = place(events(asynchronous))
    assert np.array_equal(np.setdiff1d(np.arange(SIDE * SIDE), found), stuck) and stuck.size > 500


@pytest.mark.parametrize("reference", ("previous_sample", "last_event"))
def test_events_of_defects_are_the_same_bits_however_a_run_is_cut(reference):
    """Split in two, cropped, and for an asynchronous sensor sampled at other times."""
    extra = {"evs__reference": reference, "evs__noise_cutoff_hz": 300.0}
    given = sensor(evs__defects=DEFECTS, **extra)
    times = list(range(1000, 61_000, 1000))
    whole = step_through(EvsStage(given.evs, 5), times)
    assert whole.size > 1000
    first = EvsStage(given.evs, 5)
    begin = step_through(first, times[:23])
    second = EvsStage(given.evs, 5)
    second.resume(first.state())
    assert np.concatenate([begin, step_through(second, times[23:])]).tobytes() == whole.tobytes()
    part = step_through(EvsStage(given.crop(32, 16, 32, 48).evs, 5), times)
    inside = whole[(whole["x"] >= 32) & (whole["x"] < 64) & (whole["y"] >= 48) & (whole["y"] < 64)]
    assert len(part) == len(inside) and np.array_equal(part["t_us"], inside["t_us"])
    np.testing.assert_array_equal(part["x"] + 32, inside["x"])
    if reference == "last_event":
        sparse = step_through(EvsStage(given.evs, 5), [1000, 1777, 30_001, 60_000])
        assert sparse.tobytes() == whole.tobytes()
    assert step_through(EvsStage(given.evs, 6), times).tobytes() != whole.tobytes()


def test_hot_events_wait_for_the_dead_time():
    """Events of rate r with a dead time T come at r/(1 + rT)."""
    spec = {"hot_share": 0.2, "hot_rate_hz": 1000.0}
    given = sensor(
        evs__defects=spec,
        evs__reference="last_event",
        evs__noise_cutoff_hz=300.0,
        evs__refractory_period_us=2000,
    ).evs
    events = step_through(EvsStage(given, 5), [0, 100_000, 200_000, 300_000])
    order = np.lexsort((events["t_us"], place(events)))
    gaps = np.diff(events["t_us"][order])[np.diff(place(events)[order]) == 0]
    assert gaps.min() >= 2000
    n, rate = given.defects.place.size, 1000 / (1 + 2)
    # a renewal process: variance of a count is rate·T·(relative variance of a gap), (1/3)² here
    assert abs(events.size / n - 0.3 * rate) < 4.5 * np.sqrt(0.3 * rate / 9 / n) + 0.7  # the first gap has no dead time


def test_terms_are_switched_off_by_name():
    given = sensor(
        evs__defects=DEFECTS, aps__telegraph={"share": 0.1, "amplitude_e": 20.0, "high_s": 0.1, "low_s": 0.1}
    )
    assert {"stuck", "hot", "flickering"} < set(EVS_TERMS) and "telegraph" in APS_TERMS
    found = given.evs.defects
    for term in ("stuck", "hot", "flickering"):
        left = given.evs.without(term).defects
        assert (left.stuck.size == found.stuck.size) == (term != "stuck")
        assert (np.sum(left.change_hz == 0) == np.sum(found.change_hz == 0)) == (term != "hot")
        assert (np.sum(left.change_hz > 0) == np.sum(found.change_hz > 0)) == (term != "flickering")
    aps, evs = noise_models(given, without=["aps.telegraph", "evs.stuck", "evs.hot", "evs.flickering"])
    assert aps.telegraph is None and not evs.defects
    plain = sensor()
    image = np.full((SIDE, SIDE), 300.0)
    np.testing.assert_array_equal(aps.sample(image, 10_000, 1, 4), plain.aps.sample(image, 10_000, 1, 4))
    jumping = given.aps.sample(image, 10_000, 1, 4) != plain.aps.sample(image, 10_000, 1, 4)
    assert set(np.flatnonzero(jumping)) <= set(given.aps.telegraph.place) and jumping.sum() > 500


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("evs.defects", {"hot_share": 0.1}, "hot_share needs hot_rate_hz"),
        ("evs.defects", {"flickering_share": 0.1, "flickering_rate_hz": 3.0}, "flickering_share needs"),
        ("evs.defects", {"stuck_share": 0.3, "hot_share": 0.3, "hot_rate_hz": 1.0}, "add up to more than 0.5"),
        ("evs.defects", {"stuck": 0.3}, "unknown key"),
        ("aps.telegraph", {"share": 0.1, "amplitude_e": 1.0, "high_s": 1.0}, "low_s: required key is missing"),
        ("aps.telegraph", {"share": 0.1, "amplitude_e": -1.0, "high_s": 1.0, "low_s": 1.0}, "amplitude_e"),
    ],
)
def test_wrong_keys_are_told(key, value, text):
    with pytest.raises(SpecError, match=text):
        hr.load_sensor("reference-mono", {key: value})


# ---- frame pixels --------------------------------------------------------------------------------------


def test_telegraph_noise_has_its_variance_and_autocovariance():
    """Values of noiseless pixels: two levels, mean 0, a² p (1 − p), exp(−Δt/τ); 4 scores: false alarm 1e-4."""
    given = sensor(
        aps__telegraph={"share": 0.5, "amplitude_e": 40.0, "amplitude_law": "equal", "high_s": 0.05, "low_s": 0.2}
    ).aps
    jumps = given.telegraph
    n, p, a = jumps.place.size, 0.2, 40.0 * 0.2
    assert abs(n - SIDE**2 / 2) < 4.5 * SIDE / 2
    first = jumps.values_dn(8, 5)
    np.testing.assert_allclose(np.unique(first), [-a * p, a * (1 - p)])
    variance = a**2 * p * (1 - p)
    np.testing.assert_allclose(jumps.variance_dn2, variance)
    assert abs(first.mean()) < 4.3 * np.sqrt(variance / n)
    fourth = a**4 * p * (1 - p) * ((1 - p) ** 3 + p**3)
    assert abs(np.mean(first**2) / variance - 1) < 4.3 * np.sqrt((fourth / variance**2 - 1) / n)
    correlation = np.exp(-(1 / 0.05 + 1 / 0.2) / 30)
    # 16 stretches far apart; a product has a variance of 2.25 V² and less
    pairs = [[jumps.values_dn(8, 1000 * k + step) for step in (0, 1, 500)] for k in range(16)]
    for later, expected in ((1, correlation), (2, 0.0)):
        found = np.mean([stretch[0] * stretch[later] for stretch in pairs]) / variance
        assert abs(found - expected) < 4.3 * 1.5 / np.sqrt(16 * n)
    # in frames: without other noise, and in the variance of the model
    image = np.full((SIDE, SIDE), 500.0)
    quiet = given.without(*[term for term in APS_TERMS if term != "telegraph"])
    raw = quiet.sample(image, 10_000, 8, 5).ravel().astype(float)
    expected = np.full(SIDE**2, 164.0)
    expected[jumps.place] += first
    assert np.abs(raw - np.rint(expected)).max() <= 0
    more = given.variance_dn2(image, 10_000) - given.without("telegraph").variance_dn2(image, 10_000)
    np.testing.assert_allclose(more.ravel()[jumps.place], variance)
    assert np.count_nonzero(more) == n
    # pieces and crops have the same bits
    flat = from_host(jit().Float, np.full(700, 500.0, np.float32))
    piece = given.sample_dn(flat, 10_000, 8, 5, first_pixel=1000).numpy()
    np.testing.assert_array_equal(piece, given.sample(image, 10_000, 8, 5).ravel()[1000:1700])


def test_amplitudes_are_exponential():
    """Kolmogorov, false alarm 1e-5."""
    jumps = sensor(aps__telegraph={"share": 0.5, "amplitude_e": 40.0, "high_s": 0.05, "low_s": 0.2}).aps.telegraph
    assert stats.kstest(jumps.amplitude_dn / 8.0, "expon").pvalue > 1e-5


# ---- from captures to a sensor that misbehaves alike ---------------------------------------------------

BROKEN = {
    "evs.contrast_threshold_on": 0.15, "evs.contrast_threshold_off": 0.153, "evs.threshold_mismatch_rel": 0.05,
    "evs.defects": {
        "stuck_share": 0.004, "hot_share": 0.006, "hot_rate_hz": 120.0, "hot_rate_spread_decades": 0.2,
        "flickering_share": 0.006, "flickering_rate_hz": 150.0, "flickering_firing_s": 0.15, "flickering_quiet_s": 0.3,
    },
}  # fmt: skip
EVS_SIDE, TICKS, PARTS = 128, 4800, 64


@pytest.fixture(scope="module")
def events_session(tmp_path_factory):
    """(sensor, calibration file) of a session of eiger with defects, on a part of it; events alone are calibrated."""
    folder = tmp_path_factory.mktemp("defects")
    given = hr.load_sensor("eiger", BROKEN).crop(EVS_SIDE, EVS_SIDE)
    write_captures(given, folder / "captures", frames=8, ticks=TICKS, parts=PARTS, seed=3)
    calibrate_evs(folder / "captures", folder / "c.yaml", folder / "report.html")
    return given, folder / "c.yaml"


def test_defects_of_events_are_found_and_named(events_session):
    given, file = events_session
    true, maps, section = given.evs.defects, read_maps(file, "evs"), read_calibration(file)["evs"]
    kind = maps["defect"].ravel()
    steady = true.change_hz == 0
    expected = np.zeros(kind.size, np.uint8)
    expected[true.stuck], expected[true.place[steady]], expected[true.place[~steady]] = 1, 2, 3
    assert min(np.sum(expected == k) for k in (1, 2, 3)) >= 10
    np.testing.assert_array_equal(kind, expected)  # and no good pixel is called bad
    assert section["defects"] == {
        "stuck": np.sum(expected == 1), "hot": np.sum(expected == 2), "flickering": np.sum(expected == 3), "other": 0
    }  # fmt: skip
    text = f"{section['defects']['stuck']} stuck, {section['defects']['hot']} hot"
    assert text in file.with_name("report.html").read_text() and any(
        text in line for line in summary_lines({"evs": section}, "evs")
    )
    # the rate of a hot pixel to its counting error: both sessions, less what noise adds; false alarm 1e-4
    tick_s = given.spec.evs.tick_us * 1e-6
    chance = -np.expm1(-true.on_hz[steady] * tick_s)
    error = np.sqrt(chance * (1 - chance) / (2 * TICKS))
    score = (-np.expm1(-maps["defect_on_hz"].ravel()[true.place[steady]] * tick_s) - chance) / error
    assert np.abs(score).max() < 4.8 and 0.5 < score.std() < 1.6
    assert maps["defect_off_hz"].max() * tick_s < 2e-3 and section["tick_us"] == given.spec.evs.tick_us


def test_a_calibrated_sensor_misbehaves_alike(events_session):
    given, file = events_session
    true = given.evs.defects
    again = hr.load_sensor("eiger", {"noise": str(file)}).crop(EVS_SIDE, EVS_SIDE)
    found = again.evs.defects
    np.testing.assert_array_equal(found.stuck, true.stuck)
    np.testing.assert_array_equal(np.sort(found.place), np.sort(true.place))
    order = np.argsort(true.place)
    steady = (true.change_hz == 0)[order]
    np.testing.assert_array_equal(found.change_hz == 0, steady)
    ratio = found.on_hz[steady] / true.on_hz[order][steady]
    assert np.abs(ratio - 1).max() < 0.25 and abs(np.median(ratio) - 1) < 0.05
    # times of flickering ones, each from 64 parts of 0.12 s: their median is right to a fifth
    flicker = ~steady
    for name, expected in (("on_hz", 150.0), ("change_hz", 10.0), ("firing_share", 1 / 3)):
        assert np.median(getattr(found, name)[flicker]) == pytest.approx(expected, rel=0.25), name
    # events in the dark: the sum over pixels of each kind is that of the captures
    rows, cols = again.layout.evs_shape
    dark = from_host(jit().Float, np.zeros(rows * cols, np.float32))
    counts = np.zeros((2, rows * cols))
    tick_us = given.spec.evs.tick_us
    for k, one in enumerate((given, again)):
        stage = EvsStage(one.evs, 11 + k)
        for t in range(1500):
            events = stage.step(dark, (t + 1) * tick_us)
            counts[k] += np.bincount(events["y"].astype(int) * cols + events["x"], minlength=rows * cols)
    assert not counts[:, true.stuck].any()
    hot = true.place[true.change_hz == 0]
    for where, tolerance in ((hot, 0.1), (true.place[true.change_hz > 0], 0.3)):
        assert counts[1][where].sum() == pytest.approx(counts[0][where].sum(), rel=tolerance)
    assert np.corrcoef(counts[0][hot], counts[1][hot])[0, 1] > 0.85
    assert not again.evs.without("stuck", "hot", "flickering").defects


def test_dynamics_of_flicker_from_parts():
    """An independent generator: a Markov chain stepped trial by trial; medians over 400 pixels.

    Pixels that fire in nine of ten trials tell binomial counts from those of Poisson's law.
    """
    rng = np.random.default_rng(4)
    n, count, pixels = 50, 128, 400
    for rate, share, correlation in ((0.4, 0.3, 0.98), (0.9, 0.6, 0.9)):
        state = rng.random(pixels) < share
        parts = np.zeros((count, pixels))
        for part in parts:
            for fresh, drawn, fires in rng.random((n, 3, pixels)):
                state = np.where(fresh >= correlation, drawn < share, state)
                part += state & (fires < rate)
        assert unsteady(parts, n).all()
        p, c = dynamics(parts, n)
        assert np.median(p) == pytest.approx(share, rel=0.07)
        assert np.median(-1 / np.log(c)) == pytest.approx(-1 / np.log(correlation), rel=0.15)
    # steady ones of all rates: none is called unsteady (chance 1e-6 each)
    for rate in (0.002, 0.02, 0.4, 0.95):
        assert unsteady(rng.binomial(n, rate, (count, 20_000)), n).sum() == 0


# ---- telegraph noise from dark frames ------------------------------------------------------------------

EXPOSURES_S = np.array([1e-3, 5e-3, 20e-3, 50e-3, 80e-3])


def dark_values(rng, pixels, amplitude=0.0, share=0.5, correlation=0.5, frames=64, width=1.2):
    """[exposure, frame, pixel] of a Markov chain stepped frame by frame, whole DN; not our sampler."""
    state = rng.random(pixels) < share
    values = np.empty((EXPOSURES_S.size, frames, pixels))
    for k in range(values.shape[0] * frames):
        state = np.where(rng.random(pixels) >= correlation, rng.random(pixels) < share, state)
        values.reshape(-1, pixels)[k] = amplitude * state
    values += 64 + 30 * EXPOSURES_S[:, None, None] + width * rng.standard_normal(values.shape)
    return np.rint(values)


@pytest.mark.parametrize(
    ("amplitude", "share", "correlation"), [(6.0, 0.5, 0.9), (6.0, 0.2, 0.8), (5.0, 0.6, 0.0), (20.0, 0.1, 0.6)]
)
def test_two_levels_are_recovered(amplitude, share, correlation):
    """Means over 150 pixels, from another generator; 3 scores at 4 σ: false alarm 2e-4 a case.

    The variance over pixels is that of a mean over a chain of n = 320 frames, p (1 − p)/n·(1 + c)/(1 − c).
    """
    found = fit_two_levels(dark_values(np.random.default_rng(3), 150, amplitude, share, correlation), EXPOSURES_S)
    assert found.is_telegraph.mean() > 0.97
    spread = np.sqrt(share * (1 - share) / 320 * (1 + correlation) / (1 - correlation))
    assert abs(found.high_share.mean() - share) < 4 * spread / np.sqrt(150)
    assert 0.75 < found.high_share.std() / spread < 1.25
    error = 1.2 / np.sqrt(320 * share * (1 - share))
    assert abs(np.median(found.amplitude_dn) - amplitude) < 4 * 1.25 * 1.1 * error / np.sqrt(150) + 0.01
    assert abs(found.correlation.mean() - correlation) < 0.035  # a chain's own correlation comes out low by 4/n
    assert np.median(found.width_dn) == pytest.approx(np.hypot(1.2, 12**-0.5), rel=0.02)


@pytest.mark.slow
def test_noise_of_one_level_is_not_taken_for_two():
    """Whatever its width. The gain that is asked for is 20; that of 3000 pixels stays below 16."""
    for width in (0.9, 1.2, 4.0):
        found = fit_two_levels(dark_values(np.random.default_rng(5), 1000, frames=32, width=width), EXPOSURES_S)
        assert found.gain.max() < 16 and not found.is_telegraph.any()


@pytest.mark.slow
def test_variances_of_good_pixels_are_not_looked_at():
    """1e6 pixels of Gaussian noise and of dark current that varies: 1 is expected, 8 or more have a chance of 1e-5."""
    rng, frames, side = np.random.default_rng(8), 32, 1000
    dark = 4.0 * rng.gamma(2.0, 0.5, (side, side)) * EXPOSURES_S[:, None, None] * 20
    true = 1.5 + 0.25 * dark
    variance = true * rng.chisquare(frames - 1, true.shape) / (frames - 1)
    mean = 64 + dark + np.sqrt(true / frames) * rng.standard_normal(true.shape)
    level = np.full(true.shape, 64, np.uint16)
    moments = FrameMoments(
        np.rint(EXPOSURES_S * 1e6).astype(np.int64), frames, mean.astype(np.float32), variance.astype(np.float32),
        level, level, level, np.empty(0), np.empty(0), np.empty(0, np.int8), np.empty(0),
    )  # fmt: skip
    used = np.ones((side, side), bool)
    assert _suspects(moments, used, (2, 2), 1023).sum() < 8
    moments.variance[:, 100:200, 100] *= 2.5
    assert _suspects(moments, used, (2, 2), 1023)[100:200, 100].all()


@pytest.fixture(scope="module")
def frames_session(tmp_path_factory):
    """(sensor, calibration file, captures) of frames of reference-mono with telegraph noise, at 30 frames a second."""
    folder = tmp_path_factory.mktemp("telegraph")
    noise = {"share": 0.01, "amplitude_e": 60.0, "high_s": 0.2, "low_s": 0.4}
    given = hr.load_sensor("reference-mono", {
        "aps.telegraph": noise, "aps.read_noise_e": 6.0, "aps.dark_current_e_per_s": 200.0,
        "aps.dark_current_nonuniformity_rel": 0.5, "aps.prnu_rel": 0.01, "aps.dsnu_e": 10.0,
    }).crop(SIDE, SIDE)  # fmt: skip
    off = [f"evs.{term}" for term in EVS_TERMS]
    write_captures(
        given, folder / "c", frames=48, ticks=1, without=off, seed=5, dark_exposures_us=(1000, 5000, 20000, 30000),
        lit_exposures_us=(1000, 5000, 20000),
    )  # fmt: skip
    calibrate_aps(folder / "c", folder / "c.yaml", folder / "report.html")
    return given, folder / "c.yaml", folder / "c"


@pytest.mark.slow
def test_telegraph_pixels_of_frames_are_found(frames_session):
    """All whose variance is above the limit that the docs state, and no good one: chance 1e-6 and less each."""
    given, file, _ = frames_session
    true, maps, section = given.aps.telegraph, read_maps(file, "aps"), read_calibration(file)["aps"]
    found = np.flatnonzero(maps["telegraph_amplitude_dn"])
    assert np.isin(found, true.place).all()
    noise = given.aps.without("telegraph").variance_dn2(np.zeros((SIDE, SIDE)), 20_000, adc=True).ravel()[true.place]
    plain = true.variance_dn2 > 1.2 * noise
    assert plain.sum() > 40
    assert np.isin(true.place[plain], found).mean() > 0.94  # some stay at one level for all of the dark frames
    assert section["telegraph_pixels"] == found.size and section["bad_pixels"] >= found.size
    assert f"<td>{found.size}</td>" in file.with_name("report.html").read_text()
    assert any(
        line.split() == ["telegraph", "pixels", str(found.size)] for line in summary_lines({"aps": section}, "aps")
    )
    # of those the two levels
    mine = np.searchsorted(true.place, found)
    ratio = maps["telegraph_amplitude_dn"].ravel()[found] / true.amplitude_dn[mine]
    assert abs(np.median(ratio) - 1) < 0.03 and np.quantile(np.abs(ratio - 1), 0.9) < 0.15
    assert np.median(maps["telegraph_high_share"].ravel()[found]) == pytest.approx(1 / 3, abs=0.05)
    correlation = np.exp(-np.median(maps["telegraph_change_hz"].ravel()[found]) / 30)
    assert correlation == pytest.approx(np.exp(-(5 + 2.5) / 30), abs=0.04) and section["frame_rate_hz"] == 30
    # what is left is a good sensor: the noise of the others is the file's
    assert section["read_noise_e"]["value"] == pytest.approx(6.0, rel=0.01)


@pytest.mark.slow
def test_a_calibrated_sensor_jumps_alike(frames_session):
    given, file, captures = frames_session
    again = hr.load_sensor("reference-mono", {"noise": str(file)}).crop(SIDE, SIDE)
    jumps, true = again.aps.telegraph, given.aps.telegraph
    assert np.isin(jumps.place, true.place).all() and jumps.place.size > 40
    mine = np.searchsorted(true.place, jumps.place)
    assert np.median(jumps.change_hz / true.change_hz[mine]) == pytest.approx(1, rel=0.15)
    dark = np.stack([again.aps.sample(np.zeros((SIDE, SIDE)), 20_000, 9, k) for k in range(96)]).reshape(96, -1)
    with np.load(captures / "aps_dark.npz") as data:
        before = data["frames"][2].reshape(48, -1)
    variances = [stack[:, jumps.place].astype(float).var(axis=0, ddof=1) for stack in (before, dark)]
    assert np.median(variances[1] / variances[0]) == pytest.approx(1, rel=0.2)
    assert variances[1].mean() == pytest.approx(variances[0].mean(), rel=0.2)
    good = np.setdiff1d(np.arange(SIDE**2), true.place)
    assert dark[:, good].astype(float).var(axis=0, ddof=1).mean() == pytest.approx(
        before[:, good].astype(float).var(axis=0, ddof=1).mean(), rel=0.02
    )
    # the means are those of the captures: both levels lie about them
    apart = dark[:, jumps.place].mean(axis=0) - before[:, jumps.place].mean(axis=0)
    scale = np.sqrt(variances[0] * 10 * (1 / 48 + 1 / 96))
    assert abs(np.mean(apart / scale)) < 0.6


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda parts: parts[:7], "7 parts; expected 8 or more"),
        (lambda parts: parts[:, :5], "must be whole numbers"),
        (lambda parts: parts * 1.0, "must be whole numbers"),
        (lambda parts: parts + 1, "does not add up"),
    ],
)
def test_wrong_parts_are_told(tmp_path, change, text):
    rng = np.random.default_rng(2)
    parts = rng.binomial(100, 0.01, (10, 16, 16))
    counts = {
        "n_on": parts.sum(axis=0),
        "n_off": 0 * parts[0],
        "dark_n_on": parts.sum(axis=0),
        "dark_n_off": 0 * parts[0],
    }
    (tmp_path / "capture.yaml").write_text("bit_depth: 10\ntile_rows: 1\ntile_cols: 1\n")
    np.savez(
        tmp_path / "evs_static.npz", signal_dn=np.ones((16, 16)), n_trials=1000, dark_parts=change(parts), **counts
    )
    with pytest.raises(SpecError, match=text):
        read_static(read_captures(tmp_path))
