"""Objects that get extra pilot rays: what is sorted out for a longer period is small in no window of it."""

import numpy as np
import pytest
from rendering import make_scene, mono

from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows

CAMERA = {"origin_m": [0.1, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
PERIOD_US = 64_000


def flight(name, way, turn_deg, until_us=50_000, axis=(0, 1, 0)):
    keys = [
        {"t_us": 0, "translation_m": [-v for v in way], "rotation_axis": list(axis), "rotation_deg": -0.4 * turn_deg},
        {"t_us": until_us, "translation_m": way, "rotation_axis": list(axis), "rotation_deg": 0.6 * turn_deg},
    ]
    return {"object": name, "pivot_m": [0.05, 0, 0], "keyframes": keys}


def plate(name, size, **more):
    return {"name": name, "shape": "rectangle", "size_m": [*size, 0], "reflectance": 0.4, **more}


def zoom_of(objects, motion):
    light = {"type": "uniform", "illuminance_lux": 300}
    scene = make_scene(objects=objects, light=light, camera=CAMERA, motion=motion)
    return ChangeDrivenFlux(scene, mono(320, 240), seed=3)._renderer.zoom


def swarm(rng, count=12):
    objects, motion = [], []
    for k in range(count):
        size = 10 ** rng.uniform(-2.2, -0.2, 3)
        shape = ("sphere", "box", "rectangle")[k % 3]
        dims = {"sphere": [size[0]] * 3, "box": size.tolist(), "rectangle": [size[0], size[1], 0.0]}[shape]
        objects.append({"name": f"o{k}", "shape": shape, "size_m": dims, "reflectance": 0.3,
                        "position_m": rng.uniform(-0.3, 0.3, 3).tolist()})  # fmt: skip
        way, turn = (rng.normal(size=3) * 0.2).tolist(), float(rng.choice([0, 3, 40, 300]))
        motion.append(flight(f"o{k}", way, turn, int(rng.choice([7_000, 30_000, 64_000])), rng.normal(size=3).tolist()))
    return objects, motion


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rides", [False, True])
def test_what_is_called_large_is_small_in_no_window(seed, rides):
    objects, motion = swarm(np.random.default_rng(seed))
    if rides:
        motion.append({**flight("camera", [0.15, 0.02, -0.3], 6.0, 40_000), "object": "camera"})
    zoom = zoom_of(objects, motion)
    rng, called = np.random.default_rng(seed + 50), 0
    for period in (0, 1):
        large = zoom._large(period)
        called += len(large)
        begins = np.sort(rng.uniform(period * PERIOD_US, (period + 1) * PERIOD_US - 900, 150))
        for number in large:
            for begin in begins:
                outline = zoom._outline(number, zoom._groups[number], begin, begin + rng.choice([0.0, 37.0, 900.0]))
                assert outline is None or not outline.is_small
    assert 2 <= called < 22


@pytest.mark.parametrize(("name", "way", "turn"), [("swings", [0.0, 0.0, 0.0], 170.0), ("passes", [0.5, 0, 0], 0.0)])
def test_a_plate_that_is_seen_edge_on_for_a_moment_is_not_large(name, way, turn):
    """One turns, the other goes by the camera, which sees first its left and then its right face."""
    rotation = {} if turn else {"rotation_axis": [0, 1, 0], "rotation_deg": 90}
    zoom = zoom_of([plate(name, (0.9, 0.5), **rotation)], [flight(name, way, turn)])
    assert zoom._large(0) == frozenset()
    still = zoom_of([plate(name, (0.9, 0.5))], [flight(name, [0.1, 0.02, 0], 2.0)])
    assert still._large(0) == frozenset({0})


def test_a_vibration_between_the_instants_is_seen():
    """It turns by 88° and back in the millisecond between two of them."""
    keys = [{"t_us": 500 * k, "rotation_axis": [0, 1, 0], "rotation_deg": 88.0 * (k % 2)} for k in range(3)]
    motion = [{"object": "p", "repeat": True, "pivot_m": [0.1, 0, 0], "keyframes": keys}]
    ahead = plate("p", (0.9, 0.5), position_m=[0.1, 0, 0])  # of the camera, which sees its edge at 90°
    assert zoom_of([ahead], motion)._large(0) == frozenset()


@pytest.mark.parametrize("who", ["camera", "p"])
def test_what_becomes_small_from_afar_is_large_before(who):
    """The camera or the plate goes 14 m back in the second period; the other one hardly moves."""
    back = 14.0 if who == "camera" else -14.0
    keys = [{"t_us": t, "translation_m": [0, 0, z]} for t, z in ((0, 0.0), (PERIOD_US, 0.001), (2 * PERIOD_US, back))]
    motion = [{"object": who, "keyframes": keys}]
    if who == "camera":
        motion.append(flight("p", [0.001, 0, 0], 0.0))
    zoom = zoom_of([plate("p", (0.2, 0.16))], motion)
    assert zoom._large(0) == frozenset({0}) and zoom._large(1) == frozenset()


def test_extra_looks_are_those_without_the_short_cut(monkeypatch):
    objects, motion = swarm(np.random.default_rng(8))
    speck = {
        "name": "speck",
        "shape": "sphere",
        "size_m": [0.012] * 3,
        "position_m": [0.05, 0.03, 0],
        "reflectance": 0.6,
    }
    objects, motion = [*objects, speck], [*motion, flight("speck", [0.1, -0.02, 0], 0.0)]
    zoom = zoom_of(objects, motion)
    sensor = zoom._view.sensor
    row, col = np.divmod(sensor.layout.full_index.ravel()[::3].astype(np.int64), sensor.spec.geometry.cols)
    windows = Windows(np.array([1000.0, 30_500.0, 63_900.0]), np.array([1450.0, 31_000.0, 64_100.0]))
    numbers = np.broadcast_to(np.arange(3)[:, None], (3, row.size))
    looks = zoom.sites(row, col, windows, numbers)
    assert sum(map(len, looks)) > 0
    plain = zoom_of(objects, motion)
    monkeypatch.setattr(type(plain), "_large_within", lambda *_: frozenset())
    for ours, all_ in zip(looks, plain.sites(row, col, windows, numbers), strict=True):
        assert len(ours) == len(all_)
        for one, other in zip(ours, all_, strict=True):
            assert (one.rays, one.is_small) == (other.rays, other.is_small)
            np.testing.assert_array_equal(one.place, other.place)


def test_windows_across_periods_take_no_short_cut():
    body = {"name": "card", "shape": "box", "size_m": [0.5, 0.4, 0.3], "position_m": [0, 0, 0], "reflectance": 0.4}
    zoom = zoom_of([body], [flight("card", [0.05, 0.02, 0], 2.0)])
    assert zoom._large_within(10, 900) == frozenset({0})
    assert zoom._large_within(63_900, 64_100) == frozenset()


def test_large_objects_get_looks_where_they_may_gloss_whatever_else_is_in_the_scene():
    """A plastic card, one with holes, and two painted ones; a ball that glows does not move."""
    surfaces = {
        "plastic": {"material": {"type": "roughplastic", "alpha": 0.07}},
        "grey": {"reflectance": 0.2},
        "mask": {"material": {"type": "mask", "opacity": 0.7, "bsdf": {"type": "diffuse"}}},
        "paint": {"reflectance": 0.4, "pattern": 0.1, "pattern_count": [3, 2]},
    }
    places = {"plastic": [-0.2, 0.12, 0], "grey": [0.2, 0.12, 0], "mask": [-0.2, -0.12, 0], "paint": [0.2, -0.12, 0]}
    objects = [
        {"name": name, "shape": "rectangle", "size_m": [0.3, 0.2, 0], "position_m": places[name], **surface}
        for name, surface in surfaces.items()
    ]
    glow = {"luminance_cd_m2": 90}
    ball = {"name": "lamp", "shape": "sphere", "size_m": [0.1] * 3, "position_m": [0, 0, 0.3], "emission": glow}
    zoom = zoom_of([*objects, ball], [flight(name, [0.02, 0.01, 0], 2.0) for name in surfaces])
    names = [group.name for group in zoom._groups]
    assert {names[k] for k in zoom._large_within(10, 900)} == {"grey", "paint"}
    sensor = zoom._view.sensor
    row, col = np.divmod(sensor.layout.full_index.ravel().astype(np.int64), sensor.spec.geometry.cols)
    windows = Windows(np.array([1000.0]), np.array([1450.0]))
    (looks,) = zoom.sites(row, col, windows, np.zeros((1, row.size), np.int64))
    seen = np.concatenate([look.place for look in looks])
    # 400 pixels a metre, and a pixel around: the two cards on the left, and nothing else
    assert np.all(col[seen] - col.min() < 160) and 0.95 < seen.size / (2 * (120 + 3) * (80 + 3)) < 1.05
    assert {look.is_small for look in looks} == {False}
