"""Flicker against closed forms: frames, events, several lights, motion, and how often anything is rendered."""

import numpy as np
import pytest
from mitsuba_specfilm import reference_flux
from rendering import make_scene, mono

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.flicker import FlickerFlux
from hesim_render.sources.protocol import Sample
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.renderer import flickering
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.scene import Scene, light_parts
from hesim_render.sources.still import WindowByWindow
from hesim_render.spectral.waveform import Mains, Pwm

CARD = {"type": "flat", "width_m": 0.4, "height_m": 0.3, "reflectance": {"flat": 0.5}}
MAINS = {"type": "mains", "frequency_hz": 50, "depth": 0.4, "phase_deg": 70}
PWM = {"type": "pwm", "frequency_hz": 400, "duty": 0.3}


def card(*lights):
    return make_scene(target=CARD, light=list(lights), camera={"fit": "target", "fit_margin": 1.5})


class Formula(WindowByWindow):
    """Φ = base · (1 + slope t), the mean exactly; counts what it is asked for."""

    def __init__(self, base=1e5, slope_per_s=0.0, pace_us=200.0):
        self.base, self.slope, self.pace_us = base, slope_per_s, pace_us
        self.is_static = slope_per_s == 0
        self.asked = []

    def slice_edges_us(self, begin_us, end_us):
        return np.empty(0)

    def sample_times_us(self, begin_us, end_us):
        times = np.arange(0, end_us, self.pace_us)
        return np.empty(0) if self.is_static else times[(times > begin_us) & (times < end_us)]

    def mean_flux(self, pixel, begin_us, end_us):
        self.asked.append(np.array(pixel))
        middle = 0.5e-6 * (np.asarray(begin_us, dtype=float) + np.asarray(end_us, dtype=float))
        flux = np.broadcast_to(self.base * (1 + self.slope * middle), np.shape(pixel))
        return from_host(jit().Float, flux * 1.01), from_host(jit().Float, flux * 0.99)


class Windows(Formula):
    """The same, asked for many windows at once."""

    def instants_us(self, begin_us, end_us):
        first, last = np.ceil(np.array([begin_us, end_us]) / self.pace_us).astype(np.int64)
        return (np.arange(first, last) * self.pace_us).astype(np.int64)

    def flux_of_blocks(self, pixel, blocks):
        for block in blocks:
            for k in np.flatnonzero(block.wanted):
                yield Sample(*self.mean_flux(pixel, block.begin_us[k], block.end_us[k]), None)


def run(flux, sensor, duration_us):
    aps, evs = noise_models(sensor, clean=True)
    frames, events = [], []
    for item in Capture(flux, sensor, aps, evs, duration_us, 1).run():
        (events if isinstance(item, np.ndarray) else frames).append(item)
    return frames, np.concatenate(events) if events else None


# ---- frames -------------------------------------------------------------------------------------


def test_rows_of_a_rolling_shutter_equal_the_closed_form():
    sensor = mono(8, 64, aps__shutter="rolling", aps__line_time_us=37.5, aps__exposure_us=1700)
    light = {"type": "uniform", "illuminance_lux": 500}
    steady, _ = run(RenderedFlux(card(light), sensor, 4, 3), sensor, 100_000)
    begin = np.arange(64)[:, None] * 37.5
    for waveform in (MAINS, PWM):
        scene = card({**light, "waveform": waveform})
        flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 4, 3))
        assert not flux.is_static
        frames, _ = run(flux, sensor, 100_000)
        assert len(frames) == len(steady) == 3
        for frame in frames:
            a = (frame.exposure_start_us + begin) * 1e-6
            b = a + 1700e-6
            if waveform is MAINS:
                # ∫ cos(2π 100 t + φ) dt, the antiderivative written out
                wave = (
                    (np.sin(200 * np.pi * b + np.radians(70)) - np.sin(200 * np.pi * a + np.radians(70))) / 200 / np.pi
                )
                mean = 1 + 0.4 * wave / (b - a)
            else:
                starts = np.arange(0, 0.2, 2.5e-3)
                lit = np.minimum(b, starts + 0.75e-3) - np.maximum(a, starts)
                mean = np.clip(lit, 0, None).sum(axis=1, keepdims=True) / 0.3 / 1700e-6
            expected = steady[0].electrons_mean * mean
            np.testing.assert_allclose(frame.electrons_mean, expected, rtol=2e-6)
            # half the difference of two float32 sums: good to 1e-6 of the sums
            off = np.abs(frame.electrons_stderr - steady[0].electrons_stderr * mean)
            assert off.max() < 1e-6 * expected.max()
        assert np.ptp(frames[0].electrons_mean[:, 0]) > 0.2 * frames[0].electrons_mean[0, 0]


