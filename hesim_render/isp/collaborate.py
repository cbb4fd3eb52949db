"""Noise reduction of blocks of samples by comparing each patch with similar patches (collaborative filtering).

A patch is 2×2 neighbouring blocks. It is transformed into a basis that is fitted to its tile: the principal axes of
pictures under the prior of `kriging`. Its coefficients are compared with those of the patches around. The mean and the
spread of the 16 nearest patches estimate which part of each coefficient is picture. This is the collaborative filtering
of BM3D [dabov2007] (on mosaics [danielyan2009]) with the statistics of non-local Bayes [lebrun2013]. The first pass
uses thresholds; the second is a Wiener filter that uses the result of the first as pilot. Patches are displaced by
whole blocks, so that equal colours are compared, and the basis serves any tile, also with holes.
"""

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.bands import in_bands
from hesim_render.isp.kriging import ISOTROPIC

#: Number of similar patches, and radius of the search, blocks.
_ALIKE, _REACH = 16, 4
#: Number of compared coefficients, largest in pictures first; the first pass compares only those above the noise.
_COMPARED, _STANDS_OUT = 16, 1.5
#: A mean counts as picture if it exceeds this many of its own standard deviations.
_THRESHOLD = 2.7
#: Weight of a patch's own deviation, besides the spread over its group, in the signal variance of the second pass.
_OWN = 0.5
#: Added to the residual variance of a patch before patches are weighted by its inverse.
_LEAST_LEFT = 1.0
_BAND_ROWS, _AT_ONCE = 16, 2048


@dataclass(frozen=True, eq=False)
class SampleBlocks:
    """Samples in blocks, each with a noise of standard deviation 1.

    Parameters
    ----------
    values : float32 [block row, block col, sample].
    at : [sample, 2], place of each in its block (row, col), px.
    size : rows and columns of a block, px.
    channel : channel of each sample.
    amplitude : signal of white at each sample, in units of its noise.
    """

    values: NDArray[np.float32]
    at: NDArray[np.float64]
    size: tuple[int, int]
    channel: NDArray[np.int64]
    amplitude: NDArray[np.float64]

    def basis(self) -> NDArray[np.float32]:
        """Principal axes of a patch of pictures, [sample of 2×2 blocks, axis], the largest first."""
        # a patch is 2×2 blocks; axes are those in which pictures, in units of their noise, vary most
        corners = [(i, j) for i in range(2) for j in range(2)]
        at = np.concatenate([self.at + np.array(corner) * self.size for corner in corners])
        channel, amplitude = np.tile(self.channel, 4), np.tile(self.amplitude, 4)
        dy, dx = (at[:, None] - at[None]).transpose(2, 0, 1)
        covariance = ISOTROPIC.covariance(dy, dx, channel[:, None] == channel[None])
        _, axes = np.linalg.eigh(covariance * amplitude[:, None] * amplitude)
        return np.ascontiguousarray(axes[:, ::-1], dtype=np.float32)


