"""Pictures and streams through PyAV: their own planes, unchanged, in the few layouts that have formulas here."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, reason, require_picture
from hesim_render.sources.video.arrays import without_alpha
from hesim_render.sources.video.colours import ColourTags
from hesim_render.sources.video.picture_layout import PictureFormat, Planes

#: Formats that differ from a supported one only in the order of numbers: swscale only moves these.
_REORDERED = {
    "rgb24": "gbrp", "bgr24": "gbrp", "rgba": "gbrap", "bgra": "gbrap", "argb": "gbrap", "abgr": "gbrap",
    "rgb0": "gbrp", "bgr0": "gbrp", "0rgb": "gbrp", "0bgr": "gbrp", "pal8": "gbrap",
    "rgb48le": "gbrp16le", "rgb48be": "gbrp16le", "bgr48le": "gbrp16le", "bgr48be": "gbrp16le",
    "rgba64le": "gbrap16le", "rgba64be": "gbrap16le", "bgra64le": "gbrap16le", "bgra64be": "gbrap16le",
    "nv12": "yuv420p", "nv21": "yuv420p", "nv16": "yuv422p", "nv24": "yuv444p", "monow": "gray", "monob": "gray",
    "p010le": "yuv420p10le", "p012le": "yuv420p12le", "p016le": "yuv420p16le", "p210le": "yuv422p10le",
    "ya8": "gbrap", "ya16le": "gbrap16le", "ya16be": "gbrap16le", "yuyv422": "yuv422p", "uyvy422": "yuv422p",
}  # fmt: skip
#: Codecs whose chroma sits between two luma samples.
_CENTRED = {"mjpeg", "mjpegb", "mpeg1video", "webp", "vp8"}

#: Memory of a pixel while it is decoded: three values of 16 bits, in some pictures at once.
_PIXEL_BYTES = 24


def frame_format(frame: Any, codec: str, where: str) -> tuple[PictureFormat, str]:
    """Layout of decoded frames, and the PyAV format they are converted to first (often their own).

    Raises
    ------
    SpecError
        For formats without a formula here, and for interlaced and rotated frames.
    """
    if frame.interlaced_frame:
        raise SpecError("is interlaced: de-interlace it first (ffmpeg -vf bwdif)", file=where)
    if frame.rotation:
        raise SpecError(
            f"is to be shown rotated by {frame.rotation}°: rotate its pixels first (ffmpeg does)", file=where
        )
    own = frame.format.name
    target = _REORDERED.get(own, own[:-2] + "le" if own.endswith("be") else own)
    if target != own:
        import av

        shape = av.VideoFormat(target, frame.width, frame.height)
    else:
        shape = frame.format
    parts = shape.components
    planar = len({part.plane for part in parts}) == len(parts)
    bits = {part.bits for part in parts}
    is_float = target.endswith(("f32le", "f16le"))
    if not planar or len(bits) > 1 or (is_float and not target.startswith(("gbr", "gray"))) or target.startswith("xyz"):
        raise SpecError(
            f"pixel format {own} is not supported: convert it (such as ffmpeg -pix_fmt yuv444p16le)", file=where
        )
    depth = 0 if is_float else bits.pop()
    if target.startswith("gray") or len(parts) == 1:
        return PictureFormat("grey", frame.width, frame.height, depth), target
    if shape.is_rgb:
        return PictureFormat("planar", frame.width, frame.height, depth), target
    chroma = parts[1]
    shift = (round(np.log2(frame.width / chroma.width)), round(np.log2(frame.height / chroma.height)))
    return PictureFormat("yuv", frame.width, frame.height, depth, shift, codec not in _CENTRED), target


def planes_of(frame: Any, shape: PictureFormat, target: str, where: str) -> Planes:
    """The planes of a decoded frame, R before G before B; an alpha plane must be opaque."""
    if frame.format.name != target:
        frame = frame.reformat(format=target)
    result = [_plane(plane, shape.bits) for plane in frame.planes]
    colours = {"grey": 1, "planar": 3, "yuv": 3}[shape.layout]
    if len(result) > colours:
        without_alpha(np.dstack([result[0], result[-1]]), shape.bits, where)
    if shape.layout == "planar":
        return result[2], result[0], result[1]  # PyAV has G, B, R
    return tuple(result[:colours])


def _plane(plane: Any, bits: int) -> NDArray:
    dtype = np.dtype("<f4") if bits == 0 else np.dtype("u1") if bits <= 8 else np.dtype("<u2")
    lines = np.frombuffer(plane, dtype).reshape(plane.height, plane.line_size // dtype.itemsize)
    return np.ascontiguousarray(lines[:, : plane.width])


def tags_of(frame: Any, shape: PictureFormat, where: str) -> ColourTags:
    """Colour tags of a decoded frame; RGB needs no matrix, and has full range unless tagged otherwise."""
    tags = ColourTags.of_codes(
        int(frame.color_trc), int(frame.color_primaries), int(frame.colorspace), int(frame.color_range), where
    )
    if shape.layout == "planar":
        return tags.with_given(matrix="rgb", range=tags.range or "full")
    if shape.layout == "grey":
        return tags.with_given(matrix="rgb")
    if frame.format.name.startswith("yuvj"):
        return tags.with_given(range="full")
    return tags


def decode_picture(path: Path) -> tuple[PictureFormat, ColourTags, Planes]:
    """Decode a picture file. Its tags hold what the file states; the default primaries of pictures are BT.709."""
    import av

    WholeFile(path).checked()
    try:
        with av.open(str(path)) as container:
            require_decodable(container.streams.video[0], path)
            frame = next(container.decode(video=0))
            codec = container.streams.video[0].codec_context.name
    except (av.error.FFmpegError, StopIteration, IndexError, OSError) as error:
        raise SpecError(f"cannot be read as a picture ({reason(error)})", file=path) from None
    if frame.is_corrupt:
        raise SpecError("is damaged", file=path)
    shape, target = frame_format(frame, codec, str(path))
    tags = tags_of(frame, shape, str(path))
    if shape.layout in ("planar", "grey"):
        tags = tags.with_given(range=tags.range or "full")
    return shape, tags.with_given(primaries=tags.primaries or "bt709"), planes_of(frame, shape, target, str(path))


def require_decodable(stream: Any, file: Path) -> None:
    """Refuse a video by the size that its header states; its decoder takes memory for whole pictures.

    Raises
    ------
    SpecError
        If a picture is too large.
    """
    context = stream.codec_context
    require_picture(context.width, context.height, _PIXEL_BYTES, file)
