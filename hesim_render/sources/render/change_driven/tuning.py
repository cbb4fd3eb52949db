"""Constants of change-driven rendering, in one place.

Each says where it comes from by a letter:

- F: fitted on the scenes `star`, `sweep` and `glass` of `benchmarks/change_driven.py` (the gains by
  `benchmarks/allocation.py`).
- H: the scenes of `tests/support/hidden_scenes.py`, on which nothing was fitted, showed that it is needed and how
  large.
- C: chosen, not fitted: a bound on work, or a size that follows from the others.

All were judged on the scenes of `tests/support/random_scenes.py` and of `tests/support/hidden_scenes.py`; none was
chosen on the former.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tuning:
    """How the rays of a run are spent.

    A *wanted error* is quality times the noise of the pixel, in its flux. Ray numbers are of one pixel in one window or
    exposure. "Without" says what happens where a constant is left out of the method.

    Parameters
    ----------
    pilot_rays : rays, F. Of the pilot pass where a role's pixels lie next to each other; they tell whether a pixel
        changes and how many rays it gets. Half as many: edges are seen in steps of an eighth of a pixel.
    lone_pilot_rays : rays, F. The same where pixels lie apart (event pixels of a hybrid tile). Without (as few as
        `pilot_rays`): such pixels have no neighbours to ask, and changes are missed.
    frame_pilot_rays : rays, H. Of the pilot of a frame pixel in an exposure. Without: what passes in a small part of
        the exposure is missed.
    zoom_rays : rays, H. Most that a pilot sends to a pixel by which something comes that it could miss; a pair gets as
        many, if the thing is small. Without: objects smaller than a pixel come and go unseen, or are met by one ray
        that weighs far too much.
    zoom_room, gloss_room : rays over pixels of the picture, C. All these rays in a window, for small things and for
        others. Without: a scene of many small or glossy objects takes more rays for looking than for its picture.
    zoom_margin_px : px, C. Added around their outlines. Without: a pixel that an outline only touches is not looked at.
    small_px : px, F. Largest least extent of a thing that is small. Without (0): as without `zoom_rays`.
    footprint_px : px, F. Width of the area in which the pilot's rays start. Without (1): edges are noticed only after
        they have entered the pixel.
    lone_footprint_px : px, F. The same where pixels lie apart. Without: as above, with no neighbour to notice them.
    tolerance : wanted errors, C. Deviation of a value up to which it is not called off. Without: nothing
        says how far from the truth a straight line may be.
    change : tolerances, F. Change of a pilot's flux that counts. Larger: what is filled in is further off; smaller:
        more pixels are rendered.
    great : changes that count, F. From such a change on, the pixels next to it are rendered too. Without: an edge's
        faint outskirts are filled in by straight lines.
    huge : changes that count, F. From such a change on, those two pixels away are rendered too. Without: as above, of
        lamps and their glare.
    huge_windows : windows, F. How much longer, before and after, a huge change counts. Without (0): the first trace of
        a lamp that comes is filled in.
    least_rays : rays, C. Fewest of a pair: two halves of four. Without: the difference of the halves tells no error.
    ray_weight : wanted errors, H. What a single ray of a pair brings at most. Without: a ray that sees what no pilot
        ray saw (a lamp through a gap) makes a value that is far off, and its stated error with it.
    most_rays : rays, C. Most of a pair. Without: one pixel that sees a lamp in a rough mirror takes all the time.
    matt_gain, path_gain : (factor, power), no unit, F. Standard error of n stratified rays is factor · n^-power of
        the scatter, for direct light on matt surfaces and for paths. Without (1, 0.5): the error of independent rays
        is planned for, which takes several times as many.
    frame_margin : factor, H. By which the wanted error of an exposure is smaller than `quality` says. Without (1): the
        error is too large where much moves within the exposure, as rays gain less there than the fit says.
    unseen_area : part of a pixel, F. In which the pilot may have missed what the next pixels show. Without (0): an edge
        that the pilot of 16 rays just missed gets the rays of an even area.
    most_unseen_rays : rays, F. Most that a pair gets for that. Without: every pixel next to a lamp gets `most_rays`.
    bright_rays : rays per noise unit, F. That a pair gets where a pixel up to two away is brighter by one. Without (0):
        as without `unseen_area`, next to lamps.
    knot_factor : factor, F. Times as many rays where a pair ends a block. Without (1): the straight lines of all
        windows that are filled in from there carry its error.
    audit_pilot_rays : rays, C. Of the audit's own pilot. Without (as few as `pilot_rays`): the audit's reference has
        as poor a plan as the values that it judges.
    least_audit_rays : rays, C. Fewest of the audit's trace. Without: as above.
    audit_ray_weight : wanted errors of the audit, C. As `ray_weight`. Without (as large): the reference is no better
        than what it judges.
    most_audit_times : traces, C. Most of one value. Without: a few values take the time of the whole audit.
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
