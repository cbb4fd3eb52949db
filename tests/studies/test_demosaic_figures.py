"""Patterns and figures after demosaicing: closed forms, a mosaic without loss, and orders that must hold."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import RangeError
from hesim_render.measure import edge_response
from hesim_render.spectral.spectrum import illuminant
from hesim_render.studies import demosaic_figures
from hesim_render.studies.demosaic_figures import DARK, LIGHT, _figures, zipper

STUDY = {"schema_version": 1, "name": "detail", "sensors": ["reference-bayer"], "figures": ["demosaic"]}


def test_patterns_are_means_over_pixels():
    """The box of a pixel has the MTF sinc; half of the star is bright; a zone plate has its phase at each place."""
    edge = edge_response(demosaic_figures.edge_picture()[8:-8, 8:-8])
    assert edge.angle_deg == pytest.approx(-5, abs=0.05) or edge.angle_deg == pytest.approx(5, abs=0.05)
    # along the normal of an edge tilted by 5°, the pixel is nearly a box of 1 px
    np.testing.assert_allclose(edge.mtf[[10, 25, 50]], np.sinc([0.1, 0.25, 0.5]), atol=0.01)
    star = demosaic_figures.star()
    assert star.mean() == pytest.approx(0.5, abs=1e-6) and star.min() == 0 and star.max() == 1
    zone = demosaic_figures.zone_plate_picture()
    side = demosaic_figures.SIDE_PX
    row = zone[side // 2, side // 2 :] - 0.5
    x = np.arange(side // 2) + 0.5
    # amplitude of the mean over a pixel of a cosine of frequency f: about sinc f
    expected = 0.5 * np.cos(np.pi * demosaic_figures.ZONE_TOP / (side / 2) * x**2)
    np.testing.assert_allclose(row[:20], expected[:20], atol=0.03)
    assert demosaic_figures.chart().shape == (side, 3 * side) and all(side % size == 0 for size in (2, 4, 6))


def test_spokes_and_rings_are_where_their_angle_and_distance_say():
    """Pixel by pixel, away from the sides of the sectors; rows run downwards, as the angle does from the columns on."""
    side, spokes = demosaic_figures.SIDE_PX, demosaic_figures.SPOKES
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    radius, phase = np.hypot(x, y), spokes * np.arctan2(y, x)
    whole = np.abs(np.sin(phase)) * radius / spokes > 0.8  # the pixel's corners are 0.71 px from its centre
    np.testing.assert_array_equal(demosaic_figures.star()[whole], (np.sin(phase) > 0)[whole])
    zone, frequency = demosaic_figures.zone_plate_picture(), demosaic_figures.ZONE_TOP * radius / (side / 2)
    rate = np.pi * demosaic_figures.ZONE_TOP / (side / 2)
    slow = frequency < 0.15
    box = np.sinc(2 * rate * x / (2 * np.pi)) * np.sinc(2 * rate * y / (2 * np.pi))
    np.testing.assert_allclose(zone[slow], 0.5 + 0.5 * (box * np.cos(rate * radius**2))[slow], atol=0.01)


def test_false_colour_is_counted_along_the_edge(monkeypatch):
    """A red tint on both sides of it counts up to 4 px away, each pixel as much, and is compared beyond 16 px."""
    monkeypatch.setattr(demosaic_figures, "edge_response", lambda _: SimpleNamespace(frequency_at=lambda _: 0.5))
    monkeypatch.setattr(demosaic_figures, "zipper", lambda *_: 0.0)
    side = demosaic_figures.SIDE_PX
    reflectance = DARK + (LIGHT - DARK) * demosaic_figures.chart()
    a = np.radians(demosaic_figures.EDGE_DEG)
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    distance = np.abs(x * np.cos(a) + y * np.sin(a))

    def tinted(begin, end):
        rgb = np.repeat(reflectance[..., None], 3, axis=2)
        rgb[:, :side][(distance >= begin) & (distance < end)] *= [1.3, 1.0, 0.9]
        return _figures(rgb, reflectance)["false_colour"]

    whole = tinted(0, 4.8)
    assert whole > 5
    np.testing.assert_allclose([tinted(0, 2), tinted(1, 3), tinted(0, 15)], [whole / 2, whole / 2, whole], rtol=0.04)
    assert abs(tinted(4.8, 15)) < 1e-9 and tinted(17, 99) == pytest.approx(-whole, rel=0.04)


def test_a_perfect_picture_has_perfect_figures():
    reflectance = DARK + (LIGHT - DARK) * demosaic_figures.chart()
    perfect = _figures(np.repeat(reflectance[..., None], 3, axis=2), reflectance)
    assert perfect["mtf50_cy_per_px"] == pytest.approx(0.603, abs=0.01)  # sinc f = 1/2
    assert perfect["zipper"] == 0 and perfect["star_error"] < 1e-12
    assert abs(perfect["false_colour"]) < 0.02 and perfect["zone_plate_colour"] < 0.02
    # a cast over the whole picture is no false colour of the edge
    even = np.full((*reflectance.shape, 3), 0.5) * [1.2, 1.0, 0.8]
    even[:, :, :] *= np.where(reflectance > 0.4, 1.0, 0.999)[..., None]
    assert abs(_figures(even, reflectance)["false_colour"]) < 0.05
    # one channel moved by a pixel: coloured fringes on the edge, of both signs; luminance hardly changes
    shifted = np.repeat(reflectance[..., None], 3, axis=2)
    shifted[..., 2] = np.roll(shifted[..., 2], 1, axis=1)
    fringed = _figures(shifted, reflectance)
    assert fringed["false_colour"] > 3 and fringed["zone_plate_colour"] > 3


def test_zipper_counts_pixels_that_differ_from_their_true_likes():
    true = np.zeros((9, 9, 3))
    true[:, 5:] = [50, 0, 0]
    picture = true.copy()
    every = np.ones((9, 9), bool)
    assert zipper(picture, true, every) == 0
    picture[4, 2] += [0, 5, 0]  # one spot: itself, and neighbours whose first like is the spot
    found = zipper(picture, true, every)
    assert 100 / 49 <= found <= 900 / 49
    picture[4, 2] = true[4, 2] + [0, 2, 0]
    assert zipper(picture, true, every) == 0  # below the threshold


def test_a_picture_with_noise_has_the_levels_of_the_chart(monkeypatch):
    """Dark current of as many electrons as white: its mean is taken off, whatever the exposure and the gain are."""
    monkeypatch.setattr(demosaic_figures, "_figures", lambda *_: {})
    sensor = hr.load_sensor("reference-bayer", {"aps.dark_current_e_per_s": 4e5, "aps.exposure_us": 7_000})
    figures, picture = demosaic_figures.demosaic_figures(
        sensor, illuminant("D65"), np.eye(3), np.full(3, 2900.0), np.full(3, 2900.0), 7_000.0, 0.0, 1, 3
    )
    chart = DARK + (LIGHT - DARK) * demosaic_figures.chart()
    inner = np.s_[20:-20, 20:-20]
    # shot noise of 5700 electrons and less, 75 of 2900, over 80,000 pixels
    assert picture[inner].mean() == pytest.approx(chart[inner].mean(), abs=1e-3)
    assert 0.01 < figures["picture_error_simulated"] < 0.2


@pytest.mark.slow
def test_mosaics_cost_what_their_sampling_says():
    """On grey patterns a Bayer mosaic keeps the resolution of the pixels; sparse colours give more false colour."""
    study = {**STUDY, "filter_sets": ["rggb", "rgbw-half"], "illuminance_lux": [2000], "noise": {"repeats": 2}}
    table = hr.study(study)
    # the pixel's own box: sinc f = 1/2 at 0.603
    assert table["mtf50_cy_per_px"][0] == pytest.approx(0.603, abs=0.02)
    # an eighth of the pixels red or blue in place of a quarter
    for figure in ("false_colour", "zone_plate_colour", "star_error"):
        assert table[figure][1] > 1.5 * table[figure][0]
    # in this light noise adds little to what the Bayer mosaic costs, of which luminance has the least; white clips
    bayer, half_white = table.row(0), table.row(1)
    least = bayer["star_error"] * (LIGHT - DARK)
    assert least < bayer["picture_error_simulated"] < 3 * least and half_white["picture_error_simulated"] > 0.1
    assert bayer["picture_error_low"] < bayer["picture_error_simulated"] < bayer["picture_error_high"]


@pytest.mark.slow
def test_crosstalk_blurs_and_noise_adds_to_the_error():
    table = hr.study({**STUDY, "filter_sets": ["rggb"], "illuminance_lux": [20, 2000], "crosstalk": [0, 0.2],
                      "noise": {"repeats": 2}})  # fmt: skip
    blurred, sharp = (table.where(crosstalk=c, illuminance_lux=2000).row(0) for c in (0.2, 0))
    # of a grey picture: neighbours on both sides of the edge, sinc f · (1 − c/2 (1 − cos 2πf)) = 1/2
    frequency = np.linspace(0.3, 0.7, 4001)
    expected = frequency[np.argmin(np.abs(np.sinc(frequency) * (1 - 0.1 * (1 - np.cos(2 * np.pi * frequency))) - 0.5))]
    assert blurred["mtf50_cy_per_px"] == pytest.approx(expected, rel=0.03) and expected < 0.56
    dim = table.where(crosstalk=0, illuminance_lux=20).row(0)
    assert dim["picture_error_simulated"] > 2 * sharp["picture_error_simulated"]
    assert dim["mtf50_cy_per_px"] == pytest.approx(sharp["mtf50_cy_per_px"], rel=0.02)  # without noise the same
    assert sharp["picture_error_low"] <= sharp["picture_error_simulated"] <= sharp["picture_error_high"]


def test_a_report_shows_the_patterns(tmp_path):
    hr.study({**STUDY, "filter_sets": ["rggb"], "figures": ["colour", "demosaic"]}, out=tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Patterns after demosaicing" in page and "MTF50" in page


def test_small_sensors_are_refused():
    with pytest.raises(RangeError, match="at least 576x192 px"):
        hr.study({**STUDY, "sensors": ["davis346"], "filter_sets": ["rggb"]})
