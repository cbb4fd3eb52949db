"""A picture from a file as a target."""

from __future__ import annotations

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.specs.charts import ImageTarget
from hesim_render.targets.cube import Cube, read_cube
from hesim_render.targets.piece import Picture, Piece, picture_piece

#: Wavelengths up to which the first and the last plane of a cube are held, nm; all responses lie between them.
_HELD_NM = (300.0, 1100.0)
#: Values above 1 by rounding.
_ROUNDING = 1e-6


def image(target: ImageTarget) -> list[Piece]:
    """A rectangle with the picture of a file, from edge to edge.

    Raises
    ------
    SpecError
        If the file cannot be read, or a reflectance lies outside 0 to 1.
    """
    file = target.folder / target.file
    cube = read_cube(file, target.wavelength_nm)
    values = cube.values
    if target.scale != 1:
        if file.suffix.lower() not in (".exr", ".npy"):
            raise SpecError("scale is for cubes and EXR pictures; sRGB codes are reflectances", key="target.scale")
        values = values * np.float32(target.scale)
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 1 + _ROUNDING:
        raise SpecError(
            f"reflectances must lie in [0, 1]; these run from {low:g} to {high:g} (see scale)",
            file=file,
            key="target.file",
        )
    picture = _picture(Cube(np.minimum(values, 1), cube.wavelength_nm), target)
    return [picture_piece("picture", picture, target.width_m, target.height_m)]


def _picture(cube: Cube, target: ImageTarget) -> Picture:
    if cube.wavelength_nm is None:
        return Picture(cube.values, "srgb", interpolation=target.interpolation)
    values, wavelength = cube.values, cube.wavelength_nm
    if target.beyond == "hold":
        first, last = min(_HELD_NM[0], wavelength[0] - 1), max(_HELD_NM[1], wavelength[-1] + 1)
        values = np.concatenate([values[..., :1], values, values[..., -1:]], axis=2)
        wavelength = np.concatenate([[first], wavelength, [last]])
    return Picture(values, "spectral", wavelength, target.interpolation)
