"""Each step against its formula, written out again."""

from types import SimpleNamespace

import numpy as np
import pytest
from isp_images import MIPI, QUAD, images, linear, mosaic_of, psnr

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.isp import balance, chart, colour, denoise, fill, levels, tone
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.steps import BlackLevel, ColourMatrix, Denoise, Development, Fill, Tone, WhiteBalance
from hesim_render.spectral import transfer
from hesim_render.spectral.transfer import from_root, to_root

RNG = np.random.default_rng(11)


# -- levels ------------------------------------------------------------------------------------------------------


def test_black_level_with_maps():
    raw = RNG.integers(0, 1023, (150, 20)).astype(np.uint16)
    rows, pixels = RNG.normal(0, 2, 150), RNG.normal(0, 1, (150, 20))
    found = levels.black_level(raw, 64, 1000, rows, pixels)
    np.testing.assert_allclose(found, (raw - 64.0 - rows[:, None] - pixels) / 936, atol=1e-6)
    assert found.dtype == np.float32
    with pytest.raises(RangeError, match="row_map_dn"):
        levels.black_level(raw, 64, 1000, rows[:-1])
    with pytest.raises(RangeError, match="white_level_dn"):
        levels.black_level(raw, 64, 64)


def test_lens_shading_undoes_cos4():
    y, x = np.mgrid[0:60, 0:80] - np.array([29.5, 39.5])[:, None, None]
    angle = np.arctan(np.hypot(x, y) / 100.0)
    np.testing.assert_allclose(levels.cos4_illumination((60, 80), 100.0), np.cos(angle) ** 4, rtol=1e-5)
    flat = np.full((60, 80), 0.6, dtype=np.float32)
    shaded = (flat * np.cos(angle) ** 4).astype(np.float32)
    np.testing.assert_allclose(levels.lens_shading(shaded, levels.cos4_illumination((60, 80), 100.0)), flat, rtol=1e-5)
    with pytest.raises(RangeError, match="more than 0 everywhere"):
        levels.lens_shading(flat, np.zeros((60, 80)))


# -- fill --------------------------------------------------------------------------------------------------------


def test_event_pixels_are_filled_from_their_own_colour():
    y, x = np.mgrid[0:48, 0:64]
    planes = np.stack([0.1 + 0.01 * x, 0.6 - 0.01 * y, 0.3 + 0.005 * x + 0.002 * y], -1)
    whole = mosaic_of(planes, QUAD).astype(np.float32)
    holed = mosaic_of(planes, MIPI).astype(np.float32)
    filled = fill.fill_positions(holed, MIPI, QUAD)
    np.testing.assert_allclose(filled[8:-8, 8:-8], whole[8:-8, 8:-8], atol=1e-6)
    known = np.tile(np.array(MIPI) >= 0, (12, 16))
    np.testing.assert_array_equal(filled[known], holed[known])


def test_fill_does_not_reach_across_an_edge():
    """A vertical edge between the cell and its right neighbour of the same colour."""
    picture = np.full((32, 32, 3), 0.1)
    picture[:, 18:] = 0.9
    filled = fill.fill_positions(mosaic_of(picture, MIPI).astype(np.float32), MIPI, QUAD)
    np.testing.assert_allclose(filled, mosaic_of(picture, QUAD), atol=0.01)


def test_each_hole_of_a_tile_that_is_not_square_gets_its_own_colour():
    tile, filled = ((0, 1, 2, -1), (2, 0, -1, 1), (1, 2, 0, 0)), ((0, 1, 2, 2), (2, 0, 1, 1), (1, 2, 0, 0))
    shape = (15, 22)
    colours = np.array([3.0, 7.0, 11.0, np.nan], np.float32)
    found = fill.fill_positions(mosaic_of(np.broadcast_to(colours, (*shape, 4)), tile).astype(np.float32), tile, filled)
    np.testing.assert_allclose(found, mosaic_of(np.broadcast_to(colours, (*shape, 4)), filled), rtol=1e-6)


