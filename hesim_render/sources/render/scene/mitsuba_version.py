"""Everything that depends on Mitsuba's version or its global state, in one place.

Mitsuba 3.10 renames the data of meshes: this module contains all code that this affects, and
``tests/sources/render/test_mitsuba_names.py`` lists the names.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core import backend
from hesim_render.core.child import interrupts_held
from hesim_render.core.device import dr
from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.vertex_normals import ordered_normals
from hesim_render.spectral.spectrum import Spectrum

_LEAST_THREADS = 2
#: Largest relative deviation of a wavelength from an even grid that counts as rounding.
_EVEN = 1e-9
#: Smaller values are zero in float32, and Mitsuba's parser refuses them.
_NOTHING = 1e-37


def mitsuba() -> MitsubaModule:
    """The mitsuba module with the variant of the selected backend; its log shows errors only.

    Raises
    ------
    BackendError
        If no backend works here.
    """
    wanted = backend.variant()
    with interrupts_held():
        import mitsuba as mi

        if mi.variant() != wanted:
            mi.set_variant(wanted)
        backend.set_compiler_flags()
    mi.set_log_level(mi.LogLevel.Error)
    resolver: Any = getattr(mi, "file_resolver")()  # noqa: B009 - the stubs declare it as an object
    if str(resolver[0]) != str(plugin_folder(mi)):
        resolver.prepend(str(plugin_folder(mi)))
    return mi


def plugin_folder(mi: MitsubaModule) -> Path:
    """Folder of Mitsuba's own plugins and data.

    It is searched first for all files. Mitsuba loads ``plugins/TYPE.so`` from the first folder that has it,
    by default from the working folder, so files beside a scene or in the working folder would run as its code.
    """
    return Path(mi.__file__).resolve().parent


@contextmanager
def files_readable() -> Iterator[None]:
    """Give Mitsuba at least two threads while it reads or writes files; with one it would wait for ever.

    It reads and writes EXR files in tasks of its thread pool, and one of them waits for others.
    """
    before = dr.thread_count()
    if before >= _LEAST_THREADS:
        yield
        return
    dr.set_thread_count(_LEAST_THREADS)
    try:
        yield
    finally:
        dr.set_thread_count(before)


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
    """A spectrum as an explicit, absolute Mitsuba plugin that Mitsuba neither normalises nor reshapes.

    (A bare number as radiance would mean a spectrum with the shape of D65, and ``d65`` is normalised.) An evenly
    spaced grid becomes ``regular``, which has the same values as ``irregular`` without its search. That search takes
    15-30 % of a render.
    """
    spectrum = Spectrum(spectrum.wavelength_nm, np.where(np.abs(spectrum.values) < _NOTHING, 0.0, spectrum.values))
    if not np.any(spectrum.values):
        return {"type": "uniform", "value": 0.0}  # Mitsuba refuses an all-zero table
    low, high = spectrum.support_nm
    even = np.linspace(low, high, spectrum.wavelength_nm.size)
    if np.abs(spectrum.wavelength_nm - even).max() <= _EVEN * high:
        return {
            "type": "regular",
            "wavelength_min": low,
            "wavelength_max": high,
            "values": ",".join(f"{value:.9g}" for value in spectrum.values),
        }
    return {
        "type": "irregular",
        "wavelengths": ",".join(f"{value:.9g}" for value in spectrum.wavelength_nm),
        "values": ",".join(f"{value:.9g}" for value in spectrum.values),
    }


def make_mesh(
    mi: MitsubaModule,
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[np.uint32],
    bsdf: Any,
    texcoords: NDArray[np.float64] | None = None,
    emitter: dict[str, Any] | None = None,
) -> MitsubaObject:
    """A flat-shaded mesh from arrays: vertices [n, 3] in metres, faces [m, 3], texture coordinates [n, 2]; its BSDF or
    the dictionary of it.
    """
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    if emitter is not None:
        properties["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_texcoords=texcoords is not None, props=properties)
    parameters = mi.traverse(mesh)
    given: dict[str, NDArray] = {"vertex_positions": vertices, "faces": faces}
    if texcoords is not None:
        given["vertex_texcoords"] = texcoords
    for key, values in given.items():
        parameters[key] = from_host(type(parameters[key]), values)
    parameters.update()
    return mesh


def transform(mi: MitsubaModule, matrix: NDArray[np.float64] | Sequence[Sequence[float]]) -> MitsubaObject:
    """A 4×4 matrix as Mitsuba's scalar transform."""
    return mi.ScalarTransform4f(np.asarray(matrix, dtype=np.float64))


def mesh_vertices(mesh: MitsubaObject) -> NDArray[np.float64]:
    """Places of a mesh's vertices, [vertex, 3]."""
    return np.array(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)


def mesh_faces(mesh: MitsubaObject) -> NDArray[np.int64]:
    """Numbers of the vertices of a mesh's triangles, [face, 3]."""
    return np.array(mesh.faces_buffer(), np.int64).reshape(-1, 3)


def ball_of(shape: MitsubaObject) -> NDArray[np.float64]:
    """Middle and radius of a sphere of Mitsuba, [4]."""
    low, high = (np.array(corner, np.float64).ravel() for corner in (shape.bbox().min, shape.bbox().max))
    return np.array([*(low + high) / 2, np.mean(high - low) / 2])


def matrix_of(placement: MitsubaObject) -> NDArray[np.float64]:
    """Matrix [4, 4] of a transform among an object's parameters."""
    matrix = np.array(placement.matrix, np.float64)
    return matrix.reshape(4, 4, -1)[:, :, 0]


