"""A cube as a source of flux: against Eq. 1 of whole cubes, and against pictures moved by SciPy."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, shift, zoom

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.cube import CubeFlux, CubeOptions
from hesim_render.spectral import spectrum as spectra

BANDS = np.arange(360.0, 831.0, 10.0)
RGGB = "reference-bayer"


def texture(rows, cols, seed=1):
    """Reflectances with blobs of some pixels, each of its own smooth spectrum."""
    rng = np.random.default_rng(seed)
    coarse = zoom(rng.uniform(0.1, 0.9, (rows // 6 + 2, cols // 6 + 2, 4)), (6, 6, 1), order=1)[:rows, :cols]
    basis = np.array([np.interp(BANDS, [360, 480, 600, 830], row) for row in np.eye(4)])
    return (coarse @ basis).astype(np.float32)


def saved(tmp_path, cube):
    np.save(tmp_path / "cube.npy", cube)
    return tmp_path / "cube.npy"


def flux_of(path, sensor, **options):
    given = {"wavelength_nm": BANDS.tolist(), "illuminance_lux": 300.0, **options}
    return CubeFlux(path, sensor, CubeOptions.model_validate(given))


def image(flux, begin=0.0, end=1.0):
    pixels = np.arange(flux.sensor.rows * flux.sensor.cols, dtype=np.uint32)
    return np.array(flux.mean_flux(pixels, begin, end)[0]).reshape(flux.sensor.rows, flux.sensor.cols)


def test_a_still_cube_is_eq_1_of_its_radiance(tmp_path):
    sensor = hr.load_sensor(RGGB).crop(40, 32)
    cube = texture(32, 40)
    grid = np.arange(360.0, 831.0)
    light = spectra.scale_to_lux(spectra.illuminant("D65"), 300).at(grid)
    fine = np.array([np.interp(grid, BANDS, pixel) for pixel in cube.reshape(-1, BANDS.size)])
    electrons = hr.photocurrent((fine * light / np.pi).reshape(32, 40, -1), grid, sensor, 1e6)
    flux = flux_of(saved(tmp_path, cube), sensor, fit="pixel")
    assert flux.is_static
    np.testing.assert_allclose(image(flux), electrons, rtol=2e-4)
    # radiance in its own unit, and scaled to a mean luminance
    radiance = (cube * np.interp(BANDS, grid, light) / np.pi).astype(np.float32)
    path = saved(tmp_path, radiance)
    own = {"quantity": "radiance", "illuminance_lux": None, "fit": "pixel"}
    expected = hr.photocurrent(radiance, BANDS, sensor, 1e6)
    np.testing.assert_allclose(image(flux_of(path, sensor, **own, scale=1.0)), expected, rtol=2e-4)
    np.testing.assert_allclose(image(flux_of(path, sensor, **own, scale=2.5)), 2.5 * expected, rtol=2e-4)
    with pytest.raises(SpecError, match="does not say the unit of its radiance"):
        flux_of(path, sensor, **own)
    # a file of the renderer says it
    hr.write_spectral_exr(tmp_path / "cube.exr", radiance, BANDS)
    with pytest.raises(SpecError, match="holds radiance, as it says"):
        flux_of(tmp_path / "cube.exr", sensor, wavelength_nm=None)
    told = image(flux_of(tmp_path / "cube.exr", sensor, **own, wavelength_nm=None))
    np.testing.assert_allclose(told, expected, rtol=2e-4)
    luminance = 683.002 * np.trapezoid(radiance * spectra.photopic().at(BANDS), BANDS).mean()
    np.testing.assert_allclose(
        image(flux_of(path, sensor, **own, mean_luminance_cd_m2=40.0)), expected * 40 / luminance, rtol=2e-3
    )


def test_cover_and_stretch_frame_the_cube_and_average_texels(tmp_path):
    sensor = hr.load_sensor("reference-mono").crop(20, 16)
    cube = texture(96, 60)
    mono = image(flux_of(saved(tmp_path, cube), hr.load_sensor("reference-mono").crop(60, 96), fit="pixel"))
    # 60 × 96 texels on 20 × 16 pixels: three texels a pixel, 48 rows of the middle
    covered = image(flux_of(tmp_path / "cube.npy", sensor))
    np.testing.assert_allclose(covered, mono[24:72].reshape(16, 3, 20, 3).mean(axis=(1, 3)), rtol=2e-3)
    # stretched: six rows a pixel, of which the average takes three and interpolates between their means
    stretched = image(flux_of(tmp_path / "cube.npy", sensor, fit="stretch"))
    thirds = mono.reshape(32, 3, 20, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(stretched, (thirds[::2] + thirds[1::2]) / 2, rtol=2e-3)


@pytest.mark.filterwarnings("ignore::hesim_render.core.errors.HesimWarning")
def test_an_image_that_pans_is_shifted_and_blurred(tmp_path):
    sensor = hr.load_sensor(RGGB).crop(48, 32)
    path = saved(tmp_path, texture(32, 48))
    still = flux_of(path, sensor, fit="pixel")
    moving = flux_of(path, sensor, fit="pixel", pan_px_per_s=(2000.0, -1000.0))
    assert not moving.is_static
    # at 4 ms by whole pixels, 8 to the right and 4 up; filters stay with the pixels
    planes = [image(flux_of(path, hr.load_sensor(RGGB, {"pixels.R.filter": name, "pixels.G.filter": name,
                                                        "pixels.B.filter": name}).crop(48, 32), fit="pixel"))
              for name in sensor.spec.filters]  # fmt: skip
    shading = sensor.relative_illumination
    moved = np.stack([shift(plane / shading, (-4, 8), order=1) for plane in planes])
    row, col = np.indices((32, 48))
    expected = moved[sensor.layout.filter_index, row, col] * shading
    inner = np.s_[1:27, 9:47]
    np.testing.assert_allclose(image(moving, 4000.0, 4000.0)[inner], expected[inner], rtol=1e-4)
    # over 2 ms: the mean along a path of 4 pixels, by 400 instants
    steps = (np.arange(400) + 0.5) / 400 * 2e-3
    blurred = np.mean([
        np.stack([map_coordinates(plane / shading, [row + 1000 * t, col - 2000 * t], order=1) for plane in planes])
        for t in steps
    ], axis=0)[sensor.layout.filter_index, row, col] * shading  # fmt: skip
    inner = np.s_[1:29, 5:47]
    np.testing.assert_allclose(image(moving, 0.0, 2000.0)[inner], blurred[inner], rtol=5e-3)
    assert abs(image(moving, 0.0, 2000.0)[inner] / image(still)[inner] - 1).max() > 0.02
    # rows with intervals of their own
    begin = np.repeat(np.arange(32.0) * 100, 48)
    own = np.array(moving.mean_flux(np.arange(32 * 48, dtype=np.uint32), begin, begin)[0]).reshape(32, 48)
    np.testing.assert_allclose(own[7], image(moving, 700.0, 700.0)[7], rtol=1e-5)


def test_zoom_and_rotation_turn_about_the_centre(tmp_path):
    sensor = hr.load_sensor("reference-mono").crop(40, 40)
    path = saved(tmp_path, texture(40, 40, 5))
    shading = sensor.relative_illumination
    plain = image(flux_of(path, sensor, fit="pixel")) / shading
    row, col = np.indices((40, 40)) - 19.5
    # in half a second it grows by √2, and turns by 30° clockwise as seen
    flux = flux_of(path, sensor, fit="pixel", zoom_per_s=2.0, rotation_deg_per_s=60.0)
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    x, y = (c * col + s * row) / np.sqrt(2), (c * row - s * col) / np.sqrt(2)
    expected = map_coordinates(plain, [y + 19.5, x + 19.5], order=1, mode="mirror") * shading
    np.testing.assert_allclose(image(flux, 5e5, 5e5), expected, rtol=1e-3)
    # clockwise: what was above the centre comes to its right
    quarter = flux_of(path, sensor, fit="pixel", rotation_deg_per_s=90.0)
    np.testing.assert_allclose(image(quarter, 1e6, 1e6), np.rot90(plain, -1) * shading, rtol=1e-3)


def test_beyond_its_edges_the_image_is_mirrored(tmp_path):
    sensor = hr.load_sensor("reference-mono").crop(24, 16)
    path = saved(tmp_path, texture(16, 24, 6))
    shading = sensor.relative_illumination
    plain = image(flux_of(path, sensor, fit="pixel")) / shading
    moved = image(flux_of(path, sensor, fit="pixel", pan_px_per_s=(1000.0, 0.0)), 30_000.0, 30_000.0) / shading
    wide = np.concatenate([plain[:, ::-1], plain, plain[:, ::-1], plain], axis=1)
    np.testing.assert_allclose(moved, wide[:, 24 - 30 + 48 : 48 - 30 + 48], rtol=1e-4)


def test_recordings_of_cubes_have_frames_and_events(tmp_path, capsys):
    cells = np.random.default_rng(8).choice([0.1, 0.3, 0.9], (12, 16, 1))
    path = saved(tmp_path, np.kron(cells, np.ones((4, 4, BANDS.size))).astype(np.float32))
    sensor = hr.load_sensor("reference-mono").crop(64, 48)
    options = {"wavelength_nm": BANDS.tolist(), "illuminance_lux": 2000, "duration_s": 0.05}
    still = hr.simulate_cube(path, sensor, clean=True, **options)
    moving = hr.simulate_cube(path, sensor, clean=True, pan_px_per_s=(400, 0), **options)
    assert len(still.events) == 0 and len(moving.events) > 500
    flux = flux_of(path, sensor, illuminance_lux=2000.0)
    aps = sensor.spec.aps
    np.testing.assert_allclose(still.frames[0].electrons_mean, image(flux) * aps.exposure_us * 1e-6, rtol=1e-4)
    with pytest.raises(SystemExit) as stop:
        cli.main([
            "simulate", str(path), "--sensor", "gen2", "--roi", "64x48", "--out", str(tmp_path / "rec"), "--set",
            "illuminance_lux=500", "--set", "wavelength_nm=360:830:10", "--set", "pan_px_per_s=[300, 0]", "--set",
            "rotation_deg_per_s=20", "--set", "zoom_per_s=1.1", "--duration", "0.12",
        ])  # fmt: skip
    shown = capsys.readouterr()
    assert stop.value.code == 0 and "cube.npy seen by gen2" in shown.out, shown.err
    recording = hr.Recording.load(tmp_path / "rec")
    assert recording.manifest["settings"]["cube"]["pan_px_per_s"] == [300, 0] and len(recording.frames) >= 1


@pytest.mark.parametrize(("options", "message"), [
    ({"illuminance_lux": None}, "^reflectances need illuminance_lux$"),
    ({"quantity": "radiance"}, "illuminance_lux is for reflectances"),
    ({"mean_luminance_cd_m2": 5}, "mean_luminance_cd_m2 is for radiance"),
    ({"zoom_per_s": 0}, "zoom_per_s"), ({"fit": "crop"}, "fit"), ({"speed": 3}, "speed"),
    ({"wavelength_nm": [400.0, 500.0]}, "48 planes"), ({"scale": 3.0}, r"reflectances must lie in \[0, 1\]"),
])  # fmt: skip
def test_bad_options_are_one_clear_line(tmp_path, options, message):
    path = saved(tmp_path, texture(8, 8))
    given = {"wavelength_nm": BANDS.tolist(), "illuminance_lux": 100, **options}
    with pytest.raises((RangeError, SpecError), match=message) as caught:
        hr.simulate_cube(path, hr.load_sensor("reference-mono").crop(8, 8), duration_s=0.01, **given)
    assert "\n" not in str(caught.value)


def test_a_cube_that_ends_early_holds_only_where_that_is_wanted(tmp_path):
    """Bands of 450 to 650 nm of reflectance 0.2, 0.4 at the red end, held beyond, as in a cube of all wavelengths."""
    short, sensor = np.arange(450.0, 651.0, 10.0), hr.load_sensor(RGGB).crop(12, 8)
    values = np.where(short > 645, 0.4, 0.2).astype(np.float32)
    whole = np.interp(BANDS, short, values).astype(np.float32)
    # bands at 640 and 650 nm are in both grids
    expected = image(flux_of(saved(tmp_path, np.broadcast_to(whole, (8, 12, BANDS.size)).copy()), sensor))
    path = saved(tmp_path, np.broadcast_to(values, (8, 12, short.size)).copy())
    given = {"wavelength_nm": short.tolist()}
    np.testing.assert_allclose(image(flux_of(path, sensor, beyond="hold", **given)), expected, rtol=1e-5)
    with pytest.raises(SpecError, match="or let its ends hold"):
        flux_of(path, sensor, **given)


def test_instants_follow_a_cube_that_turns_zooms_and_moves(tmp_path):
    """px/s at the corner: √(40² + 30²) + 15 · (ln 1.5 + 0.7) of 24 × 18 pixels, and half a pixel between instants."""
    sensor = hr.load_sensor("reference-mono").crop(24, 18)
    moves = {"pan_px_per_s": [40.0, -30.0], "zoom_per_s": 1 / 1.5, "rotation_deg_per_s": -float(np.degrees(0.7))}
    flux = flux_of(saved(tmp_path, texture(18, 24)), sensor, **moves)
    speed = 50 + 15 * (np.log(1.5) + 0.7)
    count = int(np.ceil(0.08 * speed / 0.5))
    times = flux.sample_times_us(20_000, 100_000)
    np.testing.assert_allclose(times, 20_000 + 80_000 * np.arange(1, count) / count)
    still = flux_of(tmp_path / "cube.npy", sensor)
    assert still.sample_times_us(0, 1e6).size == 0 and flux.sample_times_us(0, 100).size == 0
    # pixels in another order, with means of their own intervals
    pixels, begin = np.array([400, 7], np.uint32), np.array([3000.0, 9000.0])
    both = np.array(flux.mean_flux(pixels, begin, begin + 2000.0)[0])
    alone = [np.array(flux.mean_flux(pixels[k : k + 1], begin[k], begin[k] + 2000)[0]).item() for k in range(2)]
    np.testing.assert_allclose(both, alone, rtol=1e-5)
