"""A method that remembers its results keeps nothing alive."""

import gc
from weakref import ref

from hesim_render.core.method_cache import method_cache


class Squares:
    def __init__(self):
        self.asked = []
        self.of = method_cache(self._of, maxsize=2)

    def _of(self, number):
        self.asked.append(number)
        return number**2


def test_results_are_remembered():
    squares = Squares()
    assert [squares.of(number) for number in (3, 3, 4, 3, 5, 4)] == [9, 9, 16, 9, 25, 16]
    assert squares.asked == [3, 4, 5, 4]


def test_the_object_lives_as_long_as_it_is_used():
    squares = Squares()
    squares.of(3)
    alive = ref(squares)
    gc.disable()
    try:
        del squares
        assert alive() is None
    finally:
        gc.enable()
