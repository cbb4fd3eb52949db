"""`hesim-render video` from a real file to a recording and pictures, and its mistakes."""

import json
import re
import time

import numpy as np
import pytest
from PIL import Image
from test_cli import call, fails
from videos import encode, moving_bar, rgb_frames

import hesim_render as hr
from hesim_render.isp import develop_recording


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """0.4 s of H.264 at 50 pictures/s, as a camera writes it."""
    return encode(tmp_path_factory.mktemp("clip") / "bar.mp4", rgb_frames(moving_bar(20)), "libx264", 50)


def test_a_video_file_becomes_a_recording_with_pictures(clip, tmp_path, capsys):
    out = tmp_path / "out"
    status, text, err = call(
        capsys, "simulate", clip, "--sensor", "eiger", "--roi", "128x96", "--out", out, "--set", "slow_motion=2",
        "--set", "white_lux=800", "--set", "sensor.aps.exposure_us=4000", "--set", "interpolation=linear",
    )  # fmt: skip
    assert status == 0 and err == ""
    assert text.startswith("estimate: about ") and "\nbar.mp4 seen by eiger, 0.2 s" in text and "preview.png" in text
    assert "note: the pictures are enlarged 2 times" in text
    recording = hr.Recording.load(out)
    assert len(recording.frames) == 2 and recording.frames[0].exposure_us == 4000 and recording.events.size > 100
    picture = np.asarray(Image.open(out / "preview.png"))
    assert picture.ndim == 3 and picture.std() > 5
    assert Image.open(out / "preview.gif").n_frames > 5

    manifest = json.loads((out / "recording.json").read_text())
    video = manifest["settings"]["video"]
    assert manifest["scene"] is None and len(video["sha256"]) == 64 and video["codec"] == "h264"
    assert video["colour"]["transfer"] == "srgb" and video["colour"]["range"] == "limited"
    assert (video["slow_motion"], video["white_lux"], video["interpolation"]) == (2, 800, "linear")
    assert video["picture_period_us"] == pytest.approx(10_000) and video["picture_px_per_sensor_px"] == [0.5, 0.5]

    same = hr.simulate_video(
        clip, hr.load_sensor("eiger", {"aps.exposure_us": 4000}).crop(128, 96), slow_motion=2, white_lux=800,
        interpolation="linear",
    )  # fmt: skip
    assert np.array_equal(same.frames[1].raw, recording.frames[1].raw)
    assert np.array_equal(same.events, recording.events)

    shown = develop_recording(out, tmp_path / "pictures")
    developed = np.asarray(Image.open(sorted(shown.glob("*.png"))[0])).astype(float)
    columns = developed[20:-20].mean(axis=(0, 2))
    assert columns.max() > 2 * columns.min()  # the bar is there
    assert call(capsys, "view", out)[1].startswith("bar.mp4 seen by eiger")


def test_a_folder_needs_its_rate_and_transfer(tmp_path, capsys):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k, picture in enumerate(moving_bar(5)):
        Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(folder / f"{k:03d}.png")
    options = ["simulate", folder, "--sensor", "gen2", "--roi", "64x48", "--out", tmp_path / "out"]
    assert "colour tags are missing: transfer; give them" in fails(capsys, *options, "--set", "fps=100")
    assert "give the frame rate" in fails(capsys, *options, "--set", "transfer=srgb")
    assert not (tmp_path / "out").exists()
    status, text, _ = call(capsys, *options, "--set", "transfer=srgb", "--set", "fps=100", "--clean")
    assert status == 0 and "pictures seen by gen2, 0.05 s" in text
    assert "exists" in fails(capsys, *options, "--set", "transfer=srgb", "--set", "fps=100")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--set", "mode=blue"], "mode: Input should be 'matrix' or 'spectral'"),
        (["--duration", "9"], "at most the video's 0.4 s"),
        (["--duration", "-1"], "--duration"),
        (["--roi", "63x48"], "multiple of the tile"),
        (["--set", "light.illuminant=A"], "light.illuminant: unknown key (did you mean 'illuminant'?)"),
        (["--set", "white_lux=5", "--set", "white_e_per_s=5", "--set", "white_filter=red"], "give one of them"),
        (["--set", "white_e_per_s=5", "--set", "white_filter=mauve"], "red, green, blue"),
        (["--set", "camera=nowhere.yaml"], "nowhere.yaml"),
        (["--set", "illuminant=D66"], "unknown illuminant"),
        (["--set", "fit=pixel", "--roi", "256x192"], "at least the 256x192 px"),
        (["--set", "matrix=rgb"], "one for YUV pictures"),
    ],
)
def test_mistakes_are_one_line(clip, arguments, text, tmp_path, capsys):
    given = ["--roi", "64x48", *arguments]
    assert text in fails(capsys, "simulate", clip, "--sensor", "eiger", "--out", tmp_path / "out", *given)
    assert not any(tmp_path.iterdir())


