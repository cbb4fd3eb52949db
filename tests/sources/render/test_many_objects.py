"""Many moving objects: bunches change no value, and the order of the tests does not matter."""

import numpy as np
import pytest
from rendering import make_scene, mono, pair_tracer

from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.transport import many_objects, moving_scene

COLS, ROWS, RAYS = 48, 36, 16
CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
SKY = {"type": "uniform", "illuminance_lux": 800}
WALL = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.3], "reflectance": 0.2}
#: Windows of which some lie close together, so that several share a set of boxes.
STARTS_US = np.array([0.0, 500.0, 1000.0, 6000.0, 12_500.0, 24_000.0])


def swarm(count):
    """Balls, boxes and plates that fly in all directions and turn; some start at the same place."""
    rng = np.random.default_rng(3)
    objects, motion = [WALL], []
    for k in range(count):
        size = rng.uniform(0.01, 0.06, 3)
        shape = ("sphere", "box", "rectangle")[k % 3]
        sizes = {"sphere": [size[0]] * 3, "box": size.tolist(), "rectangle": [size[0], size[1], 0.0]}[shape]
        place = rng.uniform([-0.4, -0.3, -0.2], [0.4, 0.3, 0.3]) if k % 8 else np.zeros(3)
        objects.append(
            {"name": f"one{k}", "shape": shape, "size_m": sizes, "position_m": place.tolist(),
             "reflectance": float(rng.uniform(0.1, 0.9))}
        )  # fmt: skip
        axis, way = rng.normal(size=3).tolist(), rng.normal(size=3) * 0.2
        keys = [
            {"t_us": 0, "translation_m": (-way).tolist(), "rotation_axis": axis, "rotation_deg": 0},
            {"t_us": 25_000, "translation_m": way.tolist(), "rotation_axis": axis, "rotation_deg": 300},
        ]
        motion.append({"object": f"one{k}", "pivot_m": place.tolist(), "keyframes": keys})
    return make_scene(objects=objects, light=SKY, camera=CAMERA, motion=motion)


def traced(scene, controlled=False):
    """All pixels in all windows; boxes hold for few windows, or for the whole run."""
    tracer = pair_tracer(scene, mono(COLS, ROWS))
    pixel = np.tile(tracer.sensor.layout.full_index.ravel(), STARTS_US.size)
    number, windows = np.repeat(np.arange(STARTS_US.size), COLS * ROWS), Windows(STARTS_US, STARTS_US + 400)
    rays, which = np.full(pixel.size, RAYS), np.full(pixel.size, controlled)
    return [tracer.trace(pixel, number, windows, rays, which, span_us=span) for span in (None, (0.0, 25_000.0))]


@pytest.fixture(scope="module")
def usual():
    """Objects, and what is traced with bunches of the usual size."""
    scene = swarm(50)
    return scene, traced(scene)


@pytest.mark.slow
@pytest.mark.parametrize("bunch", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 3)), 1000])
def test_bunches_change_no_bit(bunch, usual, monkeypatch):
    scene, first = usual
    assert many_objects._BUNCH not in (1, 3, 1000)
    monkeypatch.setattr(many_objects, "_BUNCH", bunch)
    for one, other in zip(first, traced(scene), strict=True):
        for name in ("half_a", "half_b", "met"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    # the scene shows what it is meant to: most pixels see objects, and not all rays come near one
    assert 0.2 < first[0].met.mean() < 0.98
    assert np.ptp(first[0].half_a.reshape(STARTS_US.size, -1), axis=0).max() > 0.5 * first[0].half_a.max()


def test_they_are_what_objects_one_by_one_are(monkeypatch):
    """The same kernel arithmetic in another order of operations: float32 rounding, and rays at an edge."""
    scene = swarm(10)
    first = traced(scene)
    monkeypatch.setattr(moving_scene, "_FEW", 1000)
    for one, other in zip(first, traced(scene), strict=True):
        np.testing.assert_array_equal(one.met, other.met)
        off = np.abs(one.half_a - other.half_a) / other.half_a.mean()
        assert np.mean(off > 1e-4) < 1e-3 and off.max() < 2 / RAYS


@pytest.mark.parametrize("dark_first", [False, True])
def test_of_surfaces_at_the_same_place_the_first_object_counts(dark_first, monkeypatch):
    """Two plates in one plane that overlap, in either order along the curve by which bunches are sorted."""
    monkeypatch.setattr(many_objects, "_BUNCH", 2)
    plates = [
        {"name": name, "shape": "rectangle", "size_m": [0.8, 0.4, 0], "position_m": [x, 0, 0], "reflectance": value}
        for name, x, value in (("bright", 0.2, 0.8), ("dark", -0.2, 0.1))
    ]
    if dark_first:
        plates.reverse()
    others = [
        {"name": f"far{k}", "shape": "sphere", "size_m": [0.1] * 3, "position_m": [5.0 + k, 5, 0], "reflectance": 0.5}
        for k in range(4)
    ]
    keys = [{"t_us": 0}, {"t_us": 25_000, "translation_m": [0, 0.01, 0]}]
    motion = [{"object": one["name"], "keyframes": keys} for one in (*plates, *others)]
    scene = make_scene(objects=[WALL, *plates, *others], light=SKY, camera=CAMERA, motion=motion)
    image = traced(scene)[0].half_a.reshape(STARTS_US.size, ROWS, COLS)[0]
    bright, dark, shared = image[ROWS // 2, -2], image[ROWS // 2, 1], image[ROWS // 2, COLS // 2]
    assert bright == pytest.approx(8 * dark, rel=0.01)
    assert shared == pytest.approx(dark if dark_first else bright, rel=0.01)


def test_a_bunch_is_what_lies_together():
    """A grid of 4 × 4 × 4 places in random order: each eight along the curve are a cube of 2 × 2 × 2."""
    places = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    places = np.random.default_rng(1).permutation(places).astype(np.float32)
    order = np.argsort(many_objects._along_a_curve(places[None] * 0.1 - 7), axis=1)[0]
    for eight in places[order].reshape(8, 8, 3):
        np.testing.assert_array_equal(np.ptp(eight, axis=0), 1)
