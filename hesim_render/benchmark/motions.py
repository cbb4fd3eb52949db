"""Trajectories of generated scenes: ways of solids and of the camera at a stated speed."""

from typing import Any

import numpy as np

from hesim_render.benchmark.draws import log_uniform
from hesim_render.specs.benchmark import MotionsSpec

#: Longest straight way of a solid, view widths; a longer one is a way to and fro.
_LONGEST_WAY = 0.7
#: Largest way and turn of the camera.
CAMERA_WAY, _CAMERA_TURN_DEG = 0.15, 5.0
CAMERA_Z = 2.0


def _direction(rng: np.random.Generator, depth: float) -> np.ndarray:
    """A unit vector, mostly across the view."""
    way = rng.normal(size=3) * [1, 1, depth]
    return way / np.linalg.norm(way)


def _to_and_fro(way: np.ndarray, speed: float, begin: float) -> list[dict[str, Any]]:
    """Keyframes of a way of both directions about the middle, at constant speed; `begin` is its phase."""
    quarter = max(1, round(1e6 * float(np.linalg.norm(way)) / speed))
    places = (0, 1), (1, 0), (2, -1), (3, 0), (4, 1)
    shift = round(4 * quarter * begin)
    return [{"t_us": k * quarter - shift, "translation_m": (sign * way).round(9).tolist()} for k, sign in places]


def solid_track(rng: np.random.Generator, name: str, speed: float, size: float, duration_us: int) -> dict[str, Any]:
    """The motion of a solid: straight, to and fro, a turn, a turn on its way, or a way with corners.

    Parameters
    ----------
    rng : random numbers.
    name : of the solid.
    speed : of its middle, or of its rim where it turns, view widths per second.
    size : its extent, view widths.
    duration_us : of the clip, µs.
    """
    kind = str(rng.choice(["way", "turn", "both", "corners"], p=[0.4, 0.2, 0.2, 0.2]))
    whole = speed * duration_us / 1e6
    if kind == "turn":
        axis = _direction(rng, 1.0).round(6).tolist()
        period = max(1, round(1e6 * np.pi * size / speed))
        keys = [{"t_us": 0}, {"t_us": period, "rotation_axis": axis, "rotation_deg": 360.0}]
        return {"object": name, "repeat": True, "keyframes": keys}
    if kind == "corners" and whole <= 4 * _LONGEST_WAY:
        times, place = np.linspace(0, duration_us, 5).round().astype(int), np.zeros(3)
        keys = [{"t_us": 0, "translation_m": [0.0, 0.0, 0.0]}]
        for before, after in zip(times[:-1], times[1:], strict=True):
            if after <= before:
                break
            step = _direction(rng, 0.3) * speed * (after - before) / 1e6
            place = place + (step if np.linalg.norm(place + step) < _LONGEST_WAY else -step)
            keys.append({"t_us": int(after), "translation_m": place.round(9).tolist()})
        if len(keys) > 1:
            return {"object": name, "keyframes": keys}
    way = _direction(rng, 0.3)
    if whole > _LONGEST_WAY:
        return {
            "object": name, "repeat": True,
            "keyframes": _to_and_fro(way * rng.uniform(0.1, 0.35), speed, rng.random()),
        }  # fmt: skip
    keys = [
        {"t_us": 0, "translation_m": (-0.5 * whole * way).round(9).tolist()},
        {"t_us": duration_us, "translation_m": (0.5 * whole * way).round(9).tolist()},
    ]
    if kind == "both":
        turn = np.degrees(whole / max(size / 2, 1e-6)) * rng.choice([-1, 1]) * rng.random()
        axis = _direction(rng, 1.0).round(6).tolist()
        keys[0] |= {"rotation_axis": axis, "rotation_deg": 0.0}
        keys[1] |= {"rotation_axis": axis, "rotation_deg": round(float(turn), 6)}
    return {"object": name, "keyframes": keys}


def camera_track(rng: np.random.Generator, speed: float, duration_us: int) -> dict[str, Any]:
    """A motion of the camera across its view, with a small turn."""
    whole = speed * duration_us / 1e6
    way = _direction(rng, 0.2)
    track: dict[str, Any] = {"object": "camera", "pivot_m": [0.0, 0.0, CAMERA_Z]}
    if whole > CAMERA_WAY:
        return {**track, "repeat": True, "keyframes": _to_and_fro(way * CAMERA_WAY, speed, rng.random())}
    turn = float(rng.uniform(-1, 1)) * min(_CAMERA_TURN_DEG, np.degrees(whole / CAMERA_Z))
    keys = [
        {"t_us": 0, "rotation_axis": [0, 1, 0], "rotation_deg": 0.0, "translation_m": (-0.5 * whole * way).tolist()},
        {"t_us": duration_us, "rotation_axis": [0, 1, 0], "rotation_deg": turn,
         "translation_m": (0.5 * whole * way).tolist()},
    ]  # fmt: skip
    return {**track, "keyframes": keys}


def tracks(
    rng: np.random.Generator, spec: MotionsSpec, sizes: dict[str, float], duration_us: int
) -> list[dict[str, Any]]:
    """Tracks of one motion of a scene, all about as fast.

    Parameters
    ----------
    rng : random numbers of the motion.
    spec : ranges.
    sizes : extents of the solids by name, view widths.
    duration_us : of the clip, µs.
    """
    speed = log_uniform(rng, spec.speed)
    low, high = spec.speed
    names = list(sizes)
    first = names[int(rng.integers(len(names)))]
    result = []
    for name in names:
        moves = rng.random() < spec.moving or name == first
        own = float(np.clip(speed * log_uniform(rng, (0.6, 1.7)), low, high))
        track = solid_track(rng, name, own, sizes[name], duration_us)
        if moves:
            result.append(track)
    if rng.random() < spec.camera:
        result.append(camera_track(rng, speed, duration_us))
    return result
