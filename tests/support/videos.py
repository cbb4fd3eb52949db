"""Small videos for tests, encoded by PyAV, and pictures made from formulas."""

import av
import numpy as np

#: Codes of ITU-T H.273: sRGB transfer, BT.709 primaries and matrix, limited range.
TAGS = {"transfer": 13, "primaries": 1, "matrix": 1, "range": 1}


def yuv_planes(rgb, bits=8, full=False, weights=(0.2126, 0.0722)):
    """4:4:4 codes of R'G'B' in [0, 1], H.273 equations 20 to 43 written out: float [3, row, col]."""
    kr, kb = weights
    y = kr * rgb[..., 0] + (1 - kr - kb) * rgb[..., 1] + kb * rgb[..., 2]
    cb, cr = (rgb[..., 2] - y) / (2 * (1 - kb)), (rgb[..., 0] - y) / (2 * (1 - kr))
    if full:
        top = 2**bits - 1
        return np.stack([top * y, top * cb + 2 ** (bits - 1), top * cr + 2 ** (bits - 1)])
    unit = 2 ** (bits - 8)
    return np.stack([(219 * y + 16) * unit, (224 * cb + 128) * unit, (224 * cr + 128) * unit])


def yuv_frame(planes, name):
    """A PyAV frame with exactly these planes."""
    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, name)
    for plane, values in zip(frame.planes, planes, strict=True):
        wide = np.zeros((plane.height, plane.line_size // values.itemsize), values.dtype)
        wide[:, : plane.width] = values
        plane.update(wide)
    return frame


def tag(target, tags):
    target.color_trc, target.color_primaries = tags["transfer"], tags["primaries"]
    target.colorspace, target.color_range = tags["matrix"], tags["range"]


def encode(
    path, frames, codec="ffv1", fps=100, tags=TAGS, pts=None, time_base=None, options=None, container_options=None
):
    """Write PyAV frames as a video; `pts` in units of `time_base` make its time stamps."""
    from fractions import Fraction

    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=fps, options=options or {})
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, frames[0].format.name
        if time_base is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(time_base)
        if tags:
            tag(stream.codec_context, tags)
        for k, frame in enumerate(frames):
            if tags:
                tag(frame, tags)
            if pts is not None:
                frame.pts, frame.time_base = pts[k], Fraction(time_base)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def moving_bar(count=12, height=48, width=64, low=0.2, high=0.8):
    """R'G'B' pictures [time, row, col, 3] of a bright bar that moves two columns a picture."""
    cols = np.arange(width)
    level = [np.where((cols - 2 * k) % width < width // 4, high, low) for k in range(count)]
    tint = np.array([1.0, 0.9, 0.8])
    return np.stack([np.broadcast_to(row[None, :, None] * tint, (height, width, 3)) for row in level])


def grey_frames(levels, height=48, width=64):
    """8-bit limited-range 4:2:0 frames, each of one grey given as its luma code."""
    half = np.full((height // 2, width // 2), 128, np.uint8)
    return [yuv_frame([np.full((height, width), level, np.uint8), half, half], "yuv420p") for level in levels]


def rgb_frames(pictures, name="yuv420p"):
    """Frames of R'G'B' pictures in [0, 1] through swscale, for tests in which exact codes do not matter."""
    frames = []
    for picture in pictures:
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.rint(255 * picture).astype(np.uint8)), "rgb24")
        frames.append(frame.reformat(format=name, dst_colorspace="ITU709", dst_color_range="MPEG"))
    return frames


def srgb_to_linear(value):
    """IEC 61966-2-1 written out."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
