"""How an object or the camera moves: keyframes of rigid motions.

A mesh that changes its shape: positions of its vertices at some times, in files.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator, model_validator

from hesim_render.core.errors import SpecError
from hesim_render.specs.files import InFolder, Strict
from hesim_render.specs.geometry import Direction, RigidMatrix, Vector, rotation_about, rotation_vectors
from hesim_render.trajectories.pose_files import PoseFile, read_poses

#: Keys of a track that say how its `file` is read, and the texts that they may be; without any, whole numbers.
_OF_FILE = {"axes": ("scene", "opencv"), "quaternion": ("hamilton", "kalibr"), "begin_us": (), "every_us": ()}


class KeyframeSpec(Strict):
    """A rigid pose at one time: rotate about the track's pivot, then translate; or both as one matrix.

    `matrix` maps the object from its place in the file to its place at this time, independent of the pivot. It is
    converted to a translation and a rotation that takes the shortest way from the previous keyframe.
    """

    t_us: int = Field(ge=-(10**15), le=10**15, description="time, µs from the start")
    translation_m: Vector = (0.0, 0.0, 0.0)
    rotation_axis: Direction = (0.0, 0.0, 1.0)
    rotation_deg: float = Field(0.0, ge=-1e9, le=1e9)
    matrix: RigidMatrix | None = Field(None, description="4×4 by rows, instead of translation and rotation")

    @model_validator(mode="after")
    def _check(self) -> "KeyframeSpec":
        other = self.model_fields_set & {"translation_m", "rotation_axis", "rotation_deg"}
        if self.matrix is not None and other:
            raise ValueError(f"give matrix or {', '.join(sorted(other))}, not both")
        return self

    def resolved(
        self, pivot_m: Vector, before: "KeyframeSpec | None", turn: NDArray[np.float64] | None
    ) -> "KeyframeSpec":
        """The keyframe without a matrix: x → R (x − pivot) + pivot + translation.

        Parameters
        ----------
        pivot_m, before : of the track; and the keyframe before this one, without a matrix.
        turn : rotation vector of the matrix, from `rotation_vectors`; None without a matrix.
        """
        if self.matrix is None or turn is None:
            return self
        axis, angle_deg = _turn(turn, before)
        values, pivot = np.array(self.matrix, dtype=np.float64), np.array(pivot_m, dtype=np.float64)
        shift = values[:3, 3] - pivot + rotation_about(axis, angle_deg) @ pivot
        return KeyframeSpec(
            t_us=self.t_us, translation_m=tuple(shift.tolist()), rotation_axis=axis, rotation_deg=angle_deg
        )


def _turn(rotation: NDArray[np.float64], before: KeyframeSpec | None) -> tuple[Vector, float]:
    """Axis and angle of a rotation vector, with the number of whole turns that brings it nearest to the previous
    keyframe.

    Two keyframes about one axis may be any number of turns apart, but matrices do not count turns.
    """
    angle = float(np.linalg.norm(rotation))
    angle_deg = float(np.degrees(angle))
    axis = rotation / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
    if before is not None and before.rotation_deg != 0:
        shared = np.array(before.rotation_axis) / np.linalg.norm(before.rotation_axis)
        along = float(axis @ shared)
        if angle == 0 or abs(abs(along) - 1) < 1e-9:
            angle_deg *= np.sign(along) if angle > 0 else 0.0
            axis, angle_deg = shared, angle_deg + 360 * round((before.rotation_deg - angle_deg) / 360)
    return (float(axis[0]), float(axis[1]), float(axis[2])), angle_deg


class TrackSpec(Strict):
    """Motion of one object (``target``, an object's name, a shape id of a Mitsuba scene) or of ``camera``.

    Between keyframes the translation is linear and the rotation runs at constant angular speed:
    about the shared axis, any number of turns, where both keyframes name the same axis (a rotation
    of 0 shares every axis); along the shortest arc otherwise. Before the first and after the last
    keyframe the pose is held, or the track repeats. Objects stand still within slices of time that
    are short against their speed; the camera's motion is rendered ray by ray. With a `parent` the pose is that of the
    parent times this one.
    """

    object: str = Field(min_length=1)
    parent: str | None = Field(None, min_length=1, description="what it rides on: another object with a track")
    pivot_m: Vector = (0.0, 0.0, 0.0)
    repeat: bool = False
    keyframes: list[KeyframeSpec] = Field(min_length=2)

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, data: Any, info: ValidationInfo) -> Any:
        """Read the keyframes of ``file``; a dump then holds the numbers. A track with a parent needs none."""
        if isinstance(data, dict) and data.get("parent") is not None and not ({"file", "keyframes"} & set(data)):
            return {**data, "keyframes": [{"t_us": 0}, {"t_us": 1}]}
        if not isinstance(data, dict) or not ({"file", *_OF_FILE} & set(data)):
            return data
        name, given = data.get("file"), {key: data[key] for key in _OF_FILE if key in data}
        if "keyframes" in data or not isinstance(name, str):
            raise ValueError(f"give keyframes or file, exactly one of them; {', '.join(_OF_FILE)} go with file")
        for key, known in _OF_FILE.items():
            value = given.get(key)
            if known and value is not None and value not in known:
                raise ValueError(f"{key}: expected {' or '.join(known)}")
            if not known and value is not None and (isinstance(value, bool) or not isinstance(value, int)):
                raise ValueError(f"{key}: expected a whole number of microseconds")
        if given.get("every_us") is not None and given["every_us"] < 1:
            raise ValueError("every_us: expected 1 µs or more")
        file = (info.context or {}).get("folder", Path()) / name
        if not os.path.isfile(file):
            raise ValueError(f"file: no such file: {file}")
        try:
            frames = read_poses(file, PoseFile(**given), data.get("object") == "camera")
        except SpecError as error:
            raise ValueError(str(error)) from None
        return {key: value for key, value in data.items() if key not in ("file", *_OF_FILE)} | {"keyframes": frames}

    @field_validator("keyframes")
    @classmethod
    def _without_matrices(cls, frames: list[KeyframeSpec], info: ValidationInfo) -> list[KeyframeSpec]:
        result: list[KeyframeSpec] = []
        turns = iter(rotation_vectors([frame.matrix for frame in frames if frame.matrix is not None]))
        for frame in frames:
            turn = None if frame.matrix is None else next(turns)
            result.append(
                frame.resolved(info.data.get("pivot_m", (0.0, 0.0, 0.0)), result[-1] if result else None, turn)
            )
        return result

    @model_validator(mode="after")
    def _check(self) -> "TrackSpec":
        times = [frame.t_us for frame in self.keyframes]
        for earlier, later in zip(times[:-1], times[1:], strict=True):
            if later <= earlier:
                raise ValueError(f"keyframes must be in order of time: {later} µs follows {earlier} µs")
        return self


class DeformationSpec(InFolder):
    """Positions of the vertices of a mesh, linear in time between those of the file.

    `file` is an NPZ file with ``t_us`` [time] and ``vertices`` [time, vertex, 3], or a folder of meshes with the same
    faces, in the order of their names, one every `every_us`. Positions are in the coordinates of the mesh file, and are
    stretched and placed with it. Before the first and after the last time the shape is held, or the sequence repeats.
    """

    file: str = Field(min_length=1, description="NPZ file, or folder of PLY or OBJ files, relative to this file")
    every_us: int | None = Field(None, ge=1, le=10**12, description="time from file to file of a folder, µs")
    begin_us: int = Field(0, ge=-(10**12), le=10**12, description="time of the first file of a folder, µs")
    repeat: bool = False

    @property
    def path(self) -> Path:
        """The file or the folder."""
        return self.folder / self.file

    @property
    def files(self) -> list[str]:
        """Names of all its files, relative to the folder of the scene file, in the order of time."""
        if not self.path.is_dir():
            return [self.file]
        result = (path for path in self.path.iterdir() if path.suffix.lower() in (".ply", ".obj"))
        return [str(Path(self.file) / path.name) for path in sorted(result)]

    @model_validator(mode="after")
    def _check(self) -> "DeformationSpec":
        if not self.path.exists():
            raise ValueError(f"no such file or folder: {self.path}")
        if self.path.is_dir() != (self.every_us is not None):
            raise ValueError("every_us goes with a folder of meshes; an NPZ file has its own times (t_us)")
        if not self.path.is_dir() and ("begin_us" in self.model_fields_set or self.path.suffix.lower() != ".npz"):
            raise ValueError("expected an NPZ file, or a folder; begin_us goes with a folder")
        return self
