"""What a mosaic costs in detail: resolution, false colour and zipper after the demosaicing of the real ISP.

Test patterns as a pixel grid sees them: slanted edge, star and zone plate, each pixel the mean over its area.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.isp import process
from hesim_render.isp.pipeline import Pipeline
from hesim_render.measure.slanted_edge import edge_response
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.description import describe
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import mixed
from hesim_render.spectral.colorimetry import lab
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies.chart_noise import Measured
from hesim_render.studies.table import Cell

#: Side of a pattern, px; a multiple of the tiles of 2, 3, 4 and 6 pixels.
SIDE_PX = 192
#: Rows and columns of all patterns side by side.
CHART_PX = SIDE_PX, 3 * SIDE_PX
#: Angle of the edge from the vertical, degrees; spokes of the star; highest frequency of the zone plate, cycles per px.
EDGE_DEG, SPOKES, ZONE_TOP = 5.0, 36, 0.5
#: Points across a pixel.
_FINE = 8


def _sampled(value: Callable[[NDArray, NDArray], NDArray]) -> NDArray[np.float64]:
    """Mean over the area of each pixel of a function of the place from the centre, px."""
    fine = (np.arange(SIDE_PX * _FINE) + 0.5) / _FINE - SIDE_PX / 2
    result = np.empty((SIDE_PX, SIDE_PX))
    for row in range(SIDE_PX):
        y = fine[row * _FINE : (row + 1) * _FINE, None]
        part = value(fine[None, :], y)
        result[row] = part.reshape(_FINE, SIDE_PX, _FINE).mean(axis=(0, 2))
    return result


def edge_picture() -> NDArray[np.float64]:
    """0 on the left of an edge through the centre, 1 on the right, [row, col]."""
    slope = np.tan(np.radians(EDGE_DEG))
    return _sampled(lambda x, y: (x + slope * y > 0).astype(float))


def star() -> NDArray[np.float64]:
    """A star of sectors, 0 and 1 in turn, [row, col]."""
    return _sampled(lambda x, y: (np.sin(SPOKES * np.arctan2(y, x)) > 0).astype(float))


def zone_plate_picture() -> NDArray[np.float64]:
    """½ (1 + cos) of a phase whose frequency rises with the distance, to `ZONE_TOP` at the sides, [row, col]."""
    rate = np.pi * ZONE_TOP / (SIDE_PX / 2)
    return _sampled(lambda x, y: 0.5 * (1 + np.cos(rate * (x**2 + y**2))))


def chart() -> NDArray[np.float64]:
    """Edge, star and zone plate side by side, [row, col]."""
    return np.concatenate([edge_picture(), star(), zone_plate_picture()], axis=1)


def distance_px() -> NDArray[np.float64]:
    """Distance of each pixel of a pattern from its centre, [row, col]."""
    place = np.arange(SIDE_PX) + 0.5 - SIDE_PX / 2
    return np.hypot(place[:, None], place[None, :])


#: Reflectances of the dark and the light parts of all patterns, grey.
DARK, LIGHT = 0.05, 0.8
#: Luminance of linear sRGB, ITU-R BT.709.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
#: Half width of the strip about the edge that is judged, and of the flat parts that are left out beside it, px.
_NEAR_PX, _AWAY_PX = 4.0, 16.0
#: Change of the difference to a neighbour that counts as zipper, ΔE*ab [lu2003].
_ZIPPER = 2.3
#: Frequencies of the star that are judged, cycles per px.
_STAR_BAND = (0.08, 0.25)
_SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
#: Level of a perfect white in the frames that are developed, of the span between black and white level.
_WHITE_LEVEL = 0.9
_FIXED = ("prnu", "dsnu", "row")
#: Linear sRGB of balanced and interpolated channels.
_STEPS = Pipeline.of("black_level", {"step": "white_balance", "clip": False}, "demosaic", "colour_matrix")


@cache
def _chart() -> NDArray[np.float64]:
    return chart()


def demosaic_figures(
    sensor: Sensor,
    light: Spectrum,
    rgb_matrix: NDArray[np.float64],
    white_e: NDArray[np.float64],
    rates_of_white: NDArray[np.float64],
    exposure_us: float,
    crosstalk: float,
    repeats: int,
    seed: int,
) -> tuple[dict[str, Cell], NDArray[np.float32]]:
    """Figures of edge, star and zone plate after the ISP, without noise, and the error with noise.

    Parameters
    ----------
    sensor : the whole sensor.
    light : of the scene.
    rgb_matrix : [3, channel], from balanced channels to linear sRGB.
    white_e : [channel], electrons of one pixel of each frame filter on a perfect white, crosstalk included.
    rates_of_white : [filter of the sensor], electrons of the exposure on a perfect white, without crosstalk.
    exposure_us : µs.
    crosstalk : part of a pixel's electrons that its neighbours collect.
    repeats : noisy frames, 0 or more.
    seed : of the noise.

    Returns
    -------
    ``mtf50_cy_per_px`` (luminance, on the edge); ``false_colour`` (mean C*ab within 4 px of the edge, less that of flat
    parts); ``zipper`` (per cent of the pixels there whose difference to their most similar true neighbour is off by
    more than 2.3 [lu2003]); ``star_error`` (rms luminance error over the contrast, at 0.08 to 0.25 cycles per pixel);
    ``zone_plate_colour`` (mean C*ab up to 0.5 cycles per pixel); ``picture_error_simulated`` with its interval (rms
    error of linear RGB with noise in the same part of the star, white is 1); and the picture, noisy if there are
    repeats, linear sRGB.

    Raises
    ------
    RangeError
        If the chart is larger than the sensor.
    """  # fmt: skip
    shape = _chart().shape
    geometry = sensor.spec.geometry
    if shape[0] > geometry.rows or shape[1] > geometry.cols:
        raise RangeError("sensor", sensor.name, f"at least {shape[1]}x{shape[0]} px for demosaic figures")
    part = sensor.calibrated_part.crop(shape[1], shape[0], 0, 0)
    reflectance = DARK + (LIGHT - DARK) * _chart()
    image = mixed(reflectance * rates_of_white[part.layout.filter_index], crosstalk)
    mosaic = describe(sensor, light)
    spec = sensor.spec.aps
    assert spec is not None
    camera = Camera.of(mosaic).model_copy(
        update={"white_balance": (white_e.max() / white_e).tolist(), "matrix": rgb_matrix.tolist()}
    )
    # a digital gain puts white at a fixed level: the demosaicing works on roots, and so depends on the level
    span = camera.white_level_dn - camera.black_level_dn
    gain = _WHITE_LEVEL * span / (white_e.max() * spec.system_gain_dn_per_e)

    def developed(signal_dn: NDArray) -> NDArray[np.float64]:
        raw = (camera.black_level_dn + gain * signal_dn).astype(np.float32)
        return np.asarray(process(raw, camera, _STEPS), dtype=np.float64) / _WHITE_LEVEL

    clean = developed(image * spec.system_gain_dn_per_e)
    figures: dict[str, Cell] = dict(_figures(clean, reflectance))
    picture = clean
    errors = []
    dark_dn = spec.dark_current_now_e_per_s * exposure_us * 1e-6 * spec.system_gain_dn_per_e
    for repeat in range(repeats):
        dn = part.aps.without(*_FIXED).sample(image, exposure_us, seed, repeat)
        picture = developed(dn.astype(np.float64) - spec.black_level_dn - dark_dn)
        off = (picture - reflectance[..., None])[:, SIDE_PX : 2 * SIDE_PX][_ring()]
        errors.append(np.sqrt(np.mean(off**2)))
    if errors:
        result = Measured.of(np.array(errors))
        figures |= {
            "picture_error_simulated": result.value, "picture_error_low": result.low, "picture_error_high": result.high,
        }  # fmt: skip
    return figures, picture.astype(np.float32)


def _figures(rgb: NDArray[np.float64], reflectance: NDArray[np.float64]) -> dict[str, float | None]:
    """Figures of a picture without noise, [row, col, 3], white at 1."""
    side = SIDE_PX
    edge, star, zone = (np.s_[:, k * side : (k + 1) * side] for k in range(3))
    white = _SRGB_TO_XYZ.sum(axis=1)
    colours = lab(rgb @ _SRGB_TO_XYZ.T, white)
    chroma = np.hypot(colours[..., 1], colours[..., 2])
    luminance = rgb @ _LUMINANCE
    inner = np.s_[8:-8, 8:-8]  # the demosaicing meets its own border, or the next pattern
    mtf50 = edge_response(luminance[edge][inner]).frequency_at(0.5)
    place = np.arange(side) + 0.5 - side / 2
    slope = np.tan(np.radians(EDGE_DEG))
    distance = np.abs(place[None, :] + slope * place[:, None]) * np.cos(np.radians(EDGE_DEG))
    near, away = distance[inner] < _NEAR_PX, distance[inner] > _AWAY_PX
    own = chroma[edge][inner]
    radius = distance_px()
    ring = _ring()
    off = (luminance[star] - reflectance[star])[ring]
    return {
        "mtf50_cy_per_px": None if np.isnan(mtf50) else float(mtf50),
        "false_colour": float(own[near].mean() - own[away].mean()),
        "zipper": zipper(colours[edge][inner], lab(reflectance[edge][inner][..., None] * white, white), near),
        "star_error": float(np.sqrt(np.mean(off**2)) / (LIGHT - DARK)),
        "zone_plate_colour": float(chroma[zone][radius < side / 2 - 8].mean()),
    }


@cache
def _ring() -> NDArray[np.bool_]:
    """The judged part of the star, [row, col]."""
    frequency = SPOKES / (2 * np.pi * np.maximum(distance_px(), 1e-9))
    return (frequency > _STAR_BAND[0]) & (frequency < _STAR_BAND[1])


def zipper(colours: NDArray[np.float64], true: NDArray[np.float64], chosen: NDArray[np.bool_]) -> float:
    """Per cent of pixels whose difference to the neighbour that is truly most similar is off by more than 2.3 [lu2003].

    Parameters
    ----------
    colours, true : CIELAB of the picture and of the truth, [row, col, 3].
    chosen : pixels that count, [row, col]; those of the border never do.
    """
    shifts = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    rows, cols = chosen.shape

    def differences(values: NDArray) -> NDArray[np.float64]:
        centre = values[1:-1, 1:-1]
        return np.stack([
            np.linalg.norm(values[1 + i : rows - 1 + i, 1 + j : cols - 1 + j] - centre, axis=-1) for i, j in shifts
        ])  # fmt: skip

    truly, seen = differences(true), differences(colours)
    nearest = np.argmin(truly, axis=0)[None]
    change = np.abs(np.take_along_axis(seen, nearest, 0) - np.take_along_axis(truly, nearest, 0))[0]
    return float(100 * np.mean(change[chosen[1:-1, 1:-1]] > _ZIPPER))
