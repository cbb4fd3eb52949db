"""Every effect of the lens from the command line, on a hybrid and on an asynchronous sensor."""

import json

import pytest
from test_cli import call, fails

import hesim_render as hr
from hesim_render.cli.exit_status import ExitStatus

KERNEL = "[[[0, 0.1, 0], [0.1, 0.6, 0.1], [0, 0.1, 0]]]"
EFFECTS = {
    "distortion": "{model: fisheye, k1: -0.02}",
    "depth_of_field": "true",
    "diffraction": "true",
    "psf": f"{{type: measured, sample_um: 2, kernels: {KERNEL}}}",
    "lateral_chromatic": "{wavelength_nm: [400, 700], magnification_rel: [-0.001, 0.001]}",
    "relative_illumination": "{image_height_mm: [0, 2], illumination_rel: [1.0, 0.6]}",
    "veiling_glare": "0.05",
}
NEEDS_EXACT = {"diffraction", "lateral_chromatic", "veiling_glare"}
RUN = ("simulate", "rotating-star", "--roi", "16x12", "--duration", "0.004", "--set", "sensor.aps.exposure_us=2000",
       "--set", "sensor.aps.frame_rate_hz=400")  # fmt: skip


def rendered(capsys, tmp_path, sensor, *names):
    keys = [part for name in names for part in ("--set", f"sensor.lens.{name}={EFFECTS[name]}")]
    status, _, error = call(capsys, *RUN, "--sensor", sensor, *keys, "--out", tmp_path / "rec")
    assert status in (0, 3), error
    manifest = json.loads((tmp_path / "rec" / "recording.json").read_text(encoding="utf-8"))
    assert set(names) <= set(manifest["lens"]["effects"])
    recording = hr.Recording.load(tmp_path / "rec")
    assert len(recording.frames) == 1 and recording.frames[0].electrons_mean[recording.frames[0].valid].min() > 0
    return manifest["settings"]


@pytest.mark.parametrize("sensor", ["eiger", pytest.param("davis346", marks=pytest.mark.slow)])
def test_all_effects_together_are_rendered(capsys, tmp_path, sensor):
    settings = rendered(capsys, tmp_path, sensor, *EFFECTS)
    assert settings["mode"] == "exact" and "lens.diffraction" in settings["exact_because"]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["eiger", "davis346"])
@pytest.mark.parametrize("name", EFFECTS)
def test_each_effect_is_rendered(capsys, tmp_path, sensor, name):
    settings = rendered(capsys, tmp_path, sensor, name)
    assert (settings["mode"] == "exact") == (name in NEEDS_EXACT)
    assert ("exact_because" in settings) == (name in NEEDS_EXACT)


def test_effects_are_listed_switched_off_and_refused_in_one_line(capsys, tmp_path):
    assert call(capsys, "info", "lens")[1].split() == [f"lens.{name}" for name in EFFECTS]
    key = ("--set", "sensor.lens.distortion={model: opencv, k1: -20}")
    told = fails(capsys, *RUN, "--sensor", "eiger", *key, "--roi", "3264x2448", "--out", tmp_path / "rec")
    assert "eiger.yaml" in told and "lens.distortion: the model folds at" in told and told.count("\n") <= 1
    assert list(tmp_path.iterdir()) == []
    off = ("--without", "lens.distortion", "--samples", "4")
    done = call(capsys, *RUN, "--sensor", "eiger", *key, *off, "--out", tmp_path / "rec")
    assert done[0] == ExitStatus.NOT_MET  # four rays a pixel
