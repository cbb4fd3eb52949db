"""Spatial frequency response of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from hesim_render.core.errors import ConflictError, RangeError, did_you_mean
from hesim_render.measure.slanted_edge import FREQUENCIES, OVERSAMPLING, EdgeResponse, edge_response
from hesim_render.recording.recording import Recording, as_recording

#: What is measured: RAW values, or the noise-free electrons of the truth.
Signal = Literal["raw", "electrons"]


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
