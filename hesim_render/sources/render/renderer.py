"""Renderers of scenes: what a run needs of them, and the one of flickering lights."""

from collections.abc import Callable, Sequence
from typing import Protocol

from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.flicker import FlickerFlux
from hesim_render.sources.protocol import AuditableFlux
from hesim_render.sources.render.camera import View
from hesim_render.sources.renderer import Demand, Estimate, Renderer
from hesim_render.sources.scene import Scene, light_parts
from hesim_render.spectral.waveform import Waveform


class SceneRenderer(Renderer, Protocol):
    """A renderer of a scene."""

    @property
    def view(self) -> View:
        """The placed camera at rest."""

    @property
    def samples(self) -> int | None:
        """Rays per pixel and slice, where all pixels get the same number; None where each gets what its error takes."""


class FlickerRenderer(FlickerFlux):
    """A scene under flickering lights: one renderer for each waveform; implements `SceneRenderer`.

    Parameters
    ----------
    waveforms : waveform of each renderer; None is steady.
    sources : renderers of the same scene and camera, each with the lights of its waveform.
    window_us : length of the window in which event pixels integrate, µs.
    """

    def __init__(
        self, waveforms: Sequence[Waveform | None], sources: Sequence[SceneRenderer], window_us: float
    ) -> None:
        super().__init__(waveforms, sources, window_us)
        self.renderers = tuple(sources)

    @property
    def sensor(self) -> Sensor:
        """The sensor, with the lens in use."""
        return self.renderers[0].sensor

    @property
    def view(self) -> View:
        """The placed camera at rest."""
        return self.renderers[0].view

    @property
    def samples(self) -> int | None:
        """See `SceneRenderer.samples`."""
        return self.renderers[0].samples

    @property
    def settings(self) -> dict[str, object]:
        """See `Renderer.settings`."""
        return self.renderers[0].settings

    @property
    def quality(self) -> float | None:
        """See `Renderer.quality`."""
        return self.renderers[0].quality

    @property
    def auditable(self) -> AuditableFlux | None:
        """See `Renderer.auditable`."""
        return None if any(part.auditable is None for part in self.renderers) else self

    @property
    def work(self) -> dict[str, float]:
        """See `Renderer.work`."""
        parts = [part.work for part in self.renderers]
        total = {name: sum(part[name] for part in parts) for name in parts[0]}
        return total | ({} if self.quality is None else {"quality": self.quality})

    def estimate(self, demand: Demand, progress: Progress | None = None) -> Estimate:
        """See `Renderer.estimate`."""
        estimates = []
        for number, part in enumerate(self.renderers):
            if progress is not None:
                progress(number, len(self.renderers), "estimate")
            estimates.append(part.estimate(demand))
        return Estimate.together(estimates)

    def report(self, demand: Demand, expected: Estimate | None, progress: Progress) -> None:
        """See `Renderer.report`."""
        for part in self.renderers:
            part.report(demand, expected, progress)

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """See `Renderer.go_on`."""
        for number, renderer in enumerate(self.renderers, start=part):
            renderer.go_on(journal, number)


def flickering(
    scene: Scene, make: Callable[[Scene, Waveform | None], SceneRenderer], window_us: float = 1.0
) -> SceneRenderer:
    """The renderer of a scene with steady or flickering lights.

    Parameters
    ----------
    scene : with or without waveforms.
    make : builds the renderer of one part of the light; called once where no light flickers. The second argument is
        the waveform of the part's lights, None if they are steady.
    window_us : length of the window in which event pixels integrate, µs. Samples follow a jump of the light through it.
    """
    parts = light_parts(scene)
    if len(parts) == 1 and parts[0][0] is None:
        return make(parts[0][1], None)
    waveforms = [waveform for waveform, _ in parts]
    return FlickerRenderer(waveforms, [make(part, waveform) for waveform, part in parts], window_us)


def reported(progress: Progress, total: float) -> Callable[[int], None]:
    """Progress of one long render: rays done out of all rays."""
    return lambda rays: progress(min(rays, total), total, "rays")
