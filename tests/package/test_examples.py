"""The scripts behind the how-to pages run and find what their pages say."""

import re
import subprocess
import sys
from pathlib import Path

import consistency_study
import numpy as np
import pytest

import hesim_render as hr

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=900).stdout


@pytest.mark.slow
@pytest.mark.parametrize("board", ["checkerboard", "charuco"])
def test_opencv_finds_the_camera(board):
    found = re.findall(r"^([fc][xy]).* (-?[\d.]+)%$", run("calibrate_with_opencv.py", 8, board), re.MULTILINE)
    assert [name for name, _ in found] == ["fx", "fy", "cx", "cy"]
    assert all(abs(float(percent)) < 0.3 for _, percent in found)


@pytest.mark.slow
def test_opencv_finds_the_camera_from_events():
    found = re.findall(r"^([fc][xy]).* (-?[\d.]+)%$", run("calibrate_from_events.py", 8), re.MULTILINE)
    assert [name for name, _ in found] == ["fx", "fy", "cx", "cy"]
    assert all(abs(float(percent)) < 0.3 for _, percent in found)


@pytest.mark.slow
def test_the_measured_mtf_is_the_closed_form():
    rows = re.findall(r"^ +([\d.]+) +([\d.]+) +([\d.]+)$", run("measure_mtf.py"), re.MULTILINE)
    assert len(rows) == 5
    assert all(abs(float(measured) - float(expected)) < 0.03 for _, measured, expected in rows)


def test_the_video_of_a_render_has_the_colours_of_the_scene(monkeypatch):
    """18 % grey under the study's light, seen by the CIE observer: 0.18 of what stands for white in each of R, G, B."""
    for name, value in {"SIZE": (16, 8), "SECONDS": 1 / consistency_study.FPS, "SAMPLES": 16}.items():
        monkeypatch.setattr(consistency_study, name, value)
    light = {"light.illuminant": "LED-B3", "light.illuminance_lux": consistency_study.LUX}
    video = consistency_study.linear_video(hr.load_scene("flat-field", light), "LED-B3")
    assert video.shape == (1, 8, 16, 3)
    np.testing.assert_allclose(video, 0.18 * consistency_study.WHITE_VALUE, rtol=0.12)  # 16 rays a pixel
    np.testing.assert_allclose(video.mean(axis=(0, 1, 2)), 0.18 * consistency_study.WHITE_VALUE, rtol=0.01)


@pytest.mark.slow
def test_flow_can_be_learnt_from(tmp_path):
    text = run("flow_dataset.py", tmp_path, 64)
    length, error = map(
        float, re.search(r"test: .*mean flow ([\d.]+) px, mean error of the model ([\d.]+) px", text).groups()
    )
    assert error < length
    with np.load(next(tmp_path.glob("test-*.npz"))) as pair:
        assert pair["voxels"].shape[0] == 5 and pair["flow_px"].shape == (*pair["valid"].shape, 2)
