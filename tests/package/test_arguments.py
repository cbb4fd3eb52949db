"""Arguments of functions at their limits: the last value that is taken and the first that is not."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture import lab
from hesim_render.capture.run_settings import checked_seed
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.isp.denoise import reduce_noise
from hesim_render.isp.tone import tone_local
from hesim_render.mosaic.schedule import require_countable
from hesim_render.sources.render.cube import _check_bands
from hesim_render.sources.video.arrays import picture_bits
from hesim_render.sources.video.inversion import _unit
from hesim_render.spectral.patches import _of_lab
from hesim_render.studies import ChannelNoise, light_for_snr

PICTURE = np.full((9, 8, 3), 0.3, np.float32)
EVENTS = np.array([(0, 2, 1, 1), (90, 0, 0, -1)], hr.events.EVENT_DTYPE)
NOISE = ChannelNoise(*(np.array([x]) for x in (4.0, 1.3, 0.01, 2.0)))
DARK = SimpleNamespace(spec=hr.load_scene("flat-field", {"light": {"type": "none"}}).spec)
TICKS, FREE = (
    SimpleNamespace(spec=SimpleNamespace(evs=SimpleNamespace(reference=name)))
    for name in ("previous_sample", "last_event")
)


def session(sensor=TICKS, frames=8, ticks=2**31 - 1, trials=4, seed=0, parts=0, exposures=(1, 2)):
    lab._require(sensor, frames, ticks, trials, seed, parts, {"exposures_us": exposures})


def countable(duration_us, tick_us=None, rate_hz=None, events=True):
    aps = None if rate_hz is None else SimpleNamespace(frame_rate_hz=rate_hz)
    require_countable(aps, SimpleNamespace(tick_us=tick_us) if events else None, duration_us)


LIMITS = [  # function, keys that are right, keys that are not
    (session, [{}, {"trials": 2**16 - 1}, {"seed": 2**64 - 1}, {"parts": 8, "ticks": 80}, {"ticks": 1},
               {"sensor": FREE, "parts": 8}, {"sensor": FREE, "parts": 8191}],
     [{"frames": 7}, {"ticks": 0}, {"ticks": 2**31}, {"trials": 3}, {"trials": 2**16}, {"seed": -1}, {"seed": 2**64},
      {"exposures": (0, 2)}, {"exposures": (2,)}, {"exposures": (2, 2, 3)}, {"parts": 7, "ticks": 70},
      {"parts": 8, "ticks": 81}, {"sensor": FREE, "parts": 7}, {"sensor": FREE, "parts": 8192}]),
    (checked_seed, [{"seed": 0}, {"seed": 2**64 - 1}], [{"seed": -1}, {"seed": 2**64}, {"seed": 3.0}, {"seed": "7"}]),
    (lambda **keys: reduce_noise(PICTURE, **keys), [{"luma": 0.0, "chroma": 0.1}, {"luma": 0.1, "chroma": 0.0}],
     [{"luma": -1e-9}, {"chroma": -1e-9}]),
    (lambda **keys: tone_local(PICTURE, **keys), [{"compression": 1.0, "detail": 0.0}, {"detail": 4.0}],
     [{"compression": 0.0}, {"compression": 1.01}, {"detail": -0.01}, {"detail": 4.01}]),
    (countable, [{"duration_us": 2**32 - 1}, {"duration_us": 10**12, "events": False},
                 {"duration_us": 1_400_000_000, "tick_us": 70},
                 {"duration_us": 50_000_000_000, "rate_hz": 40.0, "events": False}],
     [{"duration_us": 2**32}, {"duration_us": 10**12 + 1, "events": False},
      {"duration_us": 1_400_000_001, "tick_us": 70},
      {"duration_us": 50_000_000_001, "rate_hz": 40.0, "events": False}]),
    (lambda bands: _check_bands(DARK, np.array(bands)), [{"bands": [360.0, 830.0]}, {"bands": [500.0]}],
     [{"bands": [359.9, 500.0]}, {"bands": [500.0, 830.1]}, {"bands": [500.0, 500.0]}, {"bands": []}]),
    (lambda kind, bits: picture_bits(np.dtype(kind), bits, "a"),
     [{"kind": kind, "bits": bits} for kind, bits in
      (("u1", 1), ("u1", 8), ("u2", 9), ("u2", 16), ("u2", None), ("f8", None))],
     [{"kind": kind, "bits": bits} for kind, bits in
      (("u1", 0), ("u1", 9), ("u2", 8), ("u2", 17), ("f4", 8), ("i2", None), ("u4", None), ("f16", None))]),
    (_unit, [{"luma": (0.0, 0.0, 1e-3)}], [{"luma": (0.5, -0.5, 0.0)}, {"luma": (0.5, 0.5)}]),
    (lambda wanted: light_for_snr(wanted, [1.0], [20.0], NOISE), [{"wanted": 1e-3}], [{"wanted": 0.0}]),
    (lambda lab: _of_lab((lab, 0.0, 0.0), "a", 3), [{"lab": 0.1}, {"lab": 99.5}], [{"lab": -0.1}, {"lab": 100.1}]),
    (lambda **keys: hr.events.event_rate(EVENTS, **keys), [{"interval_us": 30.0}],
     [{"interval_us": 8.9e-6}, {"interval_us": 0.0}]),
    (lambda bins: hr.events.voxel_grid(EVENTS, (2, 3), bins), [{"bins": 1}], [{"bins": 0}]),
    (lambda **keys: hr.ImuModel(**keys), [{"rate_hz": 1e6}, {"gyro_random_walk": 0.0}],
     [{"rate_hz": 1.01e6}, {"rate_hz": 0.0}, {"gyro_random_walk": -1e-9}, {"accelerometer_noise_density": np.inf},
      {"gravity_m_per_s2": (0.0, -9.8)}, {"gravity_m_per_s2": (0.0, -9.8, np.nan)}]),
]  # fmt: skip


@pytest.mark.parametrize(("call", "right", "wrong"), LIMITS)
def test_the_last_that_is_taken_and_the_first_that_is_not(call, right, wrong):
    for keys in right:
        call(**keys)
    for keys in wrong:
        with pytest.raises((RangeError, SpecError)):
            call(**keys)
