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
#: eiger: four event pixels, one in each cell of a colour.
EIGER = ((0, 0, 1, 1), (0, -1, 1, -1), (1, 1, 2, 2), (1, -1, 2, -1))
#: gen2: one event pixel in place of a green.
GEN2 = ((0, 0, 1, 1), (0, 0, -1, 1), (1, 1, 2, 2), (1, 1, 2, 2))


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


@functools.cache
def patterns():
    """What is hard for a mosaic: grey detail up to half the Nyquist frequency, saturated diagonals, text, edges."""
    plate = zone_plate()
    found = {
        "zone plate": plate,
        "diagonals": diagonals(),
        "text": text(),
        "colour text": text((40, 50, 150), (240, 230, 160)),
    }
    return found | {f"edge {angle} deg": slanted_edge(angle) for angle in (5, 20)}


def zone_plate(size=512, highest=0.25):
    """cos² rings whose frequency reaches `highest` cycles/px at the rim of the inscribed circle; grey outside."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    squared = x * x + y * y
    rings = 0.5 + 0.5 * np.cos(2 * np.pi * highest / size * squared)
    return np.repeat(np.where(squared <= size * size / 4, rings, 0.5)[..., None], 3, 2)


def _sampled(function, size, fine):
    """Mean linear light of function(y, x) [row, col, 3] over each pixel, as sRGB."""
    y, x = (np.mgrid[: size * fine, : size * fine] + 0.5) / fine
    return srgb(function(y, x).reshape(size, fine, size, fine, 3).mean((1, 3)))


def diagonals(size=256, period=24, colour=(0.8, 0.0, 0.0)):
    """Stripes of a colour on black at 45 degrees; `period` along a row, px."""
    return _sampled(lambda y, x: ((x + y) % period < period / 2)[..., None] * np.array(colour), size, 4)


def slanted_edge(angle_deg, size=256, dark=0.2, light=0.8):
    """A grey edge, `angle_deg` off the vertical; linear levels."""
    turn = np.deg2rad(angle_deg)

    def edge(y, x):
        side = (x - size / 2) * np.cos(turn) + (y - size / 2) * np.sin(turn) > 0
        return np.repeat(np.where(side, light, dark)[..., None], 3, 2)

    return _sampled(edge, size, 8)


def text(ink=(0, 0, 0), paper=(255, 255, 255), size=320):
    """Lines of text from 9 to 40 px, drawn four times as large and averaged."""
    from PIL import Image, ImageDraw, ImageFont

    page = Image.new("RGB", (4 * size, 4 * size), paper)
    pen, y = ImageDraw.Draw(page), 20
    for k, height in enumerate((9, 10, 11, 12, 14, 16, 18, 22, 26, 32, 40)):
        words = "The quick brown fox jumps over the lazy dog 0123456789 "[k:] * 3
        pen.text((20, y), words, font=ImageFont.load_default(size=4 * height), fill=ink)
        y += int(5.2 * height)
    return srgb(linear(np.asarray(page) / 255).reshape(size, 4, size, 4, 3).mean((1, 3)))


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


def inner_psnr(a, b, border=8):
    return psnr(a[border:-border, border:-border], b[border:-border, border:-border])


def lmmse_oracle(picture, tile, reach=5, bits=10):
    """PSNR of the best linear demosaic of this very picture: least squares of every channel at every position of the
    tile over all samples within `reach` px, fitted to the picture itself. No linear demosaic does better on it.

    On square roots, near which sRGB is; identity matrix; what lies 8 px inside counts.
    """
    tile = np.array(tile)
    channels = captured(picture, IDENTITY, bits) / (2**bits - 1) * PAPER_BALANCE
    roots = np.sqrt(channels + 0.01)
    mosaic = np.sqrt(mosaic_of(channels, tile) + 0.01)
    found = roots.copy()
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    for row, col in np.ndindex(*tile.shape):
        seen = tile[(row + dy) % tile.shape[0], (col + dx) % tile.shape[1]] >= 0
        rows, cols = (
            np.array([k for k in range(start, size, period) if reach <= k < size - reach])
            for start, size, period in zip((row, col), mosaic.shape, tile.shape, strict=True)
        )
        inputs = np.stack([mosaic[np.ix_(rows + a, cols + b)].ravel() for a, b in zip(dy[seen], dx[seen], strict=True)])
        inputs = np.concatenate([inputs, np.ones((1, inputs.shape[1]))])
        wanted = roots[np.ix_(rows, cols)].reshape(-1, 3)
        normal = inputs @ inputs.T
        normal[np.diag_indices_from(normal)] += 1e-8 * inputs.shape[1]
        estimate = (np.linalg.solve(normal, inputs @ wanted).T @ inputs).T.reshape(rows.size, cols.size, 3)
        if tile[row, col] >= 0:
            estimate[..., tile[row, col]] = roots[np.ix_(rows, cols)][..., tile[row, col]]
        found[np.ix_(rows, cols)] = estimate
    return inner_psnr(srgb(found**2 - 0.01), picture)


def ceiling(picture, matrix=IDENTITY, bits=8):
    """PSNR of the same quantisation without a mosaic."""
    channels = captured(picture, matrix, bits) / (2**bits - 1)
    return psnr(srgb((channels * PAPER_BALANCE) @ np.array(matrix).T), picture)
