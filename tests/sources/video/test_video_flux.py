"""The video as a source of flux: time, geometry, and what the capture loop makes of it."""

import gc
from types import SimpleNamespace

import numpy as np
import pytest
from videos import moving_bar, srgb_to_linear

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.video import VideoFlux, VideoOptions, flux
from hesim_render.sources.video import estimate as video_estimate
from hesim_render.sources.video.arrays import ArrayVideo
from hesim_render.sources.video.clock import Clock
from hesim_render.sources.video.geometry import mapping
from hesim_render.sources.video.picture_layout import Timing

#: One e⁻/s per unit of a linear picture.
UNIT = {"transfer": "linear", "white_e_per_s": 1.0, "white_filter": "clear"}


def mono(width=8, height=8, **overrides):
    return hr.load_sensor("reference-mono", {k.replace("__", "."): v for k, v in overrides.items()}).crop(width, height)


def grey(levels, width=8, height=8):
    """[time, row, col] of flat pictures."""
    return np.broadcast_to(np.float32(levels)[:, None, None], (len(levels), height, width))


def source(pictures, sensor=None, **options):
    return VideoFlux(
        np.ascontiguousarray(pictures), sensor or mono(), VideoOptions.of(**{**UNIT, "fps": 1000, **options})
    )


def mean(flux, begin, end, pixel=0):
    return float(np.array(flux.mean_flux(np.array([pixel], np.uint32), begin, end)[0])[0])


# -- time


def test_edges_are_the_pictures_limits():
    flux = source(grey([1, 2, 3, 4]))
    np.testing.assert_allclose(flux.slice_edges_us(0, 4000), [1000, 2000, 3000])
    np.testing.assert_allclose(flux.slice_edges_us(1000, 3000), [2000])
    assert not flux.is_static and flux.clock.end_us == 4000
    np.testing.assert_allclose(flux.sample_times_us(0, 4000), [500, 1500, 2500, 3500])


def test_slow_motion_divides_the_clock():
    flux = source(grey([1, 2]), fps=25, slow_motion=128)
    assert flux.clock.period_us == pytest.approx(1e6 / 3200) and flux.clock.end_us == pytest.approx(2e6 / 3200)


def test_any_interval_is_a_mean_over_pictures():
    levels = [1.0, 5.0, 2.0, 8.0]
    flux = source(grey(levels))
    for begin, end in ((0, 1000), (250, 250), (500, 1500), (0, 4000), (900, 3100), (1000, 2000), (3500, 4500)):
        grid = begin + (end - begin) * (np.arange(100_000) + 0.5) / 100_000
        expected = np.mean(np.array(levels)[np.clip((grid / 1000).astype(int), 0, 3)]) if end > begin else 1.0
        assert mean(flux, begin, end) == pytest.approx(expected, rel=2e-5), (begin, end)


def test_linear_interpolation_goes_from_middle_to_middle():
    levels = [1.0, 5.0, 2.0, 8.0]
    flux = source(grey(levels), interpolation="linear")
    np.testing.assert_allclose(flux.slice_edges_us(0, 4000), [500, 1500, 2500, 3500])
    for begin, end in ((0, 400), (500, 1500), (700, 900), (1500, 1500), (0, 4000), (1200, 3700)):
        grid = begin + (end - begin) * (np.arange(100_000) + 0.5) / 100_000
        expected = np.interp(grid, [500, 1500, 2500, 3500], levels).mean()
        assert mean(flux, begin, end) == pytest.approx(expected, rel=2e-5), (begin, end)


def test_each_pixel_has_its_own_interval():
    flux = source(grey([1.0, 5.0]))
    linear = source(grey([1.0, 5.0]), interpolation="linear")
    begin, end = np.array([0.0, 500, 1000, 900]), np.array([1000.0, 1500, 2000, 1100])
    pixel = np.array([3, 9, 9, 60], np.uint32)
    np.testing.assert_allclose(np.array(flux.mean_flux(pixel, begin, end)[0]), [1, 3, 5, 3], rtol=1e-6)
    expected = [1 + 4 * 0.125, 3, 5 - 4 * 0.125, 3]
    np.testing.assert_allclose(np.array(linear.mean_flux(pixel, begin, end)[0]), expected, rtol=1e-6)


