"""Absolute light of Mitsuba scenes: a level on a plane against closed forms, its stated error, and what it scales."""

import colour
import numpy as np
import pytest
from mitsuba_specfilm import reference_flux
from rendering import make_scene, mono
from scipy import integrate

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render import light_level
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.light_level import WISH, in_absolute_light
from hesim_render.sources.scene import Scene

#: Past the lamps, at the plane's point.
CAMERA = {"origin_m": [-0.8, -0.8, 1.0], "target_m": [0, 0, 0], "horizontal_fov_deg": 2}
TABLE = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]


def even(value):
    return {"type": "uniform", "value": value}


def grey(value):
    return {"type": "diffuse", "reflectance": even(value)}


def lux_of(wavelength_nm, irradiance):
    """683.002 ∫ E V dλ on a grid of 0.25 nm, both linear between their samples."""
    grid = np.arange(360, 830.01, 0.25)
    v = np.interp(grid, TABLE.wavelengths, TABLE.values)
    return 683.002 * np.trapezoid(np.interp(grid, wavelength_nm, irradiance, left=0, right=0) * v, grid)


FLAT_LUX = lux_of([300, 900], [1.0, 1.0])


def lamp(x=0.3, y=0.2, z=1.5, half=0.3, radiance=3.0, **more):
    """A square that shines down."""
    place = [[half, 0, 0, x], [0, -half, 0, y], [0, 0, -half, z], [0, 0, 0, 1]]
    light = {"type": "area", "radiance": radiance if isinstance(radiance, dict) else even(radiance)}
    return {"type": "rectangle", "to_world": place, "bsdf": grey(0.0), "emitter": light, **more}


def form(x=0.3, y=0.2, z=1.5, half=0.3):
    """∫ cos² / d² dA of that square as seen from the origin of the plane z = 0, by quadrature."""
    return integrate.dblquad(lambda b, a: z**2 / (a * a + b * b + z * z) ** 2, x - half, x + half, y - half, y + half)[
        0
    ]


def scene(shapes, level=None, motion=(), depth=2, **mitsuba):
    level = {"illuminance_lux": 1000.0} if level is None else level
    where = {"plane_point_m": (0, 0, 0), "plane_normal": (0, 0, 2)}
    level = where | level
    return make_scene(
        mitsuba={"inline": shapes, **(level | mitsuba)}, camera=CAMERA, motion=list(motion), max_depth=depth
    )


def measured(*args, **keys):
    return in_absolute_light(scene(*args, **keys))[1]


def agree(found, expected, sigmas=4.5):
    """4.5 σ of the stated error, two-sided: false alarm 7e-6 each; of 64 estimates it has 9 % of uncertainty."""
    assert abs(found.measured / expected - 1) < sigmas * found.error + 1e-6
    assert found.radiance_scale == found.level / found.measured


@pytest.mark.parametrize("depth", [2, 5])
def test_an_area_light_over_a_plane(depth):
    # nothing is there that would throw light back; the lamp is not seen by the camera, and shines all the same
    found = measured({"lamp": lamp(), "i": {"type": "path", "hide_emitters": True}}, depth=depth)
    assert found.error < 2 * WISH and found.unit == "lx" and found.level == 1000
    agree(found, 3 * form() * FLAT_LUX)


def test_an_even_sky():
    sky = {"sky": {"type": "constant", "radiance": even(0.7)}}
    agree(measured(sky, {"irradiance_w_m2": 50.0}), np.pi * 0.7 * (830 - 360))
    agree(measured(sky), np.pi * 0.7 * FLAT_LUX)


def test_a_point_light_and_a_beam_have_no_error():
    point = {"lamp": {"type": "point", "position": [0.6, 0, 0.8], "intensity": even(2.0)}}
    found = measured(point)
    np.testing.assert_allclose(found.measured, 2 * 0.8 * FLAT_LUX, rtol=1e-5)
    beam = {"type": "directional", "direction": [0.6, 0, -0.8], "irradiance": even(2.0)}
    np.testing.assert_allclose(measured(point | {"beam": beam}).measured, 2 * 2 * 0.8 * FLAT_LUX, rtol=1e-5)


