"""Surfaces of a study: sets of reflectances and hyperspectral cubes."""

from __future__ import annotations

from pathlib import Path

from hesim_render.core.errors import SpecError
from hesim_render.specs.study import SurfacesSpec
from hesim_render.spectral.patches import read_patches
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies.colour_samples import REFLECTANCE_SETS, held, reflectance_set


def reflectances_of(item: SurfacesSpec) -> dict[str, Spectrum]:
    """Reflectances by name, of a shipped set or of a CSV file of patches.

    Raises
    ------
    SpecError
        If there is no such set or file, or the file is not valid.
    """
    assert item.reflectances is not None
    if item.reflectances in REFLECTANCE_SETS:
        return reflectance_set(item.reflectances)
    if Path(item.reflectances).suffix == "":
        return reflectance_set(item.reflectances)  # raises, with what there is
    file = Path(item.beside(item.reflectances))
    if not file.is_file():
        raise SpecError("no such file", file=file)
    patches = read_patches(file)
    if not patches:
        raise SpecError("has no patches", file=file)
    return {name: held(each) for name, each in patches.items()}
