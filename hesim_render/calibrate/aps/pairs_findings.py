"""What EMVA 1288 captures show beyond the standard's linear model: of the sensor, and of the bench."""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.aps.long_series import stuck_pixels
from hesim_render.calibrate.aps.pair_levels import Levels
from hesim_render.calibrate.aps.pairs import PairCalibration
from hesim_render.calibrate.estimate import ALARM, Finding
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, polynomial
from hesim_render.recording.pair_set import light_of_series

#: Relative changes of signal and variance from which a finding names them.
_LEAST_BEND, _LEAST_SCATTER = 2e-3, 2e-3
#: Change of the dark level from which a finding names it, DN.
_LEAST_LEVEL_DN = 0.01
#: Correlation of the deviations of successive levels from which they lie on a curve of their own, and fewest levels.
_ALIKE, _FEWEST_ALIKE = 0.45, 8
#: Most by which rounding moves the mean of a level without noise, DN.
_ROUNDED_DN = 0.5
#: Missing codes that are listed.
_MOST_CODES = 6
#: Standard errors that chance exceeds in one of 10,000 cases.
SIGNIFICANT = 3.9


def findings(result: PairCalibration) -> list[Finding]:
    """What the sensor, or the bench, has beyond the standard's linear model, with its size."""
    outcome = []
    curve, k = result.curve, result.gain.slope
    top = float(result.light[result.clear].max())
    bend = float(curve.at(np.array([top]))[0] / (curve.terms[0] * (top + curve.offset)) - 1)
    if curve.bends and abs(bend) > _LEAST_BEND:
        text = (
            f"the mean bends: {100 * bend:+.2g} % at the brightest clear level. The sensor file has the curve "
            "(aps.nonlinearity); K and the quantum efficiency are means over 0 to 70 % of saturation. Light that "
            "drifts while the exposures get longer looks the same; exposures in random order tell them apart"
        )
        outcome.append(("linearity", text))
    if abs(curve.offset) > 4 * curve.offset_error > 0:
        outcome.append(("light offset", _of_the_offset(result)))
    if curve.light_rms > _LEAST_SCATTER / 4:
        amount = f"{100 * curve.light_rms:.2g} %"
        text = f"the light scatters by {amount} from exposure to exposure"
        if _are_alike(result.signal[result.clear] / curve.at(result.light[result.clear]) - 1):
            text = (
                f"the mean lies {amount} off the curve of three terms, at neighbouring lights to one side: a full well "
                "that bends the signal long before its end, or light that drifts"
            )
        outcome.append(("light", text))
    outcome += _of_the_long_series(result)
    if result.level_rms > _LEAST_SCATTER and result.level_chance < ALARM:
        amount = f"{100 * result.level_rms:.2g} %"
        text = (
            f"the variances of single levels scatter by {amount} about the polynomial, more than chance (χ²/dof "
            f"{result.level_chi2:.1f}): steps of the ADC that are not even, or noise that comes and goes"
        )
        if _are_alike(_variance_residual(result)):
            text = (
                f"the variances lie on another curve than the polynomial of the model, {amount} off it (χ²/dof "
                f"{result.level_chi2:.1f}): as where a full well bends the signal long before its end, or where steps "
                "of the ADC are not even"
            )
        outcome.append(("variance", text))
    outcome += missing_codes(result.lit, result.dark)
    for name, (variance, error) in (("row noise", result.row), ("column noise", result.col)):
        if variance > SIGNIFICANT * error:
            rms = float(np.sqrt(variance))
            text = f"{name[:-6]}s change together from frame to frame by {rms:.3g} DN ({rms / k:.2g} e-)"
            outcome.append((name, text))
    for line in result.noise_spectrum.lines[:3]:
        text = (
            f"a pattern with {line.cycles_per_row:.3g} periods a row and {line.cycles_per_col:.3g} a column has a new "
            f"phase in each frame, {line.rms_dn:.2g} DN rms"
        )
        outcome.append(("interference", text))
    if result.noise_spectrum.correlated:
        text = (
            f"the dark noise of neighbours in a row has a correlation of {result.noise_spectrum.correlation:+.3f}: a "
            "filter of the read-out"
        )
        outcome.append(("read noise", text))
    columns = result.long_dark.spatial.col
    if columns > SIGNIFICANT * result.long_dark.spatial.errors(fixed=True)[1]:
        outcome.append(("column pattern", f"columns have offsets of their own, {np.sqrt(columns):.2g} DN rms"))
    level = _level_change(result)
    if level > _LEAST_LEVEL_DN:
        outcome.append(("black level", f"the dark level changes by {level:.2g} DN from exposure to exposure"))
    outcome += _of_lag(result)
    outcome += _of_the_set(result)
    return [Finding(check, text, None) for check, text in outcome]


def _of_the_offset(result: PairCalibration) -> str:
    """What light beyond that of the stated exposures may be. A level that hardly any noise moves is rounded as a whole,
    while noisy lit frames have their own mean.
    """
    curve, unit = result.curve, "photons" if result.pairs.has_photons else "s of exposure"
    size, more = f"{abs(curve.offset):.3g} {unit}", "more" if curve.offset > 0 else "less"
    level_dn = float(curve.offset * curve.terms[0])
    if result.dark_noise_is_rounded_off and abs(level_dn) < _ROUNDED_DN:
        return (
            f"every lit frame has {size} {more} than stated, {level_dn:+.2g} DN: rounding moves a dark level with so "
            "little noise by as much, so that the exposures may well be the stated ones"
        )
    if curve.offset > 0:
        cause = "an exposure that is longer than stated by a constant, or light during the read-out (smear)"
    else:
        cause = "an exposure that is shorter than stated by a constant, or dark frames that are brighter than no light"
    return f"every lit frame has {size} {more} than stated: {cause}"


