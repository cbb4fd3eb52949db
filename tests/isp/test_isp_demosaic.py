"""Demosaic: what it must reproduce exactly, and round trips of five pictures against their ceilings."""

import numpy as np
import pytest
from isp_images import (
    BAYER,
    EIGER,
    GEN2,
    IDENTITY,
    MIPI,
    PAPER_BALANCE,
    PAPER_MATRIX,
    QUAD,
    captured,
    ceiling,
    images,
    inner_psnr,
    lmmse_oracle,
    mosaic_of,
    patterns,
    photographs,
    psnr,
    srgb,
)

from hesim_render.core import bands
from hesim_render.core.errors import RangeError
from hesim_render.isp import Camera, Pipeline, demosaic, guide, kriging, process, remosaic

RGBW = ((3, 0, 3, 1), (0, 3, 1, 3), (3, 1, 3, 2), (1, 3, 2, 3))
FIVE = ((0, 1, 0, 1, 2), (1, 2, 1, 0, 1), (0, 1, 2, 1, 0), (1, 0, 1, 2, 1), (2, 1, 0, 1, 0))
TILES = {"bayer": BAYER, "quad": QUAD, "gen2": GEN2, "mipi": MIPI, "eiger": EIGER, "rgbw": RGBW, "five": FIVE}
FLOAT = Pipeline.of("black_level", "white_balance", "demosaic", "colour_matrix", {"step": "encode", "depth": "float"})


def camera(tile, matrix=IDENTITY, bits=8):
    names = "RGB"
    return Camera(
        channels=list(names),
        tile=[["." if c < 0 else names[c] for c in row] for row in tile],
        white_level_dn=2**bits - 1,
        white_balance=list(PAPER_BALANCE),
        matrix=[list(row) for row in matrix],
    )


def round_trip(picture, tile, matrix=IDENTITY, bits=8):
    raw = mosaic_of(captured(picture, matrix, bits), tile)
    return psnr(process(raw, camera(tile, matrix, bits), FLOAT), picture)


