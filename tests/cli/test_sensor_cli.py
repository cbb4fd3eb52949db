"""``info`` of a sensor and ``new``, and every shipped sensor from the command line."""

import json

import capture_sets
import numpy as np
import pytest
from PIL import Image

from hesim_render.calibrate import calibrate_evs
from hesim_render.cli import main
from hesim_render.core.errors import SpecError
from hesim_render.recording.recording import Recording
from hesim_render.sensor.reading import read_sensor
from hesim_render.sensor.sensor import load_sensor
from hesim_render.specs.files import data_folder, list_names


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return stop.value.code, out, err


@pytest.mark.slow
def test_describe_shows_figures_and_curves(capsys, tmp_path):
    file = tmp_path / "curves.png"
    status, out, _ = call(capsys, "info", "imx636", "--out", file)
    assert status == 0
    lines = {line.split("  ")[1]: line for line in out.splitlines() if line.startswith("  ")}
    assert "(data sheet: 10 Hz)" in lines["background at 5 lx"] and " 10 Hz" in lines["background at 5 lx"]
    assert "(data sheet: 25 %)" in lines["threshold ON"]
    with Image.open(file) as picture:
        assert picture.width > 1000 and np.unique(picture.convert("L")).size > 20
    status, _, err = call(capsys, "info", "imx636", "--out", file)
    assert status == 2 and "exists" in err
    assert call(capsys, "info", "eiger", "--out", file, "--overwrite")[0] == 0
    status, _, err = call(capsys, "info", "eiger", "--out", tmp_path / "curves.txt")
    assert status == 2 and ".png or .svg or .pdf" in err and not (tmp_path / "curves.txt").exists()


def test_describe_as_json_with_a_change(capsys):
    change = "sensor.evs.data_sheet.threshold_on_percent=40"
    status, out, _ = call(capsys, "info", "imx636", "--json", "--set", change)
    data = json.loads(out)
    assert status == 0 and data["name"] == "imx636"
    figures = {row["name"]: row for row in data["figures"]["events"]}
    assert figures["threshold ON"]["value"] == pytest.approx(40) and figures["threshold ON"]["unit"] == "%"
    assert figures["background at 5 lx"]["data_sheet"] == 10
    status, _, err = call(capsys, "info", "imx636", "--set", "light.illuminance_lux=5")
    assert status == 2 and "a key of the sensor file" in err
    status, _, err = call(capsys, "info", "imx363x")
    assert status == 2 and "did you mean 'imx363'" in err


@pytest.mark.parametrize("like", ["frames", "events", "hybrid"])
def test_a_new_sensor_file_can_be_simulated_as_it_is(like, capsys, tmp_path):
    file = tmp_path / f"my {like}.yaml"
    status, out, _ = call(capsys, "new", file, "--like", like)
    assert status == 0 and "hesim-render info" in out
    text = file.read_text()
    assert text.count(" #") > 15 if like == "hybrid" else text.count(" #") > 5
    assert all(len(line) <= 120 for line in text.splitlines())
    spec = read_sensor(file)
    assert spec.name == f"my {like}"
    assert (spec.aps is not None, spec.evs is not None) == (like != "events", like != "frames")
    out_folder = tmp_path / "recording"
    given = ("--roi", "8x8", "--duration", 0.01, "--exact", "--samples", 4)
    status, _, err = call(capsys, "simulate", "flat-field", "--sensor", file, "--out", out_folder, *given)
    assert status in (0, 3), err
    status, _, err = call(capsys, "new", file)
    assert status == 2 and "exists" in err
    status, _, err = call(capsys, "new", tmp_path / "mine.txt")
    assert status == 2 and ".yaml" in err