def missing_codes(*levels: Levels) -> list[tuple[str, str]]:
    """Grey values that the ADC never gives."""
    codes = sorted({code for one in levels for code in one.missing})
    if not codes:
        return []
    shown = ", ".join(str(code) for code in codes[:_MOST_CODES]) + (" and others" if len(codes) > _MOST_CODES else "")
    text = (
        f"no frame has the grey value {shown}, though many pixels have those beside it: a missing code of the ADC, or "
        "frames that were changed after it. Means and variances of levels near it are off, of any twin as well"
    )
    return [("missing code", text)]


def _variance_residual(result: PairCalibration) -> NDArray[np.float64]:
    """Deviations of the lit variances from their polynomial, in standard errors."""
    use = result.clear
    expected = polynomial(result.fit.beta, result.signal[use], result.lit.exposure_s[use]) + ADC_VARIANCE_DN2
    return np.asarray((result.lit.variance[use] - expected) / result.lit.error[use])


def _are_alike(residual: NDArray) -> bool:
    """Whether deviations of successive levels have one sign for the most part, which no independent ones have."""
    if residual.size < _FEWEST_ALIKE:
        return False
    return float(residual[1:] @ residual[:-1]) > _ALIKE * float(residual @ residual)


def _level_change(result: PairCalibration) -> float:
    """Scatter of the dark levels about their line, DN, beyond that of the noise; 0 where chance makes as much."""
    rows, cols = result.pairs.shape
    noise = result.long_dark.temporal.pixel / (rows * cols) + sum(
        max(value, 0.0) / count for (value, _), count in ((result.row, rows), (result.col, cols))
    )
    noise /= 2  # of two frames
    freedom = max(result.black.groups - 1, 1)
    if result.black.rms**2 < noise * chi2_law.isf(ALARM, freedom) / freedom:
        return 0.0
    return float(np.sqrt(result.black.rms**2 - noise))


def _of_lag(result: PairCalibration) -> list[tuple[str, str]]:
    """First frames in the dark that are brighter than the second: a sensor that keeps a part of the light before."""
    change = result.dark.change[np.unique(result.dark.exposure_s, return_index=True)[1]]
    if change.size < 3:
        return []
    mean, error = float(change.mean()), float(change.std(ddof=1)) / np.sqrt(change.size)
    # without normal errors: that all of many pairs have one sign is as rare
    alike = 2.0 ** (1 - change.size) < ALARM and bool(np.all(change > 0))
    if mean < 5 * _LEAST_LEVEL_DN or not (alike or mean > SIGNIFICANT * error):
        return []
    text = (
        f"the first dark frame of a pair is {mean:.2g} DN brighter than the second, as after light that leaves a part "
        "behind (image lag) or while the black level settles: discard a few frames before each series"
    )
    return [("image lag", text)]


def _of_the_long_series(result: PairCalibration) -> list[tuple[str, str]]:
    """Light of the long series that is not that of the pairs: those are taken one after the other, this at once."""
    light = light_of_series(result.pairs.spatial_lit, result.pairs.has_photons)
    if not result.light[result.clear].min() <= light <= result.light[result.clear].max():
        return []
    here, curve = np.array([light]), result.curve
    expected = float(curve.at(here)[0])
    more = float(result.long_lit.mean.mean() - result.long_dark.mean.mean()) / expected - 1
    temporal = result.long_lit.temporal, result.long_dark.temporal
    shared = sum(
        max(t.row, 0.0) / result.pairs.shape[0] + max(t.col, 0.0) / result.pairs.shape[1] + max(t.frame, 0.0)
        for t in temporal
    ) / result.long_lit.frames  # fmt: skip
    level = np.sqrt(2 * result.black.rms**2 + float(curve.error(here)[0]) ** 2 + shared)
    if abs(more) < max(_LEAST_SCATTER / 2, SIGNIFICANT * float(np.hypot(level / expected, curve.light_rms))):
        return []
    text = (
        f"the long series has {100 * abs(more):.2g} % {'more' if more > 0 else 'less'} light than the pairs around its "
        "exposure: the light drifts from one capture to the next"
    )
    return [("light of the long series", text)]


def _of_the_set(result: PairCalibration) -> list[tuple[str, str]]:
    """What the captures are made of."""
    pairs = result.pairs
    outcome = []
    white, black = (int(p.sum()) for p in stuck_pixels(pairs.spec.full_scale_dn, result.long_dark, result.long_lit))
    if white + black:
        text = f"{white} pixels are at full scale in the dark, {black} at 0 DN in the light; they count as defects"
        outcome.append(("stuck pixels", text))
    if result.dark_noise_is_rounded_off:
        text = (
            f"the dark variance is down to {result.dark.least_variance:.3f} DN², below the 0.24 of EMVA 1288: rounding "
            "hides the dark noise. It is read from the probabilities of grey values, or has an upper limit alone: "
            "capture with more bits or a higher gain"
        )
        outcome.append(("dark noise", text))
    if pairs.is_dark_once:
        text = (
            f"dark frames of one exposure, {1e6 * pairs.dark[0].exposure_s:g} µs, stand for those of all: the dark "
            "current is not known and counts as light"
        )
        outcome.append(("dark frames", text))
    if len(pairs.long) > 1:
        text = (
            f"of {len(pairs.long)} long series in the light, that of {pairs.spatial_lit.label}, nearest to half of "
            "saturation, gives DSNU, PRNU and the maps; the others are not used"
        )
        outcome.append(("long series", text))
    return outcome
