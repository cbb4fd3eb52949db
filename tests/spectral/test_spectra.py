"""Spectra against closed forms, the lux scale against colour-science's tables, coverage."""

import numpy as np
import pytest
from scipy import constants, integrate

from hesim_render.core.errors import SpecError
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, constant


def test_linear_between_samples_and_zero_outside():
    spectrum = Spectrum([400, 500, 600], [0, 1, 3])
    np.testing.assert_allclose(spectrum.at([399, 400, 450, 550, 600, 600.1]), [0, 0, 0.5, 2, 3, 0])
    assert spectrum.integral() == 50 + 200
    assert spectrum.support_nm == (400, 600)


def test_product_of_ramps_against_the_closed_form():
    # ∫ over [450, 550] of (λ−400)/200 · (600−λ)/200 dλ with u = λ − 500: ∫ (100² − u²)/200² du
    up, down = Spectrum([400, 600], [0, 1]), Spectrum([450, 550], [0.75, 0.25])
    exact = (100**2 * 100 - 2 * 50**3 / 3) / 200**2
    assert spectra.integrate_product(up, down) == pytest.approx(exact, rel=1e-12)


def test_a_sum_has_each_table_where_it_is_known():
    found = spectra.summed(Spectrum([400, 600], [0.2, 0.6]), constant(3.0, 500, 700), constant(0.5, 450, 460))
    np.testing.assert_allclose(found.at([399, 400, 455, 499.9, 500, 600, 601, 700]),
                               [0, 0.2, 0.81, 0.3998, 3.4, 3.6, 3, 3], rtol=1e-9)  # fmt: skip


def test_product_of_tables_against_adaptive_quadrature():
    light, surface = spectra.illuminant("FL11"), list(spectra.colorchecker_reflectances().values())[13]
    low, high = max(light.support_nm[0], surface.support_nm[0]), min(light.support_nm[1], surface.support_nm[1])
    knots = np.union1d(light.wavelength_nm, surface.wavelength_nm)
    exact = sum(
        integrate.fixed_quad(lambda w: light.at(w) * surface.at(w), a, b, n=3)[0]  # exact for a quadratic
        for a, b in zip(knots[:-1], knots[1:], strict=True)
        if a >= low and b <= high
    )
    assert spectra.integrate_product(light, surface) == pytest.approx(exact, rel=1e-12)


def test_merged_grid_holds_all_knots_and_is_fine():
    first, second = Spectrum([400, 433.3, 700], [1, 1, 1]), Spectrum([350, 433.7, 650], [1, 1, 1])
    grid = spectra.merged_grid(first, second)
    assert {400.0, 433.3, 433.7, 650.0} <= set(grid.tolist()) and grid[0] == 400 and grid[-1] == 650
    assert np.diff(grid).max() <= 1 + 1e-9 and np.diff(grid).min() > 0
    assert spectra.merged_grid(constant(1, 400, 500), constant(1, 500, 600)).size == 0
    assert spectra.integrate_product(constant(1, 400, 500), constant(1, 510, 600)) == 0
    with pytest.raises(SpecError, match="do not overlap"):
        spectra.product(constant(1, 400, 500), constant(1, 510, 600))


def test_lux_of_a_line_at_555_nm_is_the_luminous_efficacy():
    # a triangle 2 nm wide with area 1 W/m²: 683.002 lm/W times ∫ V = 0.999973 (mean of V about the peak)
    peak = Spectrum([554, 555, 556], [0, 1, 0])
    assert spectra.illuminance_lux(peak) == pytest.approx(683.002, rel=1e-4)


@pytest.mark.parametrize("name", ["D65", "A", "FL11", "LED-B3", "E"])
def test_scaling_to_lux_and_to_watts(name):
    import colour

    scaled = spectra.scale_to_lux(spectra.illuminant(name), 320.0)
    assert spectra.illuminance_lux(scaled) == pytest.approx(320.0, rel=1e-12)
    # the same with colour-science's own table, summed at 1 nm
    efficiency = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    grid = np.arange(360, 831)
    power = np.interp(grid, scaled.wavelength_nm, scaled.values, left=0, right=0)
    assert constants.value("luminous efficacy") == pytest.approx(683.0, abs=0.01)
    assert 683.002 * np.sum(power * efficiency[grid]) == pytest.approx(320.0, rel=1e-3)
    assert spectra.scale_to_irradiance(spectra.illuminant(name), 2.5).integral() == pytest.approx(2.5, rel=1e-12)


def test_light_without_luminance_has_no_lux():
    with pytest.raises(SpecError, match="no illuminance"):
        spectra.scale_to_lux(constant(1.0, 900, 1000), 100)
    with pytest.raises(SpecError, match="no power"):
        spectra.scale_to_irradiance(constant(0.0), 1)


