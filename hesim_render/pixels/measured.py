"""Measured maps of the calibration named in a sensor file, cut to the region that is read out."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibration.measured import MeasuredMaps
from hesim_render.calibration.rates import (
    EventDefectRates,
    EventDefectsPerTrial,
    RateMaps,
    TelegraphPerFrame,
    TelegraphRates,
)
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError
from hesim_render.mosaic.layout import Layout

#: Kinds of value (`numpy.dtype.kind`) of a map and its largest size: DN, DN, DN/s, true or false.
_EXPECTED = {
    "n_row": ("fiu", 65535.0),
    "n_blc": ("fiu", 65535.0),
    "n_dp": ("fiu", 1e9),
    "response": ("f", 1e3),
    "bad_pixels": ("b", 1.0),
}
_EXPECTED |= {
    "defect": ("u", 255.0), "defect_on_per_trial": ("f", 1.0), "defect_off_per_trial": ("f", 1.0),
    "defect_firing_share": ("f", 1.0), "defect_correlation": ("f", 1.0),
    "defect_on_hz": ("f", 1e9), "defect_off_hz": ("f", 1e9), "defect_change_hz": ("f", 1e9),
    "telegraph_amplitude_dn": ("f", 65535.0), "telegraph_high_share": ("f", 1.0), "telegraph_correlation": ("f", 1.0),
    "telegraph_change_hz": ("f", 1e9),
}  # fmt: skip
_THRESHOLD = ("fiu", 1e3)  # relative to the mean
#: Maps that a calibration may lack: thresholds if no steps were shown, others by the kind of captures.
_MAY_LACK = ("threshold_", "defect", "telegraph_", "response")


def require_region(layout: Layout) -> None:
    """Check that the maps of the calibration cover the region read out.

    Raises
    ------
    SpecError
        If they do not; the message names the region of the maps.
    """
    if layout.spec.noise is not None:
        _offset(layout, _maps_of(layout))


def measured_part(layout: Layout) -> Layout:
    """The region that the maps of the calibration cover, if it lies inside the given one; else the given one."""
    if layout.spec.noise is None:
        return layout
    row, col, rows, cols = _region(layout, _maps_of(layout))
    inside = layout.row0 <= row and row + rows <= layout.row0 + layout.rows
    inside &= layout.col0 <= col and col + cols <= layout.col0 + layout.cols
    return layout.crop(cols, rows, col - layout.col0, row - layout.row0) if inside else layout


def frame_maps(layout: Layout) -> dict[str, NDArray[np.float32]] | None:
    """``n_row`` [row, 1], ``n_blc`` and ``n_dp`` [row, col] over the region: DN, DN and DN/s; None if not measured.

    ``response`` [row, col], 1 + PRNU, is there if a flat field was captured.
    """
    result = _read(layout, "aps", ("n_row", "n_blc", "n_dp", "response"))
    if result is None:
        return None
    maps, (row, _) = result
    rows = slice(row, row + layout.rows)
    cut = _frame_region(layout, result, tuple(name for name in ("n_blc", "n_dp", "response") if name in maps))
    return {name: values.astype(np.float32) for name, values in (cut | {"n_row": maps["n_row"][rows, None]}).items()}


def telegraph_rates(layout: Layout) -> TelegraphRates | None:
    """Random telegraph noise of each pixel of the region, [row, col]; None if not measured."""
    # per second where the calibration has it; those of captures without an interval are per frame
    known = _all_of(TelegraphRates, layout, "aps", _frame_region)
    if known is not None:
        return known
    counted = _all_of(TelegraphPerFrame, layout, "aps", _frame_region)
    return None if counted is None else counted.per_second(_interval_s(layout, "aps"))


def event_defect_rates(layout: Layout) -> EventDefectRates | None:
    """Defects of each event pixel of the region, [y, x]; None if not measured."""
    known = _all_of(EventDefectRates, layout, "evs", _event_region)
    if known is not None:
        return known
    counted = _all_of(EventDefectsPerTrial, layout, "evs", _event_region)
    return None if counted is None else counted.per_second(_interval_s(layout, "evs"))


_Placed = tuple[Mapping[str, NDArray], tuple[int, int]]
_Kind = TypeVar("_Kind", bound=RateMaps)


def _all_of(
    kind: type[_Kind],
    layout: Layout,
    section: str,
    cut: Callable[[Layout, _Placed, tuple[str, ...]], dict[str, NDArray]],
) -> _Kind | None:
    """Maps of one kind over the region, all of them or none."""
    result = _read(layout, section, kind.names())
    if result is None or len(result[0]) < len(kind.names()):
        return None
    return kind.of(cut(layout, result, kind.names()))


def _interval_s(layout: Layout, section: str) -> float:
    # without an interval no pixel misbehaves: the calibration would have been refused
    return _maps_of(layout).intervals_s[section] or 1.0


def _maps_of(layout: Layout) -> MeasuredMaps:
    if layout.maps is None:
        raise SpecError(
            f"the maps of the calibration of sensor {layout.spec.name!r} are not at hand; load its file",
            key="noise",
        )
    return layout.maps


def _frame_region(layout: Layout, result: _Placed, names: tuple[str, ...]) -> dict[str, NDArray]:
    maps, (row, col) = result
    return {name: maps[name][row : row + layout.rows, col : col + layout.cols] for name in names}


def _event_region(layout: Layout, result: _Placed, names: tuple[str, ...]) -> dict[str, NDArray]:
    maps, (row, col) = result
    grid = layout.spec.evs_grid
    assert grid is not None
    tile_rows, tile_cols = layout.tile_shape
    y, x = row // tile_rows * grid.rows_per_tile, col // tile_cols * grid.cols_per_tile
    height, width = layout.evs_shape
    return {name: maps[name][y : y + height, x : x + width] for name in names}


def relative_threshold(layout: Layout, polarity: str, spread: float) -> NDArray[np.float32] | None:
    """Threshold of each event pixel relative to the mean, [y, x] over the region; None if not measured.

    The measured value of each pixel contains the noise of its estimate. Deviations are scaled to `spread`, the
    mismatch without that noise. Hot and flickering pixels have the mean.

    Parameters
    ----------
    polarity : ``on`` or ``off``.
    spread : relative standard deviation over pixels.
    """
    name = f"threshold_{polarity}_rel"
    result = _read(layout, "evs", (name, "bad_pixels", "defect"))
    if result is None or name not in result[0]:
        return None
    values = result[0][name].astype(np.float64)
    good = values[~result[0]["bad_pixels"]]
    scaled = 1 + (values - good.mean()) * (spread / max(float(good.std()), 1e-12))
    if "defect" in result[0]:  # events of their own hide the threshold of these: they would count twice
        scaled[np.isin(result[0]["defect"], (Defect.HOT, Defect.FLICKERING))] = 1.0
    return _event_region(layout, ({name: scaled}, result[1]), (name,))[name].astype(np.float32)


def _read(layout: Layout, section: str, names: tuple[str, ...]) -> tuple[Mapping[str, NDArray], tuple[int, int]] | None:
    """Whole maps of a section, and the row and column of the mosaic in them where the region read out begins."""
    if layout.spec.noise is None:
        return None
    measured = _maps_of(layout)
    if section not in measured.sections:
        return None
    offset = _offset(layout, measured)
    result = measured.sections[section]
    maps = {name: result[name] for name in names if name in result}
    height, width = _region(layout, measured)[2:]
    grid = layout.spec.evs_grid
    if section == "evs" and grid is not None:
        tile_rows, tile_cols = layout.tile_shape
        height, width = height // tile_rows * grid.rows_per_tile, width // tile_cols * grid.cols_per_tile
    for name in names:
        if name not in maps and not name.startswith(_MAY_LACK):
            raise SpecError(f"its map file of {section!r} holds no {name!r}", file=measured.file)
    for name, values in maps.items():
        wanted = (height,) if values.ndim == 1 else (height, width)
        if values.shape != wanted:
            raise SpecError(
                f"map {name} is of size {values.shape}, the region captured of {wanted}; state roi in capture.yaml "
                "where only a part of the sensor was captured",
                file=measured.file,
            )
        kind, largest = _EXPECTED.get(name, _THRESHOLD)
        if values.dtype.kind not in kind:
            raise SpecError(f"map {name} holds {values.dtype.name}", file=measured.file)
        if not np.all(np.abs(values) <= largest):
            raise SpecError(f"map {name} holds values that are not finite, or beyond {largest:g}", file=measured.file)
    return maps, offset


def _region(layout: Layout, measured: MeasuredMaps) -> tuple[int, int, int, int]:
    """Row, column, rows and columns of the captured region."""
    roi = measured.roi
    if roi is None:
        return 0, 0, layout.spec.geometry.rows, layout.spec.geometry.cols
    return roi.y, roi.x, roi.height_px, roi.width_px


def _offset(layout: Layout, measured: MeasuredMaps) -> tuple[int, int]:
    row, col, rows, cols = _region(layout, measured)
    inside = row <= layout.row0 and layout.row0 + layout.rows <= row + rows
    inside &= col <= layout.col0 and layout.col0 + layout.cols <= col + cols
    if not inside:
        region = f"{cols}x{rows}+{col}+{row}"
        raise SpecError(
            f"was measured on {region} of the sensor; read out that region or a part of it (--roi {region}, in Python "
            "Sensor.crop)",
            file=measured.file,
        )
    return layout.row0 - row, layout.col0 - col