def test_each_light_is_rendered_once_while_nothing_moves():
    sensor = mono(16, 12)
    rays = []
    lights = [
        {"type": "uniform", "illuminance_lux": 100},
        {"type": "directional", "direction": [0, 0, -1], "illuminance_lux": 200, "waveform": MAINS},
        {"type": "directional", "direction": [0, -1, -1], "illuminance_lux": 300, "waveform": PWM},
        # a second light of one waveform, and a waveform that does not change, cost nothing
        {"type": "directional", "direction": [1, -1, -1], "illuminance_lux": 50, "waveform": PWM},
        {"type": "point", "position_m": [0, 1, 1], "illuminance_lux": 50, "waveform": {**MAINS, "depth": 0}},
    ]

    def make(part, light):
        rays.append(0)
        number = len(rays) - 1

        def told(done):
            rays[number] = done

        return RenderedFlux(part, sensor, 8, 3, progress=told)

    frames, _ = run(flickering(card(*lights), make), sensor, 100_000)  # 3 frames and 100 ticks
    assert len(frames) == 3
    assert rays == [16 * 12 * 8] * 3


def test_a_scene_without_flicker_is_its_own_source():
    scene = card({"type": "uniform", "illuminance_lux": 1}, {"type": "uniform", "illuminance_lux": 2})
    made = []
    assert flickering(scene, lambda part, _: made.append(part) or "the source") == "the source"
    assert made == [scene]
    flat = card({"type": "uniform", "illuminance_lux": 1, "waveform": {"type": "pwm", "frequency_hz": 100, "duty": 1}})
    assert [waveform for waveform, _ in light_parts(flat)] == [None]


# ---- several lights -----------------------------------------------------------------------------

# a card that the area light partly hides from the point light: its shadow stays where it is dark
LIGHTS = [
    {"type": "point", "position_m": [0, 0, 1.0], "illuminance_lux": 300, "illuminant": {"illuminant": "A"}},
    {
        "type": "area",
        "position_m": [0.1, 0, 0.5],
        "size_m": [0.1, 0.1],
        "illuminance_lux": 400,
        "waveform": MAINS,
    },
    {"type": "uniform", "illuminance_lux": 100, "waveform": PWM},
    {"type": "uniform", "illuminance_lux": 50, "illuminant": {"illuminant": "A"}},
]


def image(source, shape, begin_us, end_us):
    halves = source.mean_flux(np.arange(shape[0] * shape[1], dtype=np.uint32), begin_us, end_us)
    return tuple(np.array(half, dtype=np.float64).reshape(shape) for half in halves)


