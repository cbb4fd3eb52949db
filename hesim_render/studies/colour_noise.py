"""Noise after colour correction, in closed form: amplification by the matrix, luminance SNR, SNR10, dynamic range.

The signal of a channel is in electrons of one pixel. Its variance is a quadratic function of the signal (read and dark
noise, shot noise, a part that grows with the square of the signal). A channel is the mean of `count` pixels. White
balance and matrix are linear, so the variance of every output is a quadratic function of the light, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError
from hesim_render.sensor.sensor import Sensor

#: Weights of linear R, G and B in the luminance whose noise is judged (ISO 15739, Y of ITU-R BT.601).
YSNR_WEIGHTS = (0.299, 0.587, 0.114)
#: Reflectance of the grey card on which noise is judged.
GREY = 0.18


@dataclass(frozen=True, eq=False)
class ChannelNoise:
    """Temporal variance of one pixel of each channel: v = constant + linear·s + quadratic·s², s in electrons.

    Parameters
    ----------
    constant : [channel], e⁻²: read noise, dark current, rounding.
    linear : [channel], e⁻: 1 for shot noise alone.
    quadratic : [channel].
    count : [channel], pixels whose mean is the channel; 1 for a single pixel.
    """

    constant: NDArray[np.float64]
    linear: NDArray[np.float64]
    quadratic: NDArray[np.float64]
    count: NDArray[np.float64]

    def variance_e2(self, signal_e: ArrayLike) -> NDArray[np.float64]:
        """Variance of the mean of a channel's pixels, e⁻², at signals [..., channel]."""
        s = np.asarray(signal_e, dtype=np.float64)
        return (self.constant + self.linear * s + self.quadratic * s**2) / self.count


def channel_noise(
    sensor: Sensor, filters: Sequence[str], exposure_us: float, area_px: float | None = None
) -> ChannelNoise:
    """Noise of the frame pixels behind each filter, rounding of the ADC included; fixed patterns are not noise here.

    Parameters
    ----------
    sensor : with frame pixels.
    filters : channels.
    exposure_us : µs.
    area_px : pixels of the mosaic that share one output pixel; a channel is the mean of its own ones among them. None:
        one pixel of each channel.

    Returns
    -------
    The noise of the channels, in their order.

    Raises
    ------
    RangeError
        If no frame pixel has a filter.
    """
    aps, spec = sensor.aps, sensor.spec
    gain = spec.aps.system_gain_dn_per_e if spec.aps is not None else 1.0
    full = aps.full_scale_dn / gain
    rows, count = [], []
    positions = spec.positions("aps")
    tile = spec.tile_rows
    for name in filters:
        own = [(i, j) for i, j in positions if spec.pixels[tile[i][j]].filter == name]
        if not own:
            raise RangeError("filters", name, "a filter of the frame pixels")
        # a quadratic function, averaged over the positions: three values tell it exactly
        at = np.array([0.0, full / 2, full])
        values = np.mean(
            [[aps.variance_dn2(s, exposure_us, position, adc=True) / gain**2 for s in at] for position in own], axis=0
        )
        rows.append(np.linalg.solve(np.vander(at, 3, increasing=True), values))
        count.append(1.0 if area_px is None else area_px * len(own) / (len(tile) * len(tile[0])))
    constant, linear, quadratic = np.array(rows).T
    return ChannelNoise(constant, linear, quadratic, np.array(count))


@dataclass(frozen=True, eq=False)
class OutputNoise:
    """Noise of a grey surface after white balance and matrix.

    Parameters
    ----------
    rgb : [3], mean of linear R, G and B; white is 1.
    covariance : [3, 3].
    amplification : noise of R, G and B over that of the balanced channels, as root mean squares.
    ysnr : luminance over its standard deviation.
    """

    rgb: NDArray[np.float64]
    covariance: NDArray[np.float64]
    amplification: float
    ysnr: float


def output_noise(
    matrix: ArrayLike,
    white_e: ArrayLike,
    noise: ChannelNoise,
    reflectance: float = GREY,
    weights: ArrayLike = YSNR_WEIGHTS,
) -> OutputNoise:
    """Noise of a grey surface after white balance and matrix, in closed form.

    With balanced channels b = s/s_white of variance v/s_white², R, G and B have the covariance M·diag(Var b)·Mᵀ. The
    amplification is √(tr(M·diag(Var b)·Mᵀ)/3) over √(mean Var b); it is 1 where the matrix is the identity.

    Parameters
    ----------
    matrix : [3, channel], from channels with white at 1 to linear sRGB.
    white_e : [channel], electrons of one pixel on a perfect white.
    noise : of the channels.
    reflectance : of the surface.
    weights : of R, G and B in the luminance.

    Examples
    --------
    Pixels with 10,000 electrons of white and shot noise alone. On the grey card each has 1800 ± √1800 electrons:

    >>> import numpy as np
    >>> from hesim_render.studies import ChannelNoise, output_noise
    >>> shot_noise = ChannelNoise(np.zeros(3), np.ones(3), np.zeros(3), np.ones(3))
    >>> outcome = output_noise(np.eye(3), [1e4] * 3, shot_noise, weights=(1, 0, 0))
    >>> round(outcome.ysnr**2, 6), outcome.amplification
    (1800.0, 1.0)

    Returns
    -------
    The noise.

    Raises
    ------
    RangeError
        If the shapes do not fit, or a channel sees no white.
    """
    table, white = np.asarray(matrix, dtype=np.float64), np.asarray(white_e, dtype=np.float64)
    _check(table, white, noise)
    balanced = noise.variance_e2(reflectance * white) / white**2
    covariance = table @ np.diag(balanced) @ table.T
    rgb = reflectance * table.sum(axis=1)
    w = np.asarray(weights, dtype=np.float64)
    amplification = math.sqrt(np.trace(covariance) / 3 / balanced.mean())
    return OutputNoise(rgb, covariance, amplification, float(w @ rgb / math.sqrt(w @ covariance @ w)))


