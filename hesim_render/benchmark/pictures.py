"""Pictures of clips as measures compare them: linear sRGB of RAW, exposed alike, and encoded.

Bilinear demosaicing of any tile, a baseline: each channel is a mean of its samples around, weighted by a tent.
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from hesim_render.benchmark.folder import BenchmarkClip
from hesim_render.benchmark.metrics import learned, learned_measures
from hesim_render.core.units import S_PER_US
from hesim_render.isp.balance import white_balance
from hesim_render.isp.colour import colour_matrix
from hesim_render.isp.demosaicing import demosaic
from hesim_render.isp.levels import black_level
from hesim_render.isp.pipeline import Pipeline, process
from hesim_render.measure.pictures import delta_e, psnr, ssim
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.layout import Layout
from hesim_render.recording.manifest import sensor_spec
from hesim_render.specs.sensor import SensorSpec
from hesim_render.spectral.transfer import encode_exactly

_LINEAR = Pipeline.of("black_level", "white_balance", "demosaic", "colour_matrix")
#: The brightest half percent of the truth becomes this white.
_PERCENTILE, _WHITE = 99.5, 0.95


class ClipDevelopment:
    """RAW of one clip into comparable pictures.

    Parameters
    ----------
    clip : whose mosaic, colours and levels are used.
    """

    def __init__(self, clip: BenchmarkClip) -> None:
        self._clip = clip

    @cached_property
    def sensor(self) -> SensorSpec:
        """The sensor of the clip."""
        return sensor_spec(self._clip.recording.manifest, self._clip.recording.path)

    @cached_property
    def layout(self) -> Layout:
        """Places of frame and event pixels in the region that was read out."""
        roi = self._clip.recording.manifest["roi"]
        return Layout(self.sensor, roi["y"], roi["x"], roi["height_px"], roi["width_px"])

    def linear(self, raw: NDArray) -> NDArray[np.float32]:
        """Linear sRGB [row, col, 3] of RAW [row, col], DN; grey of a sensor without colours."""
        return np.asarray(process(raw, self._clip.recording.mosaic, self._pipeline), dtype=np.float32)

    @cached_property
    def _pipeline(self) -> Pipeline:
        tile = self._clip.recording.mosaic
        is_mono = len({name for row in tile.tile_filter for name in row if name}) == 1
        return Pipeline.of("black_level", "demosaic") if is_mono else _LINEAR

    def on_mosaic(self, events_map: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values of the event grid [y, x] at all pixels of the mosaic [row, col].

        They are linear along each row of event pixels, at their own columns, then linear between rows.
        """
        rows, cols = self.layout.shape
        places = self.layout.evs_pixel.reshape(self.layout.evs_shape)
        row_of, every = places[:, 0] // cols, np.arange(cols)
        along = np.stack([np.interp(every, p % cols, v) for p, v in zip(places, events_map, strict=True)])
        at = np.interp(np.arange(rows), row_of, np.arange(len(row_of)))
        # between two rows of event pixels; beyond the first and the last, their values
        low = np.minimum(at.astype(np.int64), max(0, len(row_of) - 2))
        weight = (at - low)[:, None]
        return (1 - weight) * along[low] + weight * along[np.minimum(low + 1, len(row_of) - 1)]

    def flow_on_mosaic(self, flow: NDArray[np.float64]) -> NDArray[np.float64]:
        """Flow of the event grid [y, x, 2], px of that grid, on the mosaic [row, col, 2], px of the mosaic.

        Pixels whose event pixels around have no flow (NaN) have none.
        """
        tile = self.sensor.tile_rows
        grid = self.sensor.evs_grid
        assert grid is not None
        pitch = np.array([len(tile[0]) / grid.cols_per_tile, len(tile) / grid.rows_per_tile])
        given: NDArray[np.bool_] = np.asarray(np.isfinite(flow).all(axis=-1))
        known: NDArray[np.float64] = np.where(given[..., None], flow, 0.0) * pitch
        result = np.stack([self.on_mosaic(known[..., k]) for k in range(2)], axis=-1)
        # half of the weight must come from pixels with a flow
        near = self.on_mosaic(given.astype(np.float64)) >= 0.5
        return np.where(near[..., None], result, np.nan)

    def grey_pair(self, first: NDArray, second: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Two RAW frames as 8-bit grey pictures (BT.709 luma, encoded as sRGB), both with the exposure of the first.

        Parameters
        ----------
        first, second : [row, col], DN.
        """
        a, b = (self.linear(raw) @ np.array([0.2126, 0.7152, 0.0722], np.float32) for raw in (first, second))
        bright = float(np.percentile(a, _PERCENTILE))
        gain = _WHITE / bright if bright > 0 else 1.0
        codes = [np.rint(255 * encode_exactly(np.clip(grey * gain, 0, 1))).astype(np.uint8) for grey in (a, b)]
        return codes[0], codes[1]

    def scores(self, raw: NDArray, truth: NDArray) -> dict[str, float]:
        """Measures of a RAW frame against the noise-free one.

        Both are developed to linear sRGB and multiplied by the factor that brings the truth's brightest half percent to
        0.95. PSNR and SSIM are of the encoded pictures with a peak of 1; ΔE is of the linear ones. `raw_psnr_db` is of
        the RAW values themselves, over frame pixels, of which 0 is black and 1 is full scale. Nothing is clipped at
        black: the curve of sRGB is odd, as that of bg-sRGB (IEC 61966-2-1, amendment 1).

        Parameters
        ----------
        raw, truth : [row, col], DN.
        """
        mosaic = self._clip.recording.mosaic
        black = mosaic.black_level_dn
        span = 2**mosaic.bit_depth - 1 - black
        valid = self.layout.aps_mask
        result = {"raw_psnr_db": psnr((raw - black) / span, (truth - black) / span, valid=valid)}
        return result | self._compared(self.linear(raw), self.linear(truth))

    def full_dn(self, flux: NDArray, exposure_us: float) -> NDArray[np.float64]:
        """What the sensor without noise would read of a flux, DN, not rounded; at most the white level.

        Parameters
        ----------
        flux : any shape, e⁻/s.
        exposure_us : exposure, µs.
        """
        mosaic = self._clip.recording.mosaic
        read = mosaic.black_level_dn + mosaic.system_gain_dn_per_e * flux.astype(np.float64) * exposure_us * S_PER_US
        return np.minimum(read, mosaic.white_level_dn)

    def linear_of_channels(self, channels: NDArray) -> NDArray[np.float32]:
        """Linear sRGB [row, col, 3] of every channel at every pixel [row, col, channel], DN: nothing to demosaic."""
        camera = Camera.of(self._clip.recording.mosaic)
        gains = np.array(camera.white_balance) / min(camera.white_balance)
        lifted = (channels - camera.black_level_dn) / (camera.white_level_dn - camera.black_level_dn)
        # clipped as `balance.white_balance` does it: where the channel of the smallest gain saturates
        balanced = np.minimum(lifted * gains, 1).astype(np.float32)
        return np.asarray(colour_matrix(balanced, camera.matrix), dtype=np.float32)

    def demosaiced(self, raw: NDArray) -> NDArray[np.float64]:
        """Every channel at every pixel, DN, by the package's own demosaicing of RAW [row, col], DN.

        As in its pipeline, it works on the balanced mosaic.
        """
        camera = Camera.of(self._clip.recording.mosaic)
        black, span = camera.black_level_dn, camera.white_level_dn - camera.black_level_dn
        gains, tile = camera.white_balance, camera.tile_channel
        lifted = black_level(raw, camera.black_level_dn, camera.white_level_dn)
        channels = demosaic(white_balance(lifted, tile, gains), tile)
        return channels.astype(np.float64) / (np.array(gains) / min(gains)) * span + black

    def channel_scores(self, channels: NDArray, truth: NDArray) -> dict[str, float]:
        """Measures of a demosaiced frame [row, col, channel], DN, against the truth, as those of `scores`."""
        mosaic = self._clip.recording.mosaic
        black, span = mosaic.black_level_dn, mosaic.white_level_dn - mosaic.black_level_dn
        result = {"channel_psnr_db": psnr((channels - black) / span, (truth - black) / span)}
        return result | self._compared(self.linear_of_channels(channels), self.linear_of_channels(truth))

    def _compared(self, picture: NDArray[np.float32], wanted: NDArray[np.float32]) -> dict[str, float]:
        """Measures of a picture in linear sRGB against the wanted one."""
        bright = float(np.percentile(wanted, _PERCENTILE))
        gain = _WHITE / bright if bright > 0 else 1.0
        picture, wanted = (np.minimum(image * gain, 1) for image in (picture, wanted))
        a, b = (np.copysign(encode_exactly(np.abs(image)), image) for image in (picture, wanted))
        result = {"psnr_db": psnr(a, b), "delta_e": delta_e(picture, wanted)}
        if min(a.shape[:2]) >= 11:
            result["ssim"] = ssim(a, b)
        return result | {name: learned(name, a, b) for name in learned_measures()}


def bilinear(raw: NDArray, tile: ArrayLike) -> NDArray[np.float64]:
    """Every channel at every pixel, [row, col, channel], DN.

    The tent falls to zero one tile away, so that every pixel has samples of every channel. On a Bayer tile this is the
    usual bilinear interpolation. Measured values stay as they are.

    Parameters
    ----------
    raw : [row, col], DN.
    tile : [tile_row, tile_col], channel number of each position from 0 on, -1 where there is no value.
    """
    block = np.asarray(tile)
    rows, cols = np.ogrid[: raw.shape[0], : raw.shape[1]]
    channel = block[rows % block.shape[0], cols % block.shape[1]]
    out = np.empty((*raw.shape, int(block.max()) + 1))
    for number in range(out.shape[-1]):
        own = channel == number
        total, weight = (_tent(values.astype(np.float64), block.shape) for values in (np.where(own, raw, 0), own))
        out[..., number] = np.where(own, raw, total / np.maximum(weight, 1e-12))
    return out


def _tent(values: NDArray[np.float64], period: tuple[int, ...]) -> NDArray[np.float64]:
    for axis, width in enumerate(period):
        weights = 1 - np.abs(np.arange(1 - width, width)) / width
        values = correlate1d(values, weights, axis=axis, mode="constant")
    return values
