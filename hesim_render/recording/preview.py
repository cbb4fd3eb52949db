"""Pictures of a recording for display: the RAW mosaic, events over a frame, and sheets of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from hesim_render.mosaic.description import Mosaic
from hesim_render.recording.colour_view import Picture
from hesim_render.spectral.colorimetry import encode_srgb

_BACKGROUND, _INK, _FAINT = (24, 24, 27), (235, 235, 235), (150, 150, 155)
_PANEL_PX, _WIDEST_PX = 640, 832  # magnify small frames to about the first; none is wider than the second
#: Linear tint of each DNG colour code, red to white.
_TINT = np.array(
    [[1, 0.08, 0.06], [0.1, 0.9, 0.12], [0.1, 0.2, 1], [0.1, 0.9, 1], [1, 0.2, 1], [1, 0.9, 0.1], [0.9, 0.9, 0.9]],
    dtype=np.float32,
)


def mosaic_picture(raw: NDArray[np.uint16], mosaic: Mosaic, scale: int = 1) -> Picture:
    """The RAW mosaic, each pixel in the tint of its filter, magnified `scale` times.

    Pixels that give only events are dark; from scale 6 on they have a dot in the tint of their filter.
    """
    span = float(mosaic.white_level_dn - mosaic.black_level_dn)
    signal = np.clip(raw.astype(np.float32) - np.float32(mosaic.black_level_dn), 0, span)
    valid = mosaic.tiled(mosaic.tile_channel >= 0, raw.shape)
    white = max(float(np.percentile(signal[valid], 99.5)), 0.02 * span) if valid.any() else span
    tint = _TINT[mosaic.tiled(mosaic.tile_code, raw.shape)]
    if mosaic.is_mono:
        tint = np.ones_like(tint)
    picture = encode_srgb(tint * np.where(valid, signal / white, 0.012)[..., None])
    picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)
    if scale >= 6:
        dot = np.zeros((scale, scale), dtype=bool)
        dot[scale // 3 : -(scale // 3), scale // 3 : -(scale // 3)] = True
        where = ~valid.repeat(scale, axis=0).repeat(scale, axis=1) & np.tile(dot, raw.shape)
        picture[where] = encode_srgb(0.35 * tint).repeat(scale, axis=0).repeat(scale, axis=1)[where]
    return picture


@dataclass(frozen=True)
class Panel:
    """One picture of a sheet and its caption."""

    picture: Picture
    caption: str


def panel_width(cols: int, tile_cols: int) -> tuple[int, int]:
    """Width of the panels of a sheet for frames of `cols` columns, and the share of tiles shown (1 in n²)."""
    step = -(-cols // _WIDEST_PX)
    if step > 1:
        return cols // (tile_cols * step) * tile_cols, step
    return cols * max(1, round(_PANEL_PX / cols)), 1


def every_tile(raw: NDArray[np.uint16], mosaic: Mosaic, step: int) -> NDArray[np.uint16]:
    """One tile of each `step` × `step`, so that a large mosaic still looks like one."""
    kept = [
        (np.arange(size // (period * step))[:, None] * period * step + np.arange(period)).ravel()
        for size, period in zip(raw.shape, mosaic.tile_shape, strict=True)
    ]
    return raw[np.ix_(*kept)]


def fitted(picture: Picture, width_px: int) -> Picture:
    """A picture at `width_px`: magnified by a whole number if that fits, otherwise an area average."""
    rows, cols = picture.shape[:2]
    if width_px % cols == 0:
        scale = width_px // cols
        return picture.repeat(scale, axis=0).repeat(scale, axis=1)
    size = (width_px, max(1, round(rows * width_px / cols)))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def magnified(picture: Picture) -> Picture:
    """A small picture at about the width of a panel, by a whole number; a larger one as it is."""
    scale = _magnification(picture.shape[1])
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)


def _magnification(cols: int) -> int:
    return max(1, round(_PANEL_PX / cols))


def busiest_window(picture: Picture, fraction: float) -> tuple[float, float]:
    """Relative (row, col) of the top left corner of the window with the most contrast; `fraction` is its relative
    size.
    """
    grey = picture.astype(np.float32).mean(axis=2)
    steps = np.linspace(0.0, 1.0 - fraction, 9)
    height, width = max(2, int(grey.shape[0] * fraction)), max(2, int(grey.shape[1] * fraction))
    corners = [(row, col) for row in steps for col in steps]
    spread = [
        grey[int(r * grey.shape[0]) :, int(c * grey.shape[1]) :][:height, :width].std() - 4 * abs(r + c - 1 + fraction)
        for r, c in corners
    ]
    return corners[int(np.argmax(spread))]


def panel_sheet(panels: Sequence[Panel], title: str, width_px: int) -> Image.Image:
    """Panels of one width side by side with captions, under a title."""
    gap, line = 14, 24
    pictures = [fitted(panel.picture, width_px) for panel in panels]
    columns = min(2, len(pictures))
    rows = [list(range(k, min(k + columns, len(pictures)))) for k in range(0, len(pictures), columns)]
    heights = [max(pictures[k].shape[0] for k in row) + line for row in rows]
    size = (gap + columns * (width_px + gap), 2 * gap + line + sum(heights) + gap * (len(rows) - 1))
    sheet = Image.new("RGB", size, _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((gap, gap - 2), title, fill=_INK, font=ImageFont.load_default(size=16))
    top = gap + line
    for row, height in zip(rows, heights, strict=True):
        for place, k in enumerate(row):
            left = gap + place * (width_px + gap)
            sheet.paste(Image.fromarray(pictures[k]), (left, top))
            below = top + pictures[k].shape[0] + 4
            draw.text((left, below), panels[k].caption, fill=_FAINT, font=ImageFont.load_default(size=13))
        top += height + gap
    return sheet


def save_animation(path: str, pictures: Sequence[Picture]) -> None:
    """An endless animated GIF of pictures, each `magnified`: after its colours are chosen, which then takes a twentieth
    of the time.
    """
    images = [Image.fromarray(picture).quantize(96) for picture in pictures]
    images = [ImageOps.scale(image, _magnification(image.width), Image.Resampling.NEAREST) for image in images]
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=80, loop=0, optimize=False)
