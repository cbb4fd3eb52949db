"""Exact Poisson deviates at every mean, on Dr.Jit."""

import math

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Float64, Generator, Mask, UInt32

#: Transformed rejection is used from this mean on. Its hat function is valid for means of 10 and more.
_REJECTION_FROM = 10.0
#: P(k ≥ 100) at mean 10 is 1e-63.
_SEARCH_LIMIT = 100


def poisson(mean: Float, generator: Generator, words: tuple[UInt32, UInt32] | None = None) -> Float:
    """Poisson deviates, exact to the accuracy of single precision at every mean up to 1e7.

    Below a mean of 10, inversion by sequential search is used, in double precision and with a 64-bit uniform number.
    From 10 on, transformed rejection PTRS [hormann1993] is used without its quick accept step, which cannot save work
    in SIMD lanes. The probabilities of the acceptance test have the saddle-point form of Loader [loader2000], because
    ln k! in single precision would lose all digits of the result to cancellation.

    Parameters
    ----------
    mean : Float, expected count; zero and below give a count of 0.
    generator : Philox4x32 of the same size; it is advanced.
    words : two UInt32 already drawn from `generator`; drawn here where not given.

    Returns
    -------
    Float, whole numbers (exact below 2²⁴).
    """
    if words is None:
        drawn = generator.next_uint32x4()
        words = drawn[0], drawn[1]
    return dr.select(mean < _REJECTION_FROM, _search(mean, *words), _transformed_rejection(mean, generator, *words))


def _search(mean: Float, high: UInt32, low: UInt32) -> Float:
    """Smallest k with P(K ≤ k) > u, for means below 10; 0 elsewhere.

    The distance of u from the cumulative probability is kept in units of the next term μᵏ/k!. A step therefore needs
    one subtraction and one product, and no division.

    Parameters
    ----------
    mean : expected count.
    high, low : words of u, a 64-bit fraction.
    """
    types = jit()
    wide = types.Float64(mean)
    uniform = dr.fma(types.Float64(low), 2.0**-64, types.Float64(high) * 2.0**-32)
    active = (mean > 0.0) & (mean < _REJECTION_FROM)
    inverse = dr.select(active, 1.0 / wide, 0.0)
    rest = dr.select(active, uniform * dr.exp(wide), 0.0)

    def beyond(rest: Float64, count: Float64, inverse: Float64) -> Mask:
        return (rest >= 1.0) & (count < _SEARCH_LIMIT)

    def step(rest: Float64, count: Float64, inverse: Float64) -> tuple[Float64, Float64, Float64]:
        count = count + 1.0
        return (rest - 1.0) * (count * inverse), count, inverse

    count = dr.while_loop((rest, dr.zeros(types.Float64, dr.width(rest)), inverse), beyond, step)[1]
    return types.Float(count)


def _transformed_rejection(mean: Float, generator: Generator, u_word: UInt32, v_word: UInt32) -> Float:
    """Hörmann's PTRS for means of 10 and more; 0 elsewhere."""
    types = jit()
    needed = mean >= _REJECTION_FROM
    mean = dr.maximum(mean, _REJECTION_FROM)
    count, accepted = _propose(mean, u_word, v_word)

    # Philox4x32 objects do not work as loop state in Dr.Jit 1.5: a new one is made from its parts
    key = (types.UInt64(generator.seed[0]) << 32) | types.UInt64(generator.seed[1])
    pixel, low, high = (generator.counter[k] for k in range(3))

    def pending(count: Float, active: Mask, attempt: UInt32) -> Mask:
        return active

    def retry(count: Float, active: Mask, attempt: UInt32) -> tuple[Float, Mask, UInt32]:
        attempt = attempt + 1
        word = types.Philox4x32(key, pixel, low, high ^ (attempt << 16)).next_uint32x4()
        first, first_accepted = _propose(mean, word[0], word[1])
        second, second_accepted = _propose(mean, word[2], word[3])
        return dr.select(first_accepted, first, second), active & ~(first_accepted | second_accepted), attempt

    start = count, needed & ~accepted, dr.zeros(types.UInt32, dr.width(mean))
    count = dr.while_loop(start, pending, retry)[0]
    return dr.select(needed, count, 0.0)


def _propose(mean: Float, u_word: UInt32, v_word: UInt32) -> tuple[Float, Mask]:
    """One proposal of PTRS: a count, and whether it is accepted."""
    types = jit()
    b = dr.fma(dr.sqrt(mean), 2.53, 0.931)
    a = dr.fma(b, 0.02483, -0.059)
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    # u in (-1/2, 1/2) and the distance of u to the nearer end; each is exact where it is small
    signed = types.Int32(u_word)
    to_end = types.UInt32(0x7FFFFFFF) - types.UInt32(dr.select(signed < 0, ~signed, signed))
    u = dr.fma(types.Float(signed), 2.0**-32, 2.0**-33)
    distance = dr.fma(types.Float(to_end), 2.0**-32, 2.0**-33)
    v = dr.fma(types.Float(v_word), 2.0**-32, 2.0**-33)
    a_over_distance = a / distance
    # the integer part of the mean is not part of the float sum, whose rounding would make the cells uneven
    whole = dr.floor(mean)
    count = whole + dr.floor(dr.fma(dr.fma(2.0, a_over_distance, b), u, mean - whole + 0.43))
    hat = a_over_distance / distance + b
    inside = count >= 0.0
    count = dr.maximum(count, 0.0)
    deviance, scale = _log_probability(count, mean)
    return count, inside & (v * inverse_alpha * scale <= hat * dr.exp(-deviance))


def _log_probability(count: Float, mean: Float) -> tuple[Float, Float]:
    """Poisson probability as exp(−deviance)/scale [loader2000]: bd0 plus the Stirling error, and √(2πk)."""
    empty = count == 0.0
    k = dr.maximum(count, 1.0)
    inverse_square = 1.0 / (k * k)
    # ln k! − Stirling's formula, times k: a fit in 1/k² to 3e-7 for every whole k ≥ 1
    stirling_error = dr.fma(dr.fma(4.3781e-4, inverse_square, -2.70597e-3), inverse_square, 0.08332993) / k
    # k ln(k/μ) + μ − k; near k = μ it is computed from 2 artanh(v), v = (k − μ)/(k + μ), without cancellation
    difference = k - mean
    v = difference / (k + mean)
    square = v * v
    series = dr.fma(dr.fma(dr.fma(0.13434421, square, 0.14116871), square, 0.2000384), square, 0.3333332)
    near = dr.fma(2.0 * k * v, square * series, difference * v)
    far = dr.fma(k, dr.log(k / mean), -difference)
    deviance = dr.select(dr.abs(v) < 1.0 / 3.0, near, far) + stirling_error
    return dr.select(empty, mean, deviance), dr.select(empty, 1.0, dr.sqrt(k * math.tau))
