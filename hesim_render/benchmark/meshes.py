"""Meshes by seed, as text of OBJ files, within a cube of side 1 about the origin."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Faces = tuple[NDArray[np.float64], NDArray[np.int64]]
_RINGS, _ROUND = 24, 48


def _sheet(rows: int, cols: int) -> NDArray[np.int64]:
    """Triangles of a grid of vertices that closes in its second direction."""
    row, col = np.meshgrid(np.arange(rows - 1), np.arange(cols), indexing="ij")
    a, b = row * cols + col, row * cols + (col + 1) % cols
    c, d = a + cols, b + cols
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def _boulder(rng: np.random.Generator) -> Faces:
    """A sphere whose radius varies smoothly."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, _RINGS), np.linspace(0, 2 * np.pi, _ROUND, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1)
    radius = np.ones_like(theta)
    for _ in range(6):
        way = rng.normal(size=3)
        radius += rng.uniform(0.03, 0.12) * np.sin(points @ way * rng.uniform(1, 4) + rng.uniform(0, 2 * np.pi))
    # rows run down the y axis, so that the sheet's own triangles look inwards, and glass would be air in glass
    return (points * radius[..., None]).reshape(-1, 3), _sheet(_RINGS, _ROUND)[:, ::-1]


def _star(rng: np.random.Generator) -> Faces:
    """A prism over a star of some points."""
    count = 2 * int(rng.integers(3, 9))
    angle = 2 * np.pi * np.arange(count) / count
    radius = np.where(np.arange(count) % 2 == 0, 1.0, rng.uniform(0.35, 0.8))
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    half = rng.uniform(0.1, 0.5)
    front, back = (np.column_stack([outline, np.full(count, z)]) for z in (half, -half))
    points = np.concatenate([front, back, [[0, 0, half], [0, 0, -half]]])
    k, after = np.arange(count), (np.arange(count) + 1) % count
    faces = [
        np.stack([np.full(count, 2 * count), k, after], -1),
        np.stack([np.full(count, 2 * count + 1), count + after, count + k], -1),
        np.stack([k, count + k, after], -1),
        np.stack([after, count + k, count + after], -1),
    ]
    return points, np.concatenate(faces)


def _ring(rng: np.random.Generator) -> Faces:
    """A torus."""
    inner = rng.uniform(0.12, 0.45)
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, _ROUND + 1), np.linspace(0, 2 * np.pi, _RINGS, endpoint=False), indexing="ij"
    )
    across = 1 + inner * np.cos(v)
    points = np.stack([across * np.cos(u), across * np.sin(u), inner * np.sin(v)], axis=-1)
    return points.reshape(-1, 3), _sheet(_ROUND + 1, _RINGS)


_KINDS: tuple[Callable[[np.random.Generator], Faces], ...] = (_boulder, _star, _ring)


def mesh(rng: np.random.Generator) -> str:
    """A closed mesh of a random kind.

    Returns
    -------
    Text of an OBJ file; the mesh fills the cube [-0.5, 0.5]³ in its largest extent.
    """
    points, faces = _KINDS[int(rng.integers(len(_KINDS)))](rng)
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    points = points / np.ptp(points, axis=0).max()
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"