def test_duty_shares_the_dark_gap():
    """Open in the first quarter of each millisecond: middles at 125 µs, limits in the middle of the closed time."""
    clock = Clock(Timing.regular(3, 1000.0), duty=0.25)
    np.testing.assert_allclose(clock.middle_us, [125, 1125, 2125])
    np.testing.assert_allclose(clock.hold_us, [0, 625, 1625, 3000])
    bright = [mean(source(grey([1, 2, 3]), duty=duty), 0, 600) for duty in (0.25, 1.0)]
    assert bright == [1, 1]  # the shutter changes when, not how bright


def test_irregular_times_are_kept():
    clock = Clock(Timing(np.array([0, 0.010, 0.015, 0.040]), 0.050), slow_motion=2)
    np.testing.assert_allclose(clock.hold_us, [0, 5000, 7500, 20000, 25000])
    np.testing.assert_allclose(clock.middle_us, [2500, 6250, 13750, 22500])


def test_going_back_and_forth_gives_the_same():
    flux = source(moving_bar(6)[..., 1].astype(np.float32))
    pixels = np.arange(64, dtype=np.uint32)

    def at(k):
        return np.array(flux.mean_flux(pixels, 1000 * k, 1000 * k + 1000)[0])

    first = [at(k) for k in range(6)]
    assert all(np.array_equal(at(k), first[k]) for k in (5, 0, 3, 3, 1))
    assert not np.array_equal(first[0], first[5])


def test_bad_questions():
    flux = source(grey([1, 2]))
    with pytest.raises(RangeError, match="pixel"):
        flux.mean_flux(np.array([64], np.uint32), 0, 1)
    with pytest.raises(RangeError, match="end before"):
        flux.mean_flux(np.array([0], np.uint32), 2, 1)
    assert len(np.array(flux.mean_flux(np.empty(0, np.uint32), 0, 1)[0])) == 0


# -- geometry


def image_of(pictures, sensor, **options):
    flux = source(pictures, sensor, **options)
    half_a, half_b = flux.mean_flux(np.arange(sensor.rows * sensor.cols, dtype=np.uint32), 0, 1000)
    assert np.array_equal(np.array(half_a), np.array(half_b))
    return np.array(half_a, dtype=np.float64).reshape(sensor.rows, sensor.cols)


def box_mean(picture, rows, cols, scale_y, scale_x):
    """Mean over each footprint by 60-fold oversampling per axis, centred: an oracle without overlaps."""
    height, width = picture.shape
    y = (height - rows * scale_y) / 2 + (np.arange(rows * 60) + 0.5) / 60 * scale_y
    x = (width - cols * scale_x) / 2 + (np.arange(cols * 60) + 0.5) / 60 * scale_x
    fine = picture[np.floor(y).astype(int)][:, np.floor(x).astype(int)]
    return fine.reshape(rows, 60, cols, 60).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("size", "fit", "scale"),
    [
        ((16, 24), "cover", (1.0, 1.0)),  # the region itself
        ((48, 72), "cover", (3.0, 3.0)),
        ((40, 90), "cover", (2.5, 2.5)),  # too wide: cut
        ((45, 36), "cover", (1.5, 1.5)),  # too tall: cut
        ((40, 36), "stretch", (2.5, 1.5)),
        ((8, 12), "cover", (0.5, 0.5)),  # smaller than the region
        ((6, 9), "cover", (0.375, 0.375)),
        ((4, 36), "stretch", (0.25, 1.5)),
    ],
)
def test_pixels_average_their_footprint(size, fit, scale):
    rng = np.random.default_rng(2)
    picture = rng.uniform(0, 1, size).astype(np.float32)
    found = image_of(picture[None], mono(24, 16), fit=fit)
    np.testing.assert_allclose(found, box_mean(picture, 16, 24, *scale), atol=2e-6 + 0.02 * (scale[0] % 0.5 != 0))


