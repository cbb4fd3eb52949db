"""Random scenes by seed, written as scene files: what nobody thought of is in them. No constant was tuned on any.

The camera is 2 m before the plane z = 0, of which it sees 0.8 m. 1 to 20 shapes move, or some of them; they are as
small as a twentieth of a pixel and as large as a third of the picture, and go from a pixel in a second to 25 pixels
in the 12.5 ms of a run. Half of the scenes have diffuse solids under this project's own lights, half are Mitsuba's,
with glass and metal. From seed 3000 on, lights without a closed form shine beside the others.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hesim_render as hr
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.scene import Scene

#: Pixels of the region, and m of the plane z = 0 for one of them.
COLS, ROWS = 40, 32
PIXEL_M = 0.8 / COLS
DURATION_S = 0.0125
DURATION_US = 12_500
SENSORS = {"hybrid": ("eiger", "gen2", "mipi-hybridevs", "reference-mono"), "asynchronous": ("davis346",)}
_TETRAHEDRON = "v 1 1 1\nv 1 -1 -1\nv -1 1 -1\nv -1 -1 1\nf 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
_ILLUMINANTS = ("D65", "A", "FL11", "LED-B3")
#: First seed of scenes with lights of every kind.
MORE_LIGHTS = 3000


@dataclass(frozen=True)
class RandomScene:
    """A scene file and the sensor that looks at it.

    Parameters
    ----------
    text : what kind of scene it is, for reports.
    """

    seed: int
    scene: Scene
    sensor: Sensor
    text: str
    is_asynchronous: bool


def random_scene(seed: int, folder: Path, cols: int = COLS, rows: int = ROWS) -> RandomScene:
    """The scene of a seed, seen by so many pixels; its files are written into a folder."""
    rng = np.random.default_rng([20_240_711, seed])
    kind = "asynchronous" if rng.random() < 0.3 else "hybrid"
    name = str(rng.choice(SENSORS[kind]))
    is_mitsuba = bool(rng.random() < 0.5)
    count = int(np.ceil(20 ** rng.random()))
    content: dict[str, Any] = {"schema_version": 1, "name": f"random {seed}", "description": ""}
    content |= (_foreign if is_mitsuba else _native)(rng, count)
    if seed >= MORE_LIGHTS:
        # numbers of their own, so that older seeds stay as they are
        (_add_to_foreign if is_mitsuba else _add_to_native)(np.random.default_rng([seed, 1]), content, folder)
    content["camera"] = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
    content["motion"] = [_track(rng, f"shape{k}") for k in range(count) if k == 0 or rng.random() < 0.8]
    if rng.random() < 0.2:
        content["motion"].append(_camera_track(rng))
    content["max_depth"] = int(rng.integers(2, 6)) if is_mitsuba or rng.random() < 0.3 else 2
    file = folder / f"random_{seed}.yaml"
    (folder / "tetrahedron.obj").write_text(_TETRAHEDRON)
    file.write_text(json.dumps(content))
    sensor = hr.load_sensor(name)
    sensor = sensor.crop(cols, rows)
    moved = ", ".join(track["object"] for track in content["motion"])
    kind = "Mitsuba" if is_mitsuba else "diffuse"
    text = f"{kind}, {name}, {count} shapes, depth {content['max_depth']}, moving: {moved}"
    flicker = "waveform" in json.dumps(content)
    text += ", flicker" if flicker else ""
    return RandomScene(seed, hr.load_scene(file), sensor, text, kind == "asynchronous")


def small_scene(seed: int, folder: Path) -> RandomScene:
    """The scene of a seed, small enough to be judged in a minute; asynchronous sensors have many more samples."""
    found = random_scene(seed, folder, 24, 20)
    return random_scene(seed, folder, 12, 10) if found.is_asynchronous else found


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def _size_m(rng: np.random.Generator) -> float:
    return _log_uniform(rng, 0.05, 14) * PIXEL_M


def _place(rng: np.random.Generator) -> list[float]:
    return rng.uniform([-0.35, -0.28, -0.15], [0.35, 0.28, 0.4]).tolist()


def _direction(rng: np.random.Generator) -> np.ndarray:
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


# ---- motion -------------------------------------------------------------------------------------------


def _track(rng: np.random.Generator, name: str) -> dict[str, Any]:
    """Straight ahead, to and fro, in turns, or there for a moment only."""
    way = _direction(rng) * [1, 1, 0.3]
    pace_m_per_us = _log_uniform(rng, 1, 2000) * PIXEL_M * 1e-6
    kind = rng.choice(["straight", "to and fro", "turn", "pop"], p=[0.45, 0.2, 0.2, 0.15])
    if kind == "straight":
        whole = way * pace_m_per_us * DURATION_US
        begin, end = -whole * rng.random(), None
        end = begin + whole
        keys = [{"t_us": 0, "translation_m": begin.tolist()}, {"t_us": DURATION_US, "translation_m": end.tolist()}]
        if rng.random() < 0.4:
            turn = {"rotation_axis": _direction(rng).tolist()}
            keys[0] |= {**turn, "rotation_deg": 0.0}
            keys[1] |= {**turn, "rotation_deg": float(rng.uniform(-400, 400))}
        return {"object": name, "keyframes": keys}
    if kind == "to and fro":
        period = int(_log_uniform(rng, 1500, 60_000))
        side = way * min(pace_m_per_us * period / 4, 0.3)
        keys = [(0, 0), (period // 4, 1), (3 * period // 4, -1), (period, 0)]
        frames = [{"t_us": t, "translation_m": (sign * side).tolist()} for t, sign in keys]
        return {"object": name, "repeat": True, "keyframes": frames}
    if kind == "turn":
        period = int(_log_uniform(rng, 25_000, 1_000_000))
        axis = _direction(rng).tolist()
        keys = [{"t_us": 0}, {"t_us": period, "rotation_axis": axis, "rotation_deg": 360.0}]
        pivot = rng.uniform(-0.1, 0.1, 3).tolist()
        return {"object": name, "repeat": True, "pivot_m": pivot, "keyframes": keys}
    begin, stay = int(rng.uniform(500, 10_000)), int(_log_uniform(rng, 200, 3000))
    keys = [(0, 5), (begin, 5), (begin + 1, 0), (begin + stay, 0), (begin + stay + 1, 5)]
    return {"object": name, "keyframes": [{"t_us": t, "translation_m": [0, y, 0]} for t, y in keys]}


def _camera_track(rng: np.random.Generator) -> dict[str, Any]:
    way = (_direction(rng) * _log_uniform(rng, 0.1, 5) * PIXEL_M).tolist()
    turn = float(rng.normal() * 0.3)
    keys = [
        {"t_us": 0, "rotation_axis": [0, 0, 1], "rotation_deg": 0.0},
        {"t_us": DURATION_US, "translation_m": way, "rotation_axis": [0, 0, 1], "rotation_deg": turn},
    ]
    return {"object": "camera", "pivot_m": [0, 0, 2], "keyframes": keys}


def _waveform(rng: np.random.Generator) -> dict[str, Any]:
    if rng.random() < 0.5:
        duty = float(rng.uniform(0.1, 0.9))
        return {"type": "pwm", "frequency_hz": _log_uniform(rng, 80, 3000), "duty": duty}
    depth = float(rng.uniform(0.1, 0.95))
    return {"type": "mains", "frequency_hz": _log_uniform(rng, 40, 400), "depth": depth, "phase_deg": 30.0}


# ---- this project's own scenes ------------------------------------------------------------------------


def _native(rng: np.random.Generator, count: int) -> dict[str, Any]:
    def grey() -> float:
        return float(rng.uniform(0.02, 0.95))

    wall = {
        "name": "wall",
        "shape": "rectangle",
        "size_m": [6, 6, 0],
        "position_m": [0, 0, -0.4],
        "reflectance": grey(),
    }
    objects: list[dict[str, Any]] = [wall]
    for k in range(count):
        shape = str(rng.choice(["sphere", "box", "rectangle", "mesh"], p=[0.3, 0.3, 0.25, 0.15]))
        size = _size_m(rng)
        sizes = [size] * 3 if shape == "sphere" else [size, _size_m(rng), 0.0 if shape == "rectangle" else _size_m(rng)]
        item = {"name": f"shape{k}", "shape": shape, "size_m": sizes, "position_m": _place(rng), "reflectance": grey()}
        item |= {"rotation_axis": _direction(rng).tolist(), "rotation_deg": float(rng.uniform(0, 180))}
        if shape == "mesh":
            item["mesh"] = "tetrahedron.obj"
        elif rng.random() < 0.3:
            item |= {"pattern": grey(), "pattern_count": rng.integers(1, 12, 2).tolist()}
        objects.append(item)
    lights = []
    for _ in range(int(rng.integers(1, 4))):
        kind = str(rng.choice(["uniform", "point", "directional", "area"]))
        light: dict[str, Any] = {
            "type": kind,
            "illuminance_lux": _log_uniform(rng, 150, 5000),
            "illuminant": {"illuminant": str(rng.choice(_ILLUMINANTS))},
        }
        away = rng.uniform([-1.2, -0.5, 0.9], [1.2, 1.8, 1.8])
        if kind in ("point", "area"):
            light["position_m"] = away.tolist()
        if kind == "area":
            light["size_m"] = [_log_uniform(rng, 0.02, 0.8), _log_uniform(rng, 0.02, 0.8)]
        if kind == "directional":
            light["direction"] = (-away).tolist()
        if rng.random() < 0.3:
            light["waveform"] = _waveform(rng)
        lights.append(light)
    return {"objects": objects, "light": lights}


def _add_to_native(rng: np.random.Generator, content: dict[str, Any], folder: Path) -> None:
    """A box that shines."""
    sizes = [_size_m(rng) for _ in range(3)]
    glow = {"luminance_cd_m2": _log_uniform(rng, 20, 2000), "illuminant": str(rng.choice(_ILLUMINANTS))}
    box = {"name": "glow", "shape": "box", "size_m": sizes, "position_m": _place(rng), "reflectance": 0.3}
    content["objects"].append({**box, "emission": glow})


# ---- scenes of Mitsuba's own --------------------------------------------------------------------------


def _spectrum(rng: np.random.Generator, low: float, high: float) -> dict[str, Any]:
    """Smooth, with values between two."""
    if rng.random() < 0.4:
        return {"type": "uniform", "value": float(rng.uniform(low, high))}
    wavelengths = np.linspace(340, 850, 7)
    return {
        "type": "irregular",
        "wavelengths": wavelengths.tolist(),
        "values": rng.uniform(low, high, wavelengths.size).tolist(),
    }


def _material(rng: np.random.Generator) -> dict[str, Any]:
    kinds = ["diffuse", "plastic", "roughplastic", "roughconductor", "conductor", "dielectric", "rough glass"]
    kind = str(rng.choice(kinds, p=[0.35, 0.1, 0.2, 0.15, 0.05, 0.1, 0.05]))
    colour = _spectrum(rng, 0.03, 0.9)
    if rng.random() < 0.3 and kind in ("diffuse", "plastic", "roughplastic"):
        count = float(rng.integers(1, 10))
        colour = {
            "type": "checkerboard",
            "color0": colour,
            "color1": _spectrum(rng, 0.03, 0.9),
            "to_uv": np.diag([count, count, 1, 1]).tolist(),
        }
    alpha = _log_uniform(rng, 0.03, 0.4)
    if kind == "diffuse":
        return {"type": "twosided", "material": {"type": "diffuse", "reflectance": colour}}
    if kind == "plastic":
        return {"type": "twosided", "material": {"type": "plastic", "diffuse_reflectance": colour}}
    if kind == "roughplastic":
        return {"type": "twosided", "material": {"type": kind, "diffuse_reflectance": colour, "alpha": alpha}}
    if kind == "roughconductor":
        return {"type": "twosided", "material": {"type": kind, "material": "none", "alpha": max(alpha, 0.08)}}
    if kind == "conductor":
        return {"type": "twosided", "material": {"type": kind, "material": "Al"}}
    if kind == "dielectric":
        return {"type": kind}
    return {"type": "roughdielectric", "alpha": max(alpha, 0.1)}


def _to_world(rng: np.random.Generator, sizes: np.ndarray, place: list[float]) -> list[list[float]]:
    """Any rotation of a shape of Mitsuba's, whose own size is 2."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix() @ np.diag(sizes / 2)
    matrix[:3, 3] = place
    return matrix.tolist()


