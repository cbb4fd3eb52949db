"""e-SFR of rendered edges against the product of closed forms, and the command that measures it."""

import re
from pathlib import Path

import numpy as np
import pytest
import recordings
from rendering import flux_image, make_scene, mono

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import RangeError
from hesim_render.measure import edge_response, measure_mtf, slanted_edge

FREQUENCY = np.linspace(0, 0.5, 51)
LIGHT = {"type": "uniform", "illuminance_lux": 1000}


def closed_form(frequency, angle_deg, psf_fwhm_px):
    """Square pixel of full fill seen along the normal of the edge, times the Gaussian of the lens."""
    a, sigma = np.radians(angle_deg), psf_fwhm_px / np.sqrt(8 * np.log(2))
    return (
        np.abs(np.sinc(frequency * np.cos(a)) * np.sinc(frequency * np.sin(a)))
        * np.exp(-2 * (np.pi * sigma * frequency) ** 2)
    )  # fmt: skip


@pytest.mark.parametrize(("angle_deg", "psf_fwhm_um"), [(5.0, 0.0), (-8.0, 6.0), (12.0, 12.0)])
def test_rendered_edges_have_the_product_of_pixel_and_lens(angle_deg, psf_fwhm_um):
    target = {"type": "slanted-edge", "angle_deg": angle_deg}
    scene = make_scene(target=target, light=LIGHT, camera={"origin_m": [0, 0, 1]})
    a, b, _ = flux_image(scene, mono(64, 80, lens__psf_fwhm_um=psf_fwhm_um), 512)
    found = edge_response((a + b) / 2, frequency_cy_per_px=FREQUENCY)
    np.testing.assert_allclose(found.mtf, closed_form(FREQUENCY, angle_deg, psf_fwhm_um / 5), atol=0.01)
    assert abs(found.angle_deg - angle_deg) < 0.05


