"""Physical constants (CODATA through SciPy) and the few unit conversions that cross modules."""

from scipy import constants

PLANCK_J_S: float = constants.h
LIGHT_SPEED_M_PER_S: float = constants.c

#: Luminous efficacy of V(λ) at its peak, lm/W. K_cd = 683 lm/W holds at 540 THz (555.016 nm in
#: air); at the 555 nm peak of V(λ) it is 683.002 (CIE S 010 / ISO 23539).
LUMINOUS_EFFICACY_LM_PER_W = 683.002

US_PER_S = 1_000_000
S_PER_US = 1e-6
M_PER_NM = 1e-9
M_PER_UM = 1e-6
MM_PER_M = 1e3


def photons_per_joule(wavelength_nm):  # noqa: ANN001, ANN201 - floats, NumPy and Dr.Jit arrays alike
    """λ/(h c): photons per joule at `wavelength_nm`."""
    return wavelength_nm * (M_PER_NM / (PLANCK_J_S * LIGHT_SPEED_M_PER_S))
