"""Noise reduction on the mosaic before demosaicing, by the sensor's own noise model.

The signal is transformed so that its noise has the same variance everywhere (`stabilise`). Then follow two passes of
`collaborate`, each over patches that begin at whole blocks and over patches that begin half a block further. Patches of
this size cannot separate low-frequency noise from picture. It is removed from the means of blocks, which form an image
of their own with less noise.

Pictures in RGB have a smoothing that preserves edges, the guided filter, and a noise reduction based on it.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from hesim_render.core.errors import RangeError
from hesim_render.isp import collaborate, kriging
from hesim_render.isp.collaborate import SampleBlocks
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.stabilise import Stabiliser, block_of, bordered, join, split
from hesim_render.spectral.transfer import from_root, to_root

#: The block means correct only longer wavelengths than this: standard deviation of a Gaussian, blocks.
_LONG_BLOCKS = 2.0


def denoise(
    signal_dn: NDArray[np.float32], tile: ArrayLike, noise: FrameNoise, top_dn: float, balance: Sequence[float]
) -> NDArray[np.float32]:
    """A mosaic with less temporal noise, float32 [row, col], DN above black.

    Parameters
    ----------
    signal_dn : [row, col], DN above black, corrected by the sensor's maps (`FrameNoise.corrected`).
    tile : channel of each position, -1 where there is no value.
    noise : noise of the sensor; its tile has the shape of `tile`.
    top_dn : signal at which pixels saturate, DN; saturated samples are kept.
    balance : gain of each channel that makes white equal in all.
    """
    channels = np.asarray(tile)
    stabilisers = _stabilisers(noise, channels, top_dn)
    # noise of standard deviation 1 everywhere, whatever the level
    stable = _each(signal_dn, channels.shape, stabilisers, Stabiliser.forward)
    clean = _reduced(stable, channels, 1 / np.sqrt(np.asarray(balance, dtype=np.float64)))
    out = _each(clean, channels.shape, stabilisers, Stabiliser.backward)
    return np.where(signal_dn >= top_dn, signal_dn, out)


def _stabilisers(noise: FrameNoise, tile: NDArray, top_dn: float) -> dict[tuple[int, int], Stabiliser]:
    """The transform of each tile position; positions with equal noise share one."""
    made: dict[tuple[float, float, float], Stabiliser] = {}
    result = {}
    for row, col in np.argwhere(tile >= 0):
        law = noise.variance((int(row), int(col)))
        if law not in made:
            made[law] = Stabiliser(*law, top_dn)
        result[int(row), int(col)] = made[law]
    return result


def _each(
    image: NDArray[np.float32],
    shape: tuple[int, ...],
    stabilisers: dict[tuple[int, int], Stabiliser],
    way: Callable[[Stabiliser, NDArray[np.float32]], NDArray[np.float32]],
) -> NDArray[np.float32]:
    """`Stabiliser.forward` or `backward` of every position's own transform."""
    if len(set(stabilisers.values())) == 1:
        return way(next(iter(stabilisers.values())), image)
    out = np.zeros_like(image)
    for (row, col), stabiliser in stabilisers.items():
        part = (slice(row, None, shape[0]), slice(col, None, shape[1]))
        out[part] = way(stabiliser, np.ascontiguousarray(image[part]))
    return out


def _reduced(stable: NDArray[np.float32], tile: NDArray, amplitude: NDArray) -> NDArray[np.float32]:
    """The mosaic with its noise, of standard deviation 1, reduced."""
    # the first result tells the second pass which patches are alike, and how much of each is signal
    pilot = _over_phases(stable, None, tile, amplitude)
    fine = _over_phases(stable, pilot, tile, amplitude)
    return fine + _long_waves(stable, fine, tile, amplitude)