def test_no_light_is_lost():
    """Means over whole pictures are exact where all of the picture is seen, whatever the scale."""
    rng = np.random.default_rng(4)
    for size in ((23, 37), (5, 7), (64, 96), (200, 130)):
        picture = rng.uniform(0, 1, size).astype(np.float32)
        found = image_of(picture[None], mono(24, 16), fit="stretch")
        assert found.mean() == pytest.approx(picture.mean(dtype=np.float64), rel=2e-6)


def test_pixel_fit_keeps_whole_pixels():
    picture = np.arange(19 * 27, dtype=np.float32).reshape(19, 27)
    found = image_of(picture[None], mono(24, 16), fit="pixel")
    np.testing.assert_allclose(found, picture[1:17, 1:25], rtol=3e-7)
    with pytest.raises(RangeError, match="at least the 24x16 px"):
        image_of(picture[None, :10], mono(24, 16), fit="pixel")


def test_light_is_averaged_and_not_codes():
    """Half black, half white under one pixel is half the light, not the light of middle grey."""
    picture = np.tile(np.array([[0, 255]], np.uint8), (16, 8))
    found = image_of(picture[None], mono(8, 8), transfer="srgb")
    np.testing.assert_allclose(found, 0.5, rtol=1e-6)


def test_the_mosaic_sees_each_pixel_through_its_own_filter():
    rng = np.random.default_rng(5)
    picture = rng.uniform(0.2, 0.8, (1, 96, 128, 3)).astype(np.float32)
    sensor = hr.load_sensor("gen2").crop(128, 96)
    flux = VideoFlux(picture, sensor, VideoOptions.of(fps=10, transfer="srgb"))
    found = np.array(flux.mean_flux(np.arange(128 * 96, dtype=np.uint32), 0, 10)[0]).reshape(96, 128)
    light = srgb_to_linear(picture[0].astype(np.float64))
    expected = np.einsum("rck,rck->rc", light, flux.filter_matrix[sensor.layout.filter_index])
    np.testing.assert_allclose(found, np.maximum(expected, 0), rtol=1e-4, atol=1e-4 * expected.max())


def test_lens_shading_only_where_asked_for():
    sensor = hr.load_sensor("reference-bayer")
    picture = np.full((1, 8, 12, 3), 0.5, np.float32)
    flat, shaded = (
        np.array(VideoFlux(picture, sensor, VideoOptions.of(fps=1, transfer="linear", lens_shading=on)).mean_flux(
            np.arange(sensor.rows * sensor.cols, dtype=np.uint32), 0, 1)[0])
        for on in (False, True)
    )  # fmt: skip
    np.testing.assert_allclose(shaded / flat, sensor.relative_illumination.ravel(), rtol=1e-5)


def test_out_of_gamut_colours_give_no_negative_light():
    sensor = hr.load_sensor("eiger").crop(16, 16)
    picture = np.zeros((1, 16, 16, 3), np.float32)
    picture[..., 0] = 1.0  # a pure red, of which the camera's blue would be negative
    flux = VideoFlux(picture, sensor, VideoOptions.of(fps=1, transfer="linear"))
    assert flux.filter_matrix[2, 0] < 0
    assert np.array(flux.mean_flux(np.arange(256, dtype=np.uint32), 0, 1)[0]).min() == 0


# -- through the capture loop


@pytest.mark.parametrize("shutter", ["rolling", "global"])
def test_frames_integrate_the_clean_pictures(shutter):
    """Electrons of every row: the sum of the pictures over that row's own exposure."""
    levels = np.array([100.0, 400, 50, 800, 200, 300, 700, 600])
    line_us = 90.0 if shutter == "rolling" else 0.0
    sensor = mono(8, 8, aps__exposure_us=2500, aps__frame_rate_hz=300, aps__shutter=shutter, aps__line_time_us=line_us)
    recording = hr.simulate_video(grey(levels), sensor, fps=1000, clean=True, **UNIT)
    assert len(recording.frames) == 2
    fine = np.repeat(levels, 1000)  # per µs
    for frame in recording.frames:
        begins = np.rint(frame.exposure_start_us + line_us * np.arange(8)).astype(int)
        expected = [fine[begin : begin + 2500].sum() * 1e-6 for begin in begins]
        np.testing.assert_allclose(frame.electrons_mean, np.repeat(np.array(expected)[:, None], 8, 1), rtol=1e-5)
        assert np.all(frame.electrons_stderr == 0)


