"""What `simulate` is given: a scene, a video, a hyperspectral cube, a run file, or a recording to be made again."""

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hesim_render.cli.cube import parse_bands
from hesim_render.cli.options import cropped
from hesim_render.core.errors import ConflictError
from hesim_render.core.shipped import list_names

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor
    from hesim_render.sources.scene import Scene


class InputKind(StrEnum):
    """Kinds of input, as messages name them."""

    scene = "a scene"
    video = "a video"
    cube = "a hyperspectral cube"
    run = "a run file"
    recording = "a recording"


@dataclass(frozen=True)
class Inputs:
    """A scene, video or cube, and a sensor: names or files, with the keys and options that change them."""

    name: str
    sensor: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    sensor_keys: Mapping[str, Any] = field(default_factory=dict)
    roi: str | None = None
    allow_outside: bool = False

    def load_scene(self) -> "Scene":
        import hesim_render as hr

        return hr.load_scene(self.name, self.keys, allow_outside=self.allow_outside)

    def load_sensor(self) -> "Sensor":
        import hesim_render as hr

        return cropped(hr.load_sensor(self.sensor, self.sensor_keys), self.roi)


#: Ends of the names of hyperspectral cubes. A ``.npy`` file is one where its wavelengths are given, else a video.
_CUBES = (".hdr", ".mat", ".h5", ".hdf5", ".exr")
#: A picture in a folder of CAVE, which holds one for each band.
_CAVE = re.compile(r".+_ms_\d\d\.png")
#: Options that not every kind of input takes. A run file takes all but the last three as changes of its keys.
_SIMULATED = frozenset({"--sensor", "--duration", "--roi", "--seed", "--clean", "--without"})
_RENDERED = frozenset({"--quality", "--exact", "--samples", "--truth", "--truth-every-us"})
_TAKEN: Mapping[InputKind, frozenset[str]] = {
    InputKind.scene: _SIMULATED
    | _RENDERED
    | {"--set", "--live", "--allow-outside", "--framing", "--look", "--workers"},
    InputKind.video: _SIMULATED | {"--set", "--live"},
    InputKind.cube: _SIMULATED | {"--set", "--live"},
    InputKind.run: _SIMULATED | _RENDERED | {"--set", "--allow-outside"},
    InputKind.recording: frozenset({"--allow-outside", "--scene"}),
}


def input_kind(given: str, keys: Collection[str]) -> InputKind:
    """The kind of an input, by its name, its place and, of a ``.npy`` file, the keys that `--set` gives.

    A name without an end that is no folder counts as a scene, so that an unknown one is answered with the known ones.

    Raises
    ------
    SpecError
        If it is a YAML file that cannot be read.
    """
    path = Path(given)
    end = path.suffix.lower()
    if given in list_names("scenes"):
        return InputKind.scene
    if os.path.isdir(given):
        names = os.listdir(given)
        if "recording.json" in names:
            return InputKind.recording
        return InputKind.cube if any(map(_CAVE.fullmatch, names)) else InputKind.video
    if end in (".yaml", ".yml") and os.path.isfile(given):
        from hesim_render.specs.run import is_run_file

        return InputKind.run if is_run_file(path) else InputKind.scene
    if end in _CUBES or (end == ".npy" and "wavelength_nm" in keys):
        return InputKind.cube
    return InputKind.video if end and end not in (".yaml", ".yml") else InputKind.scene


def was_given(value: object) -> bool:
    """Whether an option of the command line has a value of its own; 0 is one, although it equals False."""
    return value is not None and value is not False and value != []


def check_options(kind: InputKind, given: Mapping[str, Any]) -> None:
    """Refuse options that this kind of input does not take.

    Parameters
    ----------
    kind : of the input.
    given : options of the command line and their values; what was not given is None, False or empty.
    """
    for name, value in given.items():
        if was_given(value) and name not in _TAKEN[kind]:
            able = [each.value for each, names in _TAKEN.items() if name in names]
            raise ConflictError(name, value, f"{name}: the input is {kind.value}; only {' or '.join(able)} takes this")


def with_values(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of `--set` for a video or cube: a camera file is read, and FIRST:LAST:STEP becomes wavelengths."""
    made = dict(keys)
    if isinstance(made.get("camera"), str):
        from hesim_render.mosaic.colour_profile import load_camera

        made["camera"] = load_camera(Path(made["camera"]))
    if isinstance(made.get("wavelength_nm"), str):
        made["wavelength_nm"] = parse_bands(made["wavelength_nm"], "wavelength_nm")
    return made
