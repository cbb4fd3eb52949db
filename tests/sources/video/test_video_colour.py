"""From codes to light to electrons, against formulas and colour-science."""

import colour
import numpy as np
import pytest
from isp_images import images, psnr
from rendering import d65_irradiance
from scipy import constants
from videos import srgb_to_linear, yuv_planes

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.isp import DEFAULT, Pipeline, process
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.description import describe
from hesim_render.sources.video import VideoFlux, VideoOptions
from hesim_render.sources.video.colours import ColourTags, to_linear_srgb
from hesim_render.sources.video.inversion import camera_matrix, spectral_matrix, surface_basis, white_flux
from hesim_render.sources.video.linear import Lineariser
from hesim_render.sources.video.picture_layout import PictureFormat
from hesim_render.spectral import transfer
from hesim_render.spectral.spectrum import illuminant

WEIGHTS = {"bt709": (0.2126, 0.0722), "bt601": (0.299, 0.114), "bt2020": (0.2627, 0.0593)}


def linear(planes, shape, **tags):
    given = ColourTags(**{"transfer": "srgb", "primaries": "bt709", "matrix": "rgb", "range": "full", **tags})
    found = Lineariser(shape, given).linear(tuple(planes))
    return np.stack([np.array(plane).reshape(shape.height, shape.width) for plane in found], axis=-1)


def _pq_cd_per_m2(x):
    """SMPTE ST 2084, written out."""
    root = x ** (32 / 2523)
    return 10000 * (np.maximum(root - 3424 / 4096, 0) / (2413 / 128 - 2392 / 128 * root)) ** (16384 / 2610)


def _hlg(x):
    """ITU-R BT.2100-2 table 5, written out; light of the scene, its peak is 1."""
    return np.where(x <= 0.5, x**2 / 3, (np.exp((x - 0.55991073) / 0.17883277) + 0.28466892) / 12)


@pytest.mark.parametrize(
    ("name", "reference", "white"),
    [("pq", lambda x: _pq_cd_per_m2(x) / 203, 0.5807), ("hlg", lambda x: _hlg(x) / _hlg(0.75), 0.75)],
)
def test_high_dynamic_range_transfers_match_their_standards(name, reference, white):
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(transfer.decode(x, name), reference(x), rtol=1e-6, atol=1e-9)
    assert transfer.decode(white, name) == pytest.approx(1, rel=3e-3)
    assert np.all(transfer.decode([-0.2, 0.0], name) == 0)


@pytest.mark.parametrize("name", ["bt2020", "p3", "smpte170m", "bt470bg"])
def test_primaries_match_colour_science(name):
    space = {"bt2020": "ITU-R BT.2020", "p3": "P3-D65", "smpte170m": "SMPTE C", "bt470bg": "ITU-R BT.470 - 625"}[name]
    spaces = colour.RGB_COLOURSPACES
    expected = colour.matrix_RGB_to_RGB(spaces[space], spaces["ITU-R BT.709"], None)
    np.testing.assert_allclose(to_linear_srgb(name), expected, atol=2e-3)
    np.testing.assert_allclose(to_linear_srgb(name).sum(axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("curve", ["srgb", "bt709", "gamma", "linear"])
@pytest.mark.parametrize("layout", ["interleaved", "planar", "grey"])
@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (16, np.uint16), (0, np.float32)])
def test_every_code_becomes_its_light(curve, layout, bits, dtype):
    """All codes, in an odd-sized picture, against the transfer in float64; 2e-6 of white at most."""
    count = 2 ** (bits or 12)
    height, width = count // 64 + 1, 65
    codes = np.resize(np.arange(count), height * width * 3).reshape(height, width, 3)
    value = codes / (count - 1)
    picture = (codes if bits else value).astype(dtype)
    planes = {"interleaved": [picture], "planar": [np.ascontiguousarray(picture[..., k]) for k in range(3)]}
    planes["grey"] = planes["planar"][:1]
    found = linear(planes[layout], PictureFormat(layout, width, height, bits), transfer=curve, gamma=2.4)
    expected = transfer.decode(value, curve, 2.4)[..., : found.shape[2]]
    assert np.abs(found - expected).max() < 2e-6


def test_values_out_of_range():
    """Black stops at 0; whites above 1 stay in linear floating point, and up to 1.25 of other picture values."""
    picture = np.array([[-0.5, 0.0, 1.1, 1.2, 7.0]], np.float32)
    shape = PictureFormat("grey", 5, 1, 0)
    np.testing.assert_allclose(linear([picture], shape, transfer="linear")[0, :, 0], picture[0])
    expected = transfer.decode([0, 0, 1.1, 1.2, 1.25], "srgb")
    np.testing.assert_allclose(linear([picture], shape)[0, :, 0], expected, atol=3e-6)


