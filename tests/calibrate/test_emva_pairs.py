"""Captures of EMVA 1288 against a camera of NumPy, and, where they are at hand, real ones."""

import os
import subprocess
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import emva_camera
import numpy as np
import pytest

import hesim_render as hr
from hesim_render.calibrate import calibrate_aps, read_calibration, read_maps
from hesim_render.calibrate.aps import light_curve, pair_levels, spatial
from hesim_render.calibrate.aps.pair_levels import pair_statistics
from hesim_render.calibrate.aps.pairs import _bins, evaluate
from hesim_render.calibrate.aps.pairs_output import calibrate_pairs, content
from hesim_render.calibrate.aps.sensor_file import write_sensor
from hesim_render.calibrate.aps.spatial import Temporal, pattern_of, spatial_variance
from hesim_render.core.errors import SpecError
from hesim_render.recording.pair_set import read_pair_set

#: A folder of EMVA 1288's reference set 001 (a real CCD); the tests of real captures are skipped without it.
REAL = os.environ.get("HESIM_EMVA1288_CCD")
needs_real = pytest.mark.skipif(REAL is None, reason="HESIM_EMVA1288_CCD names no folder of the reference set 001")
CAMERA = emva_camera.Camera()
FEW, SEEDS = 20, 100


def evaluated(seeds):
    """Section ``aps`` of devices of one kind."""
    return [content(evaluate(emva_camera.in_memory(CAMERA, seed))) for seed in seeds]


@pytest.fixture(scope="module")
def few():
    return evaluated(range(FEW))


@pytest.fixture(scope="module")
def sections(few):
    return [*few, *evaluated(range(FEW, SEEDS))]


