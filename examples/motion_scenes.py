"""Write the shipped motion scenes: things that move as they do, each before or among fifty textured parts or more.

fan, pendulum, falling-objects, hand-held, facade-drive, robot-arm, traffic-light, glass-and-metal. Everything is made
by a rule or by a seed, so that another size or speed is one number away.

Run: python examples/motion_scenes.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

#: m s⁻².
GRAVITY = 9.80665
HEAD = "# Written by examples/motion_scenes.py.\n"
PAINTS = range(1, 19)  # the chromatic patches of a ColorChecker


class Plain(yaml.SafeDumper):
    """Writes equal parts in full, without references."""

    def ignore_aliases(self, data):
        return True


def patch(number):
    return {"colorchecker": "ISO 17321-1", "patch": int(number)}


def part(name, shape, size_m, position_m, rng, count=None, axis=None, angle_deg=None):
    """A chequered solid in two paints."""
    first, second = rng.choice(PAINTS, 2, replace=False)
    item = {"name": name, "shape": shape, "size_m": rounded(size_m), "position_m": rounded(position_m)}
    if axis is not None:
        item |= {"rotation_axis": rounded(axis), "rotation_deg": round(float(angle_deg), 3)}
    count = rng.integers(2, 9, 2) if count is None else count
    return item | {"reflectance": patch(first), "pattern": patch(second), "pattern_count": [int(n) for n in count]}


def rounded(values, digits=5):
    return [round(float(value), digits) for value in values]


def tiles(rng, cols, rows, size_m, depth_m, jitter_m=0.0, low_m=0.0):
    """A wall of upright tiles, each with checks of its own, that stand out by chance."""
    found = []
    for row in range(rows):
        for col in range(cols):
            place = [(col - (cols - 1) / 2) * size_m, low_m + (row + 0.5) * size_m, depth_m + jitter_m * rng.random()]
            found.append(part(f"tile-{row}-{col}", "rectangle", [0.97 * size_m, 0.97 * size_m, 0], place, rng))
    return found


def floor(rng, size_m=8.0, name="floor"):
    return part(name, "box", [size_m, 0.02, size_m], [0, -0.01, -size_m / 2 + 2], rng, (32, 32))


def turned(t_us, axis, angle_deg, shift=None):
    frame = {"t_us": int(t_us), "rotation_axis": rounded(axis), "rotation_deg": round(float(angle_deg), 4)}
    return frame if shift is None else frame | {"translation_m": rounded(shift, 6)}


LAMP = {
    "type": "area",
    "illuminant": "LED-B3",
    "illuminance_lux": 1200,
    "position_m": [0.8, 2.6, 1.6],
    "size_m": [0.9, 0.6],
    "plane_point_m": [0, 0.5, 0],
    "plane_normal": [0, 1, 0],
}
SKY = {"type": "uniform", "illuminant": "D65", "illuminance_lux": 250}


def fan(rng):
    """A desk fan at 1200 rpm on a head that swings, before a wall of tiles; the blades are parts of the rotor."""
    hub, blades = [0.0, 0.6, 0.2], 5
    objects = [floor(rng), *tiles(rng, 10, 6, 0.2, -0.5, 0.05)]
    objects += [
        part("stand", "box", [0.05, 0.55, 0.05], [0, 0.275, 0.05], rng, (2, 14)),
        part("head", "box", [0.1, 0.1, 0.16], [0, 0.6, 0.08], rng, (3, 3)),
        part("rotor", "sphere", [0.07] * 3, hub, rng, (8, 4)),
    ]
    motion = [
        {"object": "head", "pivot_m": [0, 0.6, 0.05], "repeat": True,
         "keyframes": [turned(0, (0, 1, 0), -25), turned(2_000_000, (0, 1, 0), 25), turned(4_000_000, (0, 1, 0), -25)]},
        {"object": "rotor", "parent": "head", "pivot_m": hub, "repeat": True,
         "keyframes": [turned(0, (0, 0, 1), 0), turned(50_000, (0, 0, 1), -360)]},
    ]  # fmt: skip
    for k in range(blades):
        about = Rotation.from_euler("z", 360 * k / blades, degrees=True)
        pose = about * Rotation.from_euler("y", 25, degrees=True)
        axis = pose.as_rotvec()
        place = np.array(hub) + about.apply([0, 0.12, 0])
        angle = np.degrees(np.linalg.norm(axis))
        objects.append(part(f"blade-{k}", "box", [0.07, 0.19, 0.004], place, rng, (3, 8), axis, angle))
        motion.append({"object": f"blade-{k}", "parent": "rotor"})
    camera = {"origin_m": [0.1, 0.65, 1.5], "target_m": [0, 0.58, 0], "horizontal_fov_deg": 36}
    return "A desk fan at 1200 rpm whose head swings, before a wall of tiles.", objects, [LAMP, SKY], camera, motion


def pendulum(rng):
    """A bob on a rod of 0.4 m that swings by 30° as a pendulum does (by its equation of motion, not by a sine)."""
    length, pivot, first = 0.4, np.array([0.0, 1.0, 0.1]), np.radians(30)
    steps, speed, dt = [first], 0.0, 1e-4
    while steps[-1] > 0:  # a quarter of the period; the rest follows by symmetry
        speed -= GRAVITY / length * np.sin(steps[-1]) * dt
        steps.append(steps[-1] + speed * dt)
    end = len(steps) - 2 + steps[-2] / (steps[-2] - steps[-1])
    quarter = np.interp(np.linspace(0, end, 101), np.arange(len(steps)), steps)
    swing = np.concatenate([quarter, -quarter[-2::-1]])
    there = np.concatenate([swing, swing[-2::-1]])
    times = np.linspace(0, 4e6 * dt * end, there.size).round()
    frames = [turned(at, (0, 0, 1), np.degrees(value)) for at, value in zip(times, there, strict=True)]
    objects = [
        floor(rng),
        *tiles(rng, 10, 6, 0.2, -0.6, 0.1),
        part("beam", "box", [0.5, 0.04, 0.04], [0, 1.02, 0.1], rng, (12, 2)),
    ]
    middle = pivot - [0, length / 2, 0]
    objects += [
        part("rod", "box", [0.012, length, 0.012], middle, rng, (1, 20)),
        part("bob", "sphere", [0.14] * 3, pivot - [0, length, 0], rng, (10, 6)),
    ]
    motion = [
        {"object": "rod", "pivot_m": rounded(pivot), "repeat": True, "keyframes": frames},
        {"object": "bob", "parent": "rod"},
    ]
    camera = {"origin_m": [0, 0.7, 1.7], "target_m": [0, 0.66, 0], "horizontal_fov_deg": 36}
    return "A pendulum of 0.4 m that swings by 30 degrees.", objects, [LAMP, SKY], camera, motion


def falling_objects(rng):
    """Thirty solids let go from different heights that tumble for 0.6 s."""
    objects, motion = [floor(rng), *tiles(rng, 8, 6, 0.25, -0.9, 0.1)], []
    for k in range(30):
        shape = ["box", "sphere"][k % 2]
        size = [rng.uniform(0.03, 0.09)] * 3 if shape == "sphere" else rng.uniform(0.03, 0.1, 3)
        place = rng.uniform([-0.7, 0.6, -0.6], [0.7, 2.2, 0.3])
        name, axis, rate = f"body-{k}", rng.normal(size=3), rng.uniform(-900, 900)
        objects.append(part(name, shape, size, place, rng))
        times = np.arange(0, 601, 25) * 1e-3
        frames = [turned(1e6 * t, axis, rate * t, [0, -GRAVITY * t * t / 2, 0]) for t in times]
        motion.append({"object": name, "pivot_m": rounded(place), "keyframes": frames})
    camera = {"origin_m": [0, 0.9, 2.2], "target_m": [0, 0.75, -0.2], "horizontal_fov_deg": 40}
    return "Thirty solids that fall and tumble before a wall of tiles.", objects, [LAMP, SKY], camera, motion


def hand_held(rng):
    """A still life seen by a camera in a hand.

    Angles about three axes are sums of sines from 1 to 20 Hz at random phases, whose power falls with the square of the
    frequency; 0.25° rms about each axis in all. The place moves by a millimetre rms in the same way.
    """
    objects = [floor(rng), *tiles(rng, 9, 6, 0.2, -0.8, 0.3)]
    for k in range(12):
        size = rng.uniform(0.08, 0.22)
        place = [rng.uniform(-0.6, 0.6), size / 2, rng.uniform(-0.5, 0.3)]
        objects.append(part(f"thing-{k}", ["box", "sphere"][k % 2], [size] * 3, place, rng))
    frequency = np.arange(1, 21)  # a period of 1 s
    amplitude = np.sqrt(2) / frequency / np.sqrt(np.sum(1.0 / frequency**2))
    phase = rng.uniform(0, 2 * np.pi, (6, frequency.size, 1))
    t = np.arange(0, 1001, 4) * 1e-3
    sway = np.sum(amplitude[:, None] * np.sin(2 * np.pi * frequency[:, None] * t + phase), axis=1)
    turns, shift = np.radians(0.25) * sway[:3].T, 1e-3 * sway[3:].T
    frames = [
        turned(1e6 * at, turn, np.degrees(np.linalg.norm(turn)), move)
        for at, turn, move in zip(t, turns, shift, strict=True)
    ]
    eye = [0.0, 0.6, 1.6]
    motion = [{"object": "camera", "pivot_m": eye, "repeat": True, "keyframes": frames}]
    camera = {"origin_m": eye, "target_m": [0, 0.4, -0.2], "horizontal_fov_deg": 38}
    text = "A still life seen by a camera in a hand: 0.25 degrees rms about each axis, 1 to 20 Hz, power as 1/f^2."
    return text, objects, [LAMP, SKY], camera, motion


def facade_drive(rng):
    """A camera in a car at 50 km/h past the facade of a street, 7 m away, with trees and lamps before it."""
    objects = [part("road", "box", [80, 0.02, 14], [0, -0.01, -3], rng, (400, 70))]
    objects.append(part("front", "box", [80, 12, 0.2], [0, 6, -7.4], rng, (320, 48)))
    for k in range(64):
        row, col = divmod(k, 16)
        size = [1.2, 1.6, 0.1]
        objects.append(part(f"window-{row}-{col}", "box", size, [(col - 7.5) * 2.4, 1.6 + 2.6 * row, -7.25], rng))
    for k in range(10):
        x = (k - 4.5) * 3.7
        objects.append(part(f"post-{k}", "box", [0.12, 3.5, 0.12], [x, 1.75, -4], rng, (1, 24)))
        objects.append(part(f"crown-{k}", "sphere", [1.1] * 3, [x + 1.5, 2.6, -5 - rng.random()], rng, (20, 20)))
    speed = 50 / 3.6
    keys = [
        {"t_us": 0, "translation_m": [-12.0, 0.0, 0.0]},
        {"t_us": 1_700_000, "translation_m": rounded([speed * 1.7 - 12, 0, 0])},
    ]
    bounce = [
        turned(1000 * t, (1, 0, 0), 0.15 * np.sin(2 * np.pi * t / 400), [0, 0.01 * np.sin(2 * np.pi * t / 800), 0])
        for t in range(0, 801, 20)
    ]
    objects.append(part("car", "box", [0.3, 0.2, 0.2], [0, 1.2, 0.6], rng))
    motion = [
        {"object": "car", "keyframes": keys},
        {"object": "camera", "parent": "car", "pivot_m": [0, 1.4, 0], "repeat": True, "keyframes": bounce},
    ]
    camera = {"origin_m": [0, 1.4, 0], "target_m": [0.8, 1.9, -7], "horizontal_fov_deg": 60}
    sun = {
        "type": "directional",
        "illuminant": "D65",
        "illuminance_lux": 20000,
        "direction": [-1, -1.4, -2],
        "plane_normal": [0, 1, 0],
    }
    day = {**SKY, "illuminance_lux": 6000}
    return "A camera in a car at 50 km/h past a facade 7 m away.", objects, [sun, day], camera, motion


def robot_arm(rng):
    """An arm of three links and a gripper that reaches over a table; each link rides on the one before."""
    objects = [floor(rng), *tiles(rng, 9, 5, 0.22, -0.7, 0.1)]
    for k in range(8):
        size = rng.uniform(0.05, 0.1)
        objects.append(
            part(f"cube-{k}", "box", [size] * 3, [rng.uniform(-0.5, 0.5), size / 2, rng.uniform(-0.2, 0.3)], rng)
        )
    joints = {
        "base": ([0, 0.06, -0.1], [0.16, 0.12, 0.16], (0, 1, 0), 70),
        "upper-arm": ([0, 0.3, -0.1], [0.07, 0.4, 0.07], (0, 0, 1), 35),
        "forearm": ([0, 0.65, -0.1], [0.055, 0.34, 0.055], (0, 0, 1), -80),
        "gripper": ([0, 0.87, -0.1], [0.12, 0.1, 0.03], (0, 1, 0), 150),
    }
    motion, before = [], None
    for number, (name, (place, size, axis, reach_deg)) in enumerate(joints.items()):
        objects.append(part(name, "box", size, place, rng, (3, 9)))
        pivot = np.array(place) - [0, size[1] / 2, 0]
        # every joint goes to and fro smoothly in 1 s, each a little later than the one before
        share = np.arange(0, 51) / 50
        angle = reach_deg * (0.5 - 0.5 * np.cos(2 * np.pi * (share - 0.04 * number)))
        frames = [turned(1e6 * at, axis, turn) for at, turn in zip(share, angle, strict=True)]
        track = {"object": name, "pivot_m": rounded(pivot), "repeat": True, "keyframes": frames}
        motion.append(track if before is None else track | {"parent": before})
        before = name
    camera = {"origin_m": [0.5, 0.75, 1.6], "target_m": [0, 0.42, -0.1], "horizontal_fov_deg": 40}
    return "A robot arm of three links and a gripper over a table.", objects, [LAMP, SKY], camera, motion


def traffic_light(rng):
    """An LED traffic light at night, driven by pulses, under a street lamp at the mains, while a car passes."""
    objects = [part("road", "box", [16, 0.02, 12], [0, -0.01, -2], rng, (80, 60)), *tiles(rng, 12, 5, 0.7, -6, 0.2)]
    objects.append(part("pole", "box", [0.1, 2.6, 0.1], [0.6, 1.3, -2], rng, (1, 20)))
    objects.append(
        {
            "name": "housing",
            "shape": "box",
            "size_m": [0.34, 0.95, 0.2],
            "position_m": [0.6, 2.3, -1.9],
            "reflectance": 0.03,
        }
    )
    lamps = (("red", 2.6, 635, 18, 5500, 90), ("amber", 2.3, 592, 16, 0, 90), ("green", 2.0, 525, 35, 0, 90))
    for name, y, peak, width, luminance, duty in lamps:
        glow = {"luminance_cd_m2": luminance, "illuminant": {"peak_nm": peak, "fwhm_nm": width}}
        glow["waveform"] = {"type": "pwm", "frequency_hz": 400, "duty": duty / 100}
        objects.append(
            {
                "name": name,
                "shape": "sphere",
                "size_m": [0.22] * 3,
                "position_m": [0.6, y, -1.83],
                "reflectance": 0.04,
                "emission": glow,
            }
        )
    body = [
        part("car", "box", [1.9, 0.5, 0.8], [0, 0.55, -0.6], rng, (6, 3)),
        part("cabin", "box", [1.0, 0.4, 0.7], [0, 0.98, -0.6], rng, (6, 3)),
    ]
    objects += body
    motion = [
        {
            "object": "car",
            "keyframes": [{"t_us": 0, "translation_m": [-3, 0, 0]}, {"t_us": 600_000, "translation_m": [3, 0, 0]}],
        },
        {"object": "cabin", "parent": "car"},
    ]
    for k in range(2):
        name, place = f"wheel-{k}", [-0.6 + 1.2 * k, 0.28, -0.18]
        objects.append(part(name, "box", [0.5, 0.5, 0.12], place, rng, (5, 5)))
        # 10 m/s on a wheel of 0.28 m: 5.68 turns a second
        spin = [turned(0, (0, 0, 1), 0), turned(round(2e6 * np.pi * 0.28 / 10), (0, 0, 1), -360)]
        motion.append({"object": name, "parent": "car", "pivot_m": place, "repeat": True, "keyframes": spin})
    street = {"type": "point", "illuminant": "HP1", "illuminance_lux": 12, "position_m": [-2, 5, 0.5]}
    street |= {"plane_normal": [0, 1, 0], "waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.6}}
    night = {"type": "uniform", "illuminant": "D65", "illuminance_lux": 0.3}
    camera = {"origin_m": [0, 1.3, 3.2], "target_m": [0, 1.3, -1.9], "horizontal_fov_deg": 44}
    text = "An LED traffic light at night, driven by pulses, a street lamp at 50 Hz, and a car that passes."
    return text, objects, [street, night], camera, motion


def glass_and_metal(rng):
    """Glass, metal and glossy plastic at several depths; a glass ball rolls through, and the camera moves around."""
    objects = [floor(rng), *tiles(rng, 9, 6, 0.2, -0.8, 0.2)]
    kinds = [
        {"type": "dielectric", "int_ior": 1.5},
        {"type": "roughconductor", "material": "Au", "alpha": 0.1},
        {"type": "roughplastic", "alpha": 0.08, "diffuse_reflectance": patch(15)},
        {"type": "conductor", "material": "Al"},
        {"type": "thindielectric", "int_ior": 1.5},
        {"type": "plastic", "diffuse_reflectance": patch(13)},
    ]
    for k in range(12):
        size = rng.uniform(0.1, 0.22)
        place = [-0.66 + 0.12 * k, size / 2, rng.uniform(-0.5, 0.2)]
        item = {
            "name": f"thing-{k}",
            "shape": ["sphere", "box"][(k // 2) % 2],
            "size_m": rounded([size] * 3),
            "position_m": rounded(place),
        }
        objects.append(item | {"material": kinds[k % len(kinds)]})
    radius, way = 0.07, 1.0
    objects.append(
        {
            "name": "ball",
            "shape": "sphere",
            "size_m": [2 * radius] * 3,
            "position_m": [-0.5, radius, 0.4],
            "material": kinds[0],
        }
    )
    roll = [turned(0, (0, 0, 1), 0, [0, 0, 0]), turned(1_000_000, (0, 0, 1), -np.degrees(way / radius), [way, 0, 0])]
    eye = [0.0, 0.5, 1.7]
    motion = [
        {"object": "ball", "pivot_m": [-0.5, radius, 0.4], "keyframes": roll},
        {
            "object": "camera",
            "pivot_m": [0, 0.2, -0.2],
            "keyframes": [turned(0, (0, 1, 0), -8), turned(1_000_000, (0, 1, 0), 8)],
        },
    ]
    camera = {"origin_m": eye, "target_m": [0, 0.2, -0.2], "horizontal_fov_deg": 40}
    return (
        "Glass, metal and plastic at several depths; a glass ball rolls through.",
        objects,
        [LAMP, SKY],
        camera,
        motion,
    )


SCENES = {
    "fan": fan,
    "pendulum": pendulum,
    "falling-objects": falling_objects,
    "hand-held": hand_held,
    "facade-drive": facade_drive,
    "robot-arm": robot_arm,
    "traffic-light": traffic_light,
    "glass-and-metal": glass_and_metal,
}


def content_of(name):
    """The scene file of a name, as text."""
    text, objects, light, camera, motion = SCENES[name](np.random.default_rng(sorted(SCENES).index(name)))
    scene = {"schema_version": 1, "name": name, "description": text, "objects": objects}
    scene |= {"light": light, "camera": camera, "motion": motion}
    return HEAD + yaml.dump(
        scene, Dumper=Plain, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
    )


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    for name in SCENES:
        (Path(sys.argv[1]) / f"{name}.yaml").write_text(content_of(name))
        print(Path(sys.argv[1]) / f"{name}.yaml")
