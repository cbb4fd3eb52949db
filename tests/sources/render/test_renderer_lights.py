"""Each light gives the asked-for level on its plane: form factor against quadrature, rendered card against E."""

import numpy as np
import pytest
from rendering import d65_irradiance, make_scene
from scipy import integrate

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render import render_cube
from hesim_render.sources.render.scene.lights import (
    area_light_frame,
    form_factor_integral,
    geometry_on_plane,
    irradiance,
)
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, spectrum_dict
from hesim_render.specs.scene import LightSpec
from hesim_render.spectral.spectrum import Spectrum, summed

AREA = {"type": "area", "illuminance_lux": 800, "position_m": (0.5, 1.2, 0.8), "size_m": (0.6, 0.9)}
LIGHTS = {
    "uniform": {"type": "uniform", "illuminance_lux": 800},
    "point": {"type": "point", "illuminance_lux": 800, "position_m": (0.4, 0.3, 0.5)},
    "directional": {"type": "directional", "illuminance_lux": 800, "direction": (1, -2, -1.5)},
    "area": AREA,
}


def test_polygon_form_factor_equals_quadrature_over_the_light():
    rng = np.random.default_rng(4)
    for _ in range(5):
        light = LightSpec.model_validate(
            {
                **AREA,
                "position_m": tuple(rng.uniform(0.3, 1.0, 3)),
                "size_m": tuple(rng.uniform(0.2, 0.5, 2)),
                "plane_point_m": tuple(rng.uniform(-0.3, 0, 3)),
            }
        )
        normal = np.array([0.3, 0.5, 0.9])
        normal /= np.linalg.norm(normal)
        frame = area_light_frame(light)
        point = np.array(light.plane_point_m)

        def integrand(u, v, frame=frame, point=point, normal=normal):
            ray = frame[:3, 3] + u * frame[:3, 0] + v * frame[:3, 1] - point
            distance = np.linalg.norm(ray)
            jacobian = np.linalg.norm(frame[:3, 0]) * np.linalg.norm(frame[:3, 1])
            return max(ray @ normal, 0) * max(-ray @ frame[:3, 2], 0) / distance**4 * jacobian

        expected, _ = integrate.dblquad(integrand, -1, 1, -1, 1, epsabs=1e-10)
        corners = frame[:3, 3] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ frame[:3, :2].T
        np.testing.assert_allclose(form_factor_integral(corners, point, normal), expected, rtol=1e-7)


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_lights_of_unit_strength_on_a_plane_that_is_nowhere_near_the_origin(kind):
    """cos θ/d² of a point, cos θ of a beam, at (0.1, −0.2, 0.05) with a tilted normal."""
    normal = np.array([0.2, 0.5, 0.9])
    plane = {"plane_point_m": (0.1, -0.2, 0.05), "plane_normal": tuple(normal)}
    away = np.array([0.4 - 0.1, 0.3 + 0.2, 0.5 - 0.05]) if kind == "point" else np.array([-1, 2, 1.5])
    cosine = away @ normal / np.linalg.norm(away) / np.linalg.norm(normal)
    found = geometry_on_plane(LightSpec.model_validate(LIGHTS[kind] | plane), "light")
    assert found == pytest.approx(cosine / (away @ away) if kind == "point" else cosine)


def test_polygon_below_the_horizon_does_not_count():
    # a square of 1 m that stands on the plane with its lower half below it, 1 m away
    def square(low):
        return np.array([[-0.5, 1, low], [0.5, 1, low], [0.5, 1, 0.5], [-0.5, 1, 0.5]])

    normal = np.array([0.0, 0.0, 1.0])
    half = form_factor_integral(square(0.0), np.zeros(3), normal)
    np.testing.assert_allclose(form_factor_integral(square(-0.5), np.zeros(3), normal), half, rtol=1e-12)
    # a whole hemisphere is π: a huge square close above the point
    wide = np.array([[-1e4, -1e4, 1], [1e4, -1e4, 1], [1e4, 1e4, 1], [-1e4, 1e4, 1]])
    np.testing.assert_allclose(form_factor_integral(wide, np.zeros(3), normal), np.pi, rtol=1e-6)
    assert form_factor_integral(wide - [0, 0, 2], np.zeros(3), normal) == 0


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if kind != "area" else ()) for kind in LIGHTS]
)
def test_a_card_at_the_plane_point_is_lit_as_asked(kind):
    # a 1 mm card there: L = ρ E / π at any wavelength
    scene = make_scene(
        target={"type": "flat", "width_m": 1e-3, "height_m": 1e-3, "reflectance": {"flat": 0.5}},
        light=LIGHTS[kind],
        camera={"fit": "target", "fit_margin": 1.2},
    )
    bands = np.array([450.0, 555.0, 640.0])
    wavelength, radiance, stderr = render_cube(scene, (8, 8), bands, 1024)
    np.testing.assert_array_equal(wavelength, bands)
    grid, irradiance_800 = d65_irradiance(800)
    expected = 0.5 * np.interp(bands, grid, irradiance_800) / np.pi
    error = np.sqrt((stderr.astype(float) ** 2).sum(axis=(0, 1))) / 64
    assert np.all(error / expected < 1e-3)
    # 4.4 σ (false alarm 1e-5 each), and 2e-5 for the card's finite size and single precision
    assert np.all(np.abs(radiance.mean(axis=(0, 1)) - expected) < 4.4 * error + 2e-5 * expected)