def truth(camera):
    return {
        "K": camera.gain,
        "responsivity": camera.gain * camera.efficiency,
        "quantum_efficiency": camera.efficiency,
        "read_noise_e": camera.read_noise,
        "dark_current_e_per_s": camera.dark_current,
        "row_noise_dn": camera.row_noise,
        "temporal_dark_noise_e": np.hypot(camera.read_noise, camera.row_noise / camera.gain),
        "dsnu_e": np.sqrt(sum(part**2 for part in camera.dsnu)),
        "prnu_percent": 100 * np.sqrt(sum(part**2 for part in camera.prnu)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", truth(CAMERA))
def test_intervals_hold_the_truth_of_a_hundred_devices(sections, name):
    """95 of 100 in the mean; 90 to 99 have a chance of 98 % for one parameter, and the seeds are fixed."""
    true = truth(CAMERA)[name]
    inside = sum(s[name]["interval_95"][0] <= true <= s[name]["interval_95"][1] for s in sections)
    values = np.array([s[name]["value"] for s in sections])
    assert 90 <= inside <= 99
    # the mean of a hundred; the square root of a variance lies up to 0.2 % low
    assert abs(values.mean() - true) < 3.5 * values.std(ddof=1) / np.sqrt(SEEDS) + 2e-3 * true


def test_a_linear_camera_gives_no_finding_but_its_rows_and_columns(few):
    """Rows and columns of this camera are shared noise and a fixed pattern; all else would be a false alarm."""
    assert {f["check"] for s in few for f in s["findings"]} <= {"row noise", "column pattern"}
    assert all(s["nonlinearity"][1:] == [0.0, 0.0] for s in few)


def test_the_black_levels_error_at_few_exposures_is_that_of_rows_and_pixels_of_two_frames():
    """Of six exposures the scatter tells too little: errors are those of the temporal noise, or larger."""
    camera = CAMERA.but(exposures_us=(400.0, 3000.0, 6000.0, 9000.0, 12_000.0, 15_000.0))
    dark_e2 = camera.read_noise**2 + camera.dark_current * camera.long_us * 1e-6
    pixel = camera.gain**2 * dark_e2 + 1 / 12
    variance = (camera.row_noise**2 + pixel / camera.cols) / camera.rows / 2
    t = np.array(camera.exposures_us)
    expected = np.sqrt(variance * (1 / t.size + t.mean() ** 2 / np.sum((t - t.mean()) ** 2)))
    found = [evaluate(emva_camera.in_memory(camera, seed)).black.error for seed in range(3)]
    # the noise of the rows is itself known to 3 %
    assert min(found) == pytest.approx(expected, rel=0.1)


def test_light_that_changes_between_two_frames_is_no_noise_of_columns_or_rows():
    rng = np.random.default_rng(3)
    first, second = (np.rint(rng.normal(300, 9, (14, 23))).astype(np.uint16) for _ in range(2))
    plain, brighter = pair_statistics(first, second, 4095), pair_statistics(first, second + np.uint16(21), 4095)
    assert brighter[0] == pytest.approx(plain[0] + 10.5) and brighter[1] == pytest.approx(plain[1] - 21)
    np.testing.assert_allclose(brighter[2:-2], plain[2:-2], rtol=1e-5)


@pytest.mark.parametrize("factor", (0.99, 1.01))
def test_light_drifts_beyond_six_deviations_of_rows_and_pixels(factor):
    """The mean of 14 rows, of variance 9 each and twice that in a difference, and of their 14 · 96 pixels of 4 DN²."""
    frames = np.random.default_rng(4).integers(280, 320, (2, 14, 96), np.uint16)
    change = factor * 6 * np.sqrt(2 * 9 / 14 + 2 * 4 / (14 * 96))
    entry = SimpleNamespace(lit=True, error=lambda text: SpecError(text))
    found = 300.0, change, 4.0, 0.1, 9.0, 0.1, 0.0, 0.1, 0.0, 0.0, 0.0
    drifts = pytest.raises(SpecError, match=r"the second frame is 2.3 % darker") if factor > 1 else nullcontext()
    with drifts:
        pair_levels._check(entry, found, *frames, 4095)


def test_values_above_a_full_well_are_no_gaps():
    """Most pixels at the well, the others spread over 40 DN below it; without every third of those values there are."""
    rng = np.random.default_rng(5)
    first, second = (1501 - (rng.random((64, 90)) < 0.1) * rng.integers(1, 41, (64, 90)) for _ in range(2))
    absent, expected = pair_levels._gaps(first, second, 4095)
    assert absent == 0 and 10 < expected < 20
    first, second = (np.where(frame % 3, frame, frame + 1) for frame in (first, second))
    absent, expected = pair_levels._gaps(first, second, 4095)
    assert absent == pytest.approx(expected / 3, abs=1)


def test_the_gradient_of_the_curve_is_that_of_finite_differences():
    p, h, step = np.array([0.04, 5.0, -1.3, 0.7]), np.linspace(0.1, 1.1, 7), 1e-6
    expected = [(light_curve._value(p + d, h) - light_curve._value(p - d, h)) / (2 * step) for d in step * np.eye(4)]
    np.testing.assert_allclose(light_curve._gradient(p, h), expected, rtol=1e-7)
    curve = light_curve.MeanCurve(p[0], 0.0, p[1:], np.zeros((4, 4)), 0.0)
    np.testing.assert_allclose(curve.gradient(h), expected, rtol=1e-7)


def test_saturation_is_between_the_levels_around_it(few):
    full_well = (2**CAMERA.bits - 1 - CAMERA.black) / CAMERA.gain
    for section in few[:10]:
        low, high = section["full_well_e"]["interval_95"]
        assert low < full_well < high and section["full_well_e"]["limited_by"] == "ADC full scale"


@pytest.mark.slow
@pytest.mark.parametrize("limited_by", [pytest.param("ADC full scale", marks=pytest.mark.slow), "full well"])
def test_where_the_signal_ends_lies_in_its_interval_wherever_the_levels_are(limited_by):
    """36 of 40 or more; the levels, 670 e⁻ apart, fall anywhere. The standard's value itself is one of the levels."""
    hits = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        camera = CAMERA.but(photons_per_us=CAMERA.photons_per_us * rng.uniform(0.93, 1.07))
        end, kept = (2**camera.bits - 1 - camera.black) / camera.gain, {}
        if limited_by == "full well":  # the pixels hold less than the ADC could tell
            end = rng.uniform(8500, 10_100)
            kept = {"full_well": end}
        found = content(evaluate(emva_camera.in_memory(camera.but(**kept), seed)))["full_well_e"]
        assert found["limited_by"] == limited_by
        hits += found["interval_95"][0] < end < found["interval_95"][1]
    assert hits >= 36


def test_what_the_standard_lacks_is_measured():
    """A bent signal, a late shutter, columns that change, a filter and a hum: each is found at its own size."""
    camera = CAMERA.but(
        rows=64, cols=96, bend=-0.06, late_us=31.0, column_noise=1.3, correlation=0.17, hum=2.1, light_scatter=4e-4
    )
    result = evaluate(emva_camera.in_memory(camera, 3))
    found = content(result)
    assert {f["check"] for f in found["findings"]} >= {
        "linearity", "light offset", "row noise", "column noise", "interference", "read noise", "column pattern",
    }  # fmt: skip
    low, high = found["light_offset"]["interval_95"]
    assert low < camera.photons(camera.late_us) < high
    low, high = found["column_noise_dn"]["interval_95"]
    assert low < camera.column_noise < high
    # the dark current's own noise and the rounding are not correlated
    dark_e2 = camera.dark_current * camera.long_us * 1e-6 + 1 / 12 / camera.gain**2
    expected = camera.correlation * camera.read_noise**2 / (camera.read_noise**2 + dark_e2)
    assert (
        abs(found["read_noise_correlation"]["value"] - expected) < 4 * found["read_noise_correlation"]["standard_error"]
    )
    line = found["interference"][0]
    assert (line["cycles_per_row"], line["cycles_per_col"]) in ((0.5, 0.5), (-0.5, 0.5))
    # a checkerboard of 12 frames of random phase: its power scatters by √(1/2 · 1/12) of itself
    assert abs(line["rms_dn"] - camera.hum) < 0.45 * camera.hum
    # the polynomial is that of pixels alone: without rows, columns and the hum, whose 4.4 DN² are a fifth of it
    dark = camera.gain**2 * (camera.read_noise**2 + camera.dark_current * camera.long_us * 1e-6)
    beta = [b or 0.0 for b in found["beta"][0][0]]
    t = camera.long_us * 1e-6
    assert beta[0] + beta[2] * t == pytest.approx(dark, rel=0.1)
    # the curve, at a half and at nine tenths of full scale
    n0, n1, n2 = found["nonlinearity"]
    for u in (0.5, 0.9):
        electrons = u * 4095 / camera.gain
        true = camera.gain * electrons * (1 + camera.bend * u)
        assumed = found["responsivity"]["value"] / camera.efficiency * electrons
        v = assumed / 4095
        assert abs(assumed * (1 + n0 + n1 * v + n2 * v * v) / true - 1) < 3e-3


@pytest.mark.parametrize("fixed", (False, True))
def test_errors_of_spatial_variances_are_their_scatter(fixed):
    """800 mean images: of new devices, or of one. 2.5 % of a standard deviation each, twice that for skewed laws."""
    rng = np.random.default_rng(6)
    rows, cols, frames, pixel, row, col = 31, 22, 9, 11.0, 0.9, 1.7
    own = rng.standard_normal((rows, 1)), rng.standard_normal((1, cols)), rng.standard_normal((rows, cols))
    temporal = Temporal(pixel, row, col, 0.0, 0.0, 0.0)
    values, errors = [], []
    for _ in range(800):
        drawn = own if fixed else [rng.standard_normal(part.shape) for part in own]
        image = 0.8 * drawn[0] + 0.5 * drawn[1] + 2.3 * drawn[2]
        noise = (pixel, (rows, cols)), (row, (rows, 1)), (col, (1, cols))
        image = image + sum(np.sqrt(v / frames) * rng.standard_normal(size) for v, size in noise)
        found = spatial_variance(image, temporal, frames)
        values.append([*found.parts, found.total])
        errors.append(found.errors(fixed))
    values, errors = np.array(values), np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(np.abs(values.std(axis=0, ddof=1) / errors - 1) < 0.12)
    if not fixed:
        true = np.array([0.64, 0.25, 5.29, 6.18])
        assert np.all(np.abs(values.mean(axis=0) - true) < 4.5 * errors / np.sqrt(800))


def test_a_pixel_far_from_all_others_loses_only_its_own_noise():
    """Nine deviations off, where six make a pixel an individual; the others are scaled to their variance."""
    values = np.random.default_rng(9).standard_normal((50, 70))
    values[3, 4] = 9.0
    found = spatial._scaled(values, 0.36)
    assert found[3, 4] == pytest.approx(np.sqrt(81 - 0.36))
    rest = np.arange(3500).reshape(50, 70) != 3 * 70 + 4
    assert np.mean(found[rest] ** 2) == pytest.approx(np.mean(values[rest] ** 2) - 0.36)


def test_frames_that_neighbours_share_nothing_of_have_no_correlation(few):
    assert all(s["read_noise_correlation"]["value"] == 0 and s["interference"] == [] for s in few)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A set in the layout of the standard's data sets."""
    return CAMERA.write(tmp_path_factory.mktemp("emva") / "set", 5)


def test_both_layouts_give_one_calibration(written, tmp_path):
    plain = CAMERA.write(tmp_path / "plain", 5, listed=False)
    results = []
    for number, folder in enumerate((written, plain)):
        out = tmp_path / f"{number}.yaml"
        calibrate_aps(folder, out)
        results.append(read_calibration(out))
    assert results[0]["capture"]["bit_depth"] == 12
    for section in (r["aps"] for r in results):
        section.pop("maps")
    assert results[0]["aps"] == results[1]["aps"]
    assert results[0]["aps"]["K"]["value"] == pytest.approx(CAMERA.gain, rel=0.1)


def test_the_sensor_file_simulates_what_was_captured(written, tmp_path):
    """The maps are those of the captures; the law has gain, black level and the noise of rows."""
    calibration = tmp_path / "calibration.yaml"
    result = calibrate_pairs(written, calibration, tmp_path / "report.html")
    sensor = hr.load_sensor(str(write_sensor(tmp_path / "mine.yaml", calibration, result)))
    spec = sensor.spec.aps
    assert (sensor.rows, sensor.cols, spec.bit_depth) == (36, 52, 12)
    assert spec.system_gain_dn_per_e == pytest.approx(result.gain.slope, rel=1e-6)
    assert spec.row_noise_dn == pytest.approx(CAMERA.row_noise, rel=0.2)
    percent = read_calibration(calibration)["aps"]["prnu_percent"]["value"]
    assert spec.prnu_rel == pytest.approx(percent / 100, rel=1e-6)
    maps = read_maps(calibration, "aps")
    offset = sensor.aps.fixed_pattern.offset_dn
    expected = spec.black_level_dn + maps["n_row"][:, None] + maps["n_blc"]
    assert np.allclose(offset, expected, atol=1e-3)
    assert np.allclose(sensor.aps.fixed_pattern.response, maps["response"])
    # the spread of the map is that of the pixels, without the noise of 12 frames
    pixels = maps["n_blc"] - maps["n_blc"].mean(axis=0)
    assert pixels.std() == pytest.approx(CAMERA.gain * CAMERA.dsnu[2], rel=0.06)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "quantum efficiency" in page and "NaN" not in page


def changed(written, folder, edit):
    """A copy of a set whose list was edited, line by line."""
    import shutil

    shutil.copytree(written, folder)
    file = folder / "EMVA1288_Data.txt"
    lines = file.read_text(encoding="utf-8").splitlines()
    edit(lines, folder)
    file.write_text("\n".join(lines), encoding="utf-8")
    return folder


def drop_second(lines, folder):
    del lines[5]


def drop_dark(lines, folder):
    first = next(k for k, line in enumerate(lines) if line.startswith("d 1"))
    del lines[first : first + 3]


def leave(lines, folder):
    (folder.parent / "other.png").write_bytes((folder / "images" / "b_000_00.png").read_bytes())
    lines[4] = "i ..\\other.png"


def absent(lines, folder):
    lines[4] = "i images\\none.png"


def twice(lines, folder):
    lines[5] = lines[4]


def same(lines, folder):
    (folder / "images" / "b_002_01.png").write_bytes((folder / "images" / "b_002_00.png").read_bytes())


def huge(lines, folder):
    lines[2] = "n 12 1000000 1000000"


def half_a_bit(lines, folder):
    lines[2] = "n 12.5 52 36"


def no_size(lines, folder):
    del lines[2]


def other_size(lines, folder):
    lines[2] = "n 12 53 36"


def no_number(lines, folder):
    lines[3] = "b 400000 many"


def fewer_bits(lines, folder):
    lines[2] = "n 11 52 36"


def unknown(lines, folder):
    lines[3] = "x \x1b[31m"


def no_series(lines, folder):
    del lines[-13:]


BAD = {
    "a frame of a pair is missing": (
        drop_second,
        r"EMVA1288_Data.txt:4: 452 photons, 400 µs: b_000_00.png alone; a pair has two",
    ),
    "a dark pair is missing": (drop_dark, r"EMVA1288_Data.txt:\d+: .*no dark pair of this exposure"),
    "a name leads out": (
        leave,
        r"EMVA1288_Data.txt:5: '..\\\\\\\\other.png' leads out|EMVA1288_Data.txt:5: .*leads out",
    ),
    "a picture is missing": (absent, r"EMVA1288_Data.txt:5: no such file: .*none.png"),
    "a picture is listed twice": (twice, r"EMVA1288_Data.txt:6: b_000_00.png is twice"),
    "both frames are one": (same, r"EMVA1288_Data.txt:\d+: .*both frames are the same"),
    "a size no memory has": (huge, r"EMVA1288_Data.txt:3: .*expected 1 to 16 bit"),
    "half a bit": (half_a_bit, r"EMVA1288_Data.txt:3: 12.5 52 36: expected 1 to 16 bit"),
    "no size": (no_size, r"EMVA1288_Data.txt: has no line 'n"),
    "another size": (other_size, r"b_\d+_00.png: is a I;16 picture of 52x36 px; expected a grey one of 53x36"),
    "no number": (no_number, r"EMVA1288_Data.txt:4: expected b <exposure ns> <photons>, numbers above 0"),
    "more than the bits": (fewer_bits, r"EMVA1288_Data.txt:\d+: .*more than 11 bit have"),
    "an unknown line": (unknown, r"EMVA1288_Data.txt:4: 'x' begins no line"),
    "no long series": (no_series, r"EMVA1288_Data.txt: 0 dark series of more than two frames"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_list_is_one_error_with_file_and_line(written, tmp_path, name):
    edit, message = BAD[name]
    with pytest.raises(SpecError, match=message) as error:
        evaluate(read_pair_set(changed(written, tmp_path / "set", edit)))
    assert "\n" not in str(error.value) and "\x1b" not in str(error.value)


def test_captures_that_do_not_fit_into_memory_are_refused_before_a_frame_is_read(written, monkeypatch):
    monkeypatch.setattr("hesim_render.core.guard._machine_bytes", lambda: 36 * 52 * 100)
    monkeypatch.setattr("hesim_render.recording.pair_set.read_grey", None)
    with pytest.raises(SpecError, match=r"EMVA1288_Data\.txt: maps and transforms of a frame would take"):
        evaluate(read_pair_set(written))


def spoiled(spoil, camera=CAMERA):
    """Captures in memory whose frames pass through a function of the series and the frame's number."""
    pairs = emva_camera.in_memory(camera, 2)
    plain = pairs.frames

    class Spoiled(type(pairs)):
        def frames(self, series):
            return (spoil(series, k, frame) for k, frame in enumerate(plain(series)))

    return Spoiled(*(getattr(pairs, name) for name in type(pairs).__dataclass_fields__))


def stretched(series, number, frame):
    return ((frame >> 4).astype(np.uint32) * 5 // 4).astype(np.uint16)


def with_a_hole(series, number, frame):
    """8 bits; values from 121 to 126 are written as 127."""
    grey = (frame >> 4).astype(np.uint16)
    return np.where((grey > 120) & (grey < 127), 127, grey).astype(np.uint16)


def drifting_pair(series, number, frame):
    return (frame * (0.9 if series.lit and number == 1 and series.exposure_s > 0.01 else 1.0)).astype(np.uint16)


def drifting_long(series, number, frame):
    return (frame * (1 - 0.004 * number if len(series.files) > 2 and series.lit else 1.0)).astype(np.uint16)


def drifting_levels(series, number, frame):
    here = series.lit and len(series.files) == 2 and 0.01 < series.exposure_s < 0.0115
    return (frame * (0.93 if here else 1.0)).astype(np.uint16)


def saturated(series, number, frame):
    return np.minimum(frame.astype(np.uint32) * 9, 4095).astype(np.uint16) if series.lit else frame


def saturated_long(series, number, frame):
    return np.full_like(frame, 4095) if series.lit and len(series.files) > 2 else frame


def clipped(series, number, frame):
    return frame if series.lit else np.maximum(frame.astype(np.int32) - 50, 0).astype(np.uint16)


SPOILED = {
    "8 bit with gaps": (stretched, "of .* grey values around the mean never occur: .* capture RAW frames$"),
    "8 bit with one gap": (with_a_hole, "grey values 121 to 126 occur in none of the frames, .* capture RAW frames$"),
    "the light of a pair drifts": (drifting_pair, "the light drifts: the second frame is 1[01] % darker"),
    "the light of the long series drifts": (
        drifting_long,
        "the light drifts: the frames of the long series differ by 4.* %",
    ),
    "the light of one exposure drifts": (
        drifting_levels,
        "the light drifts between exposures: this pair is 6.* % off the curve of all others",
    ),
    "saturated pairs": (saturated, "saturated from here on: only [0-4] of 18|100 % of the pixels of the long series"),
    "a saturated long series": (saturated_long, "100 % of the pixels of the long series are saturated"),
    "dark frames at 0": (clipped, "% of the dark pixels are 0 DN"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_captures_that_cannot_be_used_are_refused(name):
    spoil, message = SPOILED[name]
    with pytest.raises(SpecError, match=message):
        evaluate(spoiled(spoil))


@needs_real
@pytest.mark.slow
def test_the_reference_set_gives_the_figures_of_the_reference_implementation(tmp_path):
    """Package emva1288 on the same files, in a process of its own (it sets up logging)."""
    pytest.importorskip("emva1288")
    program = """if True:
        import sys, json, numpy as np
        np.asfarray = lambda a: np.asarray(a, float)
        from emva1288 import process
        info = process.ParseEmvaDescriptorFile(sys.argv[1] + "/EMVA1288_Data.txt")
        r = process.Results1288(process.Data1288(process.LoadImageData(info.images).data).data)
        print(json.dumps([r.K, r.R, r.QE, r.sigma_d, r.DSNU1288, r.PRNU1288, r.u_p_sat, r.s_2_y_col]))
    """
    out = subprocess.run([sys.executable, "-c", program, REAL], capture_output=True, text=True, check=True).stdout
    import json

    k, r, qe, dark, dsnu, prnu, saturation, col = json.loads(out.splitlines()[-1])
    result = evaluate(read_pair_set(REAL))
    found = content(result)
    assert found["K"]["value"] == pytest.approx(k, rel=2e-3) and found["K"]["value"] == pytest.approx(0.277, rel=0.02)
    assert found["responsivity"]["value"] == pytest.approx(r, rel=1e-6)
    efficiency = found["quantum_efficiency"]["value"]
    assert efficiency == pytest.approx(qe / 100, rel=2e-3) and efficiency == pytest.approx(0.456, rel=0.02)
    noise = found["temporal_dark_noise_e"]["value"]
    assert noise == pytest.approx(dark, rel=5e-3) and noise == pytest.approx(11.1, rel=0.02)
    assert found["dsnu_e"]["value"] == pytest.approx(dsnu, rel=0.01)
    assert found["prnu_percent"]["value"] == pytest.approx(prnu, rel=5e-3)
    assert found["full_well_e"]["photons"] == saturation
    assert result.long_lit.spatial.col == pytest.approx(col, rel=5e-3)


def test_a_faint_pattern_keeps_its_variance_below_the_noise_of_the_mean():
    """A twentieth of the noise: the variance over the picture is made exact, so that only the scatter of the means over
    boxes is left, 1 % of the pattern.
    """
    values = np.random.default_rng(12).standard_normal((384, 512))
    values -= values.mean(axis=1, keepdims=True)
    values -= values.mean(axis=0)
    noise, pattern = 2.3, 0.115
    image = 700 + np.sqrt((noise + pattern) / values.var()) * values
    found = pattern_of(image, (noise / 512, noise / 384, noise)).pixel
    assert found.var() == pytest.approx(pattern, rel=0.05)


def test_pairs_are_bins_of_the_fit_with_the_squares_of_their_variances():
    """Sums over 15 pixels: powers of the signal, variance less 1/12, and its square, from the pixels' own."""
    rng = np.random.default_rng(3)
    own = {"dark": rng.gamma(3, 2, (3, 15)), "lit": rng.gamma(3, 9, (2, 15))}
    levels = {
        name: SimpleNamespace(
            variance=values.mean(axis=1),
            squares=(values**2).mean(axis=1),
            exposure_s=0.003 + 0.01 * np.arange(len(values)),
        )
        for name, values in own.items()
    }
    signal, clear, distinct = np.array([40.0, 7.0]), np.array([False, True]), np.array([0, 2])
    bins = _bins(SimpleNamespace(shape=(3, 5)), levels["lit"], levels["dark"], signal, clear, distinct)
    used = np.stack([own["dark"][0], own["dark"][2], own["lit"][1]]) - 1 / 12
    light = np.array([0.0, 0.0, 7.0])
    np.testing.assert_allclose(bins.squares, (used**2).sum(axis=1))
    np.testing.assert_allclose(bins.powers, 15 * light[:, None] ** np.arange(7))
    np.testing.assert_allclose(bins.products, used.sum(axis=1)[:, None] * light[:, None] ** np.arange(4))
    np.testing.assert_allclose(bins.exposure_s, [0.003, 0.023, 0.013])
    np.testing.assert_array_equal(bins.lit, [False, False, True])


def test_a_hole_is_one_gap_wider_than_the_noise():
    """Noise of 2 DN: three values that are missing are more, one is less, two gaps are not one hole."""
    frame = np.rint(130 + 2 * np.random.default_rng(5).standard_normal((90, 80))).astype(np.uint16)
    wide = np.where((frame > 128) & (frame < 132), 132, frame)
    assert pair_levels._hole(wide, 255) == slice(129, 132)
    assert pair_levels._hole(frame, 255) is None
    assert pair_levels._hole(np.where(frame == 130, 131, frame), 255) is None
    split = np.where(np.isin(frame, (128, 129, 131)), 132, frame)
    assert pair_levels._hole(split, 255) is None
    assert pair_levels._hole(wide[:10, :20], 255) is None  # 13 pixels of each value are no sign
