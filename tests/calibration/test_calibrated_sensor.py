"""A sensor that points at a calibration: it keeps what it read, and a calibration that is wrong names line and key."""

import copy
import pickle
import re
import shutil
from pathlib import Path

import capture_sets
import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.special import ndtr

import hesim_render as hr
from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.evs.stage import EvsStage

ROOT = Path(__file__).parents[2]
SHAPE = 24, 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small sensor file with its calibration, of frames, events and contrast steps, and a filter in a CSV file."""
    folder = tmp_path_factory.mktemp("calibrated")
    reference = "{k: 0.2, t_ref_us: 10000}"
    keys = {"tile_rows": 1, "tile_cols": 1, "signal_reference": reference}
    capture_sets.write_events(folder / "set", size=SHAPE, trials=200_000, a=200.0, c=0.1, mismatch=0.05, **keys)
    capture_sets.write_frames(folder / "set", size=SHAPE, frames=16, **keys, theta_hardware_v=0.75e-3)
    rng, trials, contrast = np.random.default_rng(1), 400, np.linspace(-0.4, 0.4, 9)
    own = 0.2 * (1 + 0.05 * rng.standard_normal((2, *SHAPE)))
    on = rng.binomial(trials, ndtr((contrast[:, None, None] - own[0]) / 0.06))
    off = rng.binomial(trials - on, ndtr((-contrast[:, None, None] - own[1]) / 0.06))
    np.savez(folder / "set" / "evs_steps.npz", contrast=contrast, signal_dn=20.0, n_on=on, n_off=off, n_trials=trials)
    text = (folder / "set" / "capture.yaml").read_text()
    (folder / "set" / "capture.yaml").write_text(text + "contrast_of: voltage\n")
    calibrate_aps(folder / "set", folder / "c.yaml")
    calibrate_evs(folder / "set", folder / "c.yaml")
    shutil.rmtree(folder / "set")
    text = (ROOT / "sensors" / "reference-mono.yaml").read_text()
    changes = {"rows: 1024": f"rows: {SHAPE[0]}", "cols: 1024": f"cols: {SHAPE[1]}", "bit_depth: 12": "bit_depth: 10"}
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    text = re.sub(r"(?m)^quantum_efficiency:.*(\n +.*)*", "quantum_efficiency: qe.csv", text)
    (folder / "qe.csv").write_text("300,0.4\n600,0.7\n1100,0.2\n")
    (folder / "s.yaml").write_text(text + "\nnoise: c.yaml\n")
    return folder


def drawn(sensor):
    """A frame, and events of three samples."""
    frame = sensor.aps.sample(np.full(sensor.layout.shape, 100.0), 10_000, seed=1)
    stage = EvsStage(sensor.evs, seed=2)
    light = [from_host(jit().Float, np.full(SHAPE[0] * SHAPE[1], value, np.float32)) for value in (50.0, 62.0, 50.0)]
    tick_us = sensor.spec.evs.tick_us
    events = np.concatenate([stage.step(values, (k + 1) * tick_us) for k, values in enumerate(light)])
    return frame.tobytes(), events.tobytes()


@pytest.mark.parametrize("used", (False, True))
def test_a_sensor_that_was_loaded_needs_no_file(folder, tmp_path, used):
    """A pickle and a copy give the same bits when everything they came from is gone, whether used before or not."""
    here = tmp_path / "here"
    shutil.copytree(folder, here)
    sensor = hr.load_sensor(here / "s.yaml")
    maps = read_maps(here / "c.yaml", "aps"), read_maps(here / "c.yaml", "evs")
    expected = drawn(hr.load_sensor(folder / "s.yaml"))
    if used:
        assert drawn(sensor) == expected
    kept = {"pickle": pickle.dumps(sensor), "deep copy": copy.deepcopy(sensor), "copy": copy.copy(sensor)}
    kept["model"] = pickle.dumps(sensor.aps)
    wavelength = np.linspace(350, 1000, 9)
    response, dump = sensor.spectral_response(wavelength), sensor.spec.model_dump(mode="json")
    shutil.rmtree(here)
    kept["pickle"] = pickle.loads(kept["pickle"])
    frame = pickle.loads(kept.pop("model")).sample(np.full(SHAPE, 100.0), 10_000, seed=1)
    assert frame.tobytes() == expected[0]
    for name, other in kept.items():
        assert drawn(other) == expected, name
        assert other == sensor, name
        for key, values in other.spectral_response(wavelength).items():
            np.testing.assert_array_equal(values, response[key])
        assert other.spec.model_dump(mode="json") == dump
    # the measured maps are in those bits
    offset = kept["pickle"].aps.fixed_pattern.offset_dn
    np.testing.assert_allclose(offset - offset.mean(), sum_of(maps[0]), atol=1e-3)
    known = maps[1]["threshold_on_rel"].ravel()
    assert np.corrcoef(kept["pickle"].evs.threshold_on_map.ravel(), known)[0, 1] > 0.999


def sum_of(maps):
    fixed = maps["n_row"][:, None] + maps["n_blc"]
    return fixed - fixed.mean()


def test_a_pickle_holds_no_array_of_the_device(folder):
    """Reading one would load Dr.Jit before a library for it was chosen; what was worked out is left out."""
    sensor = hr.load_sensor(folder / "s.yaml")
    before = len(pickle.dumps(sensor))
    drawn(sensor)
    text = pickle.dumps([sensor, sensor.aps, sensor.evs])
    assert b"drjit" not in text and len(pickle.dumps(sensor)) == before


def test_the_files_are_read_when_the_sensor_is_loaded(folder, tmp_path):
    """Not when it is used: a map that is gone is an error of the load, and one that changes later changes nothing."""
    shutil.copytree(folder, tmp_path / "here")
    file = tmp_path / "here" / read_calibration(folder / "c.yaml")["evs"]["maps"]["file"]
    sensor = hr.load_sensor(tmp_path / "here" / "s.yaml")
    file.write_bytes(b"nothing")
    assert drawn(sensor) == drawn(hr.load_sensor(folder / "s.yaml"))
    file.unlink()
    with pytest.raises(SpecError, match=r"c_evs_maps-.*: no such file; it belongs to c\.yaml"):
        hr.load_sensor(tmp_path / "here" / "s.yaml")


@pytest.mark.parametrize(("on", "off", "known"), [(0.17, 0.29, "steps"), (0.31, 0.22, "counts")])
def test_each_threshold_of_a_calibration_reaches_its_own_polarity(folder, tmp_path, on, off, known):
    """From contrast steps, or from the asymmetry of the static counts where that is better known; θ is the mean."""
    shutil.copytree(folder, tmp_path / "here")
    file = tmp_path / "here" / "c.yaml"
    yaml = YAML()
    data = yaml.load(file.read_text())
    evs, error = data["evs"], 0.02 if known == "counts" else 1e-4
    given = {"theta": (on + off) / 2, "theta_on": on, "theta_off": off}
    if known == "counts":
        given |= {"theta_on": 0.25, "theta_off": 0.26, "asymmetry": (off - on) / (off + on)}
    for name, value in given.items():
        evs[name] = {"value": value, "standard_error": 1e-4 if name == "asymmetry" else error}
    with file.open("w") as out:
        yaml.dump(data, out)
    spec = hr.load_sensor(tmp_path / "here" / "s.yaml").spec.evs
    assert (spec.contrast_threshold_on, spec.contrast_threshold_off) == pytest.approx((on, off), rel=1e-6)


WRONG = [  # text, its replacement, the line that begins so, and what is said of it
    ("\n  black_dn: ", "\n  black_dn: high #", "  black_dn", "aps.black_dn: Input should be a valid number"),
    ("\n  black_dn: ", "\n  black_dn: '64' #", "  black_dn", "aps.black_dn: expected a number, not a text"),
    ("\n  black_dn: ", "\n  black: ", "aps:", "aps.black_dn: required key is missing"),
    ("bit_depth: 10", "bit_depth: 40", "capture:", "capture.bit_depth: Input should be less than or equal to 16"),
    ("bit_depth: 10", "bits: 10", "capture:", "capture.bits: unknown key"),
    ("schema_version: 1", "schema_version: 2", "schema_version", "schema_version: expected 1"),
    ("\nevs:", "\nevents:", "events", "events: unknown key"),
    ("shot_law: linear", "shot_law: square", "  shot_law", "evs.shot_law: Input should be 'linear' or 'sqrt'"),
    ("\n  A:\n    value: ", "\n  A:\n    value: null #", "  A:", "evs.A.value: null needs a reason"),
    ("  - tile_position: [0, 0]", "  - position: [0, 0]", "  - position", "tile_position: required key is missing"),
    ("  maps: {file: c_aps", "  maps: {name: c_aps", "  maps", "aps.maps.file: required key is missing"),
    ("tile_rows: 1", "tile_rows: 2", "  beta:", "aps.beta: expected a table of 2×1"),
]


@pytest.mark.parametrize(("text", "other", "line", "message"), WRONG)
def test_a_calibration_that_is_wrong_names_its_line_and_key(folder, tmp_path, text, other, line, message):
    good = (folder / "c.yaml").read_text()
    assert text in good
    bad = good.replace(text, other, 1)
    (tmp_path / "c.yaml").write_text(bad)
    number = next(k for k, content in enumerate(bad.splitlines(), 1) if content.startswith(line))
    with pytest.raises(SpecError, match=rf"c\.yaml:(\d+): .*{re.escape(message)}") as found:
        read_calibration(tmp_path / "c.yaml")
    told = int(re.search(r"c\.yaml:(\d+)", str(found.value))[1])
    assert abs(told - number) <= 1  # a check of a whole parameter names its key's line or the next


def test_what_calibrate_writes_is_as_the_model_says(folder):
    data = read_calibration(folder / "c.yaml")
    assert data["aps"]["K"]["value"] > 0 and data["evs"]["theta"]["value"] > 0
    assert data["capture"]["signal_reference"] == {"k": 0.2, "t_ref_us": 10000.0, "filter": "own"}


def test_telegraph_pixels_forget_their_state_at_the_frame_rate_of_the_captures(folder, tmp_path):
    """A calibration of before has a correlation from frame to frame; the file has 30 frames per second."""
    shutil.copytree(folder, tmp_path / "here")
    file = tmp_path / "here" / "c.yaml"
    section = read_calibration(file)["aps"]
    maps = tmp_path / "here" / section["maps"]["file"]
    jumps = {name: np.zeros(SHAPE, np.float32) for name in ("amplitude_dn", "high_share", "correlation")}
    for name, value in (("amplitude_dn", 40.0), ("high_share", 0.3), ("correlation", 0.8)):
        jumps[name][4, 9] = value
    capture_sets.change(maps, telegraph_change_hz=None, **{f"telegraph_{name}": array for name, array in jumps.items()})
    text = file.read_text().replace(section["maps"]["sha256"], WholeFile(maps).sha256())
    file.write_text(text)
    for changes in ({}, {"aps.frame_rate_hz": 90}):
        found = hr.load_sensor(tmp_path / "here" / "s.yaml", changes).aps.telegraph
        assert found.place.tolist() == [4 * SHAPE[1] + 9]
        assert found.change_hz[0] == pytest.approx(-np.log(0.8) * 30, rel=1e-5)
    file.write_text(re.sub(r"(?m)^aps:$", "aps:\n  frame_rate_hz: 12.5", text))
    found = hr.load_sensor(tmp_path / "here" / "s.yaml").aps.telegraph
    assert found.change_hz[0] == pytest.approx(-np.log(0.8) * 12.5, rel=1e-5)
