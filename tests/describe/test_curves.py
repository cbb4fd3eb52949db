"""What a description of a sensor says, against simulations of the sensor."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate, special

import hesim_render as hr
from hesim_render.core import drawing
from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.describe import curve_picture, curves, event_curves, figures_of, photon_transfer, s_curve, table_lines
from hesim_render.describe.table import TABLE_LUX
from hesim_render.pixels.evs.noise_rates import events_per_period
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.from_data_sheet import electrons_per_s_lux
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.files import list_names
from hesim_render.spectral.spectrum import illuminant

#: A pixel of 20 Hz, which is quick to simulate, written as a data sheet.
SLOW = {
    "evs.data_sheet.noise_cutoff_hz": 20, "evs.data_sheet.background": [{"lux": 5, "rate_hz": 4}],
    "evs.data_sheet.speed": [{"lux": 5, "bandwidth_hz": 20}], "evs.data_sheet.refractory_us": 5000,
}  # fmt: skip


#: Without noise, and without the queue of the read-out, in which events of all pixels at once would wait.
NO_QUEUE = ("leak", "shot", "dark_current", "readout_limit")
#: Shipped sensors whose event pixels are written as a data sheet, and the latencies that the sheets state.
SHEETS = {
    name: evs.data_sheet
    for name in list_names("sensors")
    if (evs := read_sensor(name).evs) is not None and evs.data_sheet
}
LATENCIES = [
    (name, speed.lux, speed.latency_us)
    for name, sheet in SHEETS.items()
    for speed in sheet.speed
    if speed.latency_us is not None
]


def electrons(sensor, lux):
    """Electrons of a window of every event pixel at an illuminance in the data sheet's light."""
    sheet = sensor.spec.evs.data_sheet or sensor.spec.evs.v2e
    light = sheet.light.load() if sheet else illuminant("D65")
    flux = electrons_per_s_lux(sensor.spec, next(iter(sensor.spec.filters)), light)
    window_s = sensor.spec.evs.window_us * 1e-6
    return from_host(jit().Float, np.full(math.prod(sensor.layout.evs_shape), lux * flux * window_s, np.float32))


def simulated_rates(sensor, lux, begin_s, seconds, seed=3):
    """ON and OFF events per second and pixel in steady light, from `begin_s` on."""
    stage, light = EvsStage(sensor.evs, seed), electrons(sensor, lux)
    stage.step(light, 0)
    found = [stage.step(light, t) for t in range(100_000, round((begin_s + seconds) * 1e6) + 1, 100_000)]
    events = np.concatenate(found)
    late = events["polarity"][events["t_us"] > begin_s * 1e6]
    scale = seconds * math.prod(sensor.layout.evs_shape)
    return np.sum(late > 0) / scale, np.sum(late < 0) / scale


def of_drawn_thresholds(sensor, lux):
    """Background of the very pixels of this sensor, by the closed form for each pixel's thresholds."""
    evs, sheet = sensor.spec.evs, sensor.spec.evs.data_sheet
    bandwidth_hz = evs.noise_cutoff_hz * float(sensor.evs.noise_share(electrons(sensor, lux).numpy()[:1], 0)[0])
    sigma = event_curves(sensor, [float(lux)]).sigma[0]
    on, off = (np.ravel(each) / sigma for each in (sensor.evs.threshold_on_map, sensor.evs.threshold_off_map))
    events = events_per_period(on, off, evs.refractory_period_us * 1e-6 * bandwidth_hz, sheet.leak_hz / bandwidth_hz)
    return sheet.leak_hz + bandwidth_hz * events.mean()


def after_step(sensor, lux, contrast, wait_us, without=()):
    """First event of each pixel after a step of contrast: µs after the step, and polarity."""
    stage, begin_us = EvsStage(sensor.evs.without(*without), 3), 5000
    for t_us, level in ((0, lux), (begin_us, lux), (begin_us + 1, lux * (1 + contrast))):
        stage.step(electrons(sensor, level), t_us)
    events = stage.step(electrons(sensor, lux * (1 + contrast)), begin_us + wait_us)
    place = events["y"].astype(np.int64) * sensor.cols + events["x"]
    first = events[np.unique(place, return_index=True)[1]]
    return first["t_us"] - begin_us, first["polarity"]


