"""APS calibration: from dark and lit frames to fixed maps, variance polynomials and photon transfer."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import rank_filter

from hesim_render.calibrate.aps.common_mode import row_noise, without_rows
from hesim_render.calibrate.aps.composite import Composite, clear_of_clipping, compose, light_signal, saturation_dn
from hesim_render.calibrate.aps.dark import DarkModel, fit_dark
from hesim_render.calibrate.aps.fitted import ApsCalibration, Position
from hesim_render.calibrate.aps.output import content, maps
from hesim_render.calibrate.aps.pairs_output import calibrate_pairs
from hesim_render.calibrate.aps.photon_transfer import linearity, photon_transfer
from hesim_render.calibrate.aps.telegraph import TelegraphMaps, find_telegraph
from hesim_render.calibrate.aps.variance import Pooled, VarianceFit, fit_variance, join, pool, variance_map
from hesim_render.calibrate.moments import FrameMoments, Progress, measure
from hesim_render.calibrate.report.page import write_report
from hesim_render.calibrate.result import check_calibration, check_report, write_section
from hesim_render.core.errors import SpecError
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2
from hesim_render.recording.capture_set import CaptureSet, FrameStack, read_captures
from hesim_render.recording.pair_set import is_pair_set

_POOR_FIT_SIGMAS = 8.0


def calibrate_aps(
    folder: str | Path,
    out: str | Path,
    report: str | Path | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Calibrate the frames of a capture set and write (or update) a ``calibration.yaml``.

    Parameters
    ----------
    folder : capture set with ``capture.yaml``, ``aps_dark.npz`` and ``aps_lit.npz``; or captures of EMVA 1288, in the
        layout of the standard's own data sets (``EMVA1288_Data.txt``) or as pairs by name.
    out : the calibration; its section ``aps`` is written, others are kept.
    report : HTML file, if wanted; it covers every section of `out`, and an earlier report of `out` is replaced.
    progress : called with a text that names the current work and the fraction done.
    overwrite : replace a report of another calibration.

    Returns
    -------
    Path of the calibration.

    Raises
    ------
    SpecError
        If the captures cannot be used; the message says what to capture instead.
    OutputError
        If a result cannot be written.
    """
    if is_pair_set(folder):
        calibrate_pairs(folder, out, report, progress, overwrite)
        return Path(out)
    captures = read_captures(folder)
    about = described_captures(captures)
    check_calibration(out, about)
    if report is not None:
        check_report(out, report, overwrite)
    stacks = captures.frames("aps_dark"), captures.frames("aps_lit")
    if stacks[0].shape[2:] != stacks[1].shape[2:]:
        sizes = " and ".join(f"{s.shape[2]}×{s.shape[3]}" for s in stacks)
        raise SpecError(f"dark and lit frames are of different sizes, {sizes} pixels", file=captures.folder)
    used = used_pixels(captures, stacks[0].shape[2:])
    dark, lit = _read(stacks, used, captures.spec.full_scale_dn, progress)
    tile = captures.spec.tile_rows, captures.spec.tile_cols
    telegraph = find_telegraph(stacks[0], dark, used, tile, captures.spec.full_scale_dn)
    result, dark, lit = analyse(captures, dark, lit, used, telegraph)
    write_section(out, "aps", about, content(captures, result, dark, lit), maps(captures, result, lit, dark))
    if report is not None:
        write_report(out, report, overwrite)
    return Path(out)


def described_captures(captures: CaptureSet) -> dict[str, Any]:
    """Description of the captures for a calibration."""
    return captures.spec.model_dump(exclude_none=True, mode="json")


def _read(
    stacks: tuple[FrameStack, FrameStack], used: NDArray[np.bool_], full_scale_dn: int, progress: Progress | None
) -> list[FrameMoments]:
    """Read both stacks in parallel. Decompression takes most of the time and releases Python's lock."""
    with ThreadPoolExecutor(2) as pool_of_two:
        return list(pool_of_two.map(lambda stack: measure(stack, used, full_scale_dn, progress), stacks))


def frame_positions(captures: CaptureSet) -> list[Position]:
    """Tile positions that have an APS value; all positions where no sensor is named."""
    spec = captures.spec
    if captures.sensor is not None:
        return captures.sensor.positions("aps")
    return list(np.ndindex(spec.tile_rows, spec.tile_cols))


