"""Colour figures of filter sets against colour-science, published definitions and figures worked out elsewhere."""

import colour
import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, constant
from hesim_render.studies import (
    ColourSamples,
    colour_differences,
    colour_samples,
    filter_quality,
    fit_matrix,
    luther_residual,
    metamerism_index,
    observer,
    reflectance_set,
    vora_value,
)
from hesim_render.studies.colour_error import expanded, to_srgb
from hesim_render.studies.subspace import GRID_NM, rank

NIKON, SIGMA = "Nikon 5100 (NPL)", "Sigma SDMerill (NPL)"
D65 = spectra.illuminant("D65")
PATCHES = list(reflectance_set("colorchecker").values())
MIX = np.array([[0.8, 0.3, -0.1], [0.2, 1.0, 0.4], [-0.5, 0.1, 2.0]])


def samples_of_tables(curves, light, reflectances, functions):
    """Samples from tables on one even grid [wavelength, channel, surface or function], as sums of products."""
    power = np.asarray(light)[:, None]
    seen, observed = power * np.asarray(curves), power * np.asarray(functions)
    surfaces = np.asarray(reflectances).T
    white, white_xyz = seen.sum(axis=0), observed.sum(axis=0)
    return ColourSamples(surfaces @ seen / white, surfaces @ observed / white_xyz[1], white_xyz / white_xyz[1])


def curves(camera):
    """Sensitivities per watt at 400-700/10 nm, straight from colour-science."""
    table = colour.MSDS_CAMERA_SENSITIVITIES[camera]
    return np.column_stack([np.interp(GRID_NM, table.wavelengths, column) for column in table.values.T])


def responses(camera):
    return [spectra.camera_sensitivity(camera, name) for name in ("red", "green", "blue")]


@pytest.mark.parametrize(("camera", "plain", "under_d65"), [
    (NIKON, 0.9306, 0.9236), (SIGMA, 0.8081, 0.8155),
])  # fmt: skip
def test_subspaces_of_measured_cameras(camera, plain, under_d65):
    """Figures of an independent script on the same data (not published ones)."""
    assert vora_value(curves(camera), observer()) == pytest.approx(plain, abs=5e-5)
    assert vora_value(curves(camera), observer(), D65.at(GRID_NM)) == pytest.approx(under_d65, abs=5e-5)
    # each curve's share in the observer's space, by the least-squares fit of it
    fitted = observer() @ np.linalg.pinv(observer()) @ curves(camera)
    expected = np.sum(fitted**2, axis=0) / np.sum(curves(camera) ** 2, axis=0)
    np.testing.assert_allclose(filter_quality(curves(camera), observer()), expected, rtol=1e-10)
    assert 0.78 < expected.min() < expected.max() < 0.98


def test_vora_value_is_the_mean_squared_cosine_of_the_principal_angles():
    """SciPy has these angles between subspaces, by another algorithm."""
    from scipy.linalg import subspace_angles

    expected = np.mean(np.cos(subspace_angles(curves(NIKON), observer())) ** 2)
    assert vora_value(curves(NIKON), observer()) == pytest.approx(expected, rel=1e-12)
    # the space matters, not the curves; an orthogonal space gives 0; a larger one at least as much
    assert vora_value(curves(NIKON) @ MIX, observer()) == pytest.approx(expected, rel=1e-9)
    outside = np.linalg.svd(observer())[0][:, 3:6]
    assert vora_value(outside, observer()) == pytest.approx(0, abs=1e-12)
    assert vora_value(np.column_stack([curves(NIKON), curves(SIGMA)]), observer()) > expected
    # of a plane in the space two of three directions are there
    assert vora_value(observer()[:, :2], observer()) == pytest.approx(2 / 3, abs=1e-12)


def test_luther_residual_is_that_of_least_squares():
    found = luther_residual(curves(NIKON), observer())
    combination = np.linalg.pinv(curves(NIKON)) @ observer()
    off = observer() - curves(NIKON) @ combination
    np.testing.assert_allclose(found.combination, combination, rtol=1e-8)
    assert found.total == pytest.approx(np.linalg.norm(off) / np.linalg.norm(observer()), rel=1e-9)
    each = np.linalg.norm(off, axis=0) / np.linalg.norm(observer(), axis=0)
    np.testing.assert_allclose(found.each, each, rtol=1e-9)
    # with orthonormal functions the squares add up to what the Vora value lacks
    basis = np.linalg.qr(observer())[0]
    assert luther_residual(curves(NIKON), basis).total ** 2 == pytest.approx(1 - vora_value(curves(NIKON), basis))