def test_a_camera_file_is_undone_and_travels_with_the_recording(clip, tmp_path, capsys):
    """The recording's mosaic holds the given balance, so that the ISP turns the same pictures out."""
    camera = tmp_path / "camera.yaml"
    camera.write_text(
        "channels: [red, green, blue]\ntile: |\n  red green\n  green blue\nwhite_level_dn: 1023\n"
        "white_balance: [2.643, 1.0, 1.764]\nmatrix: [[1.2, -0.15, -0.05], [-0.1, 1.2, -0.1], [-0.05, -0.15, 1.2]]\n"
    )
    out = tmp_path / "out"
    status, *_ = call(
        capsys,
        "simulate",
        clip,
        "--sensor",
        "reference-bayer",
        "--roi",
        "64x48",
        "--out",
        out,
        "--set",
        f"camera={camera}",
    )
    assert status == 0
    mosaic = hr.Recording.load(out).mosaic
    np.testing.assert_allclose(mosaic.neutral, [1 / 2.643, 1, 1 / 1.764])
    np.testing.assert_allclose(mosaic.camera_to_srgb[0], [1.2, -0.15, -0.05])


@pytest.mark.parametrize(
    "options",
    [
        ["--set", "white_lux=1e300"], ["--set", "white_lux=1e-300"], ["--set", "white_lux=inf"],
        ["--set", "fps=1e-300"],
        ["--set", "fps=1e-9"], ["--set", "fps=1e300"], ["--set", "slow_motion=1e-300"], ["--set", "slow_motion=1e300"],
        ["--set", "gamma=1e300", "--set", "transfer=gamma"],
        ["--set", "gamma=1e-300", "--set", "transfer=gamma"], ["--set", "duty=1e-300"],
        ["--set", "white_e_per_s=1e300", "--set", "white_filter=green"],
        ["--set", "interpolation=motion", "--set", "motion_factor=9999"],
        ["--duration", "1e300"], ["--duration", "1e-300"],
    ],
)  # fmt: skip
def test_absurd_values_are_refused_before_any_work(options, tmp_path, capsys, clip):
    begin = time.process_time()
    fails(capsys, "simulate", clip, "--sensor", "davis346", "--roi", "32x32", "--out", tmp_path / "o", *options)
    assert time.process_time() - begin < 20 and list(tmp_path.iterdir()) == []


def test_a_video_that_takes_days_has_to_be_wanted(tmp_path, capsys):
    """Three pictures, twenty minutes each: 2.88 million comparisons of every pixel, and 72,000 frames."""
    np.save(tmp_path / "slow.npy", moving_bar(3))
    status, out, err = call(
        capsys, "simulate", tmp_path / "slow.npy", "--sensor", "gen2", "--set", f"fps={1 / 1200}",
        "--set", "transfer=srgb", "--out", tmp_path / "o",
    )  # fmt: skip
    assert status == 2 and err.startswith("hesim-render: this run takes about ") and err.count("\n") == 1
    counts = re.search(r"(\d+) pictures, (\d+) event samples, (\d+) frames", out)
    assert [int(n) for n in counts.groups()] == [3, 2_880_000, 3600 * 20]
    assert "add --yes (max_minutes=None)" in err and not (tmp_path / "o").exists()
