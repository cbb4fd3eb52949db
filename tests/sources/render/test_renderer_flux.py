"""Rendered flux against closed forms, and the promises of `FluxSource`: same seed same bits, exact stillness."""

import colour
import drjit as dr
import numpy as np
import pytest
from rendering import D65_1000_LUX, FURNACE, d65_irradiance, electrons_per_s, flux_image, make_scene, mono
from scipy import stats

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.render.exact import RenderedFlux

WIDE_CARD = {"type": "flat", "width_m": 20, "height_m": 20, "reflectance": {"flat": 0.18}}


def stderr_of_mean(a, b):
    """Standard error of an image's mean from the pixels' two halves (independent pixels)."""
    return np.sqrt(np.sum(((a - b) / 2) ** 2)) / a.size


def test_white_furnace_a_white_sphere_vanishes():
    ball = {"name": "ball", "shape": "sphere", "size_m": (1, 1, 1), "reflectance": {"flat": 1.0}}
    scene = make_scene(objects=[ball], light=FURNACE, camera={"origin_m": (0, 0, 3), "horizontal_fov_deg": 40})
    a, b, source = flux_image(scene, mono(), 16)
    total = source.sensor.responses["clear"].integral()  # L = 1: Φ = ∫ R dλ, sphere and background alike
    np.testing.assert_allclose((a + b) / 2 / total, 1.0, rtol=2e-6)


def test_white_furnace_with_interreflection_is_1_within_its_error():
    # a white ball on a white floor: radiance is 1 everywhere once paths are long enough. Paths end at length 64;
    # the longest are in the narrow gap under the ball, hidden from above.
    ball = {"name": "ball", "shape": "sphere", "size_m": (1, 1, 1), "position_m": (0, 0.7, 0)}
    floor = {"name": "floor", "shape": "box", "size_m": (3, 0.1, 3), "position_m": (0, -0.05, 0)}
    objects = [{**item, "reflectance": {"flat": 1.0}} for item in (ball, floor)]
    scene = make_scene(
        objects=objects, light=FURNACE, max_depth=64, camera={"origin_m": (0, 2.5, 3), "horizontal_fov_deg": 40}
    )
    a, b, source = flux_image(scene, mono(), 64)
    total = source.sensor.responses["clear"].integral()
    mean, error = ((a + b) / 2).mean() / total, stderr_of_mean(a, b) / total
    assert error < 5e-3
    assert abs(mean - 1) < 4.4 * error + 1e-6  # false alarm 1e-5, and float32


def test_flat_field_equals_the_closed_form():
    a, b, source = flux_image(hr.load_scene("flat-field"), mono(), 64)
    grid, irradiance = d65_irradiance(1000)
    transmittance = ((grid >= 400) & (grid <= 700)).astype(float)
    expected = electrons_per_s(0.18 * irradiance / np.pi, grid, transmittance, 5.0, 4.0, 0.0)
    measured = ((a + b) / 2).mean()
    assert stderr_of_mean(a, b) / measured < 1e-4
    np.testing.assert_allclose(measured, expected, rtol=1e-3)
    assert source.is_static and source.slice_edges_us(0, 1e6).size == 0


