"""Colours of a rendered ColorChecker after the ISP, against its measured reflectances."""

import colour as colour_science
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hesim_render as hr
from hesim_render.core.errors import RangeError
from hesim_render.isp import Camera, Pipeline, chart, colour, develop
from hesim_render.spectral import spectrum as spectra

ROWS, COLS = 192, 288


@pytest.mark.filterwarnings("ignore:Aligning")
@pytest.mark.parametrize("light", [pytest.param("D65", marks=pytest.mark.slow), "A"])
def test_rendered_chart_comes_out_within_two_delta_e(light):
    sensor = hr.load_sensor("reference-bayer").crop(COLS, ROWS)
    scene = hr.load_scene("colorchecker", {"light.illuminant": light})
    recording = hr.simulate(scene, sensor, duration_s=0.011, seed=7)
    # centres of dark skin, bluish green, black and white as seen in the picture (camera: fit target, margin 0.96)
    corners = [(34.5, 28.5), (34.5, 259.0), (157.0, 259.0), (157.0, 28.5)]
    balanced = Pipeline.of("black_level", "white_balance", "demosaic")
    patches = chart.patch_means(develop(recording.frames[0], recording.mosaic, balanced).image, corners)

    # reference by colour-science alone: XYZ under the light, Bradford to D65, Lab
    table = colour_science.SDS_ILLUMINANTS[light]
    cmfs = colour_science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    shape = colour_science.SpectralShape(380, 780, 5)
    surfaces = colour_science.SDS_COLOURCHECKERS["ISO 17321-1"].values()
    xyz = np.array(
        [colour_science.sd_to_XYZ(sd.copy().align(shape), cmfs, table, method="Integration") / 100 for sd in surfaces]
    )
    white = colour_science.sd_to_XYZ(table, cmfs, method="Integration")
    white_d65 = colour_science.xy_to_XYZ(colour_science.RGB_COLOURSPACES["sRGB"].whitepoint)
    adapted = colour_science.chromatic_adaptation(
        xyz, white / white[1], white_d65, method="Von Kries", transform="Bradford"
    )
    lab = colour_science.XYZ_to_Lab(adapted, colour_science.RGB_COLOURSPACES["sRGB"].whitepoint)

    def difference(linear):
        found = np.asarray(linear) @ colour_science.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T
        found = colour_science.XYZ_to_Lab(found, colour_science.RGB_COLOURSPACES["sRGB"].whitepoint)
        return colour_science.delta_E(found, lab, method="CIE 2000")

    # the recording's own matrix, one factor of exposure; and a matrix fitted from this picture
    reference = chart.reference_linear_srgb(spectra.illuminant(light))
    own = patches @ np.array(Camera.of(recording.mosaic).matrix).T
    own *= (own * reference).sum() / (own * own).sum()
    assert difference(own).mean() < 2
    fit = colour.fit_srgb_matrix(patches, reference)
    fitted = difference(fit.exposure * patches @ np.array(fit.matrix).T)
    assert fitted.mean() < 1.5
    np.testing.assert_allclose(fit.delta_e_2000, fitted, atol=0.1)
    assert fit.mean_delta_e <= colour.delta_e_2000(own, reference).mean()


def test_wrong_corners_of_a_chart_are_told_as_corners():
    """Outside of the image, out of order, and the same place twice."""
    image = np.zeros((60, 90, 3))
    with pytest.raises(RangeError) as caught:
        chart.patch_means(image, [(10, 10), (10, 150), (50, 150), (50, 10)])
    assert str(caught.value) == (
        "chart corners is [[10.0, 10.0], [10.0, 150.0], [50.0, 150.0], [50.0, 10.0]]; expected corners inside the "
        "image of 60 rows and 90 columns: the patch around row 10, column 94 would lie outside"
    )
    crossed, twice = [(10, 10), (50, 80), (10, 80), (50, 10)], [(10, 10), (10, 10), (50, 80), (50, 10)]
    for corners in (crossed, twice, [(10, 10), (20, 20), (30, 30), (50, 10)]):
        with pytest.raises(RangeError, match="top right, bottom right and bottom left patch, in this order around the"):
            chart.patch_means(image, corners)
    assert chart.patch_means(image, [(10, 80), (10, 10), (50, 10), (50, 80)]).shape == (24, 3)  # seen in a mirror


def test_patches_of_a_chart_with_a_single_row():
    image = np.repeat(np.arange(60.0)[None, :, None], 30, axis=0) * [1.0, 2.0, 3.0]
    found = chart.patch_means(image, [(10, 10), (10, 50), (20, 50), (20, 10)], rows=1, cols=3)
    np.testing.assert_allclose(found, np.outer([10, 30, 50], [1, 2, 3]))


def test_patches_of_a_chart_in_perspective():
    """A plane that is turned about two axes before a pinhole: its patches are projected one by one."""
    turn = Rotation.from_euler("xyz", [0.5, -0.35, 0.2]).as_matrix()

    def image(u, v):
        """(row, col) of a place of the chart, whose corner patches are at 0 and 1."""
        x, y, z = turn @ [0.6 * (u - 0.4), 0.45 * (v - 0.55), 0.0] + [0.05, -0.08, 1.1]
        return 310 + 520 * y / z, 405 + 520 * x / z

    corners = [image(*place) for place in ((0, 0), (1, 0), (1, 1), (0, 1))]
    expected = [image(u, v) for v in np.linspace(0, 1, 4) for u in np.linspace(0, 1, 6)]
    np.testing.assert_allclose(chart.patch_centres(corners), expected, atol=1e-8)
    # no parallelogram: the middle of the corners is elsewhere
    assert np.hypot(*(np.mean(corners, axis=0) - image(0.5, 0.5))) > 5
