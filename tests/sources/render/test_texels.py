"""Pictures on diffuse surfaces: integrals of texels against quadrature of Mitsuba's own textures, flux against its
paths.
"""

import json

import numpy as np
import pytest
from PIL import Image
from rendering import flux_image, mono, pair_tracer, traced

import hesim_render as hr
from hesim_render.core.device import dr
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import used_responses
from hesim_render.sources.render.scene import surfaces
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.scene.pictures import picture_texture
from hesim_render.sources.render.transport import texels as own_texels
from hesim_render.sources.render.transport.texels import Texels
from hesim_render.spectral.spectrum import Spectrum, illuminant, integrate_product
from hesim_render.targets.piece import Picture

LIGHT = {"type": "uniform", "illuminant": "D65", "illuminance_lux": 700}
CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
RESPONSES = [
    Spectrum(np.array([390.0, 480, 600, 720]), np.array([0.3, 1.2, 0.7, 0.1])),
    Spectrum(np.array([420.0, 500, 555, 660]), np.array([0.0, 0.9, 1.7, 0.3])),
]
#: Two smooth ones and one with a line.
LEVELS = [illuminant("D65"), Spectrum(np.array([380.0, 450, 452, 455, 700, 790]), np.array([0.1, 0.2, 3, 0.3, 1, 0.2]))]
CUBE_NM = np.array([400.0, 430, 520, 600, 690])
KINDS = {"grey": 1, "srgb": 3, "spectral": 5}
CUBE = "{file: cube.npy, wavelength_nm: [350, 520, 900]}"


def picture(kind, interpolation, rng):
    """3 rows of 5 texels, black and white ones among them."""
    values = rng.uniform(0.02, 0.97, (3, 5, KINDS[kind])).astype(np.float32)
    values[0, 1], values[2, 3] = 1.0, 0.0
    return Picture(values, kind, CUBE_NM if kind == "spectral" else None, interpolation)


def integrals(texture, u, v, level, response):
    """∫ R ρ/π S dλ of a texture of Mitsuba at places, by the trapezoidal rule on a grid of 0.1 nm and all knots."""
    mi = mitsuba()
    knots = np.concatenate([level.wavelength_nm, response.wavelength_nm, CUBE_NM, CUBE_NM[[0, -1]] + [-1e-3, 1e-3]])
    nm = np.unique(np.concatenate([np.linspace(380, 800, 4201), knots[(knots > 380) & (knots < 800)]]))
    place, wave = (part.ravel() for part in np.meshgrid(np.arange(u.size), np.arange(nm.size), indexing="ij"))
    si = dr.zeros(mi.SurfaceInteraction3f, place.size)
    si.uv = mi.Point2f(from_host(mi.Float, u[place]), from_host(mi.Float, v[place]))
    si.wavelengths = mi.UnpolarizedSpectrum(from_host(mi.Float, nm[wave]))
    rho = np.array(texture.eval(si)[0], np.float64).reshape(u.size, nm.size)
    return np.trapezoid(rho * level.at(nm) * response.at(nm), nm, axis=1) / np.pi


@pytest.mark.parametrize("repeat", [None, (2, 3)])
@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("lights, filters", [(1, 1), (2, 2)])
def test_texels_hold_the_integrals_of_mitsubas_textures(lights, filters, interpolation, repeat, monkeypatch):
    """Places within the picture and beyond it; three pictures one after the other, of one light and filter as well.

    With two lights, two rows at a time are integrated, and the last one by itself.
    """
    monkeypatch.setattr(own_texels, "_TEXELS_AT_ONCE", 10 if lights == 2 else 1 << 20)
    mi, rng = mitsuba(), np.random.default_rng(17)
    levels, responses = LEVELS[-lights:], RESPONSES[:filters]
    pictures = [picture(kind, interpolation, rng) for kind in KINDS]
    texels = Texels(mi, [(each, repeat is not None) for each in pictures], levels, responses)
    u, v = rng.uniform(-0.3, 1.4, (2, 150)).astype(np.float32)
    across, up = repeat or (1, 1)
    for number, each in enumerate(pictures):
        texture = picture_texture(mi, each, repeat)
        texture = mi.load_dict(texture) if isinstance(texture, dict) else texture
        place = mi.Point2f(from_host(mi.Float, u * across), from_host(mi.Float, v * up))
        of = texels.at(dr.full(mi.UInt32, number, u.size), place, mi.Bool(True))
        for light, level in enumerate(levels):
            for own, response in enumerate(responses):
                grey = mi.Float(integrate_product(level, response) / np.pi)
                got = np.array(texels.factor(of, mi.UInt32(light * filters + own), grey, mi.Bool(True)))
                wanted = integrals(texture, u, v, level, response)
                np.testing.assert_allclose(got, wanted, atol=2e-4 * wanted.max())


