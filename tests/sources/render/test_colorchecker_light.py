"""The light of a ColorChecker and of a plastic ball in the default mode: no bias, and errors as stated.

Inside a patch the light of an even sky is known in closed form and has no noise: every value equals the truth to
rounding. Noise is left where a pixel sees an edge, and in everything that is glossy or lit by way of other surfaces.
"""

import functools

import colour
import numpy as np
import pytest
from mitsuba_reference import WindowReference
from rendering import make_scene
from scipy import stats

import hesim_render as hr
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

COLS, ROWS = 72, 48
ILLUMINANTS = ("A", "D65", "FL11", "LED-B3")
F_NUMBERS = (1.4, 2.8, 8.0)
SENSORS = ("reference-bayer", "eiger")
QUALITIES = (0.1, 0.5, 1.0, 4.0)
LUX = 300.0
WIDTH_M, HEIGHT_M, FILL = 0.279, 0.186, 0.85


def table(distribution):
    return np.asarray(distribution.wavelengths, float), np.asarray(distribution.values, float)


def integral(*tables):
    """∫ of a product of piecewise-linear functions, zero outside their tables, exactly (4 nodes for each piece)."""
    low, high = max(t[0][0] for t in tables), min(t[0][-1] for t in tables)
    knots = np.unique(np.clip(np.concatenate([t[0] for t in tables]), low, high))
    place, weight = np.polynomial.legendre.leggauss(4)
    half, middle = np.diff(knots) / 2, (knots[1:] + knots[:-1]) / 2
    grid = middle[:, None] + half[:, None] * place
    values = np.prod([np.interp(grid, *t) for t in tables], axis=0)
    return float(np.sum(half[:, None] * weight * values))


@functools.cache
def light_table(name):
    """E(λ) at `LUX`, W m⁻² nm⁻¹."""
    sources = colour.SDS_LIGHT_SOURCES if name in colour.SDS_LIGHT_SOURCES else colour.SDS_ILLUMINANTS
    grid, shape = table(sources[name])
    luminous = table(colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"])
    return grid, shape * LUX / (683.002 * integral((grid, shape), luminous))


def chart_scene(illuminant, f_number):
    target = {"type": "colorchecker", "width_m": WIDTH_M, "height_m": HEIGHT_M, "patch_fill": FILL, "surround": 0.1}
    light = {"type": "uniform", "illuminant": {"illuminant": illuminant}, "illuminance_lux": LUX}
    camera = {"fit": "target", "fit_margin": 1.02, "f_number": f_number}
    return make_scene(target=target, light=light, camera=camera)


def covered(edges, low, high):
    """Part of each pixel, given by its edges, in each interval [interval, pixel]."""
    first, last = np.sort(np.stack([edges[:-1], edges[1:]]), axis=0)
    inside = np.minimum(last, np.asarray(high)[:, None]) - np.maximum(first, np.asarray(low)[:, None])
    return np.clip(inside, 0, None) / (last - first)


def truth_of(view, sensor, illuminant):
    """Flux of each pixel, [row, col], and how much of it each of the 24 patches covers, [patch, row, col]."""
    pitch_x, pitch_y = WIDTH_M / 6, HEIGHT_M / 4
    margin = (1 - FILL) / 2 * min(pitch_x, pitch_y)
    left = pitch_x * np.arange(6) - WIDTH_M / 2
    bottom = HEIGHT_M / 2 - pitch_y * np.arange(1, 5)
    left_mm, right_mm, top_mm, bottom_mm = view.region_mm
    scale = view.camera_to_world[2, 3] / sensor.lens.image_distance_mm
    x = view.camera_to_world[0, 3] + scale * np.linspace(left_mm, right_mm, COLS + 1)
    y = view.camera_to_world[1, 3] - scale * np.linspace(top_mm, bottom_mm, ROWS + 1)
    along_x = covered(x, left + margin, left + pitch_x - margin)
    along_y = covered(y, bottom + margin, bottom + pitch_y - margin)
    part = (along_y[:, None, :, None] * along_x[None, :, None, :]).reshape(24, ROWS, COLS)
    reflectances = [table(sd) for sd in colour.SDS_COLOURCHECKERS["ISO 17321-1"].values()]
    surround = np.array([300.0, 1100.0]), np.array([0.1, 0.1])
    light = light_table(illuminant)
    index, flux = sensor.layout.filter_index, np.zeros((ROWS, COLS))
    for number, name in enumerate(sensor.layout.filters):
        if name not in sensor.responses or not np.any(index == number):
            continue
        response = sensor.responses[name].wavelength_nm, sensor.responses[name].values
        levels = np.array([integral(r, light, response) for r in reflectances]) / np.pi
        ground = integral(surround, light, response) / np.pi
        whole = np.tensordot(levels - ground, part, 1) + ground
        flux = np.where(index == number, whole, flux)
    return flux * sensor.relative_illumination, part


def chart_z(name, illuminant, f_number, quality, seeds, together):
    """z of the sum over the pixels of each patch that an edge goes through, and over some seeds together, [sum, patch];
    and other departures.

    What a sum's error is said to be is taken from the halves of all seeds: of one seed at 8 rays a pixel they are few.

    Returns
    -------
    z : see above. off : largest relative departure of a pixel inside a patch. bias : of whole pictures, [sum].
    """
    scene, given = chart_scene(illuminant, f_number), hr.load_sensor(name).crop(COLS, ROWS)
    pixels, sums, squares, off, bias = np.arange(ROWS * COLS, dtype=np.uint32), [], [], 0.0, []
    for seed in seeds:
        source = ChangeDrivenFlux(scene, given, quality, seed=seed)
        halves = [np.array(half, np.float64).reshape(ROWS, COLS) for half in source.mean_flux(pixels, 0.0, 1000.0)]
        flux, half = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
        truth, part = truth_of(source.view, source.sensor, illuminant)
        even = (part > 1 - 1e-4).any(axis=0)
        assert even.mean() > 0.4
        off = max(off, float(np.abs(flux / truth - 1)[even].max()))
        edge = (part > 0.01) & (part < 0.99)
        sums.append([(flux - truth)[own].sum() for own in edge])
        squares.append([(half[own] ** 2).sum() for own in edge])
        bias.append(flux.sum() / truth.sum() - 1)
    own = np.array(sums).reshape(-1, together, len(sums[0])).sum(axis=1)
    z = own / np.sqrt(together * np.mean(squares, axis=0))
    return z, off, np.array(bias).reshape(-1, together).mean(axis=1)


def assert_unbiased(name, illuminant, f_number, quality, together=1):
    z, off, bias = chart_z(name, illuminant, f_number, quality, range(10 * together), together)
    assert z.size == 240
    # float32 of a sum over a table of wavelengths
    assert off < 1e-5
    # 240 z of variance 1 (each of some 40 pixels): the mean is off by 0.22 with probability 7e-4
    assert abs(z.mean()) < 0.22 and 0.85 < z.std() < 1.15
    assert np.abs(z).max() < 5
    error = bias.std(ddof=1) / np.sqrt(bias.size)
    if error < 5e-4 / 3:
        assert abs(bias.mean()) < 5e-4
    assert abs(bias.mean()) < stats.t.isf(5e-5, bias.size - 1) * error
    return z


def test_chart():
    assert_unbiased("reference-bayer", "A", 8.0, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("quality", QUALITIES)
def test_chart_under_all_lights(name, quality):
    """Pooled over 12 lights and apertures: 2880 z, of four seeds each: of few rays, those of one have heavy tails."""
    z = np.concatenate([assert_unbiased(name, light, f, quality, 4) for light in ILLUMINANTS for f in F_NUMBERS])
    assert abs(z.mean()) < 0.15 and 0.9 < z.std() < 1.1


def glossy_ball(material, depth):
    """A ball of plastic under a lamp whose colour is given as sRGB, on a wall."""
    shapes = {
        "ball": {
            "type": "sphere",
            "to_world": np.diag([0.25, 0.25, 0.25, 1.0]).tolist(),
            "bsdf": {"type": material, "diffuse_reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.1]}},
        },
        "wall": {
            "type": "rectangle",
            "to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, -0.3], [0, 0, 0, 1]],
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.3]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": [[0.3, 0, 0, 0.6], [0, 0, -0.3, 1.4], [0, 0.3, 0, 0.5], [0, 0, 0, 1]],
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [0.05, 0.04, 0.02]}},
        },
    }
    camera = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
    return make_scene(mitsuba={"inline": shapes}, camera=camera, max_depth=depth)


