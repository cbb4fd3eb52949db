"""e-SFR on edges with a known response: analytic ones, and rendered ones."""

import numpy as np
import pytest
from scipy.special import erf

from hesim_render.core.errors import RangeError
from hesim_render.measure import edge_response
from hesim_render.measure.slanted_edge import EdgeResponse, _half_width

FREQUENCY = np.linspace(0, 0.5, 51)


def blurred_step(t, angle_deg, sigma_px):
    """Mean over a square pixel of a step with Gaussian blur, at a distance t of the pixel's centre from the edge.

    Exact in closed form: across the edge the pixel is the convolution of two boxes of widths |cos a| and |sin a|, so
    the mean is the second difference of F, the second integral of the blurred step Q: F'' = Q.
    """
    a = np.radians(angle_deg)
    c, s = abs(np.cos(a)), max(abs(np.sin(a)), 1e-4)

    def second_integral(u):
        if sigma_px == 0:
            return np.maximum(u, 0) ** 2 / 2
        z = u / sigma_px
        density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        return sigma_px**2 / 2 * ((z**2 + 1) * (1 + erf(z / np.sqrt(2))) / 2 + z * density)

    ends = [(1, c / 2 + s / 2), (-1, c / 2 - s / 2), (-1, s / 2 - c / 2), (1, -c / 2 - s / 2)]
    return sum(sign * second_integral(t + end) for sign, end in ends) / (c * s)


def edge_image(rows, cols, angle_deg, sigma_px, offset_px=0.0):
    """Edge through the middle (plus an offset along its normal), leaning clockwise, light on the right."""
    a = np.radians(angle_deg)
    row, col = np.mgrid[:rows, :cols]
    t = (col - (cols - 1) / 2) * np.cos(a) + (row - (rows - 1) / 2) * np.sin(a) - offset_px
    return blurred_step(t, angle_deg, sigma_px)


def closed_form(frequency, angle_deg, sigma_px):
    """Pixel box seen along the normal, times the Gaussian."""
    a = np.radians(angle_deg)
    box = np.sinc(frequency * np.cos(a)) * np.sinc(frequency * np.sin(a))
    return np.abs(box) * np.exp(-2 * (np.pi * sigma_px * frequency) ** 2)


def test_the_analytic_edge_is_that_of_fine_sampling():
    """The closed form above against a pixel cut into 200 × 200 parts."""
    for sigma in (0.0, 0.6):
        for angle in (5.0, -38.0, 85.0):
            a, fine = np.radians(angle), (np.arange(200) + 0.5) / 200 - 0.5
            for t in (-0.4, 0.05, 0.9):
                u = t + fine[:, None] * np.cos(a) + fine[None, :] * np.sin(a)
                expected = np.mean(u > 0) if sigma == 0 else np.mean((1 + erf(u / sigma / np.sqrt(2))) / 2)
                assert abs(blurred_step(np.array(t), angle, sigma) - expected) < 2e-3


