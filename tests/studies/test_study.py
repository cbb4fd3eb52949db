"""The study of filter sets: its rows against full simulation and hand calculations, its files, its errors."""

import csv
import io
import json
import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.drawing import report_style
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.core.units import LUMINOUS_EFFICACY_LM_PER_W
from hesim_render.sources.crosstalk import mixed
from hesim_render.specs.files import list_names, read_spec
from hesim_render.specs.filter_set import read_filter_set, read_palette
from hesim_render.specs.run import StudyKind, study_kind
from hesim_render.specs.study import StudySpec
from hesim_render.spectral import spectrum as spectra
from hesim_render.studies import Table, channel_noise, verdict, with_filter_set
from hesim_render.studies import report as study_report
from hesim_render.studies.filter_sets import filters_of, mixing
from hesim_render.studies.report import pareto_front, pareto_plot
from hesim_render.studies.run import study
from hesim_render.studies.table import has_parquet
from hesim_render.studies.verdict import ranking

BASE = {"schema_version": 1, "name": "test", "sensors": ["reference-bayer"]}


def run(**changes):
    return study({**BASE, **changes})


def set_on(sensor, name, palette="dyes"):
    return with_filter_set(hr.load_sensor(sensor), read_filter_set(name), read_palette(palette))


@pytest.mark.parametrize(("filters", "crosstalk"), [
    ("rggb", 0.0), ("quad-bayer", 0.08),
    pytest.param("rgbw", 0.08, marks=pytest.mark.slow), pytest.param("cygm", 0.0, marks=pytest.mark.slow),
])  # fmt: skip
def test_closed_forms_are_those_of_the_full_simulation(filters, crosstalk):
    """Noisy RAW frames with crosstalk, full well and ADC: amplification and YSNR within 3 %.

    36,000 output pixels or more (Quad-Bayer: 9000): standard deviations are known to 0.4 % (0.8 %), so 3 % are four
    standard errors at least; luminance and colour noise of one set are not independent.
    """
    row = run(filter_sets=[filters], crosstalk=[crosstalk], illuminance_lux=[30], figures=["colour", "noise"],
              noise={"repeats": 8, "patch_px": 48}).row(0)  # fmt: skip
    assert row["noise_amplification_simulated"] == pytest.approx(row["noise_amplification"], rel=0.03)
    assert row["ysnr_simulated"] == pytest.approx(row["ysnr"], rel=0.03)
    assert row["ysnr_low"] < row["ysnr_simulated"] < row["ysnr_high"]
    assert row["delta_e_noisy_simulated"] > row["delta_e_mean"]


