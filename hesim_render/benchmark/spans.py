"""Spans of time of a clip that is being built: the render of each is kept, so that a killed build goes on from there.

The render takes nearly all the time of a clip, so it alone is kept. The sensor's pass goes through the whole clip
again, from the light of the finished spans. Spans are no part of the data: they are removed when their clip is there.
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

from hesim_render.capture.simulate import change_driven_parts
from hesim_render.core.units import US_PER_S

SPANS = "spans"


class Spans:
    """The spans of one clip.

    Parameters
    ----------
    root : folder of the benchmark.
    name : of the clip.
    span_s : simulated time of a span, s; None keeps none.
    """

    def __init__(self, root: Path, name: str, span_s: float | None) -> None:
        self._folder = root / SPANS / name
        self._span_us = None if span_s is None else max(1, round(span_s * US_PER_S))

    def keep(self, source: Any, step: str) -> None:
        """Keep what a renderer gives from now on, and go on from what is kept of this step.

        Parameters
        ----------
        source : from `flux_source`.
        step : of the clip; its questions to the renderer are the same each time.
        """
        if self._span_us is None:
            return
        for number, part in enumerate(change_driven_parts(source)):
            part.keep_in(self._folder / step / str(number), self._span_us)

    def remove(self) -> None:
        """Remove all spans of the clip."""
        shutil.rmtree(self._folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # spans of other clips are in it, or there are none
            self._folder.parent.rmdir()
