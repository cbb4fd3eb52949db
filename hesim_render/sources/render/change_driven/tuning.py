"""Constants of change-driven rendering, in one place.

A letter says where each constant comes from:

- F: fitted on the scenes `star`, `sweep` and `glass` of `benchmarks/change_driven.py` (the gains by
  `benchmarks/allocation.py`).
- H: required by the scenes of `tests/support/hidden_scenes.py`, which also set its size; nothing was fitted on them.
- C: chosen, not fitted: a bound on work, or a size that follows from the others.

All constants were judged on the scenes of `tests/support/random_scenes.py` and of `tests/support/hidden_scenes.py`.
None was chosen on the random scenes.
"""

from dataclasses import dataclass, replace
from math import ceil, log2

import numpy as np
from numpy.typing import NDArray

#: Quality for which `Tuning.most_rays` holds, and the one from which on no more rays are given.
_QUALITY, FINEST_QUALITY = 0.5, 0.25


@dataclass(frozen=True)
class Tuning:
    """Constants that decide how a run spends its rays.

    The *wanted error* of a pixel is quality times its noise, as flux. Ray numbers are per pixel and window or exposure.
    "Without" states what goes wrong if the method leaves the constant out.

    Parameters
    ----------
    pilot_rays : rays, F. Pilot rays where the pixels of a role are direct neighbours; they decide whether a pixel
        changes and how many rays it gets. Half as many: edges appear to move in steps of 1/8 pixel.
    lone_pilot_rays : rays, F. Pilot rays where these pixels lie apart (event pixels of a hybrid tile). Without (as few
        as `pilot_rays`): changes are missed, because such pixels have no neighbours to show them.
    path_pilot_rays : rays, F. As `pilot_rays`, of asynchronous pixels that see paths; chosen on `room` and `floor-ball`
        of `benchmarks/scenes`, judged on `sky-knot` there. Without (as few as `pilot_rays`): so few of the rays show
        changes of bounced light that windows between rendered ones are further off.
    frame_pilot_rays : rays, H. Pilot rays of a frame pixel in an exposure; of an even one, few rays do. Without:
        objects that pass in a small part of the exposure are missed.
    look_stride : windows, C. The pilot of an asynchronous sensor looks at every so many windows; where two looks
        differ, it looks again half way between, and so on. Within this time, nothing moves by more than 0.8 pixels, so
        that nothing crosses the pixels around between two looks. Without (1): most of a pilot's rays see what the last
        ones saw.
    deep_looks : windows, C. Windows of a block, its ends included, in which the pilot looks at deep shadow where pixels
        lie apart. Without (2): the light of such a pixel is a straight line from one end of a block to the other.
    deep_rays : rays, C. Rays of such a look. Without (as few as `pilot_rays`): they meet no light either.
    deep_weight : wanted errors, H. Unshadowed light of a pixel in deep shadow, at least. Without (0): pixels are looked
        at in which the light that the pilot misses is less than their noise.
    deep_part : part, H. Of the unshadowed light, the pilot sees less than this there. Without (1): every pixel of a
        bright scene is looked at.
    zoom_rays : rays, H. Largest number of pilot rays for a pixel that is crossed by an object which few rays could
        miss; a pair gets as many if the object is small. Without: objects smaller than a pixel come and go unseen, or
        one ray hits them and weighs far too much.
    zoom_room, gloss_room : rays over pixels of the picture, C. Budget of these rays in a window, for small objects and
        for others. Without: a scene of many small or glossy objects spends more rays on the pilot than on its picture.
    zoom_margin_px : px, C. Margin around the outlines of these objects. Without: pixels that an outline only touches
        get no extra rays.
    small_px : px, F. An object is small if its least extent in the image is at most this. Without (0): as without
        `zoom_rays`.
    aim_px : px, C. Rays are aimed at an object whose largest extent in the image is at most this. Without (0): objects
        that cover a thousandth of a pixel need more than `most_rays`.
    aim_rays : rays, C. Pilot rays for a pixel at whose small objects rays are aimed. Without (as many as `zoom_rays`):
        pilot passes of many small objects take longer than the picture.
    footprint_px : px, F. Width of the area in which pilot rays start. Without (1): edges are noticed only after
        they have entered the pixel.
    lone_footprint_px : px, F. The same where pixels lie apart. Without: as above, with no neighbour to notice them.
    tolerance : wanted errors, C. Largest deviation of a value that does not count as off. Without: the error of
        linear interpolation has no limit.
    change : tolerances, F. Smallest change of the pilot's flux that counts. Larger: interpolated values are further
        off. Smaller: more pixels are rendered.
    large_change : changes that count, F. From this size on, the neighbours of a changing pixel are rendered too.
        Without: the faint outskirts of an edge are interpolated.
    extreme_change : changes that count, F. From this size on, pixels two away are rendered too. Without: as above,
        for lamps and their glare.
    extreme_windows : windows, F. An extreme change counts this much longer, before and after. Without (0): the first
        light of an approaching lamp is interpolated.
    least_rays : rays, C. Least number for a pair: two halves of four. Without: the difference of the halves gives no
        error estimate.
    dark_rays : rays, C. Least number for a pair of paths in which the pilot saw no light. Without (as few as
        `least_rays`): highlights and caustics that a pilot misses are missed by the picture too.
    ray_weight : wanted errors, H. Largest contribution of a single ray to a pair. Without: a ray that sees what no
        pilot ray saw (a lamp through a gap) makes a value that is far off, and its stated error with it.
    most_rays : rays, C. Largest number for a pair. Without: one pixel that sees a lamp in a rough mirror takes all the
        time.
    most_fine_rays : rays, C. The same at a quality of 0.25 or better; from 0.5 to 0.25 it grows as 1/quality². Without
        (as few as `most_rays`): no quality reaches what 4096 rays do not.
    diffuse_gain, path_gain : (factor, power), no unit, F. The standard error of n stratified rays is factor · n^-power
        times the scatter, for direct light on diffuse surfaces and for paths. Without (1, 0.5): the plan assumes
        independent rays and spends several times as many.
    bounced_part : wanted errors, F. From `rotating-star` and `camera-sweep` with a ball of plastic, `room` and
        `floor-ball` of `benchmarks/scenes`: where the law of closed forms leaves a larger error of what paths find
        beside them, the law is that of paths. Without (0): every pixel to which light bounces takes the rays of a path
        tracer.
    frame_margin : factor, H. The wanted error of an exposure is divided by this. Without (1): the error is too large
        where much moves within the exposure, because rays gain less there than the fit says.
    unseen_area : part of a pixel, F. Area in which the pilot may have missed what the neighbours show. Without (0): an
        edge that the 16 pilot rays just missed gets the rays of a uniform area.
    most_unseen_rays : rays, F. Largest number that a pair gets for that. Without: every pixel next to a lamp gets
        `most_rays`.
    bright_rays : rays per noise unit, F. Rays for each noise unit by which a pixel up to two away is brighter. Without
        (0): as without `unseen_area`, next to lamps.
    knot_factor : factor, F. Factor on the rays of a pair at the end of a block. Without (1): all windows that are
        interpolated from there carry its error.
    edge_least_rays : rays, C. Pairs that the law gives at least as many rays get decision rays for a line. Without
        (0): decision rays of cheap pairs cost more than they save.
    edge_rays : rays, F. Decision rays of a pair; half of them where these show little contrast. Half as many: the
        strip about a line is wider. Larger: they cost more than they save.
    edge_footprint_px : px, F. Width of the area in which the first half of the decision rays start. Without (1): a
        line that only just enters a pixel, or passes beside it, is not seen.
    edge_contrast_rays : rays per wanted error, F. Rays of a pair with a line for each wanted error of contrast between
        its sides; from the star alone. Without (0): what the decision rays missed makes single values that are far off.
    moving_contrast_rays : rays per wanted error, F. From the star on `eiger` alone: the same of a line that may move
        within the window. Without (as few as `edge_contrast_rays`): single values are far off.
    flat_contrast : wanted errors, C. Where the first half of the decision rays finds less contrast, the second half is
        not traced. Without (0): even pixels take twice as many decision rays.
    low_contrast : wanted errors, F. From the star alone: where decision rays find less contrast, and no line, a pair
        gets the rays that their scatter asks for. Without (0): pixels beside an edge take the rays that its contrast
        asks for.
    flat_part : part, C. Of the rays by the law, a pair in which decision rays find no contrast keeps this part at
        least. Without (0): thin objects between the decision rays make single values that are far off.
    bend_rays : rays, F. From `room` and `floor-ball` of `benchmarks/scenes` alone: rays in each window that the pilot
        marked, of pixels that see paths, which say where the flux bends. Half as many: as many windows are rendered.
        Larger (512): they cost more than they save.
    bend_gain : factor, F. From the same scenes, judged on `sky-knot` there: they look where the marked windows take
        this many times as many rays. Without (0): cheap windows are looked at for as much as rendering them takes.
    bend : wanted errors, F. From the same scenes: largest distance of such a window from the line between others.
        Larger (3): changes are off by more. Without (0): every window is rendered.
    least_difference_rays : rays, C. Least number of rays of a difference. Without: no pilot ray sees a change, and few
        rays see none either.
    difference_gain : factor, C. A pair is rendered as a difference where that takes this many times fewer rays. Without
        (1): windows to compare with are rendered for little.
    difference_part : wanted errors, C. Wanted error of a difference; that of the other window comes on top. Without
        (1): the error of the pair is larger than wanted.
    difference_factor : factor, F. From the star alone, windows 4 to 60 ms apart: the standard error of a difference of
        n rays is this times their scatter over √n, because few rays change, and strata gain little. Without (0.5):
        differences are off by twice what they should.
    unseen_change : rays, F. From the star alone: scatter of differences that the pilot does not show, as a part of all
        light, times the root of the number of its rays in a neighbourhood. Without (0): pixels at the rim of a penumbra
        are off, above all those without neighbours.
    least_shared_rays : rays, C. Pairs of an anchor with as many or more try whether sharing pays. Without (1): the
        trial costs more than it saves.
    least_sharing_gain : factor, F. Chosen on `room` of `benchmarks/scenes`, judged on the built-in Cornell box: least
        reduction of the variance for which pixels share, since a shared ray takes about twice as long. Without (1):
        slower.
    audit_pilot_rays : rays, C. Pilot rays of the audit. Without (as few as `pilot_rays`): the plan of the reference is
        as poor as that of the values it judges.
    least_audit_rays : rays, C. Least number of rays of a reference value. Without: as above.
    audit_ray_weight : wanted errors of the audit, C. As `ray_weight`; these errors are half of the run's. Without
        (twice as large): the reference is no better than the values it judges.
    edge_least_audit_rays : rays, C. As `edge_least_rays`, in the audit. Without (0): most pairs of an audit hold no
        edge, and their decision rays cost more than edges save.
    most_audit_times : traces, C. Largest number of traces of one value. Without: a few values take the time of the
        whole audit.
    """

    pilot_rays: int = 16
    lone_pilot_rays: int = 32
    path_pilot_rays: int = 32
    frame_pilot_rays: int = 64
    look_stride: int = 16
    deep_looks: int = 5
    deep_rays: int = 256
    deep_weight: float = 1024.0
    deep_part: float = 1 / 32
    zoom_rays: int = 256
    zoom_room: float = 64.0
    gloss_room: float = 16.0
    zoom_margin_px: float = 1.0
    small_px: float = 8.0
    aim_px: float = 1.0
    aim_rays: int = 32
    footprint_px: float = 1.25
    lone_footprint_px: float = 1.75
    tolerance: float = 3.0
    change: float = 0.7
    large_change: float = 16.0
    extreme_change: float = 128.0
    extreme_windows: int = 1
    least_rays: int = 8
    dark_rays: int = 64
    ray_weight: float = 2.0
    most_rays: int = 4096
    most_fine_rays: int = 16384
    diffuse_gain: tuple[float, float] = (0.68, 0.70)
    path_gain: tuple[float, float] = (0.46, 0.56)
    bounced_part: float = 0.5
    frame_margin: float = 1.5
    unseen_area: float = 1 / 32
    most_unseen_rays: int = 512
    bright_rays: float = 0.25
    knot_factor: float = 2.0
    edge_least_rays: int = 256
    edge_rays: int = 64
    edge_footprint_px: float = 1.5
    edge_contrast_rays: float = 0.2
    moving_contrast_rays: float = 0.5
    flat_contrast: float = 4.0
    low_contrast: float = 16.0
    flat_part: float = 1 / 8
    bend_rays: int = 256
    bend_gain: float = 1.5
    bend: float = 2.1
    least_difference_rays: int = 64
    difference_gain: float = 4.0
    difference_part: float = 0.5
    difference_factor: float = 0.95
    unseen_change: float = 0.5
    least_shared_rays: int = 512
    least_sharing_gain: float = 2.5
    audit_pilot_rays: int = 64
    least_audit_rays: int = 64
    audit_ray_weight: float = 2.0
    edge_least_audit_rays: int = 1024
    most_audit_times: int = 4

    def at(self, quality: float) -> "Tuning":
        """The constants for a quality: a better one than 0.5 moves the largest number of rays of a pair."""
        moved = self.most_rays << ceil(max(0.0, 2 * log2(_QUALITY / quality)))
        return replace(self, most_rays=max(self.most_rays, min(moved, self.most_fine_rays)))


