"""Trajectory files: times with a translation and a quaternion each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import read_text
from hesim_render.core.units import US_PER_S

#: Columns of a CSV file, and those of a TUM file, whose time is in seconds.
CSV_COLUMNS = ("t_us", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
#: Largest deviation of a quaternion's length from 1 that counts as rounding.
_UNIT = 1e-2
#: From OpenCV's camera axes (y down, view along +z) to those of this package (y up, view along -z).
_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def read_poses(file: Path, axes: str = "scene") -> list[dict[str, Any]]:
    """Keyframes of a trajectory file, as they may stand in a scene file.

    A CSV file has the header ``t_us,x_m,y_m,z_m,qx,qy,qz,qw``. Any other file is one of the TUM RGB-D benchmark: time
    in seconds and the same seven numbers, separated by blanks. Lines that begin with ``#`` are comments. Times are
    rounded to whole microseconds.

    Parameters
    ----------
    file : the file.
    axes : ``scene``: x to the right, y up, view along -z; ``opencv``: x to the right, y down, view along +z.

    Raises
    ------
    SpecError
        If the file is not valid or times do not increase; the message names file and line.
    """
    is_csv = file.suffix.lower() == ".csv"
    lines = [
        (number, text)
        for number, line in enumerate(read_text(file).splitlines(), 1)
        if (text := line.split("#", 1)[0].strip())
    ]
    if is_csv:
        header = [cell.strip() for cell in lines[0][1].split(",")] if lines else []
        if header != list(CSV_COLUMNS):
            raise SpecError(f"the header must be {','.join(CSV_COLUMNS)}", file=file, line=1)
        lines = lines[1:]
    found: list[dict[str, Any]] = []
    for number, text in lines:
        values = _numbers(text.split("," if is_csv else None), file, number)
        t_us = round(values[0] * (1 if is_csv else US_PER_S))
        if found and t_us <= found[-1]["t_us"]:
            raise SpecError(
                f"times must increase by 1 µs or more: {t_us} µs follows {found[-1]['t_us']} µs", file=file, line=number
            )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(values[4:]).as_matrix()
        pose[:3, 3] = values[1:4]
        found.append({"t_us": t_us, "matrix": (pose @ _FROM_OPENCV if axes == "opencv" else pose).tolist()})
    if len(found) < 2:
        raise SpecError("a trajectory needs at least two poses", file=file)
    return found


def _numbers(cells: list[str], file: Path, line: int) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != len(CSV_COLUMNS) or not np.isfinite(values).all():
        raise SpecError("expected a time, three coordinates and a quaternion (x, y, z, w)", file=file, line=line)
    length = float(np.linalg.norm(values[4:]))
    if abs(length - 1) > _UNIT:
        raise SpecError(f"a quaternion must have the length 1; this one has {length:.4g}", file=file, line=line)
    return values
