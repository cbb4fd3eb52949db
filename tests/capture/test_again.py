"""Recordings made again from their manifests."""

import json

import pytest

import hesim_render as hr
from hesim_render.capture.again import simulate_again
from hesim_render.cli import main
from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.recording.recording import Recording


def contents(folder):
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("scene", "sensor", "given"),
    [
        ("rotating-star", "gen2",
         ("--roi", "32x24+1600+1200", "--quality", 4, "--seed", 11, "--truth", "depth,events")),
        ("flat-field", "v2e-noisy", ("--roi", "16x16", "--exact", "--samples", 4, "--without", "evs.leak")),
        ("colorchecker", "eiger", ("--roi", "32x24", "--clean", "--set", "camera.f_number=4", "--set",
                                   "sensor.aps.exposure_us=2000")),
    ],
)  # fmt: skip
def test_a_recording_made_again_has_the_same_bytes(scene, sensor, given, tmp_path, capsys):
    first, again = tmp_path / "first", tmp_path / "again"
    for arguments in (
        ("simulate", scene, "--sensor", sensor, "--out", first, "--duration", 0.02, *given),
        ("simulate", first, "--out", again),
    ):
        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments])
        assert stop.value.code in (0, 3), capsys.readouterr().err
    one, other = contents(first), contents(again)
    assert one.keys() == other.keys() and len(one) > 2
    assert [name for name in one if one[name] != other[name]] == []


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("again") / "recording"
    sensor = hr.load_sensor("reference-mono").crop(16, 8)
    return hr.simulate(hr.load_scene("dark"), sensor, duration_s=0.001, out=folder, exact=True, samples=4).path


def changed(small, tmp_path, change):
    manifest = json.loads((small / "recording.json").read_text())
    change(manifest)
    (tmp_path / "recording").mkdir()
    for file in small.rglob("*"):
        target = tmp_path / "recording" / file.relative_to(small)
        if file.is_dir():
            target.mkdir(exist_ok=True)
        else:
            target.write_bytes(file.read_bytes())
    (tmp_path / "recording" / "recording.json").write_text(json.dumps(manifest))
    return Recording.load(tmp_path / "recording")


def test_other_versions_are_told(small, tmp_path):
    recording = changed(small, tmp_path, lambda manifest: manifest["software"].update(mitsuba="3.0.0"))
    with pytest.warns(HesimWarning, match=r"made with mitsuba 3\.0\.0 and now"):
        simulate_again(recording)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda manifest: manifest.update(scene=None), "of a video, or imported"),
        (lambda manifest: manifest["scene"].update(files_sha256={"mine.csv": "0" * 64}), "--scene PATH"),
        (lambda manifest: manifest["time"].update(begin_us=500), "goes on from an earlier run"),
    ],
)
def test_what_cannot_be_made_again_says_why(change, text, small, tmp_path):
    recording = changed(small, tmp_path, change)
    with pytest.raises(SpecError, match=text):
        simulate_again(recording)
    with pytest.raises(SpecError, match="is not the one of the recording"):
        simulate_again(Recording.load(small), scene=hr.load_scene("flat-field"))