def test_a_new_sensor_file_may_begin_as_a_copy(capsys, tmp_path):
    file = tmp_path / "mine.yaml"
    status, out, _ = call(capsys, "new", file, "--like", "imx636")
    assert status == 0 and "hesim-render info" in out
    mine, shipped = read_sensor(file).model_dump(), read_sensor("imx636").model_dump()
    assert mine.pop("name") == "mine" and shipped.pop("name") == "imx636" and mine == shipped
    assert file.read_text().splitlines()[0].startswith("# A copy of imx636:")
    status, _, err = call(capsys, "new", tmp_path / "other.yaml", "--like", "imx63")
    assert status == 2 and "expected one of frames, events, hybrid, davis240" in err and "did you mean 'imx636'" in err
    assert not (tmp_path / "other.yaml").exists()


@pytest.mark.slow
def test_a_sensor_whose_calibration_covers_a_part_is_described_by_it(capsys, tmp_path):
    """The file alone is enough: there is no region to be given."""
    roi = "{x: 6, y: 4, width_px: 32, height_px: 32}"
    keys = {"tile_rows": 1, "tile_cols": 1, "signal_reference": "{k: 0.2, t_ref_us: 10000}", "roi": roi}
    capture_sets.write_events(tmp_path / "set", size=32, trials=200_000, a=200.0, c=0.1, mismatch=0.05, **keys)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml")
    text = (data_folder("sensors") / "reference-mono.yaml").read_text()
    for old, new in (("rows: 1024", "rows: 48"), ("cols: 1024", "cols: 64"), ("bit_depth: 12", "bit_depth: 10")):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "s.yaml").write_text(text + "\nnoise: c.yaml\n")
    status, out, err = call(capsys, "info", tmp_path / "s.yaml", "--json", "--out", tmp_path / "s.png")
    assert status == 0, err
    figures = {row["name"]: row["value"] for rows in json.loads(out)["figures"].values() for row in rows}
    assert (figures["columns"], figures["event columns"]) == (64, 32)
    loaded = load_sensor(tmp_path / "s.yaml")
    part = loaded.calibrated_part
    assert (part.layout.col0, part.layout.row0, part.rows, part.cols) == (6, 4, 32, 32)
    assert loaded.crop(8, 8, 10, 10).calibrated_part.layout.shape == (8, 8)  # inside of it already
    with pytest.raises(SpecError, match=r"was measured on 32x32\+6\+4 of the sensor; .*--roi 32x32\+6\+4, in Python"):
        loaded.crop(8, 8, 0, 0).calibrated_part.evs  # noqa: B018


def test_the_list_of_sensors_is_a_table(capsys):
    lines = {line.split()[0]: line for line in call(capsys, "info", "sensors")[1].splitlines()}
    assert list(lines) == list_names("sensors")
    assert {len(line[: line.index("µm")]) for line in lines.values()} == {lines["eiger"].index("µm")}
    assert "frames 3264x2448" in lines["eiger"] and "events 1632x1224" in lines["eiger"]
    assert "no frames" in lines["imx636"] and "events 1280x720" in lines["imx636"] and "4.86 µm" in lines["imx636"]
    assert "no events" in lines["imx477"] and "frames 4056x3040" in lines["imx477"]


#: Two of a kind run with the normal tests, all with the slow ones.
QUICK = ("imx477", "v2e-noisy")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in list_names("sensors")]
)
def test_every_shipped_sensor_simulates(name, capsys, tmp_path):
    out = tmp_path / "recording"
    given = ("--roi", "8x8", "--duration", 0.004, "--exact", "--samples", 4, "--set", "light.illuminance_lux=300")
    status, _, err = call(capsys, "simulate", "flat-field", "--sensor", name, "--out", out, *given)
    assert status in (0, 3), err
    recording = Recording.load(out)
    spec = read_sensor(name)
    assert recording.manifest["sensor"]["name"] == name
    assert recording.manifest["counts"]["frames"] == len(recording.frames)
    # what the data sheet became is in the recording
    if spec.evs is not None and spec.evs.data_sheet is not None:
        stored = recording.manifest["sensor"]["spec"]["evs"]
        assert stored["coefficients"][0]["beta3"] == spec.evs.coefficients[0].beta3
