"""Dead leaves: the texture that is drawn has the autocovariance of the model."""

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy import integrate

from hesim_render.specs.target import TargetSpec
from hesim_render.targets import resolution
from hesim_render.targets.build import build_target
from hesim_render.targets.resolution import leaves_picture

GREYS = (0.1, 0.7)


def leaves_autocovariance(distance, radius_min, radius_max, greys):
    """Autocovariance of the dead-leaves texture, σ² γ(h)/(2 γ(0) − γ(h)) [cao2010].

    γ(h) is the mean covariogram of a leaf: the area that a disc shares with itself moved by h, averaged over radii.
    Two points have the same grey if the front-most leaf over either of them covers both.

    Parameters
    ----------
    distance : h, in the unit of the radii.
    radius_min, radius_max : limits of the radii, whose density is proportional to r⁻³.
    greys : limits of the uniform law of the greys.
    """
    h = np.asarray(distance, dtype=np.float64)
    # a Gauss rule in ln r, where the density is proportional to r⁻²
    place, weight = np.polynomial.legendre.leggauss(200)
    low, high = np.log(radius_min), np.log(radius_max)
    radius = np.exp((low + high) / 2 + (high - low) / 2 * place)
    share = weight * radius**-2.0
    half = np.clip(h[..., None] / (2 * radius), 0.0, 1.0)
    shared = 2 * radius**2 * (np.arccos(half) - half * np.sqrt(1 - half**2))
    gamma = np.sum(share * shared, axis=-1) / share.sum()
    whole = np.sum(share * np.pi * radius**2) / share.sum()
    return (greys[1] - greys[0]) ** 2 / 12 * gamma / (2 * whole - gamma)


def closed_form(h, low, high):
    """σ² γ(h)/(2 γ(0) − γ(h)), with γ the covariogram of a disc averaged over a density 2 r⁻³/(low⁻² − high⁻²)."""

    def lens(r):
        return 2 * r * r * np.arccos(h / (2 * r)) - h / 2 * np.sqrt(4 * r * r - h * h) if h < 2 * r else 0.0

    def mean(value):
        found, _ = integrate.quad(lambda r: value(r) * 2 * r**-3 / (low**-2 - high**-2), max(low, h / 2), high)
        return found

    def gamma(distance):
        return mean(lens) if distance else 2 * np.pi * np.log(high / low) / (low**-2 - high**-2)

    return (GREYS[1] - GREYS[0]) ** 2 / 12 * gamma(h) / (2 * gamma(0) - gamma(h))


def test_the_closed_form_is_that_of_a_plain_quadrature():
    distance = np.array([0.001, 1.0, 4.0, 9.0, 30.0, 79.0, 81.0])
    expected = [closed_form(h, 2.0, 40.0) if h < 80 else 0.0 for h in distance]
    np.testing.assert_allclose(leaves_autocovariance(distance, 2.0, 40.0, GREYS), expected, rtol=2e-3, atol=1e-7)
    np.testing.assert_allclose(leaves_autocovariance(0.0, 2.0, 40.0, GREYS), 0.6**2 / 12, rtol=1e-9)


def drawn(count, seed, size=160, low=3.0, high=40.0):
    """Autocovariance of each of many independent textures along x and y, about the known mean; [texture, lag]."""
    lags = np.array([0, 2, 5, 10, 20, 40, 70])
    found = []
    for k in range(count):
        field = leaves_picture(size, size, low, high, GREYS, seed + k).astype(float) - 0.4
        across = [np.mean(field[:, : size - lag] * field[:, lag:]) for lag in lags]
        down = [np.mean(field[: size - lag] * field[lag:]) for lag in lags]
        found.append((np.array(across) + down) / 2)
    return lags, np.array(found)


def agrees(lags, found, low=3.0, high=40.0):
    # texels take the leaf over their centre, so there is no blur: points of the picture are points of the model
    expected = np.array([closed_form(h, low, high) for h in lags])
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert np.all(error < 0.06 * expected[0])
    assert np.all(np.abs(found.mean(axis=0) - expected) < 3 * error), (found.mean(axis=0) - expected) / error


def test_the_autocovariance_of_drawn_leaves_is_that_of_the_model():
    agrees(*drawn(30, 100))  # 7 lags within 3 standard errors: false alarm 3 %, with this fixed seed none


@pytest.mark.slow
def test_the_autocovariance_of_many_drawn_leaves_is_that_of_the_model():
    lags, found = drawn(400, 1000)
    agrees(lags, found)
    assert np.all(found.std(axis=0, ddof=1) / 20 < 0.016 * 0.03)


def test_a_target_of_dead_leaves_is_drawn_to_its_size_and_seed():
    content = {"type": "dead-leaves", "width_m": 0.2, "height_m": 0.111, "texels_across": 100, "radius_min_m": 0.004,
               "radius_max_m": 0.02, "seed": 5}  # fmt: skip
    (piece,) = build_target(TypeAdapter(TargetSpec).validate_python(content))
    values = piece.reflectance.values
    assert values.shape == (56, 100, 1)  # rows of 2 mm: the last one stands over by half
    np.testing.assert_allclose(piece.uv[:, 1].min(), 1 - 55.5 / 56, rtol=1e-9)
    assert values.min() >= 0.05 and values.max() <= 0.8 and values.min() < 0.1 and values.max() > 0.75
    np.testing.assert_array_equal(values[..., 0], leaves_picture(56, 100, 2, 10, (0.05, 0.8), 5))
    assert np.any(values[..., 0] != leaves_picture(56, 100, 2, 10, (0.05, 0.8), 6))


def test_leaves_without_sizes_span_a_400th_to_a_tenth_of_20_cm():
    spec = TypeAdapter(TargetSpec).validate_python({"type": "dead-leaves"})
    sizes = [spec.width_m, spec.width_m / spec.radius_min_m, spec.width_m / spec.radius_max_m, spec.texels_across]
    assert sizes == pytest.approx([0.2, 400, 10, 2048])


def test_centres_lie_up_to_a_largest_radius_beyond_every_side(monkeypatch):
    """Else leaves would be rarer at that side."""
    real, asked = np.random.default_rng, []

    class Recorded:
        def __init__(self, seed):
            self.inner = real(seed)

        def random(self, count):
            return self.inner.random(count)

        def uniform(self, low, high, count):
            asked.append((low, high))
            return self.inner.uniform(low, high, count)

    monkeypatch.setattr(np.random, "default_rng", Recorded)
    leaves_picture(12, 30, 2.0, 7.0, GREYS, 3)
    assert asked[:3] == [(-7.0, 37.0), (-7.0, 19.0), GREYS] and len(asked) % 3 == 0


def test_the_front_most_leaf_over_a_texel_is_seen():
    """A loop over leaves and texels, front to back, with the same numbers."""
    rng, rows, cols = np.random.default_rng(3), 12, 30
    expected = np.full((rows, cols), np.nan)
    while np.isnan(expected).any():
        size = resolution._BATCH
        u = rng.random(size)
        radius = 1 / np.sqrt(2.0**-2 - u * (2.0**-2 - 7.0**-2))
        x, y = rng.uniform(-7, cols + 7, size), rng.uniform(-7, rows + 7, size)
        grey = rng.uniform(*GREYS, size)
        for k in range(size):
            for row, col in np.argwhere(np.isnan(expected)):
                if np.hypot(col + 0.5 - x[k], row + 0.5 - y[k]) < radius[k]:
                    expected[row, col] = grey[k]
    np.testing.assert_allclose(leaves_picture(rows, cols, 2.0, 7.0, GREYS, 3), expected, rtol=1e-6)
