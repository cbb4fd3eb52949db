"""Random numbers as a pure function of (seed, stream, pixel, frame or tick).

Every draw comes from Dr.Jit's counter-based Philox4x32 ([salmon2011]; 7 rounds pass BigCrush): the key is made from the
seed and the stream, the counters are the pixel's index on the *full* sensor, the frame or tick, and a draw number.
Nothing depends on chunking, threads, crops or the order of calls.
"""

import math
from enum import IntEnum
from typing import Any

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host

_MASK64 = (1 << 64) - 1


class Stream(IntEnum):
    """Purposes of random numbers. The values are part of the file format: append, never renumber."""

    APS = 1
    EVS = 2
    EVS_LEAK = 3
    RENDER = 4
    PRNU = 16
    DSNU = 17
    DARK_CURRENT = 18
    ROW_OFFSET = 19
    THRESHOLD_ON = 20
    THRESHOLD_OFF = 21
    RENDER_PILOT = 22
    RENDER_ZOOM = 40
    AUDIT = 41
    AUDIT_PILOT = 42
    LIGHT_LEVEL = 43
    LIGHT_LEVEL_PILOT = 44
    ROW_NOISE = 45
    EVENT_DEFECT = 46
    EVENT_DEFECT_RATE = 47
    HOT_EVENTS = 48
    EVENT_FLICKER = 49
    TELEGRAPH = 50
    TELEGRAPH_SHARE = 51
    TELEGRAPH_AMPLITUDE = 52
    EVENT_START = 53
    LEAK_SPREAD = 54
    LEAK_TAIL = 55
    IMU = 60
    RENDER_GLARE = 61
    RENDER_EDGE = 62
    AUDIT_EDGE = 63
    RENDER_DETECTOR = 64
    RENDER_SHARING = 65
    COLUMN_OFFSET = 70
    COLUMN_NOISE = 71
    INTERFERENCE = 72
    COMPARATOR_ON = 73
    COMPARATOR_OFF = 74
    NOISE_SPREAD = 75


def stream_key(seed: int, stream: Stream) -> int:
    """64-bit Philox key of a stream (SplitMix64 finaliser over seed and stream)."""
    z = (int(seed) * 0x9E3779B97F4A7C15 + (int(stream) + 1) * 0xD1B54A32D192ED03) & _MASK64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK64
    return z ^ (z >> 31)


def philox(seed: int, stream: Stream, pixel: Any, index: int = 0) -> Any:
    """Generator for one block of pixels at one frame or tick.

    Key and counters enter as opaque values, so a new seed or tick does not recompile a kernel.

    Parameters
    ----------
    seed, stream : seed of the run, and purpose of the numbers; together they make the key.
    pixel : Dr.Jit UInt32, index of each pixel on the full sensor.
    index : frame or tick number (64 bits are used).
    """
    types = jit()
    key = dr.opaque(types.UInt64, stream_key(seed, stream))
    low = dr.opaque(types.UInt32, int(index) & 0xFFFFFFFF)
    high = dr.opaque(types.UInt32, (int(index) >> 32) & 0xFFFFFFFF)
    return types.Philox4x32(key, pixel, low, high)


def device_normal(seed: int, stream: Stream, index: np.ndarray) -> np.ndarray:
    """Standard normal deviate of every full-sensor index, float32, same shape as `index`.

    Used for device maps (fixed-pattern noise), which depend on the device seed alone.
    """
    types = jit()
    flat = np.ascontiguousarray(index, dtype=np.uint32).ravel()
    if flat.size == 0:  # Dr.Jit has no loop over nothing
        return np.zeros(index.shape, np.float32)
    deviates = philox(seed, stream, from_host(types.UInt32, flat)).next_float32x4_normal()[0]
    return np.array(deviates, dtype=np.float32).reshape(index.shape)


def device_uniform(seed: int, stream: Stream, index: np.ndarray) -> np.ndarray:
    """Number in (0, 1) of every full-sensor index, float64, same shape as `index`; as `device_normal`."""
    flat = np.ascontiguousarray(index, dtype=np.uint32).ravel()
    none = np.zeros(flat.size, np.uint32)
    return uniform(random_words(seed, stream, flat, none, none)[0]).reshape(index.shape)


def random_words(seed: int, stream: Stream, pixel: np.ndarray, index: np.ndarray, draw: np.ndarray) -> np.ndarray:
    """Four random words, uint32 [4, n], of each pixel with an index and a draw of its own, uint32 [n] each."""
    types = jit()
    key = dr.opaque(types.UInt64, stream_key(seed, stream))
    counters = (from_host(types.UInt32, values) for values in (pixel, index, draw))
    words = types.Philox4x32(key, *counters).next_uint32x4()
    dr.eval(words)  # by one kernel for any n; one array of all words would need another kernel for each n
    return np.stack([word.numpy() for word in words])


def uniform(word: np.ndarray) -> np.ndarray:
    """Random words as numbers in the open interval (0, 1), float64."""
    return (word.astype(np.float64) + 0.5) * 2.0**-32


def normal_pair(radius_word: UInt32, angle_word: UInt32) -> tuple[Float, Float]:
    """Two independent N(0, 1) deviates from two UInt32 words [box1958].

    Dr.Jit's own normal generator uses 23 bits for the radius, which makes its tail coarse beyond 5 standard deviations.
    Event thresholds lie there. All 32 bits are used here. The radius word is mapped to the open interval (0, 1), where
    floats are densest at 0: the tail ends at 6.66.

    Parameters
    ----------
    radius_word, angle_word : UInt32, random words.

    Returns
    -------
    first, second : Float, as many as there are words. An unused one costs nothing.
    """
    types = jit()
    uniform = dr.fma(types.Float(radius_word), 2.0**-32, 2.0**-33)
    sine, cosine = dr.sincos(types.Float(angle_word) * (math.tau * 2.0**-32))
    radius = dr.sqrt(-2.0 * dr.log(uniform))
    return radius * cosine, radius * sine