def used_pixels(captures: CaptureSet, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels [row, col] that have an APS value."""
    used = np.zeros(shape, bool)
    for i, j in frame_positions(captures):
        used[i :: captures.spec.tile_rows, j :: captures.spec.tile_cols] = True
    return used


def analyse(
    captures: CaptureSet,
    dark_moments: FrameMoments,
    lit: FrameMoments,
    used: NDArray[np.bool_],
    telegraph: TelegraphMaps,
) -> tuple[ApsCalibration, FrameMoments, FrameMoments]:
    """Everything the frames' moments tell.

    Parameters
    ----------
    used : [row, col], pixels that have an APS value.
    telegraph : pixels of two levels, which are left out.

    Returns
    -------
    The calibration, and the moments of dark and lit frames without what rows share from frame to frame.

    Raises
    ------
    SpecError
        As `calibrate_aps`.
    """
    spec = captures.spec
    tile, positions = (spec.tile_rows, spec.tile_cols), frame_positions(captures)
    # noise that a row shares would count as noise of each pixel: it is measured, and taken out of all variances
    rows = row_noise(dark_moments, used)
    row_variance = rows.variance if rows.significant else 0.0
    if row_variance:
        dark_moments, lit = (without_rows(m, used, spec.full_scale_dn, row_variance) for m in (dark_moments, lit))
    # black level and dark current, and from them the light alone, [exposure, row, col]
    dark = fit_dark(dark_moments, used, spec.full_scale_dn, row_variance)
    signals = np.stack([light_signal(lit, dark, k) for k in range(lit.exposures_s.size)])
    # pixels that decide figures; the others are only judged
    good = used & ~dark.bad & ~dark.hot & ~telegraph.is_telegraph
    _check_light(dark, lit, signals, good, spec.full_scale_dn)
    saturation = saturation_dn(lit, signals, good, spec.full_scale_dn)
    dark_clear = (dark_moments.lowest > 0) & (dark_moments.highest < spec.full_scale_dn)

    # what is clear of clipping depends on the noise, and the noise is fitted to what is clear: two rounds of both.
    # Within each, pixels that the polynomial does not describe drop out, and it is fitted once more without them.
    beta: NDArray | None = None
    bad = used & (dark.bad | telegraph.is_telegraph)
    for _ in range(2):
        usable = np.stack(
            [
                clear_of_clipping(lit, signals[k], k, beta, spec.full_scale_dn, saturation, row_variance)
                for k in range(len(signals))
            ]
        )
        usable &= used
        for _ in range(2):
            fits, bins = _fit(
                positions, tile, dark, dark_moments, lit, signals, good & ~bad, dark_clear, usable, row_variance
            )
            beta = np.zeros((*tile, 6))
            for position, fit in fits.items():
                beta[position] = fit.beta
            # judged by all their exposures, [row, col]
            unlike = used & _unlike_their_kind(beta, dark_moments, lit, signals, dark_clear, usable)
            if not np.any(unlike & ~bad):
                break
            bad |= unlike
    # the scene without noise, from all exposures; it shows pixels without a response as well
    assert beta is not None
    composite = compose(lit, dark, usable, beta)
    bad |= used & _unresponsive(composite, tile)
    # the brightest signal: that at which pixels saturate, or else the end of the ADC above black
    top = spec.full_scale_dn - dark.black if saturation is None else saturation
    reached = saturation is not None or bool(np.mean(lit.highest[:, used] >= spec.full_scale_dn) > 1e-4)
    linear = linearity(lit, signals, usable & good, composite, top)
    transfer = photon_transfer(spec, dark, composite, fits, bins, saturation, reached, linear)
    result = ApsCalibration(dark, composite, fits, bins, bad, signals, usable, transfer, rows, telegraph)
    return result, dark_moments, lit


def _check_light(
    dark: DarkModel, lit: FrameMoments, signals: NDArray, good: NDArray[np.bool_], full_scale_dn: int
) -> None:
    if np.mean(lit.highest[:, good] >= full_scale_dn) > 0.98:
        raise SpecError("the lit frames are saturated at every exposure; capture shorter exposures or less light")
    # the longest exposure must stand out of its own noise
    k = len(signals) - 1
    t = lit.exposures_s[k]
    noise = np.sqrt(np.median(lit.variance[k][good]) / lit.frames + dark.mean_variance(t))
    if np.quantile(signals[k][good], 0.99) < 5 * noise:
        raise SpecError(
            "the lit frames show no light above the dark ones; take the cover off, or capture longer exposures or "
            "more light"
        )


def _fit(
    positions: list[Position],
    tile: tuple[int, int],
    dark: DarkModel,
    dark_moments: FrameMoments,
    lit: FrameMoments,
    signals: NDArray,
    good: NDArray[np.bool_],
    dark_clear: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    row_variance: float,
) -> tuple[dict[Position, VarianceFit], dict[Position, Pooled]]:
    bins = {}
    for position in positions:
        cut = np.s_[position[0] :: tile[0], position[1] :: tile[1]]
        parts = []
        for k, t in enumerate(dark_moments.exposures_s):
            # values of one tile position, pooled by signal; dark frames give the constant terms
            take = good[cut] & dark_clear[k][cut]
            variance = dark_moments.variance[k][cut][take]
            parts.append(pool(np.zeros(variance.size), variance, t, 0.0, dark_moments.frames, False, row_variance))
        for k, t in enumerate(lit.exposures_s):
            take = good[cut] & usable[k][cut]
            light, variance = signals[k][cut][take], lit.variance[k][cut][take]
            parts.append(pool(light, variance, t, dark.mean_variance(t), lit.frames, True, row_variance))
        bins[position] = join(parts)
        if not np.any(bins[position].lit):
            raise SpecError(
                f"no lit value of tile position {position} is clear of clipping; capture shorter exposures or less "
                "light"
            )
    return {position: fit_variance(pooled) for position, pooled in bins.items()}, bins


def _unlike_their_kind(
    beta: NDArray,
    dark: FrameMoments,
    lit: FrameMoments,
    signals: NDArray,
    dark_clear: NDArray[np.bool_],
    usable: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Pixels whose variance over all exposures is not that of the polynomial: flickering, stuck or dead pixels.

    Parameters
    ----------
    beta : [tile_row, tile_col, 6], in DN and s.
    dark, lit : moments of the frames.
    signals : [exposure, row, col], light above black, DN.
    dark_clear, usable : [exposure, row, col], dark and lit values clear of clipping.

    Returns
    -------
    [row, col].
    """
    # χ² of each pixel over all exposures, less what is expected, [row, col]
    ratio = np.zeros(lit.mean.shape[1:])
    freedom = np.zeros_like(ratio)
    for moments, mask, signal in ((dark, dark_clear, None), (lit, usable, signals)):
        for k, t in enumerate(moments.exposures_s):
            light = np.zeros(ratio.shape, np.float32) if signal is None else signal[k]
            expected = np.maximum(variance_map(beta, light, t), 0) + ADC_VARIANCE_DN2
            ratio += np.where(mask[k], (moments.frames - 1) * (moments.variance[k] / expected - 1), 0.0)
            freedom += np.where(mask[k], moments.frames - 1, 0)
    # a χ² of k degrees of freedom has the variance 2k
    spread = np.sqrt(2 * np.maximum(freedom, 1))
    scaled = ratio / spread
    # A polynomial that fits poorly somewhere must not make the pixels there bad: compare with the actual spread.
    width = max(1.0, 1.4826 * float(np.median(np.abs(scaled - np.median(scaled)))))
    return np.abs(scaled) > _POOR_FIT_SIGMAS * width


def _unresponsive(composite: Composite, tile: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels whose signal is below a fiftieth of that of all but two of the 3×3 nearest pixels of their position."""
    unresponsive = np.zeros(composite.rate_dn_per_s.shape, bool)
    for i, j in np.ndindex(tile):
        rate = composite.rate_dn_per_s[i :: tile[0], j :: tile[1]]
        error = composite.standard_error_dn_per_s[i :: tile[0], j :: tile[1]]
        # the third lowest of the nine: a dead neighbour does not make a pixel look alive, nor does itself beyond a rim
        around = rank_filter(np.nan_to_num(rate, nan=0.0), 2, size=3, mode="mirror")
        unresponsive[i :: tile[0], j :: tile[1]] = (rate < 0.02 * around) & (around - rate > 10 * error)
    return unresponsive
