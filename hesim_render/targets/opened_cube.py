"""An open hyperspectral cube, read by bands of rows."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory

Rows = Callable[[int, int], NDArray[np.float32]]


#: Wavelengths of sets whose files do not have them: names of the variable, number of bands, first and step in nm.
_KNOWN_BANDS = {
    ("ref", 31): (420.0, 10.0), ("reflectances", 33): (400.0, 10.0), ("reflectances", 32): (410.0, 10.0),
    ("reflectances", 31): (410.0, 10.0), ("cube", 31): (400.0, 10.0), ("rad", 31): (400.0, 10.0),
    ("CAVE", 31): (400.0, 10.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CubeFile:
    """An open cube.

    Parameters
    ----------
    file : the file.
    shape : rows, columns, bands.
    wavelength_nm : [band], increasing; None where the file does not say.
    read : float32 [row, col, band] of the rows from the first number up to the second.
    layout : what was recognised.
    illuminant : [band], light on the scene in the unit of the cube, where the file has it.
    is_absolute : True if the file says that its values are radiance in W m⁻² sr⁻¹ nm⁻¹.
    """

    file: Path
    shape: tuple[int, int, int]
    wavelength_nm: NDArray[np.float64] | None
    read: Rows
    layout: str
    illuminant: NDArray[np.float64] | None = None
    is_absolute: bool = False

    def require_reflectance(self) -> None:
        """Refuse a file that says that it holds radiance.

        Raises
        ------
        SpecError
            If it does.
        """
        if self.is_absolute:
            raise SpecError("holds radiance, as it says, and no reflectance (quantity: radiance)", file=self.file)

    def whole(self) -> NDArray[np.float32]:
        """All rows; refused if they do not fit into memory."""
        rows, cols, bands = self.shape
        require_memory(4 * rows * cols * bands, "the cube", self.file)
        return self.rows(0, rows)

    def rows(self, first: int, end: int) -> NDArray[np.float32]:
        """Some rows, float32 [row, col, band].

        Raises
        ------
        SpecError
            If they cannot be read, or hold values that are not finite.
        """
        with reading(self.file, "as a cube"):
            values = np.ascontiguousarray(self.read(first, end), dtype=np.float32)
        if not np.isfinite(values).all():
            raise SpecError("holds values that are not finite", file=self.file)
        return values


def known_bands(name: str, count: int) -> NDArray[np.float64] | None:
    """Wavelengths of a published set whose files do not have them, nm."""
    known = _KNOWN_BANDS.get((name, count))
    return None if known is None else known[0] + known[1] * np.arange(count, dtype=np.float64)