def test_one_pixel_with_many_filter_sets_orders_in_dim_light_as_photon_counting_says():
    """Luminance SNR of mono, RCCC, RGBW and RGB mosaics of the MT9V024's pixel at 3 lux, from electrons and read noise.

    Closed forms are exact but for the integration; noisy frames are within 3 % of them. The mean and the standard
    deviation of 36,864 output pixels with an SNR of 1 are known to 0.5 % and 0.4 %: 3 % are 4.6 standard errors.
    """
    names = ["mono", "rccc", "rgbw-half", "rgbw", "rggb"]
    every = study({
        "schema_version": 1, "name": "one pixel", "sensors": ["mt9v034"], "palette": "mt9v024", "filter_sets": names,
        "illuminance_lux": [3.0, 100.0], "exposures_us": [15_000], "figures": ["noise"],
        "noise": {"repeats": 8, "patch_px": 48},
    })  # fmt: skip
    table, bright = (every.where(illuminance_lux=lux) for lux in (3, 100))
    # where colour decides the weights
    np.testing.assert_allclose(bright["ysnr_noise_aware_simulated"], bright["ysnr_noise_aware"], rtol=0.03)
    assert bright["ysnr_noise_aware"][-1] > bright["ysnr_noise_aware"][-2]
    assert table["filter_set"].tolist() == names and "smi" not in table.columns and "ysnr" not in table.columns
    d65, grid = spectra.illuminant("D65"), np.arange(360.0, 831.0)
    power = 3 * d65.at(grid) / np.trapezoid(d65.at(grid) * spectra.photopic().at(grid), grid)
    power /= LUMINOUS_EFFICACY_LM_PER_W
    patches = np.array(
        [each.at(np.clip(grid, *each.support_nm)) for each in spectra.colorchecker_reflectances().values()]
    )
    observed = spectra.colour_matching_functions()[1].at(grid) * power
    # read noise, dark current of 15 ms, rounding of a gain of 0.038 DN per electron
    dark = 45**2 + 9.1 * 0.015 + 1 / 12 / 0.038**2
    expected = []
    for name in names:
        sensor = set_on("mt9v034", name, "mt9v024")
        channels = filters_of(sensor, "aps")
        response = np.array([sensor.spectral_response(grid)[channel] for channel in channels])
        white = 0.015 * np.trapezoid(response * power, grid) / np.pi
        camera = 0.015 * np.trapezoid(patches[:, None] * response * power, grid) / np.pi
        luminance = np.trapezoid(patches * observed, grid) / np.trapezoid(observed, grid)
        tile = [sensor.spec.pixels[letter].filter for letter in "".join(sensor.spec.tile_rows)]
        count = np.array([4 * tile.count(channel) / len(tile) for channel in channels])
        signal = 0.18 * white
        # the best estimate of the luminance, noise included
        noise = ((camera + dark) / count).sum(axis=0) / white**2
        normal = (camera / white).T @ (camera / white) + np.diag(noise)
        weights = np.linalg.solve(normal, (camera / white).T @ luminance) / white
        variance = np.sum(weights**2 * (signal + dark) / count)
        expected.append(weights @ signal / math.sqrt(variance))
        if name == "mono":  # four equal pixels: photons and read noise alone
            assert expected[0] == pytest.approx(2 * signal[0] / math.sqrt(signal[0] + dark), rel=1e-12)
    np.testing.assert_allclose(table["ysnr_noise_aware"], expected, rtol=3e-3)
    np.testing.assert_allclose(table["ysnr_noise_aware_simulated"], expected, rtol=0.03)
    assert list(table["ysnr_noise_aware_simulated"]) == sorted(table["ysnr_noise_aware_simulated"], reverse=True)
    low, seen, high = (table[f"ysnr_noise_aware_{end}"] for end in ("low", "simulated", "high"))
    assert np.all((low < seen) & (seen < high))


def test_exposures_are_equal_in_what_the_study_says():
    table = study({
        **BASE, "sensors": ["reference-bayer", "eiger"], "exposures_us": [8000], "figures": ["noise"],
        "equal": ["exposure", "light", "white"], "illuminance_lux": [50],
    })  # fmt: skip
    first, other = (table.where(sensor=name) for name in ("reference-bayer", "eiger"))
    assert all(part.where(equal="exposure").row(0)["exposure_us"] == 8000 for part in (first, other))
    # f/4 without loss against f/2 with a transmittance of 0.9: the cone is π/(1 + 4N²)
    expected = 8000 * (1 + 4 * 2**2) / (1 + 4 * 4**2) / 0.9
    assert first.where(equal="light").row(0)["exposure_us"] == pytest.approx(8000, rel=1e-12)
    assert other.where(equal="light").row(0)["exposure_us"] == pytest.approx(expected, rel=1e-9)
    for part in (first, other):
        assert part.where(equal="white")["white_saturation"][0] == pytest.approx(0.9, rel=1e-12)


def test_a_grey_card_that_saturates_has_no_noise_figures():
    table = run(filter_sets=["rggb"], illuminance_lux=[100, 3e4], figures=["noise"])
    assert table["ysnr_noise_aware"][0] > 0
    assert all(np.isnan(table[name][1]) for name in ("ysnr_noise_aware", "snr10_lux_noise_aware"))
    # 18 % of white fills the pixel
    assert 0.18 * table["white_saturation"][1] > 1 > 0.18 * table["white_saturation"][0]
    assert table["white_clipped"].tolist() == [False, True]