def test_colorchecker_patches_equal_an_independent_integral():
    cols, rows, samples = 240, 160, 512
    sensor = hr.load_sensor("reference-bayer").crop(cols, rows)
    a, b, _ = flux_image(hr.load_scene("colorchecker"), sensor, samples)
    # thin lens: the 0.279 × 0.186 m chart takes 0.96 of the view
    magnification = 0.96 * min(cols * 0.004 / 279, rows * 0.004 / 186)
    image_mm = 16 * (1 + magnification)
    x = (np.arange(cols) + 0.5 - cols / 2) * 0.004
    y = (np.arange(rows) + 0.5 - rows / 2) * 0.004
    vignetting = (1 + (x[None] ** 2 + y[:, None] ** 2) / image_mm**2) ** -2
    # what each pixel sees: position on the chart, in patches from the top left
    patch_x = (x / magnification / 279 + 0.5) * 6
    patch_y = (y / magnification / 186 + 0.5) * 4
    grid, irradiance = d65_irradiance(1000)
    curves = colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"]
    chart = colour.SDS_COLOURCHECKERS["ISO 17321-1"]
    mosaic = np.array([[0, 1], [1, 2]])[np.arange(rows)[:, None] % 2, np.arange(cols)[None] % 2]
    worst_error = 0.0
    for number, reflectance in enumerate(chart.values()):
        rho = np.interp(grid, reflectance.wavelengths, reflectance.values, left=0, right=0)
        row, col = divmod(number, 6)
        inside = (np.abs(patch_y - row - 0.5) < 0.3)[:, None] & (np.abs(patch_x - col - 0.5) < 0.3)[None]
        for channel in range(3):
            quantum = np.asarray(curves.values)[:, channel] / np.asarray(curves.wavelengths)
            table = 0.6 * quantum / quantum.max()
            transmittance = np.interp(grid, curves.wavelengths, table, left=0, right=0)
            axis = electrons_per_s(rho * irradiance / np.pi, grid, transmittance, 4.0, 4.0, magnification)
            mask = inside & (mosaic == channel)
            measured, expected = ((a + b) / 2)[mask].mean(), (axis * vignetting)[mask].mean()
            error = stderr_of_mean(a[mask], b[mask]) / measured
            worst_error = max(worst_error, error)
            assert abs(measured / expected - 1) < 2e-3, (list(chart)[number], channel)
    assert worst_error < 5e-4


def test_cos4_towards_the_corner():
    changes = {"lens__relative_illumination": "cos4", "lens__focal_length_mm": 4.0}
    sensor = mono(1024, 1024, **changes).crop(32, 32, 0, 0)
    scene = make_scene(target=WIDE_CARD, light=D65_1000_LUX, camera={"origin_m": (0, 0, 0.3)})
    a, b, _ = flux_image(scene, sensor, 64)
    centre_a, centre_b, _ = flux_image(scene, mono(32, 32, **changes), 64)
    offset_mm = (np.arange(32) + 0.5 - 512) * 5e-3
    tangent2 = (offset_mm[None] ** 2 + offset_mm[:, None] ** 2) / 4.0**2
    near_mm = (np.arange(32) + 0.5 - 16) * 5e-3
    near2 = (near_mm[None] ** 2 + near_mm[:, None] ** 2) / 4.0**2
    expected = (np.cos(np.arctan(np.sqrt(tangent2))) ** 4).mean() / (np.cos(np.arctan(np.sqrt(near2))) ** 4).mean()
    assert expected < 0.4
    np.testing.assert_allclose((a + b).mean() / (centre_a + centre_b).mean(), expected, rtol=1e-4)


def test_psf_blurs_an_edge_as_a_gaussian():
    card = {"name": "card", "shape": "rectangle", "size_m": (4, 4, 0), "position_m": (2, 0, 0.0001)}
    scene = make_scene(
        target={**WIDE_CARD, "reflectance": {"flat": 0.0}},
        objects=[{**card, "reflectance": {"flat": 1.0}}],
        light=FURNACE,
        camera={"origin_m": (0, 0, 0.5), "horizontal_fov_deg": 5},
    )
    samples = 1024
    a, b, _ = flux_image(scene, mono(32, 32, lens__psf_fwhm_um=15.0), samples)
    share = (a + b).mean(axis=0) / (a + b)[:, -2:].mean()
    sigma_px = 15 / 5 / (2 * np.sqrt(2 * np.log(2)))
    inside = (np.arange(200) + 0.5) / 200
    expected = stats.norm.cdf((np.arange(32)[:, None] + inside - 16) / sigma_px).mean(axis=1)
    # at most binomial; 5 σ over 32 columns: false alarm 2e-5
    bound = 5 * np.sqrt(expected * (1 - expected) / (samples * 32)) + 1e-5
    assert np.all(np.abs(share - expected) < bound)


