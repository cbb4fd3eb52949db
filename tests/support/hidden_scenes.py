"""Scenes whose changes are easily missed: things that are small, thin, fast, or there for a moment only.

The camera sees 0.8 m of the plane z = 0, 2 m away; all is diffuse but for the glint.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hesim_render.sources.scene import Scene
from hesim_render.specs.scene import SceneSpec

#: Side of what the camera sees at z = 0, m.
WIDE_M = 0.8
LAMP = {
    "type": "area",
    "illuminance_lux": 1500,
    "position_m": [0.8, 1.6, 1.4],
    "size_m": [0.4, 0.4],
    "plane_normal": [0, 0, 1],
}
SKY = {"type": "uniform", "illuminance_lux": 800}
WALL = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.3], "reflectance": 0.2}


def scene(objects: list[dict], motion: list[dict], light: Any = SKY, **more: Any) -> Scene:
    camera = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
    spec = {"schema_version": 1, "name": "hidden", "description": "", "objects": [WALL, *objects], "light": light}
    return Scene(SceneSpec.model_validate({**spec, "camera": camera, "motion": motion, **more}))


def track(name: str, *keys: tuple[float, list[float]], **more: Any) -> dict:
    frames = [{"t_us": round(t), "translation_m": [float(x) for x in shift]} for t, shift in keys]
    return {"object": name, "keyframes": frames, **more}


def pop_in() -> Scene:
    """Three plates that are in view for 0.7 ms each."""
    objects, motion = [], []
    for k, (begin, x) in enumerate(((3010, -0.2), (9130, 0.05), (16040, 0.2))):
        objects.append(
            {"name": f"plate{k}", "shape": "rectangle", "size_m": [0.12, 0.2, 0], "position_m": [x, 5, 0.1],
             "reflectance": 0.9}
        )  # fmt: skip
        away, there = [0, 0, 0], [0, -5, 0]
        keys = ((0, away), (begin, away), (begin + 1, there), (begin + 700, there), (begin + 701, away))
        motion.append(track(f"plate{k}", *keys))
    return scene(objects, motion)


def thin_rod() -> Scene:
    """A bright rod of 0.1 pixel that sweeps over a dark wall."""
    rod = {"name": "rod", "shape": "box", "size_m": [0.0013, 0.6, 0.0013], "reflectance": 0.95}
    return scene([rod], [track("rod", (0, [-0.2, 0, 0]), (25_000, [0.2, 0, 0]))])


def flakes(count: int, seed: int = 0) -> Scene:
    """Thin leaves that tumble as they fall."""
    rng, objects, motion = np.random.default_rng(seed), [], []
    for k in range(count):
        place = rng.uniform([-0.4, -0.3, -0.1], [0.4, 0.3, 0.3])
        objects.append(
            {"name": f"flake{k}", "shape": "rectangle", "size_m": [0.02, 0.012, 0], "position_m": place.tolist(),
             "reflectance": 0.8}
        )  # fmt: skip
        axis = rng.normal(size=3).tolist()
        keys = [
            {"t_us": 0, "translation_m": [0, 0.05, 0], "rotation_axis": axis, "rotation_deg": 0},
            {"t_us": 25_000, "translation_m": [0, -0.05, 0], "rotation_axis": axis,
             "rotation_deg": float(rng.uniform(200, 700))},
        ]  # fmt: skip
        motion.append({"object": f"flake{k}", "pivot_m": place.tolist(), "keyframes": keys})
    return scene(objects, motion)


def sparks(count: int = 400, seed: int = 1) -> Scene:
    """Small bright balls, a fifth of a pixel and less, that fly in all directions before a dark wall."""
    rng, objects, motion = np.random.default_rng(seed), [], []
    for k in range(count):
        size = float(rng.uniform(0.0005, 0.004))
        place = rng.uniform([-0.4, -0.3, 0], [0.4, 0.3, 0.1])
        objects.append(
            {"name": f"spark{k}", "shape": "sphere", "size_m": [size] * 3, "position_m": place.tolist(),
             "reflectance": 0.98}
        )  # fmt: skip
        way = rng.normal(size=3) * [0.25, 0.25, 0.02]
        motion.append(track(f"spark{k}", (0, (-way / 2).tolist()), (25_000, (way / 2).tolist())))
    wall = {**WALL, "name": "dark", "position_m": [0, 0, -0.29], "reflectance": 0.03}
    return scene([wall, *objects], motion)


def fast_ball() -> Scene:
    """A ball of three pixels that crosses the picture within five ticks."""
    ball = {"name": "ball", "shape": "sphere", "size_m": [0.04] * 3, "position_m": [0, 0.05, 0.1], "reflectance": 0.9}
    far, near = [-0.6, 0, 0], [0.6, 0, 0]
    return scene([ball], [track("ball", (0, far), (9000, far), (15_000, near), (25_000, near))], LAMP)


def crossing() -> Scene:
    """A plate, a ball and a box that cross before and behind each other, with their shadows."""
    objects = [
        {"name": "plate", "shape": "rectangle", "size_m": [0.15, 0.25, 0], "position_m": [0, 0, 0], "reflectance": 0.5},
        {"name": "ball", "shape": "sphere", "size_m": [0.15] * 3, "position_m": [0, 0.05, 0.15], "reflectance": 0.9},
        {"name": "box", "shape": "box", "size_m": [0.1] * 3, "position_m": [0, -0.1, 0.1], "rotation_deg": 30,
         "reflectance": 0.1, "pattern": 0.8, "pattern_count": [4, 4]},
    ]  # fmt: skip
    motion = [
        track("plate", (0, [-0.4, 0, 0]), (25_000, [0.4, 0, 0])),
        track("ball", (0, [0.4, 0, 0]), (25_000, [-0.4, 0.1, 0])),
        track("box", (0, [0.1, 0.35, 0]), (25_000, [-0.1, -0.2, 0])),
    ]
    return scene(objects, motion, LAMP)


def fan() -> Scene:
    """Four blades at 30 turns a second."""
    blades, motion = [], []
    for k in range(4):
        turn = np.pi / 2 * k
        place = [0.14 * np.cos(turn), 0.14 * np.sin(turn), 0.0]
        blades.append(
            {"name": f"blade{k}", "shape": "rectangle", "size_m": [0.2, 0.06, 0], "position_m": place,
             "rotation_axis": [0, 0, 1], "rotation_deg": 90.0 * k, "reflectance": 0.7 if k % 2 else 0.4}
        )  # fmt: skip
        keys = [{"t_us": 0}, {"t_us": 1_000_000, "rotation_axis": [0, 0, 1], "rotation_deg": 360.0 * 30}]
        motion.append({"object": f"blade{k}", "repeat": True, "keyframes": keys})
    return scene(blades, motion)


def vibration(hz: float = 485.0) -> Scene:
    """A striped plate that shakes by half a pixel up and down, faster than it is sampled."""
    plate = {"name": "plate", "shape": "rectangle", "size_m": [0.5, 0.4, 0], "reflectance": 0.1, "pattern": 0.8,
             "pattern_count": [12, 8]}  # fmt: skip
    times = np.arange(0, 201)
    shift = 0.006 * np.sin(2 * np.pi * times / 8)
    keys = [(1e6 / hz / 8 * t, [0, float(y), 0]) for t, y in zip(times, shift, strict=True)]
    return scene([plate], [track("plate", *keys)])


def glint() -> Scene:
    """The highlight of a glossy ball that moves past a small strong lamp."""
    ball = {
        "type": "sphere",
        "to_world": [[0.08, 0, 0, 0], [0, 0.08, 0, 0], [0, 0, 0.08, 0.1], [0, 0, 0, 1]],
        "bsdf": {"type": "roughplastic", "diffuse_reflectance": {"type": "uniform", "value": 0.1}, "alpha": 0.05},
    }
    wall = {
        "type": "rectangle",
        "to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, -0.3], [0, 0, 0, 1]],
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.3}},
    }
    lamp = {
        "type": "rectangle",
        "to_world": [[0.05, 0, 0, 0.5], [0, 0, -0.05, 1.0], [0, 0.05, 0, 1.2], [0, 0, 0, 1]],
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 2.0}},
    }
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 0.003}}
    spec = {
        "schema_version": 1,
        "name": "glint",
        "description": "",
        "mitsuba": {"inline": {"ball": ball, "wall": wall, "lamp": lamp, "sky": sky}},
        "camera": {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62},
        "max_depth": 3,
        "motion": [track("ball", (0, [-0.3, 0, 0]), (25_000, [0.3, 0.05, 0]))],
    }
    return Scene(SceneSpec.model_validate(spec))


def specks(count: int = 24, seed: int = 2) -> Scene:
    """Bright balls of less than a pixel, each there for a tenth of a window, before a camera that pans."""
    rng, objects, motion = np.random.default_rng(seed), [], []
    for k in range(count):
        x, y = rng.uniform([-0.25, -0.2], [0.25, 0.2])
        objects.append(
            {"name": f"speck{k}", "shape": "sphere", "size_m": [0.016] * 3, "position_m": [x, y + 5, 0.05],
             "reflectance": 0.98}
        )  # fmt: skip
        begin = 1250 * (k % 16 + 1) + 250 + 125 * int(rng.integers(8)) + 3
        away, there = [0, 0, 0], [0, -5, 0]
        keys = ((0, away), (begin, away), (begin + 1, there), (begin + 115, there), (begin + 116, away))
        motion.append(track(f"speck{k}", *keys))
    wall = {**WALL, "name": "dark", "position_m": [0, 0, -0.29], "reflectance": 0.03}
    pan = [
        {"t_us": 0, "translation_m": [-0.04, 0, 0], "rotation_axis": [0, 1, 0], "rotation_deg": -1.5},
        {"t_us": 25_000, "translation_m": [0.04, 0.02, 0], "rotation_axis": [0, 1, 0], "rotation_deg": 1.5},
    ]
    motion.append({"object": "camera", "pivot_m": [0, 0, 2], "keyframes": pan})
    return scene([wall, *objects], motion)


SCENES = {
    "specks, camera pans": specks,
    "pop-in plates": pop_in,
    "thin rod": thin_rod,
    "80 flakes": lambda: flakes(80),
    "150 flakes": lambda: flakes(150),
    "400 sparks": sparks,
    "fast ball": fast_ball,
    "glint": glint,
    "crossing": crossing,
    "fan": fan,
    "vibration": vibration,
}
