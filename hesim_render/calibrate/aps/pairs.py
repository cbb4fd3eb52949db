"""Calibration from captures of EMVA 1288, in the order of the standard (Release 4.0 linear) [emva2021].

Mean and variance of the pairs give gain, responsivity, quantum efficiency, dark noise and linearity. The long series
give DSNU, PRNU, defects and the fixed maps. Beyond the standard, the curve of the mean is measured, and what rows and
columns get anew in each frame, because a twin of the sensor needs them.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law

from hesim_render.calibrate.aps.light_curve import (
    Intercept,
    Line,
    MeanCurve,
    linearity_error,
    mean_curve,
    require_steady_light,
    straight,
    through_origin,
)
from hesim_render.calibrate.aps.long_series import (
    Long,
    long_series,
    require_dark_noise,
    require_series_below_well,
    stuck_pixels,
)
from hesim_render.calibrate.aps.noise_spectrum import NoiseSpectrum
from hesim_render.calibrate.aps.pair_levels import CLIPPED_SHARE, Levels, both_levels, require_one_colour
from hesim_render.calibrate.aps.rounded_noise import RoundedNoise, rounded_noise, without_rounding
from hesim_render.calibrate.aps.spatial import Pattern, outliers, pattern_of
from hesim_render.calibrate.aps.variance import Pooled, VarianceFit, fit_variance
from hesim_render.calibrate.estimate import Z_95
from hesim_render.calibrate.moments import Progress
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import require_memory
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, polynomial
from hesim_render.recording.pair_set import PairSet

#: EMVA 1288 fits from 0 to this part of saturation.
_FIT_TOP = 0.7
#: Part of saturation at which it takes the long series.
_LONG_AT = 0.5
#: Dark variance as measured, DN², below which EMVA 1288 gives the dark noise no value but a limit, and that limit, DN.
_LEAST_DARK_DN2, DARK_NOISE_LIMIT_DN = 0.24, 0.49
_FEWEST_CLEAR = 5
#: Memory of an evaluation, most of it transforms of frames in double precision.
_BYTES_PER_PIXEL = 200
#: Terms of the variance polynomial that flat fields of one light at many exposures do not tell: I t and t².
_NO_TERMS = (4, 5)


@dataclass(frozen=True)
class PairCalibration:
    """What captures of EMVA 1288 tell, before it is written.

    Attributes
    ----------
    lit, dark : statistics of the pairs, `dark[k]` of the exposure of `lit[k]`.
    signal : lit less dark mean, DN.
    saturation : number of the level of the largest variance; as many as there are levels where none saturates.
    clear : levels that the curve and the variance are fitted to.
    gain, responsivity : K in DN/e⁻ and R in DN per photon (or per s of exposure), as the standard fits them.
    black, noise : mean and variance of the dark against exposure.
    curve : mean signal against light.
    fit : variance polynomial, without what rows and columns share.
    level_chi2 : of the variances of single levels about the polynomial, per degree of freedom.
    level_chance : of a larger one.
    level_rms : their relative scatter beyond their own errors.
    row, col : temporal variance of rows and columns, and standard errors, DN².
    linearity : the levels used, and their deviations, %.
    long_dark, long_lit : the long series.
    dark_pattern, light_pattern : offset, DN, and relative response, without noise.
    defects : [row, col], pixels unlike the others in the dark or in the light.
    """

    pairs: PairSet
    lit: Levels
    dark: Levels
    signal: NDArray[np.float64]
    saturation: int
    clear: NDArray[np.bool_]
    gain: Line
    responsivity: Line
    black: Intercept
    noise: Intercept
    curve: MeanCurve
    fit: VarianceFit
    bins: Pooled
    level_chi2: float
    level_chance: float
    level_rms: float
    row: tuple[float, float]
    col: tuple[float, float]
    linearity: tuple[NDArray[np.bool_], NDArray[np.float64]]
    long_dark: Long
    long_lit: Long
    dark_pattern: Pattern
    light_pattern: Pattern
    defects: NDArray[np.bool_]

    @property
    def lines_dn2(self) -> float:
        """Mean variance of the interference, DN²."""
        return sum(line.rms_dn**2 for line in self.noise_spectrum.lines)

    @property
    def noise_spectrum(self) -> NoiseSpectrum:
        """Spectrum of the dark noise."""
        assert self.long_dark.spectrum is not None
        return self.long_dark.spectrum

    @property
    def dark_noise_is_rounded_off(self) -> bool:
        """Whether rounding hides the dark noise (EMVA 1288 R4.0: a measured variance below 0.24 DN²)."""
        return self.dark.least_variance < _LEAST_DARK_DN2

    @cached_property
    def rounded_noise(self) -> RoundedNoise | None:
        """Dark noise from the probabilities of grey values where rounding hides its variance; None where nothing does
        or none changes.
        """
        return rounded_noise(self.long_dark, self.defects) if self.dark_noise_is_rounded_off else None

    @property
    def light(self) -> NDArray[np.float64]:
        """Light of each level: photons per pixel, or the exposure in s where photons are not stated."""
        return light_of(self.pairs, self.lit)

    @property
    def top_dn(self) -> float:
        """Signal at saturation, DN: of the largest variance, or the largest seen."""
        return float(self.signal[min(self.saturation, self.signal.size - 1)])

    @property
    def brightest_dn(self) -> float:
        """Largest mean above black, DN: where a full well cuts off."""
        return float(self.lit.mean.max()) - self.black.value


def light_of(pairs: PairSet, levels: Levels) -> NDArray[np.float64]:
    """Photons per pixel of each level, or its exposure in s where photons are not stated."""
    return levels.photons if pairs.has_photons else levels.exposure_s


def evaluate(pairs: PairSet, progress: Progress | None = None) -> PairCalibration:
    """Read and evaluate captures of EMVA 1288.

    Raises
    ------
    SpecError
        With file and line, if the captures are saturated, clipped at 0, or lit by light that drifts.
    """
    require_memory(_BYTES_PER_PIXEL * pairs.shape[0] * pairs.shape[1], "maps and transforms of a frame", pairs.file)
    # mean and temporal variance of every level, from pairs of frames; where they saturate the variance falls again
    lit, dark = both_levels(pairs, progress)
    signal, light = lit.mean - dark.mean, light_of(pairs, lit)
    saturation = _saturation(lit)
    # of several long series, the one that the standard asks for
    pairs = pairs.with_long_at(_LONG_AT * float(light[min(saturation, light.size - 1)]))
    long_dark, long_lit = long_series(pairs, progress)
    require_dark_noise(pairs, dark, long_dark)
    if dark.least_variance >= _LEAST_DARK_DN2:
        dark, long_dark = without_rounding(dark, long_dark)
    require_series_below_well(pairs, long_lit, lit, saturation)
    require_one_colour(pairs.spatial_lit, long_lit.mean - long_dark.mean)
    top = float(signal[min(saturation, signal.size - 1)])
    # levels of whose variance nothing is cut off
    clear = lit.clear & (np.arange(signal.size) < saturation) & (signal > 0)
    if clear.sum() < _FEWEST_CLEAR:
        last = pairs.lit[min(int(clear.sum()), signal.size - 1)]
        half = ", of every second one," if pairs.halved else ""
        raise last.error(
            f"saturated from here on: only {int(clear.sum())} of {signal.size} lit exposures{half} are clear of "
            f"saturation, and {_FEWEST_CLEAR} are the fewest; capture shorter exposures or less light"
        )
    if light[clear].min() == light[clear].max():
        raise pairs.lit[0].error("all lit pairs have one light; EMVA 1288 needs many, up to saturation")
    row, col = _shared(dark, long_dark)
    # photon transfer: K is the slope of the variance above the dark against the signal
    use = clear & (signal <= _FIT_TOP * top)
    difference = lit.variance - dark.variance
    gain = through_origin(signal[use], difference[use], _difference_covariance(pairs, lit, dark, use))
    if not gain.slope > 5 * gain.error:
        raise SpecError(
            "the variance does not rise with the light; no gain follows from these captures", file=pairs.file
        )
    # responsivity: the slope of the signal against the light, with errors from its own scatter
    responsivity = through_origin(light[use], signal[use], None)
    # a level is the mean of two frames of all pixels: its error is what rows share, and the noise of the pixels
    shared_error = np.sqrt((max(row[0], 0.0) + long_dark.temporal.pixel / pairs.shape[1]) / pairs.shape[0] / 2)
    distinct = np.unique(dark.exposure_s, return_index=True)[1]
    # dark current and dark noise: straight lines against the exposure
    black = straight(dark.exposure_s[distinct], dark.mean[distinct], np.full(distinct.size, max(shared_error, 1e-6)))
    noise = straight(dark.exposure_s[distinct], dark.variance[distinct], dark.error[distinct])
    # beyond the standard: the curve bends, and light may be more than stated
    curve = mean_curve(light[clear], signal[clear], np.full(int(clear.sum()), np.hypot(shared_error, black.rms)))
    require_steady_light(pairs, curve, light, signal, clear)
    # the variance as a polynomial, with errors that include the scatter of whole levels
    bins = _bins(pairs, lit, dark, signal, clear, distinct)
    fit = _variance_fit(bins)
    level_chi2, level_chance, level_rms = _scatter(pairs, lit, signal, clear, fit)
    fit = _widened(fit, level_chi2)
    # fixed patterns from the long series, without the noise of their means; pixels unlike the others are defects
    dark_pattern = pattern_of(long_dark.mean, long_dark.spatial.noise, long_dark.spectrum, long_dark.frames)
    relative, relative_noise = _relative(long_lit, long_dark, curve, light[clear])
    light_pattern = pattern_of(relative, relative_noise)
    defects = outliers(long_dark.mean, long_dark.spatial.noise) | outliers(relative, relative_noise)
    defects |= np.any(stuck_pixels(pairs.spec.full_scale_dn, long_dark, long_lit), axis=0)
    result = PairCalibration(
        pairs, lit, dark, signal, saturation, clear, gain, responsivity, black, noise, curve, fit, bins, level_chi2,
        level_chance, level_rms, row, col, linearity_error(light[clear], signal[clear], top), long_dark, long_lit,
        dark_pattern, light_pattern, defects,
    )  # fmt: skip
    return replace(result, fit=_with_dark_noise(result))


def _saturation(lit: Levels) -> int:
    """Number of the level whose variance is largest; the number of levels where it rises to the end."""
    whole = lit.variance + np.maximum(lit.row, 0.0)
    k = int(np.argmax(whole))
    return whole.size if k == whole.size - 1 and lit.high[k] <= CLIPPED_SHARE else k


def _shared(dark: Levels, long_dark: Long) -> tuple[tuple[float, float], tuple[float, float]]:
    """Temporal row and column variance with standard errors, DN², from all dark pairs and the long dark series.

    Lit frames are not used: a lamp that flickers changes rows of a rolling shutter.
    """
    of_pairs = np.unique(dark.exposure_s, return_index=True)[1]
    result = []
    for values, errors in ((dark.row, dark.row_error), (dark.col, dark.col_error)):
        error = float(np.sqrt(np.mean(errors[of_pairs] ** 2) / of_pairs.size))
        result.append((float(values[of_pairs].mean()), error))
    row, row_error = result[0]
    series, series_error = long_dark.temporal.row, max(long_dark.temporal.row_error, 1e-30)
    weight = np.array([1 / max(row_error, 1e-30) ** 2, 1 / series_error**2])
    pooled = float(weight @ (row, series) / weight.sum())
    return (pooled, float(1 / np.sqrt(weight.sum()))), result[1]


def _difference_covariance(pairs: PairSet, lit: Levels, dark: Levels, use: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Covariance of lit less dark variances; levels that have one dark pair share its error."""
    numbers = np.flatnonzero(use)
    # a dark pair that serves several levels moves them together
    same = np.array([[pairs.dark[i] is pairs.dark[j] for j in numbers] for i in numbers])
    return np.diag(lit.error[use] ** 2) + same * np.outer(dark.error[use], dark.error[use])


