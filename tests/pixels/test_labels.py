"""Labels of events against runs without noise, and against sequences worked out by hand."""

import numpy as np
import pytest

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs import partners
from hesim_render.pixels.evs.cause_pairs import CAUSE, EFFECT, Balance, LastSteps, PixelSteps
from hesim_render.pixels.evs.events import EventLabels, Label, Lost
from hesim_render.pixels.evs.labels import Labeller
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.partners import NominalSteps
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor

#: Not square, so that rows are not taken for columns.
ROWS, COLS, THETA = 36, 64, 0.2
SIZE = ROWS * COLS
#: x = I + 1 with I = 2 DN per electron of a window; s² = β4², so that the noise of ln x at x = 101 is β4/101.
NOISY = {"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 5.0, "beta5": 0.0}
#: Terms that make noise; bandwidth stays.
NOISES = ("shot", "dark_current", "leak", "stuck", "hot", "flickering")
ASYNCHRONOUS = {"evs.reference": "last_event", "evs.tick_us": None, "evs.noise_cutoff_hz": 300.0,
                "evs.noise_mode": None}  # fmt: skip


def model(asynchronous=False, coefficients=NOISY, **overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    if asynchronous:
        changes = {**{k: v for k, v in ASYNCHRONOUS.items() if v is not None or k == "evs.tick_us"}, **changes}
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": ROWS, "geometry.cols": COLS, "evs.coefficients": [coefficients],
         "evs.contrast_threshold_on": THETA, "evs.contrast_threshold_off": 1.15 * THETA, **changes},
    )  # fmt: skip
    layout = Layout.full(spec)
    return EvsNoise(spec.evs, layout, spec.device_seed, np.ones(1))


def light(t_us, swing=0.6, hz=20.0):
    """ln x of every pixel: a sinusoid with a phase of its own."""
    phase = np.random.default_rng(5).uniform(0, 2 * np.pi, SIZE)
    return np.log(101.0) + swing * np.sin(2 * np.pi * hz * t_us * 1e-6 + phase)


def run(noise, times_us, level=light, labels=True, seed=9):
    """All events, and the labeller."""
    labeller = Labeller(noise, seed, int(times_us[-1])) if labels else None
    stage = EvsStage(noise, seed, labels=labeller)
    parts = [
        stage.step(from_host(jit().Float, (np.exp(level(t)) - 1) / 2), int(t)) for t in times_us
    ]  # fmt: skip
    return np.concatenate(parts), EventLabels.of([labeller.taken()]) if labels else None


def keys(events):
    return {tuple(event) for event in events.tolist()}


TICKS = 1_000 * np.arange(1, 101)


def test_labels_change_no_event_and_count_every_one():
    for asynchronous in (False, True):
        noise = model(asynchronous, evs__threshold_mismatch_rel=0.05, evs__leak_rate_hz=1.3)
        events, found = run(noise, TICKS)
        without, _ = run(noise, TICKS, labels=False)
        np.testing.assert_array_equal(events, without)
        assert found.label.size == events.size > 5_000
        assert sum(found.counts()[label.name.lower()] for label in Label) == events.size


def test_with_fixed_ticks_signal_and_mismatch_are_the_events_of_runs_without_noise():
    noise = model(evs__threshold_mismatch_rel=0.1, evs__leak_rate_hz=5.0)
    events, found = run(noise, TICKS, lambda t: light(t, hz=60.0))
    clean, _ = run(noise.clean(), TICKS, lambda t: light(t, hz=60.0), labels=False)
    own, _ = run(noise.without(*NOISES), TICKS, lambda t: light(t, hz=60.0), labels=False)
    signal, mismatch = (events[found.label == label] for label in (Label.SIGNAL, Label.MISMATCH))
    assert keys(signal) == keys(events) & keys(clean)
    assert keys(signal) | keys(mismatch) == keys(events) & (keys(clean) | keys(own))
    np.testing.assert_array_equal(found.clean, clean)
    assert min(signal.size, mismatch.size) > 100
    # without a spread of thresholds there is one run without noise, and no mismatch
    alike = noise.without("mismatch")
    events, found = run(alike, TICKS, lambda t: light(t, hz=60.0))
    assert not np.any(found.label == Label.MISMATCH)
    assert keys(events[found.label == Label.SIGNAL]) == keys(events) & keys(clean)