@pytest.mark.parametrize("sigma_px", [0.0, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("angle_deg", [2.0, 5.0, 9.0, -5.0, 21.0, 84.0, -85.0])
def test_analytic_edges_have_their_response_up_to_nyquist(angle_deg, sigma_px):
    for rows, cols, offset in ((100, 60, 0.0), (80, 80, 1.37), (61, 60, -0.73)):
        if abs(angle_deg) > 45:
            rows, cols = cols, rows
        values = 100 + 50 * edge_image(rows, cols, angle_deg, sigma_px, offset)
        found = edge_response(values, frequency_cy_per_px=FREQUENCY)
        np.testing.assert_allclose(found.mtf, closed_form(FREQUENCY, angle_deg, sigma_px), atol=0.005)
        assert found.mtf[0] == pytest.approx(1, abs=1e-9) and abs(found.angle_deg - angle_deg) < 0.02


def test_the_light_side_and_the_unit_do_not_matter():
    values = edge_image(80, 60, 5.0, 0.5)
    one = edge_response(values)
    for other in (7 - 3 * values, values[:, ::-1], values[::-1] * 1e4):
        found = edge_response(other)
        np.testing.assert_allclose(found.mtf[:51], one.mtf[:51], atol=2e-3)
        assert np.diff(found.edge_spread[[0, -1]]) > 0  # distance runs to the light side
    assert edge_response(values[:, ::-1]).angle_deg == pytest.approx(-5, abs=0.01)


def test_pixels_of_one_filter_are_enough():
    values = edge_image(160, 120, 5.0, 0.7)
    row, col = np.mgrid[:160, :120]
    red = (row % 2 == 0) & (col % 2 == 1)
    found = edge_response(np.where(red, values, np.nan), frequency_cy_per_px=FREQUENCY)
    np.testing.assert_allclose(found.mtf, closed_form(FREQUENCY, 5.0, 0.7), atol=0.005)
    same = edge_response(np.where(red, values, 17.0), red, frequency_cy_per_px=FREQUENCY)
    np.testing.assert_array_equal(same.mtf, found.mtf)


def test_noise_scatters_the_response_as_its_size_and_finds_the_same_edge():
    """σ = 2 % of the step: the mean of 20 trials is that of the noise-free edge, with its own scatter."""
    generator = np.random.default_rng(4)
    values = edge_image(200, 60, 5.0, 0.5)
    found = [edge_response(values + generator.normal(0, 0.02, values.shape)).mtf[:51] for _ in range(20)]
    error = np.std(found, axis=0, ddof=1) / np.sqrt(20)
    assert error[1:].max() < 0.01
    # a modulus grows by σ²/2|H|: at most 20 · 0.01² / (2 · 0.17) = 0.006 at the end
    assert np.all(np.abs(np.mean(found, axis=0) - closed_form(FREQUENCY, 5.0, 0.5)) < 4 * error + 0.011)


def test_frequency_at_a_level_lies_between_those_of_the_response():
    found = edge_response(edge_image(80, 60, 5.0, 0.5))
    fine = np.linspace(0.2, 0.5, 30001)
    expected = fine[np.argmin(np.abs(closed_form(fine, 5.0, 0.5) - 0.5))]
    assert abs(found.frequency_at(0.5) - expected) < 0.002
    assert np.isnan(edge_response(edge_image(80, 60, 5.0, 0.5), frequency_cy_per_px=[0, 0.1]).frequency_at(0.5))


def test_frequency_at_a_level_is_that_of_the_first_crossing():
    response = EdgeResponse(
        np.array([0, 0.1, 0.25, 0.4, 0.5]), np.array([1, 0.8, 0.6, 0.3, 0.1]), 5.0, np.zeros(1), np.zeros(1)
    )
    levels = {0.9: 0.05, 0.5: 0.3, 0.3: 0.4, 0.2: 0.45}
    assert [response.frequency_at(level) for level in levels] == pytest.approx(list(levels.values()))
    assert np.isnan(response.frequency_at(0.05)) and np.isnan(response.frequency_at(1.5))


@pytest.mark.parametrize("shape", [(31, 44), (52, 27)])
@pytest.mark.parametrize("angle_deg", [4.0, 38.0, 81.0, 113.0, 172.0, -66.0])
def test_the_strip_ends_at_the_corner_next_to_the_edge(shape, angle_deg):
    """Lines at a smaller distance end at the same two sides as the edge, between pixels of the region."""
    a, distance = np.radians(angle_deg), 0.9
    corners = np.array([(y, x) for y in (0, shape[0] - 1) for x in (0, shape[1] - 1)]) - (np.array(shape) - 1) / 2
    away = np.abs(corners @ [np.sin(a), np.cos(a)] - distance)
    if away.min() < 4:
        with pytest.raises(RangeError, match=f"values: {away.min():.2f}"):
            _half_width(shape, a, distance)
    else:
        assert _half_width(shape, a, distance) == pytest.approx(away.min(), rel=1e-12)


WRONG = {
    "flat": (np.full((40, 40), 3.0), {}, "one level only"),
    "noise": (np.random.default_rng(0).normal(size=(40, 40)), {}, "none was found"),
    "few": (np.zeros((4, 4)), {}, "at least 64 pixels"),
    "upright": (edge_image(80, 60, 0.0, 0.5), {}, "turned some degrees from rows"),
    "diagonal": (edge_image(60, 80, 45.0, 0.5), {"oversampling": 8}, "turned some degrees from rows"),
    "at the side": (edge_image(60, 60, 5.0, 0.5, 25.0), {}, "4 px or more of the region on both sides"),
    "frequency": (edge_image(60, 60, 5.0, 0.5), {"frequency_cy_per_px": [0, 3]}, "oversampling / 2"),
    "colour": (np.zeros((40, 40, 3)), {}, "an array [row, col]"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_what_cannot_be_measured_is_refused(mistake):
    values, options, told = WRONG[mistake]
    with pytest.raises(RangeError) as caught:
        edge_response(values, **options)
    assert told in str(caught.value)
