"""Colour errors of filter sets over all pixels of a hyperspectral cube, in bands of rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.sources.cube.planes import blocks, integration_weights
from hesim_render.sources.render.cube import render_cube
from hesim_render.sources.scene import load_scene
from hesim_render.specs.study import Method, NamedLight, SurfacesSpec
from hesim_render.spectral.spectrum import Spectrum, colour_matching_functions, product
from hesim_render.studies.colour_error import delta_e_2000, fit_matrix, lab
from hesim_render.studies.colour_samples import colour_samples
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
    item: SurfacesSpec, sets: Sequence[Sequence[Spectrum]], light: NamedLight, chart: Sequence[Spectrum], method: Method
) -> Iterator[dict[str, Cell]]:
    """Mean, 95 % quantile and maximum of ΔE2000 over the pixels of a cube, for each filter set.

    The matrix of a set is fitted to a chart under the light. All sets are integrated together, in one pass over the
    file. A cube of radiance is seen in its own light; the light of the study is its white, and the luminance that
    99.5 % of the pixels stay below is that of white.

    Parameters
    ----------
    item : the cube.
    sets : responses of each filter set.
    light : illuminant of reflectances, white of radiances.
    chart : reflectances that the matrices are fitted to.
    method : how they are fitted.

    Yields
    ------
    Figures of each set: ``delta_e_cube_mean``, ``…_p95``, ``…_max``, and the number of pixels.

    Raises
    ------
    SpecError
        If the cube cannot be read, does not cover a response, or holds reflectances outside 0 to 1.
    """
    cube = open_surfaces(item)
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
    matrices = [fit_matrix(colour_samples(responses, spectrum, chart, light.name), method).matrix for responses in sets]
    starts = np.cumsum([0, *(len(responses) for responses in sets)])
    white_xyz = white[-3:] / white[-2]
    histograms = np.zeros((len(sets), round(_MOST / _BIN)), dtype=np.int64)
    total, largest = np.zeros(len(sets)), np.zeros(len(sets))
    for values in blocks(cube):
        if is_reflectance:
            _check_reflectance(values, item, cube)
        signals = values.reshape(-1, values.shape[2]) @ (weights * scale).astype(np.float32)
        wanted = lab(signals[:, -3:] / white[-2], white_xyz)
        for k, matrix in enumerate(matrices):
            part = slice(starts[k], starts[k + 1])
            corrected = (signals[:, part] / white[part].astype(np.float32)) @ matrix.T
            difference = delta_e_2000(lab(corrected, white_xyz), wanted)
            histograms[k] += np.histogram(difference, histograms.shape[1], (0, _MOST))[0]
            total[k] += difference.sum()
            largest[k] = max(largest[k], float(difference.max()))
    pixels = cube.shape[0] * cube.shape[1]
    for k in range(len(sets)):
        place = int(np.searchsorted(np.cumsum(histograms[k]), 0.95 * histograms[k].sum()))
        yield {
            "delta_e_cube_mean": float(total[k] / pixels), "delta_e_cube_p95": (place + 1) * _BIN,
            "delta_e_cube_max": float(largest[k]), "cube_pixels": pixels,
        }  # fmt: skip


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
