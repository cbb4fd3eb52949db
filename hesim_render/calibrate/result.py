"""``calibration.yaml``, its map files and the place of its report. A file is written completely or not at all."""

import contextlib
import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibration.file import read_calibration, read_maps
from hesim_render.calibration.spec import SCHEMA_VERSION
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.core.npz import NpzWriter
from hesim_render.core.output import alone_in, check_place, output_errors, replacing, write_whole
from hesim_render.core.plain import as_plain
from hesim_render.core.yaml_file import yaml_text

__all__ = ["check_calibration", "plain", "read_calibration", "read_maps", "write_section"]

_SIGNIFICANT = 9
_REPORT = '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="calibration" content="'


def write_section(
    file: str | Path, section: str, capture: Mapping[str, Any], content: Mapping[str, Any], maps: Mapping[str, NDArray]
) -> Path:
    """Add or replace a section of a calibration, with its maps in ``<name>_<section>_maps-<hash>.npz`` beside it.

    The name of a map file contains a hash of its content, and the calibration holds that hash. New maps replace old
    ones in the same step in which the new calibration gets its name. Runs that write different sections of one
    calibration at the same time wait for each other here, and neither loses its section.

    Raises
    ------
    SpecError
        If `file` exists and is not a calibration, or is one of another sensor.
    OutputError
        If it cannot be written.
    """
    path = Path(file)
    names = [name for name in maps if not name.startswith("figure_")]
    with alone_in(path.absolute().parent):
        _write_section(path, section, check_calibration(path, capture), content, maps, names)
    return path


def _write_section(
    path: Path,
    section: str,
    data: Mapping[str, Any],
    content: Mapping[str, Any],
    maps: Mapping[str, NDArray],
    names: list[str],
) -> None:
    target = path.with_name(f"{path.stem}_{section}_maps-{_digest(maps)[:12]}.npz")
    try:
        with replacing(target) as temporary, NpzWriter(temporary) as archive:
            for name, array in maps.items():
                archive.add(name, np.asarray(array))
        about = {"file": target.name, "sha256": WholeFile(target).sha256(), **{name: name for name in names}}
        whole = {**data, section: {**content, "maps": about}}
        write_whole(path, yaml_text(plain(whole)))
    finally:
        with contextlib.suppress(OSError, SpecError):  # not what was asked for, and the next run does it
            _remove_unnamed(path, section)


def check_calibration(file: str | Path, capture: Mapping[str, Any]) -> dict[str, Any]:
    """What a calibration holds to which a section of such captures is added, the captures among it.

    Raises
    ------
    SpecError
        If `file` exists and is not a calibration, or is one of another sensor.
    OutputError
        If there can be no file.
    """
    path = Path(file)
    check_place(path, (".yaml", ".yml"))
    if not path.exists():
        return {"schema_version": SCHEMA_VERSION, "capture": dict(capture)}
    previous = read_calibration(path)
    for key in ("sensor", "roi", "tile_rows", "tile_cols"):
        if previous["capture"].get(key) != capture.get(key):
            raise SpecError(
                f"holds a calibration with {key} {previous['capture'].get(key)!r}, the captures have "
                f"{capture.get(key)!r}; give another --out",
                file=path,
            )
    return {**previous, "capture": {**previous["capture"], **capture}}


def _digest(maps: Mapping[str, NDArray]) -> str:
    """SHA-256 of arrays and their names."""
    digest = hashlib.sha256()
    for name, array in maps.items():
        values = np.ascontiguousarray(array)
        digest.update(f"{name} {values.dtype.str} {values.shape} ".encode())
        digest.update(values.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _remove_unnamed(path: Path, section: str) -> None:
    """Remove map files of a section that no calibration in the folder names, those of killed runs among them."""
    ours = re.compile(rf"{re.escape(path.stem)}_{section}_maps(-[0-9a-f]{{12}})?\.npz")
    result = [other for other in path.parent.iterdir() if ours.fullmatch(other.name)]
    texts = (
        [WholeFile(other).text() for other in {path, *path.parent.glob("*.y*ml")} if other.is_file()] if result else []
    )
    for other in result:
        if not any(other.name in text for text in texts):
            other.unlink(missing_ok=True)


def report_beginning(calibration: str | Path) -> str:
    """How the report of a calibration begins: with the hash of the calibration's place."""
    return _REPORT + hashlib.sha256(os.fsencode(Path(calibration).expanduser().resolve())).hexdigest()[:16]


def check_report(calibration: str | Path, report: str | Path, overwrite: bool) -> Path:
    """Whether a report may be written; returns its absolute path.

    The report of this very calibration is brought up to date without being asked; that of another one only with
    `overwrite`, and no other file is touched.

    Raises
    ------
    OutputError
        If it may not.
    """
    path, own = check_place(report, (".html", ".htm")), report_beginning(calibration)
    if path.resolve() == Path(calibration).expanduser().resolve():
        raise OutputError(f"{report}: is the calibration itself; give the report another name")
    if not path.is_file() or path.stat().st_size == 0:
        return path
    with output_errors(path), path.open("rb") as stream:
        start = stream.read(len(own)).decode("utf-8", "replace")
    if not start.startswith(_REPORT):
        raise OutputError(f"{report}: exists and is no report of a calibration; give the name of a new file")
    if start != own and not overwrite:
        raise OutputError(
            f"{report}: exists and is of another calibration; give another name, or overwrite it (--overwrite, "
            "overwrite=True)"
        )
    return path


def plain(value: Any) -> Any:
    """A value as files hold it, floats to nine significant digits."""
    return as_plain(value, _SIGNIFICANT)
