"""Filters that can be made, as functions of bounded parameters: sums of dyes, stacks of thin films, free curves.

A family turns its parameters into the transmittance at given wavelengths, on Dr.Jit and so with derivatives.
"""

from dataclasses import dataclass
from math import log, pi
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float64
from hesim_render.core.host_arrays import from_host

#: Bounds of the bands of a dye: centre and full width at half maximum in nm, density.
_CENTRE_NM, _WIDTH_NM, _DENSITY = (350.0, 750.0), (40.0, 260.0), (0.0, 3.0)
#: Bounds of the thickness of a layer, nm.
_THICKNESS_NM = (15.0, 220.0)
#: Distance of the knots of a free curve, nm.
_KNOT_NM = 20.0


class Family(Protocol):
    """A kind of filter."""

    def bounds(self) -> list[tuple[float, float]]:
        """Least and largest value of each parameter of one filter."""

    def transmittance(self, parameters: list[Float64]) -> Float64:
        """Transmittance at the wavelengths, 0 to 1, from Dr.Jit numbers."""

    def start(self, wanted: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Parameters to start from: near a wanted transmittance, with some chance."""


@dataclass(frozen=True, eq=False)
class Dyes:
    """10^(−A) with A a sum of Gaussian bands, between a least and a largest transmittance."""

    wavelength_nm: NDArray[np.float64]
    bands: int
    most: float
    least: float = 0.0

    def bounds(self) -> list[tuple[float, float]]:
        """See `Family.bounds`: centre, width and density of each band."""
        return [_CENTRE_NM, _WIDTH_NM, _DENSITY] * self.bands

    def transmittance(self, parameters: list[Float64]) -> Float64:
        """See `Family.transmittance`."""
        grid = from_host(jit().Float64, self.wavelength_nm)
        absorbance = dr.zeros(jit().Float64, self.wavelength_nm.size)
        for k in range(self.bands):
            centre, width, density = parameters[3 * k : 3 * k + 3]
            absorbance += density * dr.exp(-4 * log(2) * dr.square((grid - centre) / width))
        return self.least + (self.most - self.least) * dr.exp(-log(10) * absorbance)

    def start(self, wanted: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """See `Family.start`: bands where the wanted filter is dark."""
        dark = np.clip(-np.log10(np.maximum(wanted / self.most, 1e-3)), 0, 2)
        weight = dark + 1e-3
        result: list[float] = []
        for quantile in (np.arange(self.bands) + rng.uniform(0.2, 0.8, self.bands)) / self.bands:
            place = self.wavelength_nm[int(np.searchsorted(np.cumsum(weight) / weight.sum(), quantile))]
            result += [float(place), float(rng.uniform(60, 160)), float(rng.uniform(0.8, 1.8))]
        return np.array(result)


@dataclass(frozen=True, eq=False)
class ThinFilms:
    """Alternating layers of two materials without absorption at normal incidence; thicknesses are the parameters.

    With δ = 2π n d/λ a layer has the characteristic matrix [[cos δ, i sin δ/n], [i n sin δ, cos δ]], and with
    [B, C] = (product) · [1, n_s] the transmittance is 4 n_0 n_s/|n_0 B + C|² [macleod2010].

    Parameters
    ----------
    wavelength_nm : of the result.
    layers : number of layers, the first one of the high index.
    most, least : transmittance where all light passes the stack, and where none does.
    high, low, incidence, substrate : refractive indices.
    """

    wavelength_nm: NDArray[np.float64]
    layers: int
    most: float
    least: float = 0.0
    high: float = 2.35
    low: float = 1.46
    incidence: float = 1.52
    substrate: float = 1.52

    def bounds(self) -> list[tuple[float, float]]:
        """See `Family.bounds`: the thickness of each layer, nm."""
        return [_THICKNESS_NM] * self.layers

    def transmittance(self, parameters: list[Float64]) -> Float64:
        """See `Family.transmittance`."""
        grid = from_host(jit().Float64, self.wavelength_nm)
        # B = b_re + i b_im, C = c_re + i c_im, from the substrate to the light
        b_re, b_im, c_re, c_im = (
            dr.ones(jit().Float64, self.wavelength_nm.size),
            0.0,
            jit().Float64(self.substrate),
            0.0,
        )
        for k in reversed(range(self.layers)):
            index = self.low if k % 2 else self.high
            phase = 2 * pi * index * parameters[k] / grid
            sine, cosine = dr.sin(phase), dr.cos(phase)
            b_re, b_im, c_re, c_im = (
                cosine * b_re - sine / index * c_im,
                cosine * b_im + sine / index * c_re,
                cosine * c_re - sine * index * b_im,
                cosine * c_im + sine * index * b_re,
            )
        real, imaginary = self.incidence * b_re + c_re, self.incidence * b_im + c_im
        passed = 4 * self.incidence * self.substrate / (dr.square(real) + dr.square(imaginary))
        return self.least + (self.most - self.least) * passed

    def start(self, wanted: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """See `Family.start`: quarter waves at which the wanted filter is dark, varied by a fifth."""
        weight = 1 - np.clip(wanted, 0, 1) + 1e-3
        place = self.wavelength_nm[int(np.searchsorted(np.cumsum(weight) / weight.sum(), rng.uniform()))]
        index = np.where(np.arange(self.layers) % 2, self.low, self.high)
        return np.clip(place / 4 / index * rng.uniform(0.8, 1.2, self.layers), *_THICKNESS_NM)


@dataclass(frozen=True, eq=False)
class FreeCurves:
    """A value at every knot, straight lines between the knots.

    Parameters
    ----------
    wavelength_nm : of the result.
    least, most : bounds of the transmittance.
    """

    wavelength_nm: NDArray[np.float64]
    least: float
    most: float

    @property
    def knots_nm(self) -> NDArray[np.float64]:
        """Wavelengths of the parameters, nm."""
        first, last = self.wavelength_nm[0], self.wavelength_nm[-1]
        return np.linspace(first, last, max(2, round((last - first) / _KNOT_NM) + 1))

    def bounds(self) -> list[tuple[float, float]]:
        """See `Family.bounds`: transmittance at each knot."""
        return [(self.least, self.most)] * self.knots_nm.size

    def transmittance(self, parameters: list[Float64]) -> Float64:
        """See `Family.transmittance`."""
        knots = self.knots_nm
        place = np.clip(np.searchsorted(knots, self.wavelength_nm, side="right") - 1, 0, knots.size - 2)
        share = (self.wavelength_nm - knots[place]) / (knots[place + 1] - knots[place])
        values = dr.concat(parameters)
        types = jit()
        low, part = from_host(types.UInt32, place), from_host(types.Float64, share)
        return dr.gather(types.Float64, values, low) * (1 - part) + dr.gather(types.Float64, values, low + 1) * part

    def start(self, wanted: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """See `Family.start`: the wanted curve with smooth deviations."""
        knots = self.knots_nm
        values = np.interp(knots, self.wavelength_nm, wanted)
        wave = rng.uniform(0, 0.15) * np.sin(2 * pi * (knots / rng.uniform(120, 300) + rng.uniform()))
        return np.clip(values + wave, self.least + 1e-3, self.most - 1e-3)
