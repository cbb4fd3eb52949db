"""EXR files of others: their size is looked at before they are read."""

from pathlib import Path
from typing import Any

from hesim_render.core.guard import reading, require_picture

#: Memory of a value while it is read and stacked with others: float32, twice.
_VALUE_BYTES = 8


def exr_header(file: Path) -> tuple[tuple[int, int], dict[str, Any]]:
    """Width and height of an EXR file, and its header.

    Raises
    ------
    SpecError
        If it cannot be read.
    """
    import OpenEXR

    with (
        reading(file, "as an EXR file"),
        OpenEXR.File(str(file), separate_channels=True, header_only=True) as opened,
    ):
        header = dict(opened.header())
        low, high = header["dataWindow"]
        return (int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1), header


def require_exr_fits(file: Path) -> None:
    """Refuse an EXR file that would not fit into memory, with all its channels.

    Raises
    ------
    SpecError
        If it would not, or cannot be read.
    """
    (width, height), header = exr_header(file)
    require_picture(width, height, _VALUE_BYTES * len(header["channels"]), file)
