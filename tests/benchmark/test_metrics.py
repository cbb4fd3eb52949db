"""Measures, filters and the double integral against other programs, brute force and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from hesim_render.benchmark import metrics
from hesim_render.benchmark.event_filters import background_activity, nearest_neighbour
from hesim_render.benchmark.intensity import sharp_over_blurred
from hesim_render.benchmark.metrics import chamfer, count_error, denoising_scores, rate_error, rate_maps
from hesim_render.core.errors import RangeError
from hesim_render.measure.pictures import delta_e, psnr, ssim
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.spectral.transfer import encode_exactly


@pytest.fixture
def pair():
    rng = np.random.default_rng(2)
    truth = np.cumsum(rng.normal(size=(40, 33, 3)), axis=0)
    truth = (truth - truth.min()) / np.ptp(truth)
    return np.clip(truth + 0.07 * rng.normal(size=truth.shape), 0, 1), truth


def test_psnr_and_ssim_are_those_of_skimage(pair):
    a, b = pair
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1), abs=1e-9)
    assert psnr(255 * a, 255 * b, peak=255) == pytest.approx(psnr(a, b), abs=1e-9)
    for picture, truth, axis in ((a, b, -1), (a[..., 0], b[..., 0], None)):
        other = structural_similarity(
            picture, truth, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, channel_axis=axis
        )
        assert ssim(picture, truth) == pytest.approx(other, abs=1e-9)
    assert psnr(a, a) == np.inf and ssim(a, a) == pytest.approx(1)


def test_psnr_of_no_pixels_is_refused(pair):
    with pytest.raises(RangeError, match="at least one pixel that counts"):
        psnr(*pair, valid=np.zeros(pair[0].shape[:2], np.bool_))


def test_psnr_of_a_known_error(pair):
    _, truth = pair
    truth = 0.2 + 0.5 * truth
    assert psnr(truth + 0.1, truth) == pytest.approx(20)
    valid = np.zeros(truth.shape, bool)
    valid[:20] = True
    off = truth.copy()
    off[20:] += 0.3
    assert psnr(off, truth, valid=valid) == np.inf
    assert psnr(truth + 5, np.ones_like(truth)) == np.inf  # both are clipped to the peak


def test_colour_difference_is_that_of_skimage(pair):
    a, b = pair
    lab = [rgb2lab(encode_exactly(image)) for image in (a, b)]
    # skimage rounds the matrix of sRGB to six digits
    assert delta_e(a, b) == pytest.approx(float(deltaE_ciede2000(*lab).mean()), rel=2e-3)


def test_pictures_of_different_shapes_are_refused(pair):
    with pytest.raises(RangeError, match="shape"):
        psnr(pair[0][1:], pair[1])
    with pytest.raises(RangeError, match="11 px"):
        ssim(pair[0][:8], pair[1][:8])


# ---- events -------------------------------------------------------------------------------------------


def cloud(rng, count, rows=9, cols=11, until=20_000):
    events = np.zeros(count, EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, until, count))
    events["x"], events["y"] = rng.integers(0, cols, count), rng.integers(0, rows, count)
    events["polarity"] = rng.choice([-1, 1], count)
    return events


def test_of_too_many_events_every_kth_of_a_polarity_counts(monkeypatch):
    """Of 41, 40 and fewer at most 20 events: every third, every second, all."""
    monkeypatch.setattr(metrics, "MOST_POINTS", 20)
    a, b = cloud(np.random.default_rng(8), 61), cloud(np.random.default_rng(9), 58)
    a["polarity"], b["polarity"] = np.where(np.arange(61) < 41, 1, -1), np.where(np.arange(58) < 40, 1, -1)
    thinned = np.concatenate([a[:41:3], a[41:]]), np.concatenate([b[:40:2], b[40:]])
    found = chamfer(a, b)
    monkeypatch.undo()
    assert found == chamfer(*thinned) != chamfer(a, b)


def test_chamfer_distance_is_that_of_all_pairs():
    rng = np.random.default_rng(1)
    a, b = cloud(rng, 150), cloud(rng, 90)
    total = count = 0
    for sign in (1, -1):
        p, q = (
            np.array([[e["x"], e["y"], e["t_us"] / 500] for e in events if e["polarity"] == sign]) for events in (a, b)
        )
        distance = np.linalg.norm(p[:, None] - q[None], axis=-1)
        total += 0.5 * (distance.min(axis=1).mean() + distance.min(axis=0).mean()) * (len(p) + len(q))
        count += len(p) + len(q)
    assert chamfer(a, b, us_per_px=500) == pytest.approx(total / count)
    assert chamfer(a, a) == 0 and chamfer(a[:0], b[:0]) == 0 and np.isnan(chamfer(a, b[:0]))
    later = a.copy()
    later["t_us"] += 1
    assert chamfer(later[:1], a[:1]) == pytest.approx(1e-3)


def test_counts_and_rates():
    rng = np.random.default_rng(3)
    a, b = cloud(rng, 300), cloud(rng, 200)
    assert count_error(a, b) == 0.5 and count_error(b[:0], b) == -1 and count_error(a, b[:0]) == np.inf
    assert count_error(a[:0], b[:0]) == 0
    rates = rate_maps(a, (9, 11), 20_000)
    assert rates.sum() * 0.02 == pytest.approx(300)
    on = sum((e["x"], e["y"], e["polarity"]) == (4, 5, 1) for e in a)
    assert rates[0, 5, 4] == pytest.approx(on / 0.02)
    other = rate_maps(b, (9, 11), 20_000)
    assert rate_error(a, b, (9, 11), 20_000) == pytest.approx(np.sqrt(((rates - other) ** 2).mean()))


@pytest.mark.parametrize("filtered", [nearest_neighbour, background_activity])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(0, 120), until=st.sampled_from([40, 2000, 60_000]))
def test_filters_are_their_definition(filtered, seed, count, until):
    events = cloud(np.random.default_rng(seed), count, until=until)
    kept = filtered(events, (9, 11), 700)
    for k, event in enumerate(events):
        dx, dy = (np.abs(events[name].astype(int) - int(event[name])) for name in "xy")
        near = (dx + dy == 1) if filtered is nearest_neighbour else (np.maximum(dx, dy) == 1)
        age = event["t_us"] - events["t_us"]
        assert kept[k] == bool((near & (age >= 0) & (age <= 700)).any())


@pytest.mark.parametrize("filtered", [nearest_neighbour, background_activity])
def test_support_ends_after_its_time(filtered):
    events = np.array([(0, 3, 3, 1), (700, 3, 4, 1), (1401, 3, 3, 1)], EVENT_DTYPE)
    assert filtered(events, (9, 11), 700).tolist() == [False, True, False]


def test_scores_of_a_filter():
    kept, signal = np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 1, 0, 1], bool)
    found = denoising_scores(kept, signal)
    assert found["signal_kept"] == pytest.approx(2 / 3) and found["noise_kept"] == 0.5
    assert found["precision"] == pytest.approx(2 / 3) and found["f1"] == pytest.approx(2 / 3)


# ---- the double integral --------------------------------------------------------------------------------


def test_the_integral_of_a_single_pixel_is_exact():
    """Two events split the exposure into three constant parts: B = (L₀·4 + L₀e^{θ}·5 + L₀e^{θ−φ}·1)/10."""
    on, off = 0.3, 0.2
    events = np.array([(4, 1, 0, 1), (9, 1, 0, -1), (14, 1, 0, 1)], EVENT_DTYPE)
    first = 10 / (4 + 5 * np.exp(on) + np.exp(on - off))
    ratio = sharp_over_blurred(events, (1, 3), 0, 10, [0, 2, 4, 6, 10, 20], (on, off))
    expected = first * np.exp([0, 0, on, on, on - off, 2 * on - off])  # a time stamp is an end: at 4 it has happened
    assert ratio[:, 0, 1] == pytest.approx(expected)
    assert (ratio[:, 0, [0, 2]] == 1).all()


def test_an_event_at_the_begin_of_the_exposure_is_before_it():
    ratio = sharp_over_blurred(np.array([(0, 0, 0, 1)], EVENT_DTYPE), (1, 1), 0, 10, [-5, 0, 5], (0.3, 0.2))
    assert ratio[:, 0, 0] == pytest.approx([np.exp(-0.3), 1, 1])


def test_times_before_the_exposure_and_rows_that_begin_later():
    on, off = 0.3, 0.2
    # row 1 begins 100 µs later: its event at 105 is as one at 5 of row 0
    events = np.array([(-3, 0, 0, 1), (5, 0, 0, 1), (97, 0, 1, 1), (105, 0, 1, 1)], EVENT_DTYPE)
    ratio = sharp_over_blurred(events, (2, 1), [0, 100], 10, [-5, 0, 7], (on, off))
    assert ratio[:, 1, 0] == pytest.approx(ratio[:, 0, 0])
    first = 10 / (5 + 5 * np.exp(on))
    assert ratio[:, 0, 0] == pytest.approx([first * np.exp(-on), first, first * np.exp(on)])
    # the same 4000 µs later
    events["t_us"] += 4000
    later = sharp_over_blurred(events, (2, 1), [4000, 4100], 10, [3995, 4000, 4007], (on, off))
    np.testing.assert_array_equal(later, ratio)


def wave(t_us, rows=6, cols=40):
    """Log intensity of a wave that runs across the picture."""
    x = np.arange(cols) + 0.37 * np.arange(rows)[:, None]
    return 0.9 * np.sin(2 * np.pi * (x / 17 - np.asarray(t_us)[..., None, None] / 9000))


def events_of_wave(threshold, until_us):
    """Ideal events of the wave, by its crossings of a lattice of levels; no code of the package."""
    t = np.arange(0, until_us + 1, 5)
    level = wave(t)
    found = []
    for y in range(level.shape[1]):
        for x in range(level.shape[2]):
            reference = level[0, y, x]
            steps = np.trunc((level[:, y, x] - reference) / threshold)
            count = 0
            for k in np.flatnonzero(np.diff(steps)):
                while abs(level[k + 1, y, x] - (reference + count * threshold)) >= threshold:
                    sign = 1 if level[k + 1, y, x] > reference + count * threshold else -1
                    count += sign
                    found.append((t[k + 1], x, y, sign))
    events = np.array(found, EVENT_DTYPE)
    return events[np.argsort(events["t_us"], kind="stable")]


def test_the_double_integral_sharpens_and_noise_takes_its_gain():
    """On a wave that moves by a whole period within the exposure: more than 12 dB on clean events; lone events of a
    growing rate, then as many as real ones, take it away. Nothing here was fitted."""
    threshold, begin, exposure = 0.05, 1000, 9000
    events = events_of_wave(threshold, 12_000)
    blurred = np.exp(wave(np.arange(begin, begin + exposure, 10) + 5)).mean(axis=0)
    truth = np.exp(wave(np.array([5500.0])))[0]
    peak = truth.max()

    def sharpened(given):
        ratio = sharp_over_blurred(given, truth.shape, begin, exposure, [5500], (threshold, threshold))
        return psnr(blurred * ratio[0], truth, peak=peak)

    before, gains = psnr(blurred, truth, peak=peak), []
    for share in (0, 1, 4, 16):
        noise = cloud(np.random.default_rng(5), share * len(events) // 4, *truth.shape, until=12_000)
        mixed = np.concatenate([events, noise])
        gains.append(sharpened(mixed[np.argsort(mixed["t_us"], kind="stable")]) - before)
    assert gains[0] > 12 and all(a > b + 0.5 for a, b in zip(gains[:-1], gains[1:], strict=True)), gains