@dataclass(frozen=True)
class Gain:
    """Error law of stratified rays: standard error = factor · n^-power · scatter, for n rays.

    Parameters
    ----------
    factor, power : constants of the law, no unit; of all pairs, or of each, [n].
    """

    factor: float | NDArray[np.float32]
    power: float | NDArray[np.float32]

    def or_other(self, other: "Gain", where: NDArray[np.bool_]) -> "Gain":
        """This law, or another one where it holds; one for each pair."""
        both = (self.factor, other.factor), (self.power, other.power)
        return Gain(*(np.where(where, theirs, own).astype(np.float32) for own, theirs in both))

    def at(self, place: NDArray[np.int64]) -> "Gain":
        """The laws of some pairs."""
        factor, power = self.factor, self.power
        if isinstance(factor, float) or isinstance(power, float):
            return self
        return Gain(factor[place], power[place])

    def error(self, scatter: NDArray[np.float32], rays: NDArray[np.integer]) -> NDArray[np.float32]:
        """Expected standard error, in the unit of `scatter`."""
        return np.float32(self.factor) * scatter * rays.astype(np.float32) ** (-np.float32(self.power))

    def rays(self, scatter_over_error: NDArray[np.float32]) -> NDArray[np.float32]:
        """Number of rays that reaches a wanted error, from the scatter over that error; not yet rounded to a power
        of two.
        """
        return (np.float32(self.factor) * scatter_over_error) ** np.float32(1 / self.power)


TUNING = Tuning()