def test_noise_enters_once_a_frame():
    """The variance of a frame does not depend on how many pictures it sums: z of two variances below 4.5
    (false alarm 7e-6)."""
    variances = []
    for fps in (100, 3200):
        pictures = grey(np.full(int(0.02 * fps), 50_000.0), 256, 256)
        recording = hr.simulate_video(pictures, mono(256, 256), fps=fps, duration_s=0.02, **UNIT)
        variances.append(recording.frames[0].raw.astype(float).var())
    z = (variances[0] - variances[1]) / (variances[0] * np.sqrt(2 * 2 / 65536))
    assert abs(z) < 4.5


def test_events_tick_at_the_sensors_rate():
    """A ramp seen at 3200 pictures/s and at 500: comparisons are at k·tick in both."""
    for fps in (3200, 500):
        times = (np.arange(int(0.02 * fps)) + 0.5) / fps
        recording = hr.simulate_video(
            grey(1e6 * np.exp(300 * times)), mono(), fps=fps, duration_s=0.02, clean=True, **UNIT
        )
        tick = recording.manifest["sensor"]["spec"]["evs"]["tick_us"]
        stamps = np.unique(recording.events["t_us"])
        assert stamps.size and np.all(stamps % tick == 0)


def test_linear_interpolation_spreads_events():
    """Pictures of 100 fps that grow brighter: held ones change 3 times, interpolated ones all along."""
    pictures = grey([1e6, 3e6, 9e6, 27e6])
    ticks = {}
    for way in ("none", "linear"):
        recording = hr.simulate_video(pictures, mono(), fps=100, clean=True, interpolation=way, **UNIT)
        ticks[way] = np.unique(recording.events["t_us"]).size
        assert recording.manifest["settings"]["video"]["interpolation"] == way
    assert ticks["none"] <= 6 < 12 < ticks["linear"]


@pytest.mark.parametrize(("way", "enough"), [("none", float(np.exp(0.21))), ("linear", float(1 + 8 * np.expm1(0.21)))])
def test_what_interpolation_loses_before_a_fixed_tick_is_told(way, enough):
    """Pictures of 8 ticks: a change between two below 1 + 8 (exp(θ) - 1) gives no event if it is spread."""
    sensor = mono(
        evs__contrast_threshold_on=0.21, evs__contrast_threshold_off=0.34, evs__tick_us=1250, evs__window_us=50
    )
    counts = []
    for factor in (0.9 * enough, 1.1 * enough):
        pictures = grey(1e7 * factor ** np.array([0.0, 0.0, 1.0, 1.0]))
        recording = hr.simulate_video(pictures, sensor, fps=100, clean=True, interpolation=way, **UNIT)
        counts.append(recording.events.size)
        (note,) = (each for each in recording.manifest["settings"]["video"]["notes"] if "1250 µs" in each)
        assert "every 10000 µs" in note and "over 8 comparisons" in note
        assert "less than 2.87 times" in note and "and 1.23 times are enough" in note
        advice = "not advised for this sensor" if way == "none" else "events are LOST"
        assert advice in note and "interpolation spreads them" not in note
    assert counts[0] == 0 and counts[1] >= 64


def test_pixels_that_keep_the_level_of_their_last_event_lose_nothing_by_interpolation():
    keys = {"evs.tick_us": 1250, "evs.contrast_threshold_on": 0.21}
    sensor = hr.load_sensor("davis346", keys).crop(8, 8)
    pictures, counts = grey(np.geomspace(0.1, 0.9, 7)), []
    for way in ("none", "linear"):
        options = {"fps": 100, "transfer": "linear", "white_lux": 300, "clean": True}
        recording = hr.simulate_video(pictures, sensor, interpolation=way, **options)
        counts.append(recording.events.size)
        notes = [note for note in recording.manifest["settings"]["video"]["notes"] if "1250 µs" in note]
        assert [("loses none" in note) for note in notes] == ([True] if way == "none" else [])
    assert counts[0] >= 64 * int(np.log(9) / 0.21 - 1) and abs(counts[1] - counts[0]) <= 64


