"""Arrays of captures may hold any kind of number that has their values, and nothing else."""

import capture_sets
import numpy as np
import pytest

from hesim_render.calibrate.evs.counts import read_static
from hesim_render.calibrate.evs.steps import read_steps
from hesim_render.core.errors import SpecError
from hesim_render.recording.capture_set import FrameStack, read_captures

WHOLE, REAL = ("u2", "u4", "i2", "i4", "i8"), ("f4", "f8")


@pytest.fixture
def captures(tmp_path):
    """Frames of 8 by 12 px and events of whole numbers in every array."""
    capture_sets.write_frames(tmp_path / "set", size=(8, 12), frames=8)
    arrays = capture_sets.write_events(tmp_path / "set", size=(8, 12), trials=300)
    capture_sets.change(tmp_path / "set" / "evs_static.npz", signal_dn=np.rint(arrays["signal_dn"]))
    counts = np.random.default_rng(4).integers(0, 40, (2, 3, 8, 12))
    np.savez(tmp_path / "set" / "evs_steps.npz", contrast=[-1, 1, 2], signal_dn=7, n_on=counts[0], n_off=counts[1],
             n_trials=50)  # fmt: skip
    return tmp_path / "set"


def frames_of(folder):
    stack = FrameStack(folder / "aps_lit.npz", read_captures(folder).spec)
    return stack.exposures_us.tolist(), np.array([frame.astype(int) for frame in stack]).tolist()


def static_of(folder):
    static = read_static(read_captures(folder))
    return [static.trials, *(np.asarray(each, float).tolist() for session in static.sessions for each in session)]


def steps_of(folder):
    steps = read_steps(read_captures(folder), np.ones((8, 12), bool))
    return [steps.contrast.tolist(), steps.signal_dn, steps.on.tolist(), steps.off_total.tolist(), steps.trials]


@pytest.mark.parametrize(
    ("read", "name", "member", "kinds"),
    [
        (frames_of, "aps_lit", "frames", WHOLE), (frames_of, "aps_lit", "exposures_us", WHOLE + REAL),
        (static_of, "evs_static", "signal_dn", WHOLE + REAL), (static_of, "evs_static", "n_on", WHOLE),
        (static_of, "evs_static", "dark_n_off", WHOLE), (static_of, "evs_static", "n_trials", WHOLE + REAL),
        (steps_of, "evs_steps", "contrast", ("i2", "i8", *REAL)), (steps_of, "evs_steps", "signal_dn", WHOLE + REAL),
        (steps_of, "evs_steps", "n_off", WHOLE), (steps_of, "evs_steps", "n_trials", WHOLE + REAL),
    ],
)  # fmt: skip
def test_kinds_of_an_array(read, name, member, kinds, captures):
    expected = read(captures)
    with np.load(captures / f"{name}.npz") as data:
        value = data[member]
    for kind in kinds:
        capture_sets.change(captures / f"{name}.npz", **{member: value.astype(kind)})
        assert read(captures) == expected, kind
    for kind in (*(REAL if kinds == WHOLE else ()), "?", "c16", "S9"):
        capture_sets.change(captures / f"{name}.npz", **{member: value.astype(kind)})
        with pytest.raises(SpecError):
            read(captures)


@pytest.mark.parametrize(("exposures", "expected"), [
    ([1999.6, 5000.4, 20_000.0], [2000, 5000, 20_000]), ([0.6, 5.0, 9.0], [1, 5, 9]), ([0.4, 5.0, 9.0], None),
    ([np.inf, 5.0, 9.0], None), ([np.nan, 5.0, 9.0], None),
    ([5.2, 4.8, 9.0], None),
])  # fmt: skip
def test_exposures_are_whole_microseconds(exposures, expected, captures):
    """Rounded; two that are then one are one."""
    capture_sets.change(captures / "aps_lit.npz", exposures_us=np.array(exposures))
    if expected is None:
        with pytest.raises(SpecError, match="exposures_us"):
            frames_of(captures)
    else:
        assert frames_of(captures)[0] == expected