@pytest.mark.slow
def test_noise_aware_figures_are_those_of_the_matrix_with_the_least_squared_error_and_come_first(tmp_path, capsys):
    """RGBW before RGGB in dim light, the other way round with the matrix of colour; and white clips at 1000 lx."""
    spec = tmp_path / "study.yaml"
    spec.write_text(
        "schema_version: 1\nname: order\nsensors: [reference-bayer]\nfilter_sets: [rggb, rgbw]\n"
        "illuminance_lux: [3, 1000]\nfigures: [colour, noise]\nnoise: {repeats: 2, patch_px: 8}\n"
    )
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(spec), "--out", str(tmp_path / "out"), "--json"])
    assert not stop.value.code
    rows = json.loads(capsys.readouterr().out)["rows"]
    at = {(row["illuminance_lux"], row["filter_set"]): row for row in rows}
    rggb, rgbw = at[3, "rggb"], at[3, "rgbw"]
    assert rgbw["ysnr"] < rggb["ysnr"] and rgbw["ysnr_noise_aware"] > 1.4 * rggb["ysnr_noise_aware"]
    assert rgbw["snr10_lux_noise_aware"] < rggb["snr10_lux_noise_aware"] and rgbw["snr10_lux"] > rggb["snr10_lux"]
    for row in rows:  # 2 × 8 × 16 output pixels and more: 10 % are two standard errors
        assert row["ysnr_noise_aware_simulated"] == pytest.approx(row["ysnr_noise_aware"], rel=0.2)
        for end, other in (("_noise_aware", ""), ("", "_noise_aware")):
            name = f"noise_amplification{end}"
            assert abs(math.log(row[f"{name}_simulated"] / row[name])) < 0.15
            assert end or row[name] > row[f"noise_amplification{other}"]
    # at the light of SNR 10 the SNR is 10, with the matrix that is best there
    (again,) = run(filter_sets=["rgbw"], figures=["colour", "noise"], illuminance_lux=[rgbw["snr10_lux_noise_aware"]])
    assert again["ysnr_noise_aware"] == pytest.approx(10, rel=1e-6)
    (mono,) = run(filter_sets=["mono"], figures=["noise"], illuminance_lux=[3])
    (again,) = run(filter_sets=["mono"], figures=["noise"], illuminance_lux=[mono["snr10_lux_noise_aware"]])
    assert again["ysnr_noise_aware"] == pytest.approx(10, rel=1e-6)
    # only rgbw clips at 1000 lx, and says so in the tables
    assert [key for key, row in at.items() if row["white_clipped"]] == [(1000, "rgbw")]
    with pytest.raises(SystemExit):
        cli.main(["study", str(spec), "--out", str(tmp_path / "out"), "--overwrite"])
    told = capsys.readouterr().out
    head, *lines = told.splitlines()
    assert head.index("YSNR noise-aware") < head.index("YSNR noise-free matrix") and "Noise-free: with" in told
    assert ["CLIPPED" in line for line in lines[:4]] == [False, False, False, True]
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<td>1.15 CLIPPED</td>") == 1 and "(white clips)" in page
    assert page.index("<b>Noise-aware</b>") < page.index("<b>Noise-free matrix of colour</b>")
    assert page.index("<b>Noise-free matrix of colour</b>") < page.index("<b>Colour, without noise</b>")


def test_sensors_without_frames_have_one_row_for_all_exposures(tmp_path):
    spec = {**BASE, "sensors": ["dvs128"], "figures": ["events"], "exposures_us": [10, 20]}
    table = study({**spec, "equal": ["exposure", "light"]}, out=tmp_path / "out")
    assert len(table) == 1 and table["event_contrast_on"][0] > 0 and "exposure_us" not in table.columns
    # sensors with exposures of their own stand in one table of the report
    spec = {**BASE, "sensors": ["reference-bayer", "mt9v034"], "figures": ["noise"]}
    assert len(set(study(spec, out=tmp_path / "two")["nominal_exposure_us"])) == 2
    assert (tmp_path / "two" / "report.html").read_text().count("<h3>") == 1