def test_lights_add_up():
    sensor = mono(24, 18)
    scene = card(*LIGHTS)
    flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 256, 3))
    assert len(flux.sources) == 3
    parts = [np.mean(image(source, (18, 24), 0, 1), axis=0) for source in flux.sources]
    seen = np.mean(image(flux, (18, 24), 2000, 5300), axis=0)
    weights = Mains(50, 0.4, 70).mean(2000, 5300), Pwm(400, 0.3).mean(2000, 5300)
    expected = parts[0] + weights[0] * parts[1] + weights[1] * parts[2]
    np.testing.assert_allclose(seen, expected, rtol=1e-5)
    # all lights of one scene at once, over a time in which both waveforms have the mean 1
    a, b = image(RenderedFlux(scene, sensor, 256, 8), (18, 24), 0, 1)
    own = image(flux, (18, 24), 0, 20_000)
    error = np.sqrt((a - b) ** 2 + (own[0] - own[1]) ** 2) / 2
    difference = (a + b) / 2 - (own[0] + own[1]) / 2
    # the mean of 432 pixels within 4.4 σ (false alarm 1e-5)
    assert abs(difference.mean()) < 4.4 * np.sqrt(np.mean(error**2) / difference.size)
    # the light's rectangle casts the point light's shadow on the steady part
    middle = parts[0][9]
    assert middle.min() < 0.5 * middle.max()


@pytest.mark.slow
def test_one_instant_agrees_with_the_second_estimator():
    sensor, t_us = mono(12, 8), 1100.0
    scene = card(*LIGHTS)
    flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 512, 3))
    a, b = image(flux, (8, 12), t_us, t_us)
    reference = reference_flux(scene, sensor, 256, t_us, repeats=8, seed=9)
    other, error = reference.mosaic()
    spread = np.sqrt(np.mean((a - b) ** 2) / 4 + np.mean(error**2))
    difference = (a + b) / 2 - other
    assert abs(difference.mean()) < 4.4 * spread / np.sqrt(difference.size)  # false alarm 1e-5
    assert spread < 0.05 * other.mean()
    # and that instant is not the mean
    steady = np.mean(image(flux, (8, 12), 0, 20_000), axis=0)
    assert abs(other.mean() / steady.mean() - 1) > 0.1


def test_several_skies_are_one():
    sensor = mono(8, 8)
    grid = {"wavelength_nm": [450, 650], "value": [1.0, 1.0]}
    skies = [
        {"type": "uniform", "illuminant": {"flat": 1.0, "band_nm": [300, 900]}, "irradiance_w_m2": 6.0},
        {"type": "uniform", "illuminant": {"flat": 2.0, "band_nm": [350, 850]}, "irradiance_w_m2": 5.0},
    ]
    a, b = image(RenderedFlux(card(*skies), sensor, 1024, 3), (8, 8), 0, 1)
    # E = 0.02 W m⁻² nm⁻¹ over the whole response, reflected by one half
    expected = 0.02 / np.pi * 0.5 * sensor.responses["clear"].integral()
    np.testing.assert_allclose((a + b).mean() / 2, expected, rtol=2e-3)
    with pytest.raises(SpecError, match=r"light\.1\.illuminant.*covers"):
        RenderedFlux(card(skies[0], {**skies[1], "illuminant": grid}), sensor, 2)


def test_emitters_of_a_mitsuba_scene_flicker_by_name(tmp_path):
    mi = mitsuba()
    box = mi.cornell_box()
    lamp = {"type": "sphere", "center": [-0.5, -0.2, 0.6], "radius": 0.1}
    box["lamp"] = {**lamp, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4, 4, 4]}}}
    sensor = mono(24, 24)
    scene = Scene.from_mitsuba(box, waveforms={"lamp": PWM}, max_depth=3)
    flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 64, 3))
    dark = np.mean(image(flux, (24, 24), 1000, 2000), axis=0)  # on from 0 to 0.75 ms of 2.5 ms
    lit = np.mean(image(flux, (24, 24), 0, 500), axis=0)
    box["lamp"] = lamp
    only = np.mean(image(RenderedFlux(Scene.from_mitsuba(box, max_depth=3), sensor, 64, 3), (24, 24), 0, 1), axis=0)
    np.testing.assert_allclose(dark, only, rtol=1e-5)
    assert np.all(lit >= dark * (1 - 1e-6)) and np.median(lit / dark) > 1.5
    xml = """<scene version="3.0.0">
      <shape type="rectangle" id="card"/>
      <emitter type="point" id="bulb"><point name="position" x="0" y="0" z="2"/>
        <spectrum name="intensity" value="3"/></emitter>
      <emitter type="constant"><spectrum name="radiance" value="1"/></emitter>
    </scene>"""
    (tmp_path / "s.xml").write_text(xml)
    camera = {"origin_m": (0, 0, 4)}
    scene = Scene.from_mitsuba(tmp_path / "s.xml", waveforms={"bulb": PWM}, camera=camera)
    flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 64, 3))
    on, off = (np.mean(image(flux, (24, 24), *span), axis=0)[12, 12] for span in ((0, 1), (1000, 1001)))
    # sky: L = ρ L_sky; bulb at 2 m: ρ I/(π d²); with d65 of equal power, the bulb 1/duty bright
    np.testing.assert_allclose(on / off, 1 + 3 / (4 * np.pi) / 0.3, rtol=0.02)
    with pytest.raises(SpecError, match=r"no emitter 'lamp' in the Mitsuba scene; there are 'bulb'"):
        flickering(
            Scene.from_mitsuba(tmp_path / "s.xml", waveforms={"lamp": PWM}, camera=camera),
            lambda part, _: RenderedFlux(part, sensor, 2),
        )