def test_with_fixed_ticks_the_change_of_the_light_itself_decides():
    """From the levels that are put in: p·Δ ln x > θ, of the nominal threshold and of the pixel's own."""
    noise = model(evs__threshold_mismatch_rel=0.1, evs__contrast_threshold_off=0.25)
    events, found = run(noise, TICKS, lambda t: light(t, hz=60.0))
    place = events["y"].astype(int) * COLS + events["x"]
    levels = np.array([light(t, hz=60.0) for t in [0, *TICKS]])
    tick = events["t_us"] // 1000
    change = levels[tick, place] - levels[tick - 1, place]
    toward = events["polarity"] * change
    nominal = np.where(events["polarity"] > 0, 0.2, 0.25)
    own = np.where(
        events["polarity"] > 0, noise.threshold_on_map.ravel()[place], noise.threshold_off_map.ravel()[place]
    )
    expected = np.where(toward > nominal, Label.SIGNAL, np.where(toward > own, Label.MISMATCH, Label.NOISE))
    sure = (np.abs(toward - nominal) > 1e-5) & (np.abs(toward - own) > 1e-5)  # float32 levels
    np.testing.assert_array_equal(found.label[sure], expected[sure])
    assert sure.mean() > 0.99 and all(np.any(expected == label) for label in (0, 1, 4))


def test_leak_and_hot_pixels_are_told_apart_from_noise():
    still = np.full(SIZE, np.log(101.0))
    quiet = {**NOISY, "beta4": 0.0}
    hot = {"evs.defects": {"hot_share": 0.02, "hot_rate_hz": 200.0}}
    for asynchronous in (False, True):
        noise = model(asynchronous, quiet, evs__leak_rate_hz=3.0)
        events, found = run(noise, TICKS, lambda t: still)
        assert events.size > 300 and (found.label == Label.LEAK).all() and found.clean.size == 0
        noise = model(asynchronous, quiet, evs__comparator_noise={"on_hz": 1.0, "off_hz": 2.5})
        events, found = run(noise, TICKS, lambda t: still)
        assert events.size > 300 and (found.label == Label.NOISE).all() and found.clean.size == 0
        noise = model(asynchronous, quiet, **hot)
        events, found = run(noise, TICKS, lambda t: still)
        assert events.size > 300 and (found.label == Label.HOT).all()
        noise = model(asynchronous, **hot)
        events, found = run(noise, TICKS, lambda t: still)
        of_hot = np.isin(events["y"].astype(int) * COLS + events["x"], noise.defects.place)
        assert (found.label[~of_hot] == Label.NOISE).all() and (found.label[of_hot] == Label.HOT).mean() > 0.5


def test_with_a_dead_time_leak_and_hot_events_keep_their_origin():
    noise = model(True, {**NOISY, "beta4": 0.0}, evs__leak_rate_hz=3.0, evs__refractory_period_us=500,
                  evs__comparator_noise={"off_hz": 2.5},
                  **{"evs.defects": {"hot_share": 0.02, "hot_rate_hz": 200.0}})  # fmt: skip
    events, found = run(noise, TICKS, lambda t: np.full(SIZE, np.log(101.0)))
    of_hot = np.isin(events["y"].astype(int) * COLS + events["x"], noise.defects.place)
    on, off = (found.label[~of_hot & (events["polarity"] == sign)] for sign in (1, -1))
    assert (on == Label.LEAK).all() and on.size > 300 and (off == Label.NOISE).all() and off.size > 200
    assert (found.label[of_hot] == Label.HOT).mean() > 0.9


