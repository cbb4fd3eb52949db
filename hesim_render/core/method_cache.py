"""Results of a method, remembered without a cycle of references."""

from collections.abc import Callable
from functools import lru_cache
from typing import ParamSpec, TypeVar, cast
from weakref import WeakMethod

Args = ParamSpec("Args")
Result = TypeVar("Result")


def method_cache(method: Callable[Args, Result], maxsize: int) -> Callable[Args, Result]:
    """A bound method that remembers its last results, for an attribute of its own object.

    `functools.lru_cache` would hold the object, which would live until Python looks for cycles. A renderer holds
    surfaces, and every kernel that is compiled lists all surfaces that are about, those of other scenes as well.

    Parameters
    ----------
    method : a bound method; its arguments can be hashed.
    maxsize : number of results.
    """
    weak = WeakMethod(method)

    def call(*args: Args.args, **named: Args.kwargs) -> Result:
        bound = weak()
        assert bound is not None, "the object that holds this is alive"
        return bound(*args, **named)

    return cast("Callable[Args, Result]", lru_cache(maxsize=maxsize)(call))