# ---- events -------------------------------------------------------------------------------------


def test_ticks_under_mains_flicker_give_the_analytic_events():
    sensor = mono(4, 4)
    flux = FlickerFlux([Mains(50, 0.9, 40), None], [Formula(3e5), Formula(2e4)])
    _, events = run(flux, sensor, 100_000)
    end = np.arange(1, 101) * 1e-3
    wave = np.sin(200 * np.pi * end + np.radians(40)) - np.sin(200 * np.pi * (end - 1e-3) + np.radians(40))
    signal = (3e5 * (1 + 0.9 * wave / (200 * np.pi * 1e-3)) + 2e4) * 1e-3  # electrons of 1 ms
    change = np.diff(np.log(signal * 0.2 * 10 + 1.0))  # I = K·N·t_ref/t_evs; x = β1 I + β2
    assert np.abs(np.abs(change) - 0.1).min() > 1e-3  # no tick hangs on rounding
    expected = [(1000 * (k + 2), np.sign(c)) for k, c in enumerate(change) if abs(c) > 0.1]
    assert len(expected) > 50
    for pixel in range(16):
        own = events[events["y"] * 4 + events["x"] == pixel]
        assert [(int(e["t_us"]), int(e["polarity"])) for e in own] == expected


def log_level(flux):
    """davis346, clean: x = β1 K Φ t_ref + β2."""
    return np.log(flux * 0.036 * 0.010 + 5.0)


def davis(cols=4, rows=2):
    return hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0}).crop(cols, rows)


def travel(levels, theta_on, theta_off):
    """Signed number of events on the way from each level to the next, the reference at the first to begin with."""
    reference, counts = levels[0], []
    for level in levels[1:]:
        theta = theta_on if level > reference else theta_off
        count = (level - reference) / theta
        assert 0.02 < abs(count) % 1 < 0.98  # no extreme hangs on rounding
        counts.append(int(count))
        reference += int(count) * theta
    return counts


def test_asynchronous_events_under_mains_flicker_are_the_analytic_number():
    # the level goes up and down between its extremes, at a third of 10 ms and every 5 ms after that
    flux = FlickerFlux([Mains(50, 0.8, 60)], [Formula(1e6)])
    _, events = run(flux, davis(), 200_000)
    low, high = log_level(1e6 * 0.2), log_level(1e6 * 1.8)
    start = log_level(1e6 * (1 + 0.8 * np.cos(np.radians(60) + 200 * np.pi * 0.5e-6)))
    expected = travel([start, *([low, high] * 19)], 0.2, 0.2)
    own = events[(events["x"] == 1) & (events["y"] == 1)]
    half = np.ceil((own["t_us"] - 10_000 / 3) / 5000.0 - 1e-9).astype(int)
    found = [int(own["polarity"][half == k].sum()) for k in range(38)]
    assert found == expected and (half < 38).sum() == np.abs(expected).sum()
    # each at the time of its own crossing, to the tolerance of the straight lines: 0.002 at 0.1 per ms
    falling = start - 0.2 * np.arange(1, abs(expected[0]) + 1)
    wave = ((np.exp(falling) - 5.0) / 0.036 / 0.010 / 1e6 - 1) / 0.8
    crossing = (np.arccos(wave) - np.radians(60)) / (200 * np.pi) * 1e6
    np.testing.assert_allclose(own["t_us"][: len(wave)], crossing, atol=20)