def test_crosstalk_mixes_as_the_source_does():
    sensor = set_on("reference-bayer", "rgbw-half").crop(32, 32)
    rates = np.array([10.0, 20.0, 5.0, 40.0])[: len(sensor.spec.filters)]
    image = mixed(rates[sensor.layout.filter_index], 0.12)
    channels = filters_of(sensor, "aps")
    shares = mixing(sensor, channels, "aps", 0.12)
    inner = np.zeros(image.shape, bool)
    inner[4:-4, 4:-4] = True
    names = np.array(list(sensor.spec.filters))[sensor.layout.filter_index]
    for name, share in zip(channels, shares, strict=True):
        assert share @ rates == pytest.approx(image[inner & (names == name)].mean(), rel=1e-12)
        assert share.sum() == pytest.approx(1)


def test_event_figures_are_those_of_the_noise_model():
    names = ["quad-bayer-rgb-events", "quad-bayer-white-event"]
    table = study({**BASE, "sensors": ["eiger"], "filter_sets": names, "illuminance_lux": [5, 500]})
    for name in names:
        sensor = set_on("eiger", name)
        spec = sensor.spec.evs
        light = spectra.scale_to_lux(spectra.illuminant("D65"), 500)
        event = filters_of(sensor, "evs")
        rates = {f: spectra.integrate_product(sensor.responses[f], light) / np.pi for f in event}
        row = table.where(filter_set=name, illuminance_lux=500).row(0)
        rate, contrast = [], []
        for k, (i, j) in enumerate(sensor.spec.positions("evs")):
            grey = 0.18 * rates[sensor.spec.pixels[sensor.spec.tile_rows[i][j]].filter] * spec.window_us * 1e-6
            # mismatch widens the thresholds: the noise model gives the same with its spread as noise
            x = 1e-3 * 0.16 * 10_000 / spec.window_us * grey + 5e-3
            s2 = (3.1e-5 * 0.16 * 10_000 / spec.window_us * grey) ** 2 + 2.116e-4**2
            sigma = np.sqrt(2 * s2 / x**2 + (spec.threshold_mismatch_rel * np.array([0.1981, 0.2019])) ** 2)
            rate.append(
                sum(0.5 * math.erfc(t / s / math.sqrt(2)) for t, s in zip((0.1981, 0.2019), sigma, strict=True))
                / 1239e-6
            )
            rise = row["event_contrast_on"]
            p_on, _ = sensor.evs.event_probability(grey, grey * (1 + rise), position=k)
            contrast.append(float(p_on))
        assert row["event_noise_rate_hz"] == pytest.approx(np.mean(rate), rel=1e-6)
        if len(contrast) == 1:
            assert contrast[0] == pytest.approx(0.5, abs=1e-6)
        assert 0 < row["event_seen_isoluminant"] < row["event_seen"] < 1
    bright, dim = (table.where(illuminance_lux=lux) for lux in (500, 5))
    assert np.all(dim["event_contrast_on"] > bright["event_contrast_on"])
    assert bright.row(0)["event_seen"] > bright.row(1)["event_seen"]  # three colours tell more than one clear pixel
    asynchronous = study({**BASE, "sensors": ["davis346"], "figures": ["events"]}).row(0)
    assert asynchronous["event_noise_rate_hz"] is None and asynchronous["event_contrast_on"] > 0


def test_every_shipped_filter_set_stands_before_a_sensor():
    for name in list_names("filter_sets"):
        spec = read_filter_set(name)
        sensor = set_on("eiger" if spec.evs_grid else "reference-bayer", name)
        assert sensor.spec.tile == spec.tile and (sensor.spec.evs is not None) == (spec.evs_grid is not None)
        assert channel_noise(sensor, filters_of(sensor, "aps"), 1000, 4).count.sum() <= 4
    comparisons = [name for name in list_names("studies") if study_kind(name) is StudyKind.comparison]
    assert len(comparisons) == 5
    for name in comparisons:
        spec = read_spec(StudySpec, name, "studies")
        assert len(spec.filter_sets) + len(spec.sensors) > 2
    palette = read_palette("dyes")
    # the infrared cut keeps what cannot be rendered out
    assert float(palette.quantum_efficiency.load().at(720)) < 1e-3