def test_coverage_is_a_share_of_the_response():
    response = constant(1.0, 400, 780)
    babel = spectra.colorchecker_reflectances("BabelColor Average")["dark skin"]
    assert babel.support_nm[1] == 730
    assert spectra.coverage(babel, response) == pytest.approx(330 / 380, rel=1e-9)
    with pytest.raises(SpecError, match=r"BabelColor covers 380-730 nm, only 86\.84% of the response of mono"):
        spectra.require_coverage(babel, response, "BabelColor", "mono")
    spectra.require_coverage(babel, constant(1.0, 400, 730.3), "BabelColor", "mono")  # 99.9 % is enough
    spectra.require_coverage(spectra.colorchecker_reflectances()["dark skin"], response, "ISO 17321-1", "mono")


def test_colorchecker_has_24_patches_in_chart_order():
    for name in ("ISO 17321-1", "BabelColor Average", "ColorChecker N Ohta"):
        chart = list(spectra.colorchecker_reflectances(name).values())
        assert len(chart) == 24
        # the last row is grey, from white to black
        grey = np.array([patch.at(550) for patch in chart[18:]])
        assert np.all(np.diff(grey) < 0) and grey[0] > 0.85 and grey[-1] < 0.05


def test_unknown_names_list_the_known_ones():
    with pytest.raises(SpecError, match=r"unknown illuminant 'D66'; known are .*'D65'"):
        spectra.illuminant("D66")
    with pytest.raises(SpecError, match="unknown ColorChecker data set"):
        spectra.colorchecker_reflectances("x")
    with pytest.raises(SpecError, match="has no channel 'ir'; it has red, green, blue"):
        spectra.camera_sensitivity("Nikon 5100 (NPL)", "ir")
    assert {"D65", "A", "FL11", "LED-B3"} <= set(spectra.illuminant_names())


@pytest.mark.parametrize(
    ("wavelength", "values", "message"),
    [
        ([400], [1], "at least 2 numbers"),
        ([400, 500], [1, 2, 3], "equally long"),
        ([500, 400], [1, 1], "increase strictly"),
        ([400, 400], [1, 1], "increase strictly"),
        ([400, 500], [1, np.nan], "not finite"),
    ],
)
def test_malformed_tables(wavelength, values, message):
    with pytest.raises(SpecError, match=message):
        Spectrum(wavelength, values)


def test_csv_files(tmp_path):
    file = tmp_path / "s.csv"
    file.write_text("# measured by hand\nwavelength_nm, left, right\n400, 1, 2\n500; 3; 4\n\n600\t5\t6 # last\n")
    np.testing.assert_array_equal(spectra.read_csv(file, "right").values, [2, 4, 6])
    np.testing.assert_array_equal(spectra.read_csv(file, 1).values, [1, 3, 5])
    for column, message in ((None, "2 value columns"), (3, "does not exist"), ("up", "no column 'up'")):
        with pytest.raises(SpecError, match=message):
            spectra.read_csv(file, column)
    for text, message in (
        ("400,1\n500,x\n", r"s\.csv:2: expected numbers"),
        ("400,1\n500\n", r"s\.csv:2: expected 2 columns"),
        ("400,1\n", "at least 2 rows"),
        ("500,1\n400,1\n", "increase strictly"),
    ):
        file.write_text(text)
        with pytest.raises(SpecError, match=message):
            spectra.read_csv(file)
    with pytest.raises(SpecError, match="cannot be read"):
        spectra.read_csv(tmp_path / "nowhere.csv")


def test_spectra_as_files_write_them():
    assert SpectrumSpec.model_validate(0.5).load().at(550) == 0.5
    assert SpectrumSpec.model_validate("D65").load().at(560) == 100
    assert SpectrumSpec.model_validate({"flat": 2, "band_nm": [500, 600], "scale": 3}).load().integral() == 600
    gauss = SpectrumSpec.model_validate({"peak_nm": 550, "fwhm_nm": 40}).load()
    assert gauss.at(570) == pytest.approx(0.5, abs=1e-9)
    assert gauss.integral() == pytest.approx(40 * np.sqrt(np.pi / (4 * np.log(2))), rel=1e-6)
    planck = SpectrumSpec.model_validate({"blackbody_k": 2856}).load()
    ratio = planck.at(700) / planck.at(450)
    h, c, k = constants.h, constants.c, constants.k
    radiance = [(w * 1e-9) ** -5 / np.expm1(h * c / (w * 1e-9 * k * 2856)) for w in (700, 450)]
    assert ratio == pytest.approx(radiance[0] / radiance[1], rel=1e-6)


def test_energy_basis_becomes_electrons_per_photon():
    """A response per watt is e⁻/photon × λ/(hc): dividing by λ and normalising gives the quantum curve."""
    spec = SpectrumSpec.model_validate({"camera": "Nikon 5100 (NPL)", "channel": "green", "basis": "energy"})
    energy, quantum = spectra.camera_sensitivity("Nikon 5100 (NPL)", "green"), spec.load()
    expected = energy.values / energy.wavelength_nm
    np.testing.assert_allclose(quantum.values, expected / expected.max())
    assert quantum.values.max() == 1