@pytest.mark.parametrize("window_us", [1, 40])
def test_every_edge_of_a_pulsed_light_is_followed(window_us):
    changes = {"evs.threshold_mismatch_rel": 0, "evs.window_us": window_us, "evs.contrast_threshold_off": 0.23}
    sensor = hr.load_sensor("davis346", changes).crop(2, 2)
    flux = FlickerFlux([Pwm(500, 0.25, 0)], [Formula(1e6)], window_us)
    _, events = run(flux, sensor, 19_000)
    low, high = log_level(0.0), log_level(4e6)
    # begins lit; off at 0.5, 2.5 … 18.5 ms, on at 2, 4 … 18 ms
    edges = np.sort(np.concatenate([np.arange(500, 19_000, 2000), np.arange(2000, 19_000, 2000)]))
    expected = travel([high, *([low, high] * 10)[: edges.size]], 0.2, 0.23)
    own = events[(events["x"] == 0) & (events["y"] == 0)]
    for edge, count in zip(edges, expected, strict=True):
        near = own[(own["t_us"] > edge) & (own["t_us"] <= edge + window_us)]
        assert len(near) == abs(count) and np.all(near["polarity"] == np.sign(count))
    assert len(own) == np.abs(expected).sum()


# ---- motion -------------------------------------------------------------------------------------


def product_mean(base, slope, begin, end):
    """Mean of base·(1 + slope t)·(1 + 0.4 cos(200π t + 70°)), by quadrature."""
    t = begin + (np.arange(20_000) + 0.5) * (end - begin) / 20_000
    return np.mean(base * (1 + slope * t) * (1 + 0.4 * np.cos(200 * np.pi * t + np.radians(70))))


def test_motion_within_an_exposure_does_not_lose_the_products_covariance():
    # Φ triples within 20 ms: the product of the means alone is several per cent off
    for kind in (Formula, Windows):
        flux = FlickerFlux([Mains(50, 0.4, 70)], [kind(1e5, 100.0)])
        rows = np.arange(6, dtype=np.uint32)
        begin, end = rows * 500.0, rows * 500.0 + np.array([9000.0, 4000, 7000, 13_000, 100, 0])
        a, b = flux.mean_flux(rows, begin, end)
        mean = (np.array(a) + np.array(b)) / 2
        for k in range(5):
            expected = product_mean(1e5, 100.0, begin[k] * 1e-6, end[k] * 1e-6)
            np.testing.assert_allclose(mean[k], expected, rtol=2e-4)
        instant = begin[5] * 1e-6
        at_once = 1e5 * (1 + 100 * instant) * (1 + 0.4 * np.cos(200 * np.pi * instant + np.radians(70)))
        np.testing.assert_allclose(mean[5], at_once, rtol=1e-5)
        np.testing.assert_allclose(np.array(a), 1.01 * mean, rtol=1e-5)


def test_an_instant_on_the_border_of_two_pieces_counts_once():
    """Φ(t)·w(t) at every cut between pieces, at both ends and between, asked for together and alone."""
    for kind in (Formula, Windows):
        flux = FlickerFlux([Mains(50, 0.4, 70)], [kind(1e5, 100.0)])
        cuts = flux._cuts_us(0.0, 3000.0)
        assert cuts.size >= 3
        instants = np.concatenate([[0.0], cuts, [1.0, 1999.0, 3000.0]])
        t = instants * 1e-6
        expected = 1e5 * (1 + 100 * t) * (1 + 0.4 * np.cos(200 * np.pi * t + np.radians(70)))
        pixels = np.arange(instants.size, dtype=np.uint32)
        together = np.mean(np.array(flux.mean_flux(pixels, instants, instants)), axis=0)
        np.testing.assert_allclose(together, expected, rtol=1e-5)
        alone = [np.mean(np.array(flux.mean_flux(pixels[:1], at, at))) for at in instants]
        np.testing.assert_allclose(alone, expected, rtol=1e-5)


