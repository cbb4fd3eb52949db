"""Textures and spectra of generated scenes, against what their random numbers stand for."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.benchmark import materials
from hesim_render.spectral.spectrum import colorchecker_reflectances


class Drawn:
    """Random numbers that are given; normal ones are real."""

    def __init__(self, integers=(), uniform=(), random=()):
        self._integers, self._uniform, self._random = iter(integers), iter(uniform), iter(random)

    def integers(self, *_):
        return next(self._integers)

    def uniform(self, *_):
        return next(self._uniform)

    def random(self, *_):
        return next(self._random)

    def normal(self, size):
        return np.random.default_rng(4).normal(size=size)


def turns(line):
    """Changes between below and above one half along a closed line."""
    above = line > 0.5
    return np.count_nonzero(above != np.roll(above, 1))


def test_checks_have_their_numbers_of_squares():
    found = materials._checks(Drawn([np.array([5, 8])]))
    assert set(np.unique(found)) == {0, 1} and found[0, 0] == 0
    across, down = (np.count_nonzero(np.diff(line)) for line in (found[3], found[:, 3]))
    assert (across, down) == (4, 7) and found[3, 255] == 0 and found[255, 3] == 1


@pytest.mark.parametrize("hardness", [-0.3, 0.9])
def test_stripes_are_closed_at_the_sides_and_whole_periods(hardness):
    """Three periods along a row and seven along a column: the phase of each place, in turns."""
    found = materials._stripes(Drawn([np.array([3, -7])], [hardness], [0.11]))
    assert {turns(found[k]) for k in (0, 9, 100)} == {6} and {turns(found[:, k]) for k in (0, 9, 100)} == {14}
    y, x = np.mgrid[:256, :256] / 256
    wave = np.sin(2 * np.pi * (3 * x - 7 * y + 0.11))
    np.testing.assert_array_equal(found > 0.5, wave > 0)
    assert found.min() >= -1e-12 and found.max() <= 1 + 1e-12
    # a tenth of the way up the wave, ln of its odds is twice the slope
    soft = np.abs(np.abs(wave) - 0.1) < 0.01
    value = np.clip(2 * found[soft] - 1, -0.999, 0.999)
    np.testing.assert_allclose(np.arctanh(value) / wave[soft], 10**hardness, rtol=0.01)
    # no periods at all would be no grating
    assert turns(materials._stripes(Drawn([np.array([0, 0])], [0.5], [0.2]))[7]) == 16


def test_noise_falls_as_its_power_of_the_frequency_in_all_directions():
    falls = []
    for power in (0.7, 1.4):
        found = materials._noise(Drawn(uniform=[power]))
        assert found.min() == 0 and found.max() == 1
        size = np.abs(np.fft.fft2(found - found.mean()))
        fx = np.abs(np.fft.fftfreq(256) * 256)
        radius, angle = np.hypot(fx[:, None], fx[None, :]), np.arctan2(fx[:, None], fx[None, :])
        rings = [(radius > 8 * 2**k) & (radius < 10 * 2**k) for k in range(4)]
        for part in (angle < 0.7, angle > 0.87):
            mean = [np.sqrt(np.mean(size[ring & part] ** 2)) for ring in rings]
            falls.append(-np.polyfit(np.arange(4), np.log2(mean), 1)[0] - power)
    assert np.abs(falls).max() < 0.12  # of 100 to 3000 values in a ring, and two per cent are clipped


def test_cells_have_the_value_of_the_nearest_point_across_the_sides():
    points, values = np.array([(0.02, 0.5), (0.4, 0.45), (0.7, 0.6), (0.3, 0.97)]), np.array([0.1, 0.9, 0.4, 0.6])
    found = materials._cells(Drawn([4], random=[points, values]))
    y, x = np.mgrid[:256, :256] / 256
    off = np.abs(np.stack([x, y], axis=-1)[..., None, :] - points)
    expected = values[np.argmin(np.sum(np.minimum(off, 1 - off) ** 2, axis=-1), axis=-1)]
    assert np.mean(found == expected) > 0.999


def test_a_texture_lies_between_its_reflectances_with_a_colour_at_each_end(monkeypatch):
    """The tint is half of the contrast at most; sRGB of IEC 61966-2-1, in whole steps."""
    value = np.linspace(0, 1, 24).reshape(4, 6)
    monkeypatch.setattr(materials, "KINDS", {"a": None, "b": lambda rng: value})
    tint = np.array([[0.4, -0.9, 0.2], [-0.3, 0.8, 1.0]])
    found = materials.texture(Drawn([1], [tint]), 0.2, 0.6)
    low, high = np.array([0.2, 0.6])[:, None] * (1 + 0.25 * tint)
    linear = low + value[..., None] * (high - low)
    np.testing.assert_array_equal(found, np.rint(255 * (1.055 * linear ** (1 / 2.4) - 0.055)))
    bright = materials.texture(Drawn([1], [0 * tint]), 0.5, 0.97)
    assert bright.max() == round(255 * (1.055 * 0.97 ** (1 / 2.4) - 0.055))


def palette(contrast, low, high, rng, patches=()):
    made = materials.Palette.__new__(materials.Palette)
    made.contrast, made.low, made.high, made.measured, made.files = contrast, low, high, set(), {}
    made._rng, made._patches, made._pictures = rng, list(patches), []
    made._spec = SimpleNamespace(textured=0)
    return made


def test_spectra_have_their_level_and_are_greyer_where_the_scene_is():
    """A measured one: its own shape about its mean, times the contrast; a smooth one: three half waves."""
    name = "dark skin"
    patch = colorchecker_reflectances()[name]
    nm = materials._WAVELENGTH_NM
    shape = patch.at(np.clip(nm, *patch.support_nm))
    waves = np.array([0.3, -0.2, 0.1])
    smooth = 1 + sum(wave * np.cos((k + 1) * np.pi * (nm - 360) / 470) for k, wave in enumerate(waves))
    for contrast in (0.3, 0.8):
        made = palette(contrast, 0.1, 0.4, Drawn([2], [0.23], [0.59]), ["x", "y", name])
        values = made._spectrum()["values"]
        np.testing.assert_allclose(values, 0.23 * (1 + contrast * (shape / shape.mean() - 1)), atol=1e-6)
        assert made.measured == {name}
        made = palette(contrast, 0.1, 0.4, Drawn([], [0.31, waves], [0.61]), ["x"])
        np.testing.assert_allclose(made._spectrum()["values"], 0.31 * (1 + contrast * (smooth / smooth.mean() - 1)),
                                   atol=1e-6)  # fmt: skip
        assert not made.measured
    bright = palette(0.9, 0.9, 0.95, Drawn([2], [0.94], [0.1]), ["x", "y", name])._spectrum()["values"]
    assert max(bright) == 0.95
