"""Twins of cameras written in NumPy: right ones pass, and what the fitted half does not have fails where it is."""

import emva_camera
import numpy as np
import pytest
from emva_makers import MAKERS, Maker
from emva_makers import NARROW as MAKERS_8

from hesim_render.sensor.sensor import load_sensor
from hesim_render.twin import make_twin, run

CAMERA = emva_camera.Camera(
    rows=72, cols=104, column_noise=0.7, bend=-0.03, long_frames=16,
    exposures_us=tuple(float(t) for t in np.linspace(400, 24_000, 14).round()),
)  # fmt: skip


@pytest.fixture
def no_page(monkeypatch):
    """Without pages, whose drawings take most of the time of a twin."""
    monkeypatch.setattr(run, "page", lambda checks, texts: "")


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


def twin_of(folder, seed, effect=None, noise_seed=3):
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
    return make_twin(captures, folder / f"twin-{seed}", seed=noise_seed)


def levels(camera, part, middle, **changes):
    """The camera with exposures up to a part of the ADC's range, and its long series at another."""
    full = (2**camera.bits - 1 - camera.black) / camera.gain / camera.efficiency / camera.photons_per_us
    exposures = np.linspace(0.004, part, 30) * full
    return camera.but(
        exposures_us=tuple(float(t) for t in exposures.round()), long_us=float(round(middle * full)), long_frames=32,
        **changes,
    )  # fmt: skip


PLAIN = emva_camera.Camera(
    rows=72, cols=104, gain=0.21, efficiency=0.57, read_noise=6.0, dark_current=900.0, dsnu=(0.6, 1.1, 3.0),
    prnu=(0.001, 0.002, 0.009), row_noise=0.0,
)  # fmt: skip
NARROW = PLAIN.but(bits=8, dark_current=3000.0)
#: Sensors of unlike properties, and the forms of their sets.
SENSORS = {
    "CMOS": (
        levels(PLAIN.but(row_noise=0.9, column_noise=0.6, hot=12), 1.08, 0.5),
        MAKERS["commas, tabs, microseconds, TIFF"],
    ),
    "bent full well": (
        levels(PLAIN.but(gain=0.31, full_well=9000.0, softness=250.0), 0.9, 0.32),
        MAKERS["a table of semicolons with paths of another machine"],
    ),
    "8 bit": (
        levels(NARROW.but(gain=0.021, black=6.3, read_noise=30.0, dsnu=(2.0, 4.0, 12.0)), 1.08, 0.5),
        MAKERS_8["BMP"],
    ),
    "8 bit, a dark noise of 0.41 DN": (
        levels(NARROW.but(gain=0.05, black=8.3, read_noise=8.2, dsnu=(2.0, 4.0, 6.0)), 1.08, 0.5),
        MAKERS_8["BMP of three equal colours"],
    ),
    "full well, hot pixels": (
        levels(PLAIN.but(gain=0.29, full_well=9400.0, hot=40), 0.9, 0.31),
        MAKERS["values to the left, milliseconds"],
    ),
    "stuck pixels and a dead row": (
        levels(PLAIN.but(white=9, dead_row=31, column_noise=0.3), 1.08, 0.5),
        MAKERS["a table of semicolons with paths of another machine"],
    ),
    "light that drifts": (levels(PLAIN.but(light_drift=0.015), 1.08, 0.5), MAKERS["values to the left, milliseconds"]),
    "saturated series": (levels(PLAIN, 1.8, 0.5), MAKERS["PGM, a line for each picture, UTF-16"]),
}