def test_bad_pixels_of_a_tile_that_is_not_square_get_their_own_colour():
    """Event pixels stay as they are, on the tile's diagonal too; every other cell has bad pixels."""
    tile = np.array([(-1, 0, 2, 1), (2, 0, -1, 1), (1, 2, 0, -1)])
    whole = mosaic_of(np.broadcast_to(np.array([3.0, 7.0, 11.0, 0.3], np.float32), (31, 45, 4)), tile)
    bad = np.zeros(whole.shape, bool)
    for number, (row, col) in enumerate(np.ndindex(tile.shape)):
        bad[6 + row, 1 + 2 * number] = bad[13 + row, 20 + col] = True
    assert {int(tile[r % 3, c % 4]) for r, c in np.argwhere(bad)} == {-1, 0, 1, 2}
    found = fill.fill_pixels(np.where(bad, 99.0, whole).astype(np.float32), tile, bad)
    events = tile[np.ix_(np.arange(31) % 3, np.arange(45) % 4)] < 0
    np.testing.assert_allclose(found, np.where(events & bad, 99.0, whole), rtol=1e-6)


@pytest.mark.parametrize(("size", "period", "margin"), [(13, 3, 8), (8, 4, 8), (5, 2, 4), (9, 5, 10)])
def test_lines_beyond_the_sides_are_those_of_the_same_place_in_the_tile(size, period, margin):
    found, place = fill._kept_in_phase(size, period, margin), np.arange(-margin, size + margin)
    assert found.min() >= 0 and found.max() < size and not np.any((found - place) % period)
    np.testing.assert_array_equal(found[margin : margin + size], np.arange(size))
    assert np.abs(found - np.clip(place, 0, size - 1)).max() < period


def test_bridges_count_by_their_length_and_evenness():
    """From 0.9 to 0.8 over 1 + 1 px, from 0.2 to 0.5 over 2 + 1 px, and one with a single end, which counts little."""
    values = {(0, 1): 0.9, (0, -1): 0.8, (2, 0): 0.2, (-1, 0): 0.5, (3, 3): 0.7, (-1, -1): np.nan}
    bridges = [((0, 1), (0, -1)), ((2, 0), (-1, 0)), ((3, 3), (-1, -1))]
    total, weight = fill._mean_of_bridges(bridges, lambda offset: np.float32([values[offset]]))
    weights = [1 / ((0.1 + fill._EVEN) ** 2 * 2), 1 / ((0.3 + fill._EVEN) ** 2 * 3), 1]
    assert weight[0] == pytest.approx(sum(weights), rel=1e-5)
    assert total[0] == pytest.approx(np.dot(weights, [0.85, 0.4, 0.7]), rel=1e-5)


def test_bad_pixels_and_their_clusters_are_filled():
    y, x = np.mgrid[0:40, 0:40]
    truth = mosaic_of(np.stack([0.2 + 0.01 * x, 0.5 - 0.005 * y, 0.4 + 0.003 * x], -1), QUAD).astype(np.float32)
    bad = RNG.random((40, 40)) < 0.02
    bad[10:13, 10:13] = True
    broken = np.where(bad, 1.0, truth).astype(np.float32)
    filled = fill.fill_pixels(broken, QUAD, bad)
    np.testing.assert_array_equal(filled[~bad], truth[~bad])
    inside = np.zeros_like(bad)
    inside[4:-4, 4:-4] = True
    # a pixel with good neighbours to one side only takes a neighbour's value, off by a slope over up to 4 px
    assert np.abs(filled - truth)[bad & inside].max() < 0.045
    assert np.median(np.abs(filled - truth)[bad & inside]) < 1e-3
    with pytest.raises(RangeError, match="bad pixels"):
        fill.fill_pixels(truth, QUAD, np.ones((40, 40), dtype=bool))
    with pytest.raises(RangeError, match="mask"):
        fill.fill_pixels(truth, QUAD, bad[1:])


@pytest.mark.parametrize("place", [(0, 4), (8, 4), (4, 0), (4, 10), (0, 0), (8, 10)])
def test_bad_pixels_at_a_border_have_no_neighbours_at_the_other_one(place):
    """Mono pixels, 10 per row and 4 per column, with other values at the far border: the fill lies among its own."""
    rows, cols = np.ogrid[:9, :11]
    plane = (100 + 10 * rows + 4 * cols).astype(np.float32)
    far = np.ones(plane.shape, np.bool_)
    far[max(place[0] - 2, 0) : place[0] + 3, max(place[1] - 2, 0) : place[1] + 3] = False
    bad = np.zeros(plane.shape, np.bool_)
    bad[place] = True
    filled = [fill.fill_pixels(np.where(far, other, plane).astype(np.float32), [[0]], bad)[place] for other in (0, 9e3)]
    assert filled[0] == filled[1] and abs(filled[0] - plane[place]) <= 14


