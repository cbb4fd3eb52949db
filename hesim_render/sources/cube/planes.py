"""Integrals of a cube with spectra: one plane for each filter."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.sensor.photocurrent import band_weights
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.targets.cube_file import CubeFile

#: Values of a cube that are read at a time.
_BLOCK_VALUES = 16_000_000
#: Wavelengths up to which the first and the last plane of a cube are held, nm; all responses lie between them.
_HELD_NM = (300.0, 1100.0)


def integration_weights(spectra: Sequence[Spectrum], cube: CubeFile, hold: bool) -> NDArray[np.float64]:
    """Weights of the bands in the integrals of a cube with each spectrum, [band, spectrum].

    Parameters
    ----------
    spectra : what is integrated with the cube.
    cube : supplies the wavelengths.
    hold : the first and the last plane hold beyond their wavelengths; else the cube must cover 99.9 % of each spectrum.

    Raises
    ------
    SpecError
        If the cube does not cover a spectrum.
    """
    bands = cube.wavelength_nm
    assert bands is not None
    ends = [min(_HELD_NM[0], bands[0] - 1)], [max(_HELD_NM[1], bands[-1] + 1)]
    wide = np.concatenate([ends[0], bands, ends[1]]) if hold else bands
    result = []
    for spectrum in spectra:
        try:
            weights = band_weights(spectrum, wide)
        except SpecError as error:
            raise SpecError(f"{error}; or let its ends hold (beyond: hold)", file=cube.file, key="cube") from None
        if hold:
            weights[1] += weights[0]
            weights[-2] += weights[-1]
            weights = weights[1:-1]
        result.append(weights)
    return np.stack(result, axis=1)


def blocks(cube: CubeFile) -> Iterator[NDArray[np.float32]]:
    """The rows of a cube in bands that fit into memory, float32 [row, col, band]."""
    rows, cols, bands = cube.shape
    step = max(1, _BLOCK_VALUES // (cols * bands))
    for first in range(0, rows, step):
        yield cube.rows(first, min(first + step, rows))


def integrated(cube: CubeFile, weights: NDArray[np.float64], shrink: int) -> NDArray[np.float32]:
    """Integrals of a cube with spectra, averaged over squares of `shrink` × `shrink` texels; a rest is left out.

    Parameters
    ----------
    cube : the cube.
    weights : [band, spectrum], from `integration_weights`.
    shrink : side of a square, texels.

    Returns
    -------
    float32 [spectrum, row, col].
    """
    rows, cols = cube.shape[0] // shrink, cube.shape[1] // shrink
    out = np.empty((weights.shape[1], rows, cols), dtype=np.float32)
    step = max(1, _BLOCK_VALUES // (cube.shape[1] * cube.shape[2] * shrink))
    for first in range(0, rows, step):
        end = min(first + step, rows)
        values = cube.rows(first * shrink, end * shrink) @ weights.astype(np.float32)
        cells = values[:, : cols * shrink].reshape(end - first, shrink, cols, shrink, -1)
        out[:, first:end] = np.moveaxis(cells.mean(axis=(1, 3), dtype=np.float32), -1, 0)
    return out