def test_a_study_writes_tables_and_a_report_that_needs_no_other_file(tmp_path, capsys, monkeypatch):
    file = tmp_path / "mine.yaml"
    (tmp_path / "curve.csv").write_text("nm,t\n380,0\n430,0.8\n480,0\n")
    (tmp_path / "own.yaml").write_text(
        "schema_version: 1\nname: own\ndescription: mine\ntile: |\n  R G\n  G V\npixels:\n"
        "  R: {filter: red, roles: [aps]}\n  G: {filter: green, roles: [aps]}\n  V: {filter: violet, roles: [aps]}\n"
        "filters:\n  violet: {csv: curve.csv}\n"
    )
    (tmp_path / "patches.csv").write_text(
        "name,380,550,780\ndark,0.1,0.1,0.1\nwarm,0.2,0.4,0.9\ncool,0.8,0.5,0.3\nleaf,0.1,0.5,0.1\n"
    )
    file.write_text(
        "schema_version: 1\nname: a <study>\nsensors: [reference-bayer]\nfilter_sets: [rggb, own.yaml]\n"
        "surfaces: [colorchecker, patches.csv]\nnoise: {repeats: 2, patch_px: 8}\n"
    )
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(file), "--out", str(tmp_path / "out")])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert "4 rows in" in printed and "100 lx, equal exposure: noise-aware YSNR " in printed
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"results.csv", "results.json", "report.html"} <= names
    assert ("results.parquet" in names) == has_parquet()
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "results.csv").read_text())))
    stored = json.loads((tmp_path / "out" / "results.json").read_text())
    of = [text.partition(":")[0] for text in stored["verdicts"]]
    assert of == [f"{surfaces}, D65, 100 lx, equal exposure" for surfaces in ("colorchecker", "patches")]
    assert len(rows) == len(stored["rows"]) == 4 and stored["study"]["name"] == "a <study>"
    for row, other in zip(rows, stored["rows"], strict=True):
        assert float(row["ysnr"]) == other["ysnr"] and row["filter_set"] == other["filter_set"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert (
        "<h1>a &lt;study&gt;</h1>" in page
        and "<h2>Verdict</h2>" in page
        and page.count("<svg") >= 6
        and 'src="http' not in page
    )
    HTMLParser().feed(page)
    # again: refused, then replaced, with the same figures
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(file), "--out", str(tmp_path / "out")])
    assert stop.value.code == 2 and "exists" in capsys.readouterr().err
    before = (tmp_path / "out" / "results.csv").read_text()
    assert study(file, out=tmp_path / "out", overwrite=True).to_csv() == before
    # other surfaces and keys from the command line; paths are those of the working folder
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "cube.npy", np.full((2, 2, 95), 0.3, np.float32))
    commands = (
        [
            "--surfaces",
            "patches.csv",
            "--surfaces",
            "cie-tcs",
            "--set",
            "filter_sets=[rggb]",
            "--set",
            "noise.repeats=0",
        ],
        ["--surfaces", "cube.npy", "--set", "filter_sets=[rggb]", "--set", "noise.repeats=0"],
    )
    for number, more in enumerate(commands):
        with pytest.raises(SystemExit) as stop:
            cli.main(["study", str(file), "--out", str(tmp_path / f"more{number}"), *more])
        told = capsys.readouterr()
        assert stop.value.code == 0 if number == 0 else "cube.npy: wavelength_nm: says no wavelengths" in told.err
    rows = json.loads((tmp_path / "more0" / "results.json").read_text())["rows"]
    assert [(row["surfaces"], row["filter_set"]) for row in rows] == [("patches", "rggb"), ("cie-tcs", "rggb")]


