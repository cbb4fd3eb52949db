"""A twin against captures that it was not fitted on: one z-score a figure, with the errors of both.

An error has the noise of the captures, that of the simulated frames, and that of the fitted parameters. What the bench
does between exposures (light, black level) and the ADC's uneven steps scatter by the amount that the fitted half shows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law
from scipy.stats import t as student

from hesim_render.calibrate.aps.long_series import Long, stuck_pixels
from hesim_render.calibrate.aps.pair_levels import WELL_SHARE, Levels
from hesim_render.calibrate.aps.pairs import PairCalibration, light_of
from hesim_render.calibrate.aps.rounded_noise import RoundedNoise, rounded_noise
from hesim_render.pixels.aps.formulas import polynomial
from hesim_render.recording.pair_set import PairSet
from hesim_render.twin.figures import bin_edges, counts_in, deviations, spectra, without_defects, without_lines

#: Probability that one check fails for a twin that is right.
ALARM = 1e-3
#: Relative differences of the end of the signal that tell nothing: full wells differ from pixel to pixel.
_SAME_END = 1e-3
#: Relative error of a noise under rounding: levels of a twin's pixels are not known better than a part of a step.
_SAME_LEVELS = 0.02
#: Degrees of freedom that count as any number.
_MANY = 1e6


@dataclass(frozen=True)
class Check:
    """One statistic of the captures and of the twin, at one or more places.

    Attributes
    ----------
    name : of the statistic.
    unit, place : unit of the values, and what `places` are.
    places, real, twin, error : [n]; the error is that of the difference.
    freedom : degrees of freedom that the error is known with.
    """

    name: str
    unit: str
    place: str
    places: NDArray[np.float64]
    real: NDArray[np.float64]
    twin: NDArray[np.float64]
    error: NDArray[np.float64]
    freedom: float = np.inf

    @property
    def z(self) -> NDArray[np.float64]:
        """Difference over its error."""
        return (self.twin - self.real) / np.maximum(self.error, 1e-300)

    @property
    def limit(self) -> float:
        """Largest |z| that passes: one place of a right twin is beyond with a probability of half of `ALARM`."""
        return float(student.isf(ALARM / (4 * self.z.size), self.freedom))

    @property
    def most_rms(self) -> float:
        """Largest rms that passes: that of a right twin is beyond with a probability of half of `ALARM`."""
        return float(np.sqrt(f_law.isf(ALARM / 2, self.z.size, min(self.freedom, _MANY))))

    @property
    def worst(self) -> float:
        """The z of the largest size."""
        return float(self.z[np.argmax(np.abs(self.z))])

    @property
    def rms(self) -> float:
        """Root of the mean of z²; about 1 for a twin that is right."""
        return float(np.sqrt(np.mean(self.z**2)))

    @property
    def passed(self) -> bool:
        return bool(np.all(np.abs(self.z) <= self.limit)) and self.rms <= self.most_rms


@dataclass(frozen=True)
class Half:
    """Figures of one half of the captures, real or simulated."""

    lit: Levels
    dark: Levels
    long_dark: Long
    long_lit: Long

    @property
    def signal(self) -> float:
        """Mean signal of the lit long series, DN."""
        return float(self.long_lit.mean.mean() - self.long_dark.mean.mean())


def compare(result: PairCalibration, held: PairSet, real: Half, twin: Half) -> list[Check]:
    """All checks.

    Parameters
    ----------
    result : what was fitted, to the other half.
    held : the captures that were held out.
    real, twin : their figures and those of the twin.

    Where rounding hides the dark noise, only what grey values tell about it is compared in the dark.
    """
    checks = [
        *_temporal(result, held, real, twin),
        *_end(result, real, twin),
        *_shared(result, real, twin),
        *_spatial(result, real, twin),
    ]
    if not result.dark_noise_is_rounded_off:
        return checks
    return [*(check for check in checks if not check.name.endswith("dark")), *_under_rounding(result, real, twin)]


def _under_rounding(result: PairCalibration, real: Half, twin: Half) -> list[Check]:
    """Dark noise that grey values tell where its variance does not: of captures and twin in the same way."""
    noise = [rounded_noise(half.long_dark, result.defects) for half in (real, twin)]
    own = result.rounded_noise
    if own is None or noise[0] is None:
        return []
    # a twin whose grey values never change has no noise that could be seen
    its = RoundedNoise(0.0, 0.0, 0.0, 0.0, 0.0) if noise[1] is None else noise[1]
    chance = np.linalg.norm([own.error, noise[0].error, its.error])
    error = np.hypot(chance, _SAME_LEVELS * noise[0].value)
    mine, other, unknown = (np.array([value]) for value in (noise[0].value, its.value, float(error)))
    return [Check("noise under rounding", "DN", "", np.zeros(1), mine, other, unknown)]


def _temporal(result: PairCalibration, held: PairSet, real: Half, twin: Half) -> list[Check]:
    """Mean and temporal variance of the pairs, in the light and in the dark."""
    light = light_of(held, real.lit)
    rows, cols = held.shape
    clear = real.lit.clear & twin.lit.clear & (light <= result.light[result.clear].max() * 1.05)
    signal = result.curve.at(light)
    bench = (result.curve.light_rms * signal) ** 2 + result.black.rms**2
    fitted = result.curve.error(light) ** 2 + result.black.error_at(real.lit.exposure_s) ** 2
    own = real.lit.variance / (rows * cols) + max(result.row[0], 0.0) / rows
    mean_error = np.sqrt(bench + fitted + own)
    fit = result.fit.covariance
    design = np.stack([
        np.ones_like(signal), signal, real.lit.exposure_s, signal**2, signal * real.lit.exposure_s,
        real.lit.exposure_s**2,
    ])  # fmt: skip
    of_fit = np.einsum("il,ij,jl->l", design, fit, design)
    expected = polynomial(result.fit.beta, signal, real.lit.exposure_s)
    variance_error = np.sqrt(
        real.lit.error**2 + twin.lit.error**2 + of_fit + (result.level_rms * expected) ** 2
        + 2 * result.noise.rms**2
    )  # fmt: skip
    t = np.unique(real.dark.exposure_s, return_index=True)[1]
    dark_error = np.hypot(np.sqrt(2) * result.black.rms, result.black.error_at(real.dark.exposure_s[t]))
    dark_variance_error = np.sqrt(
        real.dark.error[t] ** 2
        + twin.dark.error[t] ** 2
        + 2 * result.noise.rms**2
        + result.noise.error_at(real.dark.exposure_s[t]) ** 2
    )
    place = "photons per pixel" if held.has_photons else "exposure, s"
    ms = 1e3 * real.dark.exposure_s[t]
    here = light[clear]

    # how much light, black level and steps of the ADC scatter is known from the fitted half alone
    terms = max(int(np.count_nonzero(np.diag(result.curve.covariance))), int(result.fit.identified.sum()) - 1)
    lit_freedom = max(int(result.clear.sum()) - terms, 1)
    dark_freedom = max(result.black.groups - 1, 1)

    def lit(name: str, unit: str, key: str, error: NDArray) -> Check:
        mine, its = (getattr(half.lit, key)[clear] for half in (real, twin))
        return Check(name, unit, place, here, mine, its, error[clear], lit_freedom)

    def dark(name: str, unit: str, key: str, error: NDArray) -> Check:
        mine, its = (getattr(half.dark, key)[t] for half in (real, twin))
        return Check(name, unit, "exposure, ms", ms, mine, its, error, dark_freedom)

    return [
        lit("mean, lit", "DN", "mean", mean_error),
        dark("mean, dark", "DN", "mean", dark_error),
        lit("temporal variance, lit", "DN²", "variance", variance_error),
        dark("temporal variance, dark", "DN²", "variance", dark_variance_error),
    ]


def _end(result: PairCalibration, real: Half, twin: Half) -> list[Check]:
    """Where a full well cuts the signal off: the brightest level, as surely as the fitted half has two that agree."""
    beyond = np.sort(result.lit.mean[result.saturation + 1 :])
    if beyond.size < 2 or result.lit.high[result.saturation :].max() > WELL_SHARE:
        return []
    here = np.array([int(np.argmax(real.lit.mean))])
    if real.lit.mean[here[0]] < beyond[0]:
        return []
    mean, its = real.lit.mean[here], twin.lit.mean[here]
    own = real.lit.variance[here] / real.long_lit.mean.size
    error = np.sqrt((beyond[-1] - beyond[-2]) ** 2 + (_SAME_END * beyond[-1]) ** 2 + own + 2 * result.black.rms**2)
    return [Check("end of the signal, lit", "DN", "", np.zeros(1), mean, its, error)]


def _shared(result: PairCalibration, real: Half, twin: Half) -> list[Check]:
    """What rows and columns get anew in each frame: the mean over all dark pairs."""
    t = np.unique(real.dark.exposure_s, return_index=True)[1]
    checks = []
    for name, key, fitted in (("row", "row", result.row[1]), ("column", "col", result.col[1])):
        values = [getattr(half.dark, key)[t] for half in (real, twin)]
        own = [np.mean(getattr(half.dark, f"{key}_error")[t] ** 2) for half in (real, twin)]
        if t.size > 2:  # pairs may differ by more than their rows, or columns, tell
            own = [max(float(v.var(ddof=1)), one) for v, one in zip(values, own, strict=True)]
        error = np.sqrt(sum(own) / t.size + fitted**2)
        means = [np.array([v.mean()]) for v in values]
        name = f"temporal {name} variance, dark"
        checks.append(Check(name, "DN²", "", np.zeros(1), means[0], means[1], np.array([error])))
    return checks


def _spatial(result: PairCalibration, real: Half, twin: Half) -> list[Check]:
    """Spatial variances, defects and spectra of the long series."""
    checks = []
    own = Half(result.lit, result.dark, result.long_dark, result.long_lit)
    # a pixel at an end of the range has no noise: its distance from the others changes with the level alone
    stuck = np.any(stuck_pixels(result.pairs.spec.full_scale_dn, own.long_dark, own.long_lit), axis=0)
    for name, unit in (("dark", "DN²"), ("lit", "relative²")):
        key = f"long_{name}"
        scale = [1.0 if name == "dark" else half.signal for half in (real, twin, own)]
        series = [without_defects(getattr(half, key), stuck) for half in (real, twin, own)]
        series = [without_lines(half, result.noise_spectrum) for half in series]
        values = [np.array([*s.spatial.parts, s.spatial.total]) / f**2 for s, f in zip(series, scale, strict=True)]
        errors = [s.spatial.errors(fixed=True) / f**2 for s, f in zip(series, scale, strict=True)]
        error = np.sqrt(np.sum(np.square(errors), axis=0))
        for number, part in enumerate(("row", "column", "pixel", "total")):
            cut = slice(number, number + 1)
            checks.append(
                Check(
                    f"spatial variance, {part}, {name}",
                    unit,
                    "",
                    np.zeros(1),
                    values[0][cut],
                    values[1][cut],
                    error[cut],
                )
            )
        images = [deviations(s.mean / f) for s, f in zip(series[:2], scale, strict=False)]
        edges = bin_edges(*images)
        counts = [counts_in(image, edges) for image in images]
        checks.append(
            Check(f"defects, histogram, {name}", "pixels", "deviation, " + ("DN" if name == "dark" else "relative"),
                  edges[:-1], counts[0], counts[1], np.sqrt(np.maximum(counts[0] + counts[1], 1.0)))
        )  # fmt: skip
        outcome = [spectra(without_defects(s, result.defects), f) for s, f in zip(series, scale, strict=True)]
        for direction in ("rows", "columns"):
            here = [f[direction] for f in outcome]
            error = np.sqrt(sum(s.error**2 for s in here))
            checks.append(
                Check(f"spectrum of {direction}, {name}", unit, "periods per pixel", here[0].cycles, here[0].power,
                      here[1].power, error)
            )  # fmt: skip
    return checks
