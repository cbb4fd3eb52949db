"""What each figure of the report means: one sentence, its formula, and how it is measured."""

from typing import NamedTuple


class Definition(NamedTuple):
    """A figure.

    Parameters
    ----------
    title : its name.
    sentence : what it is.
    formula : of the estimate.
    method : the recordings that it takes.
    """

    title: str
    sentence: str
    formula: str
    method: str


EVENTS: dict[str, Definition] = {
    "threshold": Definition(
        "threshold θ",
        "Change of the logarithm of the light that a pixel answers in half of the cases, mean over pixels.",
        "p(s) = q + (1 − q)·Φ((s − θᵢ)/σ), θᵢ ~ N(θ, τ²), s = ln(L₁/L₀)",
        "steps of several contrasts from one light, each many times; likelihood of the counts of every pixel",
    ),
    "threshold_spread_percent": Definition(
        "spread of thresholds",
        "Standard deviation of the thresholds over pixels, relative to their mean.",
        "τ/θ", "as the threshold",
    ),
    "pixel_noise": Definition(
        "width of single S-curves",
        "Standard deviation of the normal law by which the answers of one pixel go from never to always.",
        "σ", "as the threshold",
    ),
    "contrast_sensitivity": Definition(
        "contrast sensitivity",
        "Smallest relative change of the light that an average pixel answers in half of the cases.",
        "C₊ = e^θ₊ − 1, C₋ = 1 − e^−θ₋", "from the threshold",
    ),
    "threshold_by_counts": Definition(
        "threshold θ by counts",
        "Swing of the logarithm of slow light that adds one event of an average pixel to each cycle.",
        "(A₂ − A₁)/(n₂ − n₁), n with the events that the dead time T swallows, 2π²·f·T·(1/√(1 − d²) − 1)/θ²",
        "continuous modulation of one low frequency with two large swings; it takes no reset of the pixels",
    ),
    "latency": Definition(
        "latency",
        "Median time from a jump of the light to the first event of its polarity, over answered jumps of all pixels.",
        "median(tᵢⱼ − t_jump), until the next jump",
        "steps of one contrast at several lights",
    ),
    "jitter": Definition(
        "jitter of the latency",
        "Standard deviation of a pixel's latency from jump to jump: that of the normal law with the same 68 % range of "
        "differences.",
        "q₆₈.₂₇(|tᵢ,₂ⱼ₊₁ − tᵢ,₂ⱼ|)/√2", "as the latency",
    ),
    "background": Definition(
        "background",
        "Events of a pixel per second in light that does not change, mean over all pixels.",
        "n/(pixels·T)", "steady recordings; jackknife over 20 groups of pixels",
    ),
    "doubling": Definition(
        "doubling of the background",
        "Rise of the sensor's temperature that doubles the background.",
        "ln 2/b of ln(rate) = a + b·T", "steady recordings of one light at several temperatures",
    ),
    "least_light": Definition(
        "lowest light",
        "Lowest illuminance at which steps of two thresholds are found 90 of 100 times, less those that chance finds.",
        "(p − q)/(1 − q) = 0.9, its probit linear in ln L between two lights",
        "steps of 2θ at several lights; q from steady recordings cut into windows of the same length",
    ),
    "most_light": Definition(
        "highest light", "Highest illuminance for which the same holds.", "as the lowest light", "as the lowest light"
    ),
    "dynamic_range": Definition(
        "dynamic range", "Ratio of the highest to the lowest light.", "20·log₁₀(L_max/L_min)", "from both"
    ),
    "bandwidth": Definition(
        "bandwidth",
        "Frequency above which the swing of modulated light that is answered in half of the cycles or bursts exceeds "
        "√2 times that at the lowest frequency.",
        "A₅₀(f) = √2·A₅₀(f_min), A = ln(L_max/L_min); linear in ln f and ln A",
        "light modulated at several frequencies and depths: always (an answer is an ON event in a cycle), or in bursts "
        "with pauses longer than the dead time (any event in a burst)",
    ),
    "dead_time": Definition(
        "dead time",
        "Time after an event in which a pixel gives no other, and in which the fastest light changes by a threshold: "
        "where a step of the density of the intervals takes as many of them away as there are missing.",
        "K + ½ − Σ n(k ≤ K)/n(after), k in steps of the clock",
        "all recordings",
    ),
    "readout_limit": Definition(
        "read-out limit",
        "Most events per second that the sensor puts out: the content of the fullest windows of 1 ms, where these are "
        "equally full.",
        "max n/1 ms", "all recordings",
    ),
    "hot": Definition(
        "hot pixels",
        "Share of pixels with more than ten times the usual ON events in every steady recording.",
        "n > Poisson quantile of 10·rate", "two steady recordings at least",
    ),
    "dead": Definition(
        "dead pixels",
        "Share of pixels that answer fewer than half of the largest steps.",
        "n(share of answers < 1/2)/pixels", "the largest steps of the S-curve",
    ),
}  # fmt: skip

