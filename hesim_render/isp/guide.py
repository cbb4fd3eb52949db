"""The guide channel of demosaicing, predicted under several priors that are weighted locally by their likelihood.

A prior states a direction along which the picture changes least, and how much its colours differ. Each prior gives a
linear prediction (`kriging`), and for every sample its residual from the prediction by the other samples. A prior gets
weight where its residuals are much smaller than those of the isotropic prior: a mixture of linear predictors with
weights by local likelihood. A grating at half the Nyquist frequency, for example, which one direction explains as
detail and the other as colour, becomes detail.
"""

import functools

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.bands import in_bands
from hesim_render.isp import kriging
from hesim_render.isp.kriging import Prior

#: Variance of the differences of strong colours over the variance of their common part.
_STRONG = 1.0
_TURNS = [k * np.pi / 8 for k in range(8)]
#: The priors; the first one, isotropic, is the default.
_USUAL = (Prior(), Prior(line=0), Prior(line=1), *(Prior(angle=angle) for angle in _TURNS))
_STRONGLY_COLOURED = (
    Prior(_STRONG), Prior(_STRONG, line=0), Prior(_STRONG, line=1), Prior(_STRONG, _TURNS[2]), Prior(_STRONG, _TURNS[6])
)  # fmt: skip
_GREY = (Prior(grey=True), Prior(grey=True, line=0), Prior(grey=True, line=1), Prior(grey=True, smooth=True))
PRIORS = (*_USUAL, *_STRONGLY_COLOURED, *_GREY)

#: Factors on the squared residuals of a prior before they are compared, against noise in the choice: of a
#: direction, and of strong colours and greys where the local mean is grey and where it is coloured.
_DIRECTED = 1.3
_STRONG_IN_GREY, _STRONG_IN_COLOUR = 2.5, 1.1
_GREY_IN_GREY, _GREY_IN_COLOUR = 1.5, 4.0
#: Standard deviation of the channels' local means that counts as grey, and as coloured; square-root units.
_NO_COLOUR, _COLOUR = 0.03, 0.1
#: Width of that mean (standard deviation, blocks): with a small width, edges between greys look coloured.
_AROUND_BLOCKS = 1.4
#: Squared residual that counts as zero, square-root units squared.
_QUIET = 5e-5
#: Weights are the squared residual to the power of minus 2 to this: a prior that is twice as good counts 256 times.
_SHARPNESS = 3
#: Rows and columns of blocks that are processed at once, so that their data stay in the cache.
_BAND_BLOCKS, _PART_BLOCKS = 16, 64


def predict_guide(planes: NDArray[np.float32], block: NDArray, channel: int) -> NDArray[np.float32]:
    """A channel at every position: measured, or predicted.

    Parameters
    ----------
    planes : [position, block row, block col] of square roots, with one block of border.
    block : channel of each position, [row, col], -1 where there is none.
    channel : the wanted channel, the one with most samples.

    Returns
    -------
    float32 [row in block, col in block, block row, block col] : without the border.
    """
    known = [tuple(place) for place in np.argwhere(block == channel)]
    wanted = [tuple(place) for place in np.argwhere(block != channel)]
    # one matrix for all priors: predictions of the wanted places, and residuals of the known samples
    weights, member, counts = _stencils(tuple(map(tuple, block.tolist())), channel, tuple(wanted))
    height, width = planes.shape[1] - 2, planes.shape[2] - 2
    out = np.empty((*block.shape, height, width), dtype=np.float32)
    for row, col in known:
        out[row, col] = planes[row * block.shape[1] + col, 1:-1, 1:-1]
    colour = _saturation(planes, block)
    cell_of = [_cell(place, block.shape) for place in wanted]

    wide = np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")  # residuals are averaged over neighbours

    def work(rows: slice) -> None:
        for first in range(0, width, _PART_BLOCKS):
            cols = slice(first, min(first + _PART_BLOCKS, width))
            around = slice(rows.start, rows.stop + 2), slice(cols.start, cols.stop + 2)
            result = kriging.apply(wide, weights, *around)
            result = result.reshape(len(PRIORS), -1, *result.shape[1:])
            # the prior that predicts the samples around best has most of the share; unusual priors must be better by a
            # factor
            energy = _energy(result[:, len(wanted) :], member, counts)
            energy *= _handicap(colour[rows, cols])
            share = _shares(energy)
            inner = result[:, : len(wanted), 1:-1, 1:-1]
            for k, (row, col) in enumerate(wanted):
                np.einsum("krc,krc->rc", inner[:, k], share[cell_of[k]], out=out[row, col, rows, cols])

    in_bands(height, work, _BAND_BLOCKS)
    return out