def one_pass(
    blocks: SampleBlocks, pilot: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """One pass over all patches.

    Parameters
    ----------
    blocks : the samples.
    pilot : result of the first pass, which the second pass uses as estimate of the picture; None for the first pass.

    Returns
    -------
    float32 [block row, block col, sample], sums of estimates, and [block row, block col], their weights.
    """
    values, basis = blocks.values, blocks.basis()
    patch_rows, patch_cols = values.shape[0] - 1, values.shape[1] - 1
    total, weight = np.zeros_like(values), np.zeros(values.shape[:2], dtype=np.float32)
    lock = threading.Lock()  # neighbouring bands share a row of blocks: a sum of two terms, whose order does not matter

    def work(rows: slice) -> None:
        # patches of the band, and all around them with which they are compared
        halo = slice(max(rows.start - _REACH, 0), min(rows.stop + _REACH, patch_rows))
        noisy = _coefficients(values, basis, halo)
        clean = None if pilot is None else _coefficients(pilot, basis, halo)
        inside = slice(rows.start - halo.start, rows.stop - halo.start)
        # the most similar patches of each, by what is known of the picture so far, [patch, member]
        alike = _alike(_features(noisy if clean is None else clean, clean is None), inside)
        estimate, weights = _estimate(noisy, clean, alike, inside.start * patch_cols)
        # back to samples; each sample has estimates from the four patches that contain it, by their weights
        patches = (estimate @ basis.T).reshape(rows.stop - rows.start, patch_cols, 4, -1)
        patches *= weights.reshape(patches.shape[:2])[..., None, None]
        part = np.zeros((len(patches) + 1, *values.shape[1:]), dtype=np.float32)
        shares = np.zeros(part.shape[:2], dtype=np.float32)
        for corner, (i, j) in enumerate(np.ndindex(2, 2)):
            part[i : i + len(patches), j : j + patch_cols] += patches[:, :, corner]
            shares[i : i + len(patches), j : j + patch_cols] += weights.reshape(patches.shape[:2])
        with lock:
            total[rows.start : rows.stop + 1] += part
            weight[rows.start : rows.stop + 1] += shares

    in_bands(patch_rows, work, _BAND_ROWS)
    return total, weight


def _coefficients(values: NDArray[np.float32], basis: NDArray[np.float32], rows: slice) -> NDArray[np.float32]:
    """Coefficients of the patches that begin in `rows`, [row, col, axis]."""
    above, below = values[rows], values[rows.start + 1 : rows.stop + 1]
    corners = [half[:, j : half.shape[1] - 1 + j] for half in (above, below) for j in range(2)]
    return np.concatenate(corners, axis=2) @ basis


def _features(coefficients: NDArray[np.float32], is_noisy: bool) -> NDArray[np.float32]:
    """Features by which patches are compared, [row, col, feature]."""
    result = coefficients[..., :_COMPARED].copy()
    if is_noisy:
        result[..., 1:][np.abs(result[..., 1:]) < _STANDS_OUT] = 0
    return result


def _alike(features: NDArray[np.float32], inside: slice) -> NDArray[np.int64]:
    """Flat indices of the patches most similar to each patch of rows `inside`, itself included, [patch, member]."""
    height, width = features.shape[:2]
    count = inside.stop - inside.start
    reach = range(-_REACH, _REACH + 1)
    offsets = np.array([(dy, dx) for dy in reach for dx in reach])
    distance = np.full((count, width, len(offsets)), np.inf, dtype=np.float32)
    for k, (dy, dx) in enumerate(offsets):
        top, bottom = max(inside.start, -dy), min(inside.stop, height - dy)
        left, right = max(0, -dx), min(width, width - dx)
        if top >= bottom or left >= right:
            continue
        # squared distance of all patches of the band to those at one offset
        difference = features[top:bottom, left:right] - features[top + dy : bottom + dy, left + dx : right + dx]
        into = distance[top - inside.start : bottom - inside.start, left:right, k]
        np.einsum("rcf,rcf->rc", difference, difference, out=into)
    # small frames have fewer neighbours
    members = min(_ALIKE, min(_REACH + 1, height) * min(_REACH + 1, width))
    flat = distance.reshape(count * width, -1)
    nearest = np.argpartition(flat, members - 1, axis=1)[:, :members]
    own = np.arange(inside.start * width, inside.stop * width)
    return own[:, None] + (offsets @ np.array([width, 1]))[nearest]


def _estimate(
    noisy: NDArray[np.float32], clean: NDArray[np.float32] | None, alike: NDArray[np.int64], first: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Noise-reduced coefficients of the patches from `first` on, [patch, axis], and weights [patch]."""
    size = noisy.shape[2]
    noisy, clean = noisy.reshape(-1, size), None if clean is None else clean.reshape(-1, size)
    out = np.empty((len(alike), size), dtype=np.float32)
    weights = np.empty(len(alike), dtype=np.float32)
    members = float(alike.shape[1])
    for begin in range(0, len(alike), _AT_ONCE):
        part = slice(begin, min(begin + _AT_ONCE, len(alike)))
        own = noisy[first + part.start : first + part.stop]
        mean, square = _moments(noisy, alike[part])
        if clean is None:
            # first pass: noise has a variance of 1, so what the members scatter beyond it is picture
            spread = (square - mean * mean) * np.float32(members / max(members - 1, 1))
            of_mean = (np.abs(mean) > _THRESHOLD / members**0.5).astype(np.float32)
            of_rest = np.maximum(spread - 1, 0) / np.maximum(spread, np.float32(1e-6))
        else:
            # second pass: the Wiener filter, whose signal is that of the first result; a patch that lies away from its
            # kind keeps more of its own
            picture, square = _moments(clean, alike[part])
            spread = np.maximum(square - picture * picture, 0)
            away = clean[first + part.start : first + part.stop] - picture
            signal = spread + np.float32(_OWN) * (away * away - spread)
            of_mean = picture * picture
            of_mean /= of_mean + 1 / members
            of_rest = signal / (signal + 1)
        # the mean of the members has a noise of 1/members, and what is the own patch beside it the whole noise
        out[part] = of_mean * mean + of_rest * (own - mean)
        # variance of the noise that the estimate still has: its inverse is the weight
        left = np.einsum("pc,pc->p", of_rest, of_rest) + np.einsum("pc,pc->p", of_mean, of_mean) / members
        weights[part] = 1 / (np.float32(_LEAST_LEFT) + left)
    return out, weights


def _moments(coefficients: NDArray[np.float32], alike: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Mean and mean square over the members, [patch, axis]."""
    total = np.zeros((len(alike), coefficients.shape[1]), dtype=np.float32)
    squares = np.zeros_like(total)
    for member in alike.T:
        values = coefficients[member]
        total += values
        np.multiply(values, values, out=values)
        squares += values
    return total / np.float32(alike.shape[1]), squares / np.float32(alike.shape[1])