# -- white balance -----------------------------------------------------------------------------------------------


def test_balance_multiplies_and_holds_highlights():
    raw = RNG.uniform(0, 0.35, (150, 36)).astype(np.float32)
    gains = np.array([2.643, 1.0, 1.764])
    expected = raw * gains[np.tile(QUAD, (38, 9))[:150]]
    np.testing.assert_allclose(balance.white_balance(raw, QUAD, gains), expected, rtol=1e-6)
    np.testing.assert_allclose(balance.white_balance(raw, QUAD, 2 * gains), expected, rtol=1e-6)
    bright = np.ones((8, 8), dtype=np.float32)
    np.testing.assert_array_equal(balance.white_balance(bright, QUAD, gains), 1)
    assert balance.white_balance(bright, QUAD, gains, clip=False).max() == pytest.approx(2.643)
    for wrong in ([1, 0, 1], [1, 2], [1, np.nan, 1]):
        with pytest.raises(RangeError, match="white balance"):
            balance.white_balance(raw, QUAD, wrong)


@pytest.mark.parametrize("tile", [QUAD, MIPI])
def test_grey_world_finds_the_light(tile):
    grey = RNG.uniform(0.1, 0.9, (20, 30))[:, :, None].repeat(4, 0).repeat(4, 1)
    raw = mosaic_of(grey / [2.643, 1.0, 1.764], tile).astype(np.float32)
    np.testing.assert_allclose(balance.grey_world(raw, tile), [2.643, 1.0, 1.764], rtol=1e-4)
    with pytest.raises(RangeError, match="grey-world"):
        balance.grey_world(np.zeros((8, 8), dtype=np.float32), tile)


def test_balance_from_grey_patches_leaves_saturated_ones_out():
    greys = np.array([1.0, 0.5, 0.25, 0.1])[:, None] / [2.643, 1.0, 1.764]
    greys[0] = [0.5, 1.0, 1.0]
    np.testing.assert_allclose(balance.from_neutral(greys), [2.643, 1.0, 1.764], rtol=1e-9)
    with pytest.raises(RangeError, match="grey patches"):
        balance.from_neutral(np.ones((2, 3)))


# -- chart and colour --------------------------------------------------------------------------------------------


def test_patches_are_found_on_the_chart():
    picture = images()["checker"]
    means = chart.patch_means(picture, [(64, 64), (64, 704), (448, 704), (448, 64)])
    expected = picture[64::128, 64::128].reshape(24, 3)
    np.testing.assert_allclose(means, expected, atol=1e-12)
    turned = chart.patch_means(picture[::-1, ::-1], [(447, 703), (447, 63), (63, 63), (63, 703)])
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    with pytest.raises(RangeError, match="inside the image"):
        chart.patch_means(picture, [(64, 64), (64, 764), (448, 764), (448, 64)])


def test_patches_end_at_the_sides_of_the_image():
    """2 × 3 patches, 40 px apart along rows and 50 along columns: each takes half of the smaller distance."""
    image = np.random.default_rng(7).random((71, 101, 3))
    half = round(chart._SHARE * 20)
    whole = [(half, half), (half, half + 80), (half + 50, half + 80), (half + 50, half)]
    rows, cols = 50 + 2 * half + 1, 80 + 2 * half + 1
    found = chart.patch_means(image[:rows, :cols], whole, 2, 3)
    for number, (row, col) in enumerate((r, c) for r in (half, half + 50) for c in (half, half + 40, half + 80)):
        part = image[row - half : row + half + 1, col - half : col + half + 1]
        np.testing.assert_allclose(found[number], part.mean(axis=(0, 1)), rtol=1e-12)
    for smaller in (image[: rows - 1, :cols], image[:rows, : cols - 1]):
        with pytest.raises(RangeError, match="would lie outside"):
            chart.patch_means(smaller, whole, 2, 3)
    for shift in ((-1, 0), (0, -1)):
        with pytest.raises(RangeError, match="would lie outside"):
            chart.patch_means(image, np.array(whole) + shift, 2, 3)


