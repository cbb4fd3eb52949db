"""The light that the simulated bench shows to a sensor, against what its recordings say of it."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from ruamel.yaml import YAML

import hesim_render as hr
from hesim_render.exchange import open_events
from hesim_render.pixels.evs.events import no_events
from hesim_render.report import simulate as frames
from hesim_render.report import simulated
from hesim_render.report.simulated import REFERENCE_LUX, Instrument
from hesim_render.sensor.from_data_sheet import electrons_per_s_lux
from hesim_render.spectral.spectrum import illuminant


class Stage:
    """Notes light and comparisons; its level is ln of the light, and each step gives an event."""

    def __init__(self):
        self.seen, self.resets, self.level = [], [], None

    def step(self, lux, t_us):
        assert not self.seen or t_us >= self.seen[-1][0]
        self.seen.append((t_us, lux))
        self.level = math.log(lux)
        event = np.zeros(1, no_events().dtype)
        event["t_us"] = t_us
        return event

    def compare_with(self, level):
        self.resets.append((self.seen[-1][0], level))


def pixels(**given):
    """Event pixels with unlike numbers: asynchronous, or with ticks where `tick_us` is given."""
    spec = {"tick_us": None, "photoreceptor": None, "noise_cutoff_hz": 230.0, "refractory_period_us": None}
    spec |= {"contrast_threshold_on": 0.23, "contrast_threshold_off": 0.31} | given
    kind = "last_event" if spec["tick_us"] is None else "previous_sample"
    return SimpleNamespace(reference=kind, **spec)


def bench(spec, corner_hz=None):
    """An instrument whose recordings are the light itself."""
    made = Instrument.__new__(Instrument)
    made._noise = SimpleNamespace(spec=spec, corner_hz=corner_hz)
    made._seed, made._number, made._per_lux = 3, 0, np.array([2.0, 5.0])
    made._content = {"steps": [], "modulation": []}
    made.stages, made.files, made.saved = [], [], []
    made._stage = lambda: made.stages.append(Stage()) or made.stages[-1]
    made._electrons = lambda lux: lux
    made._save = lambda events, name: made.saved.append(events["t_us"].tolist()) or made.files.append(name) or name
    return made


def test_half_periods_let_pixels_settle():
    """A period of the corner frequency, four dead times and 2 ms; four ticks of pixels that have them."""
    assert bench(pixels())._half_us(70.0) == math.ceil(1e6 / 230)
    assert bench(pixels(noise_cutoff_hz=7000.0))._half_us(70.0) == 2000
    assert bench(pixels(refractory_period_us=1300))._half_us(70.0) == 5200
    assert bench(pixels(tick_us=170, refractory_period_us=9000))._half_us(70.0) == 680
    follows = SimpleNamespace(cutoff_hz=400.0, follows_light=True)
    made = bench(pixels(photoreceptor=follows), lambda electrons, position: 0.5 * float(electrons))
    assert made._half_us(70.0) == math.ceil(1e6 / (0.5 * 70 * 3.5))
    follows.follows_light = False
    assert made._half_us(70.0) == 2500
    assert made._corner_hz == 400.0 and bench(pixels())._corner_hz == 230.0
    assert bench(pixels(tick_us=170))._corner_hz == pytest.approx(1e6 / 170 / 4)


@pytest.mark.parametrize("tick_us", [None, 170])
def test_steps_rise_and_fall_by_their_size_at_the_times_of_the_file(tick_us):
    """Right after a comparison of pixels with ticks; others are compared with their own level at each jump."""
    made = bench(pixels(tick_us=tick_us))
    made._steps(70.0, 0.35, 3)
    (stage,), (entry,) = made.stages, made._content["steps"]
    t_us, lux = np.array(stage.seen).T
    half = made._half_us(70.0)
    assert entry["contrast"] == pytest.approx(np.exp(0.35) - 1) and entry["period_us"] == 2 * half
    assert (
        entry["interval_us"] == [0, 7 * half] and entry["begin_us"] == half and t_us[[0, -1]].tolist() == [0, 7 * half]
    )
    jumps = half * np.arange(1, 7)
    np.testing.assert_allclose(np.diff(np.log(lux))[np.diff(lux) != 0], 0.35 * np.array([1, -1, 1, -1, 1, -1]))
    assert entry["reset"] is (tick_us is None)
    if tick_us is None:
        assert t_us[1:][np.diff(lux) != 0].tolist() == (jumps + 1).tolist()
        assert [when for when, _ in stage.resets] == jumps.tolist()
        assert [level for _, level in stage.resets] == pytest.approx(np.log([70, 70 * np.exp(0.35)] * 3))
    else:
        # the light of a comparison is the last one before it: the first with the new light is a tick after the jump
        assert t_us[1:][np.diff(lux) != 0].tolist() == (jumps + tick_us).tolist()
        assert np.all(np.diff(t_us) == tick_us)
    made._steps(70.0, 0.35, 3)
    assert len({entry["file"] for entry in made._content["steps"]}) == 2 == len(set(made.files))
    assert made.saved == [[when for when, _ in stage.seen] for stage in made.stages]


def test_modulated_light_swings_by_thresholds_at_parts_of_the_corner_frequency():
    """The logarithm of a sine goes from ln(1 − d) to ln(1 + d), which is the swing; 8 cycles of each frequency."""
    made = bench(pixels(tick_us=170))
    made._modulations(0.27)
    entries = made._content["modulation"]
    assert len(entries) == len(made.stages) == len(set(made.files))
    rates, swings = set(), set()
    for entry, stage in zip(entries, made.stages, strict=True):
        begin_us, end_us = entry["interval_us"]
        assert begin_us == 0 and end_us == round(8 * 1e6 / entry["hz"])
        swings.add(round(math.log((1 + entry["depth"]) / (1 - entry["depth"])) / 0.27, 6))
        rates.add(entry["hz"])
        if entry["hz"] < 300:
            t_us, lux = np.array(stage.seen).T
            wave = entry["lux"] * (1 + entry["depth"] * np.sin(2 * np.pi * entry["hz"] * t_us * 1e-6))
            # held for up to a 48th of a cycle before the comparison
            assert np.abs(lux / wave - 1).max() < 1.2 * (2 * np.pi / 48 + 2 * np.pi * 170e-6 * entry["hz"])
            is_above = wave > entry["lux"] * (1 + entry["depth"] / 2)
            assert np.count_nonzero(is_above[1:] & ~is_above[:-1]) == 8
    corner = 1e6 / 170 / 4
    assert sorted(rates) == pytest.approx([corner / 8, corner / 4, corner / 2, corner, 2 * corner], rel=5e-3)
    assert min(swings) < 1 < 3 < max(swings) and len(swings) * len(rates) == len(entries)


def test_bursts_begin_and_end_in_still_light_and_have_the_stated_swing_in_their_middle():
    made = bench(pixels())
    events, end_us, times = made._bursts(40.0, 0.9)
    (stage,) = made.stages
    assert events["t_us"].tolist() == [when for when, _ in stage.seen]
    assert times["length_us"] == 5 * 25_000 and times["begin_us"] == made._half_us(REFERENCE_LUX)
    assert times["period_us"] == times["length_us"] + times["begin_us"]
    assert end_us == times["begin_us"] + 2 * times["period_us"] == stage.seen[-1][0]
    t_us, lux = np.array(stage.seen).T
    begins = [when for when, _ in stage.resets]
    assert begins == [times["begin_us"], times["begin_us"] + times["period_us"]]
    assert [level for _, level in stage.resets] == pytest.approx([math.log(REFERENCE_LUX)] * 2)
    for begin in begins:
        own = (t_us >= begin) & (t_us <= begin + 125_000)
        after, log = (t_us[own] - begin) / 125_000, np.log(lux[own] / REFERENCE_LUX)
        wanted = 0.45 * (0.5 - 0.5 * np.cos(2 * np.pi * after)) * np.sin(2 * np.pi * 5 * after)
        np.testing.assert_allclose(log, wanted, atol=1e-3)
        assert np.ptp(log) == pytest.approx(0.9, rel=0.06)
    still = ~((t_us > begins[0]) & (t_us < begins[0] + 125_000)) & ~((t_us > begins[1]) & (t_us < begins[1] + 125_000))
    np.testing.assert_allclose(lux[still], REFERENCE_LUX, rtol=1e-9)


def test_modulations_of_asynchronous_pixels_are_bursts_of_wider_swing():
    made = bench(pixels())
    made._modulations(0.27)
    ticks = bench(pixels(tick_us=170))
    ticks._modulations(0.27)
    for entry, other in zip(made._content["modulation"], ticks._content["modulation"], strict=True):
        assert entry["bursts"]["length_us"] == pytest.approx(5 * 1e6 / entry["hz"], abs=1)
        swing, plain = (2 * math.atanh(one["depth"]) for one in (entry, other))
        assert swing == pytest.approx(1.7 * plain)  # a burst begins in the middle of the range


def test_busy_and_rapid_light():
    """Twelve thresholds up and down ten times; and twenty cycles of the corner, more where pixels rest longer."""
    made = bench(pixels())
    made._strobe(0.27)
    t_us, lux = np.array(made.stages[0].seen).T
    jumps = np.diff(np.log(lux))
    np.testing.assert_allclose(jumps[jumps != 0], 12 * 0.27 * np.resize([1, -1], 20))
    half = made._half_us(REFERENCE_LUX)
    assert t_us[1:][jumps != 0].tolist() == (half * np.arange(1, 21) + 1).tolist() and t_us[-1] == 21 * half
    assert lux[0] == lux[-1] == REFERENCE_LUX and made.saved == [t_us.tolist()]
    for dead_us, cycles in ((None, 20), (1500, 27)):  # 20 · 1.5 ms · 230 Hz = 6.9 cycles
        made = bench(pixels(refractory_period_us=dead_us))
        made._rapid(0.27)
        t_us, lux = np.array(made.stages[0].seen).T
        assert t_us[-1] == round(cycles * 1e6 / 230) and made.saved == [t_us.tolist()]
        assert lux.max() / REFERENCE_LUX - 1 == pytest.approx(math.tanh(15 * 0.27), rel=2e-3)


def test_progress_of_a_bench_rises_to_its_end(monkeypatch):
    """From the first recording to the last; lights that pixels would take too long for, or do not answer, are left
    out."""
    told = []
    made = bench(pixels(noise_cutoff_hz=2.0))
    made._progress = lambda what, part: told.append(part)
    shown = []
    made._one_light = lambda lux, pairs: shown.append(lux) or (1.0 if lux > 50 else 0.24)
    monkeypatch.setattr(made, "_half_us", lambda lux: 10_000 if lux >= 20 else 1_200_001)
    made._lights([0.5])
    assert shown == [1000.0, 1e4, 1e5, 300.0, 100.0, 30.0] and simulated.DETECTED / 2 > 0.24
    shown.clear()
    made._one_light = lambda lux, pairs: shown.append(lux) or 1.0
    made._lights([0.5])
    assert shown[-1] == 30.0  # 10 lx need too long
    assert all(0 < part < 0.8 for part in told)
    first = told[: len(told) // 2]
    assert first == sorted(first)


def frame_bench(monkeypatch):
    """A mosaic of 2 x 3 with event pixels, two red filters and a green one, whose responses peak at 610 and 530 nm."""

    def spectrum(peak, top):
        grid = np.arange(400.0, 701.0, 10.0)
        values = top * np.exp(-(((grid - peak) / 40) ** 2))
        return SimpleNamespace(wavelength_nm=grid, values=values, at=lambda nm: np.interp(nm, grid, values))

    shapes = {"r": spectrum(610, 0.5), "g": spectrum(530, 0.7)}
    monkeypatch.setattr(frames, "product", lambda filter_, efficiency: filter_)
    monkeypatch.setattr(frames, "mixed", lambda values, crosstalk: values)
    aps = SimpleNamespace(full_well_e=9_000.0, black_level_dn=40.0, system_gain_dn_per_e=0.35, bit_depth=12)
    spec = SimpleNamespace(
        filters={name: SimpleNamespace(load=lambda one=one: one) for name, one in shapes.items()},
        quantum_efficiency=SimpleNamespace(load=lambda: None), tile_rows=["EGR", "RER"],
        pixels={letter: SimpleNamespace(filter=letter.lower() if letter != "E" else "g") for letter in "EGR"},
        positions=lambda role: [(0, 1), (0, 2), (1, 0), (1, 2)], geometry=SimpleNamespace(fill_factor=0.6),
    )  # fmt: skip
    seen = []

    def sample(electrons, exposure_us, seed, number):
        seen.append((electrons, exposure_us, seed, number))
        return np.arange(8 * 9).reshape(8, 9).astype(np.uint16)

    noise = SimpleNamespace(spec=aps, full_scale_dn=4095, crosstalk=None, sample=sample)
    layout = SimpleNamespace(tiled=lambda tile: np.tile(tile, (4, 3)), tile_shape=(2, 3))
    return SimpleNamespace(spec=spec, aps=noise, layout=layout, name="s"), seen


def test_frames_go_from_the_dark_beyond_saturation_with_exposures_in_equal_steps(tmp_path, monkeypatch):
    """Of the filter that most pixels have, at the wavelength of its peak; two frames a level, lit and dark, and 32."""
    sensor, seen = frame_bench(monkeypatch)
    told = []
    made = frames.FrameInstrument(sensor, tmp_path, 5, lambda what, part: told.append(part))
    assert (made.filter, made.wavelength_nm) == ("r", 610.0)
    assert made.record() == tmp_path
    exposures = np.array([each[1] for each in seen])
    assert [each[3] for each in seen] == list(range(1, len(seen) + 1)) and {each[2] for each in seen} == {5}
    # what a pixel of the red filter gets, against its saturation: that of the ADC, (4095 - 40)/0.35
    electrons = np.array([np.asarray(each[0])[0, 2] for each in seen])
    pairs, series = electrons[:96].reshape(24, 2, 2), electrons[96:].reshape(2, 32)
    times = exposures[:96].reshape(24, 2, 2)
    np.testing.assert_allclose(times[:, 0, 0], np.rint(20_000 * np.arange(1, 25) / 24))
    assert np.all(times == times[:, :1, :1]) and np.all(pairs[:, 1] == 0) and np.all(series[1] == 0)
    np.testing.assert_allclose(pairs[-1, 0], 1.1 * min(9_000, 4_055 / 0.35))
    np.testing.assert_allclose(pairs[:, 0, 0] / times[:, 0, 0], pairs[-1, 0, 0] / 20_000)
    green = np.asarray(seen[0][0])[0, 1] / np.asarray(seen[0][0])[0, 2]
    assert green == pytest.approx(0.7 * np.exp(-4) / 0.5)
    # the series has an exposure of its own, in the middle
    assert set(exposures[96:]) == {times[11, 0, 0] + 1} and np.ptp(series[0]) == 0
    assert told == sorted(told) and told[0] == 0 and told[-1] < 1
    names = sorted(path.name for path in tmp_path.glob("*.png"))
    assert len(names) == 24 * 4 + 64
    with Image.open(tmp_path / names[0]) as picture:  # the pixels of the first position of that filter
        np.testing.assert_array_equal(np.asarray(picture), np.arange(72).reshape(8, 9)[0::2, 2::3])
    photons = pairs[-1, 0, 0] / (0.5 * 0.6)
    assert f"lit_20000us_{photons:.2f}ph_01.png" in names and "dark_20000us_02.png" in names


@pytest.mark.parametrize(("half_us", "length_us"), [(90_000, 1_000_000), (700_000, 2_800_000)])
def test_one_light_is_recorded_long_enough_and_counts_its_worst_answers(half_us, length_us, monkeypatch):
    """Steps of each size, then steady light for a second, or four half periods where those are longer."""
    made, shares, steps = bench(pixels()), iter([0.97, 0.4, 0.8, 0.9]), []
    made._content["steady"] = []
    made._half_us = lambda lux: half_us
    made._steps = lambda *given: steps.append(given)
    recorded = SimpleNamespace(spec=SimpleNamespace(steps=[5, 6]), pixels=4, answers_to=lambda last: last)
    made._written = lambda: recorded

    def told(one, polarity, every, window):
        assert one == 6 and every.tolist() == [True] * 4 and window is None
        return SimpleNamespace(share=next(shares))

    monkeypatch.setattr(simulated, "answers", told)
    assert made._one_light(33.0, [0.5, 0.7]) == 0.4
    assert steps == [(33.0, 0.5, 2), (33.0, 0.7, 2)]
    assert made._content["steady"] == [{"file": "steady-33lx", "lux": 33.0, "interval_us": [0, length_us]}]
    (stage,) = made.stages
    assert stage.seen == [(0, 33.0), (length_us, 33.0)]


def test_coarse_curves_are_read_at_20_50_and_80_percent():
    """Shares of rises and falls on lines between the steps; a share that falls back counts as the largest so far."""
    made, size = bench(pixels()), [0.1, 0.2, 0.3, 0.5]
    rises, falls = [0.0, 0.4, 0.3, 1.0], [0.1, 0.5, 0.9, 0.9]

    def one(k):
        share = {0: rises[k], 1: falls[k]}
        return SimpleNamespace(size=size[k], of=lambda polarity: (np.arange(10) < 10 * share[polarity]).astype(int))

    made._written = lambda: SimpleNamespace(responses=[one(k) for k in range(4)])
    found = made._coarse_curves()
    np.testing.assert_allclose(found[0], [0.15, 0.3 + 0.2 * 0.1 / 0.6, 0.3 + 0.2 * 0.4 / 0.6], atol=1e-6)
    np.testing.assert_allclose(found[1], [0.125, 0.2, 0.275], atol=1e-6)


@pytest.mark.parametrize("tick_us", [None, 170])
def test_a_session_goes_from_coarse_to_fine_steps_to_other_lights(tick_us, monkeypatch, tmp_path):
    """Fine steps lie about the middle of the coarse curve, in widths of it; then steps of two thresholds as found."""
    made, steps, told = bench(pixels(tick_us=tick_us)), [], []
    made._folder, made._content = tmp_path, {"busy": [], "steps": []}
    made._progress = lambda what, part: told.append(part)
    made._steps = lambda lux, size, periods: steps.append((lux, size, periods))
    made._coarse_curves = lambda: [(0.2, 0.25, 0.285), (0.28, 0.33, 0.331)]
    made._written = lambda: SimpleNamespace(pixels=3, responses=None)
    made._write = lambda: None
    thetas = iter([0.26, 0.34])
    monkeypatch.setattr(simulated, "s_curve", lambda *given: SimpleNamespace(theta=next(thetas)))
    pairs = []
    made._lights, made._modulations = pairs.extend, lambda theta: told.append(theta)
    assert made.record() == tmp_path
    theta = 0.27
    assert {lux for lux, _, _ in steps} == {REFERENCE_LUX}
    coarse = [size / theta for _, size, periods in steps if periods == 2]
    fine = np.array([size for _, size, periods in steps if periods == 6]).reshape(2, 7)
    assert coarse[0] == pytest.approx(0.02) and coarse == sorted(coarse) and min(coarse) < 0.5 and max(coarse) == 2
    # the width of a normal law between 20 and 80 % is 1/1.683; at least 3 % and at most 20 % of the middle
    assert fine[:, 3] == pytest.approx([0.25, 0.33])
    widths = (fine[:, 5] - fine[:, 3]) / 1.5
    assert widths == pytest.approx([0.085 / 1.7, 0.051 / 1.7])
    np.testing.assert_allclose(fine - fine[:, 3:4], -(fine - fine[:, 3:4])[:, ::-1], atol=1e-12)
    assert pairs == pytest.approx([0.52, 0.68]) and told[-2] == pytest.approx(theta)
    assert told[0] < told[-3] < told[-1] < 1 and len(made._content["busy"]) == 2
    # without a curve, two thresholds of the sensor file; curves that are hardly apart have their mean
    for found, expected in (([np.nan, np.nan], [0.54]), ([0.3, 0.303], [0.603]), ([np.nan, 0.31], [0.62])):
        thetas = iter(found)
        pairs.clear()
        made.record()
        assert pairs == pytest.approx(expected)


def test_an_instrument_knows_the_flux_of_each_pixel_and_writes_its_files(tmp_path):
    sensor = hr.load_sensor("gen2").crop(16, 8)
    made = Instrument(sensor, tmp_path, 5, lambda what, part: None)
    assert made._shape == (made._content["rows"], made._content["cols"]) == sensor.layout.evs_shape == (2, 4)
    names = {sensor.spec.pixels[sensor.spec.tile_rows[row][col]].filter for row, col in sensor.spec.positions("evs")}
    flux = {name: electrons_per_s_lux(sensor.spec, name, illuminant("D65")) for name in names}
    window_s = sensor.spec.evs.window_us * 1e-6
    position = sensor.layout.evs_position.ravel()
    for k, (row, col) in enumerate(sensor.spec.positions("evs")):
        own = flux[sensor.spec.pixels[sensor.spec.tile_rows[row][col]].filter] * window_s
        np.testing.assert_allclose(made._per_lux[position == k], own)
    np.testing.assert_allclose(np.array(made._electrons(3.0)), 3 * made._per_lux, rtol=1e-6)
    assert made._notes().startswith("simulated; even light, D65; ")
    made._stage()
    made._stage()
    assert made._seed == 7
    events = np.zeros(2, no_events().dtype)
    events["t_us"], events["x"], events["y"], events["polarity"] = [3, 9], [1, 0], [0, 1], [1, -1]
    made._save(events, "a")
    stream = np.concatenate(list(open_events(tmp_path / "a.raw")))
    assert stream["t_us"].tolist() == [3, 9] and stream["x"].tolist() == [1, 0]
    made._write()
    content = YAML().load((tmp_path / "bench.yaml").read_text())
    assert (content["rows"], content["cols"]) == sensor.layout.evs_shape
    assert content["simulated"] and "steady" not in content and content["schema_version"] == 1
