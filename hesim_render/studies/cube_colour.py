"""Colour errors of filter sets over all pixels of a hyperspectral cube, in bands of rows."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import device_namespace
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.cube.planes import blocks, integration_weights
from hesim_render.sources.render.cube import render_cube
from hesim_render.sources.scene import load_scene
from hesim_render.specs.study import NamedLight, SurfacesSpec
from hesim_render.spectral.colorimetry import Triple, delta_e_2000_of, lab_of
from hesim_render.spectral.spectrum import Spectrum, colour_matching_functions, product
from hesim_render.studies.table import Cell
from hesim_render.targets.cube_file import CubeFile, open_cube

#: Histogram of colour differences: width of a bin and largest difference.
_BIN, _MOST = 0.01, 200.0
#: Part of the pixels whose luminance is below that of white, where a cube holds radiance.
_WHITE_QUANTILE = 0.995


def open_surfaces(item: SurfacesSpec) -> CubeFile:
    """The cube of a study, from its file or rendered.

    Raises
    ------
    SpecError
        If it cannot be read, or the scene cannot be rendered.
    """
    if item.scene is not None:
        first, last, step = item.bands_nm
        bands = first + step * np.arange(int((last - first) / step + 1e-9) + 1, dtype=np.float64)
        width, height = item.size_px
        scene = load_scene(item.beside(item.scene))
        _, radiance, _ = render_cube(scene, (height, width), bands, item.samples)
        shape = height, width, bands.size
        return CubeFile(Path(item.scene), shape, bands, lambda a, b: radiance[a:b], "rendered")
    assert item.cube is not None
    return open_cube(Path(item.beside(item.cube, shipped=False)), item.wavelength_nm)


def cube_figures(
    item: SurfacesSpec,
    cube: CubeFile,
    sets: Sequence[Sequence[Spectrum]],
    matrices: Sequence[NDArray[np.float64]],
    light: NamedLight,
) -> Iterator[dict[str, Cell]]:
    """Mean, 95 % quantile and maximum of ΔE2000 over the pixels of a cube, for each filter set.

    All sets are integrated together, in one pass over the file. A cube of radiance is seen in its own light; the light
    of the study is its white, and the luminance that 99.5 % of the pixels stay below is that of white.

    Parameters
    ----------
    item : how the cube is read.
    cube : from `open_surfaces`.
    sets : responses of each filter set.
    matrices : [3, channel] of each set, from channels with white at 1 to XYZ.
    light : illuminant of reflectances, white of radiances.

    Yields
    ------
    Figures of each set: ``delta_e_cube_mean``, ``…_p95``, ``…_max``, and the number of pixels.

    Raises
    ------
    SpecError
        If the cube cannot be read, does not cover a response, or holds reflectances outside 0 to 1.
    """
    spectrum = light.spectrum.load()
    is_reflectance = item.is_reflectance
    if is_reflectance:
        cube.require_reflectance()
    every = [response for responses in sets for response in responses]
    seen = [*every, *colour_matching_functions()]
    if is_reflectance:
        seen = [product(each, spectrum) for each in seen]
    weights = integration_weights(seen, cube, item.beyond == "hold") * item.scale
    white = np.array([product(each, spectrum).integral() for each in [*every, *colour_matching_functions()]])
    scale = 1.0 if is_reflectance else white[-2] / _white_luminance(cube, weights[:, -2])
    starts = np.cumsum([0, *(len(responses) for responses in sets)])
    parts = [np.s_[first:end] for first, end in pairwise(starts)]
    # from the bands of a texel straight to X/X_n, Y/Y_n, Z/Z_n: the true ones first, then those of each set
    white_xyz = white[-3:] / white[-2]
    tables = [weights[:, -3:] / white[-2]]
    tables += [(weights[:, own] / white[own]) @ matrix.T for own, matrix in zip(parts, matrices, strict=True)]
    to_ratios = [(scale * each / white_xyz).astype(np.float32) for each in tables]
    counts = np.zeros((len(sets), round(_MOST / _BIN)), dtype=np.int64)
    total, largest = np.zeros(len(sets)), np.zeros(len(sets))
    for values in blocks(cube):
        if is_reflectance:
            _check_reflectance(values, item, cube)
        texels = values.reshape(-1, values.shape[2]).T
        true = _lab_on_device(to_ratios[0].T @ texels)
        for k, own in enumerate(to_ratios[1:]):
            result = _differences(true, own.T @ texels)
            number = np.minimum((result * (1 / _BIN)).astype(np.int32), counts.shape[1] - 1)
            counts[k] += np.bincount(number, minlength=counts.shape[1])
            total[k] += result.sum(dtype=np.float64)
            largest[k] = max(largest[k], float(result.max()))
    pixels = cube.shape[0] * cube.shape[1]
    for k in range(len(sets)):
        place = int(np.searchsorted(np.cumsum(counts[k]), 0.95 * pixels))
        yield {
            "delta_e_cube_mean": float(total[k] / pixels), "delta_e_cube_p95": (place + 1) * _BIN,
            "delta_e_cube_max": float(largest[k]), "cube_pixels": pixels,
        }  # fmt: skip


def _lab_on_device(ratios: NDArray[np.float32]) -> Triple:
    """CIELAB of X, Y and Z over white, [3, texel], as device arrays."""
    x, y, z = (from_host(jit().Float, row) for row in ratios)
    result = lab_of((x, y, z), device_namespace())
    dr.eval(*result)
    return result


def _differences(true: Triple, ratios: NDArray[np.float32]) -> NDArray[np.float32]:
    """ΔE2000 of texels, [texel]."""
    xp = device_namespace()
    x, y, z = (from_host(jit().Float, row) for row in ratios)
    return np.asarray(delta_e_2000_of(lab_of((x, y, z), xp), true, xp).numpy())


def _check_reflectance(values: NDArray[np.float32], item: SurfacesSpec, cube: CubeFile) -> None:
    low, high = float(values.min()) * item.scale, float(values.max()) * item.scale
    if low < -1e-6 or high > 1 + 1e-6:
        raise SpecError(
            f"reflectances must lie in [0, 1]; these run from {low:g} to {high:g} (see scale, or quantity: radiance)",
            file=cube.file,
        )


def _white_luminance(cube: CubeFile, weights: NDArray[np.float64]) -> float:
    """Luminance below which most pixels stay, on a logarithmic histogram of 0.2 % steps."""
    edges = np.exp(np.arange(-60.0, 40.0, 0.002))
    counts = np.zeros(edges.size - 1, dtype=np.int64)
    for values in blocks(cube):
        counts += np.histogram(values @ weights.astype(np.float32), edges)[0]
    if not counts.sum():
        raise SpecError("holds no light", file=cube.file)
    return float(edges[np.searchsorted(np.cumsum(counts), _WHITE_QUANTILE * counts.sum()) + 1])
