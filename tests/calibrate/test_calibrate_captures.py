"""Reading capture sets: bounded memory, and one clear message for each thing that can be wrong."""

import tracemalloc

import capture_sets
import numpy as np
import pytest

from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration
from hesim_render.calibrate.moments import measure
from hesim_render.core.errors import SpecError
from hesim_render.recording.capture_set import read_captures


@pytest.fixture
def frames(tmp_path):
    folder = tmp_path / "set"
    capture_sets.write_frames(folder, size=32, frames=16)
    return folder


def load(folder, name):
    with np.load(folder / f"{name}.npz") as data:
        return data["frames"].copy(), data["exposures_us"] * 1e-6


def refused(folder, match, calibrate=calibrate_aps):
    out = folder / "out.yaml"
    with pytest.raises(SpecError, match=match) as caught:
        calibrate(folder, out)
    assert "\n" not in str(caught.value)
    assert not out.exists()


def test_moments_are_those_of_numpy_in_any_order_of_exposures(frames):
    stack, exposures = load(frames, "aps_lit")
    order = [2, 0, 1]
    capture_sets.save_frames(frames, "aps_lit", stack[order], exposures[order])
    used = np.ones(stack.shape[2:], bool)
    used[::2, 1::2] = used[3] = False
    moments = measure(read_captures(frames).frames("aps_lit"), used, 1023)
    assert list(moments.exposures_us) == [2000, 5000, 20000]
    np.testing.assert_allclose(moments.mean, stack.mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(moments.variance, stack.var(axis=1, ddof=1), rtol=1e-5)
    np.testing.assert_array_equal(moments.highest, stack.max(axis=1))
    np.testing.assert_array_equal(moments.lowest, stack.min(axis=1))
    rows = (stack * used).sum(axis=3) / np.maximum(used.sum(axis=1), 1)
    np.testing.assert_allclose(moments.row_means, rows, rtol=1e-12)
    cols = (stack * used).sum(axis=2) / np.maximum(used.sum(axis=0), 1)
    np.testing.assert_allclose(moments.col_means, cols, rtol=1e-12)
    for k, first in enumerate(stack[:, 0]):
        clear = used & (first < 0.9 * 1023)
        bright = clear & (first > np.median(first[clear]))
        np.testing.assert_array_equal(moments.half[k], np.where(clear, bright, -1))
        for side, mask in enumerate((clear & ~bright, bright)):
            np.testing.assert_allclose(moments.half_means[k, :, side], stack[k][:, mask].mean(axis=1), rtol=1e-12)


@pytest.mark.parametrize("save", [np.savez, pytest.param(np.savez_compressed, marks=pytest.mark.slow)])
def test_frames_are_read_in_bounded_memory(tmp_path, save):
    capture_sets.write_description(tmp_path)
    stack = np.random.default_rng(0).integers(50, 900, (2, 600, 96, 96), dtype=np.uint16)
    save(tmp_path / "aps_lit.npz", frames=stack, exposures_us=np.array([1000, 2000]))
    tracemalloc.start()
    moments = measure(read_captures(tmp_path).frames("aps_lit"), np.ones((96, 96), bool), 1023)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert stack.nbytes > 20e6
    assert peak < 3e6
    np.testing.assert_allclose(moments.mean, stack.mean(axis=1), rtol=1e-6)


def test_missing_files_say_what_to_capture(frames):
    (frames / "aps_lit.npz").unlink()
    refused(frames, "aps_lit.npz: no such file; capture frames of a static scene")
    refused(frames, "evs_static.npz: no such file; capture counts", calibrate_evs)
    (frames / "capture.yaml").unlink()
    refused(frames, "capture.yaml: no such file; it states bit_depth")


def test_unknown_keys_and_wrong_tiles(frames):
    capture_sets.write_description(frames, bit_deth=10)
    refused(frames, "capture.yaml:4: bit_deth: unknown key")
    capture_sets.write_description(frames, tile_rows=5)
    refused(frames, "not whole tiles of 5×2")
    capture_sets.write_description(frames, sensor="eiger")
    refused(frames, "the tile is 2×2, but that of sensor eiger is 4×4")


def test_frames_of_different_sizes(frames):
    stack, exposures = load(frames, "aps_dark")
    capture_sets.save_frames(frames, "aps_dark", stack[..., :16], exposures)
    refused(frames, "different sizes, 32×16 and 32×32")
    ragged = np.empty(3, object)
    ragged[:] = [np.zeros((4, 8, 8)), np.zeros((4, 8, 6)), np.zeros((4, 8, 8))]
    np.savez(frames / "aps_dark.npz", frames=ragged, exposures_us=[1, 2, 3])
    refused(frames, "frames of different sizes")


def test_one_exposure_only(frames):
    stack, exposures = load(frames, "aps_lit")
    capture_sets.save_frames(frames, "aps_lit", stack[:1], exposures[:1])
    refused(frames, "one exposure only.*capture at least 2 exposures")


def test_not_whole_numbers(frames):
    stack, exposures = load(frames, "aps_lit")
    capture_sets.save_frames(frames, "aps_lit", stack.astype(np.float32), exposures)
    refused(frames, "float32, not whole DN")


def test_values_above_the_bit_depth(frames):
    capture_sets.write_description(frames, bit_depth=8)
    refused(frames, "outside 0 to 255")


def test_too_few_frames_wrong_exposures_and_broken_files(frames):
    stack, exposures = load(frames, "aps_lit")
    capture_sets.save_frames(frames, "aps_lit", stack[:, :4], exposures)
    refused(frames, "4 frames per exposure")
    capture_sets.save_frames(frames, "aps_lit", stack, exposures[:2])
    refused(frames, "2 exposures_us for 3 exposures")
    capture_sets.save_frames(frames, "aps_lit", stack, [1e-3, 1e-3, 2e-3])
    refused(frames, "one exposure twice")
    capture_sets.save_frames(frames, "aps_lit", stack[0], exposures)
    refused(frames, "expected \\[exposure, frame, row, col\\]")
    np.savez(frames / "aps_lit.npz", frames=stack)
    refused(frames, "holds no array 'exposures_us'")
    capture_sets.save_frames(frames, "aps_lit", stack, exposures)
    whole = (frames / "aps_lit.npz").read_bytes()
    (frames / "aps_lit.npz").write_bytes(whole[: len(whole) // 2])
    refused(frames, "cannot be read as an .npz file")


def test_all_dark_and_all_saturated(frames):
    dark, exposures = load(frames, "aps_dark")
    lit, _ = load(frames, "aps_lit")
    capture_sets.save_frames(frames, "aps_lit", dark[:, ::-1], exposures)
    refused(frames, "no light above the dark.*capture longer exposures")
    capture_sets.save_frames(frames, "aps_lit", np.full_like(lit, 1023), exposures)
    refused(frames, "saturated at every exposure; capture shorter exposures")
    capture_sets.save_frames(frames, "aps_dark", np.full_like(dark, 1023), exposures)
    refused(frames, "dark frames reach full scale; cover the lens")
    capture_sets.save_frames(frames, "aps_dark", np.maximum(dark, 64) - np.uint16(64), exposures)
    refused(frames, "clipped at 0 DN.*black level")


def test_eight_bits_that_hide_the_noise(tmp_path):
    capture_sets.write_frames(
        tmp_path / "set", size=32, gain=0.04, read_noise_e=5.0, dark_e_per_s=10.0, dsnu_e=8.0, black=16.0,
        full_scale=255, bit_depth=8,
    )  # fmt: skip
    refused(tmp_path / "set", "below 0.24 DN².*rounding hides the noise.*capture RAW with more bits")


def test_short_exposures_whose_noise_is_hidden_take_no_part(tmp_path):
    # Variance 0.0625·(1 + 20) at 1 ms to 0.0625·(1 + 600) at 30 ms less 0: the first two hide it.
    capture_sets.write_frames(
        tmp_path / "set", gain=0.1, read_noise_e=2.0, dark_e_per_s=2000.0, dark_s=(1e-3, 5e-3, 20e-3, 60e-3, 90e-3),
        lit_s=(1e-3, 5e-3, 20e-3), brightest_e_per_s=3e5, dsnu_e=20.0,
    )  # fmt: skip
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section = read_calibration(tmp_path / "c.yaml")["aps"]
    assert any("hidden by rounding" in note for note in section["notes"])
    assert section["K"]["value"] is None or section["K"]["value"] == pytest.approx(0.1, rel=0.03)
    assert section["beta"][0][0][1] == pytest.approx(0.1, rel=0.1)


def test_event_counts_that_cannot_be(tmp_path):
    arrays = capture_sets.write_events(tmp_path / "set", size=16)
    file = tmp_path / "set" / "evs_static.npz"
    nothing = np.zeros((16, 16), int)
    for changes, match in (
        (
            {"n_on": nothing, "n_off": nothing, "dark_n_on": nothing, "dark_n_off": nothing},
            "no event at all; capture more",
        ),
        ({"n_on": arrays["n_on"][:8]}, "n_on is of size"),
        ({"n_on": arrays["n_on"] * 0.5}, "n_on holds float64; save whole numbers"),
        ({"n_on": arrays["n_on"] + 5000}, "counts outside 0 to n_trials"),
        ({"n_off": None}, "holds no array 'n_off'"),
        ({"dark_n_off": None}, "together or not at all"),
        ({"n_trials": 10.5}, "one whole number"),
        ({"signal_dn": -arrays["signal_dn"]}, "0 or above"),
    ):
        capture_sets.change(file, **changes)
        refused(tmp_path / "set", match, calibrate_evs)
        capture_sets.write_events(tmp_path / "set", size=16)


def test_events_in_every_trial(tmp_path):
    capture_sets.write_events(tmp_path / "set", size=16)
    file = tmp_path / "set" / "evs_static.npz"
    every = np.full((16, 16), 2500)
    capture_sets.change(file, n_on=every, n_off=every, dark_n_on=every, dark_n_off=every)
    refused(tmp_path / "set", "nearly every trial.*raise the threshold", calibrate_evs)
    capture_sets.change(file, n_on=every + 1000, n_off=nothing_like(every))
    refused(tmp_path / "set", "nearly every trial|More than half|more than half", calibrate_evs)


def nothing_like(array):
    return np.zeros_like(array)


def test_one_brightness_without_the_dark(tmp_path):
    capture_sets.write_events(tmp_path / "set", ramp=False, dark=False)
    refused(tmp_path / "set", "one brightness.*capture a ramp", calibrate_evs)


def test_maps_that_are_not_whole_tiles(tmp_path):
    capture_sets.write_events(tmp_path / "set", size=15)
    refused(tmp_path / "set", "not whole tiles", calibrate_evs)


def test_another_sensor_does_not_overwrite_a_calibration(tmp_path):
    capture_sets.write_events(tmp_path / "a", size=32)
    capture_sets.write_events(tmp_path / "b", size=32, tile_rows=1, tile_cols=1)
    calibrate_evs(tmp_path / "a", tmp_path / "c.yaml")
    with pytest.raises(SpecError, match="give another --out"):
        calibrate_evs(tmp_path / "b", tmp_path / "c.yaml")
    assert read_calibration(tmp_path / "c.yaml")["capture"]["tile_rows"] == 2