def test_any_invertible_mix_of_the_observer_is_a_colorimeter():
    mixed = observer() @ MIX
    assert vora_value(mixed, observer()) == pytest.approx(1, abs=1e-12)
    assert vora_value(mixed, observer(), D65.at(GRID_NM)) == pytest.approx(1, abs=1e-12)
    assert luther_residual(mixed, observer()).total < 1e-12
    np.testing.assert_allclose(filter_quality(mixed, observer()), 1, rtol=1e-12)
    functions = spectra.colour_matching_functions()
    camera = [
        Spectrum(
            functions[0].wavelength_nm,
            sum(weight * each.values for weight, each in zip(column, functions, strict=True)),
        )
        for column in np.abs(MIX).T
    ]
    samples = colour_samples(camera, D65, PATCHES)
    for method in ("least_squares_xyz", "least_delta_e_ab"):
        index = metamerism_index(samples, method)
        assert index.value == pytest.approx(100, abs=1e-6) and index.method == method
    assert fit_matrix(samples).max < 1e-6


def test_metamerism_index_of_the_nikon_by_both_methods():
    """At 400-700/10 nm under D65, 89.2 and 91.1 are the figures of an independent script."""
    chart = np.column_stack([each.at(GRID_NM) for each in PATCHES])
    samples = samples_of_tables(curves(NIKON), D65.at(GRID_NM), chart, observer())
    assert metamerism_index(samples, "least_squares_xyz").value == pytest.approx(89.2, abs=0.05)
    assert metamerism_index(samples).value == pytest.approx(91.1, abs=0.05)
    # by hand from colour-science
    found = metamerism_index(samples, "least_squares_xyz")
    xyz, camera = samples.xyz[:18], samples.camera[:18]
    fitted = camera @ np.linalg.lstsq(camera, xyz, rcond=None)[0]
    white = colour.XYZ_to_xy(samples.white_xyz)
    off = colour.delta_E(colour.XYZ_to_Lab(fitted, white), colour.XYZ_to_Lab(xyz, white), method="CIE 1976")
    assert found.mean_delta_e_ab == pytest.approx(off.mean(), rel=1e-9)
    assert found.value == pytest.approx(100 - 5.5 * off.mean(), rel=1e-9)
    # over the whole band at 1 nm it is nearly the same
    fine = colour_samples(responses(NIKON), D65, PATCHES)
    assert metamerism_index(fine).value == pytest.approx(91.1, abs=0.1)


def test_tristimulus_values_are_those_of_colour_science():
    """Integration at 1 nm of spectra that are linear between the points of their tables."""
    samples = colour_samples(responses(NIKON), D65, PATCHES)
    cmfs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    grid = np.arange(360, 831)
    light = colour.SpectralDistribution(D65.at(grid), grid)
    expected = [
        colour.sd_to_XYZ(colour.SpectralDistribution(each.at(grid), grid), cmfs, light, method="Integration") / 100
        for each in PATCHES
    ]
    np.testing.assert_allclose(samples.xyz, expected, rtol=1e-9)
    np.testing.assert_allclose(samples.white_xyz, [0.95047, 1, 1.08883], atol=3e-4)


def test_differences_are_those_of_colour_science():
    samples = colour_samples(responses(SIGMA), spectra.illuminant("A"), PATCHES)
    fit = fit_matrix(samples, "least_squares_xyz")
    white = colour.XYZ_to_xy(samples.white_xyz)
    labs = [colour.XYZ_to_Lab(values, white) for values in (samples.camera @ fit.matrix.T, samples.xyz)]
    expected = colour.delta_E(*labs, method="CIE 2000")
    np.testing.assert_allclose(fit.delta_e, expected, rtol=1e-12)
    assert (fit.mean, fit.max) == (pytest.approx(expected.mean()), pytest.approx(expected.max()))
    assert fit.p95 == pytest.approx(np.percentile(expected, 95))


@pytest.mark.parametrize(("camera", "method"), [
    (NIKON, "least_delta_e_2000"), (NIKON, "least_delta_e_ab"),
    pytest.param(SIGMA, "least_delta_e_2000", marks=pytest.mark.slow),
    pytest.param(SIGMA, "least_delta_e_ab", marks=pytest.mark.slow),
])  # fmt: skip
def test_no_other_search_finds_a_better_matrix(camera, method):
    """Nelder and Mead's from there on, and from the least squares: within 0.2 %."""
    from scipy.optimize import minimize

    samples = colour_samples(responses(camera), D65, PATCHES)
    fit = fit_matrix(samples, method)
    measure = "2000" if method.endswith("2000") else "ab"
    start = fit_matrix(samples, "least_squares_xyz").matrix

    def loss(values):
        return colour_differences(samples, values.reshape(3, 3), measure=measure).mean()

    assert fit.mean < loss(start.ravel())
    for begin in (fit.matrix, start):
        found = minimize(loss, begin.ravel(), method="Nelder-Mead", options={"maxiter": 3000, "adaptive": True})
        assert fit.mean < found.fun * 1.002


