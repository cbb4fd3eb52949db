"""What a run needs to know of its source besides the flux."""

from __future__ import annotations

from typing import Protocol

from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.demand import Demand, Estimate
from hesim_render.sources.protocol import AuditableFlux, FluxSource


class Renderer(FluxSource, Protocol):
    """A source of flux that can be asked for a whole run.

    The change-driven and the exact renderer of scenes, both of them under flickering light, and videos implement it.
    """

    @property
    def sensor(self) -> Sensor:
        """The sensor, with the lens in use."""
        ...

    @property
    def settings(self) -> dict[str, object]:
        """How the source works, for the manifest: plain values."""
        ...

    @property
    def quality(self) -> float | None:
        """Wanted error over the sensor's noise; None where no error is asked for."""
        ...

    @property
    def auditable(self) -> AuditableFlux | None:
        """The source, if its values can be estimated again with other random numbers."""
        ...

    @property
    def work(self) -> dict[str, float]:
        """Work done so far, for the manifest; empty where nothing is counted."""
        ...

    def estimate(self, demand: Demand, progress: Progress | None = None) -> Estimate:
        """Time and memory of a run. What is computed for it changes no value.

        Parameters
        ----------
        demand : what the run asks for.
        progress : called with (done, total, what).
        """
        ...

    def report(self, demand: Demand, expected: Estimate | None, progress: Progress) -> None:
        """Report the rays of what rests, which is one long render; nothing else is reported.

        Parameters
        ----------
        demand, expected : what the run asks for, and the estimate of it, if there is one.
        progress : called with (done, total, what).
        """
        ...

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """Keep what is traced in a journal, and take from it what is there already.

        Parameters
        ----------
        journal : of the run.
        part : number of this part of the light.
        """
        ...


class Untraced:
    """The parts of `Renderer` of a source without rays: it has no error, keeps nothing and counts nothing."""

    quality: None = None
    auditable: None = None

    @property
    def work(self) -> dict[str, float]:
        """See `Renderer.work`."""
        return {}

    def report(self, demand: Demand, expected: Estimate | None, progress: Progress) -> None:
        """See `Renderer.report`: there is no long render."""

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """See `Renderer.go_on`: a run that goes on reads its pictures again."""