def textured(folder, changes=None, plate=CUBE):
    """A photo behind a box and a plate with pictures; the plate shows its back."""
    rng = np.random.default_rng(8)
    for name, size in (("photo", (24, 32, 3)), ("wood", (9, 7, 3))):
        Image.fromarray(rng.integers(0, 256, size, dtype=np.uint8)).save(folder / f"{name}.png")
    np.save(folder / "cube.npy", rng.uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32))
    text = """
schema_version: 1
name: pictures
description: pictures on a target, a box and a plate
target: {type: image, file: photo.png, width_m: 0.9, height_m: 0.7, position_m: [0, 0, -0.15]}
objects:
- {name: box, shape: box, size_m: [0.2, 0.15, 0.3], position_m: [-0.2, 0.05, 0.05], rotation_axis: [1, 1, 0],
   rotation_deg: 40, texture: {file: wood.png, repeat: [2, 3], interpolation: nearest}}
- {name: plate, shape: rectangle, size_m: [0.25, 0.2, 0], position_m: [0.18, -0.08, 0.1], rotation_axis: [0, 1, 0],
   rotation_deg: 160, texture: PLATE}
- {name: ball, shape: sphere, size_m: [0.12, 0.12, 0.12], position_m: [0.12, 0.2, 0.1], reflectance: 0.4, pattern: 0.7,
   pattern_count: [8, 4]}
light:
- {type: area, illuminant: LED-B3, illuminance_lux: 900, position_m: [0.5, 0.9, 1.0], size_m: [0.5, 0.3]}
- {type: uniform, illuminant: D65, illuminance_lux: 150}
camera: {origin_m: [0, 0, 2], target_m: [0, 0, 0], horizontal_fov_deg: 22.62}
"""
    (folder / "scene.yaml").write_text(text.replace("PLATE", plate))
    return hr.load_scene(folder / "scene.yaml", changes)


def test_flux_of_pictures_is_that_of_mitsubas_paths(tmp_path):
    """Means of 4×4 pixels of three filters, by both estimates; differences over standard errors from halves."""
    scene, sensor = textured(tmp_path), hr.load_sensor("gen2").crop(48, 36, 1500, 1100)
    tracer = pair_tracer(scene, sensor)
    assert tracer.is_diffuse

    def groups(half_a, half_b):
        # filters of a tile apart, tiles of a group together
        a, b = (np.array(half, np.float64).reshape(9, 2, 2, 12, 2, 2).mean(axis=(1, 4)) for half in (half_a, half_b))
        return (a + b) / 2, (a - b) ** 2 / 4

    a, b, _ = flux_image(scene, sensor, 4096, begin_us=0.0, end_us=0.0)
    wanted, their_square = groups(a, b)
    assert wanted.std() > 0.2 * wanted.mean()
    for controlled in (True, False):
        seen = traced(tracer, 4096, 0.0, 0.0, controlled)
        got, square = groups(seen.half_a, seen.half_b)
        spread = np.sqrt(np.mean(square + their_square))
        assert spread < 0.01 * wanted.mean()
        assert abs(np.mean(got - wanted)) < 5 * spread / got.size**0.5
        assert np.abs(got - wanted).max() < 12 * spread


@pytest.mark.parametrize("repeats", [False, True])
def test_the_rim_of_a_picture_goes_over_into_the_other_one_only_if_it_repeats(tmp_path, repeats):
    """Two texels, dark and white: a tenth of the way across, 0.3 of a texel from the middle of the dark one."""
    Image.fromarray(np.repeat(np.array([[[40], [255]]], np.uint8), 3, axis=2)).save(tmp_path / "two.png")
    if repeats:
        plate = {"name": "plate", "shape": "rectangle", "size_m": [0.8, 0.8, 0], "texture": {"file": "two.png"}}
        what = {"objects": [plate]}
    else:
        what = {"target": {"type": "image", "file": "two.png", "width_m": 0.8, "height_m": 0.8}}
    spec = {"schema_version": 1, "name": "two", "description": "", "light": LIGHT, "camera": CAMERA, **what}
    (tmp_path / "two.yaml").write_text(json.dumps(spec))
    tracer = pair_tracer(hr.load_scene(tmp_path / "two.yaml"), mono(40, 30))
    across = traced(tracer, 256, 0.0, 0.0).mean.reshape(30, 40).mean(axis=0)
    dark = 0.0212  # linear sRGB of 40
    ratio = (0.3 + 0.7 * dark) / (0.7 + 0.3 * dark) if repeats else dark
    assert across[3:5].mean() / across[35:37].mean() == pytest.approx(ratio, rel=0.03)