def test_root_polynomials_are_those_of_colour_science_and_follow_the_exposure():
    rgb = np.random.default_rng(1).uniform(0.01, 1, (9, 3))
    expected = colour.characterisation.polynomial_expansion_Finlayson2015(rgb, 2, True)
    ours = expanded(rgb, "root_polynomial")
    np.testing.assert_allclose(np.sort(ours, axis=1), np.sort(expected, axis=1), rtol=1e-12)
    np.testing.assert_allclose(expanded(3 * rgb, "root_polynomial"), 3 * ours, rtol=1e-12)
    samples = colour_samples(responses(SIGMA), D65, PATCHES)
    assert fit_matrix(samples, expansion="root_polynomial").mean < fit_matrix(samples).mean


def test_matrices_and_chromatic_adaptation_are_those_of_colour_science():
    samples = colour_samples(responses(SIGMA), spectra.illuminant("A"), PATCHES)
    fit = fit_matrix(samples, "least_squares_xyz").matrix
    theirs = colour.characterisation.matrix_colour_correction_Cheung2004(samples.camera, samples.xyz, terms=3)
    np.testing.assert_allclose(fit, theirs, rtol=1e-9)
    root = fit_matrix(samples, "least_squares_xyz", "root_polynomial").matrix
    theirs = colour.characterisation.matrix_colour_correction_Finlayson2015(samples.camera, samples.xyz, 2, True)
    np.testing.assert_allclose(
        expanded(samples.camera, "root_polynomial") @ root.T,
        colour.characterisation.polynomial_expansion_Finlayson2015(samples.camera, 2, True) @ theirs.T, rtol=1e-7,
    )  # fmt: skip
    # from the white of incandescent light to that of sRGB, Bradford
    expected = colour.XYZ_to_RGB(
        samples.camera @ fit.T, "sRGB", colour.XYZ_to_xy(samples.white_xyz), chromatic_adaptation_transform="Bradford"
    )
    np.testing.assert_allclose(samples.camera @ to_srgb(fit, samples.white_xyz).T, expected, atol=5e-4)
    np.testing.assert_allclose(to_srgb(np.eye(3), samples.white_xyz) @ samples.white_xyz, 1, atol=1e-6)


def test_sets_of_reflectances():
    assert [
        len(reflectance_set(name)) for name in ("colorchecker", "colorchecker-chromatic", "rawtoaces", "cie-tcs")
    ] == [24, 18, 190, 14]
    with pytest.raises(SpecError, match=r"no set of reflectances named 'rawtoace'.*did you mean 'rawtoaces'"):
        reflectance_set("rawtoace")
    tcs = colour.quality.datasets.SDS_TCS["CIE 1995"]["TCS09"]
    np.testing.assert_allclose(reflectance_set("cie-tcs")["TCS09"].at(tcs.wavelengths), tcs.values)
    # tables are held beyond their ends
    first = reflectance_set("rawtoaces")["patch1"]
    assert first.support_nm == (360, 830) and first.at(365) == first.at(380)


def test_bad_sets_are_one_clear_line():
    two = responses(NIKON)[:2]
    samples = colour_samples([*two, two[0].scaled(0.5)], D65, PATCHES)
    assert rank(samples.camera) == 2
    with pytest.raises(SpecError, match=r"see these surfaces in 2 of the 3 dimensions"):
        fit_matrix(samples)
    with pytest.raises(SpecError, match=r"the light covers 420-700 nm"):
        colour_samples(responses(NIKON), constant(1.0, 420, 700), PATCHES)
    with pytest.raises(SpecError, match=r"the reflectances cover 420-700 nm"):
        colour_samples(responses(NIKON), D65, [constant(0.5, 420, 700)])
    with pytest.raises(SpecError, match="set of reflectances is empty"):
        colour_samples(responses(NIKON), D65, [])
    with pytest.raises(RangeError, match="method is 'best'"):
        fit_matrix(samples, "best")
    with pytest.raises(RangeError, match="expansion is 'cubic'"):
        fit_matrix(samples, expansion="cubic")
    few = ColourSamples(samples.camera[:2] * [[1, 2, 3], [3, 1, 2]], samples.xyz[:2], samples.white_xyz)
    with pytest.raises((RangeError, SpecError)):
        fit_matrix(few)
    with pytest.raises(RangeError, match="18 chromatic patches"):
        metamerism_index(ColourSamples(samples.camera[:17], samples.xyz[:17], samples.white_xyz))
    with pytest.raises(RangeError, match="31 wavelengths"):
        vora_value(curves(NIKON)[:-1], observer())
    with pytest.raises(RangeError, match="light is"):
        vora_value(curves(NIKON), observer(), np.ones(3))
    with pytest.raises(RangeError, match="column of zeros"):
        vora_value(curves(NIKON) * [1, 0, 1], observer())


def test_responses_of_a_sensor_are_per_watt():
    """`Sensor.responses` of the Nikon's curves have the Vora value of the curves themselves: nothing is per photon."""
    sensor = hr.load_sensor("reference-bayer")
    table = np.column_stack(list(sensor.spectral_response(GRID_NM).values()))
    assert vora_value(table, observer()) == pytest.approx(0.9306, abs=2e-3)