def can_move(parameters: MitsubaObject, prefix: str) -> bool:
    """Whether a shape of a loaded scene has a pose that can be set."""
    return f"{prefix}.vertex_positions" in parameters or f"{prefix}.to_world" in parameters


class Movable:
    """One shape of a loaded scene with an adjustable pose: its initial geometry, moved by a rigid pose."""

    def __init__(self, parameters: MitsubaObject, prefix: str, shape: MitsubaObject) -> None:
        self._parameters = parameters
        self.prefix = prefix
        self._to_world: NDArray[np.float64] | None = None
        self._normals: NDArray[np.float64] | None = None
        self.is_mesh = f"{prefix}.vertex_positions" in parameters
        if self.is_mesh:
            self._vertices = np.array(parameters[f"{prefix}.vertex_positions"], dtype=np.float64).reshape(-1, 3)
            self._normals = vertex_normals(parameters, prefix)
            self.corners = box_corners(self._vertices.min(axis=0), self._vertices.max(axis=0))
        else:
            self._to_world = matrix_of(parameters[f"{prefix}.to_world"])
            if shape.class_name() == "Instance":
                box = shape.bbox()
                self.corners = box_corners(np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel())
            else:
                unit = box_corners(-np.ones(3), np.ones(3))  # Mitsuba's analytic shapes fit into [-1, 1]³
                self.corners = unit @ self._to_world[:3, :3].T + self._to_world[:3, 3]

    def deform(self, vertices_m: NDArray[np.float64]) -> None:
        """Give a mesh another shape, [vertex, 3] as at its initial placement; takes effect at the next `set_pose`."""
        self._vertices = vertices_m
        if self._normals is not None:
            faces = np.array(self._parameters[f"{self.prefix}.faces"]).reshape(-1, 3)
            self._normals = ordered_normals(vertices_m, faces).astype(np.float64)

    def set_pose(self, pose: NDArray[np.float64]) -> None:
        """Set the shape to `pose` (4×4, rigid) times its initial placement; takes effect at ``parameters.update()``."""
        rotation, shift = pose[:3, :3], pose[:3, 3]
        if self._to_world is not None:
            import mitsuba as mi

            # the entries of the transform are arrays, not literals, so setting it compiles nothing
            self._parameters[f"{self.prefix}.to_world"] = mi.AffineTransform4f((pose @ self._to_world).tolist())
            return
        positions = self._vertices @ rotation.T + shift
        self._parameters[f"{self.prefix}.vertex_positions"] = positions.astype(np.float32).ravel()
        if self._normals is not None:
            # with positions alone, Mitsuba would compute normals of its own
            turned = self._normals @ rotation.T
            self._parameters[f"{self.prefix}.vertex_normals"] = turned.astype(np.float32).ravel()


def vertex_normals(parameters: MitsubaObject, prefix: str) -> NDArray[np.float64] | None:
    """Normals of a mesh's vertices, [vertex, 3]; None if its faces are flat."""
    key = f"{prefix}.vertex_normals"
    if key not in parameters or len(parameters[key]) != len(parameters[f"{prefix}.vertex_positions"]):
        return None
    return np.array(parameters[key], dtype=np.float64).reshape(-1, 3)


def names_of(shapes: Sequence[MitsubaObject]) -> list[str]:
    """Names of a scene's shapes: their ids, and ``shape_3`` for the fourth one if that has none."""
    names = [shape.id() for shape in shapes]
    for number, name in enumerate(names):
        if not name:
            own = f"shape_{number}"
            while own in names:
                own += "_"
            names[number] = own
    return names


def settle_normals(parameters: MitsubaObject, needs_normals: Callable[[str], bool]) -> None:
    """Give meshes the normals that their vertices determine, in place of Mitsuba's, whose last bits are by chance.

    Parameters
    ----------
    parameters : ``mitsuba.traverse(scene)``.
    needs_normals : True for the name of a mesh whose file has no normals (`brings_normals`).
    """
    ending, changed = ".vertex_normals", False
    names = list(parameters.keys())  # iteration over the parameters themselves gives pairs
    for prefix in [name.removesuffix(ending) for name in names if name.endswith(ending)]:
        # a mesh of a group has the names of its owners before its own
        if vertex_normals(parameters, prefix) is not None and needs_normals(prefix.rpartition(".")[2]):
            vertices, faces = (np.array(parameters[f"{prefix}.{key}"]) for key in ("vertex_positions", "faces"))
            normals = ordered_normals(vertices.reshape(-1, 3), faces.reshape(-1, 3))
            parameters[f"{prefix}{ending}"], changed = normals.ravel(), True
    if changed:
        parameters.update()


def box_corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 8 corners of an axis-parallel box, [8, 3]."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T
    return low + corners * (high - low)


def path_depths(integrator: MitsubaObject) -> tuple[int, int]:
    """Longest path of an integrator, and its first segment with Russian roulette; -1 for none."""
    if integrator.class_name() == "DirectIntegrator":
        return 2, -1
    most, roulette = (number_of(integrator, name) for name in ("max_depth", "rr_depth"))
    return most, roulette


def number_of(integrator: MitsubaObject, property_name: str) -> int:
    """A whole number among the properties of an integrator, -1 for none. Mitsuba gives it only in its text."""
    for line in str(integrator).splitlines():
        name, _, value = line.strip().rstrip(",").partition(" = ")
        if name == property_name:
            number = int(value)
            return -1 if number >= 2**31 else number
    raise AssertionError(f"this integrator has a {property_name}")
