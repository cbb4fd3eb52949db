"""Surfaces under a light as a camera and as the CIE observer see them.

Surfaces of a study: sets of reflectances and hyperspectral cubes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.specs.study import SurfacesSpec
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.colorimetry import responses_to, tristimulus
from hesim_render.spectral.patches import read_patches
from hesim_render.spectral.spectrum import REQUIRED_COVERAGE, Spectrum, constant, coverage


@dataclass(frozen=True, eq=False)
class ColourSamples:
    """Surfaces under one light, in the channels of a camera and in CIE XYZ.

    Parameters
    ----------
    camera : [surface, channel], response over that to a perfect white under the same light, so that white is 1.
    xyz : [surface, 3], CIE 1931 XYZ over the Y of white.
    white_xyz : [3], XYZ of white with Y = 1.
    """

    camera: NDArray[np.float64]
    xyz: NDArray[np.float64]
    white_xyz: NDArray[np.float64]


def colour_samples(
    responses: Sequence[Spectrum], light: Spectrum, reflectances: Sequence[Spectrum], light_name: str = "the light"
) -> ColourSamples:
    """What a camera and the CIE 1931 observer see of surfaces under a light, by sums at 1 nm over 360-830 nm.

    Parameters
    ----------
    responses : response of each channel per watt (of any scale), such as `Sensor.responses`.
    light : relative spectral power.
    reflectances : of the surfaces.
    light_name : for errors.

    Returns
    -------
    Channels and XYZ of every surface, and XYZ of white.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.spectral import spectrum as spectra
    >>> from hesim_render.studies import colour_samples
    >>> responses = list(hr.load_sensor("reference-bayer").responses.values())
    >>> surfaces = list(spectra.colorchecker_reflectances().values())
    >>> samples = colour_samples(responses, spectra.illuminant("D65"), surfaces)
    >>> samples.camera.shape, samples.xyz.shape, samples.white_xyz.round(3).tolist()
    ((24, 3), (24, 3), [0.95, 1.0, 1.089])

    Raises
    ------
    SpecError
        If the light covers less than 99.9 % of a response or of luminous efficiency, a reflectance less than 99.9 % of
        what the light makes of it, or a channel sees nothing of the light.
    """
    for response in [*responses, spectra.photopic()]:
        if coverage(light, response) < REQUIRED_COVERAGE:
            raise SpecError(
                f"{light_name} covers {light.support_nm[0]:g}-{light.support_nm[1]:g} nm, less than "
                f"{REQUIRED_COVERAGE:.1%} of a response ({response.support_nm[0]:g}-{response.support_nm[1]:g} nm)"
            )
    flat = [constant(1.0)]
    white = responses_to(light, flat, responses)[0]
    if white.min() <= 0:
        raise SpecError(f"{light_name} gives no signal in channel {int(np.argmin(white))}")
    limited = constant(1.0, *_common_support(reflectances))
    missing = float(np.max(1 - responses_to(light, [limited], responses)[0] / white))
    if missing > 1 - REQUIRED_COVERAGE:
        low, high = limited.support_nm
        raise SpecError(
            f"the reflectances cover {low:g}-{high:g} nm; {missing:.2%} of the signal under {light_name} lies outside"
        )
    white_xyz = tristimulus(light, flat)[0]
    return ColourSamples(
        responses_to(light, reflectances, responses) / white,
        tristimulus(light, reflectances) / white_xyz[1],
        white_xyz / white_xyz[1],
    )


def _common_support(reflectances: Sequence[Spectrum]) -> tuple[float, float]:
    if not reflectances:
        raise SpecError("a set of reflectances is empty")
    low, high = np.array([each.support_nm for each in reflectances]).T
    return float(low.max()), float(high.min())


#: Sets of reflectances by name: what they are.
REFLECTANCE_SETS: Mapping[str, str] = {
    "colorchecker": "24 patches of the ColorChecker, as ISO 17321-1 has them",
    "colorchecker-chromatic": "its first 18 patches, without the greys",
    "rawtoaces": "190 training reflectances of rawtoaces (A.M.P.A.S.)",
    "rawtoaces-even": "every second one of these, from the first on",
    "rawtoaces-odd": "the others",
    "cie-tcs": "test colour samples 1 to 14 of CIE 13.3",
}


def reflectance_set(name: str) -> dict[str, Spectrum]:
    """Measured reflectances by the name of their set, from colour-science.

    Parameters
    ----------
    name : one of `REFLECTANCE_SETS`.

    Examples
    --------
    >>> from hesim_render.studies import reflectance_set
    >>> len(reflectance_set("rawtoaces")), len(reflectance_set("cie-tcs"))
    (190, 14)

    Returns
    -------
    Reflectances by name. Where a table ends between 700 and 780 nm its last value is held up to 830 nm, and the first
    down to 360 nm: the light there is a few tenths of a per cent of a visible response.

    Raises
    ------
    SpecError
        If there is no such set.
    """
    if name.startswith("colorchecker"):
        chart = spectra.colorchecker_reflectances()
        if name == "colorchecker":
            return {key: held(each) for key, each in chart.items()}
        if name == "colorchecker-chromatic":
            return {key: held(each) for key, each in list(chart.items())[:18]}
    colour = spectra.colour_science()
    if name in ("rawtoaces", "rawtoaces-even", "rawtoaces-odd"):
        table = colour.characterisation.read_training_data_rawtoaces_v1()
        grid, values = np.asarray(table.wavelengths), np.asarray(table.values)
        result = {
            str(label): held(Spectrum(grid, np.maximum(column, 0.0)))
            for label, column in zip(table.labels, values.T, strict=True)
        }
        first, step = {"rawtoaces": (0, 1), "rawtoaces-even": (0, 2), "rawtoaces-odd": (1, 2)}[name]
        return dict(list(result.items())[first::step])
    if name == "cie-tcs":
        samples = colour.quality.datasets.SDS_TCS["CIE 1995"]
        return {
            str(key): held(Spectrum(np.asarray(sd.wavelengths), np.asarray(sd.values))) for key, sd in samples.items()
        }
    raise SpecError(
        f"no set of reflectances named {name!r}; known are {', '.join(REFLECTANCE_SETS)}"
        f"{did_you_mean(name, REFLECTANCE_SETS)}"
    )


def held(reflectance: Spectrum) -> Spectrum:
    """A reflectance whose first and last value hold up to the ends of the renderable wavelengths."""
    grid, values = reflectance.wavelength_nm, reflectance.values
    if grid[0] > 360.0:
        grid, values = np.append(360.0, grid), np.append(values[0], values)
    if grid[-1] < 830.0:
        grid, values = np.append(grid, 830.0), np.append(values, values[-1])
    return Spectrum(grid, values)


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
