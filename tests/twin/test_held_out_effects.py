"""Twins of cameras written in NumPy: right ones pass, and what the fitted half does not have fails where it is."""

import emva_camera
import numpy as np
import pytest
from emva_makers import Maker

from hesim_render.twin import make_twin

CAMERA = emva_camera.Camera(
    rows=72, cols=104, column_noise=0.7, bend=-0.03, long_frames=16,
    exposures_us=tuple(float(t) for t in np.linspace(400, 24_000, 14).round()),
)  # fmt: skip


def doubled_columns(frames, rng):
    """Column noise of twice its rms."""
    return frames + np.sqrt(3) * CAMERA.column_noise * rng.standard_normal((len(frames), 1, CAMERA.cols))


def bent(frames, rng):
    """4 % less signal at full scale."""
    return frames * (1 - 0.04 * frames / 4095)


def jumping(frames, rng):
    """A fiftieth of the pixels has one of two levels in each frame, 25 DN apart."""
    pixels = np.random.default_rng(0).random(frames.shape[1:]) < 0.02
    return frames + 25 * pixels * rng.integers(0, 2, frames.shape)


def twin_of(folder, seed, effect=None):
    """The twin of a camera, of whose second exposures and frames, which the twin is not fitted on, some have more."""
    pairs, long = CAMERA.set(seed)
    rng = np.random.default_rng(1000 + seed)

    def changed(frames, number):
        if effect is None or number % 2 == 0:
            return frames
        return np.clip(np.rint(effect(frames.astype(float), rng)), 0, 4095).astype(np.uint16)

    series = [
        (lit, us, CAMERA.photons(us), changed(pairs[lit, us], number))
        for number, us in enumerate(CAMERA.exposures_us) for lit in (True, False)
    ]  # fmt: skip
    for lit, stack in long.items():
        frames = np.concatenate([changed(stack[k : k + 1], k) for k in range(len(stack))])
        series.append((lit, CAMERA.long_us, CAMERA.photons(CAMERA.long_us), frames))
    captures = Maker().write(folder / f"set-{seed}", series, 12, (CAMERA.rows, CAMERA.cols))
    return make_twin(captures, folder / f"twin-{seed}", seed=3)


@pytest.mark.slow
def test_twins_of_twenty_cameras_pass(tmp_path):
    """Of 20 statistics each fails in one of 1000 right twins, so that two of 20 twins fail with a chance of 6 %."""
    assert sum(twin_of(tmp_path, seed).passed for seed in range(20)) >= 18


#: Effects of the half that is held out, and the statistics that tell them.
EFFECTS = {
    "columns": (doubled_columns, "temporal column variance, dark"),
    "curve": (bent, "mean, lit"),
    "jumps": (jumping, "spatial variance, pixel, dark"),
}


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_the_fitted_half_lacks_fails_where_it_is(tmp_path, name):
    effect, expected = EFFECTS[name]
    twin = twin_of(tmp_path, 31, effect)
    assert expected in {check.name for check in twin.checks if not check.passed}
    assert not twin.passed