@pytest.mark.parametrize(
    ("noise_dn", "spread"),
    [(5.0, 0.08), *(pytest.param(dn, s, marks=pytest.mark.slow) for dn, s in ((5.0, 0.0), (2.0, 0.03), (2.0, 0.08)))],
)
def test_asynchronous_signal_has_the_rate_of_the_run_without_noise(noise_dn, spread):
    """In two periods after the first two: the first reference level has noise in it, which gives steps of its own.

    An event comes a little before its partner, so that both are counted from one phase to the same one, and the run
    goes on for a while. Both are counts of steps over the same swings of 2304 pixels, from reference levels that
    differ; the bound is the counting error of one of them. Noise of a quarter and of a tenth of the threshold. The
    thresholds of both polarities have one mean: where they differ, noise moves the reference level itself (docs).
    """
    coefficients = {**NOISY, "beta4": noise_dn}
    noise = model(True, coefficients, evs__threshold_mismatch_rel=spread, evs__leak_rate_hz=1.3,
                  evs__contrast_threshold_off=THETA)  # fmt: skip
    times = 500 * np.arange(1, 451)
    events, found = run(noise, times)
    own, _ = run(noise.without(*NOISES), times, labels=False)
    counts = found.counts()
    for polarity in (1, -1):
        labelled = events[(found.label <= Label.MISMATCH) & (events["polarity"] == polarity)]
        labelled, expected = (
            np.count_nonzero((each["t_us"] > 100_000) & (each["t_us"] <= 200_000))
            for each in (labelled, own[own["polarity"] == polarity])
        )
        assert expected > 20_000
        assert abs(labelled - expected) < np.sqrt(expected)
    assert (counts["mismatch"] > 0) == (spread > 0)
    assert counts["noise"] > 100
    np.testing.assert_array_equal(found.clean, run(noise.clean(), times, labels=False)[0])


def test_noise_of_still_light_is_not_signal():
    """From the first moment on, as pixels begin in the state that they have in this light."""
    noise = model(True, evs__threshold_mismatch_rel=0.05)
    events, found = run(noise, 1_000 * np.arange(1, 181), lambda t: np.full(SIZE, np.log(101.0)))
    assert events.size > 300 and (found.label == Label.NOISE).mean() > 0.998
    assert found.clean.size == 0


def test_events_lost_in_the_read_out_are_those_that_a_faster_one_gives():
    slow = model(evs__readout_max_events_per_s=20_000.0, evs__readout_buffer_events=10)
    events, found = run(slow, TICKS)
    every, labels = run(slow.without("readout_limit"), TICKS)
    assert found.lost.size > 1_000 and (found.lost_in == Lost.READOUT).all()
    assert keys(found.lost) == keys(every) - keys(events) and found.lost.size + events.size == every.size
    expected = dict(zip(map(tuple, every.tolist()), labels.label, strict=True))
    assert [expected[tuple(event)] for event in events.tolist()] == found.label.tolist()


def test_events_lost_in_the_dead_time_are_noise_free_crossings_within_it():
    noise = model(True, {**NOISY, "beta4": 0.0}, evs__refractory_period_us=3_000)
    times = 500 * np.arange(1, 201)
    events, found = run(noise, times)
    crossings, _ = run(noise.without("refractory"), times, labels=False)
    assert (found.label == Label.SIGNAL).mean() > 0.5
    expected = []
    place = events["y"].astype(int) * COLS + events["x"]
    for event in crossings.tolist():
        fired = events["t_us"][place == event[2] * COLS + event[1]]
        if np.any((fired < event[0]) & (event[0] <= fired + 3_000)):
            expected.append(event)
        if len(expected) == 300:
            break
    assert len(expected) == 300 and (found.lost_in == Lost.REFRACTORY).all()
    lost = keys(found.lost)
    # a crossing within a dead time may be the partner of an event that came a little before it
    assert np.mean([event in lost for event in expected]) > 0.9


