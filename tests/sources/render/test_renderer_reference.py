"""The reference from elsewhere against closed forms and itself with more instants, and the default mode against it."""

import numpy as np
import pytest
from hidden_scenes import crossing, glint, vibration
from mitsuba_reference import WindowReference, reference_windows
from rendering import d65_irradiance, electrons_per_s, make_scene, mono
from scipy import stats

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

#: m of the plane z = 0 that the camera of `plate` sees across its 8 columns.
WIDE_M = 0.8
PITCH_M = WIDE_M / 8
SPEED_M_PER_US = 3e-4
RADIANCE = 0.02


def plate(move="plate", **mitsuba):
    """A plate that shines evenly and goes to the right at 0.3 pixels per 100 µs, its right edge at x = 0 at t = 0.

    `move`: or the camera goes to the left.
    """
    shapes = {
        "plate": {
            "type": "rectangle",
            "to_world": [[4, 0, 0, -4], [0, 4, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "emitter": {"type": "area", "radiance": {"type": "uniform", "value": RADIANCE}},
        }
    }
    way = SPEED_M_PER_US * 1000 * (1 if move == "plate" else -1)
    keys = [{"t_us": 0}, {"t_us": 1000, "translation_m": [way, 0, 0]}]
    return make_scene(
        mitsuba={"inline": shapes, **mitsuba},
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": np.degrees(2 * np.arctan(0.2))},
        motion=[{"object": move, "keyframes": keys}],
        max_depth=2,
    )


def covered(sensor, t_us):
    """Part of each pixel that the plate covers at each time, [time, pixel]."""
    left = (np.arange(sensor.cols) - sensor.cols / 2) * PITCH_M
    part = np.clip((SPEED_M_PER_US * np.asarray(t_us)[:, None] - left) / PITCH_M, 0, 1)
    return np.tile(part, (1, sensor.rows))


def full_flux(sensor, radiance=RADIANCE):
    grid = np.arange(400, 700.01, 0.25)
    lens = sensor.lens
    one = electrons_per_s(
        np.full(grid.size, radiance), grid, np.ones(grid.size), 5.0, sensor.spec.lens.f_number, lens.magnification
    )
    return one * sensor.relative_illumination.ravel()


def middle_times(begin, end, count=20_000):
    return begin + (np.arange(count) + 0.5) / count * (end - begin)


@pytest.mark.parametrize("move", [pytest.param("plate", marks=pytest.mark.slow), "camera"])
def test_edge_that_moves_across_pixels(move):
    """Its mean coverage is known; 12 windows of one row, in each of which one or two pixels are partly covered."""
    scene, sensor = plate(move), mono(8, 6)
    windows = np.array([[10 + 77 * k, 60 + 77 * k + 60 * (k % 4)] for k in range(11)] + [[777, 777]])
    reference, pixel = WindowReference(scene, sensor), np.arange(16, 24)
    unit = full_flux(reference.sensor)[pixel]
    found = reference.flux(windows, pixel, 4e-3 * unit, seed=1)
    truth = np.array([covered(sensor, middle_times(*w))[:, pixel].mean(axis=0) for w in windows]) * unit
    partly, wholly = (truth > 0.03 * unit) & (truth < 0.97 * unit), (truth == 0) | (truth > unit * (1 - 1e-12))
    assert partly.sum() >= 12
    # wavelengths are drawn as the response goes, so that an even spectrum has no noise
    np.testing.assert_allclose(found.flux[wholly], truth[wholly], rtol=1e-6)
    z = (found.flux - truth)[partly] / found.stderr[partly]
    assert np.all(found.stderr[partly] < 5e-3 * unit.max())
    assert np.abs(z).max() < stats.t.isf(1e-5 / z.size / 2, found.repeats - 1)
    # two pixels of a window see the same edge at the same instants: as many independent ones as windows
    assert abs(z.mean()) < 4.4 * 1.08 / np.sqrt(len(windows))
    assert 0.4 < np.mean(z**2) < 1.15 + 4.4 * np.sqrt(3.6 / len(windows))


@pytest.mark.slow
def test_lamp_that_flickers_while_it_moves():
    """The light's power and the coverage change together; the mean of their product in NumPy."""
    waveforms = {
        "pwm": {"type": "pwm", "frequency_hz": 4000, "duty": 0.3, "phase_deg": 40},
        "mains": {"type": "mains", "frequency_hz": 1200, "depth": 0.9},
    }
    laws = {
        "pwm": lambda t: (np.mod(4e-3 * t + 40 / 360, 1) < 0.3) / 0.3,
        "mains": lambda t: 1 + 0.9 * np.cos(2 * np.pi * 2 * 1.2e-3 * t),
    }
    sensor = mono(8, 6)
    windows = np.array([[0, 150], [111, 333], [400, 900]])
    pixel = np.arange(16, 24)
    for name, waveform in waveforms.items():
        reference = WindowReference(plate(waveforms={"plate": waveform}), sensor)
        unit = full_flux(reference.sensor)[pixel]
        found = reference.flux(windows, pixel, 5e-3 * unit, seed=2)
        truth = np.empty((3, pixel.size))
        for k, window in enumerate(windows):
            t = middle_times(*window, 200_000)
            truth[k] = np.mean(laws[name](t)[:, None] * covered(sensor, t)[:, pixel], axis=0) * unit
        off = np.abs(found.flux - truth)
        assert np.all(off <= stats.t.isf(1e-6, found.repeats - 1) * found.stderr + 2e-5 * unit)
        assert np.all(found.stderr < 1e-2 * unit)


@pytest.mark.slow
def test_diffuse_plate_under_an_area_light():
    """E is given on the plane; L = ρ E/π there."""
    light = {
        "type": "area",
        "illuminance_lux": 1000,
        "position_m": (0.1, 0.2, 0.5),
        "size_m": (0.2, 0.2),
        "illuminant": {"illuminant": "D65"},
    }
    grey = {"name": "plate", "shape": "rectangle", "size_m": (2, 2, 0), "reflectance": 0.5}
    camera = {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": 0.002}
    scene, sensor = make_scene(objects=[grey], light=light, camera=camera), mono(8, 6)
    reference = WindowReference(scene, sensor)
    grid, irradiance = d65_irradiance(1000)
    inside = (grid >= 400) & (grid <= 700)
    lens = reference.sensor.lens
    one = electrons_per_s(
        0.5 * irradiance[inside] / np.pi, grid[inside], 1.0, 5.0, sensor.spec.lens.f_number, lens.magnification
    )
    truth = one * reference.sensor.relative_illumination.ravel()
    few = reference.flux([[0, 1000]], np.arange(48), 1.0, seed=3, instants=1)
    z = (few.flux[0] - truth) / few.stderr[0]
    assert np.all(few.stderr[0] < 5e-3 * truth)
    # t with 15 degrees of freedom: variance 1.15; 48 independent ones, false alarm 1e-5 each
    assert abs(z.mean()) < 4.4 * 1.08 / np.sqrt(z.size)
    assert abs(np.mean(z**2) - 1.15) < 4.4 * np.sqrt(3.6 / z.size)
    many = reference.flux([[0, 1000]], np.arange(16, 32), 100.0, seed=4)
    np.testing.assert_allclose(many.flux[0], truth[16:32], rtol=5e-5)
    assert abs(many.flux.mean() / truth[16:32].mean() - 1) < 1e-5


@pytest.mark.slow
def test_twice_as_many_instants_change_nothing():
    scene, sensor = vibration(), hr.load_sensor("reference-bayer").crop(40, 32)
    reference = WindowReference(scene, sensor)
    pixel = np.random.default_rng(4).choice(1280, 30, replace=False)
    windows = [[2000, 3000]]
    few, many = (reference.flux(windows, pixel, 1.0, seed, instants=count) for seed, count in ((1, 8), (2, 16)))
    z = (many.flux - few.flux) / np.hypot(many.stderr, few.stderr)
    assert np.abs(z).max() < stats.t.isf(1e-5 / z.size / 2, few.repeats - 1)
    assert abs(np.mean(z**2) - 1.1) < 5 * np.sqrt(3 / z.size) * 2  # instants are shared by the pixels of a window
    # more instants, smaller errors: in some of the pixels a plate shakes
    assert np.sum(many.stderr**2) < 0.7 * np.sum(few.stderr**2)


def test_what_is_asked_for_besides_does_not_matter():
    scene, sensor = crossing(), hr.load_sensor("reference-bayer").crop(40, 32)
    reference = WindowReference(scene, sensor)
    pixel, windows = np.array([400, 17, 900]), [[1000, 2000], [5000, 6000]]
    every = reference.flux(windows, pixel, 500.0, seed=9)
    alone = reference.flux(windows[1:], pixel[1:2], 500.0, seed=9)
    np.testing.assert_allclose(alone.flux[0, 0], every.flux[1, 1], rtol=1e-13)
    np.testing.assert_allclose(alone.stderr[0, 0], every.stderr[1, 1], rtol=1e-9)
    other = reference.flux(windows[1:], pixel[1:2], 500.0, seed=10)
    assert other.flux[0, 0] != alone.flux[0, 0]


@pytest.mark.slow
def test_still_scene_is_one_estimate_for_all_windows():
    light = {"type": "uniform", "illuminance_lux": 500, "waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.5}}
    scene = hr.load_scene("colorchecker", {"light": light})
    sensor = hr.load_sensor("reference-bayer").crop(16, 12)
    found = reference_windows(scene, sensor, [[0, 1000], [4000, 7000], [5000, 5000]], np.arange(20), 100.0)
    t = [middle_times(0, 1000), middle_times(4000, 7000), np.array([5000.0])]
    power = np.array([np.mean(1 + 0.5 * np.cos(2 * np.pi * 1e-4 * own)) for own in t])
    np.testing.assert_allclose(
        found.flux / found.flux[:1], np.broadcast_to(power[:, None] / power[0], (3, 20)), rtol=1e-6
    )


def default_against_reference(scene, sensor, window, pixel, seeds=6):
    """z of the mean over seeds of the default mode, by its own scatter and the reference's error."""
    every = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)
    runs = []
    for seed in range(seeds):
        source = ChangeDrivenFlux(scene, sensor, 0.5, seed=seed)
        halves = source.mean_flux(every, *window)
        runs.append(0.5 * sum(np.array(half, dtype=np.float64) for half in halves)[pixel])
    runs = np.array(runs)
    unit = source.noise_unit(pixel, runs.mean(axis=0), False)
    found = reference_windows(scene, sensor, [window], pixel, 0.15 * unit, seed=77)
    error = np.hypot(runs.std(axis=0, ddof=1) / np.sqrt(seeds), found.stderr[0])
    # what the default mode is not asked for
    error = np.hypot(error, 0.01 * unit)
    return (runs.mean(axis=0) - found.flux[0]) / error, runs.sum() / (seeds * found.flux[0].sum())


@pytest.mark.slow
@pytest.mark.parametrize("scene", [crossing, glint], ids=["crossing", "glint"])
def test_default_mode_against_it(scene):
    sensor = hr.load_sensor("reference-bayer").crop(40, 32)
    pixel = np.random.default_rng(6).choice(1280, 24, replace=False)
    z, ratio = default_against_reference(scene(), sensor, (10_000, 11_000), pixel)
    # between t with 5 and with 15 degrees of freedom; false alarm 1e-4 of the mean, 1e-4 of the largest
    assert abs(z.mean()) < 3.9 * 1.3 / np.sqrt(z.size)
    assert np.abs(z).max() < stats.t.isf(1e-4 / z.size / 2, 5)
    assert abs(ratio - 1) < 2e-3


def test_bad_arguments():
    scene, sensor = plate(), mono(8, 6)
    reference = WindowReference(scene, sensor)
    with pytest.raises(RangeError, match="pixel"):
        reference.flux([[0, 1]], [48], 1.0)
    with pytest.raises(RangeError, match="end_us"):
        reference.flux([[2, 1]], [4], 1.0)
    with pytest.raises(RangeError, match="error_wanted"):
        reference.flux([[0, 1]], [4], 0.0)
    with pytest.raises(RangeError, match="samples"):
        WindowReference(scene, sensor, samples=8)
    with pytest.raises(RangeError, match="repeats"):
        WindowReference(scene, sensor, repeats=1)
    with pytest.raises(RangeError, match="most_rays"):
        WindowReference(scene, sensor, most_rays=8)
    blurred = hr.load_sensor("reference-bayer", {"lens.psf_fwhm_um": 5}).crop(8, 6)
    with pytest.raises(SpecError, match="psf_fwhm_um"):
        WindowReference(scene, blurred)