def test_sensors_without_a_tick_follow_the_pictures():
    sensor = hr.load_sensor("davis346").crop(16, 16)
    options = {"fps": 1000, "transfer": "linear", "white_lux": 100}
    recording = hr.simulate_video(grey(np.linspace(0.2, 1, 20), 16, 16), sensor, clean=True, **options)
    assert recording.events.size and np.all(recording.events["polarity"] == 1)
    theta = sensor.spec.evs.contrast_threshold_on
    stamps = np.unique(recording.events["t_us"])
    assert np.log(5) / theta - 2 < stamps.size < np.log(5) / theta + 1 and np.any(stamps % 1000)


@pytest.mark.parametrize("duty", [1.0, 0.4])
@pytest.mark.parametrize("way", ["none", "linear"])
def test_events_of_asynchronous_sensors_are_not_late(way, duty):
    """Light that grows as exp(t/τ): the k-th event of a pixel is due when the light has grown by exp(k θ)."""
    period_us, tau_us = 10_000, 200_000
    sensor = hr.load_sensor(
        "davis346", {"evs.window_us": 1, "evs.contrast_threshold_on": 0.1, "evs.coefficients.0.beta2": 1e-9}
    ).crop(8, 8)
    begin = np.arange(60) * period_us
    end = begin + duty * period_us  # each picture is the mean over its exposure, in closed form
    level = tau_us * (np.exp(end / tau_us) - np.exp(begin / tau_us)) / (end - begin)
    options = {"fps": 1e6 / period_us, "transfer": "linear", "white_lux": 100, "duty": duty, "interpolation": way}
    recording = hr.simulate_video(grey(level / level[-1], 8, 8), sensor, clean=True, **options)
    stamps = np.unique(recording.events["t_us"])
    # the reference is the light at the first sample, 1 µs after the begin: held there until the first middle
    first_us = duty * period_us / 2
    due = first_us + 0.1 * tau_us * np.arange(1, stamps.size + 1)
    late_us = stamps - due
    assert stamps.size >= 28
    # half a picture would be 5000 µs; a straight line between means of an exponential is off by (Δt/τ)²/24 · τ
    assert abs(late_us.mean()) < 60 and np.abs(late_us).max() < 200
    notes = recording.manifest["settings"]["video"]["notes"]
    assert any("not half a picture late" in note for note in notes) == (way == "none")


def test_the_same_seed_gives_the_same_recording():
    pictures = (255 * moving_bar(20)).astype(np.uint8)
    sensor = hr.load_sensor("eiger").crop(64, 48)
    once, again, other = (
        hr.simulate_video(pictures, sensor, fps=100, transfer="srgb", seed=seed) for seed in (3, 3, 4)
    )
    assert np.array_equal(once.events, again.events) and np.array_equal(once.frames[0].raw, again.frames[0].raw)
    assert not np.array_equal(once.frames[0].raw, other.frames[0].raw)
    assert once.events.size > 100