def test_pictures_that_do_not_fit_are_seen_by_paths(tmp_path, monkeypatch):
    """A number a texel for each of two lights and each filter; one of a grey picture."""
    sensor = hr.load_sensor("gen2").crop(8, 8, 1500, 1100)
    entries = 2 * len(used_responses(sensor)) * (24 * 32 + 9 * 7 + 4 * 4)
    for most, fits in ((entries, True), (entries - 1, False)):
        monkeypatch.setattr(surfaces, "_MOST_ENTRIES", most)
        assert pair_tracer(textured(tmp_path), sensor).is_diffuse == fits
    assert surfaces.are_few([surfaces.pictured("a", picture("grey", "nearest", np.random.default_rng(1)))], 1 << 40)


def test_the_scatter_of_pictures_is_not_mild(tmp_path):
    """Texels cross pixels everywhere: the mild scatter left errors of 0.6 units where 0.5 are wanted."""
    sensor = hr.load_sensor("davis346").crop(8, 8, 150, 110)
    without = {"target": {"type": "flat", "reflectance": 0.3}, "objects": []}
    for changes, mild in ((None, False), (without, True)):
        renderer = ChangeDrivenFlux(textured(tmp_path, changes), sensor)._renderer
        bands = list(renderer.bands(np.arange(64, dtype=np.uint32), "events"))
        assert renderer.tracer.is_diffuse and bands[0].mild == mild


@pytest.mark.slow
def test_moving_pictures_have_the_wanted_error_in_the_default_mode(tmp_path, monkeypatch):
    """A photo slides, a box with another one turns. Errors in noise units against the path tracer, which sees Mitsuba's
    own textures, and their mean (false alarm 1e-5).
    """
    ends = {"target": {"translation_m": [0.17, -0.06, 0]}, "box": {"rotation_axis": [0, 1, 0], "rotation_deg": 50}}
    motion = [{"object": name, "keyframes": [{"t_us": 0}, {"t_us": 100_000, **end}]} for name, end in ends.items()]
    scene, sensor = textured(tmp_path, {"motion": motion}), hr.load_sensor("davis346").crop(48, 36, 150, 110)
    flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=6)
    blocks = list(flux.sample_blocks(1, 0, 5_000))
    pixels = np.arange(48 * 36, dtype=np.uint32)
    seen = np.array([(np.array(s.half_a) + np.array(s.half_b)) / 2 for s in flux.flux_of_blocks(pixels, blocks)])
    begin, end = (np.concatenate([getattr(b, name)[b.wanted] for b in blocks]) for name in ("begin_us", "end_us"))
    rng = np.random.default_rng(2)
    window, pixel = rng.integers(1, len(seen), 600), rng.choice(pixels.size, 600, replace=False)
    unit = flux.noise_unit(pixels, seen, True)[window, pixel]
    # no picture fits, so that paths see them
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", 0)
    paths = pair_tracer(textured(tmp_path, {"motion": motion}), sensor)
    assert flux._renderer.tracer.is_diffuse and not paths.is_diffuse
    places, windows = sensor.layout.full_index.ravel()[pixel], Windows(begin, end)
    given = places, window, windows, np.full(600, 4096), np.zeros(600, np.bool_)
    several = np.array([paths.trace(*given, repeat=k).mean for k in range(4)], np.float64)
    off = (seen[window, pixel] - several.mean(axis=0)) / unit
    assert np.mean(np.abs(seen[window, pixel] - seen[0, pixel]) > 3 * unit) > 0.3
    assert np.sqrt(np.mean(several.var(axis=0, ddof=1) / 4 / unit**2)) < 0.15
    assert np.sqrt(np.mean(off**2)) < 0.5
    assert abs(off.mean()) < 4.4 * off.std() / off.size**0.5


def test_a_picture_without_light_is_black(tmp_path):
    scene = textured(tmp_path, {"light": {"type": "none"}})
    recording = hr.simulate(scene, hr.load_sensor("davis346").crop(8, 6, 150, 110), duration_s=0.003, clean=True)
    assert len(recording.events) == 0
