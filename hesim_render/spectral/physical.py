"""Spectra of physical parts: silicon of a stated depth, dyes as sums of absorption bands, stacks of thin films."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.spectral.spectrum import Spectrum, colour_science, read_csv

#: Optical constants of silicon, [green2008].
SILICON_FILE = Path(__file__).with_name("silicon.csv")
#: Grid of computed filters, nm.
GRID_NM = np.arange(300.0, 1101.0, 1.0)


@functools.cache
def silicon_index() -> tuple[Spectrum, Spectrum]:
    """Refractive index n and extinction coefficient k of silicon at 300 K, 250-1100 nm [green2008]."""
    return read_csv(SILICON_FILE, "n"), read_csv(SILICON_FILE, "k")


def silicon_quantum_efficiency(depth_um: float, surface: Literal["coated", "bare"] = "coated") -> Spectrum:
    """Internal collection in a silicon layer, η(λ) = (1 − R)·(1 − exp(−4π k d/λ)), 250-1100 nm.

    All electrons that are generated within the depth are collected, none from below it.

    Parameters
    ----------
    depth_um : d, depth of collection, µm.
    surface : ``coated``: no light is reflected; ``bare``: R of silicon in air at normal incidence (Fresnel).

    Returns
    -------
    η, electrons per photon. Absorption in a wavelength varies faster than linearly, so the table is refined to 5 nm in
    the exponent (ln k linear between the points of the source).
    """
    n, k = silicon_index()
    grid = np.arange(n.support_nm[0], n.support_nm[1] + 1, 5.0)
    extinction = np.exp(np.interp(grid, k.wavelength_nm, np.log(k.values)))
    absorbed = -np.expm1(-4 * np.pi * extinction * depth_um * 1e3 / grid)
    if surface == "bare":
        index = n.at(grid)
        absorbed *= 1 - ((index - 1) ** 2 + extinction**2) / ((index + 1) ** 2 + extinction**2)
    return Spectrum(grid, absorbed)


def dye_transmittance(bands: ArrayLike = (), edges: ArrayLike = (), grid_nm: NDArray[np.float64] = GRID_NM) -> Spectrum:
    """Transmittance 10^(−A) of a dye whose absorbance A is a sum of bands and edges (Beer and Lambert).

    Parameters
    ----------
    bands : [n, 3], Gaussians: centre in nm, full width at half maximum in nm, absorbance (optical density) there.
    edges : [n, 3], D/(1 + exp((λ₀ − λ)/w)): place λ₀ in nm, width w in nm, absorbance D far beyond. With a positive
        width light longer than λ₀ is absorbed, with a negative one shorter light.
    grid_nm : wavelengths of the result, nm.
    """
    absorbance = np.zeros_like(grid_nm)
    for centre, width, density in np.reshape(bands, (-1, 3)):
        absorbance += density * np.exp(-4 * np.log(2) * ((grid_nm - centre) / width) ** 2)
    for place, width, density in np.reshape(edges, (-1, 3)):
        absorbance += density / (1 + np.exp(np.clip((place - grid_nm) / width, -500, 500)))
    return Spectrum(grid_nm, 10.0**-absorbance)


def thin_film_transmittance(
    indices: Sequence[float],
    thicknesses_nm: Sequence[float],
    incidence_index: float = 1.0,
    substrate_index: float = 1.52,
    angle_deg: float = 0.0,
    grid_nm: NDArray[np.float64] = GRID_NM,
) -> Spectrum:
    """Transmittance of a stack of thin films into its substrate, unpolarised, by colour-science's transfer matrices.

    Parameters
    ----------
    indices : refractive index of each layer, from the side of the light.
    thicknesses_nm : of each layer, nm.
    incidence_index, substrate_index : refractive indices in front of the stack and behind it.
    angle_deg : of incidence, degrees.
    grid_nm : wavelengths of the result, nm.
    """
    stack = [incidence_index, *indices, substrate_index]
    _, passed = colour_science().phenomena.multilayer_tmm(stack, list(thicknesses_nm), grid_nm, angle_deg)
    return Spectrum(grid_nm, np.clip(np.asarray(passed, dtype=np.float64)[:, 0, 0].mean(axis=-1), 0.0, 1.0))


def blackbody(temperature_k: float) -> Spectrum:
    """Relative spectrum of a black body by Planck's law, 1 at its largest value on `GRID_NM`.

    c2 = h c / k_B = 1.438776877e7 nm K (CODATA 2018).
    """
    power = GRID_NM**-5 / np.expm1(1.438776877e7 / (GRID_NM * temperature_k))
    return Spectrum(GRID_NM, power / power.max())


def gaussian_band(peak_nm: float, fwhm_nm: float) -> Spectrum:
    """A band of the form of a Gaussian, 1 at its peak, by its full width at half maximum, 2·√(2 ln 2) standard
    deviations.
    """
    sigma = fwhm_nm / 2.354820045
    return Spectrum(GRID_NM, np.exp(-0.5 * ((GRID_NM - peak_nm) / sigma) ** 2))