def test_patch_centres_follow_perspective():
    """Lines stay lines: the diagonals of the chart meet in the centre of any of its views."""
    corners = np.array([(10, 20), (30, 200), (150, 180), (120, 40)], dtype=float)
    centres = chart.patch_centres(corners, 3, 3).reshape(3, 3, 2)
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    t = np.linalg.solve(np.stack([a, -b], 1), corners[1] - corners[0])[0]
    np.testing.assert_allclose(centres[1, 1], corners[0] + t * a, atol=1e-9)
    np.testing.assert_allclose(centres[[0, 0, 2, 2], [0, 2, 2, 0]], corners, atol=1e-9)


def test_fit_finds_the_matrix_that_made_the_patches():
    matrix = np.array([[1.7, -0.6, -0.1], [-0.2, 1.6, -0.4], [0.05, -0.5, 1.45]])
    reference = chart.reference_linear_srgb()
    patches = 0.4 * reference @ np.linalg.inv(matrix).T
    fit = colour.fit_srgb_matrix(patches, reference)
    np.testing.assert_allclose(fit.matrix, matrix, atol=1e-3)
    assert fit.exposure == pytest.approx(2.5, rel=1e-3)
    assert fit.max_delta_e < 0.05
    np.testing.assert_allclose(np.sum(fit.matrix, axis=1), 1, atol=1e-12)
    with pytest.raises(RangeError, match="patches and reference"):
        colour.fit_srgb_matrix(patches[:2], reference[:2])


def test_delta_e_of_a_known_pair():
    """Sharma, Wu and Dalal (2005), data pair 7: Lab (50, 0, 0) against (50, -1, 2) is 2.3669."""

    def to_linear_srgb(lab):
        f = np.array([(lab[0] + 16) / 116 + lab[1] / 500, (lab[0] + 16) / 116, (lab[0] + 16) / 116 - lab[2] / 200])
        x, y = 0.3127, 0.3290
        xyz = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29)) * [x / y, 1, (1 - x - y) / y]
        primaries = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
        return np.linalg.solve(primaries, xyz)

    found = colour.delta_e_2000(to_linear_srgb((50, 0, 0)), to_linear_srgb((50, -1, 2)))
    assert found == pytest.approx(2.3669, abs=2e-3)


def test_colour_matrix_is_a_product():
    image, matrix = RNG.random((70, 9, 4)).astype(np.float32), RNG.normal(size=(3, 4))
    np.testing.assert_allclose(colour.colour_matrix(image, matrix), image @ matrix.T, atol=1e-5)
    with pytest.raises(RangeError, match="colour matrix"):
        colour.colour_matrix(image, np.eye(3))


# -- tone, noise, transfer ---------------------------------------------------------------------------------------


def test_global_tone_follows_the_formula_and_keeps_hue():
    image = RNG.uniform(0, 4, (70, 8, 3)).astype(np.float32)
    found = tone.tone_global(image, white=4.0)
    y = image @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(found @ [0.2126, 0.7152, 0.0722], y * (1 + y / 16) / (1 + y), rtol=1e-4)
    np.testing.assert_allclose(found / found.sum(-1, keepdims=True), image / image.sum(-1, keepdims=True), atol=1e-5)
    white = tone.tone_global(np.full((2, 2, 3), 4, dtype=np.float32), white=4.0)
    np.testing.assert_allclose(white, 1, rtol=1e-4)


def test_local_tone_lowers_large_contrast_and_keeps_detail():
    image = np.full((128, 256, 3), 0.02, dtype=np.float32)
    image[:, 128:] = 0.8
    texture = 1 + 0.1 * (np.indices((128, 256)).sum(0) % 2 - 0.5)
    image *= texture[..., None].astype(np.float32)
    found = tone.tone_local(image, compression=0.5, radius_px=8)[..., 1]
    left, right = found[32:96, 32:96], found[32:96, 160:224]
    assert np.log2(right.mean() / left.mean()) == pytest.approx(0.5 * np.log2(0.8 / 0.02), rel=0.02)
    for part in (left, right):
        assert part.std() / part.mean() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(tone.tone_local(image, compression=1.0), image, rtol=1e-5)