def _foreign(rng: np.random.Generator, count: int) -> dict[str, Any]:
    behind = np.diag([3.0, 3.0, 1.0, 1.0])
    behind[2, 3] = -0.4
    wall = {"type": "diffuse", "reflectance": _spectrum(rng, 0.05, 0.8)}
    shapes: dict[str, Any] = {"wall": {"type": "rectangle", "to_world": behind.tolist(), "bsdf": wall}}
    for k in range(count):
        kind = str(rng.choice(["sphere", "cube", "rectangle", "disk", "cylinder"]))
        sizes = np.array([_size_m(rng) for _ in range(3)])
        if kind == "sphere":
            sizes[:] = sizes[0]
        elif kind in ("disk", "cylinder"):
            sizes[1] = sizes[0]  # round ones
        material = _material(rng)
        if kind in ("rectangle", "disk", "cylinder") and material["type"] in ("dielectric", "roughdielectric"):
            material = {"type": "twosided", "material": {"type": "diffuse"}}  # nothing has an inside there
        shapes[f"shape{k}"] = {"type": kind, "to_world": _to_world(rng, sizes, _place(rng)), "bsdf": material}
    waveforms = {}
    for k in range(int(rng.integers(1, 4))):
        name, lamp = f"lamp{k}", _lamp(rng)
        shapes[name] = lamp
        if rng.random() < 0.3:
            waveforms[name] = _waveform(rng)
    if rng.random() < 0.5:
        shapes["sky"] = {"type": "constant", "radiance": {"type": "uniform", "value": _log_uniform(rng, 2e-4, 5e-3)}}
    return {"mitsuba": {"inline": shapes, "waveforms": waveforms}}