BAD = [
    ({"filter_sets": ["rccc"]}, r"filter_sets\.0: rccc on reference-bayer: its filters span 2 of the 3 dimensions"),
    ({"filter_sets": ["rggb", "mono"]}, r"filter_sets\.1: mono on reference-bayer: its filters span 1 of"),
    ({"filter_sets": ["rgb"]}, r"no filter set named 'rgb'; shipped are .*did you mean"),
    ({"filter_sets": ["cygm"], "palette": "nikon-5100"}, r"the palette 'nikon-5100' has no filter 'cyan'"),
    ({"filter_sets": ["quad-bayer-white-event"]}, r"the set has event pixels, and the sensor has no 'evs' section"),
    ({"filter_sets": ["rggb", "rggb"]}, r"two have the name 'rggb'"),
    ({"illuminants": [{"name": "short", "spectrum": {"flat": 1, "band_nm": [420, 700]}}]},
     "short covers 420-700"),
    ({"illuminants": [{"name": "dark", "spectrum": {"flat": -1}}]}, "must not be negative"),
    ({"surfaces": ["macbeth"]}, r"no set of reflectances named 'macbeth'; known are colorchecker"),
    ({"surfaces": [{"reflectances": "missing.csv"}]}, "missing.csv: no such file"),
    ({"surfaces": [{"name": "neither"}]}, "either 'reflectances', a 'cube' or a 'scene'"),
    ({"figures": ["color"]}, "figures"),
    ({"equal": ["white", "white"]}, "an entry is there twice"),
    ({"noise": {"repeats": 2, "patch_px": 512}}, r"32 patches fit on 1536x1024 px"),
    ({"sensors": ["davis346"]}, r"its filters span 1 of the 3"),
    ({"exposure": 5}, "unknown key"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_bad_studies_are_one_clear_line(changes, message):
    with pytest.raises((SpecError, RangeError), match=message) as caught:
        run(**changes)
    assert "\n" not in str(caught.value)


SET = """schema_version: 1
name: own
description: mine
tile: |
  R G
  G B
pixels:
  R: {filter: red, roles: [aps]}
  G: {filter: green, roles: [aps]}
  B: {filter: blue, roles: [aps]}
"""


@pytest.mark.parametrize(("old", "new", "message"), [
    ("  G B\n", "  G G\n", r"own.yaml:10: pixels.B: no pixel of the tile has this letter"),
    ("  G B\n", "  G X\n", r"tile: the letter 'X' is not defined"),
    ("  G B\n", "  G\n", "same number of letters"),
    ("pixels:", "filters: {spare: 0.5}\npixels:", r"filters.spare: no pixel has this filter"),
    ("{filter: red,", "{filter: rad,", "has no filter 'rad' .did you mean 'red'"),
    ("pixels:", "filters: {red: 1.5}\npixels:", r"transmittance must lie in \[0, 1\]"),
    ("pixels:", "filters: {red: -0.5}\npixels:", r"transmittance must lie in \[0, 1\]"),
])  # fmt: skip
def test_bad_filter_sets_are_one_clear_line(tmp_path, old, new, message):
    file = tmp_path / "own.yaml"
    assert old in SET
    file.write_text(SET.replace(old, new))
    with pytest.raises(SpecError, match=message):
        run(filter_sets=[str(file)])


@pytest.mark.parametrize(("curve", "message"), [
    ("nm,t\n400,0.1\n500,1.2\n700,0.1\n", r"transmittance must lie in \[0, 1\]"),
    ("nm,t\n400,0.1\n500,-0.2\n700,0.1\n", r"transmittance must lie in \[0, 1\]"),
    ("nm,t\n400,0.1\n500,\n700,0.1\n", r"curve\.csv:3: expected numbers"),
    ("nm,t\n400,0.1\n500,nan\n700,0.1\n", "finite"),
    ("nm,t\n400,0.1\n700,0.5\n500,0.1\n", "increas"),
    ("nm,t\n400,0.1\n400,0.5\n500,0.1\n", "increas"),
])  # fmt: skip
def test_a_curve_out_of_range_or_with_gaps_is_one_clear_line(tmp_path, curve, message):
    (tmp_path / "curve.csv").write_text(curve)
    (tmp_path / "own.yaml").write_text(SET.replace("pixels:", "filters: {red: curve.csv}\npixels:"))
    with pytest.raises(SpecError, match=message) as caught:
        run(filter_sets=[str(tmp_path / "own.yaml")])
    assert "\n" not in str(caught.value)
    # the same in a palette
    (tmp_path / "own.yaml").unlink()
    (tmp_path / "mine.yaml").write_text(
        "schema_version: 1\nname: mine\ndescription: mine\nfilters: {red: curve.csv, green: 0.5, blue: 0.5}\n"
    )
    with pytest.raises(SpecError, match=message.replace("transmittance ", "")) as caught:
        run(filter_sets=["rggb"], palette=str(tmp_path / "mine.yaml"))
    assert "\n" not in str(caught.value)


def test_a_set_does_not_inherit_noise_of_other_positions(tmp_path):
    beta = [[[2.0, 0.25, 0.0, 0.0, 0.0, 0.0]] * 2] * 2
    sensor = hr.load_sensor("reference-bayer", {"aps.beta": beta})
    with pytest.raises(SpecError, match="measured for the positions of its own tile"):
        with_filter_set(sensor, read_filter_set("rggb"), read_palette("dyes"))


def test_tables(tmp_path):
    table = Table([{"a": 1, "b": "x"}, {"a": 2.5, "c": True}, {"a": None, "b": "x, y"}])
    assert table.columns == ["a", "b", "c"] and len(table) == 3
    np.testing.assert_array_equal(table["a"], [1, 2.5, np.nan])
    assert table["b"].tolist() == ["x", None, "x, y"]
    assert list(csv.reader(io.StringIO(table.to_csv())))[1:] == [["1", "x", ""], ["2.5", "", "True"], ["", "x, y", ""]]
    assert len(table.where(b="x")) == 1 and len(table.where(b="z")) == 0
    assert json.loads(Table([{"a": math.inf}]).to_json())["rows"] == [{"a": "inf"}]
    with pytest.raises(RangeError, match="did you mean"):
        Table([{"ysnr": 1}])["ysrn"]
    path = table.write(tmp_path / "t.csv")
    assert path.read_text() == table.to_csv()
    with pytest.raises(OutputError, match="exists"):
        table.write(path)
    with pytest.raises(OutputError, match=r"\.csv, \.json or \.parquet"):
        table.write(tmp_path / "t.xls")
    if not has_parquet():
        with pytest.raises(OutputError, match="pyarrow"):
            table.write(tmp_path / "t.parquet")
        assert not (tmp_path / "t.parquet").exists()


def test_pareto_fronts():
    cost, gain = np.array([1.0, 2.0, 3.0, 1.0, 2.5]), np.array([1.0, 3.0, 3.0, 1.0, 2.0])
    assert pareto_front(cost, gain).tolist() == [True, True, False, True, False]


def test_a_set_whose_white_clips_has_a_hollow_marker():
    """In a style that draws no edges of markers, it was not seen at all."""
    with report_style():
        drawn = [
            pareto_plot(Table({**row, "crosstalk": 0.0, "white_clipped": clips} for row in ranked()), "t")
            for clips in (True, False)
        ]
    assert "stroke-width: 1.5" in drawn[0] and "stroke-width: 1.5" not in drawn[1]


def test_names_of_sets_are_not_cut_off_below_a_plot():
    """The legend has fewer columns where the names are long, and the figure is higher by its lines."""
    sizes = []
    for more in ("", " of many pixels and sizes", " which has a name that two columns cannot hold at all"):
        with report_style():
            named = ({**row, "filter_set": row["filter_set"] + more, "crosstalk": 0.0} for row in ranked())
            page = pareto_plot(Table(named), "t")
        assert page.count(f">ryyb{more}<") == 1
        sizes.append(float(re.search(r'viewBox="0 0 [\d.]+ ([\d.]+)"', page).group(1)))
    assert np.diff(sizes).tolist() == [16, 16]


def ranked(**changes):
    """Rows of three sets at one level, with figures as a study gives them."""
    common = {"surfaces": "chart", "illuminant": "D65", "illuminance_lux": 20.0, "equal": "exposure", "sensor": "s",
              "nominal_exposure_us": 5000.0}  # fmt: skip
    figures = {
        "rggb": {"": 30.2, "_low": 28.0, "_simulated": 30.0, "_high": 32.0, "delta_e": 2.0},
        "ryyb": {"": 41.0, "_low": 39.5, "_simulated": 41.5, "_high": 43.5, "delta_e": 3.5},
        "rccb": {"": 32.5, "_low": 31.0, "_simulated": 33.0, "_high": 35.0, "delta_e": 2.5},
    }
    for name, values in figures.items():
        row = common | {"filter_set": name, "delta_e_mean_noise_aware": values["delta_e"], "white_clipped": False}
        row |= {f"ysnr_noise_aware{end}": values[end] for end in ("", "_low", "_simulated", "_high")}
        yield row | changes.get(name, {})


def test_a_level_of_light_has_a_verdict_in_one_sentence():
    (text,) = ranking(Table(ranked()))
    assert text == (
        "chart, D65, 20 lx, equal exposure: noise-aware YSNR ryyb: 41.5 (39.5 to 43.5) > rccb: 33 (31 to 35) ~ rggb: "
        "30 (28 to 32); but the noise-aware ΔE2000 of ryyb is larger: 3.5, that of rggb 2"
    )
    (text,) = ranking(Table(ranked(ryyb={"delta_e_mean_noise_aware": 2.05, "white_clipped": True})))
    assert "ryyb: 41.5 (39.5 to 43.5) CLIPPED > rccb" in text
    assert text.endswith("; ryyb has as good a noise-aware ΔE2000 as well")
    (text,) = ranking(Table(ranked(ryyb={"delta_e_mean_noise_aware": 1.9})))
    assert text.endswith("; ryyb has the least noise-aware ΔE2000 as well")
    gone = {f"ysnr_noise_aware{end}": None for end in ("", "_low", "_simulated", "_high")}
    gone |= {"white_clipped": True, "delta_e_mean_noise_aware": None}
    (text,) = ranking(Table(ranked(ryyb=gone)))
    assert "YSNR rccb: 33 (31 to 35) ~ rggb" in text
    assert text.endswith("; not ranked, as even the grey card saturates: ryyb")


def test_a_verdict_on_many_sets_names_the_first_ones(monkeypatch):
    monkeypatch.setattr(verdict, "_MOST_NAMED", 2)
    (text,) = ranking(Table(ranked()))
    assert "ryyb: 41.5 (39.5 to 43.5) > rccb: 33 (31 to 35), and 1 more; but the noise-aware ΔE2000 of ryyb" in text


def test_a_verdict_without_intervals_says_so():
    """Closed forms differ by any amount; whether that counts, nothing tells. One interval does not judge a pair."""
    without = {"ysnr_noise_aware_low": None, "ysnr_noise_aware_high": None}
    ends = "(no intervals to judge the differences by); but the noise-aware"
    (text,) = ranking(Table(ranked(ryyb=without, rggb=without, rccb=without)))
    assert f"YSNR ryyb: 41.5, rccb: 33, rggb: 30 {ends}" in text
    (text,) = ranking(Table(ranked(rccb=without)))
    assert f"YSNR ryyb: 41.5 (39.5 to 43.5), rccb: 33, rggb: 30 (28 to 32) {ends}" in text
    (text,) = ranking(Table(ranked()))
    assert "no intervals" not in text
    gone = {f"ysnr_noise_aware{end}": None for end in ("", "_low", "_simulated", "_high")}
    (text,) = ranking(Table(ranked(ryyb=gone, rccb=gone, rggb=without)))
    assert "YSNR rggb: 30; " in text and "no intervals" not in text


def test_levels_and_candidates_of_a_verdict():
    rows = list(ranked())
    other = [row | {"illuminance_lux": 300.0, "nominal_exposure_us": 9000.0} for row in rows]
    assert [text.partition(": ")[0] for text in ranking(Table([*rows, *other]))] == [
        "chart, D65, 20 lx, equal exposure, 5000 µs", "chart, D65, 300 lx, equal exposure, 9000 µs"
    ]  # fmt: skip
    plain = [{key: value for key, value in row.items() if "ysnr_noise_aware_" not in key} for row in rows]
    twice = [row | {"crosstalk": share} for row in plain for share in (0.0, 0.08)]
    (text,) = ranking(Table(twice))
    assert "YSNR ryyb crosstalk 0: 41, ryyb crosstalk 0.08: 41, rccb crosstalk 0: 32.5, " in text
    assert ranking(Table(rows[:1])) == ranking(Table([{"sensor": "s"}, {"sensor": "t"}])) == []


def test_exposures_of_tables_are_in_ms():
    assert study_report._in_ms(2500) == 2.5 and study_report._in_ms(1250.0) == 1.25 and study_report._in_ms("a") == "a"
