"""Pictures, materials and light of objects, against Mitsuba's own scenes and closed forms."""

import json

import numpy as np
import pytest
from PIL import Image
from rendering import d65_irradiance, electrons_per_s, flux_image, make_scene, mitsuba_scene, mono, pair_tracer

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.scene.builder import NeedsExactMode
from hesim_render.sources.scene import light_parts

CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
SKY = {"type": "uniform", "illuminant": {"flat": 1.0, "band_nm": (300, 900)}, "irradiance_w_m2": np.pi * 600}
PLATE = {"name": "plate", "shape": "rectangle", "size_m": [1.2, 1.2, 0]}


def seen(objects, light=SKY, depth=None, samples=256, cols=16, rows=12, folder=None, **more):
    """Flux of a scene of objects, [row, col], as a scene file in a folder if that is given."""
    content = {"objects": objects, "light": light, "camera": CAMERA, **more}
    if depth is not None:
        content["max_depth"] = depth
    if folder is None:
        scene = make_scene(**content)
    else:
        file = folder / "scene.yaml"
        file.write_text(json.dumps({"schema_version": 1, "name": "t", "description": "", **content}))
        scene = hr.load_scene(file)
    a, b, _ = flux_image(scene, mono(cols, rows), samples)
    return (a + b) / 2


def picture(folder, values, name="picture.png"):
    Image.fromarray(np.asarray(values, dtype=np.uint8)).save(folder / name)
    return {"file": name}


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("roughplastic", "principled")),
        *("roughconductor", "dielectric"),
    ],
)
def test_a_material_is_that_of_mitsuba(name):
    """A ball before a wall under the sky: the same material in a dictionary of Mitsuba's own, other random numbers."""
    spectra = {
        "roughplastic": "diffuse_reflectance",
        "principled": "base_color",
        "roughconductor": "specular_reflectance",
    }
    own = {"type": name, **({"alpha": 0.2} if name.startswith("rough") else {})}
    mitsuba = dict(own)
    if name in spectra:
        own[spectra[name]] = {"wavelength_nm": [300.0, 550.0, 900.0], "value": [0.1, 0.9, 0.3]}
        mitsuba[spectra[name]] = {"type": "irregular", "wavelengths": [300, 550, 900], "values": [0.1, 0.9, 0.3]}
    wall = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.3], "reflectance": 0.2}
    ball = {"name": "ball", "shape": "sphere", "size_m": [0.5] * 3, "material": own}
    image = seen([wall, ball], depth=6, samples=2048)
    behind = np.diag([2.0, 2.0, 1.0, 1.0])
    behind[2, 3] = -0.3
    diffuse = {"type": "twosided", "material": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.2}}}
    reference = mitsuba_scene(
        {
            "wall": {"type": "rectangle", "to_world": behind.tolist(), "bsdf": diffuse},
            "ball": {"type": "sphere", "radius": 0.25, "bsdf": mitsuba},
            "sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}},
        },
        depth=6,
    )
    a, b, _ = flux_image(reference, mono(16, 12), 2048, seed=77)
    other = (a + b) / 2
    # the ball covers 60 % of the picture; of its pixels' differences each has an error of its own
    np.testing.assert_allclose(image.mean(), other.mean(), rtol=4e-3)
    assert np.sqrt(np.mean((image - other) ** 2)) < 0.04 * other.mean()
    assert abs(image.mean() / seen([wall, {**ball, "material": {"type": "diffuse"}}], depth=6).mean() - 1) > 0.02


def test_a_picture_lies_on_u_and_v(tmp_path):
    """Left half white, right half black, twice along u: columns at and beside a closed form."""
    texture = picture(tmp_path, np.repeat(np.array([[[255], [0]]]), 3, axis=2)) | {"interpolation": "nearest"}
    once = seen([{**PLATE, "size_m": [0.8, 0.8, 0], "texture": texture}], folder=tmp_path, cols=32, rows=8)
    assert np.all(once[:, 16:] < 1e-4 * once.max())
    white = seen([{**PLATE, "reflectance": 1.0}], cols=32, rows=8)
    np.testing.assert_allclose(once[:, :15], white[:, :15], rtol=0.01)
    twice = seen(
        [{**PLATE, "size_m": [0.8, 0.8, 0], "texture": texture | {"repeat": [2, 1]}}], folder=tmp_path, cols=32, rows=8
    )
    dark = twice.mean(axis=0) < 1e-4 * white.max()
    assert np.array_equal(np.flatnonzero(dark), [*range(8, 16), *range(24, 32)])


def test_a_cube_repeats_as_a_picture_does(tmp_path):
    """A spectral picture, 0.8 and 0.2 at all wavelengths, three times along u, bilinear also across its rim."""
    values = np.broadcast_to(np.array([0.8, 0.2], np.float32)[None, :, None], (1, 2, 2))
    np.save(tmp_path / "cube.npy", values)
    texture = {"file": "cube.npy", "wavelength_nm": [300, 900], "repeat": [3, 1]}
    plate = {**PLATE, "size_m": [0.8, 0.8, 0]}
    image = seen([{**plate, "texture": texture}], folder=tmp_path, cols=24, rows=4, samples=4096)
    white = seen([{**plate, "reflectance": 1.0}], cols=24, rows=4, samples=4096)
    # over a period of 8 columns a triangle between the centres of both texels, at 2 and 6
    place = (np.arange(24) + 0.5) % 8
    expected = 0.5 + 0.3 * (1 - np.abs((place + 2) % 8 - 4) / 2)
    np.testing.assert_allclose((image / white).mean(axis=0), expected, atol=0.01)


