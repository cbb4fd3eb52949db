"""What a run asks of its source of flux, what it needs to know of it besides, and the estimate of what a run takes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_pixels
from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress
from hesim_render.mosaic.schedule import BlockSample, Exposure
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.protocol import AuditableFlux, FluxSource


class Renderer(FluxSource, Protocol):
    """A source of flux that can be asked for a whole run.

    The change-driven and the exact renderer of scenes, both of them under flickering light, and videos implement it.
    """

    @property
    def sensor(self) -> Sensor:
        """The sensor, with the lens in use."""

    @property
    def settings(self) -> dict[str, object]:
        """How the source works, for the manifest: plain values."""

    @property
    def quality(self) -> float | None:
        """Wanted error over the sensor's noise; None where no error is asked for."""

    @property
    def auditable(self) -> AuditableFlux | None:
        """The source, if its values can be estimated again with other random numbers."""

    @property
    def work(self) -> dict[str, float]:
        """Work done so far, for the manifest; empty where nothing is counted."""

    def estimate(self, demand: "Demand", progress: Progress | None = None) -> "Estimate":
        """Time and memory of a run. What is computed for it changes no value.

        Parameters
        ----------
        demand : what the run asks for.
        progress : called with (done, total, what).
        """

    def report(self, demand: "Demand", expected: "Estimate | None", progress: Progress) -> None:
        """Report the rays of what rests, which is one long render; nothing else is reported.

        Parameters
        ----------
        demand, expected : what the run asks for, and the estimate of it, if there is one.
        progress : called with (done, total, what).
        """

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """Keep what is traced in a journal, and take from it what is there already.

        Parameters
        ----------
        journal : of the run.
        part : number of this part of the light.
        """


class Untraced:
    """The parts of `Renderer` of a source without rays: it has no error, keeps nothing and counts nothing."""

    quality: None = None
    auditable: None = None

    @property
    def work(self) -> dict[str, float]:
        """See `Renderer.work`."""
        return {}

    def report(self, demand: "Demand", expected: "Estimate | None", progress: Progress) -> None:
        """See `Renderer.report`: there is no long render."""

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """See `Renderer.go_on`: a run that goes on reads its pictures again."""


@dataclass(frozen=True)
class Demand:
    """What a run asks for.

    Parameters
    ----------
    duration_us : length of the run, µs.
    event_pixel, blocks : [n] mosaic indices of event pixels, and a sample of the run's blocks of windows.
    frame_pixel, exposures : [n] mosaic indices of frame pixels, and the exposures of the run.
    """

    duration_us: int
    event_pixel: NDArray[np.uint32]
    blocks: BlockSample
    frame_pixel: NDArray[np.uint32]
    exposures: Sequence[Exposure]

    @property
    def pixels(self) -> NDArray[np.uint32]:
        """Mosaic indices of all pixels that are asked for, each once; those of frames only where there is one."""
        return distinct_pixels(self.frame_pixel if self.exposures else self.frame_pixel[:0], self.event_pixel)


@dataclass(frozen=True)
class Estimate:
    """Estimated time and memory of a run, right to about a factor of two.

    Parameters
    ----------
    seconds : time of the rays, or of the whole run (`hesim_render.capture.overheads`), s.
    peak_bytes : peak memory, bytes.
    rays : total number of rays.
    held_bytes : part of the memory that each part of the light needs anew, bytes.
    audit_rays : rays of the audit of a short run, if the scene needs fewer than the sensor alone lets expect.
    ray_s : time of a single ray of the picture, s.
    trace_s : time to start a trace of any number of rays, s.
    """

    seconds: float
    peak_bytes: float
    rays: float
    held_bytes: float = 0.0
    audit_rays: float = math.inf
    ray_s: float = 0.0
    trace_s: float = 0.0

    @classmethod
    def together(cls, parts: "Sequence[Estimate]") -> "Estimate":
        """Of a run whose light has several parts, each of which is asked for all of it."""
        return cls(
            seconds=sum(part.seconds for part in parts),
            peak_bytes=parts[0].peak_bytes + sum(part.held_bytes for part in parts[1:]),
            rays=sum(part.rays for part in parts),
            held_bytes=sum(part.held_bytes for part in parts),
            audit_rays=sum(part.audit_rays for part in parts),
            ray_s=max(part.ray_s for part in parts),
            trace_s=max(part.trace_s for part in parts),
        )

    def __str__(self) -> str:
        if self.seconds < 90:
            duration = f"{max(1, round(self.seconds))} s"
        elif self.seconds < 5400:
            duration = f"{self.seconds / 60:.0f} min"
        else:
            duration = f"{self.seconds / 3600:.1f} h"
        return f"about {duration}, {self.peak_bytes / 1e9:.1f} GB, {self.rays / 1e6:.0f} million rays"