def _over_phases(
    stable: NDArray[np.float32], pilot: NDArray[np.float32] | None, tile: NDArray, amplitude: NDArray
) -> NDArray[np.float32]:
    """Mean of the estimates of patches that begin at whole blocks and of those that begin in the middle of blocks."""
    block = block_of(tile)
    total, weight = np.zeros_like(stable), np.zeros_like(stable)
    for part in range(2):
        top, left = (part * (size // 2) for size in block.shape)
        if stable.shape[0] <= top or stable.shape[1] <= left:
            continue
        turned = np.roll(block, (-top, -left), axis=(0, 1))
        blocks = _blocks(stable[top:, left:], turned, amplitude)
        known = None if pilot is None else _blocks(pilot[top:, left:], turned, amplitude).values
        sums, shares = collaborate.one_pass(blocks, known)
        for image, values in ((total, sums), (weight, np.broadcast_to(shares[..., None], sums.shape))):
            image[top:, left:] += _image(values, turned, image[top:, left:].shape)
    return np.where(weight > 0, total / np.maximum(weight, np.float32(1e-12)), stable)


def _blocks(stable: NDArray[np.float32], block: NDArray, amplitude: NDArray) -> SampleBlocks:
    places = np.argwhere(block >= 0)
    planes = split(np.ascontiguousarray(stable), block.shape)[block.ravel() >= 0]
    values = np.ascontiguousarray(planes.transpose(1, 2, 0))
    channel = block[block >= 0]
    return SampleBlocks(values, places.astype(np.float64), block.shape, channel, amplitude[channel])


def _image(values: NDArray[np.float32], block: NDArray, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Blocks with their border as an image; 0 where the tile has no value."""
    inner = values[1:-1, 1:-1]
    planes = np.zeros((*block.shape, *inner.shape[:2]), dtype=np.float32)
    planes[block >= 0] = inner.transpose(2, 0, 1)
    out = np.empty(shape, dtype=np.float32)
    join(planes, out)
    return out


def _long_waves(
    stable: NDArray[np.float32], fine: NDArray[np.float32], tile: NDArray, amplitude: NDArray
) -> NDArray[np.float32]:
    """Difference between the noise-reduced means of blocks and the block means of a result, as an image."""
    block = block_of(tile)
    channels = [np.flatnonzero(block.ravel() == c) for c in range(block.max() + 1)]
    roots = np.sqrt([len(own) for own in channels]).astype(np.float32)

    def means(image: NDArray[np.float32]) -> NDArray[np.float32]:
        planes = split(image, block.shape)[:, 1:-1, 1:-1]
        return np.stack([planes[own].mean(axis=0) for own in channels])

    # patches reach a few blocks, and leave noise of longer waves; the means of blocks show these.
    # A mean of k samples has the noise 1/√k: in units of that it is 1 again.
    clean = _reduced_means(means(stable) * roots[:, None, None], block.shape, amplitude * roots)
    clean /= roots[:, None, None]
    out = np.zeros_like(fine)
    spread = kriging.bilinear_stencil(block.shape, tuple((size - 1) / 2 for size in block.shape))
    for channel, rest in enumerate(clean - means(fine)):
        # only long waves are corrected: shorter ones are better in the result than in the means
        smooth = bordered(gaussian_filter(rest, _LONG_BLOCKS, mode="nearest")[None])
        planes = kriging.apply(smooth, spread, slice(0, rest.shape[0])).reshape(*block.shape, *rest.shape)
        planes *= (block == channel)[:, :, None, None]
        everywhere = np.empty_like(out)
        join(planes, everywhere)
        out += everywhere
    return out


def _reduced_means(means: NDArray[np.float32], pitch_px: tuple[int, ...], amplitude: NDArray) -> NDArray[np.float32]:
    """Means [channel, row, col] of blocks `pitch_px` apart, with their noise, of standard deviation 1, reduced."""
    square = np.zeros((2, 2), dtype=np.int64)
    places = np.argwhere(square >= 0)
    count = len(means)
    blocks = SampleBlocks(
        np.concatenate([split(mean, square.shape) for mean in means]).transpose(1, 2, 0).copy(),
        np.tile(places * np.array(pitch_px, dtype=np.float64), (count, 1)),
        (2 * pitch_px[0], 2 * pitch_px[1]),
        np.repeat(np.arange(count), len(places)),
        np.repeat(amplitude, len(places)),
    )
    known = None
    for _ in range(2):
        sums, shares = collaborate.one_pass(blocks, known)
        known = sums / shares[..., None]
    assert known is not None
    parts = np.split(known, count, axis=2)
    return np.stack([_image(part, square, means.shape[1:]) for part in parts])


def guided_filter(
    image: NDArray[np.float32], guide: NDArray[np.float32], radius_px: int, epsilon: float
) -> NDArray[np.float32]:
    """An image as a local linear function of a guide ([he2013], Eqs. 5-8), in boxes of 2·radius + 1.

    Parameters
    ----------
    image, guide : [row, col].
    radius_px : radius of the boxes, px.
    epsilon : variance of the guide below which it counts as flat.
    """
    from scipy.ndimage import uniform_filter

    def mean(values: NDArray) -> NDArray:
        return uniform_filter(values, 2 * radius_px + 1, mode="nearest")

    if radius_px < 1 or not epsilon > 0:
        raise RangeError("radius_px, epsilon", (radius_px, epsilon), "at least 1, more than 0")
    # subtract the mean first, so that float32 differences of squares keep their digits
    centre = np.float32(guide.mean())
    guide = guide - centre
    mean_guide, mean_image = mean(guide), mean(image)
    slope = (mean(guide * image) - mean_guide * mean_image) / (
        np.maximum(mean(guide * guide) - mean_guide * mean_guide, 0) + np.float32(epsilon)
    )
    return mean(slope) * guide + mean(mean_image - slope * mean_guide)


def reduce_noise(
    image: NDArray[np.float32], luma: float = 0.005, chroma: float = 0.02, radius_px: int = 3
) -> NDArray[np.float32]:
    """Balanced linear channels with less noise: brightness is smoothed little, colour differences more.

    The filter works on square roots. Brightness is filtered with itself as guide, differences to it with brightness.

    Parameters
    ----------
    image : [row, col, channel].
    luma, chroma : standard deviation that counts as noise, in square roots of white; 0 leaves the part unchanged.
    radius_px : radius of the filter, px.
    """
    if min(luma, chroma) < 0:
        raise RangeError("luma, chroma", (luma, chroma), "0 or more")
    root = to_root(image)
    brightness = root.mean(axis=-1)
    clean = guided_filter(brightness, brightness, radius_px, luma**2) if luma > 0 else brightness
    out = np.empty((image.shape[2], *image.shape[:2]), dtype=np.float32)
    for channel in range(image.shape[2]):
        difference = root[..., channel] - brightness
        if chroma > 0 and image.shape[2] > 1:
            difference = guided_filter(difference, clean, 2 * radius_px, chroma**2)
        out[channel] = from_root(clean + difference)
    return np.moveaxis(out, 0, -1)