def _bins(
    pairs: PairSet, lit: Levels, dark: Levels, signal: NDArray, clear: NDArray[np.bool_], distinct: NDArray
) -> Pooled:
    """One bin a pair for the fit of the variance polynomial."""
    pixels = float(pairs.shape[0] * pairs.shape[1])
    # each dark pair once, then the lit ones; sums are those of pixels that all have the mean signal of the level
    light = np.concatenate([np.zeros(distinct.size), signal[clear]])
    variance = np.concatenate([dark.variance[distinct], lit.variance[clear]]) - ADC_VARIANCE_DN2
    raw = np.concatenate([dark.squares[distinct], lit.squares[clear]])
    squares = raw - 2 * ADC_VARIANCE_DN2 * (variance + ADC_VARIANCE_DN2) + ADC_VARIANCE_DN2**2
    exposure = np.concatenate([dark.exposure_s[distinct], lit.exposure_s[clear]])
    is_lit = np.arange(light.size) >= distinct.size
    zero = np.zeros(light.size)
    return Pooled(
        exposure, zero, np.asarray(pixels * light[:, None] ** np.arange(7), np.float64),
        pixels * (variance * light ** np.arange(4)[:, None]).T,
        pixels * squares, zero, np.ones(light.size), is_lit,
    )  # fmt: skip