def twin_of_sensor(folder, name, seed, lacking=()):
    """The twin of a sensor, without the pairs at some exposures."""
    camera, maker = SENSORS[name]
    pairs, long = camera.set(seed)
    series = [
        (lit, us, camera.photons(us), pairs[lit, us])
        for number, us in enumerate(camera.exposures_us) if number not in lacking for lit in (True, False)
    ]  # fmt: skip
    series += [(lit, camera.long_us, camera.photons(camera.long_us), stack) for lit, stack in long.items()]
    captures = maker.write(folder / f"set-{seed}", series, camera.bits, (camera.rows, camera.cols))
    return make_twin(captures / maker.name, folder / f"twin-{seed}", seed=1000 + seed)


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "CMOS" else pytest.mark.slow) for n in SENSORS])
def test_twins_of_unlike_sensors_pass(tmp_path, name):
    """Three pairs are lacking. A drift of the light is named."""
    twin = twin_of_sensor(tmp_path, name, 5, lacking=(5, 6, 14))
    assert twin.passed, [(c.name, c.worst, c.rms) for c in twin.checks if not c.passed]
    named = {finding.check for finding in twin.findings}
    assert ("light of the long series" in named) == (name == "light that drifts")


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.9, 1.0, 1.15])
def test_where_rounding_hides_the_dark_noise_grey_values_tell_it(tmp_path, monkeypatch, factor):
    """A dark noise of 0.22 DN at 8 bit: 9 statistics in the light, and the noise by the chances of grey values.

    A read noise that is 10 % too small or 15 % too large fails.
    """
    camera = levels(NARROW.but(gain=0.0155, black=3.5, read_noise=14.0, dsnu=(2.0, 4.0, 8.0)), 1.08, 0.5)

    def wrong(file):
        beta = np.array(load_sensor(file).spec.aps.beta)
        beta[..., 0] *= factor**2
        return load_sensor(file, {"aps.beta": beta.tolist()} if factor != 1.0 else {})

    monkeypatch.setattr(run, "load_sensor", wrong)
    twin = make_twin(camera.write(tmp_path / "set", 8), tmp_path / "twin")
    lit, own = twin.checks[:-1], twin.checks[-1]
    assert len(lit) == 9 and all(check.name.endswith("lit") for check in lit)
    assert all(check.passed for check in lit), [(c.name, c.worst, c.rms) for c in lit if not c.passed]
    assert own.name == "noise under rounding" and own.passed == (factor == 1.0)
    # the long series is half of the longest exposure: its dark current makes noise of its own
    dark_e = camera.dark_current * camera.long_us * 1e-6
    noise = camera.gain * np.sqrt(camera.read_noise**2 + dark_e)
    assert own.real[0] == pytest.approx(noise, rel=0.04)
    assert any("by the probabilities of grey values it is 0.2" in finding.text for finding in twin.findings)


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("factor", (0.93, 1.0, 1.07))
def test_where_a_full_well_ends_is_compared(tmp_path, monkeypatch, factor):
    """Levels beyond saturation tell it, also where the twin's is too large to be seen at any level below."""
    camera = levels(PLAIN.but(gain=0.29, full_well=9400.0), 1.0, 0.31)
    folder = camera.write(tmp_path / "set", 6)

    def wrong(file):
        spec = load_sensor(file).spec.aps
        return load_sensor(file, {"aps.full_well_e": factor * spec.full_well_e})

    monkeypatch.setattr(run, "load_sensor", wrong)
    twin = make_twin(folder, tmp_path / "twin")
    failed = {check.name for check in twin.checks if not check.passed}
    assert len(twin.checks) == 21 and ("end of the signal, lit" in failed) == (factor != 1.0)
    assert failed <= {"end of the signal, lit"} or factor < 1.0


@pytest.mark.usefixtures("no_page")
@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_right_twins_fail_as_rarely_as_stated(tmp_path, name):
    """Of ten right twins of a sensor one fails with a chance of 20 %, two with 2 %."""
    failed = [seed for seed in range(40, 50) if not twin_of_sensor(tmp_path, name, seed).passed]
    assert len(failed) <= 1


@pytest.mark.usefixtures("no_page")
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


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_the_fitted_half_lacks_fails_where_it_is(tmp_path, name):
    effect, expected = EFFECTS[name]
    twin = twin_of(tmp_path, 31, effect)
    assert expected in {check.name for check in twin.checks if not check.passed}
    assert not twin.passed


#: Smaller effects that ten of ten twins tell, and the statistics.
SMALLER = {
    "columns": (doubled_columns, "temporal column variance, dark"),
    "curve": (lambda frames, rng: frames * (1 - 0.01 * frames / 4095), "mean, lit"),
    "jumps": (
        lambda frames, rng: (
            frames + 25 * (np.random.default_rng(0).random(frames.shape[1:]) < 0.005) * rng.integers(0, 2, frames.shape)
        ),
        "spatial variance, pixel, dark",
    ),
}


@pytest.mark.usefixtures("no_page")
@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLER)
def test_smaller_effects_are_told_by_most_twins(tmp_path, name):
    """Twice the column noise, 1 % less signal at full scale, a 200th of the pixels that jump: 9 of 10 at least."""
    effect, expected = SMALLER[name]
    told = 0
    for seed in range(200, 210):
        twin = twin_of(tmp_path, seed, effect, noise_seed=seed)
        told += expected in {check.name for check in twin.checks if not check.passed}
    assert told >= 9
