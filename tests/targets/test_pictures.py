"""Pictures, cubes and lamps of targets, rendered, against what their files say."""

import colour
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from rendering import FURNACE, flux_image, make_scene, mono

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.cube import render_cube
from hesim_render.targets.cube import read_cube

CAMERA = {"fit": "target"}
SIZE = {"width_m": 0.4, "height_m": 0.3}
DARK = {"type": "none"}


def seen(target, bands, rows=12, cols=16, samples=16):
    """Radiance of a target under light of radiance 1 (its reflectance), [row, col, band]; the target fills the view."""
    scene = make_scene(target={**SIZE, **target}, light=FURNACE, camera=CAMERA)
    return render_cube(scene, (rows, cols), bands, samples)[1]


def cube_file(path):
    """3 × 4 texels, each with a spectrum of its own at uneven wavelengths."""
    wavelength = [400.0, 450.0, 470.0, 600.0, 720.0]
    values = np.random.default_rng(3).uniform(0.05, 0.95, (3, 4, 5)).astype(np.float32)
    np.save(path, values)
    return values, wavelength


def test_a_cube_has_the_spectrum_of_each_texel_at_its_place(tmp_path):
    values, wavelength = cube_file(tmp_path / "cube.npy")
    target = {"type": "image", "file": str(tmp_path / "cube.npy"), "wavelength_nm": wavelength}
    bands = np.array([400.0, 431.0, 455.0, 470.0, 533.0, 600.0, 719.0])
    radiance = seen({**target, "interpolation": "nearest"}, bands)
    expected = np.array([[np.interp(bands, wavelength, texel) for texel in row] for row in values])
    np.testing.assert_allclose(radiance, np.kron(expected, np.ones((4, 4, 1))), rtol=2e-5)
    # bilinear: 48 × 64 pixels show the mean over small parts of the linear surface between texel centres
    radiance = seen({**target}, bands[:4], 48, 64)
    row, col = 20, 36  # off the texel centres at 8 + 16 k, by one line of texels in either direction
    y, x = (row + 0.5) / 16 - 0.5, (col + 0.5) / 16 - 0.5
    a, b, u, v = int(y), int(x), y - int(y), x - int(x)
    mixed = (1 - u) * ((1 - v) * expected[a, b] + v * expected[a, b + 1])
    mixed += u * ((1 - v) * expected[a + 1, b] + v * expected[a + 1, b + 1])
    np.testing.assert_allclose(radiance[row, col], mixed[:4], rtol=2e-3)


def test_a_cube_must_cover_the_response_unless_its_ends_are_held(tmp_path):
    values = np.full((2, 2, 3), 0.5, np.float32)
    values[..., 2] = 0.25
    np.save(tmp_path / "cube.npy", values)
    target = {"type": "image", "file": str(tmp_path / "cube.npy"), "wavelength_nm": [420, 550, 650]}
    scene = make_scene(target=target, light=FURNACE, camera=CAMERA)
    with pytest.raises(SpecError, match=r"target \(picture\): this spectrum covers 420-650 nm, only 74"):
        hr.simulate(scene, mono(8, 8), duration_s=0.01)
    held = seen({**target, "beyond": "hold"}, [400.0, 600.0, 690.0], 3, 4)
    np.testing.assert_allclose(held[0, 0], [0.5, 0.375, 0.25], rtol=1e-5)


def test_srgb_colours_have_their_tristimulus_values_under_d65(tmp_path):
    codes = np.array([[[255, 255, 255], [128, 128, 128]], [[200, 60, 40], [30, 90, 160]]], np.uint8)
    Image.fromarray(codes).save(tmp_path / "picture.png")
    bands = np.arange(380, 781, 5.0)
    target = {"type": "image", "file": str(tmp_path / "picture.png"), "interpolation": "nearest"}
    reflectance = seen(target, bands, 6, 8, 4)
    d65 = np.interp(bands, colour.SDS_ILLUMINANTS["D65"].wavelengths, colour.SDS_ILLUMINANTS["D65"].values)
    table = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    observer = np.stack([np.interp(bands, table.wavelengths, column) for column in table.values.T], axis=-1)
    xyz = np.trapezoid(reflectance[..., None] * (d65[:, None] * observer), bands, axis=2)
    xyz /= np.trapezoid(d65 * observer[:, 1], bands)
    linear = np.where(codes / 255 <= 0.04045, codes / 255 / 12.92, ((codes / 255 + 0.055) / 1.055) ** 2.4)
    expected = linear @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T
    # the model of Mitsuba is a table of fits; ΔE of a per cent of white
    np.testing.assert_allclose(xyz[1::3, 1::4][:2, :2], expected, atol=0.01)
    np.testing.assert_allclose(xyz[1, 5], expected[0, 1], rtol=3e-3)  # grey