def test_edges_over_the_field_have_the_same_response_in_both_directions():
    """Four edges of a square off the axis; the turned square has two nearly upright and two nearly level sides."""
    field = {"type": "edge-field", "rows": 1, "cols": 2, "width_m": 0.4, "height_m": 0.2, "fill": 0.6}
    scene = make_scene(target=field, light=LIGHT, camera={"fit": "target"})
    a, b, _ = flux_image(scene, mono(240, 120, lens__psf_fwhm_um=4.0), 128)
    image = (a + b) / 2
    for part, angle in ((np.s_[34:86, 80:112], 5.0), (np.s_[8:40, 154:206], -85.0)):  # right side, then upper side
        found = edge_response(image[part], frequency_cy_per_px=FREQUENCY)
        assert abs(found.angle_deg - angle) < 0.1
        np.testing.assert_allclose(found.mtf, closed_form(FREQUENCY, 5.0, 0.8), atol=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("psf_fwhm_um", [0.0, 3.0, 6.0, 10.0])
@pytest.mark.parametrize("angle_deg", [3.0, 5.0, -7.0, 10.0])
def test_more_rendered_edges_have_the_product_of_pixel_and_lens(angle_deg, psf_fwhm_um):
    target = {"type": "slanted-edge", "angle_deg": angle_deg}
    scene = make_scene(target=target, light=LIGHT, camera={"origin_m": [0, 0, 1]})
    a, b, _ = flux_image(scene, mono(100, 200, lens__psf_fwhm_um=psf_fwhm_um), 512)
    found = edge_response((a + b) / 2, frequency_cy_per_px=FREQUENCY)
    np.testing.assert_allclose(found.mtf, closed_form(FREQUENCY, angle_deg, psf_fwhm_um / 5), atol=0.01)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("edge") / "recording"
    sensor = hr.load_sensor("reference-bayer", {"lens.psf_fwhm_um": 4.0}).crop(120, 96)
    changes = {"target.dark": 0.05, "light.illuminance_lux": 400}
    hr.simulate(hr.load_scene("slanted-edge", changes), sensor, duration_s=0.03, seed=2, out=folder)
    return folder


def test_one_filter_of_a_mosaic_is_measured_in_a_part_of_a_frame(recording):
    loaded = hr.Recording.load(recording)
    pitch_um = loaded.manifest["sensor"]["spec"]["geometry"]["pitch_um"]
    expected = closed_form(FREQUENCY, 5.0, 4.0 / pitch_um)
    known = sorted({name for row in loaded.mosaic.tile_filter for name in row})
    for name in known:
        found = measure_mtf(loaded, region=(10, 0, 100, 96), signal="electrons", filter_name=name)
        # a quarter of the pixels, rendered to half of the sensor's noise
        np.testing.assert_allclose(found.mtf[:51], expected, atol=0.05)
        assert abs(found.angle_deg - 5) < 0.2
    raw = measure_mtf(loaded, region=(10, 0, 100, 96), filter_name=known[1])
    whole, same = (measure_mtf(loaded, region=part, filter_name=known[1]) for part in (None, (0, 0, 120, 96)))
    np.testing.assert_array_equal(whole.mtf, same.mtf)
    assert not raw.clipped
    assert abs(raw.mtf[10] - expected[10]) < 0.05
    with pytest.raises(RangeError, match="say on which to measure"):
        measure_mtf(loaded)
    # beyond either side, and without an area
    for region in ((100, 0, 30, 30), (0, 90, 20, 7), (-1, 0, 30, 30), (0, -1, 30, 30), (10, 0, 0, 30), (10, 0, 30, 0)):
        with pytest.raises(RangeError, match=re.escape(f"region is {region}")):
            measure_mtf(loaded, region=region, filter_name=known[0])
    with pytest.raises(RangeError, match="frame is 7; expected 0 to 0"):
        measure_mtf(loaded, 7, filter_name=known[0])


@pytest.mark.parametrize("signal", ["raw", "electrons"])
def test_a_part_of_a_frame_keeps_the_places_of_its_filter(monkeypatch, signal):
    """From column 13 and row 6 on: not a multiple of the tile."""
    asked = []
    monkeypatch.setattr(slanted_edge, "edge_response", lambda values, used, **_: asked.append((values, used)))
    monkeypatch.setattr(slanted_edge, "replace", lambda result, **_: result)
    made = recordings.make("gen2", width=64, height=48, frames=2)
    frame, layout = made.frames[1], hr.load_sensor("gen2").crop(64, 48).layout
    tile = made.mosaic.tile_filter
    name = tile[0][1]
    measure_mtf(made, 1, (13, 6, 40, 31), signal=signal, filter_name=name)
    ((values, used),) = asked
    assert values.shape == used.shape == (31, 40)
    for i, j in np.ndindex(31, 40):
        row, col = 6 + i, 13 + j
        assert used[i, j] == (tile[row % len(tile)][col % len(tile[0])] == name and bool(layout.aps_mask[row, col]))
    whole = frame.raw if signal == "raw" else frame.electrons_mean
    np.testing.assert_array_equal(values[used], whole[6:37, 13:53][used])


def run(*arguments):
    with pytest.raises(SystemExit) as caught:
        cli.main([str(argument) for argument in arguments])
    return caught.value.code


def test_the_command_prints_and_writes_the_response(recording, tmp_path, capsys):
    name = hr.Recording.load(recording).mosaic.tile_filter[0][0]
    out = tmp_path / "mtf.csv"
    given = [
        "measure",
        "mtf",
        recording,
        "--roi",
        "100x96+10+0",
        "--filter",
        name,
        "--signal",
        "electrons",
        "--out",
        out,
    ]
    assert run(*given) == 0
    printed = capsys.readouterr().out
    assert "noise-free electrons" in printed and "CLIPPED" not in printed
    assert "MTF at 0.25 cycles per pixel: 0." in printed and f"in {out}" in printed
    assert float(re.search(r"edge ([\d.]+)° from the vertical", printed)[1]) == pytest.approx(5, abs=0.03)
    table = np.loadtxt(out, delimiter=",", skiprows=1)
    loaded = hr.Recording.load(recording)
    expected = measure_mtf(loaded, region=(10, 0, 100, 96), signal="electrons", filter_name=name)
    np.testing.assert_allclose(table, np.column_stack([expected.frequency_cy_per_px, expected.mtf]), rtol=1e-5)
    assert out.read_text().splitlines()[0] == "frequency_cy_per_px,mtf"
    before = out.read_bytes()
    assert run(*given) == 2 and out.read_bytes() == before and "--overwrite" in capsys.readouterr().err
    assert run(*given, "--overwrite") == 0
    capsys.readouterr()
    assert run("measure", "mtf", recording, "--roi", "100x96") == 2
    assert "first column and row" in capsys.readouterr().err
    assert run("measure", "mtf", tmp_path / "none") == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_recording_without_frames_says_so():
    events = hr.simulate(hr.load_scene("slanted-edge"), hr.load_sensor("reference-mono").crop(8, 8), duration_s=0.002)
    with pytest.raises(RangeError, match="a frame of a recording that has frames; this one has none"):
        measure_mtf(events)


def test_saturated_pixels_are_refused(tmp_path, capsys):
    bright = hr.load_scene("slanted-edge", {"light.illuminance_lux": 1e6})
    recording = hr.simulate(bright, mono(64, 48), duration_s=0.02, clean=True, out=tmp_path / "bright")
    with pytest.raises(RangeError, match="values below saturation"):
        measure_mtf(recording)
    found = measure_mtf(recording, signal="electrons")
    assert found.mtf[25] > 0.8 and found.clipped  # the truth is not clipped
    assert run("measure", "mtf", tmp_path / "bright", "--signal", "electrons") == 0
    assert "CLIPPED: RAW values" in capsys.readouterr().out


@pytest.mark.parametrize("page", ["docs/cli.md", pytest.param("docs/targets.md", marks=pytest.mark.slow)])
def test_the_commands_of_the_docs_measure_an_edge(page, tmp_path, monkeypatch, capsys):
    lines = (Path(__file__).parents[2] / page).read_text(encoding="utf-8").splitlines()
    starts = "hesim-render simulate slanted-edge", "hesim-render measure mtf"
    commands = [next(line for line in lines if line.startswith(start)) for start in starts]
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert run(*command.split()[1:]) in (0, None), capsys.readouterr().err
    assert "MTF50: 0.60" in capsys.readouterr().out and (tmp_path / "mtf.csv").is_file()


def test_the_command_names_its_own_options(capsys, tmp_path):
    """Errors of functions name arguments; the command line has options for them, whose names differ at times."""
    import recordings

    recordings.make("reference-bayer", tmp_path / "r")
    given = ["measure", "mtf", str(tmp_path / "r")]
    for more, told in (
        (
            [],
            "this mosaic has 3 filters: say on which to measure, --filter NAME (filter_name), one of blue, green, red",
        ),
        (["--filter", "rde"], "--filter is 'rde'; expected one of blue, green, red (did you mean 'red'?)"),
        (["--frame", "9"], "--frame is 9; expected 0 to 1"),
    ):
        with pytest.raises(SystemExit):
            cli.main([*given, *more])
        assert capsys.readouterr().err == f"hesim-render: {told}\n"