@pytest.mark.slow
def test_memory_stays_the_same_however_long_the_video():
    """20 000 pictures mapped on one: at most three flux maps are kept, and one more for each picture in a window."""
    one = np.full((1, 32, 32), 200, np.uint8)
    pictures = np.lib.stride_tricks.as_strided(one, (20_000, 32, 32), (0, 32, 1))
    longer = VideoFlux(pictures, mono(32, 32, evs__window_us=1000), VideoOptions.of(fps=3200, transfer="srgb"))
    longer.mean_flux(np.zeros(1, np.uint32), 0, 1e6)
    assert len(longer._maps) <= 3 + 3
    sensor = mono(32, 32, aps__frame_rate_hz=10, evs__window_us=300)
    flux = VideoFlux(pictures, sensor, VideoOptions.of(fps=3200, transfer="srgb"))
    pixels = np.arange(1024, dtype=np.uint32)
    kept = set()
    for k in range(0, 20_000, 7):
        flux.mean_flux(pixels, k * 312.5, (k + 2) * 312.5)
        kept.add(len(flux._maps))
    gc.collect()
    assert max(kept) <= 3
    total = float(np.array(flux.mean_flux(pixels[:1], 0, 20_000 * 312.5)[0])[0])  # all pictures in one call
    assert total == pytest.approx(mean(flux, 0, 10), rel=1e-3) and len(flux._maps) <= 3


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"duration_s": 0.5}, RangeError, "at most the video's 0.004 s"),
        ({"duration_s": -1}, RangeError, "above 0"),
        ({"fps": None}, SpecError, "frame rate"),
        ({"transfer": None}, SpecError, "colour tags are missing: transfer"),
        ({"matrix": "bt709"}, RangeError, "one for RGB"),
        ({"seed": -1}, RangeError, "seed"),
        ({"without": ["aps.magic"]}, RangeError, "noise term"),
    ],
)
def test_mistakes_have_one_clear_error(changes, error, text):
    options = {**UNIT, "fps": 1000, **changes}
    with pytest.raises(error, match=text):
        hr.simulate_video(grey([1, 2, 3, 4]), mono(), **options)


def test_mapping_describes_itself():
    found = mapping(1296, 1024, 2448, 3264, "cover").describe()
    assert found["picture_px_per_sensor_px"] == pytest.approx([1296 / 3264] * 2)
    assert found["first_picture_px"][1] == pytest.approx((1024 - 2448 * 1296 / 3264) / 2)


def disc(k, height=96, width=128):
    """A textured disc that moves four columns a picture over a standing texture; 8-bit grey."""
    y, x = np.mgrid[:height, :width]
    inside = np.hypot(y - 48, x - (30 + 4 * k)) < 15
    ground = 60 + 40 * np.sin(x / 5) * np.sin(y / 7)
    return np.clip(np.where(inside, 200 + 20 * np.sin((x - 4 * k) / 2), ground), 0, 255)


@pytest.mark.parametrize("colour", [False, True])
def test_motion_compensated_pictures_follow_the_motion(colour):
    """Half-way between two pictures the error is a third of the straight line's or less; the given ones stay exact."""
    pictures = np.rint([disc(k) for k in range(6)]).astype(np.uint8)
    if colour:
        pictures = np.stack([pictures, pictures, 255 - pictures], axis=-1)
    sensor = mono(128, 96)
    pixels = np.arange(128 * 96, dtype=np.uint32)
    options = {**UNIT, "fps": 1000, "luma": (0, 1, 0)}
    flux = {
        way: VideoFlux(pictures, sensor, VideoOptions.of(interpolation=way, motion_factor=4, **options))
        for way in ("linear", "motion")
    }

    def at(way, t_us):
        return 255 * np.array(flux[way].mean_flux(pixels, t_us, t_us)[0]).reshape(96, 128)

    for k in (0, 3, 5, 2):  # and back
        np.testing.assert_allclose(at("motion", 500 + 1000 * k), np.rint(disc(k)), atol=1e-3)
    for k in (1, 2, 4):
        errors = {way: np.abs(at(way, 1000 + 1000 * k) - disc(k + 0.5)).mean() for way in flux}
        assert errors["motion"] < errors["linear"] / 3
    edges = flux["motion"].slice_edges_us(0, 6000)
    np.testing.assert_allclose(edges, 500 + 250 * np.arange(21))
    with pytest.raises(SpecError, match="8-bit"):
        VideoFlux(pictures.astype(np.uint16), sensor, VideoOptions.of(interpolation="motion", **options))