def test_each_lost_event_has_its_own_cause_where_there_are_both():
    """Of a slow read-out behind pixels with a dead time: what a faster one gives, and what the dead time takes."""
    noise = model(True, {**NOISY, "beta4": 0.0}, evs__refractory_period_us=3_000,
                  evs__readout_max_events_per_s=60_000.0, evs__readout_buffer_events=10)  # fmt: skip
    times = 2_500 * np.arange(1, 41)
    events, found = run(noise, times)
    every, labels = run(noise.without("readout_limit"), times)
    unread, asleep = (keys(found.lost[found.lost_in == cause]) for cause in (Lost.READOUT, Lost.REFRACTORY))
    assert min(len(unread), len(asleep)) > 300 and found.lost.size == len(unread) + len(asleep)
    assert unread == keys(every) - keys(events) and asleep == keys(labels.lost)
    assert np.all(np.diff(found.lost["t_us"]) >= 0)
    step = np.searchsorted(times, found.lost["t_us"])
    # a block takes both causes in order of time
    assert np.any((np.diff(found.lost_in.astype(int)) != 0) & (np.diff(step) == 0))


@pytest.mark.parametrize(
    ("noise_dn", "dead_us", "most"),
    [
        pytest.param(*p, marks=pytest.mark.slow)
        for p in ((2.0, 1_000, 0.0), (1.0, 1_000, 0.0), (2.0, 300, 0.01), (5.0, 1_000, 0.03))
    ],
)
def test_with_a_dead_time_signal_has_the_rate_of_the_run_without_noise_but_with_dead_time(noise_dn, dead_us, most):
    """As above, both polarities together. The run to compare with has the dead time and the pixels' own thresholds.

    Noise of a tenth of the threshold and of a twentieth. Where the dead time is shorter than the noise lasts, or the
    noise is a quarter of the threshold, noise is in the reference at the release, so that pixels fire more often or
    less: docs/ground-truth.md states 1 % and 3 %. The thresholds of both polarities have one mean, as above.
    """
    noise = model(True, {**NOISY, "beta4": noise_dn}, evs__threshold_mismatch_rel=0.05,
                  evs__refractory_period_us=dead_us, evs__contrast_threshold_off=THETA)  # fmt: skip
    times = 500 * np.arange(1, 451)
    events, found = run(noise, times)
    own, _ = run(noise.without(*NOISES), times, labels=False)
    labelled, expected = (
        np.count_nonzero((each["t_us"] > 100_000) & (each["t_us"] <= 200_000))
        for each in (events[found.label <= Label.MISMATCH], own)
    )
    assert expected > 20_000
    assert abs(labelled - expected) < max(np.sqrt(expected), most * expected)
    assert found.counts()["lost_refractory"] > 50 and found.counts()["mismatch"] > 100


# ---- nominal and own thresholds --------------------------------------------------------------------------------------


