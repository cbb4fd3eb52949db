"""Meshes that change their shape: positions of their vertices at any time."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import require_memory
from hesim_render.core.npz import read_arrays
from hesim_render.sources.render.scene.mitsuba_version import as_spec_error, mesh_faces, mesh_vertices
from hesim_render.sources.render.scene.sizes import require_fits
from hesim_render.specs.motion import DeformationSpec


@dataclass(frozen=True, eq=False)
class Deformation:
    """Positions of vertices, linear in time between `knots_us`.

    Parameters
    ----------
    knots_us : times, increasing, µs.
    vertices_m : [time, vertex, 3], positions in the world with the object at its place in the scene file, m, float32.
    repeat : True if the sequence starts over at its last time; otherwise its first and last shapes are held.
    """

    knots_us: NDArray[np.float64]
    vertices_m: NDArray[np.float32]
    repeat: bool

    @property
    def period_us(self) -> float:
        """Time from the first shape to the last, µs."""
        return float(self.knots_us[-1] - self.knots_us[0])

    def part(self, vertices: slice) -> "Deformation":
        """The same of some of the vertices."""
        return replace(self, vertices_m=self.vertices_m[:, vertices])

    def at(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Positions at times [...], [..., vertex, 3], m."""
        # time since the first shape, wrapped or held at the ends
        local = np.asarray(t_us, dtype=np.float64) - self.knots_us[0]
        local = np.mod(local, self.period_us) if self.repeat else np.clip(local, 0.0, self.period_us)
        knots = self.knots_us - self.knots_us[0]
        # the two shapes around each time, between which vertices go along straight lines
        segment = np.clip(np.searchsorted(knots, local, side="right") - 1, 0, knots.size - 2)
        share = ((local - knots[segment]) / (knots[segment + 1] - knots[segment]))[..., None, None]
        begin = self.vertices_m[segment].astype(np.float64)
        return begin + share * (self.vertices_m[segment + 1] - begin)


def read_deformation(
    mi: MitsubaModule, spec: DeformationSpec, mesh: MitsubaObject, fit: NDArray[np.float64], key: str
) -> Deformation:
    """Positions of the vertices of a mesh from its files.

    Parameters
    ----------
    mi : the mitsuba module.
    spec : keys of the scene file.
    mesh : the mesh as its own file has it.
    fit : [4, 4], from the coordinates of the file to the world.
    key : key of the scene file, for errors.

    Raises
    ------
    SpecError
        If a file is damaged or does not fit the mesh, or times do not increase.
    """
    count, faces = int(mesh.vertex_count()), mesh_faces(mesh)
    if spec.path.is_dir():
        times, vertices = _from_folder(mi, spec, count, faces, key)
    else:
        arrays = read_arrays(spec.path, ("t_us", "vertices"), only=("t_us", "vertices"), kinds="fiu")
        times, vertices = arrays["t_us"].astype(np.float64), arrays["vertices"]
        if vertices.ndim != 3 or vertices.shape[1:] != (count, 3) or times.shape != vertices.shape[:1]:
            held = f"t_us {list(times.shape)} and vertices {list(vertices.shape)}"
            raise SpecError(f"holds {held}; expected [times] and [times, {count}, 3], as the mesh has {count} vertices",
                            file=spec.path, key=key)  # fmt: skip
    if len(times) < 2:
        raise SpecError("a deformation needs at least two shapes", file=spec.path, key=key)
    if not np.isfinite(times).all() or not np.isfinite(vertices).all():
        raise SpecError("has values that are not finite", file=spec.path, key=key)
    wrong = np.flatnonzero(np.diff(times) < 1)
    if wrong.size:
        before, after = times[wrong[0] : wrong[0] + 2]
        raise SpecError(f"times must increase by 1 µs or more: {after:g} µs follows {before:g} µs",
                        file=spec.path, key=key)  # fmt: skip
    # to world coordinates, shape by shape: all of them in float64 would need twice the memory
    placed = np.empty(vertices.shape, np.float32)
    for shape, own in zip(placed, vertices, strict=True):
        shape[:] = own.astype(np.float64) @ fit[:3, :3].T + fit[:3, 3]
    return Deformation(times, placed, spec.repeat)


def _from_folder(
    mi: MitsubaModule, spec: DeformationSpec, count: int, faces: NDArray, key: str
) -> tuple[NDArray[np.float64], NDArray[np.floating]]:
    names = spec.files
    require_memory(len(names) * count * 12, "all shapes of the mesh", spec.path)
    shapes = np.empty((len(names), count, 3), np.float32)
    for number, name in enumerate(names):
        path = spec.folder / name
        require_fits(path)
        with as_spec_error(path, key):
            mesh = mi.load_dict({"type": path.suffix.lower().lstrip("."), "filename": str(path)})
        if mesh.vertex_count() != count or not np.array_equal(mesh_faces(mesh), faces):
            raise SpecError(f"its faces are not those of the mesh, which has {count} vertices and {len(faces)} faces",
                            file=path, key=key)  # fmt: skip
        shapes[number] = mesh_vertices(mesh)
    assert spec.every_us is not None
    return spec.begin_us + spec.every_us * np.arange(len(names), dtype=np.float64), shapes