def _variance_fit(bins: Pooled) -> VarianceFit:
    """The polynomial in 1, I, t and I²: one light at many exposures, or many at one, tells no more.

    Where dark current makes no visible noise, the term in t is left out too: its sign would be chance. Dark variances
    above the standard's limit are all used: levels in the light alone would tell the constant badly.
    """
    least = _LEAST_DARK_DN2 - ADC_VARIANCE_DN2
    fit = fit_variance(bins, _NO_TERMS, least)
    if fit.beta[2] > 2 * np.sqrt(fit.covariance[2, 2]):
        return fit
    return fit_variance(bins, (2, *_NO_TERMS), least)


def _scatter(
    pairs: PairSet, lit: Levels, signal: NDArray, clear: NDArray[np.bool_], fit: VarianceFit
) -> tuple[float, float, float]:
    """χ² per degree of freedom of the lit levels' variances, its chance, and their relative scatter beyond errors.

    The errors are from the scatter of rows, so that the ratio has an F law.
    """
    expected = polynomial(fit.beta, signal[clear], lit.exposure_s[clear]) + ADC_VARIANCE_DN2
    residual, error = lit.variance[clear] - expected, lit.error[clear]
    dof = max(int(clear.sum() - fit.identified.sum()), 1)
    chi2 = float(np.sum((residual / error) ** 2)) / dof
    excess = float(np.mean(((residual**2) * clear.sum() / dof - error**2) / expected**2))
    return chi2, float(f_law.sf(chi2, dof, pairs.shape[0] - 1)), float(np.sqrt(max(excess, 0.0)))