def test_detail_and_contrast_have_factors_of_their_own():
    """A chessboard of ± 0.05 doublings about 2⁻² is detail but for 1.5 %, var/(var + 0.16); its mean is the base."""
    ripple = 0.05 * np.where(np.add.outer(np.arange(60), np.arange(84)) % 2, 1.0, -1.0)
    image = (2.0 ** (ripple - 2))[..., None] * np.array([0.6, 1.1, 1.4])
    image /= np.array([0.2126, 0.7152, 0.0722]) @ np.array([0.6, 1.1, 1.4])
    found = np.log2(tone.tone_local(image.astype(np.float32), 0.7, 1.8, 9))[20:-20, 20:-20]
    tint = np.log2(image / image[..., :1])[20:-20, 20:-20]
    np.testing.assert_allclose(found - found[..., :1], tint, atol=1e-4)
    luminance = np.log2(2.0**found @ np.array([0.2126, 0.7152, 0.0722]))
    own = 0.05**2 / (0.05**2 + 0.16)
    assert luminance.mean() == pytest.approx(0.7 * -2, abs=2e-3)
    size = np.sum((luminance - luminance.mean()) * ripple[20:-20, 20:-20]) / np.sum(ripple[20:-20, 20:-20] ** 2)
    assert size == pytest.approx(own * 0.7 + (1 - own) * 1.8, rel=0.01)


def test_automatic_exposure_brings_highlights_to_the_level():
    image = RNG.uniform(0, 0.1, (200, 200, 3)).astype(np.float32)
    gain = tone.auto_gain(image, 99, 0.9)
    assert np.percentile((gain * image)[::2, ::2].max(-1), 99) == pytest.approx(0.9, rel=1e-4)
    assert tone.auto_gain(np.zeros((8, 8, 3), dtype=np.float32)) == pytest.approx(50)
    # as it is: the 99.5 % percentile of the largest channel becomes 0.95, of every second row and column
    ramp = np.zeros((2, 402, 3), np.float32)
    ramp[0, ::2, 1] = 0.3 * np.arange(201) / 200
    assert tone.auto_gain(ramp) == pytest.approx(0.95 / (0.3 * 0.995), rel=1e-5)


def test_noise_reduction_lowers_noise_and_keeps_edges():
    clean = np.full((128, 128, 3), 0.1, dtype=np.float32)
    clean[:, 64:] = [0.6, 0.4, 0.5]
    noisy = clean + RNG.normal(0, 0.01, clean.shape).astype(np.float32)
    found = denoise.reduce_noise(noisy, luma=0.02, chroma=0.05)
    assert found[20:108, 20:44].std(axis=(0, 1)).max() < 0.5 * 0.01
    assert found[20:108, 84:108].std(axis=(0, 1)).max() < 0.5 * 0.01
    np.testing.assert_allclose(found.mean((0, 1)), noisy.mean((0, 1)), rtol=0.01)
    step = found[:, 66].mean(0) - found[:, 61].mean(0)
    np.testing.assert_allclose(step, [0.5, 0.3, 0.4], rtol=0.06)
    np.testing.assert_allclose(denoise.reduce_noise(noisy, 0, 0), noisy, atol=1e-6)
    assert psnr(found, clean) > psnr(noisy, clean) + 4


def test_colour_is_smoothed_over_twice_the_radius():
    """An even brightness guides nothing: two means over 2 · 2 · 3 + 1 pixels reach 12 pixels far."""
    root = np.full((41, 49, 3), 0.5, np.float32)
    root[20, 24] += [0.06, -0.02, -0.04]
    found = to_root(denoise.reduce_noise(from_root(root), luma=0, chroma=0.05, radius_px=3)) - 0.5
    row, col = np.nonzero(np.abs(found).max(axis=2) > 1e-5)
    assert (row.min(), row.max(), col.min(), col.max()) == (8, 32, 12, 36)