FRAMES: dict[str, Definition] = {
    "K": Definition("system gain K", "Digital numbers per electron.", "slope of σ_y² − σ_y.dark² over μ_y − μ_y.dark",
                    "pairs, 0 to 70 % of saturation"),
    "responsivity": Definition("responsivity R", "Digital numbers per photon on a pixel.",
                               "slope of μ_y − μ_y.dark over μ_p", "pairs"),
    "quantum_efficiency": Definition("quantum efficiency η", "Electrons per photon on a pixel, of the light used.",
                                     "R/K", "pairs"),
    "temporal_dark_noise_e": Definition("temporal dark noise σ_d", "Noise of a dark pixel from frame to frame at no "
                                        "exposure, without that of rounding.", "√(σ_y.dark² − 1/12)/K", "dark pairs"),
    "threshold_e": Definition("absolute sensitivity threshold, electrons", "Signal that equals its noise.",
                              "√(σ_d² + 1/(12 K²)) + 1/2", "from σ_d"),
    "threshold_photons": Definition("absolute sensitivity threshold, photons", "The same in photons.",
                                    "(√(σ_d² + 1/(12 K²)) + 1/2)/η", "from σ_d and η"),
    "full_well_e": Definition("saturation capacity", "Electrons at the largest temporal variance.",
                              "η·μ_p.sat", "pairs"),
    "snr_max": Definition("largest signal-to-noise ratio", "Ratio at saturation, of shot noise alone.",
                          "20·log₁₀ √μ_e.sat", "from the saturation capacity"),
    "dynamic_range": Definition("dynamic range", "Ratio of saturation to the sensitivity threshold.",
                                "20·log₁₀(μ_e.sat/μ_e.min)", "from both"),
    "dark_current_e_per_s": Definition("dark current", "Electrons per second and pixel in the dark.",
                                       "slope of μ_y.dark over exposure, over K", "dark pairs"),
    "dsnu_e": Definition("DSNU", "Standard deviation of the offsets over pixels.", "s_y.dark/K", "dark series"),
    "prnu_percent": Definition("PRNU", "Standard deviation of the response over pixels, relative.",
                               "√(s_y² − s_y.dark²)/(μ_y − μ_y.dark)", "lit and dark series"),
    "linearity_error_percent": Definition("linearity error",
                                          "Mean deviation of the signal from a straight line, relative.",
                                          "mean |δ_y|, 5 to 95 % of saturation", "pairs"),
    "row_noise_dn": Definition("temporal row noise", "Noise that the pixels of a row share.", "σ of row means",
                               "dark pairs and series"),
    "column_noise_dn": Definition("temporal column noise", "Noise that the pixels of a column share.",
                                  "σ of column means", "dark pairs and series"),
    "defect_pixels": Definition("defect pixels", "Share of pixels unlike the others in the dark or in the light.",
                                "|x − x̄ around it| > 8 robust σ, or stuck at 0 or full scale", "dark and lit series"),
}  # fmt: skip