def light_for_snr(
    wanted: float, luminance: ArrayLike, electrons_per_unit: ArrayLike, noise: ChannelNoise, reflectance: float = GREY
) -> float:
    """Light at which the luminance SNR of a grey surface reaches a value, in closed form.

    With E the light, the luminance is Y·E and its variance B + A·E + Q·E²; SNR² = wanted² is a quadratic equation.
    SNR10, the low-light figure of [alakarhu2007], is this light in lux for SNR 10 on an 18 % grey card.

    Parameters
    ----------
    wanted : SNR.
    luminance : [channel], weights of the *electrons* of the channels in the luminance.
    electrons_per_unit : [channel], electrons of one pixel on a perfect white per unit of light (lux).
    noise : of the channels.
    reflectance : of the surface.

    Examples
    --------
    A single pixel with 20 e⁻/lux of white and 2 e⁻ of read noise: N²= 100 (N + 4) gives N = 103.85 e⁻ at 28.85 lx.

    >>> from hesim_render.studies import ChannelNoise, light_for_snr
    >>> round(light_for_snr(10, [1.0], [20.0], ChannelNoise(*(np.array([x]) for x in (4.0, 1.0, 0.0, 1.0)))), 2)
    28.85

    Returns
    -------
    The light, in the unit of `electrons_per_unit`; infinite if noise that grows with the signal keeps the SNR below.

    Raises
    ------
    RangeError
        If the SNR is not above 0, or the luminance of the surface is not.
    """
    if not wanted > 0:
        raise RangeError("wanted", wanted, "an SNR above 0")
    u = np.asarray(luminance, dtype=np.float64)
    s = reflectance * np.asarray(electrons_per_unit, dtype=np.float64)
    y, share = float(u @ s), u**2 / noise.count
    if not y > 0:
        raise RangeError("luminance", u.tolist(), "weights that make grey positive")
    # the quadratic parts of pixels that are averaged are independent, as the formula of `variance_e2` has them
    rest = y**2 - wanted**2 * float(share @ (noise.quadratic * s**2))
    if rest <= 0:
        return math.inf
    a = wanted**2 * float(share @ (noise.linear * s))
    b = wanted**2 * float(share @ noise.constant)
    return (a + math.sqrt(a * a + 4 * rest * b)) / (2 * rest)


def dynamic_range_db(sensor: Sensor, exposure_us: float) -> float:
    """Dynamic range of a frame pixel, dB: saturation over the signal of SNR 1 (EMVA 1288, temporal noise).

    The signal of SNR 1 is √(σ_d² + ¼) + ½ electrons with the dark noise σ_d, rounding included. Saturation is the
    smaller one of full well and the top of the ADC, less the mean dark signal.

    Parameters
    ----------
    sensor : with frame pixels.
    exposure_us : µs.

    Examples
    --------
    >>> import math
    >>> import hesim_render as hr
    >>> from hesim_render.studies import dynamic_range_db
    >>> sensor = hr.load_sensor("reference-bayer")  # 15000 e⁻, 2 e⁻ of read noise, 1 DN = 4 e⁻
    >>> least = math.sqrt(2**2 + 4**2 / 12 + 0.25) + 0.5
    >>> round(dynamic_range_db(sensor, 10_000) - 20 * math.log10(15000 / least), 6)
    0.0

    Returns
    -------
    20 log₁₀ of the ratio.
    """
    saturation = saturation_e(sensor, exposure_us)
    first = sensor.spec.positions("aps")[0]
    spec = sensor.spec.aps
    assert spec is not None
    dark = float(sensor.aps.variance_dn2(0.0, exposure_us, first, adc=True)) / spec.system_gain_dn_per_e**2
    return 20 * math.log10(saturation / (math.sqrt(dark + 0.25) + 0.5))


def saturation_e(sensor: Sensor, exposure_us: float) -> float:
    """Light electrons at which a frame pixel saturates: full well or top of the ADC, less the mean dark signal."""
    spec = sensor.spec.aps
    if spec is None:
        raise RangeError("sensor", sensor.name, "one with frame pixels")
    dark = spec.dark_current_now_e_per_s * exposure_us * 1e-6
    top = (sensor.aps.full_scale_dn - spec.black_level_dn) / spec.system_gain_dn_per_e
    return max(min(spec.full_well_e, top) - dark, 0.0)


def _check(matrix: NDArray, white: NDArray, noise: ChannelNoise) -> None:
    if matrix.shape != (3, white.size) or noise.constant.shape != white.shape:
        raise RangeError("matrix", matrix.shape, f"(3, {white.size}), as many columns as channels")
    if not white.min() > 0:
        raise RangeError("white_e", white.tolist(), "electrons above 0 in every channel")
