"""Streams of random numbers: none is another one under a second name, and their kernels serve any number of pixels."""

import drjit as dr
import numpy as np

from hesim_render.core.rng import Stream, random_words


def test_every_purpose_has_random_numbers_of_its_own():
    """Of two equal values an enumeration makes one member with two names."""
    assert len(Stream.__members__) == len(set(map(int, Stream.__members__.values()))) > 20
    # numbers that recordings were made with
    assert (Stream.APS, Stream.EVS, Stream.EVS_LEAK, Stream.RENDER) == (1, 2, 3, 4)


def test_words_of_any_number_of_pixels_are_made_by_few_kernels():
    """At most one for each way in which three arrays of the host can be aligned; there was one for each number."""
    pixel = np.arange(40, dtype=np.uint32) * 7 + 3
    whole = random_words(11, Stream.HOT_EVENTS, pixel, pixel + 1, pixel * 2)
    assert whole.dtype == np.uint32 and whole.shape == (4, 40) and np.unique(whole).size == 160
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for size in range(2, 40):
            part = pixel[:size]
            np.testing.assert_array_equal(
                random_words(11, Stream.HOT_EVENTS, part, part + 1, part * 2), whole[:, :size]
            )
        assert 1 <= len({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}) <= 8
