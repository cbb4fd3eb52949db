"""Silicon, dyes and thin films against closed forms and known figures."""

import numpy as np
import pytest

from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.physical import (
    dye_transmittance,
    silicon_index,
    silicon_quantum_efficiency,
    thin_film_transmittance,
)


def test_silicon_absorbs_as_beer_and_lambert_say():
    """Absorption length 1/α = λ/(4πk): 1.57 µm at 550 nm and 5.3 µm at 700 nm; figures of any table of silicon."""
    _, k = silicon_index()
    length_um = {nm: 1e-3 * nm / (4 * np.pi * float(k.at(nm))) for nm in (450, 550, 700, 850)}
    assert length_um[450] == pytest.approx(0.415, abs=0.01) and length_um[850] == pytest.approx(18.7, abs=0.5)
    for depth_um in (0.5, 3.0, 20.0):
        efficiency = silicon_quantum_efficiency(depth_um)
        for nm, length in length_um.items():
            assert float(efficiency.at(nm)) == pytest.approx(1 - np.exp(-depth_um / length), rel=1e-9)
    bare, coated = silicon_quantum_efficiency(3.0, "bare"), silicon_quantum_efficiency(3.0)
    # normal reflectance of silicon in air: 36.7 % at 550 nm
    assert 1 - float(bare.at(550)) / float(coated.at(550)) == pytest.approx(0.367, abs=0.001)


def test_dyes_by_hand():
    spectrum = dye_transmittance([[550, 80, 1.5]], [[650, 5, 3.0], [420, -10, 2.0]])
    for nm in (400, 510, 590, 650, 700):
        absorbance = 1.5 * 2 ** -(((nm - 550) / 40) ** 2)
        absorbance += 3 / (1 + np.exp((650 - nm) / 5)) + 2 / (1 + np.exp((nm - 420) / 10))
        assert float(spectrum.at(nm)) == pytest.approx(10**-absorbance, rel=1e-9)
    # density adds: twice the dye is the square of the transmittance
    twice = dye_transmittance([[550, 80, 3.0]])
    np.testing.assert_allclose(twice.values, dye_transmittance([[550, 80, 1.5]]).values ** 2, rtol=1e-12)


def test_thin_films_have_the_closed_forms_of_quarter_waves():
    """A quarter wave: R = ((n₀ n_s − n₁²)/(n₀ n_s + n₁²))². p pairs and one more: y = (n_H/n_L)^2p n_H²/n_s, R of y."""
    at = 550.0
    grid = np.array([at, at + 1])
    coated = thin_film_transmittance([1.38], [at / 4 / 1.38], substrate_index=1.52, grid_nm=grid)
    expected = ((1.52 - 1.38**2) / (1.52 + 1.38**2)) ** 2
    assert 1 - coated.values[0] == pytest.approx(expected, rel=1e-9)
    high, low, pairs = 2.35, 1.46, 4
    layers = [high, low] * pairs + [high]
    mirror = thin_film_transmittance(layers, [at / 4 / n for n in layers], substrate_index=1.52, grid_nm=grid)
    y = (high / low) ** (2 * pairs) * high**2 / 1.52
    assert mirror.values[0] == pytest.approx(1 - ((1 - y) / (1 + y)) ** 2, rel=1e-9)
    # no film at all, at Brewster's angle: of p light everything, of s light 1 − sin²(2θ − 90°)
    angle = np.degrees(np.arctan(1.52))
    plain = thin_film_transmittance([1.0], [10.0], substrate_index=1.52, angle_deg=angle, grid_nm=grid)
    s_reflected = np.cos(2 * np.radians(angle)) ** 2
    assert plain.values[0] == pytest.approx(1 - s_reflected / 2, rel=1e-9)


def test_files_can_name_them():
    spec = SpectrumSpec.model_validate(
        {
            "product": [
                {"dye": {"bands": [[600, 100, 1.0]]}},
                {"silicon_depth_um": 3},
                {"flat": 0.5, "band_nm": [400, 700]},
            ]
        }
    )
    expected = 0.5 * 10**-1.0 * float(silicon_quantum_efficiency(3.0).at(600))
    assert float(spec.load().at(600)) == pytest.approx(expected, rel=1e-6) and spec.load().support_nm == (400, 700)
    film = SpectrumSpec.model_validate({"thin_film": {"layers": [[1.38, 99.6]], "substrate": 1.52}})
    np.testing.assert_allclose(film.load().values, thin_film_transmittance([1.38], [99.6]).values)
    for bad in (
        {"dye": {"edges": [[500, 0, 1]]}}, {"dye": {"bands": [[500, 40, -1]]}}, {"thin_film": {"layers": []}},
        {"thin_film": {"layers": [[0.5, 10]]}}, {"silicon_depth_um": 0}, {"product": [1.0]},
        {"silicon_depth_um": 3, "flat": 1},
    ):  # fmt: skip
        with pytest.raises(ValueError):
            SpectrumSpec.model_validate(bad)
