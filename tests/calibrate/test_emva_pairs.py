"""Captures of EMVA 1288 against a camera of NumPy, and, where they are at hand, real ones."""

import os
from pathlib import Path

import emva_camera
import numpy as np
import pytest

from hesim_render.calibrate import calibrate_aps, read_calibration, read_maps
from hesim_render.calibrate.aps.pairs import evaluate
from hesim_render.calibrate.aps.pairs_output import content
from hesim_render.recording.pair_set import read_pair_set

#: A folder of EMVA 1288's reference set 001 (a real CCD); the tests of real captures are skipped without it.
REAL = os.environ.get("HESIM_EMVA1288_CCD")
CAMERA = emva_camera.Camera()
SEEDS = 100


@pytest.fixture(scope="module")
def sections():
    """Section ``aps`` of a hundred devices of one kind."""
    return [content(evaluate(emva_camera.in_memory(CAMERA, seed))) for seed in range(SEEDS)]


def truth(camera):
    row, col, pixel = camera.dsnu
    return {
        "K": camera.gain,
        "responsivity": camera.gain * camera.efficiency,
        "quantum_efficiency": camera.efficiency,
        "read_noise_e": camera.read_noise,
        "dark_current_e_per_s": camera.dark_current,
        "row_noise_dn": camera.row_noise,
        "dsnu_e": np.sqrt(row**2 + col**2 + pixel**2),
        "prnu_percent": 100 * np.sqrt(sum(part**2 for part in camera.prnu)),
    }


@pytest.mark.parametrize("name", truth(CAMERA))
def test_intervals_hold_the_truth_of_a_hundred_devices(sections, name):
    """95 of 100 in the mean; 90 to 99 have a chance of 98.3 % for one parameter."""
    true = truth(CAMERA)[name]
    inside = [s[name]["interval_95"][0] <= true <= s[name]["interval_95"][1] for s in sections]
    values = np.array([s[name]["value"] for s in sections])
    errors = np.array([s[name]["standard_error"] for s in sections])
    assert 90 <= sum(inside) <= 99, (sum(inside), values.mean() / true, values.std() / errors.mean())
    # the mean of a hundred, at 4.5 of its standard errors
    assert abs(values.mean() - true) < 4.5 * values.std(ddof=1) / np.sqrt(SEEDS) + 2e-3 * true