def test_exr_pictures_and_spectral_exr_cubes_are_read(tmp_path):
    values, wavelength = cube_file(tmp_path / "cube.npy")
    channels = {f"T.{w:.6f}nm".replace(".", ",").replace("T,", "T."): values[..., k] for k, w in enumerate(wavelength)}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    OpenEXR.File(header, planes).write(str(tmp_path / "cube.exr"))
    cube = read_cube(tmp_path / "cube.exr")
    np.testing.assert_array_equal(cube.values, values)
    np.testing.assert_array_equal(cube.wavelength_nm, wavelength)
    colours = {name: np.ascontiguousarray(values[..., k]) for k, name in enumerate("RGB")}
    OpenEXR.File(header, colours).write(str(tmp_path / "picture.exr"))
    picture = read_cube(tmp_path / "picture.exr")
    assert picture.wavelength_nm is None
    np.testing.assert_array_equal(picture.values, values[..., :3])
    OpenEXR.File(header, {"Y": planes["T.400,000000nm"]}).write(str(tmp_path / "grey.exr"))
    with pytest.raises(SpecError, match=r"grey\.exr: expected channels T\.550,0nm … .*R, G, B.; found Y"):
        read_cube(tmp_path / "grey.exr")
    # a spectral file may show its picture in R, G, B besides
    OpenEXR.File(header, {**planes, **colours}).write(str(tmp_path / "both.exr"))
    np.testing.assert_array_equal(read_cube(tmp_path / "both.exr").values, values)
    OpenEXR.File({**header, "emissiveUnits": "W.m^-2.sr^-1.nm^-1"}, planes).write(str(tmp_path / "light.exr"))
    with pytest.raises(SpecError, match=r"light\.exr: holds radiance, as it says, and a surface needs reflectances"):
        read_cube(tmp_path / "light.exr")


def test_exr_pictures_that_do_not_fit_into_memory_are_refused_before_they_are_read(tmp_path, monkeypatch):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    planes = {name: np.zeros((64, 128), np.float32) for name in "RGB"}
    OpenEXR.File(header, planes).write(str(tmp_path / "large.exr"))
    monkeypatch.setattr("hesim_render.core.guard._machine_bytes", lambda: 2 * 24 * 64 * 128 - 1)
    with pytest.raises(SpecError, match=r"large\.exr: the picture would take 0\.000197 GB"):
        read_cube(tmp_path / "large.exr")


