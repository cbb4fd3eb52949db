"""Old module names: importing one gives the module that holds its content today."""

from __future__ import annotations

import importlib
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

#: Maps old names to current ones, both inside the package.
MOVED = {
    "backend": "core.backend",
    "bands": "core.bands",
    "bench": "capture.bench",
    "camera": "mosaic.colour_profile",
    "colorimetry": "spectral.colorimetry",
    "crosstalk": "sources.crosstalk",
    "dng": "recording.dng",
    "errors": "core.errors",
    "eventfile": "exchange.dsec",
    "evs": "pixels.evs.stage",
    "flicker": "sources.flicker",
    "flux": "sources.protocol",
    "frame": "recording.frame",
    "guard": "core.guard",
    "lab": "capture.lab",
    "layout": "mosaic.layout",
    "manifest": "recording.manifest",
    "noise": "pixels",
    "noise.aps": "pixels.aps.model",
    "noise.arrays": "pixels.arrays",
    "noise.evs": "pixels.evs.model",
    "noise.fixed_pattern": "pixels.aps.fixed_pattern",
    "noise.measured": "pixels.measured",
    "noise.normal": "pixels.normal",
    "noise.photoreceptor": "pixels.evs.photoreceptor",
    "noise.poisson": "pixels.aps.poisson",
    "noise.processes": "pixels.evs.processes",
    "noise.readout": "pixels.evs.readout",
    "noise.refractory": "pixels.evs.refractory",
    "noise.terms": "pixels.terms",
    "npzfile": "core.npz",
    "optics": "sensor.lens",
    "output": "core.output",
    "preview": "recording.preview",
    "progress": "core.progress",
    "radiometry": "sensor.photocurrent",
    "recording.event_file": "exchange.dsec",
    "recording_spec": "recording.manifest_spec",
    "render_error": "capture.error_meter",
    "renderer": "sources.render",
    "renderer._mitsuba": "sources.render.scene.mitsuba_version",
    "renderer.audit": "sources.render.audit.audit",
    "renderer.bounds": "sources.render.transport.motion_bounds",
    "renderer.boxes": "sources.render.transport.swept_boxes",
    "renderer.builder": "sources.render.scene.builder",
    "renderer.camera": "sources.render.camera",
    "renderer.change_driven": "sources.render.change_driven.flux",
    "renderer.changes": "sources.render.change_driven.plan",
    "renderer.clock": "sources.render.change_driven.sample_instants",
    "renderer.compare": "sources.render.audit.compare",
    "renderer.confidence": "sources.render.audit.confidence",
    "renderer.cube": "sources.render.cube",
    "renderer.fleet": "sources.render.transport.many_objects",
    "renderer.flux": "sources.render.exact",
    "renderer.forecast": "sources.render.change_driven.forecast",
    "renderer.frozen": "sources.render.frozen",
    "renderer.images": "sources.render.transport.mirrored_lamps",
    "renderer.irradiance": "sources.render.transport.irradiance",
    "renderer.light_level": "sources.render.light_level",
    "renderer.lights": "sources.render.scene.lights",
    "renderer.matt": "sources.render.transport.matt",
    "renderer.mitsuba_camera": "sources.render.scene.mitsuba_camera",
    "renderer.mitsuba_scene": "sources.render.scene.mitsuba_scene",
    "renderer.moving": "sources.render.transport.moving_scene",
    "renderer.notes": "sources.render.audit.units",
    "renderer.options": "sources.render.change_driven.tuning",
    "renderer.paint": "sources.render.scene.paint",
    "renderer.pairs": "sources.render.change_driven.pair_tracer",
    "renderer.parts": "sources.render.transport.closed_form",
    "renderer.paths": "sources.render.transport.paths",
    "renderer.pilot": "sources.render.change_driven.pilot",
    "renderer.plugins": "sources.render.scene.plugins",
    "renderer.reference": "sources.render.reference",
    "renderer.retrace": "sources.render.change_driven.retrace",
    "renderer.sampler": "sources.render.sampling.sampler",
    "renderer.scene_files": "sources.render.scene.files",
    "renderer.sites": "sources.render.change_driven.neighbours",
    "renderer.specfilm": "sources.render.specfilm",
    "renderer.tables": "core.tables",
    "renderer.targets": "targets.build",
    "renderer.timeline": "sources.render.timeline",
    "renderer.tracer": "sources.render.tracer",
    "renderer.tracks": "sources.render.scene.tracks",
    "renderer.trajectory": "sources.render.scene.trajectory",
    "renderer.wavelengths": "sources.render.sampling.wavelengths",
    "renderer.windows": "sources.render.change_driven.windows",
    "renderer.wish": "sources.render.change_driven.error_target",
    "renderer.zoom": "sources.render.change_driven.small_objects",
    "rng": "core.rng",
    "scene": "sources.scene",
    "schedule": "mosaic.schedule",
    "showcase": "recording.showcase",
    "simulation": "capture.simulate",
    "spectra": "spectral.spectrum",
    "terminal": "cli.terminal",
    "transfer": "spectral.transfer",
    "units": "core.units",
    "video": "sources.video",
    "video.arrays": "sources.video.arrays",
    "video.clock": "sources.video.clock",
    "video.colours": "sources.video.colours",
    "video.file": "sources.video.file",
    "video.flux": "sources.video.flux",
    "video.folder": "sources.video.folder",
    "video.geometry": "sources.video.geometry",
    "video.inversion": "sources.video.inversion",
    "video.linear": "sources.video.linear",
    "video.motion": "sources.video.motion",
    "video.options": "sources.video.options",
    "video.picture": "sources.video.picture",
    "video.pyav": "sources.video.pyav",
    "video_simulation": "capture.simulate_video",
    "waveform": "spectral.waveform",
}

_PACKAGES = ("noise", "renderer", "video")


class _Today(Loader):
    """Loader that returns the current module under an old name, unchanged."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._spec: Any = None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._name)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        package, _, name = fullname.partition(".")
        if package != "hesim_render" or name not in MOVED:
            return None
        return ModuleSpec(fullname, _Today(f"hesim_render.{MOVED[name]}"), is_package=name in _PACKAGES)


def install() -> None:
    """Install the finder for old names."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