@pytest.mark.parametrize("matrix", list(WEIGHTS))
@pytest.mark.parametrize(("bits", "full"), [(8, False), (8, True), (10, False), (16, False)])
def test_yuv_matches_its_standard(matrix, bits, full):
    rng = np.random.default_rng(3)
    rgb = rng.uniform(0.05, 0.95, (24, 40, 3))
    planes = np.rint(yuv_planes(rgb, bits, full, WEIGHTS[matrix])).astype(np.uint8 if bits == 8 else np.uint16)
    shape = PictureFormat("yuv", 40, 24, bits)
    found = linear(planes, shape, matrix=matrix, range="full" if full else "limited")
    expected = srgb_to_linear(
        colour.YCbCr_to_RGB(
            np.moveaxis(planes.astype(int), 0, -1), K=WEIGHTS[matrix], in_bits=bits, in_legal=not full, in_int=True
        )
    )
    assert np.abs(found - expected).max() < 3e-6
    # and back to where it came from, within its rounding
    assert np.abs(found - srgb_to_linear(rgb)).max() < 6 / 2**bits


@pytest.mark.parametrize("size", [(40, 24), (41, 25)])
@pytest.mark.parametrize("left", [True, False])
def test_chroma_is_interpolated_from_where_it_was_sampled(size, left):
    """A plane of colour, sampled at the chroma sites of 4:2:0, comes back exactly (but at the picture's edges)."""
    width, height = size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    chroma_x, chroma_y = np.meshgrid(
        np.arange((width + 1) // 2) * 2 + (0 if left else 0.5), np.arange((height + 1) // 2) * 2 + 0.5
    )

    def blue(x, y):
        return 100 + 1.0 * x + 0.5 * y

    planes = [np.full((height, width), 30000), blue(chroma_x, chroma_y) * 256, np.full(chroma_x.shape, 32768)]
    shape = PictureFormat("yuv", width, height, 16, (1, 1), left)
    found = linear(
        [np.rint(p).astype(np.uint16) for p in planes], shape, transfer="linear", matrix="bt709", range="full"
    )
    cb = (blue(x, y) * 256 - 32768) / 65535
    expected = 30000 / 65535 + 1.8556 * cb
    inner = (slice(1, -2), slice(1, -2))
    assert np.abs(found[..., 2] - expected)[inner].max() < 2e-5


# -- from light to electrons


def mosaic_free(picture, sensor_name="reference-bayer", **options):
    """Φ of every colour at every pixel: one sensor per filter, all its pixels behind that filter."""
    height, width = picture.shape[:2]
    full = hr.load_sensor(sensor_name)
    camera = options.pop("camera", Camera.of(describe(full)))
    found = []
    for name in camera.channels:
        same = {f"pixels.{letter}.filter": name for letter in full.spec.pixels}
        sensor = hr.load_sensor(sensor_name, same).crop(width, height)
        flux = VideoFlux(picture[None], sensor, VideoOptions.of(fps=100, transfer="srgb", camera=camera, **options))
        half, _ = flux.mean_flux(np.arange(width * height, dtype=np.uint32), 0, 10_000)
        found.append(np.array(half, dtype=np.float64).reshape(height, width))
    return np.stack(found, axis=-1), camera, full


@pytest.mark.filterwarnings("ignore:.*no pixel has this filter")
@pytest.mark.parametrize("name", ["natural", "checker", "grey", "rgb"])
def test_round_trip_without_a_mosaic(name):
    """Inverse pipeline and the ISP's own description of the camera meet above 80 dB."""
    picture = images()[name][:256, :384].astype(np.float32)
    flux, camera, sensor = mosaic_free(picture)
    strongest = int(np.argmax(1 / np.array(camera.white_balance)))
    white = white_flux(sensor, camera.channels, illuminant("D65"), 1000)[strongest]
    linear_rgb = camera.to_linear(flux / white / camera.white_balance[strongest])
    back = transfer.encode(linear_rgb.astype(np.float32), camera.transfer)
    in_gamut = (camera.from_linear(srgb_to_linear(picture)) >= 0).all(axis=-1)
    assert in_gamut.mean() > 0.95
    assert psnr(back[in_gamut], picture[in_gamut]) > 80


def test_flat_colours_return_through_raw_and_isp():
    """Video → clean RAW → default ISP gives the colours back within the 12-bit RAW's rounding."""
    colours = np.array([(0.8, 0.8, 0.8), (0.6, 0.4, 0.3), (0.3, 0.5, 0.7), (0.5, 0.6, 0.2)])
    picture = np.rint(255 * colours).astype(np.uint8).repeat(32, 0)[None, :, None].repeat(64, 2)
    sensor = hr.load_sensor("reference-bayer", {"aps.read_noise_e": 0}).crop(64, 128)
    full_well, exposure_s = sensor.spec.aps.full_well_e, sensor.spec.aps.exposure_us * 1e-6
    recording = hr.simulate_video(
        picture, sensor, fps=50, transfer="srgb", clean=True, white_e_per_s=full_well / exposure_s, white_filter="green"
    )
    back = process(
        recording.frames[0],
        recording.mosaic,
        Pipeline.of(*[s.step for s in DEFAULT.steps[:-1]], {"step": "encode", "depth": "float"}),
    )
    for k, value in enumerate(np.rint(255 * colours) / 255):
        np.testing.assert_allclose(back[32 * k + 8 : 32 * k + 24, 8:-8].mean(axis=(0, 1)), value, atol=1.5e-3)


@pytest.mark.parametrize("mode", ["matrix", "spectral"])
def test_white_is_a_perfect_diffuser_under_its_lux(mode):
    """Eq. 1 written out: A·G·∫ T λ/(hc) E/π dλ on a flat 400-700 nm response, at 500 lux and f/4."""
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    grid, irradiance = d65_irradiance(500)
    band = (grid >= 400) & (grid <= 700)
    photons = np.trapezoid((irradiance * grid * 1e-9)[band] / np.pi, grid[band]) / (constants.h * constants.c)
    solid_angle = np.pi / (1 + 4 * sensor.lens.f_number**2)
    expected = (sensor.spec.geometry.pitch_um * 1e-6) ** 2 * solid_angle * photons
    picture = np.ones((1, 8, 8), np.float32)
    flux = VideoFlux(picture, sensor, VideoOptions.of(fps=10, transfer="linear", mode=mode, white_lux=500))
    found = np.array(flux.mean_flux(np.arange(64, dtype=np.uint32), 0, 1000)[0])
    np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_white_by_its_electrons():
    sensor = hr.load_sensor("gen2")
    light = illuminant("D65")
    options = VideoOptions.of(fps=10, transfer="linear", white_e_per_s=12345.0, white_filter="green")
    flux = VideoFlux(np.ones((1, 8, 8), np.float32), sensor.crop(8, 8), options)
    names = sensor.layout.filters
    found = flux.filter_matrix.sum(axis=1)
    assert found[names.index("green")] == pytest.approx(12345, rel=1e-6)
    ratios = white_flux(sensor, names, light, 1.0)
    np.testing.assert_allclose(found / 12345, ratios / ratios[names.index("green")], rtol=2e-3)


def test_spectral_mode_gives_colours_that_the_observer_agrees_with():
    """The basis is a reflectance, sums to white, and under D65 has the tristimulus values of its sRGB colours."""
    grid = np.arange(380, 781, 1.0)
    basis = np.array([part.at(grid) for part in surface_basis()])
    assert basis.min() >= 0 and basis.max() <= 1
    np.testing.assert_allclose(basis.sum(axis=0), 1, atol=2e-5)
    light = np.interp(grid, colour.SDS_ILLUMINANTS["D65"].wavelengths, colour.SDS_ILLUMINANTS["D65"].values)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    seen = np.array([np.interp(grid, observer.wavelengths, column) for column in observer.values.T])
    xyz = (basis * light) @ seen.T / (light @ seen[1])
    np.testing.assert_allclose(xyz.T, colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ, atol=2e-3)


def test_spectral_mode_against_measured_surfaces():
    """24 ColorChecker patches through Nikon curves, from their sRGB alone: 3.1 % off on average, 22 % at most (the blue
    of orange, its darkest channel), greys 0.6 %. Metamers differ: that is the limit of any upsampling."""
    from hesim_render.spectral.colorimetry import tristimulus, xyz_to_linear_srgb
    from hesim_render.spectral.spectrum import colorchecker_reflectances, constant, integrate_product, scale_to_lux

    sensor = hr.load_sensor("reference-bayer")
    light, names = illuminant("D65"), sensor.layout.filters
    patches = list(colorchecker_reflectances().values())
    rgb = xyz_to_linear_srgb(tristimulus(light, patches), tristimulus(light, [constant(1.0)])[0])
    irradiance = scale_to_lux(light, 1000)
    exact = np.array(
        [[integrate_product(sensor.responses[n], irradiance, patch) / np.pi for n in names] for patch in patches]
    )
    found = np.clip(rgb, 0, None) @ spectral_matrix(sensor, names, light, 1000).T
    error = np.abs(found / exact - 1)
    assert error.mean() < 0.04 and error.max() < 0.25 and error[18:].max() < 0.01


def test_event_pixels_without_a_colour_see_luma_or_a_spectrum():
    sensor, light = hr.load_sensor("gen2"), illuminant("D65")
    names = sensor.layout.filters
    white = names.index("white")
    level = white_flux(sensor, ["white"], light, 1000)[0]
    luma = camera_matrix(sensor, names, light, 1000)[white]
    np.testing.assert_allclose(luma / level, (0.2126, 0.7152, 0.0722), rtol=1e-9)
    stated = camera_matrix(sensor, names, light, 1000, luma=(1, 1, 2))[white]
    np.testing.assert_allclose(stated / level, (0.25, 0.25, 0.5), rtol=1e-9)
    spectral = camera_matrix(sensor, names, light, 1000, others="spectral")
    np.testing.assert_allclose(spectral[white], spectral_matrix(sensor, ["white"], light, 1000)[0], rtol=1e-12)
    assert spectral[white].sum() == pytest.approx(level, rel=1e-4)
    assert abs(spectral[white] / level - (0.2126, 0.7152, 0.0722)).max() > 0.05  # a luma is no white pixel


def test_a_given_camera_is_undone():
    """Matrix and balance of the H-ESIM paper's code: what Camera.to_linear turns back into the colour."""
    sensor, light = hr.load_sensor("eiger"), illuminant("D65")
    names = sensor.layout.filters
    camera = Camera(
        channels=["red", "green", "blue"], tile="red green\ngreen blue", white_level_dn=1023,
        white_balance=[2.643, 1, 1.764],
        matrix=[[1.1484375, -0.048828125, -0.099609375], [-0.013671875, 1.315429688, -0.30078125],
                [0.037109375, -0.40234375, 1.364257813]],
    )  # fmt: skip
    found = camera_matrix(sensor, names, light, 1000, camera)
    rgb = np.array([0.4, 0.3, 0.2])
    channels = found @ rgb
    white = found.sum(axis=1)
    assert white[1] == pytest.approx(white_flux(sensor, ["green"], light, 1000)[0])
    np.testing.assert_allclose(white[1] / white, (2.643, 1, 1.764), rtol=2e-3)  # its matrix keeps white to 1e-3
    np.testing.assert_allclose(camera.to_linear(channels) / camera.to_linear(white), rgb, rtol=5e-3)
    np.testing.assert_allclose(camera.to_linear(channels)[0] / camera.to_linear(channels)[1], 0.4 / 0.3, rtol=1e-9)


def test_more_colours_than_three_need_the_spectral_mode():
    letters = {"pixels.G.filter": "green", "pixels.B.roles": ["aps"]}
    sensor = hr.load_sensor("gen2", {"pixels.w.roles": ["aps", "evs"], **letters})
    with pytest.raises(RangeError, match="spectral"):
        camera_matrix(sensor, sensor.layout.filters, illuminant("D65"), 1000)
    assert spectral_matrix(sensor, sensor.layout.filters, illuminant("D65"), 1000).shape == (4, 3)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"white_lux": 10, "white_e_per_s": 5, "white_filter": "red"}, "give one of them"),
        ({"white_e_per_s": 5}, "needs white_filter"),
        ({"white_lux": -1}, "white_lux"),
        ({"duty": 1.5}, "duty"),
        ({"mode": "spectral", "camera": None, "fit": "zoom"}, "fit"),
        ({"transfer": "srgb", "gamma": 2.0}, "gamma belongs"),
        ({"colour": "srgb"}, "colour"),
    ],
)
def test_options_are_checked(options, text):
    with pytest.raises(SpecError, match=text):
        VideoOptions.of(**options)


def test_unknown_white_filter():
    options = VideoOptions.of(fps=10, transfer="linear", white_e_per_s=5, white_filter="cyan")
    with pytest.raises(RangeError, match="red, green, blue"):
        VideoFlux(np.ones((1, 8, 8), np.float32), hr.load_sensor("eiger").crop(8, 8), options)
