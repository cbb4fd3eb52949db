"""The scripts behind the how-to pages run and find what their pages say."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.slow
def test_flow_can_be_learnt_from(tmp_path):
    text = run("flow_dataset.py", tmp_path, 64)
    length, error = map(
        float, re.search(r"test: .*mean flow ([\d.]+) px, mean error of the model ([\d.]+) px", text).groups()
    )
    assert error < length
    with np.load(next(tmp_path.glob("test-*.npz"))) as pair:
        assert pair["voxels"].shape[0] == 5 and pair["flow_px"].shape == (*pair["valid"].shape, 2)