def test_halves_are_independent_and_their_difference_is_the_error():
    # a flat field without vignetting: all pixels have the same law, so scatter across pixels is the truth
    a, b, _ = flux_image(hr.load_scene("flat-field"), mono(128, 128), 8)
    count = a.size
    correlation = np.corrcoef(a.ravel(), b.ravel())[0, 1]
    assert abs(correlation) < 4.4 / np.sqrt(count)  # false alarm 1e-5
    true_variance = ((a + b) / 2).var()
    claimed = np.mean(((a - b) / 2) ** 2)
    # ratio of two variances with `count` degrees each; the kurtosis here is below 3 (bounded integrand)
    assert abs(claimed / true_variance - 1) < 4.4 * np.sqrt(4 / count)


def test_error_falls_faster_than_random_sampling():
    errors = []
    for samples in (8, 128):
        a, b, _ = flux_image(hr.load_scene("flat-field"), mono(), samples)
        errors.append(np.sqrt(np.mean((a - b) ** 2)))
    assert errors[1] < errors[0] / 10  # 16 times the samples: a factor of 4 without strata, 15 was seen


def test_same_seed_same_bits_in_any_order_chunk_or_crop():
    scene = hr.load_scene("camera-sweep")
    sensor = hr.load_sensor("eiger").crop(96, 64)
    rng = np.random.default_rng(1)
    count = sensor.rows * sensor.cols
    begin = rng.uniform(0, 5e5, count)
    end = begin + rng.uniform(0, 1e4, count)
    whole = RenderedFlux(scene, sensor, 8, 3)
    expected = [np.array(half) for half in whole.mean_flux(np.arange(count), begin, end)]
    assert np.ptp(expected[0]) > 0
    order = rng.permutation(count)[:2500]
    other = RenderedFlux(scene, sensor, 8, 3, block_rays=1 << 12)
    for source in (whole, other):
        shuffled = source.mean_flux(order, begin[order], end[order])
        for half, reference in zip(shuffled, expected, strict=True):
            np.testing.assert_array_equal(np.array(half), reference[order])
    different = np.array(RenderedFlux(scene, sensor, 8, 4).mean_flux(np.arange(count), begin, end)[0])
    assert np.mean(different != expected[0]) > 0.5


def test_a_crop_repeats_the_full_sensors_random_numbers():
    scene = make_scene(target=WIDE_CARD, light=D65_1000_LUX, camera={"origin_m": (0, 0, 0.3)})
    sensor = hr.load_sensor("eiger")
    large_a, large_b, _ = flux_image(scene, sensor.crop(64, 64, 1600, 1200), 8)
    small_a, small_b, _ = flux_image(scene, sensor.crop(32, 16, 1608, 1220), 8)
    np.testing.assert_allclose(small_a, large_a[20:36, 8:40], rtol=1e-6)
    np.testing.assert_allclose(small_b, large_b[20:36, 8:40], rtol=1e-6)
    assert not np.allclose(small_a, large_a[:16, :32], rtol=1e-6)


MOVING_CARD = {
    "target": {"type": "checkerboard", "width_m": 0.4, "height_m": 0.3},
    "objects": [
        {
            "name": "card",
            "shape": "rectangle",
            "size_m": (0.1, 0.1, 0),
            "position_m": (-0.1, 0, 0.01),
            "reflectance": {"flat": 0.9},
        }
    ],
    "light": {"type": "directional", "illuminance_lux": 1000, "direction": (0.1, -0.2, -1)},
    "camera": {"fit": "target"},
    "motion": [{"object": "card", "keyframes": [{"t_us": 0}, {"t_us": 10_000, "translation_m": (0.2, 0, 0)}]}],
}