def test_a_patch_is_as_far_to_each_side_of_its_centre():
    """On a ramp its mean is that of its centre, whatever its size; rows and columns are as far apart as they are."""
    row, col = np.mgrid[0:90, 0:160]
    image = np.stack([row, col, row + 2 * col], axis=-1).astype(np.float32)
    corners = [(12, 15), (12, 140), (72, 140), (72, 15)]
    found = chart.patch_means(image, corners)
    centres = chart.patch_centres(corners)
    np.testing.assert_allclose(found[:, :2], centres, atol=0.51)
    np.testing.assert_allclose(found[:, :2].mean(axis=0), [42, 77.5], atol=0.02)


def test_guided_filter_against_its_definition():
    """One pixel by hand: mean of the linear models of all windows that cover it."""
    image, guide = RNG.random((2, 15, 15)).astype(np.float32)
    found = denoise.guided_filter(image, guide, 1, 0.01)[7, 7]
    models = []
    for y in range(6, 9):
        for x in range(6, 9):
            p, g = image[y - 1 : y + 2, x - 1 : x + 2].astype(float), guide[y - 1 : y + 2, x - 1 : x + 2].astype(float)
            a = ((g * p).mean() - g.mean() * p.mean()) / (g.var() + 0.01)
            models.append((a, p.mean() - a * g.mean()))
    a, b = np.mean(models, axis=0)
    assert found == pytest.approx(a * guide[7, 7] + b, abs=1e-5)
    for radius_px, epsilon in ((0, 0.01), (1, 0.0)):
        with pytest.raises(RangeError, match="radius_px, epsilon"):
            denoise.guided_filter(image, guide, radius_px, epsilon)


@pytest.mark.parametrize("name", ["srgb", "bt709", "gamma", "linear"])
def test_transfer_functions_are_inverses(name):
    x = np.linspace(0, 1, 100_001)
    atol = 1e-6 if name == "srgb" else 1e-12  # the published constants of sRGB leave a step where its branches meet
    np.testing.assert_allclose(transfer.decode(transfer.encode_exactly(x, name), name), x, atol=atol)
    np.testing.assert_allclose(transfer.encode_exactly(transfer.decode(x, name), name), x, atol=atol)
    assert transfer.decode([0.0, 1.0], name) == pytest.approx([0, 1])


def test_srgb_against_the_standard():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(transfer.decode(x), linear(x), atol=1e-12)
    with pytest.raises(RangeError, match="transfer"):
        transfer.decode(x, "rec2020")


@pytest.mark.parametrize("depth", [8, 16])
def test_integer_depths_round_the_curve(depth):
    image = np.linspace(-0.1, 1.1, 3 * 200_000).reshape(200, 1000, 3).astype(np.float32)
    found = transfer.encode(image, depth=depth)
    top = 2**depth - 1
    exact = top * transfer.encode_exactly(np.clip(image, 0, 1).astype(np.float64))
    assert found.dtype == (np.uint8 if depth == 8 else np.uint16)
    # 8 bit: a table of 65536 levels, at most 0.03 of a code off half a code; 16 bit: float32 input rounds once
    assert np.abs(found - exact).max() < 0.55


def test_each_method_has_its_own_gains():
    image = RNG.uniform(0.2, 0.6, (8, 12)).astype(np.float32)
    state = SimpleNamespace(image=image, tile=QUAD, camera=SimpleNamespace(white_balance=[1.7, 1.0, 1.3], matrix=None))
    step = WhiteBalance(step="white_balance", gains=[2.0, 1.1, 1.4])
    expected = {"camera": [1.7, 1.0, 1.3], "given": [2.0, 1.1, 1.4], "grey_world": balance.grey_world(image, QUAD)}
    for method, gains in expected.items():
        assert step.model_copy(update={"method": method})._gains(state) == gains
    for method in ("given", "chart"):
        for lacking in (
            WhiteBalance(step="white_balance", method=method),
            ColourMatrix(step="colour_matrix", method=method),
        ):
            with pytest.raises(SpecError, match=f"is required by method {method}"):
                lacking.run(state)


