"""hesim_render: a physically-rendered scene-to-sensor simulator for hybrid event-frame cameras.

Examples
--------
>>> import hesim_render as hr
>>> sensor = hr.load_sensor("gen2").crop(32, 24)
>>> scene = hr.load_scene("flat-field")
>>> rec = hr.simulate(scene, sensor, duration_s=0.05, seed=7)
>>> rec.frames[0].raw.shape, rec.events.dtype.names
((24, 32), ('t_us', 'x', 'y', 'polarity'))
>>> hr.__version__.count(".") >= 1 or hr.__version__.startswith("0+")
True
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from hesim_render.core import backend as _backend

# Dr.Jit takes the first LLVM it finds when it is imported, and some abort the process: choose before.
_backend.prepare()

try:
    __version__ = version("hesim_render")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+unknown"

# Imported on first use: the command line must answer --help without loading a renderer.
_HOMES = {
    "HesimError": "hesim_render.core.errors",
    "HesimWarning": "hesim_render.core.errors",
    "ImuModel": "hesim_render.sources.render.truth.imu",
    "Recording": "hesim_render.recording.recording",
    "Scene": "hesim_render.sources.scene",
    "SceneTruth": "hesim_render.sources.render.truth.scene_truth",
    "Sensor": "hesim_render.sensor.sensor",
    "load_scene": "hesim_render.sources.scene",
    "load_sensor": "hesim_render.sensor.sensor",
    "photocurrent": "hesim_render.sensor.photocurrent",
    "read_spectral_exr": "hesim_render.sources.render.cube",
    "render_cube": "hesim_render.sources.render.cube",
    "rig_scenes": "hesim_render.sources.render.truth.rig",
    "simulate": "hesim_render.capture.simulate",
    "simulate_cube": "hesim_render.capture.simulate_cube",
    "simulate_video": "hesim_render.capture.simulate_video",
    "study": "hesim_render.studies.run",
    "write_spectral_exr": "hesim_render.sources.render.cube",
}

__all__ = [
    "HesimError",
    "HesimWarning",
    "ImuModel",
    "Recording",
    "Scene",
    "SceneTruth",
    "Sensor",
    "__version__",
    "events",
    "load_scene",
    "load_sensor",
    "photocurrent",
    "read_spectral_exr",
    "render_cube",
    "rig_scenes",
    "simulate",
    "simulate_cube",
    "simulate_video",
    "study",
    "write_spectral_exr",
]

if TYPE_CHECKING:
    from hesim_render import events
    from hesim_render.capture.simulate import simulate
    from hesim_render.capture.simulate_cube import simulate_cube
    from hesim_render.capture.simulate_video import simulate_video
    from hesim_render.core.errors import HesimError, HesimWarning
    from hesim_render.recording.recording import Recording
    from hesim_render.sensor.photocurrent import photocurrent
    from hesim_render.sensor.sensor import Sensor, load_sensor
    from hesim_render.sources.render.cube import read_spectral_exr, render_cube, write_spectral_exr
    from hesim_render.sources.render.truth.imu import ImuModel
    from hesim_render.sources.render.truth.rig import rig_scenes
    from hesim_render.sources.render.truth.scene_truth import SceneTruth
    from hesim_render.sources.scene import Scene, load_scene
    from hesim_render.studies.run import study


def __getattr__(name: str) -> Any:
    if name == "events":  # a package of functions, used as hr.events.voxel_grid
        return importlib.import_module("hesim_render.events")
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'hesim_render' has no attribute {name!r}")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