def test_windows_are_what_the_mean_over_each_would_be():
    flux = FlickerFlux([Mains(50, 0.4, 70), None], [Windows(1e5, 100.0), Windows(3e4, 100.0)])
    begin = np.arange(12) * 1500.0
    end = begin + 1500.0
    pixels = np.arange(3, dtype=np.uint32)
    blocks = [Block(begin[part], end[part], np.arange(6) > 0) for part in (slice(0, 6), slice(5, 11))]
    blocks[0].wanted[0] = True
    seen = [np.array(sample.half_a)[1] / 1.01 for sample in flux.flux_of_blocks(pixels, blocks)]
    assert len(seen) == 11
    for k in range(11):
        steady = 3e4 * (1 + 100 * (begin[k] + 750) * 1e-6)
        expected = product_mean(1e5, 100.0, begin[k] * 1e-6, end[k] * 1e-6) + steady
        np.testing.assert_allclose(seen[k], expected, rtol=2e-4)
    still = FlickerFlux([Mains(50, 0.4, 70)], [Windows(1e5)])
    for k, sample in enumerate(still.flux_of_blocks(pixels, blocks)):
        np.testing.assert_allclose(
            np.array(sample.half_a) / 1.01, product_mean(1e5, 0, begin[k] * 1e-6, end[k] * 1e-6), rtol=1e-5
        )
    assert [len(asked) for asked in still.sources[0].asked] == [3]


def test_a_light_that_is_off_meanwhile_is_not_rendered():
    sources = [Formula(1e5, 100.0), Formula(3e4, 100.0)]
    flux = FlickerFlux([Pwm(100, 0.2, 0), None], sources)
    a, _ = flux.mean_flux(np.arange(4, dtype=np.uint32), 3000.0, 3100.0)
    assert len(sources[0].asked) == 0 and len(sources[1].asked) == 1
    np.testing.assert_allclose(np.array(a), 1.01 * 3e4 * (1 + 100 * 3050e-6), rtol=1e-6)


def test_edges_of_the_motion_are_passed_on_and_times_are_those_of_both():
    scene = hr.load_scene(
        "rotating-star",
        {"light": {"type": "uniform", "illuminance_lux": 100, "waveform": {**PWM, "frequency_hz": 1000}}},
    )
    sensor = mono(32, 24)
    plain = RenderedFlux(light_parts(scene)[0][1], sensor, 2)
    flux = flickering(scene, lambda part, _: RenderedFlux(part, sensor, 2))
    np.testing.assert_array_equal(flux.slice_edges_us(0, 5000), plain.slice_edges_us(0, 5000))
    times = flux.sample_times_us(0, 5000)
    assert np.isin(plain.sample_times_us(0, 5000), times).all()
    assert {300.0, 301.0, 1000.0, 1001.0} <= set(times)
    assert np.all(np.diff(times) > 0) and times[0] > 0 and times[-1] < 5000


def test_means_over_parts_of_a_microsecond_weight_the_pieces_by_their_lengths():
    """A jump of the light within intervals of 0.6 and 0.9 µs, and a piece that only one of the pixels reaches."""
    light = Pwm(400, 0.3)  # on for 750 µs
    flux = FlickerFlux([light], [Formula(slope_per_s=300.0)])
    begin, end = np.array([749.8, 749.3, 740.0]), np.array([750.4, 750.2, 741.0])
    half_a, half_b = flux.mean_flux(np.arange(3, dtype=np.uint32), begin, end)
    lit = np.minimum(end, 750.0)
    middle = (begin + lit) / 2
    expected = 1e5 * (1 + 300e-6 * middle) * (lit - begin) / (end - begin) / 0.3
    np.testing.assert_allclose((np.array(half_a) + np.array(half_b)) / 2, expected, rtol=1e-5)
    nothing = flux.mean_flux(np.arange(0, dtype=np.uint32), 1.0, 2.0)
    assert np.array(nothing[0]).size == 0


