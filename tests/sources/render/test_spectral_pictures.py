"""Textures of spectral pictures, place by place, against interpolation of SciPy and NumPy."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.scene.pictures import picture_texture
from hesim_render.targets.piece import Picture

NM = np.array([400.0, 450.0, 470.0, 600.0, 720.0])


@pytest.mark.parametrize("repeat", [None, (2, 3)])
@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_a_spectral_picture_is_interpolated_in_both_directions_and_in_wavelength(interpolation, repeat):
    """4 rows of 7 texels, v upwards; the rim goes on beyond, or the next copy of the picture."""
    mi, rng = mitsuba(), np.random.default_rng(5)
    values = rng.uniform(0.05, 0.95, (4, 7, 5)).astype(np.float32)
    texture = picture_texture(mi, Picture(values, "spectral", NM, interpolation), repeat)
    u, v = rng.uniform(0, 1, (2, 400)) if repeat is None else rng.uniform(-1.2, 1.3, (2, 400))
    wavelengths = np.array([rng.uniform(390, 730, 400) for _ in range(4)])
    si = mi.SurfaceInteraction3f()
    si.uv, si.wavelengths = mi.Point2f(u, v), type(si.wavelengths)(wavelengths)
    found = np.array(texture.eval(si))
    across, up = (1, 1) if repeat is None else repeat
    x, y = across * u % 1 * 7 if repeat else u * 7, (1 - (up * v % 1 if repeat else v)) * 4
    if interpolation == "nearest":
        place, order = [np.floor(y), np.floor(x)], 0
        clear = (np.abs(x - np.rint(x)) > 1e-4) & (np.abs(y - np.rint(y)) > 1e-4)
    else:
        place, order, clear = [y - 0.5, x - 0.5], 1, np.ones(400, bool)
    mode = "nearest" if repeat is None else "grid-wrap"
    texels = np.stack([map_coordinates(values[..., k].astype(float), place, order=order, mode=mode) for k in range(5)])
    for own, nm in zip(found, wavelengths, strict=True):
        expected = np.array([np.interp(w, NM, texels[:, k], left=0, right=0) for k, w in enumerate(nm)])
        np.testing.assert_allclose(own[clear], expected[clear], atol=2e-5)
