"""Helpers of the renderer's tests: scenes from keywords, flux as images, and closed forms written out again."""

import functools

import colour
import numpy as np
from scipy import constants

import hesim_render as hr
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import RenderedFlux, used_responses
from hesim_render.sources.scene import Scene
from hesim_render.specs.scene import SceneSpec

# L = 1 W m⁻² sr⁻¹ nm⁻¹ from everywhere between 300 and 900 nm: E = π · 600 nm
FURNACE = {"type": "uniform", "illuminant": {"flat": 1.0, "band_nm": (300, 900)}, "irradiance_w_m2": np.pi * 600}
D65_1000_LUX = {"type": "uniform", "illuminant": {"illuminant": "D65"}, "illuminance_lux": 1000}


def make_scene(**sections):
    return Scene(SceneSpec.model_validate({"schema_version": 1, "name": "test", "description": "", **sections}))


def flux_image(scene, sensor, samples, seed=5, begin_us=0.0, end_us=1000.0, **options):
    """Both halves, [row, col], and the flux source."""
    source = RenderedFlux(scene, sensor, samples, seed, **options)
    pixels = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)
    halves = source.mean_flux(pixels, begin_us, end_us)
    a, b = (np.array(half, dtype=np.float64).reshape(sensor.rows, sensor.cols) for half in halves)
    return a, b, source


@functools.cache
def d65_irradiance(lux):
    """Wavelength (0.25 nm grid) and E(λ) of D65 at an illuminance, W m⁻² nm⁻¹: 683.002 ∫ E V dλ = lux."""
    table = colour.SDS_ILLUMINANTS["D65"]
    luminous = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    grid = np.arange(360, 830.01, 0.25)
    shape = np.interp(grid, table.wavelengths, table.values)
    v = np.interp(grid, luminous.wavelengths, luminous.values)
    return grid, shape * lux / (683.002 * np.trapezoid(shape * v, grid))


def electrons_per_s(radiance, grid, transmittance, pitch_um, f_number, magnification):
    """Eq. 1 on the axis with fill factor 1: A G ∫ T λ/(hc) L dλ, G = π/(1 + 4N²(1 + m)²)."""
    solid_angle = np.pi / (1 + 4 * f_number**2 * (1 + magnification) ** 2)
    photons = grid * 1e-9 / (constants.h * constants.c)
    return (pitch_um * 1e-6) ** 2 * solid_angle * np.trapezoid(radiance * photons * transmittance, grid)


def mono(cols=64, rows=48, **overrides):
    """`reference-mono` (flat 400-700 nm response, 5 µm, f/4) with a centred region."""
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    return hr.load_sensor("reference-mono", changes).crop(cols, rows)


def mitsuba_scene(shapes, motion=(), depth=3):
    """A scene of Mitsuba's own, from a dictionary, under a camera that sees 0.8 m of the plane z = 0 from 2 m."""
    return make_scene(
        mitsuba={"inline": shapes},
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62},
        motion=list(motion),
        max_depth=depth,
    )


def pair_tracer(scene, sensor, seed=3):
    """What the default mode traces with."""
    return PairTracer(scene, sensor, seed, used_responses(sensor))


def traced(tracer, rays, begin_us=0.0, end_us=1000.0, controlled=False):
    """Every pixel of the region in one window, a `PairFlux`."""
    pixel = tracer.sensor.layout.full_index.ravel()
    window = Windows(np.array([begin_us]), np.array([end_us]))
    count = pixel.size
    return tracer.trace(pixel, np.zeros(count, np.int64), window, np.full(count, rays), np.full(count, controlled))