def _cells(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Rows and columns of cells in a block; a cell measures 2×2 px, or a little more where a side is odd."""
    return tuple(size // 2 for size in shape)


def _cell(place: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(min(at // 2, size // 2 - 1) for at, size in zip(place, shape, strict=True))


@functools.lru_cache(maxsize=32)
def _stencils(
    tile: kriging.Block, channel: int, wanted: tuple[tuple[int, int], ...]
) -> tuple[kriging.Taps, list[tuple[int, ...]], NDArray[np.float32]]:
    """Weights [prior · (wanted, then residuals)], the cell of each residual, and samples per cell."""
    block = np.array(tile)
    cells = [_cell(tuple(place), block.shape) for place in np.argwhere(block >= 0)]
    counts = np.zeros(_cells(block.shape), dtype=np.float32)
    for cell in cells:
        counts[cell] += 1
    parts = [
        part
        for prior in PRIORS
        for part in (kriging.stencil(tile, channel, wanted, prior), kriging.residual_stencil(tile, prior))
    ]
    return kriging.Taps.of(np.concatenate(parts)), cells, counts


def _energy(
    residual: NDArray[np.float32], cells: list[tuple[int, ...]], counts: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Mean squared residual around each cell, [cell row, cell col, prior, block row, block col].

    Parameters
    ----------
    residual : [prior, sample, block row, block col], with one more block on each side; overwritten by its squares.
    cells : cell of each sample.
    counts : samples per cell.
    """
    np.multiply(residual, residual, out=residual)
    sums = np.zeros((*counts.shape, len(residual), *residual.shape[2:]), dtype=np.float32)
    for k, cell in enumerate(cells):
        sums[cell] += residual[:, k]
    wrapped = np.pad(counts, 1, mode="wrap")
    lines = wrapped[:-2] + 2 * wrapped[1:-1] + wrapped[2:]
    around = lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:]
    for axis in range(2):
        sums = _binomial(sums, axis)
    sums /= around[:, :, None, None, None]
    sums += np.float32(_QUIET)
    return sums


def _binomial(cells: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Each cell twice plus its two neighbours along rows (axis 0) or columns (1), without the border of blocks."""
    blocks = cells.ndim - 2 + axis
    size = cells.shape[blocks] - 2

    def of(cell: int, step: int) -> NDArray[np.float32]:
        step, cell = step + cell // cells.shape[axis], cell % cells.shape[axis]
        part: list[slice | int] = [slice(None)] * cells.ndim
        part[axis], part[blocks] = cell, slice(1 + step, 1 + step + size)
        return cells[tuple(part)]

    out = [of(k, 0) * np.float32(2) for k in range(cells.shape[axis])]
    for k, line in enumerate(out):
        line += of(k - 1, 0)
        line += of(k + 1, 0)
    return np.stack(out, axis=axis)


def _saturation(planes: NDArray[np.float32], block: NDArray) -> NDArray[np.float32]:
    """Mean colourfulness of the picture around each block, 0 grey to 1, [block row, block col]."""
    from scipy.ndimage import gaussian_filter

    channels = [np.flatnonzero(block.ravel() == c) for c in range(block.max() + 1)]
    means = np.stack([np.mean([planes[k, 1:-1, 1:-1] for k in own], axis=0) for own in channels])
    smooth = [gaussian_filter(mean, _AROUND_BLOCKS, mode="nearest") for mean in means]
    return np.clip((np.std(smooth, axis=0) - np.float32(_NO_COLOUR)) / np.float32(_COLOUR - _NO_COLOUR), 0, 1)


def _handicap(colour: NDArray[np.float32]) -> NDArray[np.float32]:
    """Factor of each prior's squared residuals, [prior, block row, block col]."""
    strong = _STRONG_IN_GREY + colour * np.float32(_STRONG_IN_COLOUR - _STRONG_IN_GREY)
    grey = _GREY_IN_GREY + colour * np.float32(_GREY_IN_COLOUR - _GREY_IN_GREY)
    usual = [np.full_like(colour, 1.0 if k == 0 else _DIRECTED) for k in range(len(_USUAL))]
    return np.stack([*usual, *[strong] * len(_STRONGLY_COLOURED), *[grey] * len(_GREY)])


def _shares(energy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weights of the priors, which sum to 1, written over their energies [cell row, cell col, prior, …]."""
    np.divide(energy.min(axis=2, keepdims=True), energy, out=energy)
    for _ in range(_SHARPNESS):
        np.multiply(energy, energy, out=energy)
    energy /= energy.sum(axis=2, keepdims=True)
    return energy