def test_the_named_size_at_3200_pictures_a_second():
    """1296×1024 through the capture loop at the rates of the H-ESIM paper: rows integrate their own 5 ms."""
    changes = {"evs.tick_us": 1250, "evs.window_us": 1000, "aps.frame_rate_hz": 24, "aps.exposure_us": 5000}
    sensor = hr.load_sensor("gen2", {**changes, "aps.shutter": "global"}).crop(1296, 1024)
    rng = np.random.default_rng(1)
    base = rng.integers(30, 220, (64, 81, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    pictures = np.stack([np.roll(base, 2 * k, axis=1) for k in range(16)])
    recording = hr.simulate_video(pictures, sensor, fps=3200, transfer="srgb", clean=True, white_lux=500)
    assert recording.duration_us == 5000 and len(recording.frames) == 1
    assert recording.manifest["settings"]["video"]["notes"] == []
    stamps = np.unique(recording.events["t_us"])
    assert set(stamps) <= {2500, 3750, 5000} and recording.events.size > 1000
    matrix = np.array(recording.manifest["settings"]["video"]["linear_srgb_to_e_per_s"])
    light = srgb_to_linear(np.arange(256) / 255).astype(np.float32)[pictures].mean(axis=0)
    expected = 5e-3 * (light * matrix[sensor.layout.filter_index]).sum(axis=-1)
    found = recording.frames[0].electrons_mean
    valid = sensor.layout.aps_mask & (expected > 1)
    np.testing.assert_allclose(found[valid], expected[valid], rtol=2e-2)
    assert abs(found[valid] / expected[valid] - 1).mean() < 1e-4


@pytest.mark.slow
def test_a_long_file_runs_in_bounded_memory(tmp_path):
    """10 000 frames from a file of 10 000 pictures: the process stays within 20 MB of its size after 2000."""
    from pathlib import Path

    from videos import encode, grey_frames

    from hesim_render.capture.loop import Capture
    from hesim_render.capture.run_settings import noise_models

    path = encode(tmp_path / "a.mp4", grey_frames(np.arange(10_000) % 200 + 20, 32, 32), "mpeg4", 30)
    sensor = hr.load_sensor("reference-bayer", {"aps.frame_rate_hz": 30, "aps.exposure_us": 10_000}).crop(16, 16)
    flux = VideoFlux(path, sensor)
    sizes = []
    for k, _ in enumerate(Capture(flux, sensor, *noise_models(sensor), int(flux.clock.end_us), 7).run()):
        if k % 500 == 0:
            gc.collect()
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6)
    assert k > 9900 and max(sizes) - sizes[4] < 20


@pytest.mark.parametrize("interpolation", ["none", "linear"])
@pytest.mark.parametrize("window_us", [300, 1000, 2500])
def test_frames_and_events_together_read_each_picture_once_and_in_order(window_us, interpolation, monkeypatch):
    """A video file is decoded from its begin to its end: going back in it costs a second of decoding."""
    pictures = np.random.default_rng(1).integers(0, 255, (120, 8, 8), np.uint8)
    read = []
    monkeypatch.setattr(
        ArrayVideo, "read", lambda self, number, real=ArrayVideo.read: read.append(number) or real(self, number)
    )
    # before the run, the estimate reads the first pictures
    monkeypatch.setattr(VideoFlux, "seconds_per_picture", lambda *_: 0.0)
    sensor = mono(8, 8, evs__tick_us=2500, evs__window_us=window_us, aps__exposure_us=20_000, aps__frame_rate_hz=40)
    hr.simulate_video(pictures, sensor, fps=2000, transfer="srgb", interpolation=interpolation)
    assert read == sorted(set(read)) and len(read) > 60


# -- estimate


def estimate(pictures, **options):
    told = []
    hr.simulate_video(pictures, mono(), on_estimate=told.append, **{**UNIT, "fps": 1000, **options})
    return told[0]


def test_the_estimate_holds_the_time_to_decode(monkeypatch):
    """Each of 20 pictures takes 50 ms to read, by a clock that stands otherwise: 1 s more than without."""
    pictures = np.ascontiguousarray(grey(np.linspace(0.1, 0.9, 20)))
    now_s, read, given = [0.0], ArrayVideo.read, []
    monkeypatch.setattr(flux.time, "perf_counter", lambda: now_s[0])
    plain = estimate(pictures)

    def slowly(self, index):
        given.append(index)
        now_s[0] += 0.05
        return read(self, index)

    monkeypatch.setattr(ArrayVideo, "read", slowly)
    whole = estimate(pictures)
    assert whole.seconds - plain.seconds == pytest.approx(1.0, rel=0.01)
    first = given.index(0)  # the run begins anew with the first picture
    assert given[:first] == list(range(1, first + 1)) and 5 < first < 15
    assert given[first:] == list(range(20))
    assert (whole.pictures, whole.event_samples) == (plain.pictures, plain.event_samples)


@pytest.mark.parametrize("tick_us", [None, 700])
def test_the_estimate_is_the_sum_of_pixels_items_and_decoding(monkeypatch, tick_us):
    """Pixels are shared among the cores; pictures, comparisons and frames are not, nor is decoding. By hand."""
    monkeypatch.setattr(video_estimate, "_PER_PIXEL_S", np.array([3e-7, 5e-7, 11e-7]))
    monkeypatch.setattr(video_estimate, "_PER_ITEM_S", np.array([0.013, 0.0017, 0.19]))
    monkeypatch.setattr(video_estimate, "_IN_ALL_S", 2.3)
    monkeypatch.setattr(video_estimate.os, "cpu_count", lambda: 3)
    spec = SimpleNamespace(aps=SimpleNamespace(frame_rate_hz=60.0), evs=SimpleNamespace(tick_us=tick_us))
    given = SimpleNamespace(spec=spec, layout=SimpleNamespace(shape=(40, 52), evs_shape=(20, 13)))
    found = video_estimate.estimate_of_counts(given, 90_000, 17, 0.021)
    # 0.09 s: 5.4 frames; 128 ticks of 700 µs, or a sample a picture
    samples = 17 if tick_us is None else 128
    on_cores = 17 * 40 * 52 * 3e-7 + samples * 20 * 13 * 5e-7 + 5 * 40 * 52 * 11e-7
    wanted = on_cores / 3 + 17 * 0.013 + samples * 0.0017 + 5 * 0.19 + 2.3 + 17 * 0.021
    assert found.seconds == pytest.approx(wanted, rel=1e-12)
    assert (found.pictures, found.event_samples, found.frames) == (17, samples, 5)
    spec.aps = spec.evs = None
    none = video_estimate.estimate_of_counts(given, 90_000, 17, 0.021)
    assert none.seconds == pytest.approx(17 * 40 * 52 * 3e-7 / 3 + 17 * 0.013 + 2.3 + 17 * 0.021, rel=1e-12)
    assert (none.event_samples, none.frames) == (0, 0)


def test_only_pictures_of_the_run_are_read_for_the_estimate():
    """The fourth picture is damaged: a run of three pictures goes through, a longer one is refused before its start."""
    pictures = np.array(grey([0.1, 0.2, 0.3, 0.4]))
    pictures[3, 0, 0] = np.nan
    assert estimate(pictures, duration_s=0.0024).pictures == 3
    with pytest.raises(SpecError, match="picture 3"):
        estimate(pictures)
    flux = source(pictures)
    assert flux.seconds_per_picture(1) == 0  # the first one is read in any case


def test_pictures_made_between_those_of_a_video_divide_the_time_between_their_middles():
    """Periods of 10, 6 and 24 ms at twice the speed, open for 0.4 of each; three pictures from each one."""
    clock = Clock(Timing(np.array([0, 0.010, 0.016]), 0.040), slow_motion=2, duty=0.4, factor=3)
    given = np.array([1000.0, 5600.0, 10_400.0])
    expected = [given[0] + k / 3 * 4600 for k in range(3)] + [given[1] + k / 3 * 4800 for k in range(4)]
    np.testing.assert_allclose(clock.middle_us, expected)
    between = (clock.middle_us[1:] + clock.middle_us[:-1]) / 2
    np.testing.assert_allclose(clock.hold_us, [0, *between, 20_000])
    assert clock.count == 7 and clock.period_us == pytest.approx((4600 / 3 + 4800 / 3) / 2)
    single = Clock(Timing(np.array([0.0]), 0.040), slow_motion=2)
    assert single.count == 1 and single.period_us == 20_000
    times = np.array([3.0, 5.0, 8.0, 9.0])
    assert clock.inner(times, 3.0, 9.0).tolist() == [5, 8] and clock.inner(times, 2.9, 9.1).tolist() == [3, 5, 8, 9]
