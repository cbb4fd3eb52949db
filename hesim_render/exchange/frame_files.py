"""RAW frames as files of other programs: 16-bit TIFF and PNG, NPY, and the ``.bin`` of the MIPI challenge.

All hold the exact DN. The challenge's files are uint16, little endian: width, height, then the pixels row by row.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError


def write_tiff(path: Path, raw: NDArray[np.uint16]) -> None:
    """Write a frame [row, col] as an uncompressed grey TIFF file of one strip."""
    import tifffile

    tifffile.imwrite(path, raw, photometric="minisblack", rowsperstrip=raw.shape[0], metadata=None, software=False)


def write_png(path: Path, raw: NDArray[np.uint16]) -> None:
    """Write a frame [row, col] as a grey 16-bit PNG file."""
    from PIL import Image

    Image.fromarray(raw).save(path, format="PNG", compress_level=1)


def write_npy(path: Path, raw: NDArray[np.uint16]) -> None:
    """Write a frame [row, col] as a NumPy file."""
    np.save(path, raw)


def write_mipi(path: Path, raw: NDArray[np.uint16]) -> None:
    """Write a frame [row, col] as a file of the MIPI challenge.

    Raises
    ------
    SpecError
        If the frame has more than 65535 rows or columns.
    """
    rows, cols = raw.shape
    if max(rows, cols) >= 1 << 16:
        raise SpecError(f"the format holds at most 65535 rows and columns, not {cols}x{rows} px", file=path)
    path.write_bytes(np.array([cols, rows], dtype="<u2").tobytes() + raw.astype("<u2").tobytes())