def _add_to_foreign(rng: np.random.Generator, content: dict[str, Any], folder: Path) -> None:
    """A spot, a block that shines, a checked disk that shines, a map of the sky, or several of them."""
    from PIL import Image

    shapes = content["mitsuba"]["inline"]
    which = rng.random(4) < 0.45
    if which[3]:
        Image.fromarray(rng.integers(5, 250, (6, 12, 3), dtype=np.uint8)).save(folder / "map.png")
        level = _log_uniform(rng, 1e-3, 0.02)
        shapes["sky"] = {"type": "envmap", "filename": str(folder / "map.png"), "scale": level}
    if which[0] or not which.any():
        place = rng.uniform([-1.2, -0.4, 1.0], [1.2, 1.8, 1.8])
        towards = -place / np.linalg.norm(place)
        across = np.cross([0.0, 1.0, 0.0], towards)
        across /= np.linalg.norm(across)
        matrix = np.eye(4)
        matrix[:3] = np.stack([across, np.cross(towards, across), towards, place], axis=1)
        level = _log_uniform(rng, 1e-3, 0.03) * float(place @ place)
        light = {"to_world": matrix.tolist(), "intensity": {"type": "uniform", "value": level}}
        shapes["spot"] = {"type": "spot", **light, "cutoff_angle": float(rng.uniform(4, 30))}
    for kind, is_there in (("cube", which[1]), ("disk", which[2])):
        if is_there:
            own = _to_world(rng, np.array([_size_m(rng) for _ in range(3)]), _place(rng))
            radiance = {"type": "uniform", "value": _log_uniform(rng, 3e-4, 0.03)}
            if kind == "disk":
                radiance = {"type": "checkerboard", "color0": radiance, "color1": {"type": "uniform", "value": 1e-4}}
            shapes[f"glow-{kind}"] = {"type": kind, "to_world": own, "emitter": {"type": "area", "radiance": radiance}}


