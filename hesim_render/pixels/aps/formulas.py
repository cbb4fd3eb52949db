"""Noise of frame pixels as formulas: what the simulator samples and the calibration fits.

Physical form, per pixel, I_e light electrons, D dark current in e⁻/s, t exposure in s, K gain in DN/e⁻::

    N_e = min( Poisson( (1 + PRNU)·I_e + D·t ), full well ) + N(0, σ_r²)
    DN  = clip( round( f(K·N_e) + N_FP + N_tr + N_tc + N_res ), 0, 2^bits − 1 )

Polynomial form (``aps.beta`` given), I = f(K·(1 + PRNU)·I_e) in DN, per tile position::

    mean = I + t·N_DP + N_FP
    Var  = β0 + β1 I + β2 t + β3 I² + β4 I·t + β5 t²        before the ADC, without N_tr, N_tc

Both forms are cases of one model (`PixelValue`). A count with mean m is Poisson, or Gaussian with variance m. It is
multiplied by a gain in DN and added to fixed DN and a Gaussian. N_FP = black + N_row + N_col + N_BLC. N_tr is one
Gaussian number per row of a frame, shared by the pixels of the row (temporal row noise), N_tc likewise one per column.
f is the identity, or a smooth curve (`Curve`). The ADC rounds once: no uniform noise
is added, and every variance here excludes its q²/12.

Arrays are NumPy's or Dr.Jit's (`hesim_render.core.device_types`); nothing here draws a random number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import Namespace, Values

#: Error variance of rounding with a step of q = 1 DN, q²/12.
ADC_VARIANCE_DN2 = 1.0 / 12.0

#: Below this temporal variance (without that of the ADC) rounding hides the noise and biases the means: Sheppard's
#: correction q²/12 fails.
QUANTISED_VARIANCE_DN2 = 0.24

#: The noise term of each of β0 … β5. A coefficient is 0 where its term is switched off.
BETA_TERMS = ("read", "shot", "dark_current", "shot", "shot", "dark_current")


@dataclass(frozen=True)
class PixelProperties:
    """Properties of each pixel that the formulas need; numbers or arrays.

    Attributes
    ----------
    response : 1 + PRNU.
    dark_e_per_s : dark current D, e⁻/s.
    offset_dn : N_FP, DN.
    beta : β0 … β5 of the polynomial form, in DN and s; None in the physical form.
    """

    response: Values
    dark_e_per_s: Values
    offset_dn: Values
    beta: tuple[Values, ...] | None


@dataclass(frozen=True)
class PixelValue:
    """Law of a pixel's value in DN above N_FP, before full well, row noise and ADC.

    Attributes
    ----------
    fixed_dn : part without noise, DN.
    gain_dn : DN per unit of the count.
    count : mean of the count.
    gaussian_dn2 : variance of the Gaussian part, DN².
    """

    fixed_dn: Values
    gain_dn: Values
    count: Values
    gaussian_dn2: Values

    @property
    def mean_dn(self) -> Values:
        return self.fixed_dn + self.gain_dn * self.count

    @property
    def variance_dn2(self) -> Values:
        """Temporal variance, DN²."""
        return self.gain_dn * self.gain_dn * self.count + self.gaussian_dn2


@dataclass(frozen=True)
class Curve:
    """Smooth non-linearity of the signal: f(E) = E (1 + n₀ + n₁ u + n₂ u²), u = E/full scale, E = K·electrons in DN.

    Beyond full scale f goes on as a straight line through the origin. n₀ is 0 where K is the gain at no light; a K that
    is a mean over a range, as of EMVA 1288, is less than that.
    """

    terms: tuple[float, float, float]
    full_scale_dn: float

    @classmethod
    def of(cls, terms: Sequence[float] | None, full_scale_dn: float) -> "Curve | None":
        """The curve of a sensor file; None where there is none."""
        if terms is None:
            return None
        n0, n1, n2 = (*terms, 0.0, 0.0)[:3]
        return cls((n0, n1, n2), full_scale_dn)

    def factor(self, signal_dn: Values, xp: Namespace) -> Values:
        """f(E)/E."""
        n0, n1, n2 = self.terms
        u = xp.minimum(signal_dn, self.full_scale_dn) / self.full_scale_dn
        return 1.0 + n0 + u * (n1 + u * n2)

    def slope(self, signal_dn: Values, xp: Namespace) -> Values:
        """df/dE up to full scale, and its value there beyond."""
        n0, n1, n2 = self.terms
        u = xp.minimum(signal_dn, self.full_scale_dn) / self.full_scale_dn
        return 1.0 + n0 + u * (2.0 * n1 + u * (3.0 * n2))


def light_gain_dn(beta: Sequence[Values] | NDArray, signal_dn: Values, exposure_s: Values) -> Values:
    """g = β1 + β3 I + β4 t in DN: the part of the variance that depends on the light, divided by the signal I.

    Parameters
    ----------
    beta : β0 … β5 on the first axis, in DN and s.
    signal_dn : light signal I, DN.
    exposure_s : exposure t, s.
    """
    return beta[1] + beta[3] * signal_dn + beta[4] * exposure_s


def dark_variance_dn2(beta: Sequence[Values] | NDArray, exposure_s: Values) -> Values:
    """Variance without light, β0 + β2 t + β5 t², DN².

    Parameters
    ----------
    beta : β0 … β5 on the first axis, in DN and s.
    exposure_s : exposure t, s.
    """
    return beta[0] + (beta[2] * exposure_s + beta[5] * exposure_s * exposure_s)


def polynomial(beta: ArrayLike, signal_dn: Values, exposure_s: Values) -> NDArray[np.float64]:
    """Temporal variance β0 + β1 I + β2 t + β3 I² + β4 I·t + β5 t² in DN², before the ADC.

    Parameters
    ----------
    beta : [..., 6], in DN and s.
    signal_dn : light signal I, DN; it must broadcast against `beta` without its last axis.
    exposure_s : exposure t, s; it must broadcast likewise.
    """
    b = np.moveaxis(np.asarray(beta), -1, 0)
    return dark_variance_dn2(b, exposure_s) + signal_dn * light_gain_dn(b, signal_dn, exposure_s)


def physical_beta(system_gain_dn_per_e: float, read_noise_e: float, dark_e_per_s: float) -> list[float]:
    """β0 … β5 of the physical form: K²σ_r², K, K²D and 0, exactly. PRNU is spatial and does not contribute to β3.

    Parameters
    ----------
    system_gain_dn_per_e : K, DN/e⁻.
    read_noise_e : σ_r, e⁻.
    dark_e_per_s : D, e⁻/s.

    Returns
    -------
    The six coefficients, in DN and s.
    """
    gain = system_gain_dn_per_e
    return [(gain * read_noise_e) ** 2, gain, gain**2 * dark_e_per_s, 0.0, 0.0, 0.0]


def physical_value(
    electrons: Values,
    exposure_s: Values,
    pixels: PixelProperties,
    system_gain_dn_per_e: float,
    read_noise_e: float,
    shot: bool,
) -> PixelValue:
    """Value of a pixel in the physical form. Light and dark current together are one count of K DN per electron.

    Parameters
    ----------
    electrons : I_e, mean photo-electrons of the exposure.
    exposure_s : exposure, s.
    pixels : properties of the pixels.
    system_gain_dn_per_e : K, DN/e⁻.
    read_noise_e : σ_r, e⁻.
    shot : whether the light has shot noise. Without it, the shot noise of the dark current remains.
    """
    light, dark = pixels.response * electrons, pixels.dark_e_per_s * exposure_s
    read_dn2 = (system_gain_dn_per_e * read_noise_e) ** 2
    if shot:
        return PixelValue(0.0, system_gain_dn_per_e, light + dark, read_dn2)
    return PixelValue(light * system_gain_dn_per_e, system_gain_dn_per_e, 0.0 * light + dark, read_dn2)


def calibrated_value(
    electrons: Values,
    exposure_s: Values,
    pixels: PixelProperties,
    system_gain_dn_per_e: float,
    full_scale_dn: float,
    xp: Namespace,
    curve: Curve | None = None,
) -> PixelValue:
    """Value of a pixel in the polynomial form. The light is a count of g = β1 + β3 I + β4 t DN per unit.

    The variance of that count is g·I. The rest of the polynomial is the variance of the Gaussian part, at least 0.
    In g, I is limited to full scale, above which the polynomial was not measured. Where g is 0 the light has no noise.

    Parameters
    ----------
    electrons : I_e, mean photo-electrons of the exposure.
    exposure_s : exposure, s.
    pixels : properties of the pixels, with `beta`.
    system_gain_dn_per_e : K, DN/e⁻.
    full_scale_dn : largest value of the ADC, DN.
    xp : functions of the arrays' library.
    curve : non-linearity of the signal. The polynomial is one in the signal that comes out of it.
    """
    assert pixels.beta is not None
    signal = system_gain_dn_per_e * (pixels.response * electrons)
    if curve is not None:
        signal = signal * curve.factor(signal, xp)
    gain = light_gain_dn(pixels.beta, xp.minimum(signal, full_scale_dn), exposure_s)
    noisy = gain > 0.0
    count = xp.where(noisy, signal / xp.where(noisy, gain, 1.0), 0.0)
    fixed = system_gain_dn_per_e * (pixels.dark_e_per_s * exposure_s) + xp.where(noisy, 0.0, signal)
    return PixelValue(fixed, gain, count, xp.maximum(dark_variance_dn2(pixels.beta, exposure_s), 0.0))


def bent_value(value: PixelValue, system_gain_dn_per_e: float, curve: Curve, xp: Namespace) -> PixelValue:
    """Value of a pixel in the physical form whose signal passes a curve.

    The signal becomes f(E) and its variance f'(E)² K E, which is that of a count of f(E)/g with g = K E f'(E)²/f(E) DN
    each.

    Parameters
    ----------
    value : the law without the curve, whose count has K DN per electron.
    system_gain_dn_per_e : K, DN/e⁻.
    curve : the non-linearity.
    xp : functions of the arrays' library.
    """
    whole = value.fixed_dn + system_gain_dn_per_e * value.count
    factor, slope = curve.factor(whole, xp), curve.slope(whole, xp)
    gain = system_gain_dn_per_e * slope * slope / factor
    # the noisy part of the signal keeps its part of the mean
    return PixelValue(
        value.fixed_dn * factor, gain, value.count * (system_gain_dn_per_e * factor / gain), value.gaussian_dn2
    )


def noise_equivalent_e(
    variance_dn2: Values, system_gain_dn_per_e: float, prnu_rel: float, electrons: Values, xp: Namespace
) -> Values:
    """Noise of a pixel in electrons at its input: √(Var/K² + (PRNU·I_e)²).

    Parameters
    ----------
    variance_dn2 : temporal variance, DN².
    system_gain_dn_per_e : K, DN/e⁻.
    prnu_rel : relative standard deviation of the response.
    electrons : I_e, mean photo-electrons.
    xp : functions of the arrays' library.

    Returns
    -------
    Standard deviation, e⁻.
    """
    fixed_e = prnu_rel * electrons
    return xp.sqrt(variance_dn2 / system_gain_dn_per_e**2 + fixed_e * fixed_e)


def fourth_cumulant_dn4(gain_dn: Values, count_variance_dn2: Values) -> Values:
    """Fourth cumulant κ₄ = g⁴ m of a Poisson count with g DN per unit and the variance g² m. A Gaussian has κ₄ = 0.

    Parameters
    ----------
    gain_dn : g, DN.
    count_variance_dn2 : g² m, DN².
    """
    return gain_dn * gain_dn * count_variance_dn2


def telegraph_levels(amplitude: Values, high_share: Values) -> tuple[Values, Values]:
    """Low and high level of random telegraph noise relative to its mean: −a p and a (1 − p).

    Parameters
    ----------
    amplitude : a, high level minus low level, in any unit.
    high_share : p, fraction of the time at the high level.
    """
    return -amplitude * high_share, amplitude * (1.0 - high_share)


def telegraph_variance(amplitude: Values, high_share: Values) -> Values:
    """Variance of random telegraph noise, a² p (1 − p), in the square of the amplitude's unit [machlup1954]."""
    return amplitude * amplitude * high_share * (1.0 - high_share)
