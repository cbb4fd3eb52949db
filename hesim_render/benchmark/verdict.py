"""Sentences on an evaluation: which method loses to doing nothing, in how many items, and why that happens."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from hesim_render.benchmark.tasks import Score

#: Of each task: the method that does nothing, the measure that decides, and 1 where more of it is better, else −1.
NOTHING = {
    "deblur": ("blurred", "raw_psnr_db", 1),
    "interpolate": ("hold", "raw_psnr_db", 1),
    "denoise": ("none", "f1", 1),
    "fidelity": ("none", "chamfer_px", -1),
    "flow": ("zero", "epe_px", -1),
    "hdr": ("shortest", "psnr_mu_db", 1),
}
#: Why a method may lose; ``{nothing}`` is the mean of doing nothing.
_WHY = {
    "deblur": "doing nothing has {nothing:.3g} dB because little blurs, so there is little to gain, and a method adds "
    "errors everywhere",
    "interpolate": "doing nothing has {nothing:.3g} dB because little changes from frame to frame, and a method adds "
    "errors everywhere",
    "denoise": "F1 of {nothing:.3g} without a filter says that many events are signal, of which a filter drops more "
    "than it gains by the noise that it drops",
    "fidelity": "the events are {nothing:.3g} px from the true ones without a filter, and signal that a filter drops "
    "moves them away",
    "flow": "pixels move by {nothing:.3g} px in the mean, which is the error of zero; a method is wrong also where "
    "nothing moves",
    "hdr": "the shortest exposure has {nothing:.3g} dB; what moves between exposures leaves ghosts in a merge",
}
#: Methods that count a threshold for each event.
_INTEGRALS = ("double-integral",)


def verdicts(scores: Sequence[Score], ticked: Collection[str] = ()) -> list[str]:
    """One sentence for each method that is worse than doing nothing, over the items that both have.

    Parameters
    ----------
    scores : of clips and their items.
    ticked : clips whose event pixels compare at fixed ticks.
    """
    result = []
    for task, (nothing, measure, way) in NOTHING.items():
        own = [score for score in scores if score.task == task]
        idle = _values(own, nothing, measure)
        for method in dict.fromkeys(score.method for score in own if score.method != nothing):
            values = _values(own, method, measure)
            both = [item for item in values if item in idle]
            if not both:
                continue
            pairs = np.array([(values[item], idle[item]) for item in both])
            gain = way * (pairs[:, 0] - pairs[:, 1])
            if gain.mean() >= 0:
                continue
            mean = pairs.mean(axis=0)
            text = (
                f"{task}: {method} loses to doing nothing ({nothing}): {measure} {mean[0]:.4g} in place of "
                f"{mean[1]:.4g}, worse in {np.count_nonzero(gain < 0)} of {gain.size} items. Why: "
                f"{_WHY[task].format(nothing=mean[1])}"
            )
            of_ticks = sum(clip in ticked for clip, _ in both)
            if method in _INTEGRALS and of_ticks:
                text += (
                    f"; {of_ticks} of the items are of pixels with a fixed tick, whose events do not say by how much "
                    "the light changed"
                )
            result.append(text)
    return result


def _values(scores: Sequence[Score], method: str, measure: str) -> dict[tuple[str, int], float]:
    """The finite values of a measure, by clip and item."""
    return {
        (score.clip, score.item): score.values[measure]
        for score in scores
        if score.method == method and np.isfinite(score.values.get(measure, np.nan))
    }
