"""Weights of linear demosaicing: the best linear unbiased prediction of a colour from the samples around it.

The method is universal co-kriging ([wackernagel2003], ch. 23-24). It equals the linear minimum-mean-square demosaicing
of Trussell and Hartley [trussell2002] with the constraint that planes of any colour are reproduced exactly. A prior
states two properties of pictures. Nearby samples are similar: cov = exp(-distance / length). Colours are correlated:
cov(colour a, colour b) = cov · (1 + colour · [a = b]). `Prior` has variants of this one. The method needs no training
data and works for any tile, also with holes.

A stencil is an array of weights [output, input position in the block, block row - 1 … + 1, block col - 1 … + 1].
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

#: Correlation length, px. Pictures have no preferred scale, and between 10 and 100 px results hardly change.
LENGTH_PX = 24.0
#: Ratio of the correlation length along a direction to that across it.
ELONGATION = 6.0
#: Correlation length of a picture that is smooth on the scale of a pixel, px.
SMOOTH_PX = 1.5
#: Variance of the differences of colours over the variance of their common part, after white balance.
COLOUR = 0.06
#: Variance of noise over that of the picture; it keeps the equations well posed and hardly smooths.
NOISE = 1e-3
#: Samples farther than this from the block are not used, px.
REACH_PX = 4
#: OpenBLAS multiplies matrices of up to this many products on the calling thread. The bands of a frame are threads
#: already, and further threads of OpenBLAS would only wait for each other.
_ONE_THREAD = 1 << 18
_PIECE = 64

Block = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Prior:
    """Prior assumptions about a picture.

    Parameters
    ----------
    colour : variance of the differences of colours over that of their common part.
    angle : direction in which the picture changes least, radians from the rows towards the columns; None for none.
    line : predict from the target's own column (0) or row (1) alone; None from all directions.
    smooth : no detail below `SMOOTH_PX` (a Matérn covariance of order 3/2) instead of detail of all sizes.
    grey : all colours are the same, also in the mean.
    """

    colour: float = COLOUR
    angle: float | None = None
    line: int | None = None
    smooth: bool = False
    grey: bool = False

    def distinguished(self, channel: NDArray) -> NDArray:
        """Channel numbers, all equal where the prior does not distinguish colours."""
        return np.zeros_like(channel) if self.grey else channel

    def covariance(self, dy: NDArray, dx: NDArray, same: NDArray) -> NDArray[np.float64]:
        """Covariance of samples at distances dy, dx, px; `same` is True where they have the same colour."""
        shared = own = np.exp(-np.hypot(dy, dx) / LENGTH_PX)
        if self.smooth:
            far = np.hypot(dy, dx) / SMOOTH_PX
            shared = (1 + far) * np.exp(-far)
        elif self.angle is not None:
            along = dx * np.cos(self.angle) + dy * np.sin(self.angle)
            across = dy * np.cos(self.angle) - dx * np.sin(self.angle)
            shared = np.exp(-np.hypot(along / ELONGATION, across) * np.sqrt(ELONGATION) / LENGTH_PX)
        return shared + self.colour * own * same


#: No preferred direction, colours as in most pictures.
ISOTROPIC = Prior()


class _Equations:
    """The kriging equations of samples at `at` [n, 2], with planes of every colour as drift, and their inverse."""

    def __init__(self, at: NDArray, channel: NDArray, prior: Prior, scale: NDArray) -> None:
        self._at, self._channel, self._prior = at, prior.distinguished(channel), prior
        self._names = np.unique(self._channel)
        self._moves = [axis for axis in range(2) if np.ptp(at[:, axis]) > 0]
        self._centre, self._scale = at.mean(axis=0), scale
        # weights of least variance under the condition that planes of each colour are met exactly (Lagrange
        # multipliers)
        drift = self._planes(at, self._channel)
        n, p = drift.shape
        system = np.zeros((n + p, n + p))
        system[:n, :n] = self._covariance(at, self._channel) + NOISE * np.eye(n)
        system[:n, n:], system[n:, :n] = drift, drift.T
        self.inverse = _inverse(system)[:n]

    def _covariance(self, at: NDArray, channel: NDArray) -> NDArray[np.float64]:
        dy, dx = (self._at[:, None] - at[None]).transpose(2, 0, 1)
        return self._prior.covariance(dy, dx, self._channel[:, None] == channel[None])

    def _planes(self, at: NDArray, channel: NDArray) -> NDArray[np.float64]:
        own = (channel[:, None] == self._names).astype(np.float64)
        shift = (at - self._centre) / self._scale
        return np.concatenate([own, *(own * shift[:, axis, None] for axis in self._moves)], axis=1)

    def weights(self, at: NDArray, channel: NDArray) -> NDArray[np.float64]:
        """Weight of each sample for targets at `at` [m, 2]; [n, m]."""
        channel = self._prior.distinguished(channel)
        return self.inverse @ np.vstack([self._covariance(at, channel), self._planes(at, channel).T])


def _inverse(system: NDArray) -> NDArray[np.float64]:
    """Inverse of a symmetric matrix; the pseudo-inverse if the samples of a sparse tile do not determine every
    plane.
    """
    try:
        inverse = np.linalg.inv(system)
    except np.linalg.LinAlgError:
        inverse = np.zeros_like(system)
    if np.abs(system @ inverse - np.eye(len(system))).max() < 1e-6:
        return inverse
    return np.linalg.pinv(system, rcond=1e-10, hermitian=True)


def _window(block: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Samples within reach of a block: flat index into [position, 3, 3], place [n, 2] and channel."""
    rows, cols = block.shape
    y, x = np.mgrid[-rows : 2 * rows, -cols : 2 * cols]
    channel = np.tile(block, (3, 3))
    # samples of the block and its eight neighbours that lie near enough
    near = (y >= -REACH_PX) & (y < rows + REACH_PX) & (x >= -REACH_PX) & (x < cols + REACH_PX) & (channel >= 0)
    y, x, channel = y[near], x[near], channel[near]
    index = ((y % rows * cols + x % cols) * 3 + y // rows + 1) * 3 + x // cols + 1
    return index, np.stack([y, x], axis=1).astype(np.float64), channel


@functools.lru_cache(maxsize=512)
def _equations(tile: Block, prior: Prior, line: int | None) -> tuple[NDArray[np.int64], NDArray, NDArray, _Equations]:
    """Index, place and channel of the used samples of a block (all, or those on one line), and their equations."""
    block = np.array(tile)
    index, at, seen = _window(block)
    if line is not None and prior.line is not None:
        on = at[:, 1 - prior.line] == line
        index, at, seen = index[on], at[on], seen[on]
    return index, at, seen, _Equations(at, seen, prior, np.array(block.shape))


def _known_from(
    tile: Block, prior: Prior, channel: int, place: tuple[int, int], least: int
) -> tuple[NDArray[np.int64], NDArray, NDArray, _Equations]:
    """The samples that predict a place: those on its line, if the prior has lines and the channel occurs there often
    enough.
    """
    if prior.line is not None:
        line = np.array(tile)[:, place[1]] if prior.line == 0 else np.array(tile)[place[0]]
        if np.count_nonzero(line >= 0 if prior.grey else line == channel) * 3 > least:
            return _equations(tile, prior, place[1 - prior.line])
    return _equations(tile, replace(prior, line=None), None)


@functools.lru_cache(maxsize=256)
def stencil(
    tile: Block, channel: int, targets: tuple[tuple[int, int], ...], prior: Prior = ISOTROPIC
) -> NDArray[np.float32]:
    """Weights for one channel at positions of the block, from all samples around.

    With a prior that uses lines, a target whose line lacks the channel gets the weights from all samples.
    """
    block = np.array(tile)
    weights = np.zeros((len(targets), block.size * 9))
    for k, target in enumerate(targets):
        index, _, _, equations = _known_from(tile, prior, channel, target, 0)
        weights[k, index] = equations.weights(np.array([target], dtype=np.float64), np.array([channel]))[:, 0]
    return weights.reshape(len(targets), block.size, 3, 3).astype(np.float32)


@functools.lru_cache(maxsize=256)
def residual_stencil(tile: Block, prior: Prior = ISOTROPIC) -> NDArray[np.float32]:
    """Weights that give the residual of each sample of the block from its prediction by the other samples.

    Leave-one-out residuals of kriging in closed form [dubrule1983]: with the inverse B of the
    kriging matrix, r_i = Σ_j B_ij y_j / B_ii. There is one output for each position of the block that has a sample.
    """
    block = np.array(tile)
    places = np.argwhere(block >= 0)
    weights = np.zeros((len(places), block.size * 9))
    for k, place in enumerate(places):
        index, at, _, equations = _known_from(tile, prior, int(block[tuple(place)]), tuple(place), 1)
        own = int(np.flatnonzero((at == place).all(axis=1))[0])
        inverse = equations.inverse[own, : len(at)]
        if inverse[own] > 1e-9:
            weights[k, index] = inverse / inverse[own]
    return weights.reshape(len(places), block.size, 3, 3).astype(np.float32)


@functools.lru_cache(maxsize=64)
def lone_stencil(
    shape: tuple[int, int], samples: tuple[tuple[int, int], ...], targets: tuple[tuple[int, int], ...]
) -> NDArray[np.float32]:
    """Weights from samples of one kind at these positions of each block; inputs are numbered as in `samples`."""
    block = np.full(shape, -1)
    block[tuple(np.array(samples).T)] = 0
    dense = stencil(tuple(map(tuple, block.tolist())), 0, targets, Prior(colour=0.0))
    kept = [row * shape[1] + col for row, col in samples]
    return dense[:, kept]


@functools.lru_cache(maxsize=64)
def bilinear_stencil(shape: tuple[int, int], centre: tuple[float, float]) -> NDArray[np.float32]:
    """Weights that spread one value per block, standing at `centre` of it, to all its pixels."""

    def line(size: int, middle: float) -> NDArray:
        place = (np.arange(size) - middle) / size
        return np.stack([np.clip(-place, 0, 1), 1 - np.abs(place), np.clip(place, 0, 1)], axis=1)

    rows, cols = line(shape[0], centre[0]), line(shape[1], centre[1])
    return np.einsum("ia,jb->ijab", rows, cols).reshape(-1, 1, 3, 3).astype(np.float32)


@dataclass(frozen=True)
class Taps:
    """A stencil prepared for use: positions it reads (position, block row, block col), and weights [output,
    reading].
    """

    reads: tuple[tuple[int, int, int], ...]
    matrix: NDArray[np.float32]

    @classmethod
    def of(cls, weights: NDArray[np.float32]) -> "Taps":
        reads = np.argwhere(np.abs(weights).max(axis=0) > 0)
        return cls(tuple((int(p), int(y), int(x)) for p, y, x in reads), np.ascontiguousarray(weights[:, *reads.T]))


def apply(
    planes: NDArray[np.float32], stencil: Taps | NDArray[np.float32], rows: slice, cols: slice | None = None
) -> NDArray[np.float32]:
    """A stencil at block rows `rows` of planes [position, block row, block col] with one block of border.

    Parameters
    ----------
    rows, cols : count without the border; all columns by default.

    Returns
    -------
    float32 [output, row, col].
    """
    taps = stencil if isinstance(stencil, Taps) else Taps.of(stencil)
    cols = slice(0, planes.shape[2] - 2) if cols is None else cols
    height, width = rows.stop - rows.start, cols.stop - cols.start
    size, count = height * width, len(taps.reads)
    pieces = -(-size // _PIECE)
    line = np.zeros(pieces * _PIECE, dtype=np.float32)
    image, cut = line[:size].reshape(height, width), line.reshape(pieces, _PIECE)
    # pixels in short pieces, [piece, reading, pixel], each of which one product on the calling thread serves
    around = np.empty((pieces, count, _PIECE), dtype=np.float32)
    for k, (position, dy, dx) in enumerate(taps.reads):
        image[:] = planes[position, rows.start + dy : rows.stop + dy, cols.start + dx : cols.stop + dx]
        around[:, k] = cut
    out = np.empty((len(taps.matrix), pieces * _PIECE), dtype=np.float32)
    together = max(1, _ONE_THREAD // (count * _PIECE))
    for first in range(0, len(out), together):
        some = slice(first, first + together)
        np.matmul(taps.matrix[some], around, out=out[some].reshape(-1, pieces, _PIECE).transpose(1, 0, 2))
    return out[:, :size].reshape(-1, height, width)
