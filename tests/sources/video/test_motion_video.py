"""Pictures between those of a video, by motion estimation."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hesim_render.core.errors import SpecError
from hesim_render.sources.video.motion import MotionVideo
from hesim_render.sources.video.picture_layout import PictureFormat

ROWS, COLS, COUNT = 46, 70, 4


def texture(seed, shape=(ROWS, COLS + 32)):
    rough = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.0)
    return np.clip(128 + 50 * rough / rough.std(), 0, 255).astype(np.uint8)


def video(layout, bits=8):
    """A texture that moves by 4 px a picture, of its own in each channel."""
    channels = [texture(k) for k in range(3)]
    moved = [[channel[:, 4 * k : 4 * k + COLS] for channel in channels] for k in range(COUNT)]
    given = {
        "grey": lambda planes: (planes[0],),
        "planar": tuple,
        "interleaved": lambda planes: (np.stack(planes, axis=-1),),
    }[layout]
    shape = PictureFormat(layout, COLS, ROWS, bits)
    return moved, SimpleNamespace(
        format=shape, name="a.mp4", tags=None, timing=None, count=COUNT, read=lambda number: given(moved[number])
    )


@pytest.mark.parametrize("layout", ["grey", "planar", "interleaved"])
def test_given_pictures_are_unchanged_and_new_ones_lie_on_the_way(layout):
    moved, reader = video(layout)
    made = MotionVideo(reader, 4)
    assert made.count == 13 and made.format.layout == ("grey" if layout == "grey" else "planar")
    # forwards, the last one, and back
    for number in (0, 4, 12, 8, 8, 4):
        planes = made.read(number)
        assert len(planes) == (1 if layout == "grey" else 3)
        for plane, given in zip(planes, moved[number // 4], strict=False):
            np.testing.assert_array_equal(plane, given)
    between = made.read(6)
    for k, plane in enumerate(between):
        halfway = texture(k)[:, 6 : 6 + COLS]
        error = np.abs(plane.astype(float) - halfway)[8:-8, 8:-8].mean()
        assert error < 0.3 * np.abs(plane.astype(float) - moved[1][k])[8:-8, 8:-8].mean()


def test_pictures_of_more_than_8_bits_are_refused():
    with pytest.raises(SpecError, match="needs 8-bit pictures"):
        MotionVideo(video("planar", 10)[1], 2)
