"""The run of a scene, step by step: estimate, capture, verdict on the render, geometric truth."""

import warnings
from collections.abc import Callable

from hesim_render.capture.error_meter import ErrorMeter, stated_verdict
from hesim_render.capture.loop import Capture
from hesim_render.capture.overheads import with_overheads, with_workers
from hesim_render.capture.run_settings import Noise, RunSettings
from hesim_render.core.device import dr
from hesim_render.core.errors import SpecError, TooLongError
from hesim_render.core.progress import Progress
from hesim_render.recording.truth_file import EVENTS
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.audit.audit import STRETCHES, Audit
from hesim_render.sources.render.audit.units import NotedFlux
from hesim_render.sources.render.change_driven.flux import QUALITY
from hesim_render.sources.render.renderer import SceneRenderer
from hesim_render.sources.render.truth.scene_truth import SceneTruth
from hesim_render.sources.renderer import Estimate
from hesim_render.sources.scene import Scene


class SceneRun:
    """One run.

    Parameters
    ----------
    renderer : of the scene and sensor.
    noise : models of frame pixels and event pixels.
    settings : of the run.
    progress : called with (done, total, what).
    workers : number of processes that render.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        noise: Noise,
        settings: RunSettings,
        progress: Progress | None,
        workers: int = 1,
    ) -> None:
        self._renderer, self._noise, self._settings, self._progress = renderer, noise, settings, progress
        self._workers = workers
        # a capture knows what the run asks for; this one takes nothing
        self._demand = Capture(renderer, renderer.sensor, *noise, settings.duration_us, settings.seed).demand
        self._errors: dict[str, ErrorMeter] = {}
        self._noted: NotedFlux | None = None

    def expect(self, on_estimate: Callable[[Estimate], None] | None) -> Estimate | None:
        """Estimate the run, where anybody wants to know, and refuse one that is too long.

        Parameters
        ----------
        on_estimate : called with the estimate.

        Returns
        -------
        The estimate; None where nobody asked.

        Raises
        ------
        TooLongError
            If the run takes longer than `RunSettings.max_minutes`.
        """
        renderer, report, most = self._renderer, self._progress, self._settings.max_minutes
        # a bar is worth the estimate of a run whose rays follow its changes; that of the exact mode renders pictures
        is_shown = report is not None and renderer.auditable is not None
        expected: Estimate | None = None
        if is_shown or on_estimate is not None or most is not None:
            expected = with_overheads(
                with_workers(renderer.estimate(self._demand, report), self._workers), renderer.sensor, self._demand,
                audited=self._is_audited, rests=renderer.is_static,
            )  # fmt: skip
        if expected is not None and on_estimate is not None:
            on_estimate(expected)
        if expected is not None and most is not None:
            require_short(expected, most, f"a shorter --duration, a smaller --roi, or {self._cheaper()}")
        if report is not None:
            renderer.report(self._demand, expected, report)
        return expected

    def _cheaper(self) -> str:
        """What takes less time than these settings, in words."""
        if self._renderer.quality is not None:
            return f"a larger error, such as --quality {2 * self._renderer.quality:g}"
        samples = self._renderer.samples or 0
        return f"fewer rays, such as --samples {max(2, samples // 4 * 2)}"

    @property
    def _is_audited(self) -> bool:
        return self._settings.audit and self._renderer.auditable is not None

    def record(self, writer: RecordingWriter) -> None:
        """Capture frames and events; the audit notes some values on their way."""
        source, settings = self._renderer, self._settings
        # units are drawn during the run, before anybody can know their values: the audit cannot choose easy ones
        if self._is_audited:
            spec = source.sensor.spec.evs
            stretch = STRETCHES[spec.reference] if spec is not None else (0, 1, 0)
            frames = 1 if source.is_static else max(1, len(self._demand.exposures))
            windows = round(self._demand.blocks.windows)
            self._noted = NotedFlux(source, self._demand.event_pixel, windows, frames, *stretch, settings.seed)
        capture = Capture(
            self._noted or source, source.sensor, *self._noise, settings.duration_us, settings.seed,
            labels=EVENTS in settings.kinds,
        )  # fmt: skip
        capture.record(writer, self._progress)
        self._errors = capture.errors

    def verdict(self) -> dict[str, object]:
        """The entry ``render`` of the manifest: errors, work, and whether the render is good enough."""
        renderer, errors = self._renderer, self._errors
        result: dict[str, object] = {
            "error_noise": {name: meter.as_dict(renderer.quality) for name, meter in errors.items()}
        }
        result |= renderer.work
        if renderer.samples is not None:
            result["audit"] = stated_verdict(errors, renderer.samples, QUALITY)
        elif renderer.quality is not None and self._noted is not None and renderer.auditable is not None:
            if self._progress is not None:
                self._progress(0, 1, "audit")
            # what the run took on the device is let go
            dr.flush_malloc_cache()
            evs = renderer.sensor.evs if renderer.sensor.spec.evs is not None else None
            pixels, seed = self._demand.event_pixel, self._settings.seed
            result["audit"] = Audit(self._noted, renderer.auditable, renderer.quality, evs, pixels, seed).run()
        return result

    def write_truth(self, writer: RecordingWriter, scene: Scene, sensor: Sensor) -> None:
        """Write the kinds of geometric truth that were asked for.

        Parameters
        ----------
        writer : of the recording.
        scene, sensor : as loaded, in the units of their files.
        """
        report, kinds = self._progress, set(self._settings.kinds)
        if kinds - {EVENTS}:
            step = None if report is None else lambda done, total: report(done, total, "truth")
            writer.write_truth(SceneTruth(scene, sensor), step)
        if EVENTS in kinds:
            try:
                writer.write_event_objects(SceneTruth(scene, sensor))
            except SpecError as error:  # its events have causes all the same
                warnings.warn(f"objects of events are not written: {error}", stacklevel=3)


def require_short(expected: Estimate, most_minutes: float, cheaper: str) -> None:
    """Refuse a run that takes longer than was wanted.

    Parameters
    ----------
    expected, most_minutes : the estimate, and the limit, min.
    cheaper : what takes less time, in words.

    Raises
    ------
    TooLongError
        If it does.
    """
    if expected.seconds > 60 * most_minutes:
        raise TooLongError(
            "max_minutes",
            most_minutes,
            f"this run takes {expected}, and more than {most_minutes:g} min must be allowed: add --yes "
            f"(max_minutes=None), or ask for less: {cheaper}",
        )