def test_an_object_shines(tmp_path):
    """Its luminance is stated: π cd m⁻² is the luminance of white at 1 lx."""
    grid, e = d65_irradiance(1000)
    glow = {"luminance_cd_m2": 1000 / np.pi}
    image = seen([{**PLATE, "reflectance": 0.0, "emission": glow}], light={"type": "none"}, cols=4, rows=4)
    sensor = mono(4, 4)
    transmittance = ((grid >= 400) & (grid <= 700)).astype(float)
    expected = electrons_per_s(e / np.pi, grid, transmittance, 5.0, sensor.lens.f_number, sensor.lens.magnification)
    np.testing.assert_allclose(image.mean() / expected, 1.0, rtol=0.02)


def test_objects_that_shine_flicker_apart():
    lamp = {"luminance_cd_m2": 100, "waveform": {"type": "pwm", "frequency_hz": 100, "duty": 0.5}}
    objects = [{**PLATE, "emission": lamp}, {**PLATE, "name": "other", "emission": {"luminance_cd_m2": 50}}]
    parts = light_parts(make_scene(objects=objects, light=SKY, camera=CAMERA))
    assert [kind is None for kind, _ in parts] == [True, False]
    shown = [[item.emission.luminance_cd_m2 for item in part.spec.objects] for _, part in parts]
    assert shown == [[0.0, 50.0], [100.0, 0.0]]
    assert [light.is_on for _, part in parts for light in part.spec.lights] == [True, False]


def test_a_moving_lamp_needs_the_exact_mode():
    keys = [{"t_us": 0}, {"t_us": 1000, "translation_m": [0.1, 0, 0]}]
    lamp = {"name": "lamp", "shape": "sphere", "size_m": [0.1] * 3, "emission": {"luminance_cd_m2": 100}}
    scene = make_scene(objects=[PLATE, lamp], light=SKY, camera=CAMERA, motion=[{"object": "lamp", "keyframes": keys}])
    with pytest.raises(NeedsExactMode, match="'lamp' moves and emits light"):
        pair_tracer(scene, mono(4, 4))


def test_the_default_mode_agrees_with_the_exact_one(tmp_path):
    """A glossy ball before a picture, rendered by both."""
    noise = np.random.default_rng(3).integers(0, 255, (4, 4, 3))
    wall = {**PLATE, "position_m": [0, 0, -0.3], "size_m": [2, 2, 0], "texture": picture(tmp_path, noise)}
    ball = {
        "name": "ball",
        "shape": "sphere",
        "size_m": [0.4] * 3,
        "material": {"type": "roughconductor", "alpha": 0.3},
    }
    objects, sensor = [wall, ball], mono(12, 8)
    exact = seen(objects, folder=tmp_path, samples=4096, cols=12, rows=8)
    scene = hr.load_scene(tmp_path / "scene.yaml")
    source = ChangeDrivenFlux(scene, sensor, 0.1, seed=9)
    halves = source.mean_flux(np.arange(96, dtype=np.uint32), 0.0, 1000.0)
    other = np.mean([np.array(half, np.float64) for half in halves], axis=0).reshape(8, 12)
    np.testing.assert_allclose(other.mean(), exact.mean(), rtol=5e-3)
    assert np.sqrt(np.mean((other - exact) ** 2)) < 0.04 * exact.mean()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"material": {"type": "circular"}}, "objects.plate.material.type.*polarisation"),
        ({"material": {"type": "../evil"}}, "objects.plate.material.type.*not known here"),
        ({"material": {"type": "sphere"}}, "objects.plate.material.type.*not known here"),
        ({"material": {"alpha": 0.1}}, "material.*with its 'type'"),
        ({"material": {"type": "plastic", "alhpa": 0.1}}, "objects.plate.material.*alhpa"),
        ({"material": {"type": "plastic"}, "reflectance": 0.3}, "give one of"),
        ({"texture": {"file": "none.png"}}, "no such file"),
        ({"texture": {"file": "../outside.png"}}, "outside of the scene's folder"),
        (
            {"material": {"type": "plastic", "diffuse_reflectance": {"file": "../o.png"}}},
            "outside of the scene's folder",
        ),
        ({"material": {"type": "measured", "filename": "none.bsdf"}}, "no such file"),
        ({"material": {"type": "plastic", "diffuse_reflectance": {"flat": 0.5, "band_nm": [400, 500]}}}, "covers"),
    ],
)
def test_wrong_surfaces_are_told(tmp_path, change, told):
    (tmp_path / "in").mkdir()
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "outside.png")
    with pytest.raises(SpecError, match=told):
        seen([{**PLATE, **change}], samples=4, folder=tmp_path / "in")


def test_files_of_surfaces_are_in_the_manifest(tmp_path):
    texture = picture(tmp_path, np.full((2, 2, 3), 128))
    nested = {
        "type": "bumpmap",
        "arbitrary": {"type": "bitmap", "filename": "bump.png", "raw": True},
        "bsdf": {"type": "plastic"},
    }
    picture(tmp_path, np.full((2, 2, 3), 128), "bump.png")
    objects = [{**PLATE, "texture": texture}, {**PLATE, "name": "b", "position_m": [0, 0, -1], "material": nested}]
    file = tmp_path / "scene.yaml"
    content = {"objects": objects, "light": SKY, "camera": CAMERA}
    file.write_text(json.dumps({"schema_version": 1, "name": "t", "description": "", **content}))
    run = hr.simulate(hr.load_scene(file), mono(4, 4), duration_s=0.001, clean=True, exact=True, samples=4)
    assert set(run.manifest["scene"]["files_sha256"]) == {"picture.png", "bump.png"}
