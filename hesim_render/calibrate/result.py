"""``calibration.yaml`` and the map files beside it: written whole or not at all, read back checked."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from hesim_render.errors import SpecError
from hesim_render.output import output_errors
from hesim_render.specs.calibration import SCHEMA_VERSION, read_calibration, read_maps

__all__ = ["plain", "read_calibration", "read_maps", "write_section", "write_text"]

_SIGNIFICANT = 9


def write_section(
    file: str | Path, section: str, capture: Mapping[str, Any], content: Mapping[str, Any], maps: Mapping[str, NDArray]
) -> Path:
    """Add or replace a section of a calibration, with its maps in ``<name>_<section>_maps.npz`` beside it.

    Raises
    ------
    SpecError
        If `file` exists and is not a calibration, or is one of another sensor.
    OutputError
        If it cannot be written.
    """
    path = Path(file)
    data: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "capture": dict(capture)}
    if path.exists():
        previous = read_calibration(path)
        for key in ("sensor", "roi", "tile_rows", "tile_cols"):
            if previous["capture"].get(key) != capture.get(key):
                raise SpecError(
                    f"holds a calibration with {key} {previous['capture'].get(key)!r}, the captures have "
                    f"{capture.get(key)!r}; give another --out",
                    file=path,
                )
        data = previous
        data["capture"] = {**previous["capture"], **capture}
    names = [name for name in maps if not name.startswith("figure_")]
    map_file = path.with_name(f"{path.stem}_{section}_maps.npz")
    data[section] = {**content, "maps": {"file": map_file.name, **{name: name for name in names}}}
    arrays: dict[str, Any] = dict(maps)
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(map_file, lambda stream: np.savez(stream, **arrays))
        _replace(path, lambda stream: _yaml().dump(plain(data), stream))
    return path


def write_text(file: str | Path, text: str) -> Path:
    """Write a text file whole or not at all."""
    path = Path(file)
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(path, lambda stream: stream.write(text.encode("utf-8")))
    return path


def plain(value: Any) -> Any:
    """NumPy numbers and arrays as Python's, floats to nine significant digits; anything not finite becomes null."""
    if isinstance(value, Mapping):
        return {key if isinstance(key, int) else str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_SIGNIFICANT}g}") if np.isfinite(value) else None
    return value


def _yaml() -> YAML:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # ruamel declares None
    yaml.width = 110
    return yaml


def _replace(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            write(stream)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
