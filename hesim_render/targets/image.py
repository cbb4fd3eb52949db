"""Pictures from files, as targets and on surfaces."""

from __future__ import annotations

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.specs.charts import ImageTarget
from hesim_render.specs.reflectance import PictureFile
from hesim_render.targets.cube import read_cube
from hesim_render.targets.piece import Picture, TargetPiece, picture_piece

#: Wavelengths up to which the first and the last plane of a cube are held, nm; all responses lie between them.
_HELD_NM = (300.0, 1100.0)
#: Values above 1 by rounding.
_ROUNDING = 1e-6


def image(target: ImageTarget) -> list[TargetPiece]:
    """A rectangle with the picture of a file, from edge to edge.

    Raises
    ------
    SpecError
        If the file cannot be read, or a reflectance lies outside 0 to 1.
    """
    return [picture_piece("picture", read_picture(target, "target"), target.width_m, target.height_m)]


def read_picture(source: PictureFile, key: str) -> Picture:
    """Read a picture of reflectances.

    Parameters
    ----------
    source : names the file.
    key : place of `source` in the scene file, for errors.

    Raises
    ------
    SpecError
        If the file cannot be read, or a reflectance lies outside 0 to 1.
    """
    file = source.folder / source.file
    cube = read_cube(file, source.wavelength_nm)
    values = cube.values
    if source.scale != 1:
        if file.suffix.lower() not in (".exr", ".npy"):
            raise SpecError("scale is for cubes and EXR pictures; sRGB codes are reflectances", key=f"{key}.scale")
        values = values * np.float32(source.scale)
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 1 + _ROUNDING:
        raise SpecError(
            f"reflectances must lie in [0, 1]; these run from {low:g} to {high:g} (see scale)",
            file=file,
            key=f"{key}.file",
        )
    values, wavelength = np.minimum(values, 1), cube.wavelength_nm
    if wavelength is None:
        return Picture(values, "srgb", interpolation=source.interpolation)
    if source.beyond == "hold":
        first, last = min(_HELD_NM[0], wavelength[0] - 1), max(_HELD_NM[1], wavelength[-1] + 1)
        values = np.concatenate([values[..., :1], values, values[..., -1:]], axis=2)
        wavelength = np.concatenate([[first], wavelength, [last]])
    return Picture(values, "spectral", wavelength, source.interpolation)