def test_object_stands_at_the_pose_of_its_slices_middle():
    scene, sensor = make_scene(**MOVING_CARD), mono()
    source = RenderedFlux(scene, sensor, 64, 1, max_motion_px=2.0)
    edges = source.slice_edges_us(0, 10_000)
    # 0.2 m at z = 0.01 m: the camera stands f·(d/v) away, one pixel is 0.4 m / 64 on the target
    path_px = 0.2 / (0.4 / 64) * (1 / (1 - 0.01 / (16 * 400 / (64 * 5e-3) / 1000)))
    assert edges.size + 1 == int(np.ceil(path_px / 2))
    np.testing.assert_allclose(np.diff(edges), 10_000 / (edges.size + 1))
    begin, end = edges[3], edges[4]
    middle = (begin + end) / 2
    still = {**MOVING_CARD, "motion": []}
    still["objects"] = [{**MOVING_CARD["objects"][0], "position_m": (-0.1 + 0.2 * middle / 10_000, 0, 0.01)}]
    expected, _, _ = flux_image(make_scene(**still), sensor, 64, seed=1)
    for first, last in ((begin, end), (begin + 1, begin + 20), (end - 5, end)):  # any part of the slice: same pose
        half = np.array(source.mean_flux(np.arange(64 * 48), first, last)[0]).reshape(48, 64)
        # equal but for rays that meet an edge within rounding
        assert np.mean(np.abs(half / expected - 1) > 1e-5) < 2e-3
    other = np.array(source.mean_flux(np.arange(64 * 48), edges[8], edges[9])[0]).reshape(48, 64)
    assert np.mean(np.abs(other / expected - 1) > 1e-5) > 0.02


def test_a_static_pixel_of_a_moving_scene_is_exactly_static():
    scene, sensor = make_scene(**MOVING_CARD), mono()
    source = RenderedFlux(scene, sensor, 16, 1)
    edges = np.concatenate([[0], source.slice_edges_us(0, 10_000), [10_000]])
    assert not source.is_static and edges.size > 30
    pixels = np.arange(64 * 48)
    frames = [np.array(source.mean_flux(pixels, edges[k], edges[k + 1])[0]).reshape(48, 64) for k in (0, 7, 20)]
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame[:10], frames[0][:10])  # the card and its shadow never come here
        np.testing.assert_array_equal(frame[42:], frames[0][42:])
        assert np.any(frame[16:32] != frames[0][16:32])


def test_slice_edges_do_not_depend_on_the_interval_asked_for():
    source = RenderedFlux(hr.load_scene("rotating-star"), hr.load_sensor("eiger").crop(128, 96), 2)
    edges = source.slice_edges_us(-50_000, 4_100_000)
    assert edges.size > 1000 and np.all(np.diff(edges) > 0)
    for begin, end in ((0, 100_000), (1_990_000, 2_020_000), (edges[5], edges[9])):
        inside = edges[(edges > begin) & (edges < end)]
        np.testing.assert_allclose(source.slice_edges_us(begin, end), inside, rtol=0, atol=1e-6)
    # a corner of the 0.2 m square, 0.72 of 96 pixels, at 0.141 m from the axis, half a turn per second
    speed = np.pi * 0.72 * 96 / 0.2 * np.hypot(0.1, 0.1) * 1e-6
    assert 0.45 < np.median(np.diff(edges)) * speed <= 0.5 + 1e-9


def test_no_kernel_is_compiled_after_the_first_slices():
    source = RenderedFlux(hr.load_scene("rotating-star"), hr.load_sensor("eiger").crop(64, 48), 8)
    pixels = np.arange(64 * 48)
    edges = np.concatenate([[0], source.slice_edges_us(0, 200_000)])

    def compiled(k):
        dr.kernel_history_clear()
        dr.eval(source.mean_flux(pixels[: pixels.size - 100 * k], edges[k], edges[k + 1]))
        return sum(
            1 for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT and not kernel["cache_hit"]
        )

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        counts = [compiled(k) for k in range(8)]
    assert sum(counts[2:]) == 0, counts


def test_darkness_is_exactly_zero():
    for scene in (hr.load_scene("dark"), hr.load_scene("colorchecker", {"light.illuminance_lux": 0})):
        a, b, source = flux_image(scene, hr.load_sensor("eiger").crop(32, 32), 4)
        assert np.all(a == 0) and np.all(b == 0) and source.is_static


def test_progress_counts_every_ray():
    seen = []
    scene = hr.load_scene("flat-field")
    flux_image(scene, mono(), 16, progress=seen.append, block_rays=1 << 14)
    assert seen[-1] == 64 * 48 * 16 and seen == sorted(seen) and len(seen) == 3


