"""Veiling glare and lateral chromatic aberration, effects that are switched off, and what recordings say."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import rendering
from scipy.special import j1

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.recording.manifest import build
from hesim_render.sources.render import RenderedFlux
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.glare import VeilingGlare
from hesim_render.sources.render.primary_rays import RayFactory
from hesim_render.sources.render.scene.builder import NeedsExactMode
from hesim_render.spectral.spectrum import RENDERABLE_NM

CAMERA = {"origin_m": [0, 0, 1]}
SUN = {"type": "directional", "illuminance_lux": 1000, "direction": [0, 0, -1]}


def card(size, place, reflectance=0.9, **more):
    return {"name": more.pop("name", "card"), "shape": "rectangle", "size_m": [*size, 0], "position_m": place,
            "reflectance": reflectance, **more}  # fmt: skip


WALL = card([9, 9], [0, 0, -0.01], 0.02, name="wall")


def test_glare_spreads_a_part_of_the_light_of_the_whole_sensor():
    """A bright card beside the region that is read out, and a dark wall: Φ' = (1 − g) Φ + g ⟨Φ⟩.

    The card covers known pixels, at 1600 px/m; the second lens has cos⁴.
    """
    scene = rendering.make_scene(objects=[card([0.08, 0.16], [0.1, 0.0, 0]), WALL], light=SUN, camera=CAMERA)
    for shading in ("none", "cos4"):
        changes = {"lens__relative_illumination": shading, "lens__focal_length_mm": 8.0}
        plain, _, _ = rendering.flux_image(scene, rendering.mono(32, 24, **changes), 64)
        glare, other, _ = rendering.flux_image(scene, rendering.mono(32, 24, lens__veiling_glare=0.1, **changes), 64)
        col, row = np.meshgrid(np.arange(1024) - 511.5, np.arange(1024) - 511.5)
        focal = 8.0 / 5e-3
        seen = (np.abs(col / focal - 0.1) < 0.04) & (np.abs(row / focal) < 0.08)
        vignetting = (1 + (col**2 + row**2) / focal**2) ** -2 if shading == "cos4" else np.ones((1024, 1024))
        wall = plain.mean()  # in the middle of the sensor, behind the card's left rim
        mean = (np.where(seen, 0.9 / 0.02, 1.0) * vignetting).mean() * wall / vignetting[500:524, 496:528].mean()
        np.testing.assert_allclose(((glare + other) / 2).mean(), 0.9 * wall + 0.1 * mean, rtol=0.01)
        # the same for all pixels
        np.testing.assert_allclose(np.ptp(glare - 0.9 * plain) / (0.1 * mean), 0, atol=1e-3)
    assert mean > 2 * wall
    with pytest.raises(NeedsExactMode, match=r"lens\.veiling_glare"):
        ChangeDrivenFlux(scene, rendering.mono(32, 24, lens__veiling_glare=0.1))


def test_glare_is_measured_all_over_a_sensor_that_is_not_square():
    """One pixel in each of 32 × 32 cells, of a sensor of 346 × 260 pixels."""
    sensor = hr.load_sensor("davis346")
    glare = VeilingGlare(SimpleNamespace(sensor=sensor, radiance_scale=1.7), None, [0], seed=3)
    row, col = np.divmod(glare._index.reshape(32, 32), 346)
    for place, size, axis in ((row, 260, 0), (col, 346, 1)):
        middle = (np.indices((32, 32))[axis] + 0.5) * size / 32
        assert np.abs(place + 0.5 - middle).max() <= size / 64 + 0.5


@pytest.mark.slow
def test_glare_has_the_light_of_each_pixels_own_time():
    """The card leaves the picture, with the camera, between the first window and the last."""
    track = {"object": "camera", "pivot_m": [0, 0, 1], "keyframes": [
        {"t_us": 0}, {"t_us": 10_000, "rotation_axis": [0, 1, 0], "rotation_deg": 60}]}  # fmt: skip
    scene = rendering.make_scene(
        objects=[card([0.1, 0.1], [0.1, 0.0, 0]), WALL], light=SUN, camera=CAMERA, motion=[track]
    )
    sensor = rendering.mono(32, 24, lens__veiling_glare=0.2)
    source = RenderedFlux(scene, sensor, 64, 3)
    begin = np.array([0.0, 9_900.0])
    both = source.mean_flux(np.array([0, 1], np.uint32), begin, begin + 100)
    alone = [RenderedFlux(scene, sensor, 64, 3).mean_flux(np.array([k], np.uint32), begin[k], begin[k] + 100)
             for k in (0, 1)]  # fmt: skip
    for half in (0, 1):
        together, single = np.array(both[half]), np.array([float(alone[k][half][0]) for k in (0, 1)])
        # other pixels of the sensor are looked at for two windows than for one
        np.testing.assert_allclose(together, single, rtol=0.06)
    assert np.array(both[0])[0] > 1.5 * np.array(both[0])[1]


def test_events_and_frames_of_a_hybrid_sensor_get_the_glare_of_their_own_filters():
    scene = rendering.make_scene(objects=[card([9, 9], [0, 0, 0], 0.5)], light=SUN, camera=CAMERA)
    sensor = hr.load_sensor("eiger", {"lens.veiling_glare": 0.3, "lens.relative_illumination": "none"}).crop(16, 16)
    plain = hr.load_sensor("eiger", {"lens.relative_illumination": "none"}).crop(16, 16)
    found, told = rendering.flux_image(scene, sensor, 16)[0], rendering.flux_image(scene, plain, 16)[0]
    np.testing.assert_allclose(found, told, rtol=5e-3)  # an even picture stays as it is


def test_colours_are_as_much_larger_as_the_file_says():
    """The edge of a card 2 mm off the axis, found in cubes of single wavelengths."""
    told = {"wavelength_nm": [450, 550, 650], "magnification_rel": [-0.002, 0.0, 0.004]}
    sensor = hr.load_sensor("reference-mono", {"lens.lateral_chromatic": told}).crop(64, 16, 880, 504)
    # the left rim of the card lies 0.123 m to the right at 1 m: 393.6 px from the axis
    scene = rendering.make_scene(objects=[card([1, 1], [0.623, 0.0, 0]), {**WALL, "reflectance": 0.0}], light=SUN,
                                 camera=CAMERA)  # fmt: skip
    bands, cube, _ = hr.render_cube(scene, sensor, [450, 500, 550, 650], 256, seed=2)
    profile = cube.mean(axis=0) / cube.max(axis=(0, 1))
    rim = 880 + 64 - profile.sum(axis=0) - 512  # from the axis, px
    expected = 0.123 * 3200 * (1 + np.interp(bands, told["wavelength_nm"], told["magnification_rel"]))
    np.testing.assert_allclose(rim, expected, atol=0.02)
    assert np.ptp(expected) > 2


@pytest.mark.parametrize("end", [0, 1])
def test_colours_at_the_ends_of_the_spectrum_have_their_own_size(end):
    """A magnification that still changes in the last nanometre, against the pinhole with the factor written out."""
    nm, larger = [RENDERABLE_NM[0], RENDERABLE_NM[0] + 1, RENDERABLE_NM[1] - 1, RENDERABLE_NM[1]], [0.02, 0, 0, 0.03]
    told = {"wavelength_nm": nm, "magnification_rel": larger}
    sensor = rendering.mono(16, 12, lens__lateral_chromatic=told)
    rays = RayFactory(place_camera(rendering.make_scene(objects=[WALL], light=SUN, camera=CAMERA).spec, sensor))
    types = jit()
    asked = np.array([0.0, 0.5]) * (1 - 2 * end) + RENDERABLE_NM[end]
    place = types.Float(3.0), types.Float(2.0)
    middle = types.Float(0.5), types.Float(0.5)
    plain = rays.towards(place[1], place[0], *middle)[1].numpy().reshape(3)
    _, direction, _ = rays.through_lens(place, middle, None, from_host(types.Float, asked))
    found = direction.numpy().reshape(3, 2)
    slope = found[:2] / found[2]
    factor = 1 + larger[3 * end] * np.array([1, 0.5])
    np.testing.assert_allclose(slope * factor, (plain[:2] / plain[2])[:, None] * np.ones(2), rtol=4e-4)


def test_a_dispersive_lens_keeps_the_light_of_an_even_picture():
    """One wavelength for a ray instead of four: the same mean, by the same law; z of halves, false alarm 1e-4."""
    light = {"type": "uniform", "illuminance_lux": 500, "illuminant": {"illuminant": "FL11"}}
    scene = rendering.make_scene(objects=[card([9, 9], [0, 0, 0], 0.5)], light=light, camera=CAMERA)
    told = {"wavelength_nm": [400, 700], "magnification_rel": [0.0, 1e-3]}
    even = [np.array(rendering.flux_image(scene, rendering.mono(32, 24, **changes), 256)[:2])
            for changes in ({}, {"lens__lateral_chromatic": told}, {"lens__diffraction": True})]  # fmt: skip
    for found in even[1:]:
        error = np.abs(found[0] - found[1]).mean() / np.sqrt(np.pi) / np.sqrt(32 * 24)
        assert abs(found.mean() - even[0].mean()) < 3.9 * np.hypot(error, 1e-4 * even[0].mean())


def hopkins(nu, defocus):
    """OTF of a round aperture with a defocus of so many wavelengths at its rim, by its overlap integral."""
    x = np.linspace(0, 1 - nu, 20_001)
    height = 2 * np.sqrt(np.maximum(1 - (x + nu) ** 2, 0))
    return 2 * np.trapezoid(height * np.cos(8 * np.pi * defocus * nu * x), x) / np.pi


def test_the_product_of_diffraction_and_defocus_is_off_where_the_documentation_says():
    """docs/physics.md: by more than 0.01 from 0.04 to 33 wavelengths of defocus, by at most 0.25."""
    nu = np.concatenate([np.linspace(1e-3, 0.1, 400), np.linspace(0.1, 0.999, 200)])
    in_focus = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    assert max(abs(hopkins(share, 0.0) - mtf) for share, mtf in zip(nu, in_focus, strict=True)) < 1e-4
    worst = {}
    for defocus in (0.037, 0.045, 0.2, 0.35, 1.0, 5.0, 30.0, 36.0, 60.0):
        z = 8 * np.pi * defocus * nu  # the blur circle is 8 N W wide, and ν = f λ N
        exact = np.array([hopkins(share, defocus) for share in nu])
        worst[defocus] = np.abs(exact - in_focus * 2 * j1(z) / z).max()
    assert all((error > 0.01) == (0.04 < defocus < 33) for defocus, error in worst.items()), worst
    assert max(worst.values()) == worst[0.35] and 0.24 < worst[0.35] < 0.255


# ---- names, manifest, errors -----------------------------------------------------------------------------------------

EVERY = {
    "lens.distortion": {"model": "opencv", "k1": -0.2},
    "lens.depth_of_field": True,
    "lens.diffraction": True,
    "lens.psf": {"type": "gaussian", "image_height_mm": [0, 3], "fwhm_um": [2, 6]},
    "lens.lateral_chromatic": {"wavelength_nm": [400, 700], "magnification_rel": [-1e-3, 1e-3]},
    "lens.veiling_glare": 0.02,
}


def test_each_effect_is_switched_off_by_its_name_and_told_in_the_manifest():
    from hesim_render.specs.lens import LENS_TERMS

    assert set(LENS_TERMS) == {*EVERY, "lens.relative_illumination"}
    scene = hr.load_scene("flat-field")
    sensor = hr.load_sensor("davis346", EVERY).crop(16, 12)
    plain = hr.load_sensor("davis346").crop(16, 12)
    run = {"duration_s": 0.06, "samples": 4, "seed": 1}
    on = hr.simulate(scene, sensor, **run)
    names = [term.removeprefix("lens.") for term in LENS_TERMS]
    assert sorted(on.manifest["lens"]["effects"]) == sorted(names)
    off = hr.simulate(scene, sensor, without=list(LENS_TERMS), **run)
    assert off.manifest["lens"]["effects"] == {} and off.manifest["settings"]["without"] == list(LENS_TERMS)
    bare = hr.simulate(scene, plain, without=["lens.relative_illumination"], **run)
    np.testing.assert_array_equal(off.frames[0].electrons_mean, bare.frames[0].electrons_mean)
    # one of them by a run, whose kernels take a second to compile; the others by what writes the manifest of a run
    by_run = hr.simulate(scene, sensor, without=["lens.distortion"], **run).manifest["lens"]["effects"]
    for term in LENS_TERMS:
        one = build(sensor.without([term]), scene=scene.spec, seed=1, duration_us=60_000, settings={})["lens"][
            "effects"
        ]
        assert sorted(one) == sorted(set(names) - {term.removeprefix("lens.")})
        assert term != "lens.distortion" or one == by_run
    with pytest.raises(RangeError, match=r"lens\.difraction.*did you mean 'lens\.diffraction'"):
        hr.simulate(scene, sensor, without=["lens.difraction"], **run)
    # truth of a recording is that of its own lens
    assert on.truth.camera().distortion == (-0.2, 0.0, 0.0, 0.0, 0.0)
    assert off.truth.camera().distortion_model == "none"


def test_a_saved_recording_holds_the_kernels_of_its_lens(tmp_path):
    kernels = np.zeros((2, 3, 5))
    kernels[0, 1, 2], kernels[1, 1, 1:4] = 1, 1 / 3
    np.save(tmp_path / "psf.npy", kernels)
    text = (hr.specs.files.data_folder("sensors") / "davis346.yaml").read_text(encoding="utf-8")
    told = "  psf: {type: measured, file: psf.npy, sample_um: 10, image_height_mm: [0, 3]}\n"
    (tmp_path / "mine.yaml").write_text(text.replace("lens:\n", f"lens:\n{told}"), encoding="utf-8")
    sensor = hr.load_sensor(tmp_path / "mine.yaml")
    run = {"duration_s": 0.06, "samples": 4}
    saved = hr.simulate(hr.load_scene("flat-field"), sensor.crop(16, 12), out=tmp_path / "rec", **run)
    (tmp_path / "psf.npy").unlink()
    loaded = hr.Recording.load(tmp_path / "rec")
    assert loaded.manifest["lens"]["effects"]["psf"]["type"] == "measured"
    assert loaded.manifest["sensor"]["spec"]["lens"]["psf"]["kernels"] == kernels.tolist()
    assert loaded.truth.camera().width == 16
    assert saved.manifest["sensor"]["sha256"] == loaded.manifest["sensor"]["sha256"]
    # a recording from elsewhere reads no other file
    manifest = json.loads((tmp_path / "rec" / "recording.json").read_text(encoding="utf-8"))
    np.save(tmp_path / "psf.npy", kernels)
    manifest["sensor"]["spec"]["lens"]["psf"] |= {"file": str(tmp_path / "psf.npy"), "kernels": None}
    (tmp_path / "rec" / "recording.json").write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises(SpecError, match=r"sensor\.spec: names a file of a PSF"):
        hr.Recording.load(tmp_path / "rec")


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ("psf: {type: measured, file: dim.npy, sample_um: 1}", "lens.psf.file: kernel 0 sums to 0.9; a PSF must sum"),
        ("psf: {type: measured, file: dark.npy, sample_um: 1}", "lens.psf.file: kernel 0 has a value of -0.1"),
        ("psf: {type: measured, file: even.npy, sample_um: 1}", "lens.psf.file: a kernel must have an odd number"),
        ("psf: {type: measured, file: none.npy, sample_um: 1}", "lens.psf.file: "),
        ("psf: {type: measured, sample_um: 1}", "lens.psf.file: file is required, or kernels"),
        ("psf: {type: measured, file: fine.npy, sample_um: 1, image_height_mm: [0, 1]}",
         "lens.psf.file: 1 values for the 2 of image_height_mm"),
        ("psf: {type: gaussian, image_height_mm: [0, 2, 1], fwhm_um: [1, 2, 3]}",
         "lens.psf.image_height_mm: image_height_mm must start at 0 or above and increase strictly"),
        ("psf: {type: gaussian, image_height_mm: [0], fwhm_um: [1]}\n  psf_fwhm_um: 2",
         "lens.psf: give psf or psf_fwhm_um, not both"),
        ("distortion: {model: opencv, k7: 1}", "lens.distortion.k7: unknown key"),
        ("distortion: {model: brown}", "lens.distortion"),
        ("lateral_chromatic: {wavelength_nm: [5,4], magnification_rel: [0,0]}", "lens.lateral_chromatic.wavelength_nm"),
        ("veiling_glare: 1.0", "lens.veiling_glare"),
        ("depth_of_field: 3", "lens.depth_of_field"),
    ],
)  # fmt: skip
def test_bad_lenses_are_one_line_with_file_line_and_key(tmp_path, keys, told):
    kernel = np.zeros((3, 3))
    kernel[1, 1] = 1
    np.save(tmp_path / "fine.npy", kernel)
    np.save(tmp_path / "dim.npy", 0.9 * kernel)
    np.save(tmp_path / "dark.npy", np.where(kernel == 0, -0.1, 1.8))
    np.save(tmp_path / "even.npy", np.full((2, 2), 0.25))
    text = (hr.specs.files.data_folder("sensors") / "davis346.yaml").read_text(encoding="utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("lens:\n", f"lens:\n  {keys}\n"), encoding="utf-8")
    line = 1 + file.read_text(encoding="utf-8").splitlines().index(f"  {keys.splitlines()[0]}")
    with pytest.raises(SpecError) as caught:
        hr.load_sensor(file)
    message = str(caught.value)
    assert message.startswith(f"{file}:{line}: {told}") and "\n" not in message, message
