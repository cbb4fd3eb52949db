"""Point-spread functions: offsets of rays against closed forms of their laws, and what pictures have of them."""

import numpy as np
import pytest
import rendering
from scipy import optimize, special, stats

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.blur import AiryBlur, GaussianBlur, KernelBlur, airy_radii
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

RAYS = 400_000


def uniform(count, seed, pairs=1):
    numbers = np.random.default_rng(seed).random((2 * pairs + 1, count)).astype(np.float32)
    types = jit()
    return [from_host(types.Float, np.minimum(values, np.float32(1 - 2**-24))) for values in numbers]


def place_of(col, row, count):
    types = jit()
    return from_host(types.Float, np.full(count, col, np.float32)), from_host(
        types.Float, np.full(count, row, np.float32)
    )


def test_an_airy_pattern_has_the_mtf_of_a_round_aperture():
    """2/π (acos ν − ν √(1 − ν²)) with ν = f λ N (1 + |m|); z of the mean of a cosine, false alarm 1e-4 in all."""
    sensor = rendering.mono(lens__diffraction=True, lens__f_number=11.0, lens__magnification=0.25)
    u = uniform(RAYS, 3)
    cutoff = 1 / (550e-3 * 11 * 1.25 / 5.0)  # cycles per pixel of 5 µm
    x, y = (np.array(v, np.float64) for v in AiryBlur(sensor).offset((u[0], u[1]), jit().Float(550.0)))
    shares = np.array([0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.1])
    for share in shares:
        nu = min(share, 1.0)
        expected = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
        wave = np.cos(2 * np.pi * share * cutoff * (x * 0.6 + y * 0.8))
        z = (wave.mean() - expected) / (wave.std() / np.sqrt(RAYS))
        assert abs(z) < stats.norm.isf(0.5e-4 / shares.size), share
    # the light within a radius, far out as well
    for ring in (1.0, 3.8317, 20.0, 3000.0):
        radius = ring / np.pi * 550e-3 * 11 * 1.25 / 5.0
        inside = np.mean(np.hypot(x, y) < radius)
        expected = 1 - special.j0(ring) ** 2 - special.j1(ring) ** 2
        assert abs(inside - expected) < 5 * np.sqrt(expected * (1 - expected) / RAYS) + 2e-6, ring


def test_radii_of_an_airy_pattern_rise():
    assert np.all(np.diff(airy_radii()) > 0)
    for part in (0.1, 0.5, 0.8):
        ring = optimize.brentq(lambda x, part=part: 1 - special.j0(x) ** 2 - special.j1(x) ** 2 - part, 0.01, 3.8)
        np.testing.assert_allclose(np.interp(part, np.arange(1 << 14) / (1 << 14), airy_radii()), ring, rtol=1e-4)


@pytest.mark.parametrize("name", ["Gaussian", "Airy"])
def test_even_numbers_go_once_around_the_chief_ray(name):
    """What is even in the unit square stays so: 40 turns a fortieth apart, and Box and Muller's radius."""
    types = jit()
    parts = (np.arange(40) + 0.5) / 40
    numbers = from_host(types.Float, np.full(40, 0.3, np.float32)), from_host(types.Float, parts)
    if name == "Airy":
        x, y = AiryBlur(rendering.mono(lens__diffraction=True)).offset(numbers, types.Float(500.0))
    else:
        x, y = GaussianBlur(rendering.mono(lens__psf_fwhm_um=7.3)).offset(numbers, None)
        radius = 7.3 / np.sqrt(8 * np.log(2)) / 5.0 * np.sqrt(-2 * np.log(0.7))
        np.testing.assert_allclose(np.hypot(x, y), radius, rtol=1e-5)
    turns = np.mod(np.arctan2(y, x) / (2 * np.pi), 1)
    np.testing.assert_allclose(turns, parts, atol=1e-5)


