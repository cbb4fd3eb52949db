"""Tiles, crops and the event grid."""

import numpy as np
import pytest

from hesim_render.core.errors import RangeError
from hesim_render.mosaic.layout import Layout
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.files import list_names


def full(name):
    return Layout.full(read_sensor(name))


def test_tile_is_drawn_as_the_file_shows_it():
    layout = full("eiger").crop(16, 8)
    letters = ["RRGG", "RrGg", "GGBB", "GgBb"]
    names = {"r": "red", "g": "green", "b": "blue"}
    for row in range(8):
        for col in range(8):
            letter = letters[row % 4][col % 4]
            assert layout.filters[layout.filter_index[row, col]] == names[letter.lower()]
            assert layout.aps_mask[row, col] == letter.isupper()
            assert layout.has_role("evs")[row, col] == letter.islower()


@pytest.mark.parametrize(
    ("name", "shape", "aps_share"),
    [
        ("eiger", (1224, 1632), 12 / 16),
        ("gen2", (612, 816), 15 / 16),
        ("mipi-hybridevs", (1224, 816), 14 / 16),
        ("davis346", (260, 346), 1),
        ("reference-bayer", (0, 0), 1),
    ],
)
def test_event_grids_of_the_shipped_sensors(name, shape, aps_share):
    layout = full(name)
    assert layout.evs_shape == shape and layout.evs_pixel.shape == shape
    assert layout.aps_mask.mean() == aps_share


def test_event_coordinates_map_to_the_pixels_of_the_file():
    layout = full("eiger").crop(64, 32)
    # event (y, x) is the pixel at (1, 1) of 2×2 cell (y, x)
    y, x = np.mgrid[: layout.evs_shape[0], : layout.evs_shape[1]]
    np.testing.assert_array_equal(layout.evs_pixel, (2 * y + 1) * 64 + 2 * x + 1)
    np.testing.assert_array_equal(layout.evs_position, (y % 2) * 2 + x % 2)
    mipi = full("mipi-hybridevs").crop(16, 8)
    assert mipi.evs_shape == (4, 4)
    assert mipi.evs_pixel[0, 1] == 1 * 16 + 5 and mipi.evs_pixel[1, 1] == 3 * 16 + 7
    assert mipi.evs_position[:, 0].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize("name", list_names("sensors"))
def test_every_event_pixel_appears_once_and_has_the_role(name):
    layout = full(name)
    tile_rows, tile_cols = layout.tile_shape
    layout = layout.crop(8 * tile_cols, 6 * tile_rows)
    flat = layout.evs_pixel.ravel()
    assert np.unique(flat).size == flat.size == layout.has_role("evs").sum() * (layout.spec.evs is not None)
    assert layout.has_role("evs").ravel()[flat].all()


@pytest.mark.parametrize("name", list_names("sensors"))
def test_a_crop_keeps_phase_and_full_sensor_index(name):
    whole = full(name)
    tile_rows, tile_cols = whole.tile_shape
    width, height = 5 * tile_cols, 3 * tile_rows
    for x, y in ((None, None), (2 * tile_cols, 4 * tile_rows), (0, 0)):
        part = whole.crop(width, height, x, y)
        inside = np.s_[part.row0 : part.row0 + height, part.col0 : part.col0 + width]
        for values in ("filter_index", "aps_mask", "full_index"):
            np.testing.assert_array_equal(getattr(part, values), getattr(whole, values)[inside])
        assert part.row0 % tile_rows == 0 and part.col0 % tile_cols == 0
        # a crop of a crop counts from the full sensor too
        inner = part.crop(tile_cols, tile_rows, tile_cols, tile_rows)
        assert (inner.row0, inner.col0) == (part.row0 + tile_rows, part.col0 + tile_cols)
    # sizes out of arrays: a manifest takes integers of Python alone
    of_numpy = whole.crop(*np.array([width, height, x, y]))
    assert of_numpy == part and {type(value) for value in (of_numpy.rows, of_numpy.row0, of_numpy.col0)} == {int}
    centred = whole.crop(width, height)
    assert abs(centred.col0 + width / 2 - whole.cols / 2) <= tile_cols
    assert abs(centred.row0 + height / 2 - whole.rows / 2) <= tile_rows


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3268, 4), "roi width_px is 3268; expected 1 to 3264"),
        ((4, 2452), "roi height_px is 2452"),
        ((0, 4), "roi width_px is 0"),
        ((-4, 4), "roi width_px is -4"),
        ((6, 4), "a multiple of the tile's 4 pixels"),
        ((8, 8, 2, 0), "offset along width_px is 2; expected a multiple"),
        ((8, 8, 3260, 0), "inside the sensor"),
        ((8, 8, 0, -4), "inside the sensor"),
        ((8.0, 8), "roi width_px is 8.0; expected a whole number"),
        ((8, 8, 4, "4"), "roi offset along height_px is '4'; expected a whole number"),
    ],
)
def test_crops_that_do_not_fit(arguments, message):
    with pytest.raises(RangeError, match=message):
        full("eiger").crop(*arguments)


def test_tiled_repeats_a_table_over_the_region():
    layout = full("gen2").crop(12, 8)
    table = np.arange(16 * 6).reshape(4, 4, 6)
    np.testing.assert_array_equal(layout.tiled(table), np.tile(table, (2, 3, 1)))
