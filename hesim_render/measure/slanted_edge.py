"""Spatial frequency response on a slanted edge, e-SFR of ISO 12233.

The steps are those of the standard: find the edge, project the pixels along it onto its normal, make of them an
edge-spread function on a grid finer than a pixel, differentiate it (line-spread function), and take the Fourier
transform.

The standard averages pixels in bins of a quarter pixel and takes differences of bins. Both filter the response: means
over a width δ by sinc(f δ), sinc x = sin(π x)/(π x), differences by as much again. At the Nyquist frequency this is 5 %
together, of which the standard's factor corrects the difference alone; and pixels do not lie evenly in their bins,
which adds up to 0.01. Here the edge-spread function is the least-squares cubic spline with knots δ apart through all
pixels at their own places. Its derivative is exact, and its transform is a sum over its coefficients times sinc³(f δ).

The edge is not found row by row from centroids, but as the straight line of the best smooth step through all pixels at
once. This works on any subset of pixels, such as those of one filter of a mosaic.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import ConflictError, RangeError, did_you_mean
from hesim_render.recording.recording import Recording, as_recording

#: Knots of the spline per pixel, as many as the standard has bins.
OVERSAMPLING = 4
#: Frequencies at which a response is given, cycles per pixel, unless others are asked for.
FREQUENCIES = np.linspace(0.0, 1.0, 101)
#: Least number of pixels, and least half width of the used strip along the edge, pixels.
_LEAST_PIXELS, _LEAST_HALF_WIDTH_PX = 64, 4.0
#: Part of the strip, at each end, over which the line-spread function fades out.
_TAPER = 0.2
#: Pixels nearest to the edge that decide its place, at most.
_MOST_FITTED = 60_000
#: What is measured: RAW values, or the noise-free electrons of the truth.
Signal = Literal["raw", "electrons"]


@dataclass(frozen=True, eq=False)
class EdgeResponse:
    """Spatial frequency response across an edge.

    Parameters
    ----------
    frequency_cy_per_px : [n], along the normal of the edge, cycles per pixel.
    mtf : [n], modulus of the response, 1 at frequency 0.
    angle_deg : of the edge, clockwise from the vertical as seen, above -90 to 90.
    distance_px : [n], places between the knots, from the edge towards its light side.
    edge_spread : [n], the edge-spread function there, in the unit of the input.
    clipped : RAW values of the region are saturated, and the response is that of noise-free electrons, which are not.
    """

    frequency_cy_per_px: NDArray[np.float64]
    mtf: NDArray[np.float64]
    angle_deg: float
    distance_px: NDArray[np.float64]
    edge_spread: NDArray[np.float64]
    clipped: bool = False

    def frequency_at(self, level: float = 0.5) -> float:
        """Lowest frequency at which the response falls to a level, cycles per pixel.

        Parameters
        ----------
        level : 0.5 gives MTF50.

        Returns
        -------
        The frequency, linear between those of the response; NaN if it stays above.
        """
        below = np.flatnonzero(self.mtf < level)
        if below.size == 0 or below[0] == 0:
            return float("nan")
        k = int(below[0])
        share = (self.mtf[k - 1] - level) / (self.mtf[k - 1] - self.mtf[k])
        return float(self.frequency_cy_per_px[k - 1] + share * np.diff(self.frequency_cy_per_px[k - 1 : k + 1])[0])


def edge_response(
    values: ArrayLike,
    valid: ArrayLike | None = None,
    *,
    frequency_cy_per_px: ArrayLike = FREQUENCIES,
    oversampling: int = OVERSAMPLING,
) -> EdgeResponse:
    """Spatial frequency response on the one straight edge of a region, from linear values.

    The response is that of the whole chain, pixel aperture included, along the normal of the edge. Noise of the values
    adds to the modulus where the response is small; a longer edge reduces it.

    Parameters
    ----------
    values : [row, col], proportional to light (no gamma, no sharpening); any offset and factor.
    valid : [row, col], bool: the pixels to use, such as those of one filter; default all that are finite.
    frequency_cy_per_px : [n], frequencies from 0 to `oversampling` / 2, cycles per pixel.
    oversampling : knots of the edge-spread function per pixel, 2 or more.

    Examples
    --------
    >>> import numpy as np
    >>> from hesim_render.measure import edge_response
    >>> row, col = np.mgrid[:80, :60]
    >>> step = np.tanh((col - 30 + 0.1 * row - 4) / 0.8)
    >>> response = edge_response(step)
    >>> round(response.angle_deg, 2), bool(0.2 < response.frequency_at(0.5) < 0.4)
    (5.71, True)

    Returns
    -------
    The response.

    Raises
    ------
    RangeError
        If there is no edge, it is too near to the sides of the region, or too nearly along rows, columns or a simple
        diagonal, so that no pixel lies between some knots.
    """
    image = np.asarray(values, dtype=np.float64)
    if image.ndim != 2:
        raise RangeError("values", image.shape, "an array [row, col]")
    used = np.isfinite(image) if valid is None else np.asarray(valid, dtype=bool) & np.isfinite(image)
    frequency = np.asarray(frequency_cy_per_px, dtype=np.float64)
    if oversampling < 2 or frequency.min() < 0 or frequency.max() > oversampling / 2:
        raise RangeError("frequency_cy_per_px", frequency.tolist()[:3], f"0 to {oversampling / 2:g} (oversampling / 2)")
    row, col = np.nonzero(used)
    if row.size < _LEAST_PIXELS:
        raise RangeError("valid", row.size, f"at least {_LEAST_PIXELS} pixels to measure an edge on")
    middle = np.array([image.shape[1] - 1, image.shape[0] - 1]) / 2
    x, y, value = col - middle[0], row - middle[1], image[row, col]
    angle, distance = _find_edge(x, y, value)
    along = np.cos(angle) * x + np.sin(angle) * y - distance
    half = _half_width(image.shape, angle, distance)
    spline, bins = _edge_spread(along, value, half, oversampling)
    # E' has the coefficients Δc/δ on quadratic B-splines, whose transform is that of three boxes of width δ
    steps = np.diff(spline.c) * _fading(spline.c.size - 1)
    at = np.arange(steps.size) / oversampling  # the modulus does not depend on the origin
    transform = np.abs(np.exp(-2j * np.pi * np.outer(frequency, at)) @ steps) / np.abs(steps.sum())
    mtf = transform * np.abs(np.sinc(frequency / oversampling)) ** 3
    place = (np.arange(2 * bins) - bins + 0.5) / oversampling
    degrees = float(np.degrees(angle))
    return EdgeResponse(frequency, mtf, 90 - (90 - degrees) % 180, place, spline(place))


def _find_edge(x: NDArray, y: NDArray, value: NDArray) -> tuple[float, float]:
    """Direction of the normal towards the light side, rad, and distance of the edge from the origin, px.

    The edge is at x cos a + y sin a = d of the least-squares step: an error function between two levels.
    """
    from scipy.optimize import least_squares
    from scipy.special import erf

    low, high = np.percentile(value, [5, 95])
    if not high > low:
        raise RangeError("values", float(high), "an edge between two levels, and the region has one level only")
    # a plane through all values points to the light side; its slopes count by the size of the region
    slope, *_ = np.linalg.lstsq(np.column_stack([x, y, np.ones(x.size)]), value, rcond=None)
    angle = float(np.arctan2(slope[1] * np.ptp(y) ** 2, slope[0] * np.ptp(x) ** 2))
    share = np.clip((value - low) / (high - low), 0, 1)
    distance = float(np.quantile(np.cos(angle) * x + np.sin(angle) * y, 1 - share.mean()))
    width = float(np.ptp(x) + np.ptp(y)) / 8

    for _ in range(2):  # first everywhere, then near the edge alone, where its place is decided
        near = np.argsort(np.abs(np.cos(angle) * x + np.sin(angle) * y - distance))[:_MOST_FITTED]
        u, v, seen = x[near], y[near], share[near]

        def residual(p: NDArray, u: NDArray = u, v: NDArray = v, seen: NDArray = seen) -> Any:
            step = erf((np.cos(p[0]) * u + np.sin(p[0]) * v - p[1]) / np.exp(p[2]))
            return p[3] + p[4] * step - seen

        result = least_squares(
            residual, [angle, distance, np.log(width), 0.5, 0.5], x_scale=[0.01, 0.1, 0.1, 0.01, 0.01]
        )
        angle, distance = float(result.x[0]), float(result.x[1])
        width = float(np.clip(np.exp(result.x[2]), 0.1, width))
    if result.x[4] < 0:
        angle, distance = angle + np.pi, -distance
    scatter = float(np.sqrt(np.mean(result.fun**2)))
    if abs(result.x[4]) < 2 * scatter:
        raise RangeError("values", scatter, "one straight edge that stands out of the noise; none was found")
    return angle, distance


def _half_width(shape: tuple[int, ...], angle: float, distance: float) -> float:
    """Half the width of the strip about the edge that lies in the region over its whole length, px."""
    half_x, half_y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    c, s = abs(np.cos(angle)), abs(np.sin(angle))
    # the edge ends at the two sides that it crosses; the other two limit the strip
    reach = half_x * c - half_y * s if c * half_x >= s * half_y else half_y * s - half_x * c
    half = float(reach - abs(distance))
    if half < _LEAST_HALF_WIDTH_PX:
        raise RangeError(
            "values", round(half, 2), f"an edge with {_LEAST_HALF_WIDTH_PX:g} px or more of the region on both sides"
        )
    return half


def _edge_spread(along: NDArray, value: NDArray, half: float, oversampling: int) -> tuple[Any, int]:
    """The least-squares cubic spline through all pixels of the strip, and the number of its intervals on each side."""
    from scipy.interpolate import make_lsq_spline

    bins = int(half * oversampling)
    inside = np.flatnonzero(np.abs(along) < bins / oversampling)
    order = inside[np.argsort(along[inside], kind="stable")]
    place, seen = along[order], value[order]
    number = np.floor(place * oversampling).astype(np.int64) + bins
    empty = 2 * bins - np.unique(number).size
    if empty:
        raise RangeError(
            "angle",
            f"{empty} empty intervals",
            "an edge turned some degrees from rows, columns and diagonals, and so long that a pixel lies between any "
            "two knots of the edge-spread function",
        )
    knots = np.arange(-bins - 3, bins + 4) / oversampling
    return make_lsq_spline(place, seen, knots, k=3), bins


def _fading(count: int) -> NDArray[np.float64]:
    """1, and a cosine to 0 at both ends."""
    from scipy.signal.windows import tukey

    return tukey(count + 2, 2 * _TAPER)[1:-1]


def measure_mtf(
    recording: Recording | str | Path,
    frame: int = 0,
    region: tuple[int, int, int, int] | None = None,
    *,
    signal: Signal = "raw",
    filter_name: str | None = None,
    oversampling: int = OVERSAMPLING,
) -> EdgeResponse:
    """Spatial frequency response on a slanted edge of a recorded frame; see `edge_response`.

    Values are linear and undeveloped: RAW values, or the mean electrons of the truth. Of a mosaic only the pixels of
    one filter are used, at their true places; frequencies are still in cycles per pixel of the mosaic.

    Parameters
    ----------
    recording : the recording, or its folder.
    frame : number of the frame.
    region : first column, first row, width and height of the part with the edge, px of the frame; default all.
    signal : ``raw`` or ``electrons``.
    filter_name : the filter; may be left out if all frame pixels have the same one.
    oversampling : knots of the edge-spread function per pixel.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.measure import measure_mtf
    >>> sensor = hr.load_sensor("reference-mono").crop(64, 48)
    >>> rec = hr.simulate(hr.load_scene("slanted-edge"), sensor, duration_s=0.03, seed=1)
    >>> response = measure_mtf(rec, signal="electrons")
    >>> bool(abs(response.angle_deg - 5) < 0.1), bool(abs(response.mtf[50] - 0.635) < 0.02)
    (True, True)

    Returns
    -------
    The response.

    Raises
    ------
    RangeError
        If the frame, the region or the filter does not exist, a RAW value is saturated, or the region has no edge that
        can be measured.
    ConflictError
        If the mosaic has several filters and `filter_name` is left out.
    """
    recording = as_recording(recording)
    if not recording.frames:
        raise RangeError("frame", frame, "a frame of a recording that has frames; this one has none")
    if not 0 <= frame < len(recording.frames):
        raise RangeError("frame", frame, f"0 to {len(recording.frames) - 1}")
    mosaic, chosen = recording.mosaic, recording.frames[frame]
    rows, cols = chosen.raw.shape
    x, y, width, height = (0, 0, cols, rows) if region is None else region
    if not (x >= 0 and y >= 0 and 0 < width <= cols - x and 0 < height <= rows - y):
        raise RangeError("region", (x, y, width, height), f"a part of the frame of {cols}x{rows} px")
    filters = np.array(mosaic.tile_filter)
    aps = np.array(mosaic.tile_aps)
    known = sorted(set(filters[aps].tolist()))
    if filter_name is None and len(known) == 1:
        filter_name = known[0]
    if filter_name not in known:
        if filter_name is None:
            raise ConflictError(
                "filter_name", None,
                f"this mosaic has {len(known)} filters: say on which to measure, --filter NAME (filter_name), one of "
                f"{', '.join(known)}",
            )  # fmt: skip
        raise RangeError("filter_name", filter_name, f"one of {', '.join(known)}{did_you_mean(filter_name, known)}")
    own = mosaic.tiled((filters == filter_name) & aps, chosen.raw.shape) & chosen.valid
    part = np.s_[y : y + height, x : x + width]
    values = np.asarray(chosen.raw if signal == "raw" else chosen.electrons_mean, dtype=np.float64)[part]
    used = own[part]
    largest = float(chosen.raw[part][used].max(initial=0))
    clipped = largest >= mosaic.white_level_dn
    if signal == "raw" and clipped:
        raise RangeError("raw", largest, "values below saturation; use less light or exposure")
    result = edge_response(values, used, frequency_cy_per_px=FREQUENCIES, oversampling=oversampling)
    return replace(result, clipped=clipped)