@pytest.mark.parametrize(("height_mm", "fwhm_um"), [(0.0, 4.0), (0.5, 7.0), (1.0, 10.0), (3.0, 10.0)])
def test_a_gaussian_follows_the_image_height(height_mm, fwhm_um):
    told = {"type": "gaussian", "image_height_mm": [0, 1.0], "fwhm_um": [4, 10]}
    sensor = rendering.mono(lens__psf=told)
    u = uniform(RAYS, 4)
    # heights along a diagonal from the middle of 1024×1024 pixels
    away = height_mm / 5e-3 / np.sqrt(2)
    x, y = GaussianBlur(sensor).offset((u[0], u[1]), place_of(511.5 + away, 511.5 - away, RAYS))
    sigma = fwhm_um / np.sqrt(8 * np.log(2)) / 5.0
    for values in (np.array(x, np.float64), np.array(y, np.float64)):
        assert abs(values.mean()) < 4.5 * sigma / np.sqrt(RAYS)
        assert abs(values.std() / sigma - 1) < 4.5 / np.sqrt(2 * RAYS) + 2e-3  # the table of heights is even


def kernels():
    """A lopsided kernel on the axis, and one dot beside the chief ray 1 mm away."""
    first, second = np.zeros((2, 5, 7))
    first[0, 0], first[2, 3], first[4, 5] = 0.2, 0.5, 0.3
    second[2, 6] = 1.0
    return np.stack([first, second])


def test_98_of_100_rays_end_within_the_reach_of_a_psf():
    """A Gaussian, one whose width follows the height, at its widest, and a kernel that is that Gaussian, in steps of a
    tenth of a pixel."""
    u, sigma_px = uniform(RAYS, 8), 9.4 / np.sqrt(8 * np.log(2)) / 5.0
    side = np.arange(-40, 41) * 0.5 / 5.0
    bell = np.exp(-(side[:, None] ** 2 + side**2) / (2 * sigma_px**2))
    bell /= bell.sum()
    psfs = (
        {"lens__psf_fwhm_um": 9.4},
        {"lens__psf": {"type": "gaussian", "image_height_mm": [0, 1.0], "fwhm_um": [4.1, 9.4]}},
        {"lens__psf": {"type": "measured", "kernels": [bell.tolist()], "sample_um": 0.5, "image_height_mm": [0.0]}},
    )
    for told, law in zip(psfs, (GaussianBlur, GaussianBlur, KernelBlur), strict=True):
        blur = law(rendering.mono(**told))
        place = place_of(511.5 + 260, 511.5, RAYS)
        numbers = (u[0], u[1]) if law is GaussianBlur else ((u[0], u[1]), u[2])
        x, y = (np.array(values, np.float64) for values in blur.offset(numbers, place))
        error = np.sqrt(0.98 * 0.02 / RAYS)
        # a kernel's cells have a size: half a step of its radius holds 0.2 %
        assert abs(np.mean(np.hypot(x, y) <= blur.reach_px) - 0.98) < 5 * error + (0 if law is GaussianBlur else 2e-3)


def test_a_measured_psf_is_turned_about_the_axis_and_interpolated_over_the_height():
    told = {"type": "measured", "kernels": kernels().tolist(), "sample_um": 2.5, "image_height_mm": [0.0, 1.0]}
    sensor = rendering.mono(lens__psf=told)
    blur = KernelBlur(sensor)
    u = uniform(RAYS, 5)

    def drawn(col, row):
        x, y = blur.offset(((u[0], u[1]), u[2]), place_of(col, row, RAYS))
        return np.array(x, np.float64), np.array(y, np.float64)

    # to the right of the axis, 0.25 mm: three quarters of the first kernel, one of the second
    x, y = drawn(511.5 + 50, 511.5)
    wanted = 0.75 * kernels()[0] + 0.25 * kernels()[1]
    # a pixel collects light from the opposite side
    counts, _, _ = np.histogram2d(-y, -x, bins=[np.arange(6) * 0.5 - 1.25, np.arange(8) * 0.5 - 1.75])
    expected = wanted * RAYS
    some = expected > 0
    assert counts[~some].sum() == 0 and counts.sum() == RAYS
    # heights are tabulated: the share of the second kernel is right to 1e-3
    assert np.all(np.abs(counts - expected)[some] < 5 * np.sqrt(expected[some]) + 1e-3 * RAYS)
    # uniform within a square of the kernel
    inside = (np.abs(-y + 1.0) < 0.25) & (np.abs(-x + 1.5) < 0.25)
    for values in (-y[inside] + 1.0, -x[inside] + 1.5):
        assert abs(values.std() * np.sqrt(12) / 0.5 - 1) < 0.01
    # one dot 3 squares outwards, far out in four directions
    for turn in np.radians([0, 90, 200, 315]):
        x, y = drawn(511.5 + 300 * np.cos(turn), 511.5 + 300 * np.sin(turn))
        np.testing.assert_allclose([x.mean(), y.mean()], [-1.5 * np.cos(turn), -1.5 * np.sin(turn)], atol=0.005)


