"""What EMVA 1288 captures show beyond the standard's linear model: of the sensor, and of the bench."""

from __future__ import annotations

import numpy as np

from hesim_render.calibrate.aps.pairs import PairCalibration
from hesim_render.calibrate.estimate import ALARM, Finding

#: Relative changes of signal and variance from which a finding names them.
_LEAST_BEND, _LEAST_SCATTER = 2e-3, 2e-3
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
            "(aps.nonlinearity); K and the quantum efficiency are means over 0 to 70 % of saturation"
        )
        outcome.append(("linearity", text))
    if abs(curve.offset) > 4 * curve.offset_error > 0:
        unit = "photons" if result.pairs.has_photons else "s of exposure"
        text = (
            f"every lit frame has {curve.offset:.3g} {unit} more than stated: an exposure that is longer than stated "
            "by a constant, or light during the read-out (smear)"
        )
        outcome.append(("light offset", text))
    if curve.light_rms > _LEAST_SCATTER / 4:
        outcome.append(("light", f"the light scatters by {100 * curve.light_rms:.2g} % from exposure to exposure"))
    if result.level_rms > _LEAST_SCATTER and result.level_chance < ALARM:
        text = (
            f"the variances of single levels scatter by {100 * result.level_rms:.2g} % about the polynomial, more than "
            f"chance (χ²/dof {result.level_chi2:.1f}): steps of the ADC that are not even, or noise that comes and goes"
        )
        outcome.append(("variance", text))
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
    if result.black.rms > 3 * np.sqrt(max(result.row[0], 0.0) / (2 * result.pairs.shape[0])) + 0.01:
        outcome.append(
            ("black level", f"the dark level changes by {result.black.rms:.2g} DN from exposure to exposure")
        )
    outcome += _of_the_set(result)
    return [Finding(check, text, None) for check, text in outcome]


def _of_the_set(result: PairCalibration) -> list[tuple[str, str]]:
    """What the captures are made of."""
    pairs = result.pairs
    outcome = []
    if result.dark_noise_is_rounded_off:
        text = (
            f"the dark variance is down to {result.dark.variance.min():.3f} DN², below the 0.24 of EMVA 1288: rounding "
            "hides the dark noise, which has an upper limit alone. Capture with more bits or a higher gain"
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
