"""Full simulation of a chart with noise: RAW values of every patch, averaged to channels, balanced and corrected."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import mixed
from hesim_render.spectral.colorimetry import delta_e_2000, lab
from hesim_render.studies.colour_noise import YSNR_WEIGHTS
from hesim_render.studies.colour_samples import ColourSamples

#: Fixed patterns, which are no temporal noise.
_FIXED = ("prnu", "dsnu", "row")
#: Patches with the grey card at the end of a chart.
GREYS = 8


@dataclass(frozen=True, eq=False)
class NoisyChart:
    """Channels of the patches of a chart in repeated noisy frames.

    Parameters
    ----------
    channels : [repeat, patch, tile, channel], electrons; a channel is the mean of its pixels of one tile.
    tile_px : pixels of a tile.
    """

    channels: NDArray[np.float64]
    tile_px: int

    def balanced(self, white_e: NDArray[np.float64], area_px: float) -> NDArray[np.float64]:
        """`channels` with white at 1, with the noise of an area other than a tile: deviations from the mean are scaled.

        Parameters
        ----------
        white_e : [channel], electrons of one pixel on a perfect white.
        area_px : pixels that share one output pixel.
        """
        mean = self.channels.mean(axis=(0, 2), keepdims=True)
        return (mean + (self.channels - mean) * sqrt(self.tile_px / area_px)) / white_e


def noisy_chart(
    sensor: Sensor,
    filters: Sequence[str],
    patch_e: NDArray[np.float64],
    exposure_us: float,
    *,
    repeats: int,
    patch_px: int,
    crosstalk: float = 0.0,
    seed: int = 1,
) -> NoisyChart:
    """Expose a chart of even patches, with the temporal noise of the sensor, crosstalk, full well and ADC.

    Parameters
    ----------
    sensor : the whole sensor; the chart lies in its middle, or in that of the part that its calibration has measured.
    filters : of the frame pixels, the channels of the result.
    patch_e : [patch, filter of the sensor], electrons of a pixel behind every filter, without crosstalk.
    exposure_us : µs.
    repeats : number of frames.
    patch_px : side of a patch, about; it is rounded up to whole tiles.
    crosstalk : part of a pixel's electrons that its neighbours collect.
    seed : of the noise.

    Raises
    ------
    RangeError
        If the chart is larger than the sensor.
    """
    tile_rows, tile_cols = sensor.layout.tile_shape
    count = len(patch_e)
    # a nearly square chart in whole tiles; what is left over repeats the last patch
    across = ceil(sqrt(count))
    down = ceil(count / across)
    high, wide = (-(-patch_px // size) * size for size in (tile_rows, tile_cols))
    whole = sensor.calibrated_part
    if across * wide > whole.cols or down * high > whole.rows:
        raise RangeError(
            "noise.patch_px", patch_px,
            f"a size at which {count} patches fit on {whole.cols}x{whole.rows} px of sensor {sensor.name!r}",
        )  # fmt: skip
    part = whole.crop(across * wide, down * high)
    number = np.arange(down)[:, None] * across + np.arange(across)
    patch = np.minimum(np.kron(number, np.ones((high, wide), dtype=np.int64)), count - 1)
    image = mixed(patch_e[patch, part.layout.filter_index], crosstalk)
    # temporal noise alone: fixed patterns would be the same in all repeats
    aps = part.aps.without(*_FIXED)
    spec = part.spec.aps
    assert spec is not None
    dark = 0.0 if "dark_current" in aps.off else spec.dark_current_now_e_per_s * exposure_us * 1e-6
    frames = []
    for repeat in range(repeats):
        raw = aps.sample(image, exposure_us, seed, repeat).astype(np.float64)
        frames.append((raw - spec.black_level_dn) / spec.system_gain_dn_per_e - dark)
    # a tile at the rim of a patch has light of its neighbours
    margin = 1 if crosstalk > 0 else 0
    shape = (repeats, down, high // tile_rows, tile_rows, across, wide // tile_cols, tile_cols)
    cells = np.stack(frames).reshape(shape)
    if margin and cells.shape[2] > 2 and cells.shape[5] > 2:
        cells = cells[:, :, margin:-margin, :, :, margin:-margin]
    channels = np.stack([_mean_of(cells, sensor, name) for name in filters], axis=-1)
    # [repeat, down, tiles, across, tiles, channel] to [repeat, patch, tile, channel]
    channels = channels.swapaxes(2, 3).reshape(repeats, down * across, -1, len(filters))[:, :count]
    return NoisyChart(channels, tile_rows * tile_cols)


def _mean_of(cells: NDArray, sensor: Sensor, name: str) -> NDArray[np.float64]:
    spec = sensor.spec
    own = [(i, j) for i, j in spec.positions("aps") if spec.pixels[spec.tile_rows[i][j]].filter == name]
    return np.mean([cells[:, :, :, i, :, :, j] for i, j in own], axis=0)


@dataclass(frozen=True)
class Measured:
    """Mean of a figure over repeats, and its 95 % interval (Student's t)."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> "Measured":
        """From one value per repeat; without an interval for a single one."""
        from scipy.stats import t

        mean = float(values.mean())
        if values.size < 2:
            return cls(mean, float("nan"), float("nan"))
        half = float(t.ppf(0.975, values.size - 1) * values.std(ddof=1) / sqrt(values.size))
        return cls(mean, mean - half, mean + half)


def measured_figures(
    balanced: NDArray[np.float64],
    rgb_matrix: NDArray[np.float64],
    xyz_matrix: NDArray[np.float64],
    samples: ColourSamples,
) -> dict[str, Measured]:
    """Figures of noisy frames whose last `GREYS` patches are the grey card.

    Parameters
    ----------
    balanced : [repeat, patch, tile, channel], channels with white at 1.
    rgb_matrix, xyz_matrix : [3, channel], to linear sRGB and to XYZ.
    samples : the true colours of the patches but the grey card's.

    Returns
    -------
    ``ysnr`` and ``noise_amplification`` on the grey card, ``delta_e_noisy``: mean ΔE2000 of noisy output pixels.
    """  # fmt: skip
    grey = _grey_card(balanced)
    rgb = grey @ rgb_matrix.T
    amplification = np.sqrt(rgb.var(axis=1, ddof=1).mean(axis=-1) / grey.var(axis=1, ddof=1).mean(axis=-1))
    seen = lab(balanced[:, :-GREYS] @ xyz_matrix.T, samples.white_xyz)
    # against the true colour of each patch, at every output pixel
    wanted = lab(samples.xyz, samples.white_xyz)[None, :, None]
    difference = delta_e_2000(seen, np.broadcast_to(wanted, seen.shape))
    return {
        "ysnr": measured_luminance(balanced, np.array(YSNR_WEIGHTS) @ rgb_matrix),
        "noise_amplification": Measured.of(amplification),
        "delta_e_noisy": Measured.of(difference.mean(axis=(1, 2))),
    }


def measured_luminance(balanced: NDArray[np.float64], weights: NDArray[np.float64]) -> Measured:
    """Luminance over its standard deviation on the grey card of noisy frames.

    Parameters
    ----------
    balanced : as for `measured_figures`.
    weights : [channel], of the channels in the luminance.

    Returns
    -------
    The mean over frames, with its interval.
    """
    luminance = _grey_card(balanced) @ weights
    return Measured.of(luminance.mean(axis=1) / luminance.std(axis=1, ddof=1))


def _grey_card(balanced: NDArray[np.float64]) -> NDArray[np.float64]:
    """The output pixels of the grey card, [repeat, pixel, channel]."""
    return balanced[:, -GREYS:].reshape(len(balanced), -1, balanced.shape[-1])