def test_a_source_that_weights_its_means_itself_is_asked_once():
    """Within 3250 µs the light is on for 750 µs from 0 and from 2500 µs: the flux of these times is that at 1625 µs."""
    light = Pwm(400, 0.3)

    class Weighted(Formula):
        def mean_flux(self, pixel, begin_us, end_us):
            return super().mean_flux(pixel, 1625.0, 1625.0)

    own, plain = Weighted(slope_per_s=300.0), Formula(slope_per_s=300.0)
    own.light = light
    for source in (own, plain):
        halves = FlickerFlux([light], [source]).mean_flux(np.arange(3, dtype=np.uint32), 0.0, 3250.0)
        np.testing.assert_allclose(np.mean(halves, axis=0), 1e5 * (1 + 300 * 1625e-6) * 1500 / 3250 / 0.3, rtol=1e-5)
    assert len(own.asked) == 1 < len(plain.asked)
    # weighted by another light, it is cut at the jumps as any other
    own.light = Pwm(400, 0.4)
    own.asked.clear()
    FlickerFlux([light], [own]).mean_flux(np.arange(3, dtype=np.uint32), 0.0, 3250.0)
    assert len(own.asked) > 1


def test_windows_that_straddle_slices_have_the_mean_of_their_parts():
    class Sliced(Formula):
        def slice_edges_us(self, begin_us, end_us):
            return np.array([at for at in (100.0, 160.0) if begin_us < at < end_us])

        def mean_flux(self, pixel, begin_us, end_us):
            level = {0: 5.0, 1: 7.0, 2: 11.0}[int(np.searchsorted([100.0, 160.0], begin_us, side="right"))]
            return level, 2 * level

    begin, end = np.array([0.0, 70.0, 150.0, 120.0]), np.array([50.0, 180.0, 170.0, 120.0])
    block = Block(begin, end, np.array([False, True, True, True]))
    found = [(one.half_a, one.half_b) for one in Sliced().flux_of_blocks(np.arange(2), [block])]
    means = [(30 * 5 + 60 * 7 + 20 * 11) / 110, 9.0, 7.0]
    np.testing.assert_allclose(found, [(mean, 2 * mean) for mean in means])


@pytest.mark.parametrize("has_error", [True, False])
def test_errors_of_pieces_add_and_those_of_lights_are_independent(has_error):
    """Two lights in three pieces of a window, with weights: √(Σ (Σ w σ)²), as the pieces share their random numbers."""
    rng = np.random.default_rng(5)
    weights, error = rng.uniform(0.2, 3, (3, 2)), rng.uniform(1, 9, (3, 2, 4)).astype(np.float32)
    a, b = rng.uniform(10, 90, (2, 3, 2, 4))
    samples = [
        tuple(
            Sample(*(from_host(jit().Float, half[p, k]) for half in (a, b)), error[p, k] if has_error else None)
            for k in range(2)
        )
        for p in range(3)
    ]  # fmt: skip
    total = FlickerFlux([None, None], [Formula(), Formula(slope_per_s=3.0)])._sum(samples, weights)
    np.testing.assert_allclose(total.half_a, np.einsum("pk,pkn->n", weights, a), rtol=1e-6)
    np.testing.assert_allclose(total.half_b, np.einsum("pk,pkn->n", weights, b), rtol=1e-6)
    wanted = np.hypot(*np.einsum("pk,pkn->kn", weights, error)) if has_error else []
    np.testing.assert_allclose(total.error, wanted, rtol=1e-6)
