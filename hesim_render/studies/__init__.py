"""Studies of colour filter arrays: colour and noise figures of filter sets, comparison, design, sweeps."""

from hesim_render.studies.colour_error import (
    ColourError,
    MetamerismIndex,
    colour_differences,
    fit_matrix,
    metamerism_index,
)
from hesim_render.studies.colour_noise import (
    ChannelNoise,
    OutputNoise,
    channel_noise,
    dynamic_range_db,
    light_for_snr,
    output_noise,
)
from hesim_render.studies.colour_samples import REFLECTANCE_SETS, ColourSamples, colour_samples, reflectance_set
from hesim_render.studies.filter_sets import with_filter_set
from hesim_render.studies.subspace import LutherResidual, filter_quality, luther_residual, observer, vora_value
from hesim_render.studies.table import Table

__all__ = [
    "REFLECTANCE_SETS",
    "ChannelNoise",
    "ColourError",
    "ColourSamples",
    "LutherResidual",
    "MetamerismIndex",
    "OutputNoise",
    "Table",
    "channel_noise",
    "colour_differences",
    "colour_samples",
    "dynamic_range_db",
    "filter_quality",
    "fit_matrix",
    "light_for_snr",
    "luther_residual",
    "metamerism_index",
    "observer",
    "output_noise",
    "reflectance_set",
    "vora_value",
    "with_filter_set",
]