def test_grey_world_leaves_out_tiles_of_which_one_channel_is_dark_or_saturated():
    """The gains are those of the well exposed part; the others have other colours."""
    tile, colour = ((0, 1), (1, 2)), np.array([0.31, 0.62, 0.44])
    raw = colour[np.tile(tile, (20, 30))].astype(np.float32)
    for rows, channel, level in ((slice(0, 12), 2, 0.004), (slice(12, 24), 0, 0.97)):
        part = raw[rows]
        part[np.tile(tile, (6, 30)) == channel] = level
    np.testing.assert_allclose(balance.grey_world(raw, tile), colour.max() / colour, rtol=1e-5)


def test_black_and_white_of_a_step_are_its_own_or_the_cameras():
    image = np.array([[40.0, 470.0], [900.0, 255.0]], np.float32)
    for given, black, white in (({}, 64.0, 1023.0), ({"black_level_dn": 40.0, "white_level_dn": 900.0}, 40.0, 900.0)):
        state = SimpleNamespace(image=image, camera=SimpleNamespace(black_level_dn=64.0, white_level_dn=1023.0))
        BlackLevel(step="black_level", **given).run(state)
        assert state.span_dn == white - black
        np.testing.assert_allclose(state.image, (image - black) / (white - black), rtol=1e-6)


def test_the_report_of_noise_reduction_has_the_rms_of_the_row_offsets(monkeypatch):
    offsets = np.array([3.0, -1.0, 2.0, 0.0], np.float32)
    monkeypatch.setattr("hesim_render.isp.steps.row_offsets", lambda *given: offsets)
    noise = FrameNoise(np.tile([0.6, 0.2, 0, 0, 0, 0], (1, 1, 1)), 1000.0)
    tile, camera = np.zeros((1, 1), int), SimpleNamespace(white_balance=[1.0])
    state = Development(np.full((4, 6), 0.5, np.float32), camera, tile, noise=noise, span_dn=200.0)
    Denoise(step="denoise", strength=0, row_std_dn=1.3).run(state)
    assert state.report == {"row_offsets_rms_dn": pytest.approx(np.sqrt(14 / 4))}
    np.testing.assert_allclose(state.image, 0.5 - offsets[:, None] / 200 + np.zeros((4, 6)), rtol=1e-6)


def test_gains_of_a_tile_that_is_not_square_reach_their_own_pixels():
    tile, gains = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 0, 2]]), np.array([1.7, 1.0, 1.3])
    raw = RNG.uniform(0.1, 0.5, (11, 8)).astype(np.float32)
    channel = tile[np.arange(11)[:, None] % 4, np.arange(8) % 3]
    np.testing.assert_allclose(balance.white_balance(raw, tile, gains), raw * gains[channel], rtol=1e-6)


def test_eight_bits_are_those_of_the_nearest_of_65536_levels():
    levels = np.arange(1 << 16)
    found = transfer.encode((levels[:, None, None] / 65535).astype(np.float32) * np.ones(3, np.float32), depth=8)
    np.testing.assert_array_equal(found[:, 0, 1], np.rint(255 * transfer.encode_exactly(levels / 65535)))


def test_steps_of_fill_and_tone_do_what_their_options_say():
    raw = RNG.uniform(0, 1, (24, 32)).astype(np.float32)
    camera = SimpleNamespace(filled_tile=np.array(QUAD))

    def state(image, tile=MIPI):
        return Development(image.copy(), camera, np.array(tile))

    given = state(raw)
    Fill(step="fill").run(given)
    np.testing.assert_array_equal(given.image, raw)
    Fill(step="fill", event_pixels=True).run(given)
    np.testing.assert_array_equal(given.image, fill.fill_positions(raw, MIPI, QUAD))
    np.testing.assert_array_equal(given.tile, QUAD)
    assert not np.array_equal(given.image, raw)
    Fill(step="fill", event_pixels=True).run(whole := state(raw, QUAD))
    np.testing.assert_array_equal(whole.image, raw)
    picture = RNG.uniform(0, 3, (40, 30, 3)).astype(np.float32)
    Tone(step="tone", white=2.5).run(given := state(picture))
    np.testing.assert_array_equal(given.image, tone.tone_global(picture, 2.5))
    Tone(step="tone", method="local", compression=0.7, detail=1.5, radius_px=3).run(given := state(picture))
    np.testing.assert_array_equal(given.image, tone.tone_local(picture, 0.7, 1.5, 3))