def test_an_evenly_spaced_spectrum_is_the_same_looked_up_faster():
    mi = mitsuba()
    rng = np.random.default_rng(2)
    grids = (np.arange(360.0, 831.0, 5.0), np.linspace(380.123, 729.77, 301), np.array([300.0, 1100.0]))
    for grid in grids:
        spectrum = Spectrum(grid, rng.uniform(0, 3, grid.size))
        quick = spectrum_dict(spectrum)
        assert quick["type"] == "regular"
        numbers = [",".join(f"{v:.9g}" for v in array) for array in (spectrum.wavelength_nm, spectrum.values)]
        slow = {"type": "irregular", "wavelengths": numbers[0], "values": numbers[1]}
        inside = rng.uniform(*spectrum.support_nm, 4000)
        outside = np.concatenate([rng.uniform(200, grid[0] - 0.01, 200), rng.uniform(grid[-1] + 0.01, 1300, 200)])
        seen = []
        for plugin in (quick, slow):
            texture = mi.load_dict(plugin)
            si = mi.SurfaceInteraction3f()
            values = []
            for wavelengths in (inside, outside):
                si.wavelengths = mi.UnpolarizedSpectrum(from_host(mi.Float, wavelengths))
                values.append(np.array(texture.eval(si))[0])
            assert np.all(values[1] == 0)
            seen.append(values[0])
        np.testing.assert_allclose(seen[0], seen[1], atol=5e-5 * grid.size / 100 * 3)
        np.testing.assert_allclose(seen[0], spectrum.at(inside), atol=5e-5 * grid.size / 100 * 3)
    uneven = Spectrum(np.array([400.0, 500.0, 601.0]), np.ones(3))
    assert spectrum_dict(uneven)["type"] == "irregular"
    assert spectrum_dict(uneven.scaled(0)) == spectrum_dict(Spectrum(np.array([400.0, 700.0]), np.zeros(2)))


def test_summed_spectra_end_each_where_their_table_does():
    first, second = (
        Spectrum(np.array([400.0, 600.0]), np.array([1.0, 2.0])),
        Spectrum(np.array([500.0, 700.0]), np.ones(2)),
    )
    total = summed(first, second)
    assert total.support_nm == (400.0, 700.0)
    for wavelength in (400.0, 450.0, 499.99, 500.0, 550.0, 600.0, 600.01, 650.0, 700.0):
        np.testing.assert_allclose(total.at(wavelength), first.at(wavelength) + second.at(wavelength), rtol=1e-12)
    np.testing.assert_allclose(total.integral(), first.integral() + second.integral(), rtol=1e-5)


def test_level_in_watts_is_the_integral_over_the_table():
    light = LightSpec.model_validate(
        {"type": "uniform", "illuminant": {"flat": 1, "band_nm": (400, 800)}, "irradiance_w_m2": 20}
    )
    np.testing.assert_allclose(irradiance(light).values, 20 / 400)


def test_a_light_behind_its_plane_or_without_direction_is_an_error(tmp_path):
    shots = {
        "point": {"position_m": [0, 0, -1]},
        "area": {"position_m": [0, 0, -1], "size_m": [1, 1]},
        "directional": {"direction": [0, 0, 1]},
    }
    for kind, extra in shots.items():
        scene = hr.load_scene("flat-field", {"light": {"type": kind, "illuminance_lux": 100, **extra}})
        with pytest.raises(SpecError, match=r"flat-field\.yaml: light: the light does not reach"):
            render_cube(scene, (4, 4), [550], 2)
    for light, message in (
        ({"type": "point", "illuminance_lux": 1}, "needs position_m"),
        ({"type": "uniform", "illuminance_lux": 1, "size_m": [1, 1]}, "has no size_m"),
        ({"type": "uniform"}, "exactly one of"),
        ({"type": "uniform", "illuminance_lux": 1, "irradiance_w_m2": 1}, "exactly one of"),
        ({"type": "directional", "illuminance_lux": 1, "direction": [0, 0, 0]}, "zero vector"),
        ({"type": "none", "illuminance_lux": 1}, "no level"),
        ({"type": "uniform", "illuminance_lux": -1}, "greater than or equal to 0"),
        ({"type": "uniform", "illuminance_lux": 1, "illuminant": {"flat": -1}}, "negative"),
    ):
        with pytest.raises(SpecError, match=message):
            hr.load_scene("flat-field", {"light": light})
