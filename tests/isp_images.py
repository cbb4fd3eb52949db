"""Five sRGB test pictures and an inverse pipeline, written without hesim_render.

The pictures are those of `make_isp_images.py`, an independent generator for ISP round trips (float in [0, 1],
512×768×3): hue against value, a grey ramp, crossed linear ramps, 24 flat patches with the ColorChecker's nominal
sRGB values, and 1/f^1.3 luminance with weaker independent chroma.
"""

import colorsys
import functools

import numpy as np

H, W = 512, 768
#: White balance of the H-ESIM paper, and the colour matrix of its released code (sRGB_to_RAW.py).
PAPER_BALANCE = (2.643, 1.0, 1.764)
PAPER_MATRIX = (
    (1.1484375, -0.048828125, -0.099609375),
    (-0.013671875, 1.315429688, -0.30078125),
    (0.037109375, -0.40234375, 1.364257813),
)
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
QUAD = ((0, 0, 1, 1), (0, 0, 1, 1), (1, 1, 2, 2), (1, 1, 2, 2))
BAYER = ((0, 1), (1, 2))
#: mipi-hybridevs: event pixels at (1, 1) and (3, 3).
MIPI = ((0, 0, 1, 1), (0, -1, 1, 1), (1, 1, 2, 2), (1, 1, 2, -1))


@functools.cache
def images():
    yy, xx = np.mgrid[0:H, 0:W] / np.array([H, W])[:, None, None]
    hue = np.array([[colorsys.hsv_to_rgb(c / W * 0.99, 1, r / H) for c in range(W)] for r in range(H)])
    grey = np.repeat(xx[..., None] * W / (W - 1), 3, 2).clip(0, 1)
    rgb = np.stack([0.1 + 0.7 * xx, 0.2 + 0.6 * yy, 0.8 - 0.6 * xx], -1)
    hexes = "735244c29682627a9d576c438580b167bdaad67e2c505ba6c15a635e3c6c9dbc40e0a32e"
    hexes += "383d9646943baf363ce7c71fbb56950885a1f3f3f2c8c8c8a0a0a07a7a79555555343434"
    checker = np.full((H, W, 3), 0.1)
    for k in range(24):
        h = hexes[6 * k : 6 * k + 6]
        r, c = divmod(k, 6)
        checker[r * 128 + 8 : r * 128 + 120, c * 128 + 8 : c * 128 + 120] = [
            int(h[i : i + 2], 16) / 255 for i in (0, 2, 4)
        ]
    rng = np.random.default_rng(5)
    f = np.fft.rfft2(rng.standard_normal((3, H, W)))
    radius = np.hypot(np.fft.fftfreq(H)[:, None], np.fft.rfftfreq(W)[None])
    n = np.fft.irfft2(f / np.maximum(radius, 1 / W) ** 1.3, (H, W))
    n /= n.std((1, 2), keepdims=True)
    luma = 0.45 + 0.18 * n[0]
    natural = np.stack([luma + 0.05 * n[1], luma, luma + 0.05 * n[2]], -1).clip(0.02, 0.98)
    return {"natural": natural, "checker": checker, "grey": grey, "rgb": rgb, "hue": hue}


def photographs():
    """Four photographs of scikit-image's package (public domain or CC0), cropped to whole 4×4 tiles; {} without it."""
    try:
        from skimage import data
    except ImportError:
        return {}
    found = {name: getattr(data, name)() for name in ("astronaut", "cat", "coffee", "rocket")}
    return {k: v[: v.shape[0] // 4 * 4, : v.shape[1] // 4 * 4] / 255 for k, v in found.items()}


def linear(picture):
    return np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)


def srgb(values):
    x = np.clip(values, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def captured(picture, matrix=IDENTITY, bits=8):
    """What a sensor with all three colours at every pixel would give, DN."""
    channels = linear(picture) @ np.linalg.inv(np.array(matrix)).T / PAPER_BALANCE
    return np.rint(np.clip(channels, 0, 1) * (2**bits - 1)).astype(np.uint16)


def mosaic_of(planes, tile):
    """One channel per pixel; 0 where the tile has none."""
    tile = np.array(tile)
    rows, cols = np.ogrid[: planes.shape[0], : planes.shape[1]]
    channel = tile[rows % tile.shape[0], cols % tile.shape[1]]
    one = np.take_along_axis(planes, np.maximum(channel, 0)[..., None], 2)[..., 0]
    return np.where(channel >= 0, one, 0)


def psnr(a, b):
    return float(-10 * np.log10(np.mean((np.asarray(a, dtype=np.float64) - b) ** 2)))


def ceiling(picture, matrix=IDENTITY, bits=8):
    """PSNR of the same quantisation without a mosaic."""
    channels = captured(picture, matrix, bits) / (2**bits - 1)
    return psnr(srgb((channels * PAPER_BALANCE) @ np.array(matrix).T), picture)