@pytest.mark.parametrize(
    ("depth", "integrator"), [(2, "path"), (3, "path"), (6, "path"), (6, "volpath"), (2, "direct")]
)
def test_light_that_surfaces_throw_back_counts_as_far_as_paths_go(depth, integrator):
    # in the middle of a hollow ball of radius 2 m is a point light: each bounce lights the wall evenly, ρ times as much
    shell = {"type": "sphere", "radius": 2.0, "flip_normals": True, "bsdf": grey(0.6)}
    shapes = {"shell": shell, "lamp": {"type": "point", "intensity": even(3.0)}}
    shapes["i"] = {"type": integrator} | ({} if integrator == "direct" else {"hide_emitters": True, "rr_depth": 99})
    found = measured(shapes, {"irradiance_w_m2": 1.0}, depth=depth, plane_point_m=(0, 0, -1))
    wall = 3.0 / 2**2
    agree(found, 470 * (3.0 + wall * sum(0.6**k for k in range(1, depth - 1))))


def test_coloured_light_is_weighed_by_v():
    wavelength, radiance = [360, 500, 600, 830], [0.0, 1.0, 0.2, 2.0]
    spectrum = {"type": "irregular", "wavelengths": wavelength, "values": radiance}
    agree(measured({"lamp": lamp(radiance=spectrum)}), form() * lux_of(wavelength, radiance))
    watts = np.trapezoid(np.interp(np.arange(360, 831), wavelength, radiance), np.arange(360, 831))
    agree(measured({"lamp": lamp(radiance=spectrum)}, {"irradiance_w_m2": 3.0}), form() * watts)


@pytest.mark.slow
def test_the_stated_error_is_the_true_one():
    rng = np.random.default_rng(4)
    z = []
    for _ in range(24):
        where = dict(zip("xyz", (*rng.uniform(-1, 1, 2), rng.uniform(0.3, 2)), strict=True))
        found = measured({"lamp": lamp(**where)})
        z.append((found.measured / (3 * form(**where) * FLAT_LUX) - 1) / found.error)
    # 24 values: the mean within 4.5/√24, the standard deviation of 23 degrees of freedom within its 1e-5 quantiles
    assert abs(np.mean(z)) < 0.92
    assert 0.45 < np.std(z, ddof=1) < 1.7


def test_it_is_the_same_every_time_and_follows_the_level():
    first, again = (measured({"lamp": lamp()}) for _ in range(2))
    assert first == again
    twice = measured({"lamp": lamp()}, {"illuminance_lux": 2000.0})
    assert twice.radiance_scale == 2 * first.radiance_scale


def test_a_card_on_the_plane_gives_the_flux_of_that_level_in_every_mode():
    shapes = {"lamp": lamp(), "card": {"type": "rectangle", "bsdf": grey(0.18)}}
    sensor = mono(8, 8)
    given = scene(shapes, depth=2)
    # E at the middle of the small picture is E of the plane's point; E(λ) is flat
    expected = 0.18 / np.pi * 1000 / FLAT_LUX * sensor.responses["clear"].integral()
    pixels = np.arange(64, dtype=np.uint32)
    exact = np.mean([np.array(half) for half in RenderedFlux(given, sensor, 1024).mean_flux(pixels, 0.0, 1.0)])
    np.testing.assert_allclose(exact, expected, rtol=0.005)
    np.testing.assert_allclose(reference_flux(given, sensor, 1024).mosaic()[0].mean(), expected, rtol=0.005)
    recording = hr.simulate(given, sensor, duration_s=0.011, clean=True)
    np.testing.assert_allclose(recording.frames[0].electrons_mean.mean(), expected * 0.01, rtol=0.01)
    settings = recording.manifest["settings"]
    assert settings["mode"] == "change-driven"
    told = settings["light_level"]
    assert told["level"] == 1000 and told["unit"] == "lx" and 0 < told["error"] < 2 * WISH
    assert told["plane_normal"] == (0, 0, 1) or list(told["plane_normal"]) == [0, 0, 1]
    assert recording.manifest["scene"]["spec"]["mitsuba"]["illuminance_lux"] == 1000