def test_photographs_stand_upright_and_transparent_pictures_are_refused(tmp_path):
    codes = np.zeros((2, 3, 3), np.uint8)
    codes[0, 0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: the first row is the right side
    Image.fromarray(codes).save(tmp_path / "turned.png", exif=exif)
    values = read_cube(tmp_path / "turned.png").values
    assert values.shape == (3, 2, 3) and values[0, 1].tolist() == [1, 1, 1] and values.sum() == 3
    alpha = np.full((2, 3, 4), 255, np.uint8)
    Image.fromarray(alpha, "RGBA").save(tmp_path / "opaque.png")
    assert (read_cube(tmp_path / "opaque.png").values == 1).all()
    alpha[1, 2, 3] = 254
    Image.fromarray(alpha, "RGBA").save(tmp_path / "hole.png")
    with pytest.raises(SpecError, match=r"hole\.png: has transparent parts"):
        read_cube(tmp_path / "hole.png")


WRONG = {
    "missing": ("file: none.png", "no such file: {folder}/none.png"),
    "kind": ("file: notes.txt", "a picture must be one of .png, .jpg"),
    "damaged": ("file: damaged.png", "cannot be read as a picture"),
    "no wavelengths": ("file: cube.npy", "a .npy file needs wavelength_nm beside it"),
    "wavelengths": ("file: card.png, wavelength_nm: [400, 700]", "a .png file takes no wavelength_nm"),
    "planes": ("file: cube.npy, wavelength_nm: [400, 500]", "the cube has 5 planes and wavelength_nm 2 values"),
    "order": ("file: cube.npy, wavelength_nm: [400, 500, 450, 600, 700]", "the wavelengths of a cube must increase"),
    "flat array": (
        "file: flat.npy, wavelength_nm: [400, 500]",
        "expected numbers [row, col, wavelength], found float64",
    ),
    "range": ("file: cube.npy, wavelength_nm: [4, 5, 6, 7, 8], scale: 3", "reflectances must lie in [0, 1]"),
    "scale": ("file: card.png, scale: 2", "scale is for cubes and EXR pictures"),
    "outside": ("file: ../card.png", "lies outside of the scene's folder"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_wrong_picture_is_one_line(mistake, tmp_path, capsys):
    cube_file(tmp_path / "cube.npy")
    np.save(tmp_path / "flat.npy", np.zeros((4, 4)))
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "card.png")
    (tmp_path / "damaged.png").write_bytes((tmp_path / "card.png").read_bytes()[:40])
    (tmp_path / "notes.txt").write_text("no picture")
    content, told = WRONG[mistake]
    (tmp_path / "scene.yaml").write_text(
        f"schema_version: 1\nname: wrong\ndescription: one mistake\ntarget: {{type: image, {content}}}\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {fit: target}\n"
    )
    with pytest.raises(SystemExit) as caught:
        cli.main(["simulate", str(tmp_path / "scene.yaml"), "--sensor", "reference-mono", "--roi", "8x8",
                  "--duration", "0.002", "--out", str(tmp_path / "out")])  # fmt: skip
    lines = capsys.readouterr().err.splitlines()
    assert caught.value.code == 2 and not (tmp_path / "out").exists()
    assert len(lines) == 1 and told.format(folder=tmp_path) in lines[0] and str(tmp_path) in lines[0], lines


def test_the_manifest_has_the_hash_of_a_picture(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "card.png")
    scene = make_scene(target={"type": "image", "file": str(tmp_path / "card.png")}, light=FURNACE, camera=CAMERA)
    manifest = hr.simulate(scene, mono(8, 8), duration_s=0.002).manifest
    assert len(manifest["scene"]["files_sha256"][str(tmp_path / "card.png")]) == 64


def luminance_response(sensor, illuminant="D65"):
    """∫ R S dλ over 683.002 ∫ V S dλ: flux in e⁻/s per cd/m²."""
    table, grid = colour.SDS_ILLUMINANTS[illuminant], np.arange(360, 830.01, 0.25)
    shape = np.interp(grid, table.wavelengths, table.values)
    photopic = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    v = np.interp(grid, photopic.wavelengths, photopic.values)
    # the response ends in steps, which a grid beyond them would make slopes
    low, high = sensor.responses["clear"].support_nm
    inside = (grid >= low) & (grid <= high)
    flux = np.trapezoid((sensor.responses["clear"].at(grid) * shape)[inside], grid[inside])
    return flux / (683.002 * np.trapezoid(v * shape, grid))


def test_the_port_of_a_sphere_is_uniform_and_has_its_luminance():
    sphere = {"type": "integrating-sphere", "luminance_cd_m2": 250, "port_diameter_m": 0.1, "plate_m": 0.1001}
    camera = {"origin_m": [0, 0, 1], "horizontal_fov_deg": 4}
    a, b, source = flux_image(make_scene(target=sphere, light=DARK, camera=camera), mono(), 64)
    image, error = (a + b) / 2, np.abs(a - b) / 2
    expected = 250 * luminance_response(source.sensor)
    np.testing.assert_allclose(image.mean(), expected, rtol=2e-4)  # 3 σ of the rays
    # the spread of 3072 pixels is that of their halves, and no part of the field differs from another
    spread, stated = image.std(), np.sqrt(np.mean(error**2))
    assert spread < 3e-3 * expected and abs(spread / stated - 1) < 0.08  # σ of the ratio 0.018: false alarm 1e-5
    parts = image.reshape(4, 12, 4, 16).mean(axis=(1, 3))
    assert np.abs(parts - image.mean()).max() < 4.6 * stated / np.sqrt(192)  # 16 parts, false alarm 1e-4
    outside = make_scene(target=sphere, light=DARK, camera={"origin_m": [0.2, 0, 1], "target_m": [0.2, 0, 0]})
    a, b, _ = flux_image(outside, mono(8, 8), 4)
    assert not np.any(a + b)


@pytest.mark.parametrize("tilt_deg", [0.0, 60.0])
def test_the_port_is_uniform_to_the_error_of_a_recording(tilt_deg):
    """In the default mode, on the axis and obliquely: the same radiance in all directions."""
    sphere = {"type": "integrating-sphere", "luminance_cd_m2": 250, "port_diameter_m": 0.2, "plate_m": 0.25,
              "rotation_axis": [1, 1, 0], "rotation_deg": tilt_deg}  # fmt: skip
    scene = make_scene(target=sphere, light=DARK, camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": 4})
    sensor = mono(64, 48)
    frame = hr.simulate(scene, sensor, duration_s=0.012, seed=4, audit=False).frames[0]
    expected = 250 * luminance_response(sensor) * frame.exposure_us * 1e-6
    image, stated = frame.electrons_mean / expected, np.sqrt(np.mean(frame.electrons_stderr**2)) / expected
    assert stated < 1e-4 and abs(image.mean() - 1) < 2e-5
    assert abs(image.std() / stated - 1) < 0.08  # σ of the ratio 0.018: false alarm 1e-5
    parts = image.reshape(4, 12, 4, 16).mean(axis=(1, 3))
    assert np.abs(parts - image.mean()).max() < 4.6 * stated / np.sqrt(192)  # 16 parts, false alarm 1e-4


def test_lamps_of_a_grid_blink_on_a_board_in_steady_light():
    target = {"type": "led-grid", "rows": 1, "cols": 1, "pitch_m": 0.04, "diameter_m": 0.039, "luminance_cd_m2": 100,
              "margin_m": 0.02, "waveform": {"type": "pwm", "frequency_hz": 100, "duty": 0.25}}  # fmt: skip
    scene = make_scene(target=target, light={"type": "uniform", "illuminance_lux": 10}, camera=CAMERA)
    from hesim_render.sources.render.exact import RenderedFlux
    from hesim_render.sources.render.renderer import flickering

    source = flickering(scene, lambda part, _: RenderedFlux(part, mono(32, 32), 16, 1))
    response = luminance_response(source.sensor)
    pixel = np.array([16 * 32 + 16, 2], np.uint32)  # a lamp, and the board
    for begin, end, power in ((0, 2000, 4.0), (3000, 9000, 0.0), (0, 10000, 1.0)):
        flux = np.mean([np.array(half) for half in source.mean_flux(pixel, begin, end)], axis=0)
        # the lamp is also a diffuse surface of 5 % in the light of the room
        expected = np.array([100 * power + 0.05 * 10 / np.pi, 0.05 * 10 / np.pi]) * response
        np.testing.assert_allclose(flux, expected, rtol=6e-3)
    both = hr.simulate(scene, mono(8, 8), duration_s=0.01, clean=True).manifest
    assert both["settings"]["render"]["renders"] == 2


def test_a_ramp_is_linear_from_side_to_side():
    radiance = seen({"type": "grey-ramp", "reflectance_min": 0.1, "reflectance_max": 0.9}, [550.0], 24, 32, 64)[..., 0]
    # the camera fits the target's width; columns are means over a 32nd of it
    np.testing.assert_allclose(radiance[1], 0.1 + 0.8 * (np.arange(32) + 0.5) / 32, atol=8e-4)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1"])
def test_pictures_of_8_bits_may_be_stored_in_any_way(mode, tmp_path):
    """Black and white and, where a mode has them, other greys and colours: the same values as in RGB."""
    codes = np.zeros((3, 5, 3), np.uint8)
    codes[1, 2:], codes[2, :3] = 255, 255
    if mode != "1":
        codes[0, 1] = 77
    if mode in ("RGB", "RGBA", "P"):
        codes[2, 4] = (200, 10, 90)
    Image.fromarray(codes).save(tmp_path / "plain.png")
    other = Image.fromarray(codes)
    other = other.quantize(16) if mode == "P" else other.convert(mode)
    assert other.mode == mode
    other.save(tmp_path / "other.png")
    np.testing.assert_array_equal(
        np.broadcast_to(read_cube(tmp_path / "other.png").values, (3, 5, 3)), read_cube(tmp_path / "plain.png").values
    )
    for wrong in ("I;16", "F"):
        Image.fromarray(np.zeros((3, 5), np.uint16 if wrong == "I;16" else np.float32)).save(tmp_path / "wrong.tif")
        with pytest.raises(SpecError):
            read_cube(tmp_path / "wrong.tif")
