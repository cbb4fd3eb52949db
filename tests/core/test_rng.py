"""Streams of random numbers: none is another one under a second name."""

from hesim_render.core.rng import Stream


def test_every_purpose_has_random_numbers_of_its_own():
    """Of two equal values an enumeration makes one member with two names."""
    assert len(Stream.__members__) == len(set(map(int, Stream.__members__.values()))) > 20
    # numbers that recordings were made with
    assert (Stream.APS, Stream.EVS, Stream.EVS_LEAK, Stream.RENDER) == (1, 2, 3, 4)
