"""Patches of a colour chart in an image, and their reference colours."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.colorimetry import tristimulus, xyz_to_linear_srgb
from hesim_render.spectral.spectrum import Spectrum, constant

#: The grey patches of a ColorChecker without white and black (part of the last row), in the order of `patch_means`.
NEUTRAL = slice(19, 23)
#: Side of the square in a patch over the distance of neighbouring patches.
_SHARE = 0.5

Corner = tuple[float, float]


def patch_centres(corners: Sequence[Corner], rows: int = 4, cols: int = 6) -> NDArray[np.float64]:
    """Centres (row, col) of a chart's patches in chart order, [patch, 2].

    Parameters
    ----------
    corners : (row, col) of the centres of the chart's four corner patches: top left, top right, bottom right,
        bottom left as printed (dark skin, bluish green, black, white of a ColorChecker). Perspective is allowed.

    Raises
    ------
    RangeError
        If they are no corners of a chart: not four, or three of them on a line.
    """
    points = np.asarray(corners, dtype=np.float64)
    if points.shape != (4, 2):
        raise RangeError("chart corners", points.tolist(), "four (row, col)")
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)):
        raise RangeError(
            "chart corners", points.tolist(),
            "the (row, col) of top left, top right, bottom right and bottom left patch, in this order around the chart",
        )  # fmt: skip
    # homography of the unit square (u to the right, v down) onto the four points
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    equations, right = [], []
    for (u, v), (y, x) in zip(square, points, strict=True):
        equations += [[u, v, 1, 0, 0, 0, -u * y, -v * y], [0, 0, 0, u, v, 1, -u * x, -v * x]]
        right += [y, x]
    h = np.append(np.linalg.solve(np.array(equations), right), 1.0).reshape(3, 3)
    v, u = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : cols * 1j]
    mapped = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ h.T
    return mapped[:, :2] / mapped[:, 2:]


def patch_means(image: NDArray, corners: Sequence[Corner], rows: int = 4, cols: int = 6) -> NDArray[np.float64]:
    """Mean of each patch over a centred square, [patch, channel].

    Parameters
    ----------
    image : [row, col, channel]; NaN counts as missing.

    Raises
    ------
    RangeError
        If a patch lies outside the image.
    """
    centres = patch_centres(corners, rows, cols)
    grid = centres.reshape(rows, cols, 2)
    pitch = min(
        float(np.hypot(*np.moveaxis(np.diff(grid, axis=axis), -1, 0)).min()) for axis in (0, 1) if grid.shape[axis] > 1
    )
    half = max(0.5, _SHARE * pitch / 2)
    means = []
    for row, col in centres:
        top, bottom, left, right = (round(value) for value in (row - half, row + half, col - half, col + half))
        if top < 0 or left < 0 or bottom >= image.shape[0] or right >= image.shape[1]:
            raise RangeError(
                "chart corners",
                np.asarray(corners, dtype=np.float64).tolist(),
                f"corners inside the image of {image.shape[0]} rows and {image.shape[1]} columns: the patch around row "
                f"{round(row)}, column {round(col)} would lie outside",
            )
        means.append(np.nanmean(image[top : bottom + 1, left : right + 1].reshape(-1, image.shape[2]), axis=0))
    return np.array(means)


def reference_linear_srgb(light: Spectrum | None = None) -> NDArray[np.float64]:
    """Linear sRGB of a ColorChecker's 24 patches under a light (default D65), its white adapted to (1, 1, 1)."""
    light = light or spectra.illuminant("D65")
    patches = list(spectra.colorchecker_reflectances("ISO 17321-1").values())
    return xyz_to_linear_srgb(tristimulus(light, patches), tristimulus(light, [constant(1.0)])[0])