def test_bad_arguments_are_one_clear_error():
    scene, sensor = hr.load_scene("flat-field"), mono()
    for samples in (0, 3, 1 << 30):
        with pytest.raises(RangeError, match="samples"):
            RenderedFlux(scene, sensor, samples)
    source = RenderedFlux(scene, sensor, 2)
    with pytest.raises(RangeError, match="pixel"):
        source.mean_flux(np.array([64 * 48]), 0, 1)
    with pytest.raises(RangeError, match="end_us"):
        source.mean_flux(np.array([0]), 10, 5)
    assert np.array(source.mean_flux(np.array([], dtype=np.uint32), 0, 1)[0]).size == 0


def test_pixels_of_a_list_lie_on_the_full_sensor_and_have_random_numbers_of_their_own():
    sensor = mono(8, 6)
    tracer = RenderedFlux(hr.load_scene("flat-field"), sensor, 4, 7)._tracer
    index, numbers = sensor.layout.full_index.ravel(), []

    def wavelengths(pixel, u):
        numbers.append(u)
        return [500 + 0 * u] * 4

    def drawn(pixel, **more):
        tracer.trace(pixel, 0.0, 1.0, wavelengths, lambda pixel, radiance: [radiance[0]], **more)
        return np.array(numbers[-1]).reshape(pixel.size, 4)

    own = drawn(np.arange(48, dtype=np.uint32))
    np.testing.assert_array_equal(own[[5, 3]], drawn(np.array([5, 3], np.uint32)))
    other = drawn(np.arange(2, dtype=np.uint32), elsewhere=index[[5, 3]])
    assert not np.isin(other, own).any()  # 8 numbers of 24 bits
    np.testing.assert_array_equal(other[:1], drawn(np.array([1], np.uint32), elsewhere=index[[3, 5]]))
    with pytest.raises(RangeError, match="pixel is 2; expected 0 to 1,"):
        drawn(np.array([2], np.uint32), elsewhere=index[[3, 5]])


def test_light_that_does_not_cover_the_response_is_refused():
    narrow = {"light.illuminant": {"flat": 1.0, "band_nm": [450, 700]}}
    with pytest.raises(SpecError, match=r"flat-field.yaml: light.illuminant: .* only .* of filter 'clear'"):
        RenderedFlux(hr.load_scene("flat-field", narrow), mono(), 2)
    with pytest.raises(SpecError, match=r"target \(dark skin"):
        babel = {"target.dataset": "BabelColor Average"}
        wide = hr.load_sensor("reference-mono", {"filters.clear": {"flat": 1, "band_nm": [400, 780]}})
        RenderedFlux(hr.load_scene("colorchecker", babel), wide.crop(32, 32), 2)


def test_sample_times_follow_the_cameras_own_motion():
    """A camera that slides past a flat target at distance d: the image moves v·f′/d, the same everywhere."""
    scene = hr.load_scene(
        "flat-field",
        {
            "camera": {"origin_m": [0, 0, 0.5], "target_m": [0, 0, 0], "focal_length_mm": 16.0},
            "motion": [
                {
                    "object": "camera",
                    "keyframes": [{"t_us": 0}, {"t_us": 100_000, "translation_m": [0.05, 0.0, 0.0]}],
                }
            ],
        },
    )
    flux = RenderedFlux(scene, hr.load_sensor("reference-mono").crop(64, 64), samples=2)
    assert flux.slice_edges_us(0, 100_000).size == 0 and not flux.is_static
    times = flux.sample_times_us(0, 100_000)
    # reference-mono: m = 0, so f′ = 16 mm; 0.05 m at 0.5 m is 1.6 mm on the chip, 320 px of 5 µm
    moved_px = np.diff(np.concatenate([[0], times, [100_000]])) * 320 / 100_000
    assert moved_px.max() <= 0.5 + 1e-9 and moved_px.min() > 0.4
    assert flux.sample_times_us(100_000, 200_000).size == 0  # the last pose is held