def _widened(fit: VarianceFit, level_chi2: float) -> VarianceFit:
    """The fit with errors that include that whole levels, not only pixels, scatter about the polynomial."""
    values = {name: getattr(fit, name) for name in VarianceFit.__dataclass_fields__}
    return VarianceFit(**{**values, "covariance": fit.covariance * max(level_chi2, 1.0)})


def _with_dark_noise(result: PairCalibration) -> VarianceFit:
    """The fit with the dark noise that grey values tell where no dark variance could be used."""
    noise, fit = result.rounded_noise, result.fit
    if noise is None:
        return fit
    line = np.array([1.0, 0.0, result.pairs.spatial_dark.exposure_s, 0.0, 0.0, 0.0])
    shared = sum(max(value, 0.0) for value, _ in (result.row, result.col))
    error = 2 * noise.value * (noise.high - noise.low) / (2 * Z_95)
    own = error**2 + result.row[1] ** 2 + result.col[1] ** 2
    gain = fit.covariance @ line / (line @ fit.covariance @ line + own)
    beta = fit.beta + gain * (noise.value**2 - shared - line @ fit.beta)
    covariance = fit.covariance - np.outer(gain, line @ fit.covariance)
    return replace(fit, beta=beta, covariance=covariance)


def _relative(
    lit: Long, dark: Long, curve: MeanCurve, light: NDArray
) -> tuple[NDArray[np.float64], tuple[float, float, float]]:
    """Response of each pixel relative to the mean, less 1, and the noise of its row, column and pixel means.

    Where the curve bends, a pixel with 1 % more light has less than 1 % more signal; this is taken back. The dark
    pattern that is subtracted is the expected one: the noise of the dark mean would be in the response with its sign
    changed, and the lit pattern of a twin, which has both, be too small.
    """
    expected = pattern_of(dark.mean, dark.spatial.noise, dark.spectrum, dark.frames, expected=True)
    signal = lit.mean - dark.mean.mean() - expected.whole
    level = float(signal.mean())
    # the light at which the curve gives the mean signal of the series, by a table
    places = np.linspace(float(light.min()), float(light.max()), 512)
    here = float(np.interp(level, curve.at(places), places))
    shifted = here + curve.offset
    # signal ∝ lightᵉ about there: e is 1 where the curve is straight
    exponent = float(curve.gradient(np.array([here]))[0, 0]) * shifted / float(curve.at(np.array([here]))[0])
    scale = level * exponent
    # of the dark pattern that part is unknown which is as large as what is known of its noise
    own, given = np.maximum(dark.spatial.parts, 0.0), np.array(dark.spatial.noise)
    noise = (np.array(lit.spatial.noise) + given * own / np.maximum(own + given, 1e-300)) / scale**2
    return (signal / level - 1) / exponent, (float(noise[0]), float(noise[1]), float(noise[2]))
