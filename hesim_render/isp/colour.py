"""Colour correction: a matrix from the camera's channels to linear sRGB, fitted to a chart and judged in ΔE2000."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError
from hesim_render.spectral.spectrum import colour_science


@dataclass(frozen=True)
class ColourFit:
    """A matrix and its error on the patches it was fitted to.

    Parameters
    ----------
    matrix : [3][channel], balanced channels to linear sRGB; rows sum to 1.
    exposure : factor on the channels that matches the scale of the references.
    delta_e_2000 : [patch].
    """

    matrix: list[list[float]]
    exposure: float
    delta_e_2000: list[float]

    @property
    def mean_delta_e(self) -> float:
        return float(np.mean(self.delta_e_2000))

    @property
    def max_delta_e(self) -> float:
        return float(np.max(self.delta_e_2000))


def colour_matrix(image: NDArray[np.float32], matrix: ArrayLike) -> NDArray[np.float32]:
    """Linear RGB [row, col, 3] (a view of planes) of balanced channels [row, col, channel]."""
    weights = np.asarray(matrix, dtype=np.float32)
    if weights.shape != (3, image.shape[2]):
        raise RangeError("shape of the colour matrix", weights.shape, f"(3, {image.shape[2]})")
    out = np.empty((3, *image.shape[:2]), dtype=np.float32)

    def work(rows: slice) -> None:
        scratch = np.empty((rows.stop - rows.start, image.shape[1]), dtype=np.float32)
        for channel in range(3):
            np.multiply(image[rows, :, 0], weights[channel, 0], out=out[channel, rows])
            for other in range(1, image.shape[2]):
                np.multiply(image[rows, :, other], weights[channel, other], out=scratch)
                out[channel, rows] += scratch

    in_bands(image.shape[0], work)
    return np.moveaxis(out, 0, -1)


def fit_srgb_matrix(patches: ArrayLike, reference: ArrayLike) -> ColourFit:
    """The matrix with the least mean ΔE2000 whose rows sum to 1, so that white stays white.

    The fit starts from least squares in linear light ([cheung2004], with the white constraint) and minimises
    the mean ΔE2000 from there. If that does not improve the result, the least-squares matrix is kept.

    Parameters
    ----------
    patches : [patch, channel], linear, black at 0, white-balanced, any exposure.
    reference : [patch, 3], linear sRGB.

    Raises
    ------
    RangeError
        If there are fewer patches than channels, or the shapes do not fit.
    """
    from scipy.optimize import minimize

    camera, target = np.asarray(patches, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if camera.ndim != 2 or target.shape != (len(camera), 3) or len(camera) < max(3, camera.shape[1]):
        raise RangeError("shape of patches and reference", (camera.shape, target.shape), "(n, channels) and (n, 3)")
    # initial exposure: the single factor that fits the sum of the channels to that of the reference
    exposure = float((camera.mean(axis=1) @ target.mean(axis=1)) / (camera.mean(axis=1) @ camera.mean(axis=1)))
    free = _constrained_least_squares(exposure * camera, target)
    start = np.append(free.ravel(), 1.0)

    def unpack(values: NDArray) -> tuple[NDArray, float]:
        return _with_unit_rows(values[:-1].reshape(3, -1)), exposure * values[-1]

    def loss(values: NDArray) -> float:
        matrix, scale = unpack(values)
        return float(delta_e_2000(scale * camera @ matrix.T, target).mean())

    # ΔE2000 has kinks, so that a search without derivatives improves the least squares
    best = start
    if camera.shape[1] > 1:
        result = minimize(loss, start, method="Powell", options={"maxiter": 20, "xtol": 1e-4, "ftol": 1e-5})
        best = result.x if result.fun < loss(start) else start
    matrix, scale = unpack(best)
    return ColourFit(matrix.tolist(), scale, delta_e_2000(scale * camera @ matrix.T, target).tolist())


def _constrained_least_squares(camera: NDArray, target: NDArray) -> NDArray[np.float64]:
    """Columns but the first of the matrix [3, channel] whose rows sum to 1, by least squares."""
    # with the first column as 1 less the others, white stays white whatever the rest is
    result, *_ = np.linalg.lstsq(camera[:, 1:] - camera[:, :1], target - camera[:, :1], rcond=None)
    return result.T


def _with_unit_rows(free: NDArray) -> NDArray[np.float64]:
    return np.concatenate([1 - free.sum(axis=1, keepdims=True), free], axis=1)


def delta_e_2000(linear_a: ArrayLike, linear_b: ArrayLike) -> NDArray[np.float64]:
    """ΔE2000 (CIE 142-2001) between linear sRGB values [..., 3], under sRGB's own white."""
    return colour_science().delta_E(_lab(linear_a), _lab(linear_b), method="CIE 2000")


def _lab(linear: ArrayLike) -> NDArray[np.float64]:
    colour = colour_science()
    space = colour.RGB_COLOURSPACES["sRGB"]
    xyz = np.asarray(linear, dtype=np.float64) @ space.matrix_RGB_to_XYZ.T
    return colour.XYZ_to_Lab(xyz, space.whitepoint)
