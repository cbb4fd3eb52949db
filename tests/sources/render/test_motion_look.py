"""Motion and events from geometry alone, against closed forms of a card that moves before a wall."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import rendering
from PIL import Image

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import RangeError
from hesim_render.describe import motion_figures, motion_lines
from hesim_render.sources.render.truth import motion_look as look
from hesim_render.sources.render.truth.chief_rays import SKY, sky_brightness
from hesim_render.sources.render.truth.motion_look import EventForecast, _bursts, _compared, motion_look
from hesim_render.spectral.spectrum import illuminance_lux, illuminant, scale_to_irradiance

#: Reflectances of card and wall, and px of the picture by which the card moves to the right in the run.
CARD, WALL, PATH_PX = 0.12, 0.52, 15.0
DURATION_US = 50_000


def sliding(path_px=PATH_PX):
    """A card of 17×11 px before a wall, in a picture in which a pixel is 10 mm at the card."""
    card = {"name": "card", "shape": "rectangle", "size_m": [0.17, 0.11, 0], "position_m": [-0.08, 0.015, 0.001],
            "reflectance": CARD}  # fmt: skip
    wall = {"name": "wall", "shape": "rectangle", "size_m": [90, 90, 0], "reflectance": WALL}
    track = [{"t_us": 0}, {"t_us": DURATION_US, "translation_m": [0.01 * path_px, 0, 0]}]
    fov = 2 * np.degrees(np.arctan(0.01 * 44 / 2 / 12))
    return rendering.make_scene(
        objects=[card, wall], light=rendering.D65_1000_LUX, motion=[{"object": "card", "keyframes": track}],
        camera={"origin_m": [0, 0, 12], "target_m": [0, 0, 0], "horizontal_fov_deg": fov},
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return motion_look(sliding(), hr.load_sensor("davis346").crop(44, 30), 20_000.0, DURATION_US)


def test_a_sliding_card_gives_the_events_of_its_two_edges(found):
    spec = hr.load_sensor("davis346").spec.evs
    contrast = np.log(WALL / CARD)
    per_edge = np.floor(contrast / spec.contrast_threshold_on) + np.floor(contrast / spec.contrast_threshold_off)
    wanted = PATH_PX * 11 * per_edge
    assert found.events.stride == 1
    assert found.events.mean_hz * DURATION_US * 1e-6 == pytest.approx(wanted, rel=0.12)
    assert found.events.density_hz.sum() * DURATION_US * 1e-6 == pytest.approx(wanted, rel=0.12)
    rows = np.flatnonzero(found.events.density_hz.any(axis=1))
    assert rows.size in (11, 12) and rows.min() in (7, 8)
    speed = PATH_PX / (DURATION_US * 1e-6)
    assert found.speed_px_per_s.max() == pytest.approx(speed, rel=1e-3)
    assert np.count_nonzero(found.speed_px_per_s) == len(found.trails) > 20
    np.testing.assert_allclose(found.trails[:, -1] - found.trails[:, 0], [[PATH_PX, 0]] * len(found.trails), atol=0.01)
    assert found.moving == pytest.approx(17 * 11 / (44 * 30), rel=0.3)
    middle = found.picture[15 - 2, 22 - 8 + 6]  # the card, 6 px on its way
    np.testing.assert_allclose([middle, found.picture[2, 3]], [[CARD] * 3, [WALL] * 3], rtol=0.01)


def test_the_sky_is_as_bright_as_the_light_from_everywhere(tmp_path):
    """Over that of a white card: its part of the level of all lights, in lux."""
    everywhere = {"type": "uniform", "illuminant": "A", "illuminance_lux": 330}
    lamp = {"type": "point", "position_m": [1, 2, 3], "illuminant": "D65", "illuminance_lux": 550}
    in_watts = {"type": "directional", "direction": [0, 0, -1], "illuminant": "E", "irradiance_w_m2": 4.0}
    card = {"name": "card", "shape": "rectangle", "size_m": [0.4, 0.4, 0], "reflectance": CARD}
    camera = {"origin_m": [0, 0, 12], "target_m": [0, 0, 0], "horizontal_fov_deg": 4}
    Image.new("RGB", (4, 2), (90, 90, 90)).save(tmp_path / "sky.png")
    around = {"type": "environment", "file": str(tmp_path / "sky.png"), "illuminance_lux": 200}
    watts_lux = illuminance_lux(scale_to_irradiance(illuminant("E"), 4.0))
    for lights, wanted in (
        ([everywhere], 1),
        ([lamp], 0),
        ([everywhere, lamp], 330 / 880),
        ([lamp, in_watts, everywhere], 330 / (880 + watts_lux)),
        ([lamp, around], 200 / 750),
        ([{"type": "none"}], 0),
    ):
        scene = rendering.make_scene(objects=[card], light=lights, camera=camera)
        assert sky_brightness(scene.spec) == pytest.approx(wanted, rel=1e-6)
    assert sky_brightness(hr.load_scene("cornell-box").spec) == SKY
    scene = rendering.make_scene(objects=[card], light=[everywhere, lamp], camera=camera)
    seen = motion_look(scene, hr.load_sensor("davis346").crop(44, 30), 0.0, DURATION_US)
    np.testing.assert_allclose([seen.picture[15, 22], seen.picture[2, 3]], [[CARD] * 3, [330 / 880] * 3], rtol=0.01)


def test_events_between_two_samples():
    spec = SimpleNamespace(contrast_threshold_on=0.2, contrast_threshold_off=0.3)
    log, level = np.array([0.9, 0.4, 0.1, -0.5]), np.array([0.2, 0.3, 0.1, 0.1])
    counts, after = _compared(spec, log, level, 0)
    assert counts.tolist() == [3, 0, 0, 2]
    np.testing.assert_allclose(after, [0.8, 0.3, 0.1, -0.5])
    for ticks, wanted in ((1, [1, 0, 0, 1]), (2, [2, 0, 0, 2]), (3, [3, 0, 0, 0]), (4, [0, 0, 0, 0])):
        counts, after = _compared(spec, log, level, ticks)
        assert counts.tolist() == wanted
        np.testing.assert_array_equal(after, log)


@pytest.mark.slow
def test_fixed_ticks_give_one_event_a_change_or_none_where_it_is_slow():
    """An edge that takes several ticks to cross a pixel changes it by less than a threshold in each of them."""
    sensor = hr.load_sensor("reference-quiet").crop(44, 30)
    fast = motion_look(sliding(), sensor, 0.0, DURATION_US).events
    # 0.3 px a tick: a third of a pixel changes within one tick, so an edge gives about three events to a pixel
    assert 2 * PATH_PX * 11 < fast.mean_hz * DURATION_US * 1e-6 < 2 * 3.5 * PATH_PX * 11
    slow = motion_look(sliding(0.8), sensor, 0.0, DURATION_US).events
    assert slow.mean_hz == 0  # 0.016 px a tick


@pytest.mark.parametrize(("speed", "ticks"), [(300.0, 2), (90.0, 5), (4_000.0, 1)])
def test_samples_of_pixels_with_ticks_are_whole_ticks_apart(speed, ticks, monkeypatch):
    """As many as the fastest point takes for a third of a pixel, 700 µs each; ln of the light goes on a line, so that
    a pixel has an event at each tick or at none."""
    rows, cols, seen = 6, 9, []
    slope = np.linspace(-6e-4, 5e-4, rows * cols).reshape(rows, cols)  # by µs: -0.42 to 0.35 of a tick
    grid = np.mgrid[:rows, :cols]
    raster = SimpleNamespace(shape=(rows, cols), row=grid[0], col=grid[1])
    monkeypatch.setattr(look.Raster, "of", lambda sensor, name: raster)
    monkeypatch.setattr(look, "_seen", lambda rays, col, row, t_us: seen.append(t_us) or np.exp(3 + slope * t_us))
    spec = SimpleNamespace(
        tick_us=700, reference="previous_sample", contrast_threshold_on=0.2, contrast_threshold_off=0.3
    )
    found = look._events(SimpleNamespace(sensor=None), spec, 60_000, speed)
    assert np.unique(np.diff(seen)).tolist() == [700 * ticks] and seen[0] == 0
    fires = (700 * slope >= 0.2) | (-700 * slope >= 0.3)
    np.testing.assert_allclose(found.density_hz, np.where(fires, 1e6 / 700, 0), rtol=1e-9)
    np.testing.assert_allclose(found.rates_hz, fires.sum() * 1e6 / 700, rtol=1e-9)


def test_bursts_cover_a_short_run_and_are_spread_over_a_long_one():
    begins, count = _bursts(50_000.0, 500.0)
    assert begins.tolist() == [0.0] and count == 100
    begins, count = _bursts(1_000_000.0, 500.0)
    assert (begins.size, count) == (16, 8) and begins[0] == 31_250 - 2_000 and np.ptp(begins) == 1e6 * 15 / 16


def test_figures_in_words_say_what_is_lost(found):
    sensor = hr.load_sensor("davis346", {"evs.readout_max_events_per_s": 5_000.0}).crop(44, 30)
    figures = motion_figures(found, sensor, DURATION_US)
    assert figures["blur_px"] == pytest.approx(300 * sensor.spec.aps.exposure_us * 1e-6, rel=1e-3)
    assert figures["frames"] * 44 * 30 * 13 + figures["events"] * 4.5 == pytest.approx(figures["bytes"])
    moving, events, size = motion_lines(figures, sensor, DURATION_US)
    assert moving == f"{found.moving:.0%} of the picture moves, at up to 300 px/s: 0.6 px in an exposure of 2 ms"
    assert "(the read-out takes 5000/s: EVENTS WILL BE LOST)" in events and "0.05 s" in size
    large = figures | {"speed_px_per_s": 36_437.0, "blur_px": 364.4, "events_per_s": 94_700.0,
                       "busy_events_per_s": 12_340_000.0, "events": 5_040_000.0, "bytes": 2.14e9}  # fmt: skip
    moving, events, size = motion_lines(large, sensor, DURATION_US)
    assert "up to 36400 px/s: 360 px" in moving and "about 95000/s, 90 % of the time below 12 million/s" in events
    assert "has about 2100 MB: 2 frames and 5000000 events" in size
    with pytest.raises(RangeError, match=r"look is 0.06; expected 0 to 0.05 s, within the run"):
        motion_look(sliding(), sensor, 60_000.0, DURATION_US)


@pytest.mark.slow
def test_some_pixels_stand_for_all(found, monkeypatch):
    monkeypatch.setattr("hesim_render.sources.render.truth.motion_look._PIXELS", 350)
    some = motion_look(sliding(), hr.load_sensor("davis346").crop(44, 30), 20_000.0, DURATION_US).events
    assert some.stride == 2 and some.density_hz.shape == (15, 22)
    assert some.mean_hz == pytest.approx(found.events.mean_hz, rel=0.25)


@pytest.mark.slow
def test_the_option_writes_a_picture_and_prints_what_moves(tmp_path, capsys):
    given = ["simulate", "rotating-star", "--sensor", "davis346", "--roi", "44x30", "--look", "0.02", "--json"]
    with pytest.raises(SystemExit) as ended:
        cli.main([*given, "--out", str(tmp_path / "star")])
    told = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0 and told["events_per_s"] > 0 and told["speed_px_per_s"] > 10
    assert told["picture"] == str(tmp_path / "star.png") and not (tmp_path / "star").exists()
    with Image.open(tmp_path / "star.png") as picture:
        assert picture.width > 900 and picture.height > 300
    with pytest.raises(SystemExit) as ended:
        cli.main([*given, "--out", str(tmp_path / "s"), "--framing"])
    assert ended.value.code == 2 and "give one of --framing, --look and --dry-run" in capsys.readouterr().err


def test_the_picture_has_three_colours_and_event_pixels_see_their_mean(monkeypatch):
    """Reflectances at 610, 545 and 465 nm; each pixel is the mean of nine places a third of a pixel apart."""
    values = {610: 0.83, 545: 0.31, 465: 0.12}
    nm = [300, 464, 465, 466, 544, 545, 546, 609, 610, 611, 900]
    wall = {"name": "wall", "shape": "rectangle", "size_m": [90, 90, 0],
            "reflectance": {"wavelength_nm": nm, "value": [values.get(one, 0.5) for one in nm]}}  # fmt: skip
    scene = rendering.make_scene(
        objects=[wall], light=rendering.D65_1000_LUX,
        camera={"origin_m": [0, 0, 12], "target_m": [0, 0, 0], "horizontal_fov_deg": 2},
    )  # fmt: skip
    seen = motion_look(scene, hr.load_sensor("davis346").crop(4, 2), 0.0, 1000)
    np.testing.assert_allclose(seen.picture[1, 2], list(values.values()), rtol=1e-3)
    asked = []

    def brightness(at, nm):
        asked.append(at)
        assert list(nm) == [610, 545, 465, 465]
        bands = np.stack([at.col, 2 * at.col, 6 * at.row, 1000 + 0 * at.row], axis=1)
        return bands / 100

    mean = look._seen(SimpleNamespace(brightness=brightness), np.array([[2.0, 7.0]]), np.array([[3.0, 5.0]]), 17.0)
    np.testing.assert_allclose(mean, [[(3 * 2 + 6 * 3) / 300, (3 * 7 + 6 * 5) / 300]])
    places = np.stack([asked[0].col, asked[0].row]).reshape(2, 9, 2)[:, :, 0] - [[2], [3]]
    assert sorted(np.rint(3 * places.T).tolist()) == [[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]
    np.testing.assert_allclose(3 * places, np.rint(3 * places), atol=1e-12)
    dark = look._seen(SimpleNamespace(brightness=brightness), np.array([[-9.0, 0.0]]), np.array([[3.0, 0.01]]), 17.0)
    np.testing.assert_allclose(dark, [[1e-4, 2e-4]])  # black has a logarithm


def test_the_busy_rate_is_that_of_nine_tenths_of_the_time():
    rates = np.random.default_rng(3).permutation(np.arange(201.0))
    forecast = EventForecast(np.full((3, 4), 2.0), 5, rates)
    assert forecast.mean_hz == pytest.approx(100) and forecast.busy_hz == pytest.approx(180)
