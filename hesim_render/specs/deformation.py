"""A mesh that changes its shape: positions of its vertices at some times, in files."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from hesim_render.specs.reflectance import InFolder


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
        found = (path for path in self.path.iterdir() if path.suffix.lower() in (".ply", ".obj"))
        return [str(Path(self.file) / path.name) for path in sorted(found)]

    @model_validator(mode="after")
    def _check(self) -> DeformationSpec:
        if not self.path.exists():
            raise ValueError(f"no such file or folder: {self.path}")
        if self.path.is_dir() != (self.every_us is not None):
            raise ValueError("every_us goes with a folder of meshes; an NPZ file has its own times (t_us)")
        if not self.path.is_dir() and ("begin_us" in self.model_fields_set or self.path.suffix.lower() != ".npz"):
            raise ValueError("expected an NPZ file, or a folder; begin_us goes with a folder")
        return self