def wandering(t_us, seed=6, every_us=500):
    """ln x of every pixel at samples: a walk with jumps of many thresholds, between two walls."""
    rng = np.random.default_rng(seed)
    level = np.zeros((t_us // every_us + 1, SIZE))
    for k in range(1, len(level)):
        jump = rng.normal(0, 0.12, SIZE) + rng.normal(0, 1.0, SIZE) * (rng.random(SIZE) < 0.05)
        level[k] = level[k - 1] + jump
        level[k] = np.where(np.abs(level[k]) > 1.5, level[k - 1] - jump, level[k])
    return np.log(101.0) + level


def steps_worked_out(level, own, nominal):
    """Of one pixel, step by step: its steps (sample, sign), and whether the level goes on from the reference of each to
    the nominal threshold before the pixel steps back; None where rounding decides."""
    found, reference = [], level[0]
    for k, now in enumerate(level):
        sign = 1 if now > reference else -1
        while sign * (now - reference) >= own[sign]:
            found.append((k, sign, reference + sign * nominal[sign]))
            reference += sign * own[sign]
    told = []
    for place, (k, sign, goal) in enumerate(found):
        back = next((other for other, turn, _ in found[place:] if turn != sign), len(level))
        left = sign * goal - (sign * level[k:back]).max()
        told.append((k, sign, None if abs(left) < 1e-4 else left < 0))
    return told


def test_a_step_is_signal_if_the_level_goes_on_to_the_nominal_threshold_before_the_pixel_steps_back():
    """Asynchronous pixels without noise, so that every event is a step with the pixel's own threshold."""
    noise = model(True, {**NOISY, "beta4": 0.0}, evs__threshold_mismatch_rel=0.15, evs__contrast_threshold_off=0.25)
    times = 500 * np.arange(1, 121)
    levels = wandering(int(times[-1]))
    events, found = run(noise, times, lambda t: levels[t // 500])
    place = events["y"].astype(int) * COLS + events["x"]
    right = wrong = mismatch = 0
    for pixel in range(0, SIZE, 4):
        own = {1: noise.threshold_on_map.ravel()[pixel], -1: noise.threshold_off_map.ravel()[pixel]}
        expected = steps_worked_out(levels[1:, pixel], own, {1: THETA, -1: 0.25})
        here = place == pixel
        if events["polarity"][here].tolist() != [sign for _, sign, _ in expected]:
            wrong += len(expected)  # rounding has moved a step that the level only just reaches
            continue
        for label, (_, _, signal) in zip(found.label[here], expected, strict=True):
            if signal is not None:
                right += label == (Label.SIGNAL if signal else Label.MISMATCH)
                wrong += label != (Label.SIGNAL if signal else Label.MISMATCH)
                mismatch += not signal
    assert right > 10_000 and mismatch > 500 and wrong < 0.002 * right


@pytest.mark.parametrize("dead_us", [None, pytest.param(300, marks=pytest.mark.slow)])
def test_labels_neither_drift_nor_need_more_memory_as_time_goes_on(dead_us):
    """Lamps that blink, by 5 thresholds between two samples, with noise and thresholds of each pixel's own."""
    noise = model(True, {**NOISY, "beta4": 2.0}, evs__threshold_mismatch_rel=0.1, evs__leak_rate_hz=1.3,
                  **({} if dead_us is None else {"evs.refractory_period_us": dead_us}))  # fmt: skip
    labeller = Labeller(noise, 9, 10**9)
    stage = EvsStage(noise, 9, labels=labeller)
    generator = np.random.default_rng(4)
    held, shares = [], []
    for _ in range(3):
        blocks, count = [], 0
        for k in range(70):
            on = (k // 5) % 2 * 1.1 + generator.normal(0, 0.05, SIZE)
            t_us = (stage.t_us or 0) + 1_000
            count += stage.step(from_host(jit().Float, (101.0 * np.exp(on) - 1) / 2), t_us).size
            blocks.append(labeller.taken())
        held.append(nbytes(labeller))
        assert sum(block.label.size for block in blocks) == count > 30_000
        label = np.concatenate([block.label for block in blocks])
        shares.append(np.mean(label == Label.SIGNAL))
    assert max(held[1:]) <= 1.1 * held[0]
    assert np.ptp(shares[1:]) < 0.01


def test_what_is_let_go_of_changes_no_label(monkeypatch):
    noise = model(True, evs__threshold_mismatch_rel=0.1, evs__refractory_period_us=300)
    found = []
    for few in (0, 10**9):
        monkeypatch.setattr(partners, "_FEW", few)
        labeller = Labeller(noise, 9, 10**9)
        stage = EvsStage(noise, 9, labels=labeller)
        for t in TICKS:
            stage.step(from_host(jit().Float, (np.exp(light(t)) - 1) / 2), int(t))
        verdicts = labeller._partners._verdicts
        found.append((EventLabels.of([labeller.taken()]).label, verdicts._open.shape[1], verdicts._given.size))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] < 0.5 * found[1][1] and found[0][2] < found[1][2]


def test_labels_where_nothing_happens_between_two_samples():
    """One rise by 0.195 at once, in reach of some thresholds; later a slow one by 0.02, past the nominal 0.2."""
    noise = model(True, {**NOISY, "beta4": 0.0}, evs__threshold_mismatch_rel=0.1)

    def rise(t_us):
        return np.full(SIZE, np.log(101.0) + 0.195 * (t_us > 500) + max(0, t_us - 20_000) * 1e-6)

    for samples, label, highest in ((40, Label.MISMATCH, 0.195), (80, Label.SIGNAL, 0.215)):
        events, found = run(noise, 500 * np.arange(1, samples + 1), rise)
        assert (noise.threshold_on_map < highest - 1e-5).sum() <= events.size > 500
        assert (noise.threshold_on_map < highest + 1e-5).sum() >= events.size
        assert (found.label == label).all()


def test_steps_that_wait_follow_the_reference_of_their_pixel():
    """Two pixels of θ = 0.2 of their own and 0.3 nominal, at ln x = 1.25. The reference of one moves up by 0.1."""
    own, nominal = (0.2, 0.2), (0.3, 0.3)
    both = NominalSteps(own, nominal, 2)
    reference, level = np.full(2, 1.2, np.float32), np.full(2, 1.25, np.float32)
    assert both.take(steps((5, 0, 1, 10), (5, 1, 1, 11)), reference, level).size == 0
    both.shift(np.array([1]), np.array([0.1], np.float32))
    assert both.take(steps(), reference, np.full(2, 1.35, np.float32)).tolist() == [10]
    assert both.undecided.tolist() == [11]
    assert both.take(steps(), reference, np.full(2, 1.41, np.float32)).tolist() == [11]


def nbytes(thing):
    """Bytes of all NumPy arrays that an object holds."""
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    if isinstance(thing, dict):
        return sum(map(nbytes, thing.values()))
    if isinstance(thing, (list, tuple)):
        return sum(map(nbytes, thing))
    if type(thing).__module__.startswith("hesim_render.pixels.evs") and hasattr(thing, "__dict__"):
        return 0 if isinstance(thing, (EvsNoise, EvsStage)) else nbytes(vars(thing))
    return 0


# ---- pairs ---------------------------------------------------------------------------------------------------------


def paired(causes, effects):
    """The pairs of one pixel, step by step; (time, sign) each."""
    waiting = {0: [], 1: []}
    pairs = []
    both = sorted(
        [(t, 0, s, n) for n, (t, s) in enumerate(causes)] + [(t, 1, s, n) for n, (t, s) in enumerate(effects)]
    )
    for _, side, sign, number in both:
        other = waiting[1 - side]
        if other and other[-1][0] == sign:
            partner = other.pop()[1]
            pairs.append((partner, number) if side else (number, partner))
        elif waiting[side] and waiting[side][-1][0] != sign:
            waiting[side].pop()
        else:
            waiting[side].append((sign, number))
    return pairs


def test_pairs_against_a_pixel_by_pixel_version_in_any_portions():
    rng = np.random.default_rng(8)
    pixels, length = 40, 60
    steps = [
        (np.sort(rng.integers(0, 1000, (pixels, length))), rng.choice([-1, 1], (pixels, length))) for _ in range(2)
    ]
    expected = set()
    for pixel in range(pixels):
        sequences = [list(zip(t[pixel].tolist(), s[pixel].tolist(), strict=True)) for t, s in steps]
        expected |= {(pixel * length + a, pixel * length + b) for a, b in paired(*sequences)}
    for cuts in ([0, 1001], [0, 100, 101, 480, 1001]):
        balance, found = Balance(pixels), set()
        for low, high in zip(cuts[:-1], cuts[1:], strict=True):
            parts = []
            for t, s in steps:
                pixel, k = np.nonzero((t >= low) & (t < high))
                order = np.argsort(t[pixel, k], kind="stable")
                pixel, k = pixel[order], k[order]
                parts.append(PixelSteps(t[pixel, k], pixel, s[pixel, k], pixel * length + k))
            cause, effect, lost = balance.take(*parts)
            found |= set(zip(cause.tolist(), effect.tolist(), strict=True))
            assert lost.size == 0
        assert found == expected and len(found) > 200


def steps(*given):
    """(time, pixel, sign, number) each."""
    return PixelSteps(*np.array(given, np.int64).reshape(-1, 4).T)


def test_pairs_of_pixels_with_a_dead_time():
    """10 µs. Pixel 0: a cause soon after its event is its partner, the next one is lost. Pixel 1: the event has no
    partner once the pixel is released. Pixel 2: a cause after the release is paired with the next event.
    """
    causes = steps((5, 0, 1, 10), (8, 0, 1, 11), (50, 1, 1, 12), (20, 2, -1, 13))
    effects = steps((0, 0, 1, 0), (0, 1, 1, 1), (0, 2, -1, 2), (60, 1, 1, 3), (30, 2, -1, 4), (70, 0, 1, 5))
    cause, effect, lost = Balance(3, 10.0).take(causes, effects)
    assert set(zip(cause.tolist(), effect.tolist(), strict=True)) == {(10, 0), (12, 3), (13, 4)}
    assert lost.tolist() == [11]
    # the instant of the release belongs to the dead time: an event that waits is still there
    cause, effect, lost = Balance(2, 10.0).take(
        steps((15, 0, 1, 20), (16, 1, 1, 21)), steps((5, 0, 1, 6), (5, 1, 1, 7))
    )
    assert (cause.tolist(), effect.tolist(), lost.tolist()) == ([20], [6], [])
    # without a dead time the events wait for their partners
    cause, effect, lost = Balance(3).take(causes, effects)
    assert set(zip(cause.tolist(), effect.tolist(), strict=True)) == {(10, 0), (11, 5), (12, 1), (13, 2)}
    assert lost.size == 0


def test_steps_wait_until_their_partners_come():
    """Three causes of a pixel wait, of which the latest finds its partner first; a step back leaves the ones before."""
    balance = Balance(3)
    balance.take(steps((5, 0, 1, 10), (8, 0, 1, 11), (9, 0, 1, 12), (9, 2, -1, 13)), steps((7, 1, 1, 4)))
    assert sorted(balance.waiting(CAUSE)) == [10, 11, 12, 13] and balance.waiting(EFFECT).tolist() == [4]
    assert balance.is_idle(np.array([0, 1, 2]), 90).tolist() == [False] * 3
    cause, effect, _ = balance.take(steps((21, 2, 1, 14)), steps((20, 0, 1, 5)))
    assert (cause.tolist(), effect.tolist()) == ([12], [5])
    assert sorted(balance.waiting(CAUSE)) == [10, 11] and balance.is_idle(np.array([2]), 90).all()
    asleep = Balance(2, 10.0)
    asleep.take(steps((3, 0, 1, 1)), steps((4, 0, 1, 2)))
    assert asleep.is_idle(np.array([0, 0, 1]), 14).tolist() == [True, True, True]
    assert asleep.is_idle(np.array([0, 1]), 13).tolist() == [False, True]


def test_last_steps_wait_until_the_next_of_their_own_sequence():
    last = LastSteps(3, 10.0)
    cause, effect = last.take(steps((5, 0, 1, 10), (8, 0, 1, 11), (9, 2, -1, 13)), steps((7, 1, 1, 4), (9, 2, 1, 6)))
    assert cause.size == effect.size == 0
    assert sorted(last.waiting(CAUSE)) == [11, 13] and sorted(last.waiting(EFFECT)) == [4, 6]
    cause, effect = last.take(steps((30, 1, 1, 15)), steps((31, 0, 1, 7), (32, 2, -1, 8)))
    assert sorted(zip(cause.tolist(), effect.tolist(), strict=True)) == [(11, 7), (13, 8), (15, 4)]
    assert last.is_idle(np.array([0, 1]), 40).tolist() == [False, True] and last.is_idle(np.array([0]), 41).all()