def _lamp(rng: np.random.Generator) -> dict[str, Any]:
    """One that gives 1 to 30 mW m⁻² nm⁻¹ about the origin: of daylight's colour that would be 100 to 3000 lux."""
    place = rng.uniform([-1.2, -0.4, 1.0], [1.2, 1.8, 1.8])
    level = _log_uniform(rng, 1e-3, 0.03)
    square = float(place @ place)
    kind = str(rng.choice(["rectangle", "sphere", "point"]))
    bright = _spectrum(rng, 0.5, 1.5)

    def scaled(factor: float) -> dict[str, Any]:
        if bright["type"] == "uniform":
            return {"type": "uniform", "value": bright["value"] * factor}
        return {**bright, "values": [value * factor for value in bright["values"]]}

    if kind == "point":
        return {"type": "point", "position": place.tolist(), "intensity": scaled(level * square)}
    size = _log_uniform(rng, 0.02, 0.4)
    matrix = np.eye(4)
    matrix[:3, 3] = place
    if kind == "sphere":
        matrix[:3, :3] *= size / 2
        radiance = scaled(level * square / (np.pi * size**2 / 4))
    else:
        normal = -place / np.sqrt(square)
        across = np.cross([0.0, 1.0, 0.0], normal)
        across /= np.linalg.norm(across)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = across * size / 2, np.cross(normal, across) * size / 2, normal
        radiance = scaled(level * square / size**2)
    return {"type": kind, "to_world": matrix.tolist(), "emitter": {"type": "area", "radiance": radiance}}