def test_a_lopsided_kernel_is_seen_as_it_was_measured():
    """A point of light in the picture has the kernel's shape, not its mirror image."""
    kernel = np.zeros((3, 9))
    kernel[1, 4], kernel[1, 8] = 0.5, 0.5  # the second image is 4 px to the right
    told = {"type": "measured", "kernels": [kernel.tolist()], "sample_um": 5.0}
    scene = rendering.make_scene(
        objects=[
            {"name": "dot", "shape": "rectangle", "size_m": [0.012, 0.012, 0], "position_m": [0, 0, 0.001],
             "reflectance": 1.0},
            {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "reflectance": 0.0},
        ],
        light=rendering.FURNACE, camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": 6},
    )  # fmt: skip
    plain, _, _ = rendering.flux_image(scene, rendering.mono(64, 48), 128)
    a, _, _ = rendering.flux_image(scene, rendering.mono(64, 48, lens__psf=told), 512)
    col = np.arange(64) - 31.5
    shift = (a.sum(axis=0) * col).sum() / a.sum() - (plain.sum(axis=0) * col).sum() / plain.sum()
    assert abs(shift - 2.0) < 0.06
    assert a.sum() == pytest.approx(plain.sum(), rel=0.02)


@pytest.mark.slow
def test_the_skirts_of_a_measured_psf_change_with_what_moves_far_away():
    """A lamp 12 px away: 3 % of its light lies in a ring of the kernel, which few of a pixel's rays meet."""
    y, x = np.mgrid[-15:16, -15:16]
    ring = (np.abs(np.hypot(x, y) - 12) < 2).astype(float)
    kernel = 0.03 * ring / ring.sum()
    kernel[15, 15] += 0.97
    told = {"type": "measured", "kernels": [kernel.tolist()], "sample_um": 5.0}
    ends = [{"t_us": 0}, {"t_us": 10_000, "translation_m": [0.015, 0, 0]}]
    scene = rendering.make_scene(
        objects=[
            {"name": "spark", "shape": "sphere", "size_m": [0.004] * 3, "position_m": [-0.01, 0, 0.01],
             "reflectance": 1.0},
            {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "reflectance": 0.002},
        ],
        light={"type": "directional", "illuminance_lux": 10_000, "direction": (0, 0, -1)},
        motion=[{"object": "spark", "keyframes": ends}], camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": 6},
    )  # fmt: skip
    sensor, pixels = rendering.mono(64, 48, lens__psf=told), np.arange(64 * 48, dtype=np.uint32)
    wanted, shares = [], []
    for t_us in (1_000.0, 9_000.0):
        a, b, _ = rendering.flux_image(scene, sensor, 1024, 9, t_us, t_us + 10)
        wanted.append(((a + b) / 2).ravel())
    expected = wanted[1] - wanted[0]
    skirt = np.abs(expected) < 0.02 * np.abs(expected).max()
    # one ray in thousands meets the lamp, so that a single seed is off by a quarter
    for seed in range(1, 9):
        flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=seed)
        assert not flux.still_pixels(pixels).any()
        means = [sum(np.array(half) for half in flux.mean_flux(pixels, t, t + 10)) / 2 for t in (1_000.0, 9_000.0)]
        found = means[1] - means[0]
        shares.append(np.sum((found * np.sign(expected))[skirt]) / np.sum(np.abs(expected)[skirt]))
    # noise of the expected values makes their sum a little larger
    assert skirt.sum() > 1000 and 0.7 < np.mean(shares) < 1.1