@pytest.mark.slow
def test_the_background_of_a_data_sheet_is_what_the_sensor_gives():
    sensor = hr.load_sensor("imx636", SLOW).crop(64, 64)
    on, off = simulated_rates(sensor, 5, 4.0, 2.0)  # after 80 periods of the noise the level has settled
    curves = event_curves(sensor, [5.0])
    assert curves.on_hz[0] + curves.off_hz[0] == pytest.approx(4.0, rel=1e-3)
    # 32,000 events of 4096 pixels with thresholds of their own: standard error 1.2 %
    assert on + off == pytest.approx(4.0, rel=0.05)
    assert on == pytest.approx(curves.on_hz[0], rel=0.05) and off == pytest.approx(curves.off_hz[0], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "lux", "pixels", "begin_s", "seconds"),
    [
        ("imx636", 5, 64, 0.5, 1.5), ("v2e-noisy", 0, 240, 3, 6), ("v2e-noisy", 100, 240, 3, 6),
        ("genx320", 5, 64, 0.5, 1.5), ("dvxplorer", 100, 128, 4, 2),
    ],
)  # fmt: skip
def test_the_background_of_shipped_sensors_is_what_they_give(name, lux, pixels, begin_s, seconds):
    whole = hr.load_sensor(name)
    sensor = whole.crop(pixels, pixels)
    found = sum(simulated_rates(sensor, lux, begin_s, seconds))
    options = sensor.spec.evs.v2e
    if options is None:
        (sheet,) = sensor.spec.evs.data_sheet.background
        assert sheet.lux == lux
        stated = sheet.rate_hz
        # where thresholds differ much, rare pixels have most of the noise, and which ones are in the crop matters
        found *= of_drawn_thresholds(whole, lux) / of_drawn_thresholds(sensor, lux)
    else:
        stated = options.shot_noise_rate_hz * (1 if lux == 0 else 0.25) + 0.1
    # 33,000 events or more; the draw of 4096 (57,600) pixels adds 1 % (2 % where rare pixels have most of the noise)
    assert found == pytest.approx(stated, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pixels"), [("davis240", 128), ("dvs128", 128), ("gen31-vga", 96)])
def test_rare_background_with_its_leak(name, pixels):
    """Noise events far rarer than the periods of the noise, from the 1000th to the 3000th period, as in the tables.

    Few pixels of low threshold have most of them. What is simulated is a part of the sensor; the closed form tells what
    its thresholds make of the rate.
    """
    whole = hr.load_sensor(name)
    sensor = whole.crop(pixels, pixels)
    sheet = sensor.spec.evs.data_sheet
    (stated,) = sheet.background
    curves = event_curves(sensor, [float(stated.lux)])
    assert curves.on_hz[0] + curves.off_hz[0] == pytest.approx(stated.rate_hz, rel=1e-3)
    begin_s, end_s = (round(periods / sheet.noise_cutoff_hz, 1) for periods in (1000, 3000))
    found = sum(simulated_rates(sensor, stated.lux, begin_s, end_s - begin_s))
    drawn = of_drawn_thresholds(sensor, stated.lux)
    assert found == pytest.approx(drawn, rel=0.05)  # 10,000 events or more
    assert of_drawn_thresholds(whole, stated.lux) * found / drawn == pytest.approx(stated.rate_hz, rel=0.05)


def test_comparator_noise_is_in_the_rates():
    """Without other noise the rates are its own; a stated background holds it, and less is left for the light."""
    own = {"on_hz": 0.013, "off_hz": 0.029}
    silent = {"evs.coefficients.0.beta3": 0.0, "evs.coefficients.0.beta4": 0.0, "evs.leak_rate_hz": 0.17}
    for name, leak_hz in (("davis346", 0.17), ("eiger", 0.17)):
        curves = event_curves(hr.load_sensor(name, {**silent, "evs.comparator_noise": own}), [7.0])
        assert curves.on_hz[0] == pytest.approx(leak_hz + own["on_hz"], rel=1e-3)
        assert curves.off_hz[0] == pytest.approx(own["off_hz"], rel=1e-3)
    plain, noisy = hr.load_sensor("davis240"), hr.load_sensor("davis240", {"evs.comparator_noise": own})
    (stated,) = noisy.spec.evs.data_sheet.background
    curves, without = (event_curves(sensor, [stated.lux]) for sensor in (noisy, plain))
    assert curves.on_hz[0] + curves.off_hz[0] == pytest.approx(stated.rate_hz, rel=1e-3)
    assert curves.sigma[0] < without.sigma[0]
    with pytest.raises(SpecError, match="is not above leak and comparator_noise"):
        hr.load_sensor("davis240", {"evs.comparator_noise": {"off_hz": stated.rate_hz}})


@pytest.mark.parametrize("dead_us", [None, 23])
def test_rates_are_those_of_the_dead_time_and_of_the_leak(dead_us, monkeypatch):
    """Seconds and Hz; a sensor may have no dead time."""
    given = []
    monkeypatch.setattr(curves, "noise_rates_hz", lambda *arguments: given.append(arguments) or (0.7, 0.4))
    changes = {"evs.refractory_period_us": dead_us, "evs.leak_rate_hz": 0.17, "evs.comparator_noise": {"on_hz": 0.03}}
    found = event_curves(hr.load_sensor("davis346", changes), [7.0])
    (*_, dead_s, resets_hz) = given[0]
    assert dead_s == pytest.approx((dead_us or 0) * 1e-6, abs=0) and resets_hz == pytest.approx(0.2)
    assert found.on_hz[0] == pytest.approx(0.9) and found.off_hz[0] == pytest.approx(0.4)


@pytest.mark.slow
@pytest.mark.parametrize("lux", (0.4, 6.0, 30.0))
def test_rates_of_a_gradual_corner_and_comparator_noise(lux):
    """The closed form and a simulation, where light, bias and the comparators each have a part of the events."""
    changes = {
        "evs.noise_cutoff_hz": 210.0, "evs.comparator_noise": {"on_hz": 0.6, "off_hz": 1.7},
        "evs.photoreceptor": {
            "cutoff_hz": 340.0, "signal_dn": 900.0, "min_cutoff_hz": 4.0, "filters_noise": True, "approach": "gradual",
        },
        "evs.refractory_period_us": 150,
    }  # fmt: skip
    sensor = hr.load_sensor("davis346", changes).crop(64, 64)
    curves = event_curves(sensor, [lux])
    found = simulated_rates(sensor, lux, 0.5, 4.0)
    # 10,000 events or more of pixels that differ: 5 % is four standard errors
    assert found == pytest.approx((curves.on_hz[0], curves.off_hz[0]), rel=0.06)


def test_rates_in_dim_light_fall_with_the_pixels_speed():
    """Above the illuminance where the photoreceptor limits the noise the rate falls with the noise itself, below it
    with the bandwidth: between them is the maximum that measured rates of event cameras have."""
    curves = event_curves(hr.load_sensor("imx636"), np.geomspace(0.2, 100, 40))
    rate = curves.off_hz
    peak = int(np.argmax(rate))
    assert 3 < curves.lux[peak] < 7
    assert np.all(np.diff(rate[: peak + 1]) > 0) and np.all(np.diff(rate[peak:]) < 0)
    slope = np.diff(np.log(rate[:peak])) / np.diff(np.log(curves.lux[:peak]))
    assert np.all(slope < 2.2) and slope[-1] == pytest.approx(1.0, abs=0.3)
    # never below the shot noise of the electrons themselves
    assert np.all(curves.sigma > curves.shot_limit)


def test_the_shot_limit_is_white_noise_through_two_poles():
    sensor = hr.load_sensor("imx636")
    light, lux = illuminant("LED-B2"), 200.0  # where the noise has its full bandwidth of 60 Hz
    flux = lux * electrons_per_s_lux(sensor.spec, "clear", light)
    pole_hz = 60 / math.sqrt(math.sqrt(2) - 1)
    # one-sided density 2/Φ of ln of the light, times |H|² = 1/(1 + (f/f0)²)²
    power = integrate.quad(lambda f: 2 / flux / (1 + (f / pole_hz) ** 2) ** 2, 0, np.inf)[0]
    assert event_curves(sensor, [lux]).shot_limit[0] == pytest.approx(math.sqrt(power), rel=1e-6)
    fixed = hr.load_sensor("gen2")
    counted = electrons(fixed, 3.0).numpy()[0]
    row, col = fixed.spec.positions("evs")[0]
    name = fixed.spec.pixels[fixed.spec.tile_rows[row][col]].filter
    counted *= electrons_per_s_lux(fixed.spec, name, illuminant("D65")) / electrons_per_s_lux(
        fixed.spec, next(iter(fixed.spec.filters)), illuminant("D65")
    )
    assert event_curves(fixed, [3.0]).shot_limit[0] == pytest.approx(1 / math.sqrt(counted), rel=1e-4)


@pytest.mark.slow
def test_threshold_and_mismatch_of_a_data_sheet_are_those_of_simulated_s_curves():
    sensor = hr.load_sensor("imx636", SLOW).crop(128, 128)
    bright = 50_000.0
    for sign in (1, -1):
        # contrasts between the 2nd and the 98th percentile of the thresholds
        percent = np.linspace(20.5, 29.5, 7) if sign > 0 else 100 * (1 - 1 / (1 + np.linspace(0.205, 0.295, 7)))
        share = []
        for contrast in sign * percent / 100:
            wait_us, polarity = after_step(sensor, bright, contrast, 100_000)
            share.append(np.mean(polarity == sign) * len(wait_us) / 128**2)
        theta = np.abs(np.log1p(sign * percent / 100))
        slope, offset = np.polyfit(theta, special.ndtri(share), 1)
        centre, width = -offset / slope, 1 / slope
        # 16,384 pixels: standard errors 0.1 % of the centre and 0.7 % of the width
        assert centre == pytest.approx(math.log(1.25), rel=0.01)
        assert width == pytest.approx(0.025 / 1.25, rel=0.05)
        # one comparison: without the noise and the leak, which give a pixel more chances while it settles
        share = [
            np.sum(after_step(sensor, bright, contrast, 100_000, ("leak", "shot", "dark_current"))[1] == sign) / 128**2
            for contrast in sign * percent / 100
        ]
        predicted = s_curve(sensor, bright, sign * percent / 100)
        np.testing.assert_allclose(predicted, share, atol=0.0156)  # four standard errors at most


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_s_curves_of_shipped_sheets_have_their_threshold_and_mismatch(name):
    """Without noise, so that one step decides: the spread is that of the pixels' own thresholds, over 8192 of them."""
    sensor = hr.load_sensor(name)
    sensor = sensor.crop(min(128, sensor.cols), min(64, sensor.rows))
    sheet = sensor.spec.evs.data_sheet
    for sign, stated in ((1, sheet.threshold_on_percent), (-1, sheet.threshold_off_percent)):
        percent = stated + sheet.threshold_mismatch_percent * np.linspace(-1.8, 1.8, 7)
        contrast = percent / 100 if sign > 0 else 1 / (1 + percent / 100) - 1
        share = [
            np.sum(after_step(sensor, 20_000.0, c, 20_000, NO_QUEUE)[1] == sign) / math.prod(sensor.layout.evs_shape)
            for c in contrast
        ]
        theta = np.log1p(percent / 100)
        slope, offset = np.polyfit(theta, special.ndtri(share), 1)
        # standard errors 1 % of the width and 2 % of it for the centre
        assert -offset / slope == pytest.approx(math.log1p(stated / 100), rel=0.02)
        assert 1 / slope == pytest.approx(sheet.threshold_mismatch_percent / 100 / (1 + stated / 100), rel=0.05)


@pytest.mark.parametrize(("name", "lux", "stated_us"), LATENCIES)
def test_latencies_of_a_data_sheet_are_those_of_simulated_steps(name, lux, stated_us):
    sensor = hr.load_sensor(name).crop(8, 8)
    wait_us, polarity = after_step(sensor, lux, 1.0, max(4 * stated_us, 50), (*NO_QUEUE, "mismatch"))
    assert len(wait_us) == 64 and np.all(polarity == 1)
    # the light rises within 1 µs, in the middle of which the step is, and times of events are rounded up to whole µs
    assert np.median(wait_us) - 0.5 - 0.5 == pytest.approx(stated_us, rel=0.05)
    assert event_curves(sensor, [float(lux)]).latency_us[0] == pytest.approx(stated_us, rel=0.01)


def test_rates_at_a_fixed_tick_against_the_stage():
    changes = {"evs.contrast_threshold_on": 0.05, "evs.contrast_threshold_off": 0.06}
    sensor = hr.load_sensor("reference-mono", changes).crop(256, 256)
    lux = 0.5
    curves = event_curves(sensor, [lux])
    stage, light = EvsStage(sensor.evs, 3), electrons(sensor, lux)
    ticks, tick_us = 60, sensor.spec.evs.tick_us
    events = np.concatenate([stage.step(light, tick_us * (k + 1)) for k in range(ticks + 1)])
    scale = ticks * 256**2 * tick_us * 1e-6
    on, off = (np.sum(events["polarity"] == sign) / scale for sign in (1, -1))
    assert min(on, off) * scale > 2000
    # at least 2000 events; successive comparisons share a sample: standard error below 3 %
    assert on == pytest.approx(curves.on_hz[0], rel=0.12) and off == pytest.approx(curves.off_hz[0], rel=0.12)


def test_leak_and_comparators_act_where_a_tick_has_no_event_yet():
    """At a tick of 1 ms: 31 % ON and 23 % OFF by noise, then leak of 300 Hz, then the comparators' own events."""
    changes = {
        "evs.contrast_threshold_on": 0.03, "evs.contrast_threshold_off": 0.045, "evs.threshold_mismatch_rel": 0.2,
        "evs.leak_rate_hz": 300.0, "evs.comparator_noise": {"on_hz": 90.0, "off_hz": 160.0},
    }  # fmt: skip
    sensor = hr.load_sensor("reference-mono", changes).crop(128, 128)
    lux = 2.0
    curves = event_curves(sensor, [lux])
    stage, light, tick_us = EvsStage(sensor.evs, 3), electrons(sensor, lux), sensor.spec.evs.tick_us
    events = np.concatenate([stage.step(light, tick_us * (k + 1)) for k in range(61)])
    scale = 60 * 128**2 * tick_us * 1e-6
    on, off = (np.sum(events["polarity"] == sign) / scale for sign in (1, -1))
    # 450,000 and 280,000 events; successive comparisons share a sample
    assert on == pytest.approx(curves.on_hz[0], rel=8e-3) and off == pytest.approx(curves.off_hz[0], rel=8e-3)


def test_photon_transfer_is_that_of_the_emva_standard():
    sensor = hr.load_sensor("imx250")
    electrons_, mean, deviation = photon_transfer(sensor)
    gain, read, dark = 0.347, 2.4, 3.0 * 0.005
    np.testing.assert_allclose(mean, gain * (electrons_ + dark), rtol=1e-6)
    np.testing.assert_allclose(deviation**2, gain**2 * (electrons_ + dark + read**2) + 1 / 12, rtol=1e-6)
    figures = {row.name: row.value for row in figures_of(sensor)["frames"]}
    # the source of the preset states 40.3 dB and 71.2 dB
    assert figures["largest SNR"] == pytest.approx(40.3, abs=0.1)
    assert figures["dynamic range"] == pytest.approx(71.2, abs=2.0)


@pytest.mark.parametrize("name", list_names("sensors"))
def test_every_shipped_sensor_can_be_described(name):
    sensor = hr.load_sensor(name)
    figures = figures_of(sensor)
    assert ("frames" in figures) == (sensor.spec.aps is not None)
    assert ("events" in figures) == (sensor.spec.evs is not None)
    for row in (row for rows in figures.values() for row in rows):
        assert math.isfinite(row.value) or row.name.startswith("latency")
        if row.stated is not None:
            assert row.value == pytest.approx(row.stated, rel=2e-3), row.name
    lines = list(table_lines(figures))
    assert all(len(line) <= 120 for line in lines)
    if sensor.spec.evs is not None:
        assert sum(" lx " in line and line.endswith(("µs", "none")) for line in lines) >= len(TABLE_LUX)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"lux": [-1.0]}, "0 or more"),
        ({"lux": [math.nan]}, "finite"),
        ({"lux": [1.0], "step": 0.0}, "above 0"),
        ({"lux": [1.0], "position": 4}, "event position"),
    ],
)
def test_mistakes_are_named(arguments, text):
    with pytest.raises(RangeError, match=text):
        event_curves(hr.load_sensor("gen2"), **arguments)
    with pytest.raises(RangeError, match="above -1"):
        s_curve(hr.load_sensor("gen2"), 1.0, [-1.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_noise_and_latency_have_no_kink_where_the_dark_current_begins(name):
    """Light and dark current together set the corner. The noise of a current I + I₀ in a bandwidth that is proportional
    to it has the same σ in any light, and from the light on that has the noise's own bandwidth it falls.
    """
    dark_lux, evs, sensor = SHEETS[name].dark_lux, read_sensor(name).evs, hr.load_sensor(name)
    dim = event_curves(sensor, np.geomspace(dark_lux / 10, 5 * dark_lux, 102), step=7.0)
    (beta,) = evs.coefficients
    share = evs.photoreceptor.min_cutoff_hz / evs.noise_cutoff_hz
    np.testing.assert_allclose(dim.sigma, beta.beta4 / dark_lux * np.sqrt(share), rtol=2e-4)
    # a step of the exponent by 1 has a second difference of 0.04
    for values in (dim.sigma, dim.on_hz + dim.off_hz, dim.latency_us):
        assert np.abs(np.diff(np.log(values), 2)).max() < 2e-3
    assert np.all(np.diff(dim.latency_us) < 0)
    # the rate rises with the bandwidth of the noise, and falls with its σ
    rate_hz = event_curves(sensor, np.geomspace(dark_lux / 10, 1e4, 40)).on_hz
    assert np.count_nonzero(np.diff(np.sign(np.diff(rate_hz)[np.abs(np.diff(rate_hz)) > 1e-9]))) == 1


@pytest.mark.parametrize("name", [pytest.param("imx636", marks=pytest.mark.slow), "eiger", "reference-bayer"])
def test_texts_on_the_axes_of_the_picture_do_not_overlap(name, tmp_path, monkeypatch):
    """And the point of the data sheet, which counts all events, lies on a curve that counts all events."""
    drawn = []
    monkeypatch.setattr(curve_picture, "new_figure", lambda size: drawn.append(drawing.new_figure(size)) or drawn[-1])
    curve_picture.write_picture(hr.load_sensor(name), tmp_path / "p.png")
    (figure,) = drawn
    # three drawings a row at most, those that are not there left out
    axes = [each for each in figure.axes if each.axison]
    columns = min(len(axes), 3)
    assert {each.get_subplotspec().get_gridspec().ncols for each in axes} == {columns}
    assert {each.get_subplotspec().get_gridspec().nrows for each in axes} == {-(-len(axes) // columns)}
    with drawing.report_style():
        figure.canvas.draw()
        for axes in figure.axes:
            for axis, side in ((axes.xaxis, 0), (axes.yaxis, 1)):
                seen = [tick.label1 for tick in axis.get_major_ticks() if tick.label1.get_text()]
                boxes = [label.get_window_extent() for label in seen]
                inside = [box for box in boxes if axes.bbox.intervalx[0] - 60 < box.x1 < axes.bbox.intervalx[1] + 30]
                starts = sorted(box.get_points()[:, side].tolist() for box in inside)
                assert all(before[1] < after[0] for before, after in pairwise(starts)), axes.get_title(loc="left")
    if name == "imx636":
        (rates,) = (axes for axes in figure.axes if axes.get_title(loc="left") == "Events in steady light")
        lines = {line.get_label(): line for line in rates.lines}
        curve, point = lines["all events"], lines["data sheet, all events"]
        (lux,), (rate,) = point.get_data()
        np.testing.assert_allclose(np.interp(lux, *curve.get_data()), rate, rtol=0.05)


def test_large_figures_of_the_table_have_no_exponent():
    """A full well or an exposure of 10,000 is a number to compare with a data sheet."""
    figures = figures_of(hr.load_sensor("reference-mono", {"aps.full_well_e": 10715, "aps.exposure_us": 10_000}))
    lines = list(table_lines(figures))
    (well,) = (line for line in lines if "full well" in line)
    assert well.split()[-2:] == ["10715", "e⁻"]
    latencies = [line for line in lines if " lx " in line]
    assert latencies and not any("e+" in line for line in lines)