# -- exactness ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in TILES if name != "five"])
def test_weights_are_unbiased_and_exact_on_planes(name):
    """Σ weights over samples of colour b = [b = wanted], and the first moments point at the target."""
    tile = np.array(TILES[name])
    block = np.tile(tile, [-(-4 // n) for n in tile.shape])
    targets = tuple((int(i), int(j)) for i, j in np.ndindex(*block.shape))
    y = np.arange(-4, 8)[:, None] + np.zeros((1, 12))
    x = y.T
    channel = np.tile(block, (3, 3))
    for wanted in range(int(block.max()) + 1):
        # [target, position, dy, dx] as the image of 12×12 px around the block
        weights = kriging.stencil(tuple(map(tuple, block.tolist())), wanted, targets)
        spread = weights.reshape(-1, 4, 4, 3, 3).transpose(0, 3, 1, 4, 2).reshape(-1, 12, 12).astype(np.float64)
        for other in range(int(block.max()) + 1):
            own = np.where(channel == other, spread, 0)
            same = float(other == wanted)
            np.testing.assert_allclose(own.sum((1, 2)), same, atol=2e-5)
            np.testing.assert_allclose((own * y).sum((1, 2)), same * np.array(targets)[:, 0], atol=1e-4)
            np.testing.assert_allclose((own * x).sum((1, 2)), same * np.array(targets)[:, 1], atol=1e-4)


def samples_around(tile):
    """Places and channels of the samples that a 4×4 block is predicted from."""
    y, x = (k.ravel() for k in np.mgrid[-4:8, -4:8])
    channel = np.tile(np.array(tile), (3, 3)).ravel()
    return y[channel >= 0], x[channel >= 0], channel[channel >= 0]


@pytest.mark.parametrize("number", [0, 1, 2, 6, 11, 16, 19])
def test_residuals_are_those_of_predictions_without_the_sample(number):
    """A sample is left out and predicted from the others by the kriging equations, written out again."""
    prior = guide.PRIORS[number]
    tile = np.array(EIGER)
    y, x, channel = samples_around(tile)
    own = np.zeros_like(channel) if prior.grey else channel
    image = np.random.default_rng(number).normal(size=(12, 12))
    planes = image.reshape(3, 4, 3, 4).transpose(1, 3, 0, 2).reshape(16, 3, 3).astype(np.float32)
    found = kriging.apply(planes, kriging.residual_stencil(tuple(map(tuple, tile.tolist())), prior), slice(0, 1))
    for k, (row, col) in list(enumerate(np.argwhere(tile >= 0)))[1::7]:
        here = (y == row) & (x == col)
        used = ~here
        if prior.line is not None:
            used &= (x == col) if prior.line == 0 else (y == row)
        dy, dx = np.subtract.outer(y[used], y[used]), np.subtract.outer(x[used], x[used])

        def covariance(dy, dx, same):
            far = np.hypot(dy, dx)
            shared = np.exp(-far / 24)
            if prior.smooth:
                shared = (1 + far / 1.5) * np.exp(-far / 1.5)
            elif prior.angle is not None:
                along = dx * np.cos(prior.angle) + dy * np.sin(prior.angle)
                across = dy * np.cos(prior.angle) - dx * np.sin(prior.angle)
                shared = np.exp(-np.hypot(along / 6, across) * 6**0.5 / 24)
            return shared + prior.colour * np.exp(-far / 24) * same

        n = used.sum()
        drift = np.stack([(own[used] == c) * term for c in np.unique(own[used])
                          for term in (np.ones(n), y[used] - row, x[used] - col) if np.ptp(term) > 0 or term[0] == 1],
                         axis=1)  # fmt: skip
        system = np.block([[covariance(dy, dx, np.equal.outer(own[used], own[used])) + 1e-3 * np.eye(n), drift],
                           [drift.T, np.zeros((drift.shape[1],) * 2)]])  # fmt: skip
        at_place = [float(c == own[here][0]) * (term == 0) for c in np.unique(own[used])
                    for term in ((0, 1, 1) if prior.line is None else (0, 1))]  # fmt: skip
        right = np.concatenate([covariance(y[used] - row, x[used] - col, own[used] == own[here][0]), at_place])
        weights = np.linalg.solve(system, right)[:n]
        expected = image[row + 4, col + 4] - weights @ image[y[used] + 4, x[used] + 4]
        assert found[k, 0, 0] == pytest.approx(expected, abs=2e-3), (row, col)


@pytest.mark.parametrize("name", TILES)
@pytest.mark.parametrize("method", ["guided", "linear"])
def test_flat_colours_come_back(name, method):
    tile = np.array(TILES[name])
    colour = np.array([0.7, 0.2, 0.45, 0.5])[: tile.max() + 1].astype(np.float32)
    planes = np.broadcast_to(colour, (36, 44, colour.size))
    found = demosaic(mosaic_of(planes, tile).astype(np.float32), tile, method)
    np.testing.assert_allclose(found, planes, atol=3e-5)


def test_linear_method_is_exact_on_ramps_inside():
    y, x = np.mgrid[0:40, 0:48]
    planes = np.stack([0.1 + 0.01 * x, 0.6 - 0.005 * y, 0.3 + 0.004 * x - 0.002 * y], -1).astype(np.float32)
    for tile in (BAYER, QUAD, MIPI):
        found = demosaic(mosaic_of(planes, tile).astype(np.float32), tile, "linear")
        np.testing.assert_allclose(found[4:-4, 4:-4], planes[4:-4, 4:-4], atol=2e-5)


def test_measured_values_are_kept():
    rng = np.random.default_rng(1)
    for tile in (BAYER, QUAD, RGBW):
        raw = rng.uniform(0, 1, (32, 40)).astype(np.float32)
        found = demosaic(raw, tile)
        channel = np.tile(np.array(tile), (32 // len(tile), 40 // len(tile[0])))
        np.testing.assert_allclose(np.take_along_axis(found, channel[..., None], 2)[..., 0], raw, atol=1e-6)


def test_mono_passes_and_its_holes_are_bridged():
    y, x = np.mgrid[0:32, 0:32]
    ramp = (0.2 + 0.01 * x + 0.005 * y).astype(np.float32)
    np.testing.assert_array_equal(demosaic(ramp, [[0]])[..., 0], ramp)
    tile = np.zeros((4, 4), dtype=int)
    tile[1, 1] = -1
    holed = np.where(np.tile(tile, (8, 8)) < 0, 0, ramp)
    np.testing.assert_allclose(demosaic(holed, tile)[4:-4, 4:-4, 0], ramp[4:-4, 4:-4], atol=2e-4)


@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (9, 33), (31, 18), (130, 67)])
def test_any_size_gives_that_size(shape):
    planes = np.broadcast_to(np.float32([0.5, 0.3, 0.2]), (*shape, 3))
    found = demosaic(mosaic_of(planes, QUAD).astype(np.float32), QUAD)
    assert found.shape == (*shape, 3)
    np.testing.assert_allclose(found, planes, atol=3e-5)


def test_mirrored_picture_gives_the_mirrored_result():
    """Quad RGGB transposed is quad RGGB: rows and columns must be treated alike."""
    picture = images()["natural"][:128, :160].astype(np.float32)
    one = demosaic(mosaic_of(picture, QUAD).astype(np.float32), QUAD)
    other = demosaic(np.ascontiguousarray(mosaic_of(picture, QUAD).T).astype(np.float32), QUAD)
    np.testing.assert_allclose(other.transpose(1, 0, 2), one, atol=1e-4)


def test_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    raw = mosaic_of(captured(images()["natural"]), QUAD) / np.float32(255)
    several = demosaic(raw, QUAD)
    monkeypatch.setattr(bands, "_WORKERS", 1)
    np.testing.assert_array_equal(demosaic(raw, QUAD), several)


def test_remosaic_keeps_what_both_tiles_measure():
    picture = images()["natural"][:64, :64].astype(np.float32)
    raw = mosaic_of(picture, QUAD).astype(np.float32)
    bayer = remosaic(raw, QUAD)
    both = np.tile(QUAD, (16, 16)) == np.tile(BAYER, (32, 32))
    np.testing.assert_allclose(bayer[both], raw[both], atol=1e-6)
    assert psnr(bayer, mosaic_of(picture, BAYER)) > 36
    assert both.mean() == pytest.approx(0.375)


def test_bad_arguments_are_named():
    raw = np.zeros((8, 8), dtype=np.float32)
    with pytest.raises(RangeError, match="demosaic method"):
        demosaic(raw, QUAD, "best")
    with pytest.raises(RangeError, match="at least one tile"):
        demosaic(raw[:3], QUAD)
    with pytest.raises(RangeError, match="1 does not occur"):
        demosaic(raw, [[0, 2], [2, 0]])
    with pytest.raises(RangeError, match="at least one >= 0"):
        demosaic(raw, [[-1]])
    with pytest.raises(RangeError, match="target tile"):
        remosaic(raw, QUAD, [[0, 5]])


# -- bounds on pictures ------------------------------------------------------------------------------------------

MATRICES = {"identity": IDENTITY, "paper": PAPER_MATRIX}


@pytest.mark.parametrize("matrix", MATRICES)
@pytest.mark.parametrize("name", ["natural", "checker"])
def test_quad_bayer_keeps_detail_and_edges(name, matrix):
    assert round_trip(images()[name], QUAD, MATRICES[matrix]) >= 33


@pytest.mark.parametrize("matrix", MATRICES)
@pytest.mark.parametrize("name", ["grey", "rgb", "hue"])
def test_quad_bayer_reaches_the_ceiling_on_smooth_pictures(name, matrix):
    picture = images()[name]
    assert round_trip(picture, QUAD, MATRICES[matrix]) >= ceiling(picture, MATRICES[matrix]) - 1


@pytest.mark.parametrize("name", ["natural", "checker", "grey", "rgb", "hue"])
def test_event_pixels_cost_little(name):
    picture = images()[name]
    assert round_trip(picture, MIPI) >= round_trip(picture, QUAD) - 1.5


@pytest.mark.parametrize("name", ["natural", "checker"])
def test_edge_directed_method_pays(name):
    picture = images()[name].astype(np.float32)
    raw = mosaic_of(picture, QUAD).astype(np.float32)
    assert psnr(srgb(demosaic(raw, QUAD)), srgb(picture)) > psnr(srgb(demosaic(raw, QUAD, "linear")), srgb(picture))


def test_rgbw_is_developed():
    """White = mean of the three; its luminance samples make up half of the mosaic."""
    for name, least in (("natural", 33), ("checker", 30)):
        picture = images()[name]
        planes = np.concatenate([picture, picture.mean(-1, keepdims=True)], -1)
        found = demosaic(mosaic_of(planes, RGBW).astype(np.float32), RGBW)[..., :3]
        assert psnr(found, picture) > least


def test_tiles_of_odd_size_are_developed():
    picture = images()["natural"][:203, :301].astype(np.float32)
    assert psnr(demosaic(mosaic_of(picture, FIVE).astype(np.float32), FIVE), picture) > 33


@pytest.mark.slow
@pytest.mark.parametrize("name", ["natural", "checker", "grey", "rgb", "hue"])
def test_bayer_is_not_below_menon(name):
    """colour-demosaicing's Menon (2007) with its refining step on the same balanced mosaic."""
    reference = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Menon2007
    picture = images()[name]
    raw = mosaic_of(captured(picture), BAYER) / 255 * np.tile([[2.643, 1.0], [1.0, 1.764]], (256, 384))
    assert round_trip(picture, BAYER) >= psnr(srgb(reference(raw, "RGGB")), picture) - 0.2


def test_bayer_is_not_below_menon_on_photographs():
    reference = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Menon2007
    pytest.importorskip("skimage")
    for picture in photographs().values():
        gains = np.tile([[2.643, 1.0], [1.0, 1.764]], [n // 2 for n in picture.shape[:2]])
        raw = mosaic_of(captured(picture), BAYER) / 255 * gains
        assert round_trip(picture, BAYER) >= psnr(srgb(reference(raw, "RGGB")), picture) - 0.2


# What the demosaic of one direction and one prior had, in dB at 10 bit: the gains below are over these.
BEFORE = {
    "natural": {"quad": 37.28, "gen2": 36.52, "mipi": 35.97, "eiger": 34.83, "bayer": 39.45},
    "astronaut": {"quad": 33.38, "gen2": 33.03, "mipi": 32.77, "eiger": 32.02, "bayer": 35.23},
    "cat": {"quad": 37.17, "gen2": 36.62, "mipi": 36.28, "eiger": 35.41, "bayer": 39.41},
    "coffee": {"quad": 31.72, "gen2": 31.22, "mipi": 30.83, "eiger": 29.73, "bayer": 33.30},
    "rocket": {"quad": 30.76, "gen2": 30.48, "mipi": 30.58, "eiger": 30.11, "bayer": 31.87},
    "zone plate": {"quad": 21.58}, "diagonals": {"quad": 15.42},
    "text": {"eiger": 22.10}, "edge 5 deg": {"bayer": 63.20},
}  # fmt: skip


def inner_round_trip(picture, name):
    raw = mosaic_of(captured(picture, bits=10), TILES[name])
    return inner_psnr(process(raw, camera(TILES[name], bits=10), FLOAT), picture)


@pytest.mark.parametrize(
    ("name", "tile", "gain"),
    [("zone plate", "quad", 20), ("diagonals", "quad", 3), ("text", "eiger", 1.5), ("edge 5 deg", "bayer", 1)],
)
def test_patterns_hard_for_a_mosaic_gained(name, tile, gain):
    """Detail of half the Nyquist frequency is no colour, red on black has no beads, text and grey edges are sharp."""
    assert inner_round_trip(patterns()[name], tile) >= BEFORE[name][tile] + gain


def test_grey_edges_are_not_behind_menon():
    reference = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Menon2007
    picture = patterns()["edge 5 deg"]
    raw = mosaic_of(captured(picture, bits=10), BAYER) / 1023 * np.tile([[2.643, 1.0], [1.0, 1.764]], (128, 128))
    assert inner_round_trip(picture, "bayer") >= inner_psnr(srgb(reference(raw, "RGGB")), picture) + 1


@pytest.mark.parametrize("tile", ["quad", "gen2", "mipi", "eiger", "bayer"])
def test_natural_pictures_lose_nothing_by_it(tile):
    picture = images()["natural"]
    assert inner_round_trip(picture, tile) >= BEFORE["natural"][tile] - 0.1


@pytest.mark.parametrize("tile", ["quad", "eiger", "bayer"])
def test_photographs_gain(tile):
    pytest.importorskip("skimage")
    for name, picture in photographs().items():
        assert inner_round_trip(picture, tile) >= BEFORE[name][tile] + 0.5, name


def test_a_decibel_more_is_not_there_on_natural_texture():
    """`natural` is a Gaussian field, of which a linear demosaic is the best: with eiger's tile even the one that was
    fitted to this very picture is less than 0.3 dB better."""
    assert lmmse_oracle(images()["natural"], EIGER) < BEFORE["natural"]["eiger"] + 0.3


def test_event_pixels_of_every_shipped_tile_are_those_of_the_sensor_files():
    from hesim_render.mosaic.description import describe
    from hesim_render.sensor.sensor import load_sensor

    for name, tile in (("eiger", EIGER), ("gen2", GEN2), ("mipi-hybridevs", MIPI), ("reference-bayer", BAYER)):
        np.testing.assert_array_equal(describe(load_sensor(name)).tile_channel, tile)


def test_samples_that_do_not_determine_every_plane_have_the_pseudo_inverse():
    rng = np.random.default_rng(3)
    full = rng.normal(size=(5, 5))
    regular = full @ full.T + np.eye(5)
    np.testing.assert_allclose(kriging._inverse(regular) @ regular, np.eye(5), atol=1e-9)
    for singular in (full[:, :3] @ full[:, :3].T, np.zeros((4, 4))):
        np.testing.assert_allclose(kriging._inverse(singular), np.linalg.pinv(singular, rcond=1e-9), atol=1e-8)