def image_means(scene, seeds, cols, rows, part):
    """Image mean of the default mode over that of the reference, less one; and its standard error."""
    sensor = hr.load_sensor("reference-bayer").crop(cols, rows)
    pixels = np.arange(cols * rows, dtype=np.uint32)
    runs = []
    for seed in seeds:
        source = ChangeDrivenFlux(scene, sensor, 0.5, seed=seed)
        runs.append(sum(np.array(half, np.float64) for half in source.mean_flux(pixels, 0.0, 1000.0)).mean() / 2)
    unit = source.noise_unit(pixels, np.full(pixels.size, np.mean(runs)), False)
    found = WindowReference(scene, sensor, samples=1024, most_rays=1 << 18).flux(
        [[0, 1000]], pixels, part * unit, seed=5
    )
    mean, error = found.flux.mean(), np.sqrt((found.stderr**2).sum()) / pixels.size
    own = np.std(runs, ddof=1) / np.sqrt(len(runs))
    return np.mean(runs) / mean - 1, float(np.hypot(own, error) / mean)


def assert_right_mean(scene, seeds):
    """Within 0.1 % of Mitsuba's own film, of which both errors together are a third; false alarm 3e-3."""
    off, error = image_means(scene, seeds, 24, 20, 0.1)
    assert error < 1e-3 / 3
    assert abs(off) < 1e-3


@pytest.mark.slow
def test_image_of_a_plastic_ball():
    """Direct light and the lamp's image in the ball: caustics on the wall would be all of the error."""
    assert_right_mean(glossy_ball("plastic", 2), range(40))


@pytest.mark.slow
def test_image_of_a_rough_ball_with_interreflection():
    assert_right_mean(glossy_ball("roughplastic", 4), range(64))
