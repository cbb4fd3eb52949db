"""Everything that depends on Mitsuba's version or its global state, in one place.

Mitsuba 3.10 renames mesh parameters and brings animated transforms: what it touches is here and
in `builder`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render import backend
from hesim_render.errors import SpecError
from hesim_render.spectra import Spectrum


def mitsuba() -> Any:
    """The mitsuba module, its variant set to the selected backend's, its log kept to errors.

    Raises
    ------
    BackendError
        If no backend works here.
    """
    wanted = backend.variant()
    import mitsuba as mi

    if mi.variant() != wanted:
        mi.set_variant(wanted)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


@contextmanager
def using_variant(name: str | None) -> Iterator[Any]:
    """The mitsuba module in another variant for a while (``scalar_spectral``); None keeps the backend's.

    Raises
    ------
    SpecError
        If this build of Mitsuba lacks the variant.
    """
    mi = mitsuba()
    if name is None or name == mi.variant():
        yield mi
        return
    if name not in mi.variants() or "spectral" not in name:
        spectral = ", ".join(v for v in mi.variants() if "spectral" in v)
        raise SpecError(f"no spectral Mitsuba variant {name!r}; this build has {spectral}")
    before = mi.variant()
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield mi
    finally:
        mi.set_variant(before)


@contextmanager
def as_spec_error(file: str | Path | None, key: str | None = None) -> Iterator[None]:
    """Turn an exception of Mitsuba's loader into a `SpecError` of one line."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, SpecError):
            raise
        text = re.sub(r"\[[\w.]+:\d+\]\s*", "", str(error))
        lines = [line.strip(" :") for line in text.splitlines() if line.strip()]
        raise SpecError(f"Mitsuba cannot read this scene: {' '.join(lines)[:400]}", file=file, key=key) from None


def spectrum_dict(spectrum: Spectrum) -> dict[str, Any]:
    """A spectrum as an explicit Mitsuba plugin, absolute: Mitsuba neither normalises nor reshapes it.

    (A bare number as radiance would mean a spectrum shaped like D65, and ``d65`` is normalised.)
    """
    if not np.any(spectrum.values):
        return {"type": "uniform", "value": 0.0}  # 'irregular' refuses an all-zero table
    return {
        "type": "irregular",
        "wavelengths": ",".join(f"{value:.9g}" for value in spectrum.wavelength_nm),
        "values": ",".join(f"{value:.9g}" for value in spectrum.values),
    }


def make_mesh(
    mi: Any,
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[np.uint32],
    bsdf: dict[str, Any],
    texcoords: NDArray[np.float64] | None = None,
) -> Any:
    """A flat-shaded mesh from arrays: vertices [n, 3] in metres, faces [m, 3], texture coordinates [n, 2]."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_texcoords=texcoords is not None, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    if texcoords is not None:
        parameters["vertex_texcoords"] = np.ascontiguousarray(texcoords, dtype=np.float32).ravel()
    parameters.update()
    return mesh


def transform(mi: Any, matrix: NDArray[np.float64] | Sequence[Sequence[float]]) -> Any:
    """A 4×4 matrix as Mitsuba's scalar transform."""
    return mi.ScalarTransform4f(np.asarray(matrix, dtype=np.float64))


class Movable:
    """One shape of a loaded scene whose pose can be set: initial geometry, moved by a rigid pose."""

    def __init__(self, parameters: Any, prefix: str) -> None:
        self._parameters = parameters
        self._prefix = prefix
        self._to_world: NDArray[np.float64] | None = None
        self.is_mesh = f"{prefix}.vertex_positions" in parameters
        if self.is_mesh:
            self._vertices = np.array(parameters[f"{prefix}.vertex_positions"], dtype=np.float64).reshape(-1, 3)
            normals = f"{prefix}.vertex_normals"
            has_normals = normals in parameters and len(parameters[normals]) == self._vertices.size
            self._normals = np.array(parameters[normals], dtype=np.float64).reshape(-1, 3) if has_normals else None
            self.corners = box_corners(self._vertices.min(axis=0), self._vertices.max(axis=0))
        else:
            matrix = np.array(parameters[f"{prefix}.to_world"].matrix, dtype=np.float64)
            self._to_world = matrix.reshape(matrix.shape[0], matrix.shape[1], -1)[:, :, 0]
            unit = box_corners(-np.ones(3), np.ones(3))  # Mitsuba's analytic shapes fit into [-1, 1]³
            self.corners = unit @ self._to_world[:3, :3].T + self._to_world[:3, 3]

    def set_pose(self, pose: NDArray[np.float64]) -> None:
        """Put the shape at `pose` (4×4 rigid) times its initial placement; takes effect at ``parameters.update()``."""
        rotation, shift = pose[:3, :3], pose[:3, 3]
        if self._to_world is not None:
            import mitsuba as mi

            # a transform whose entries are arrays, not literals: setting it does not recompile anything
            self._parameters[f"{self._prefix}.to_world"] = mi.AffineTransform4f((pose @ self._to_world).tolist())
            return
        positions = self._vertices @ rotation.T + shift
        self._parameters[f"{self._prefix}.vertex_positions"] = positions.astype(np.float32).ravel()
        if self._normals is not None:
            turned = self._normals @ rotation.T
            self._parameters[f"{self._prefix}.vertex_normals"] = turned.astype(np.float32).ravel()


def box_corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 8 corners of an axis-parallel box, [8, 3]."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T
    return low + corners * (high - low)
