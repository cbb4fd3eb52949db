"""The cost of a filter set in a design, with derivatives with respect to its filters.

Electrons come from `photocurrent` with the responses as parameters (Eq. 1). For each illuminant and level the colour
matrix M is the one with the least expected squared colour difference, noise included::

    J = mean over surfaces of |W (M c − x)|² + Σ_c Var(c_c) |W M_c|²

c are the electrons of the channels, x is the true XYZ, and W the derivative of the colour difference at the true
colour: of CIELAB, with the weights of lightness, chroma and hue of ΔE2000 (without its rotation term). J is quadratic
in M, so M is found by one linear solve; at this minimum the derivative of J with respect to the filters is that at
constant M. All numbers have 64 bits, because a matrix of similar filters amplifies rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float64
from hesim_render.core.host_arrays import from_host
from hesim_render.sensor.photocurrent import photocurrent
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.design import CostSpec
from hesim_render.spectral.colorimetry import lab
from hesim_render.spectral.spectrum import Spectrum, scale_to_lux
from hesim_render.studies.colour_noise import GREY, ChannelNoise
from hesim_render.studies.colour_samples import colour_samples

#: Noise in electrons² of the term of colour alone, which keeps its matrix defined.
_LEAST_VARIANCE = 1e-3


def difference_weights(xyz: NDArray[np.float64], white_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """W of every colour, [surface, 3, 3]: colour difference is about |W (change of XYZ)| for small changes.

    Parameters
    ----------
    xyz : [surface, 3].
    white_xyz : [3].
    """
    # derivatives of CIELAB by XYZ, [surface, 3, 3]; the cube root becomes a line near black
    ratio = np.maximum(xyz / white_xyz, 1e-6)
    slope = np.where(ratio > (6 / 29) ** 3, ratio ** (-2 / 3) / 3, (29 / 6) ** 2 / 3) / white_xyz
    jacobian = np.zeros((len(xyz), 3, 3))
    jacobian[:, 0, 1] = 116 * slope[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 1] = 500 * slope[:, 0], -500 * slope[:, 1]
    jacobian[:, 2, 1], jacobian[:, 2, 2] = 200 * slope[:, 1], -200 * slope[:, 2]
    # along lightness, chroma and hue, each over its weight in CIE94 and CIEDE2000: steps of chroma and hue are seen
    # less where the chroma is high
    lightness, a, b = lab(xyz, white_xyz).T
    chroma = np.hypot(a, b)
    unit = np.stack([a, b]) / np.maximum(chroma, 1e-9)
    unit[:, chroma < 1e-9] = np.array([[1.0], [0.0]])
    square = (lightness - 50) ** 2
    turn = np.zeros((len(xyz), 3, 3))
    turn[:, 0, 0] = 1 / (1 + 0.015 * square / np.sqrt(20 + square))
    turn[:, 1, 1:] = (unit / (1 + 0.045 * chroma)).T
    turn[:, 2, 1:] = (np.stack([-unit[1], unit[0]]) / (1 + 0.015 * chroma)).T
    return turn @ jacobian


@dataclass(frozen=True, eq=False)
class Condition:
    """Surfaces under one light.

    Parameters
    ----------
    radiance : [surface, band] at 1 lux, the grey card last, W m⁻² sr⁻¹ nm⁻¹.
    xyz : [surface, 3], without the grey card.
    weights : [surface, 3, 3].
    """

    radiance: NDArray[np.float64]
    xyz: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def of(cls, reflectances: Sequence[Spectrum], light: Spectrum, wavelength_nm: NDArray[np.float64]) -> "Condition":
        """From reflectances and an illuminant."""
        per_lux = scale_to_lux(light, 1.0).at(wavelength_nm) / np.pi
        surfaces = np.array([each.at(wavelength_nm) for each in reflectances])
        samples = colour_samples([light], light, reflectances)
        surfaces = np.concatenate([surfaces, np.full((1, wavelength_nm.size), GREY)])
        return cls(surfaces * per_lux, samples.xyz, difference_weights(samples.xyz, samples.white_xyz))


@dataclass(frozen=True, eq=False)
class DesignCost:
    """Cost of a filter set over several lights and levels.

    Parameters
    ----------
    sensor : any sensor of the family; its responses are replaced.
    wavelength_nm : [band], bands of all spectra.
    conditions : lights.
    illuminance_lux : levels.
    exposure_us : µs.
    noise : of the channels of frames, the signal's own noise included; its counts hold unless a call gives others.
    frames, events : numbers of the filters of frame and of event pixels.
    event_scale : relative rise of light per event without baseline, and baseline over slope in electrons of a window.
    event_window_us : window of the event pixels, µs.
    weights : of the parts.
    """

    sensor: Sensor
    wavelength_nm: NDArray[np.float64]
    conditions: Sequence[Condition]
    illuminance_lux: Sequence[float]
    exposure_us: float
    noise: ChannelNoise
    frames: Sequence[int]
    events: Sequence[int]
    event_scale: tuple[float, float]
    event_window_us: float
    weights: CostSpec

    def __call__(self, responses: Sequence[Float64], counts: Sequence[Float64] | None = None) -> Float64:
        """The cost, a Dr.Jit number with derivatives.

        Parameters
        ----------
        responses : response of each filter at the bands, Dr.Jit Float64 [band].
        counts : pixels of each channel of the frames in an output pixel, Dr.Jit numbers; None: those of `noise`.
        """
        if counts is None:
            counts = [dr.opaque(jit().Float64, float(count)) for count in self.noise.count]
        name = self.sensor.layout.filters[0]
        types = jit()
        total: Float64 = types.Float64(0.0)
        for condition in self.conditions:
            radiance = types.TensorXf64(from_host(types.Float64, condition.radiance), shape=condition.radiance.shape)
            per_lux: list[Float64] = []
            for response in responses:
                own = types.TensorXf64(response, shape=(self.wavelength_nm.size,))
                electrons: Float64 = photocurrent(
                    radiance, self.wavelength_nm, self.sensor, self.exposure_us, filter=name, responses=own
                )
                per_lux.append(electrons.array)
            total += self._of_condition(condition, per_lux, counts) / len(self.conditions)
        return total

    def _of_condition(self, condition: Condition, per_lux: list[Float64], counts: Sequence[Float64]) -> Float64:
        count = len(condition.xyz)
        index = dr.arange(jit().UInt32, count)
        chosen = [dr.gather(jit().Float64, per_lux[k], index) for k in self.frames]
        total: Float64 = jit().Float64(0.0)
        if self.weights.colour:
            # any brightness does without noise; a fixed one keeps the term of `_LEAST_VARIANCE` small
            scale = 1e4 / max(float(np.mean(each.numpy())) for each in chosen)
            electrons = [each * dr.opaque(jit().Float64, scale) for each in chosen]
            total += self.weights.colour * self._difference(condition, electrons, None)
        for lux in self.illuminance_lux:
            if self.weights.noise:
                part = self._difference(condition, [each * lux for each in chosen], counts)
                total += self.weights.noise / len(self.illuminance_lux) * part
            if self.weights.events and self.events:
                total += self.weights.events / len(self.illuminance_lux) * self._contrast(per_lux, count, lux)
        return total

    def _contrast(self, per_lux: list[Float64], grey: int, lux: float) -> Float64:
        """Relative rise of the light on the grey card that gives an event, the mean over event filters."""
        total: Float64 = jit().Float64(0.0)
        rise, baseline_e = self.event_scale
        for k in self.events:
            electrons = dr.gather(jit().Float64, per_lux[k], jit().UInt32(grey)) * (
                lux * self.event_window_us / self.exposure_us
            )
            total += rise * (1 + baseline_e / dr.maximum(electrons, 1e-3)) / len(self.events)
        return total

    def _difference(self, condition: Condition, electrons: list[Float64], counts: Sequence[Float64] | None) -> Float64:
        """√J with its best matrix; without noise where there are no counts."""
        types, noise = jit(), self.noise
        if counts is not None:
            noise = replace(noise, count=np.array([float(each[0]) for each in counts]))
        host = np.stack([np.array(each, dtype=np.float64) for each in electrons], axis=1)
        spread = np.full_like(host, _LEAST_VARIANCE) if counts is None else noise.variance_e2(host)
        # the matrix has no derivative of its own: at its best the cost does not change with it
        matrix = best_matrix(host, spread, condition.xyz, condition.weights)
        rows = [from_host(types.Float64, condition.weights[:, i, j]) for i in range(3) for j in range(3)]
        true = [from_host(types.Float64, column) for column in condition.xyz.T]
        # deviation of XYZ of each surface, with derivatives by the electrons
        off = [
            sum(
                (dr.opaque(types.Float64, float(matrix[i, c])) * each for c, each in enumerate(electrons)),
                start=-true[i],
            )
            for i in range(3)
        ]
        total: Float64 = 0.0
        for i in range(3):
            total += dr.square(rows[3 * i] * off[0] + rows[3 * i + 1] * off[1] + rows[3 * i + 2] * off[2])
        # noise of channel c moves the colour by W M_c: its variance times the square of that length
        weighted = np.einsum("sij,jc->sic", condition.weights, matrix)
        for c, each in enumerate(electrons):
            gain = from_host(types.Float64, np.sum(weighted[:, :, c] ** 2, axis=1))
            if counts is not None:
                # plain numbers: NumPy's would turn the array into one of NumPy's, without derivatives
                constant, linear, square = (float(part[c]) for part in (noise.constant, noise.linear, noise.quadratic))
                variance = constant + linear * each + square * dr.square(each)
                total += gain * variance / counts[c]
            else:
                total += gain * _LEAST_VARIANCE
        return dr.sqrt(dr.mean(total))


def best_matrix(
    electrons: NDArray[np.float64],
    variance: NDArray[np.float64],
    xyz: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """M with the least Σ |W (M c − x)|² + Σ_c Var(c_c) |W M_c|², by its normal equations, [3, channel].

    Parameters
    ----------
    electrons, variance : [surface, channel].
    xyz : [surface, 3].
    weights : [surface, 3, 3].
    """
    count = electrons.shape[1]
    # channels of one size, so that the equations are well conditioned
    scale = electrons.mean(axis=0)
    c = electrons / scale
    metric = np.einsum("ski,skj->sij", weights, weights)
    square = c[:, :, None] * c[:, None, :] + np.einsum("sc,cd->scd", variance / scale**2, np.eye(count))
    normal = np.einsum("sij,scd->icjd", metric, square).reshape(3 * count, 3 * count)
    wanted = np.einsum("sij,sj,sc->ic", metric, xyz, c).ravel()
    return np.linalg.solve(normal, wanted).reshape(3, count) / scale