@pytest.mark.slow
def test_all_lit_light_counts_once_however_it_flickers():
    lamps = {"one": lamp(), "two": lamp(x=-0.5, radiance=1.0), "off": lamp(y=-0.4, radiance=7.0)}
    waves = {"two": {"type": "pwm", "frequency_hz": 100, "duty": 0.3, "phase_deg": 180}}
    both = 3 * form() + form(x=-0.5)
    found = measured(lamps, unlit=("off",), waveforms=waves)
    agree(found, both * FLAT_LUX)
    agree(measured(lamps, lit=("off",)), 7 * form(y=-0.4) * FLAT_LUX)
    card = {"card": {"type": "rectangle", "bsdf": grey(0.18)}}
    flickers = scene(lamps | card, unlit=("off",), waveforms=waves)
    # over whole periods the flux is that of the time means
    frame = hr.simulate(flickers, mono(8, 8, **{"aps__exposure_us": 20000}), duration_s=0.021, clean=True).frames[0]
    expected = 0.18 / np.pi * 1000 / FLAT_LUX * mono(8, 8).responses["clear"].integral() * 0.02
    np.testing.assert_allclose(frame.electrons_mean.mean(), expected, rtol=0.01)


def test_things_stand_where_they_do_at_the_start():
    roof = {"type": "rectangle", "to_world": np.diag([5, 5, 1, 1]).tolist(), "bsdf": grey(0.0)}
    roof["to_world"][2][3] = 1.0
    away = [{"t_us": 0, "translation_m": (50, 0, 0)}, {"t_us": 1000, "translation_m": (0, 0, 0)}]
    motion = [{"object": "roof", "keyframes": away}]
    agree(measured({"lamp": lamp(), "roof": roof}, motion=motion), 3 * form() * FLAT_LUX)
    with pytest.raises(SpecError, match="no light of the scene reaches the plane"):
        measured({"lamp": lamp(), "roof": roof}, motion=[{"object": "roof", "keyframes": [dict(k) for k in away[1:]] + [
            {"t_us": 2000, "translation_m": (50, 0, 0)}]}])  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"illuminance_lux": 1.0, "irradiance_w_m2": 1.0}, "not both"),
        ({"illuminance_lux": 1.0, "radiance_scale": 2.0}, "radiance_scale.*takes its place"),
        ({"illuminance_lux": 1.0, "plane_point_m": None}, "plane_point_m is required beside a level"),
        ({"irradiance_w_m2": 1.0, "plane_normal": None}, "plane_normal is required beside a level"),
        ({}, "plane_point_m goes with illuminance_lux or irradiance_w_m2"),
        ({"illuminance_lux": 0.0}, "greater than or equal to"),
        ({"illuminance_lux": 1.0, "plane_normal": (0, 0, 0)}, "zero vector"),
    ],
)
def test_levels_that_say_too_little_or_too_much(keys, message):
    where = {"plane_point_m": (0, 0, 0), "plane_normal": (0, 0, 1)}
    with pytest.raises(SpecError, match=message):
        Scene.from_mitsuba({"lamp": lamp()}, camera=CAMERA, **(where | keys))


def test_levels_that_cannot_be_measured(monkeypatch):
    with pytest.raises(SpecError, match=r"mitsuba\.illuminance_lux: no light of the scene reaches the plane"):
        measured({"lamp": lamp()}, plane_normal=(0, 0, -1))
    glass = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.5, "bsdf": {"type": "dielectric"}}
    far = lamp(z=40.0, half=0.001, radiance=1e6, x=0.0, y=0.0)
    monkeypatch.setattr(light_level, "_MOST", 1 << 12)  # it is not found with the full number either, in 15 s
    with pytest.raises(SpecError, match=r"can be measured to .* % only"):
        measured({"lamp": far, "glass": glass}, depth=6)
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    with pytest.raises(SpecError, match="among media; give radiance_scale"):
        measured({"lamp": lamp(), "box": box, "i": {"type": "volpath"}}, depth=None)
