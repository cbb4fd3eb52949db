"""The virtual calibration session, and a sensor that simulates with what was calibrated from it."""

import hashlib
import json
import zipfile
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import multivariate_normal

import hesim_render as hr
from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps
from hesim_render.calibrate.summary import summary_lines
from hesim_render.capture import lab_trials
from hesim_render.capture.lab import DARK_EXPOSURES_US, LIT_EXPOSURES_US, _describe, _Session, write_captures
from hesim_render.capture.lab_bench import Bench, set_up, step_target, truth_of
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.core.npz import NpzWriter
from hesim_render.pixels.aps.model import APS_TERMS
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording.capture_set import read_captures
from hesim_render.spectral import spectrum as spectra

# eiger with lower thresholds and a wider mismatch: a short session then holds enough events
BUSY = {
    "evs.contrast_threshold_on": 0.15, "evs.contrast_threshold_off": 0.153, "evs.threshold_mismatch_rel": 0.05,
}  # fmt: skip
WIDE, HIGH, FRAMES, TICKS = 144, 112, 32, 6000


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """(folder, sensor, calibration file) of one session on a part of the sensor."""
    folder = tmp_path_factory.mktemp("lab")
    sensor = hr.load_sensor("eiger", BUSY).crop(WIDE, HIGH)
    write_captures(sensor, folder / "captures", frames=FRAMES, ticks=TICKS, seed=3)
    calibration = folder / "calibration.yaml"
    calibrate_aps(folder / "captures", calibration)
    calibrate_evs(folder / "captures", calibration)
    return folder / "captures", sensor, calibration


@pytest.fixture
def few_trials(monkeypatch):
    """Three trials of each step of contrast in place of 50, where no statistics are made of them."""
    monkeypatch.setattr("hesim_render.capture.lab._LEAST_TRIALS", 3)


def test_exposures_share_the_kernel_that_samples_them(tmp_path):
    """Within it as a constant, each of the five dark and eight lit exposures would compile it again."""
    sensor = hr.load_sensor(
        "reference-mono", {"pixels.M.roles": ["aps"], "evs": None, "sources": {}, "assumptions": {}}
    )
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        write_captures(sensor.crop(16, 8), tmp_path / "set", frames=8, seed=3)
        kernels = {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}
    assert 1 <= len(kernels) < 8 < len(DARK_EXPOSURES_US) + len(LIT_EXPOSURES_US)


def arrays(file):
    with np.load(file) as data:
        return {name: data[name] for name in data.files}


# ---- the target and its light ------------------------------------------------------------------------


def test_the_target_is_a_wedge_above_two_ramps():
    target = step_target(240, 360)
    density = -np.log10(target)
    wedge = np.unique(np.round(density[:120], 9))
    np.testing.assert_allclose(wedge, 0.15 * np.arange(24), atol=1e-9)
    steps = np.abs(np.diff(density[:30].mean(axis=0)))
    assert np.count_nonzero(steps) == 5 and density[30, -1] == pytest.approx(0.9)  # rows run to and fro
    along = (np.arange(360) + 0.5) / 360  # middles of the pixels
    np.testing.assert_allclose(target[[120, 179]], np.tile(10**-3.6 + (1 - 10**-3.6) * along, (2, 1)))
    np.testing.assert_allclose(density[[180, 239]], np.tile(3.6 * (1 - along), (2, 1)))
    assert target.min() > 0 and target.max() == 1.0


def test_flux_is_the_closed_form_through_each_pixels_own_filter():
    sensor = hr.load_sensor("gen2").crop(80, 48)
    bench = set_up(sensor, LIT_EXPOSURES_US, "A")
    source = spectra.illuminant("A")
    grid = np.arange(360.0, 830.5, 0.5)
    photopic = spectra.photopic()
    radiance = np.interp(grid, source.wavelength_nm, source.values)
    luminance = 683.002 * np.trapezoid(radiance * photopic.at(grid), grid)
    radiance *= bench.lux / np.pi / luminance
    spec, lens = sensor.spec, sensor.spec.lens
    area = (1.4e-6) ** 2
    cone = np.pi / (1 + 4 * lens.f_number**2)  # focused at infinity: m = 0
    photons = grid * 1e-9 / (6.62607015e-34 * 299792458.0)
    target = step_target(48, 80)
    for row, col in ((0, 0), (1, 2), (3, 3), (20, 61), (44, 5)):
        name = spec.pixels[spec.tile_rows[row % 4][col % 4]].filter
        transmittance = spec.filters[name].load().at(grid)
        expected = area * cone * 0.9 * 0.7 * np.trapezoid(transmittance * photons * radiance, grid) * target[row, col]
        # the region is near the axis: relative illumination is 1 to 3e-4; own quadrature to 5e-4
        assert bench.flux_e_per_s[row, col] == pytest.approx(expected, rel=1e-3)


def test_the_light_suits_the_frames():
    sensor = hr.load_sensor("eiger").crop(80, 48)
    bench = set_up(sensor, (1000, 9000, 81000))
    brightest = bench.flux_e_per_s[sensor.layout.aps_mask].max() * 9e-3
    assert brightest == pytest.approx(0.9 * (1023 - 64) / 0.16, rel=1e-9)  # 6000 e⁻ of full well are a little more


@pytest.mark.usefixtures("few_trials")
def test_frames_without_noise_are_the_flux_times_exposure(tmp_path):
    sensor = hr.load_sensor("eiger").crop(48, 24)
    off = [f"aps.{term}" for term in APS_TERMS]
    write_captures(
        sensor, tmp_path / "c", frames=8, ticks=1, without=off, dark_exposures_us=(1000, 2000),
        lit_exposures_us=(2000, 8000),
    )  # fmt: skip
    flux = set_up(sensor, (2000, 8000)).flux_e_per_s
    lit = arrays(tmp_path / "c" / "aps_lit.npz")["frames"]
    valid = sensor.layout.aps_mask
    for k, t in enumerate((2e-3, 8e-3)):
        expected = np.clip(np.rint(0.16 * flux * t + 64), 0, 1023)
        assert np.abs(lit[k].astype(int) - expected)[:, valid].max() <= 1  # float32 at a rounding edge
        assert np.mean(lit[k][:, valid] != expected[valid]) < 1e-2
    assert (arrays(tmp_path / "c" / "aps_dark.npz")["frames"][..., valid] == 64).all()
    assert (lit[..., ~valid] == 0).all()  # positions without a frame value


# ---- what is written ---------------------------------------------------------------------------------


def test_the_capture_set_has_the_format_that_calibration_reads(session):
    folder, sensor, _ = session
    assert sorted(p.name for p in folder.iterdir()) == [
        "aps_dark.npz", "aps_lit.npz", "capture.yaml", "evs_static.npz", "evs_steps.npz", "sensor.yaml",
    ]  # fmt: skip
    captures = read_captures(folder)
    assert captures.spec.roi.model_dump() == {
        "x": sensor.layout.col0, "y": sensor.layout.row0, "width_px": WIDE, "height_px": HIGH
    }  # fmt: skip
    assert captures.spec.contrast_of == "signal" and captures.spec.theta_hardware_v == 0.00075
    assert captures.sensor.evs.contrast_threshold_on == 0.15  # changed, so its own file is beside
    for name, exposures in (("aps_dark", DARK_EXPOSURES_US), ("aps_lit", LIT_EXPOSURES_US)):
        stack = captures.frames(name)
        assert stack.shape == (len(exposures), FRAMES, HIGH, WIDE)
        np.testing.assert_array_equal(stack.exposures_us, exposures)
    static, steps = arrays(folder / "evs_static.npz"), arrays(folder / "evs_steps.npz")
    assert static["n_trials"] == TICKS and steps["n_trials"] == TICKS // 100
    assert static["signal_dn"].shape == static["n_on"].shape == (HIGH // 2, WIDE // 2)
    assert steps["contrast"].shape == (21,) and steps["n_on"].shape == (21, HIGH // 2, WIDE // 2)
    np.testing.assert_allclose(steps["contrast"][[0, 10, 20]], [-0.303, 0, 0.303], atol=1e-12)


def test_the_truth_stands_beside_the_estimate(session):
    captures, sensor, calibration = session
    aps, evs = sensor.spec.aps, sensor.spec.evs
    theta, one = (evs.contrast_threshold_on + evs.contrast_threshold_off) / 2, evs.coefficients[0]
    wanted = {
        "aps": {"K": aps.system_gain_dn_per_e, "read_noise_e": aps.read_noise_e, "dsnu_e": aps.dsnu_e,
                "dark_current_e_per_s": aps.dark_current_e_per_s, "prnu_percent": 100 * aps.prnu_rel},
        "evs": {"theta_on": evs.contrast_threshold_on, "theta_off": evs.contrast_threshold_off,
                "threshold_mismatch_rel": evs.threshold_mismatch_rel, "D": one.beta5, "C": one.beta3 / one.beta4,
                "B": theta / evs.threshold_hardware_v * one.beta2 / one.beta4,
                "A": theta / evs.threshold_hardware_v * one.beta1 / one.beta4},
    }  # fmt: skip
    found, calibrated = read_captures(captures).spec.truth, read_calibration(calibration)
    names = {"aps": 7, "evs": 9}
    for section, values in wanted.items():
        for name, value in values.items():
            assert found[section][name] == pytest.approx(value, rel=1e-12), name
        lines = summary_lines(calibrated, section)
        assert sum("; truth " in line for line in lines) >= names[section]
    gain = next(line for line in summary_lines(calibrated, "aps") if line.startswith("K, system gain"))
    assert gain.endswith(f" DN/e-; truth {aps.system_gain_dn_per_e:.5g}")
    calibrated["capture"]["truth"]["aps"]["K"] *= 1.3
    gain = next(line for line in summary_lines(calibrated, "aps") if line.startswith("K, system gain"))
    assert gain.endswith(" (outside)")
    calibrated["capture"]["truth"] = None
    assert not any("truth" in line for line in summary_lines(calibrated, "aps"))


def test_the_truth_of_events_is_the_law_that_pixels_follow():
    """P = Q(u) in still light, u = Θ (A I + B)/√(2 (1 + C² I²)) for the mean of both thresholds, I in DN."""
    one = {"beta1": 1.3e-3, "beta2": 7e-3, "beta3": 4.1e-4, "beta4": 1.9e-3, "beta5": 0.0}
    changes = {
        "evs.coefficients": [one], "evs.contrast_threshold_on": 0.19, "evs.contrast_threshold_off": 0.31,
        "evs.threshold_hardware_v": 0.43, "evs.threshold_mismatch_rel": 0.0,
    }  # fmt: skip
    sensor = hr.load_sensor("gen2", changes).crop(16, 8)
    bench = set_up(sensor, LIT_EXPOSURES_US)
    truth = truth_of(bench, 80_000)["evs"]
    for electrons in (0.0, 3.0, 40.0):
        signal_dn = electrons / (sensor.spec.evs.window_us * 1e-6) * bench.event_dn_per_e_per_s[0, 0]
        shot = 1 + (truth["C"] * signal_dn) ** 2
        u = 0.43 * (truth["A"] * signal_dn + truth["B"]) / np.sqrt(2 * shot)
        for found, theta in zip(sensor.evs.event_probability(electrons, electrons), (0.19, 0.31), strict=True):
            assert found == pytest.approx(ndtr(-u * theta / 0.25), rel=1e-5)
    assert truth["D"] == 0 and (truth["theta_on"], truth["theta_off"]) == (0.19, 0.31)


def test_the_truth_knows_what_is_off_or_mixed():
    sensor = hr.load_sensor("eiger", {"aps.residual_noise_dn": 0.6, "evs.leak_rate_hz": 3.0}).crop(16, 8)
    off = ["aps.read", "aps.dsnu", "aps.dark_current", "evs.shot", "evs.mismatch"]
    found = truth_of(set_up(sensor, LIT_EXPOSURES_US, without=off), 80_000)
    gain = sensor.spec.aps.system_gain_dn_per_e
    assert found["aps"]["read_noise_e"] == pytest.approx(0.6 / gain)
    assert found["aps"]["dsnu_e"] == found["aps"]["dark_current_e_per_s"] == found["evs"]["threshold_mismatch_rel"] == 0
    assert found["evs"]["leak_per_trial"] == pytest.approx(1 - np.exp(-3.0 * sensor.spec.evs.tick_us * 1e-6))
    assert not {"A", "B", "C", "D"} & set(found["evs"])
    aps = sensor.spec.aps
    span = (2**aps.bit_depth - 1 - aps.black_level_dn) / gain
    assert found["aps"]["full_well_e"] == min(span, aps.full_well_e)
    davis = hr.load_sensor("davis346", {"aps.row_noise_dn": 0.7}).crop(16, 8)
    found = truth_of(set_up(davis, LIT_EXPOSURES_US), 80_000)
    assert found["aps"]["row_noise_dn"] == 0.7 and not {"read_noise_e", "full_well_e"} & set(found["aps"])
    assert found["evs"]["noise_cutoff_hz"] == davis.spec.evs.noise_cutoff_hz and "A" not in found["evs"]


@pytest.mark.usefixtures("few_trials")
def test_a_shipped_sensor_is_named_not_copied(tmp_path):
    folder = write_captures(hr.load_sensor("gen2").crop(48, 24), tmp_path / "c", frames=8, ticks=5)
    assert read_captures(folder).spec.sensor == "gen2" and not (folder / "sensor.yaml").exists()


@pytest.mark.usefixtures("few_trials")
def test_the_same_seed_gives_the_same_bytes_and_no_frame_repeats(tmp_path):
    sensor = hr.load_sensor("eiger").crop(24, 16)
    digests = []
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        folder = write_captures(
            sensor, tmp_path / name, frames=8, ticks=20, seed=seed, dark_exposures_us=(1000, 9000),
            lit_exposures_us=(2000, 7000, 11_000),
        )  # fmt: skip
        digests.append({p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()})
    assert digests[0] == digests[1]
    assert digests[0]["aps_dark.npz"] != digests[2]["aps_dark.npz"]
    folder = tmp_path / "a"
    frames = np.concatenate([arrays(folder / f"aps_{k}.npz")["frames"].reshape(-1, 16 * 24) for k in ("dark", "lit")])
    assert len(np.unique(frames, axis=0)) == len(frames) == 5 * 8


@pytest.mark.usefixtures("few_trials")
def test_only_what_can_be_calibrated_is_captured(tmp_path):
    folder = write_captures(hr.load_sensor("reference-bayer").crop(24, 16), tmp_path / "none", frames=8, ticks=5)
    assert not list(folder.glob("evs_*")) and (folder / "aps_lit.npz").is_file()
    assert "signal_reference" not in (folder / "capture.yaml").read_text()
    text = (hr.specs.files.data_folder("sensors") / "reference-mono.yaml").read_text()
    begin, end = text.index("aps:\n"), text.index("evs:\n")
    text = text[:begin] + text[end:].replace("  aps: ideal, round figures\n", "")
    (tmp_path / "events.yaml").write_text(text.replace("[aps, evs]", "[evs]"))
    folder = write_captures(hr.load_sensor(tmp_path / "events.yaml").crop(48, 24), tmp_path / "e", ticks=50)
    assert sorted(p.name for p in folder.glob("*.npz")) == ["evs_static.npz", "evs_steps.npz"]
    assert arrays(folder / "evs_static.npz")["signal_dn"].max() == pytest.approx(1000.0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"frames": 7}, "frames is 7; expected 8 or more"),
        ({"ticks": 0}, "ticks is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"without": ["aps.nothing"]}, "noise term is 'aps.nothing'"),
        ({"dark_exposures_us": (1000,)}, "dark exposures"),
        ({"lit_exposures_us": (1000, 1000)}, "lit exposures"),
        ({"lit_exposures_us": (0, 1000)}, "lit exposures"),
    ],
)
def test_bad_numbers_write_nothing(options, text, tmp_path):
    with pytest.raises(RangeError, match=text.replace("(", r"\(")):
        write_captures(hr.load_sensor("eiger").crop(24, 16), tmp_path / "c", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("few_trials")
def test_a_session_that_breaks_off_leaves_nothing(tmp_path):
    def stop(done, total, what):
        assert 0 < done <= total
        if what == "aps_lit":
            raise KeyboardInterrupt

    sensor = hr.load_sensor("eiger").crop(24, 16)
    with pytest.raises(KeyboardInterrupt):
        write_captures(sensor, tmp_path / "c", frames=8, ticks=5, progress=stop)
    assert list(tmp_path.iterdir()) == []
    write_captures(sensor, tmp_path / "c", frames=8, ticks=5)
    with pytest.raises(OutputError, match="exists"):
        write_captures(sensor, tmp_path / "c", frames=8, ticks=5)
    write_captures(sensor, tmp_path / "c", frames=9, ticks=5, overwrite=True)
    assert arrays(tmp_path / "c" / "aps_lit.npz")["frames"].shape[1] == 9


def test_npz_pieces_are_read_by_numpy(tmp_path):
    values = np.arange(24, dtype=np.uint16).reshape(4, 3, 2)
    with NpzWriter(tmp_path / "a.npz") as archive:
        archive.add("whole", values)
        archive.add("number", np.array(7))
        archive.add_pieces("pieces", values.shape, np.uint16, iter(values))
    found = arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(found["whole"], values)
    np.testing.assert_array_equal(found["pieces"], values)
    assert found["number"] == 7 and found["pieces"].dtype == np.uint16
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:  # the first date that ZIP can state, whatever the clock says
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    for rows in (5, 3):  # too few pieces, and too many
        with pytest.raises(RangeError, match="values of x"), NpzWriter(tmp_path / "b.npz") as archive:
            archive.add_pieces("x", (rows, 3, 2), np.uint16, iter(values))


# ---- events --------------------------------------------------------------------------------------------


def test_first_events_of_trials_fall_into_the_bins_that_end_with_their_instant(tmp_path, monkeypatch):
    """Two trials of a step and three of steady light, on 2 rows of 3 pixels, in bins (0, 4] and (4, 10] µs."""
    seeds, levels = [], []

    class Given:
        """A stage whose events are given: (µs after the step, x, y, polarity), in the order of time."""

        def __init__(self, noise, seed, defects, is_reset):
            seeds.append(seed)
            early, late = (-4, 2, 1, 1), (9, 2, 1, 1)  # while it settles, and after: not calm
            ends = [(4, 1, 0, 1), (10, 1, 0, -1)] if len(seeds) % 2 else [(10, 1, 0, 1)]  # the first one counts
            own = [early, (5, 0, 1, -1), *ends, late]
            self.events = np.array(sorted(own), EVENT_DTYPE)
            self.last_us = self.step_us = None

        def step(self, electrons, t_us):
            levels.append(float(electrons.numpy()[0]))
            if self.step_us is None:
                self.step_us, self.last_us = t_us + 7, t_us
            found = self.events.copy()
            found["t_us"] += self.step_us
            found = found[(found["t_us"] > self.last_us) & (found["t_us"] <= t_us)]
            self.last_us = t_us
            return found

    monkeypatch.setattr(lab_trials, "EvsStage", Given)
    noise = SimpleNamespace(
        layout=SimpleNamespace(evs_shape=(2, 3)), defects=None, spec=SimpleNamespace(window_us=500)
    )  # fmt: skip
    plan = lab_trials.TrialPlan(np.array([2.0, 5.0]), np.array([0.3, 0.0]), 7, np.array([0, 4, 10]), np.array([2, 3]))
    passed = []
    bench = lab_trials.TrialBench(noise, np.full((2, 3), 1e-4), 2**64 - 1, passed.append)
    bench.write(tmp_path / "t.npz", plan)
    found = arrays(tmp_path / "t.npz")
    assert found["n_calm"].tolist() == [[[2, 2, 2], [2, 2, 0]], [[3, 3, 3], [3, 3, 0]]]
    none = [0, 0, 0]
    # trials 1, 3 and 5 fire at 4 µs, 2 and 4 at 10 µs
    assert found["n_on"].tolist() == [[[[0, 1, 0], none], [[0, 1, 0], none]], [[[0, 2, 0], none], [[0, 1, 0], none]]]
    assert found["n_off"].tolist() == [[[none, none], [none, [2, 0, 0]]], [[none, none], [none, [3, 0, 0]]]]
    assert len(set(seeds)) == 5 and all(0 <= seed < 2**64 for seed in seeds) and bench.t_us == 5 * 18
    # light of 2 DN and, from 1 µs after the step, of 2 e^0.3 DN, at 1e-4 DN per e⁻/s, in the window of 500 µs
    after = 10 * np.exp(0.3)
    assert levels[:4] == pytest.approx([10, 10, after, after], rel=1e-6) and set(levels[8:]) == {25.0}
    assert passed == pytest.approx([17e-6] * 5)


@pytest.mark.slow
def test_event_counts_follow_the_closed_form(tmp_path):
    """Rates per pixel against P = Q(θ/σ) of nominal thresholds, written out; per-instant noise over-disperses."""
    sensor = hr.load_sensor("eiger", {**BUSY, "evs.threshold_mismatch_rel": 0.0}).crop(128, 128)
    write_captures(sensor, tmp_path / "c", frames=8, ticks=4000, seed=11)
    static, steps = arrays(tmp_path / "c" / "evs_static.npz"), arrays(tmp_path / "c" / "evs_steps.npz")

    def spread(signal):
        return np.sqrt((3.1e-5 * signal) ** 2 + 2.116e-4**2) / (1e-3 * signal + 5e-3)

    n = 4000
    scores = []
    for signal, on, off in (
        (static["signal_dn"], static["n_on"], static["n_off"]),
        (0.0 * static["signal_dn"], static["dark_n_on"], static["dark_n_off"]),
    ):
        for theta, counts in ((0.15, on), (0.153, off)):
            expected = n * ndtr(-theta / (np.sqrt(2) * spread(signal)))
            # counts of one polarity scatter a little less than Poisson's: an ON seldom follows an ON
            scores.append((counts.sum() - expected.sum()) / np.sqrt(expected.sum()))
    # an OFF often follows an ON, as both share a sample: differences correlate by −½
    u = 0.15 / (np.sqrt(2) * spread(0.0))
    v = u * 0.153 / 0.15
    pair = multivariate_normal(cov=[[1, 0.5], [0.5, 1]])
    both = pair.cdf([-u, -v])
    repeated = sum(multivariate_normal(cov=[[1, -0.5], [-0.5, 1]]).cdf([-w, -w]) for w in (u, v))
    rate = ndtr(-u) + ndtr(-v)
    expected = 1 - rate + 2 * (2 * both + repeated - rate**2) / rate
    dispersion = (static["dark_n_on"] + static["dark_n_off"]).var() / (n * rate)
    scores.append((dispersion / expected - 1) / np.sqrt(2 / 64**2))
    assert expected > 1.15
    level = steps["signal_dn"]
    for k in (4, 5, 14, 15, 16):  # where rates are neither 0 nor 1; trials of a step are independent
        after = level * np.exp(steps["contrast"][k])
        change = np.log((1e-3 * after + 5e-3) / (1e-3 * level + 5e-3))
        sigma = np.hypot(spread(level), spread(after))
        total = steps["n_on"][k].size * int(steps["n_trials"])
        for theta, sign, counts in ((0.15, 1, steps["n_on"][k]), (0.153, -1, steps["n_off"][k])):
            expected = ndtr(-(theta - sign * change) / sigma)
            scores.append((counts.sum() / total - expected) / np.sqrt(max(expected * (1 - expected), 1e-9) / total))
    assert len(scores) == 15
    assert np.abs(scores).max() < 4.5, scores  # false alarm 1e-4


# ---- simulating with a calibration -------------------------------------------------------------------


def calibrated(session):
    """The captured bench with the calibrated sensor in place of the true one."""
    _, sensor, calibration = session
    true = set_up(sensor, LIT_EXPOSURES_US)
    again = hr.load_sensor("eiger", {"noise": str(calibration)}).crop(WIDE, HIGH)
    return Bench(again, true.flux_e_per_s, true.lux, *noise_models(again))


def test_calibrated_values_replace_the_files_own(session):
    _, _, calibration = session
    data, maps = read_calibration(calibration), read_maps(calibration, "aps")
    sensor = hr.load_sensor("eiger", {"noise": str(calibration)}).crop(WIDE, HIGH)
    spec = sensor.spec
    assert spec.aps.system_gain_dn_per_e == data["aps"]["K"]["value"] != 0.16
    assert spec.aps.black_level_dn == data["aps"]["black_dn"]
    assert spec.aps.beta[0][0] == data["aps"]["beta"][0][0] and spec.aps.beta[1][1] == [0.0] * 6  # an event pixel
    offset = data["aps"]["black_dn"] + maps["n_row"][:, None] + maps["n_blc"]
    np.testing.assert_allclose(sensor.aps.fixed_pattern.offset_dn, offset, atol=1e-4)
    dark = maps["n_dp"] / data["aps"]["K"]["value"]
    np.testing.assert_allclose(sensor.aps.fixed_pattern.dark_e_per_s, dark, rtol=1e-5, atol=1e-5)
    rows = sensor.aps.without("dsnu").fixed_pattern.offset_dn
    np.testing.assert_allclose(rows, np.broadcast_to(offset - maps["n_blc"], rows.shape), atol=1e-4)
    # A … D of each position, from β in whatever gauge the file is written
    theta = (spec.evs.contrast_threshold_on + spec.evs.contrast_threshold_off) / 2
    assert theta == pytest.approx(data["evs"]["theta"]["value"])
    for one, position in zip(spec.evs.coefficients, data["evs"]["positions"], strict=True):
        beta0 = theta / spec.evs.threshold_hardware_v
        found = (beta0 * one.beta1 / one.beta4, beta0 * one.beta2 / one.beta4, one.beta3 / one.beta4, one.beta5)
        assert found == pytest.approx([position[name]["value"] for name in "ABCD"])
    relative = sensor.evs.threshold_on_map / spec.evs.contrast_threshold_on
    good = ~read_maps(calibration, "evs")["bad_pixels"]
    assert relative[good].std() == pytest.approx(spec.evs.threshold_mismatch_rel, rel=1e-4)
    true = hr.load_sensor("eiger", BUSY).crop(WIDE, HIGH).evs.threshold_on_map / 0.15
    assert np.corrcoef(relative[good], true[good])[0, 1] > 0.8  # the pixels' own thresholds, not another draw
    assert spec.sources["aps.system_gain_dn_per_e"].startswith("measured: ")


def test_frames_simulated_with_the_calibration_are_those_captured(session, tmp_path):
    """Mean and variance of every position at three exposures, lit and dark: 144 scores, |z| < 4.7: 4e-4."""
    folder, sensor, calibration = session
    bench = calibrated(session)
    again = _Session(bench, 77, None)
    again.write_frames(tmp_path / "dark.npz", DARK_EXPOSURES_US, FRAMES, 0.0)
    again.write_frames(tmp_path / "lit.npz", LIT_EXPOSURES_US, FRAMES, 1.0)
    gain = read_calibration(calibration)["aps"]["K"]
    relative = gain["standard_error"] / gain["value"]
    scores = []
    for name, picked in (("dark", (0, 2, 4)), ("lit", (0, 3, 7))):
        captured, simulated = arrays(folder / f"aps_{name}.npz"), arrays(tmp_path / f"{name}.npz")
        for k in picked:
            both = [stack["frames"][k].astype(np.float64) for stack in (captured, simulated)]
            clear = (both[0].max(axis=0) < 900) & (both[1].max(axis=0) < 900)  # of saturation and of full well
            means, variances = [b.mean(axis=0) for b in both], [b.var(axis=0, ddof=1) for b in both]
            for i, j in sensor.spec.positions("aps"):
                use = np.zeros(clear.shape, bool)
                use[i::4, j::4] = clear[i::4, j::4]
                count = use.sum()
                light = np.maximum(means[0][use] - 65, 0)
                variance = variances[0][use].mean()
                # captured, simulated, and the maps' own error, which is of the first kind; light is as good as K
                error = np.hypot(np.sqrt(3 * variance / FRAMES / count), relative * light.mean())
                scores.append((means[1][use].mean() - means[0][use].mean()) / error)
                sampling = np.sqrt(2 * np.mean(variances[0][use] ** 2) / (FRAMES - 1) / count)
                error = np.hypot(np.sqrt(2) * sampling, relative * gain["value"] * light.mean())
                scores.append((variances[1][use].mean() - variance) / error)
    assert len(scores) == 144
    assert np.abs(scores).max() < 4.7
    assert 0.45 < np.std(scores) < 1.2  # errors not so wide that anything would pass (0.72 on this session)


def test_temporal_row_noise_goes_from_the_sensor_file_through_the_captures_into_the_calibrated_sensor(tmp_path):
    """1.2 DN on 48 rows; 4.5 standard errors of each of three figures: a false alarm in 2e-5."""
    sensor = hr.load_sensor("eiger", {"aps.row_noise_dn": 1.2}).crop(80, 48)
    exposures = {"dark_exposures_us": (1000, 20000, 80000), "lit_exposures_us": (1000, 10000, 80000)}
    write_captures(sensor, tmp_path / "captures", frames=32, ticks=1000, seed=5, **exposures)
    calibrate_aps(tmp_path / "captures", tmp_path / "c.yaml")
    section = read_calibration(tmp_path / "c.yaml")["aps"]
    assert [f["check"] for f in section["findings"]] == ["row noise"]
    for name, true in (("row_noise_dn", 1.2), ("read_noise_e", 5.0), ("K", 0.16)):
        assert abs(section[name]["value"] - true) < 4.5 * section[name]["standard_error"], name
    assert section["row_noise_dn"]["standard_error"] < 0.02
    calibrated = hr.load_sensor("eiger", {"noise": str(tmp_path / "c.yaml")}).spec
    assert calibrated.aps.row_noise_dn == pytest.approx(section["row_noise_dn"]["value"])
    calm = hr.load_sensor("eiger", {"noise": str(tmp_path / "c.yaml"), "aps.row_noise_dn": 0.0})
    assert calm.spec.aps.row_noise_dn == 0


def test_single_pixels_keep_their_fixed_pattern(session, tmp_path):
    folder, sensor, _ = session
    again = _Session(calibrated(session), 78, None)
    again.write_frames(tmp_path / "dark.npz", DARK_EXPOSURES_US, FRAMES, 0.0)
    valid = sensor.layout.aps_mask
    means = [
        arrays(file)["frames"][4][:, valid].mean(axis=0) for file in (folder / "aps_dark.npz", tmp_path / "dark.npz")
    ]
    assert np.corrcoef(means[0], means[1])[0, 1] > 0.98  # rows of 1.5 DN, pixels of 0.3 DN, noise of 0.15 DN


def test_event_counts_simulated_with_the_calibration_are_those_captured(session, tmp_path):
    """Counts of every position and polarity, in the dark and in three ranges of light: 32 scores, |z| < 4.5: 2e-4."""
    folder, sensor, _ = session
    again = _Session(calibrated(session), 79, None)
    again.write_static(tmp_path / "static.npz", TICKS)
    captured, simulated = arrays(folder / "evs_static.npz"), arrays(tmp_path / "static.npz")
    np.testing.assert_allclose(simulated["signal_dn"], captured["signal_dn"], rtol=1e-6)
    position, signal = sensor.layout.evs_position, captured["signal_dn"]
    scores = []
    for polarity in ("n_on", "n_off"):
        for prefix, low, high in (("dark_", 0, np.inf), ("", 0, 1), ("", 1, 3), ("", 100, np.inf)):
            for k in range(4):
                use = (position == k) & (signal >= low) & (signal < high)
                first, second = (int(data[prefix + polarity][use].sum()) for data in (captured, simulated))
                assert first > 50
                # counts of one polarity scatter as Poisson's do; what the fit lacks is what these counts lack
                scores.append((second - first) / np.sqrt(first + second))
    assert len(scores) == 32
    assert np.abs(scores).max() < 4.5


def test_maps_hold_for_the_region_captured_and_parts_of_it(session):
    _, sensor, calibration = session
    x, y = sensor.layout.col0, sensor.layout.row0
    whole = hr.load_sensor("eiger", {"noise": str(calibration)})
    for region in ((WIDE + 4, HIGH, x, y), (WIDE, HIGH, x - 4, y), (64, 64, 0, 0)):
        for part in ("aps", "evs"):
            with pytest.raises(SpecError, match=rf"--roi {WIDE}x{HIGH}\+{x}\+{y}"):
                getattr(whole.crop(*region), part)
    with pytest.raises(SpecError, match="was measured on"):
        _ = whole.aps
    part = whole.crop(32, 16, x + 8, y + 12)
    full = whole.crop(WIDE, HIGH)
    np.testing.assert_array_equal(part.aps.fixed_pattern.offset_dn, full.aps.fixed_pattern.offset_dn[12:28, 8:40])
    np.testing.assert_array_equal(part.evs.threshold_off_map, full.evs.threshold_off_map[6:14, 4:20])


def test_what_a_calibration_cannot_be_used_for_is_one_clear_error(session, tmp_path):
    _, _, calibration = session
    for name, changes, text in (
        ("reference-bayer", {}, "tile of 4×4, not 2×2"),
        ("eiger", {"noise": str(tmp_path / "none.yaml")}, "cannot be read"),
        ("eiger", {"noise": 3}, "expected the path of a calibration.yaml"),
        ("eiger", {"noise": None, "noise.file": "c.yaml"}, "expected the path of a calibration.yaml"),
        ("eiger", {"noise": {"file": str(calibration), "name": 1}}, "noise.name: unknown key"),
        ("eiger", {"noise": {"file": str(calibration), "sha256": "00"}}, "is not the one this sensor was written with"),
        ("gen2", {}, "4 event positions"),
    ):
        with pytest.raises(SpecError, match=text):
            hr.load_sensor(name, {"noise": str(calibration), **changes})
    text = calibration.read_text()
    for before, after, said in (
        ("  K:\n    value: ", "  K:\n    reason: none\n    value: null #", r"aps\.K: not identifiable"),
        ("  K:\n", "  gain:\n", r"changed\.yaml:\d+: aps\.K: required key is missing"),
        ("bit_depth: 10", "bit_depth: 12", "of frames of 12 bits, the sensor has 10"),
    ):
        (tmp_path / "changed.yaml").write_text(text.replace(before, after))
        with pytest.raises(SpecError, match=said):
            hr.load_sensor("eiger", {"noise": str(tmp_path / "changed.yaml")})
    with pytest.raises(SpecError, match=r"evs\.contrast_threshold_on"):  # the file's own faults come first
        hr.load_sensor("eiger", {"noise": str(calibration), "evs.contrast_threshold_on": "high"})


def test_overrides_have_the_last_word_and_the_path_is_relative_to_the_file(session, tmp_path, monkeypatch):
    _, _, calibration = session
    for file in calibration.parent.glob("calibration*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (hr.specs.files.data_folder("sensors") / "eiger.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("sources:\n", "noise: calibration.yaml\nsources:\n", 1))
    mine = hr.load_sensor(tmp_path / "mine.yaml", {"aps.black_level_dn": 70})
    assert mine.spec.aps.black_level_dn == 70
    gain = read_calibration(calibration)["aps"]["K"]["value"]
    assert mine.spec.aps.system_gain_dn_per_e == gain
    monkeypatch.chdir(tmp_path)
    assert hr.load_sensor("eiger", {"noise": "calibration.yaml"}).spec.aps.system_gain_dn_per_e == gain
    dump = json.dumps(mine.spec.model_dump(mode="json"))
    assert str(tmp_path) not in dump  # where it lay is nobody's business; what it held is
    first = mine.spec.model_dump(mode="json")["noise"]
    assert first["file"] == "calibration.yaml" and len(first["sha256"]) == 64
    (tmp_path / "calibration.yaml").write_text((tmp_path / "calibration.yaml").read_text() + "# changed\n")
    assert hr.load_sensor(tmp_path / "mine.yaml").spec.model_dump(mode="json")["noise"]["sha256"] != first["sha256"]


@pytest.mark.slow
def test_without_a_measured_threshold_the_files_own_is_kept(tmp_path):
    sensor = hr.load_sensor("eiger", BUSY).crop(64, 64)
    folder = write_captures(sensor, tmp_path / "c", frames=8, ticks=4000)
    (folder / "evs_steps.npz").unlink()
    calibrate_evs(folder, tmp_path / "c.yaml")
    data = read_calibration(tmp_path / "c.yaml")["evs"]
    assert data["theta"]["value"] is None
    spec = hr.load_sensor("eiger", {"noise": str(tmp_path / "c.yaml")}).spec
    assert spec.aps.beta is None  # events only were calibrated
    assert (spec.evs.contrast_threshold_on + spec.evs.contrast_threshold_off) / 2 == pytest.approx(0.2)
    one = spec.evs.coefficients[0]
    assert 0.2 / 0.00075 * one.beta2 / one.beta4 == pytest.approx(data["positions"][0]["B"]["value"], rel=1e-6)


@pytest.mark.slow
def test_a_sensor_with_poisson_events_gives_its_own_parameters(tmp_path):
    """reference-mono: A = θβ1/β4 = 5, B = 5, C = √2/0.02; rates from 0.46 to 1e-4. False alarm 6e-5 each."""
    folder = write_captures(hr.load_sensor("reference-mono").crop(64, 64), tmp_path / "c", frames=8, ticks=4000)
    calibrate_evs(folder, tmp_path / "calibration.yaml")
    section = read_calibration(tmp_path / "calibration.yaml")["evs"]
    assert section["shot_law"] == "sqrt"
    for name, true in (("A", 5.0), ("B", 5.0), ("C", 2**0.5 / 0.02)):
        assert abs(section[name]["value"] - true) < 4 * section[name]["standard_error"], name
        assert section[name]["standard_error"] < 0.1 * true


@pytest.mark.slow
def test_counts_that_no_law_describes_give_no_numbers(tmp_path):
    folder = write_captures(hr.load_sensor("reference-mono").crop(64, 64), tmp_path / "c", frames=8, ticks=2000)
    static = arrays(folder / "evs_static.npz")
    static["signal_dn"] = static["signal_dn"].max() * 1.01 - static["signal_dn"]  # bright and dark exchanged
    np.savez(folder / "evs_static.npz", **static)
    with pytest.raises(SpecError, match="neither shot law describes"):
        calibrate_evs(folder, tmp_path / "calibration.yaml")
    assert not (tmp_path / "calibration.yaml").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gen2", "mipi-hybridevs"])
def test_white_event_pixels_take_their_signal_from_the_frames(name, tmp_path):
    """No frame pixel is white: the light stated in capture.yaml tells white from the colours around it."""
    sensor = hr.load_sensor(name, BUSY).crop(192, 192)
    folder = write_captures(sensor, tmp_path / "c", frames=16, ticks=2000, illuminant="A")
    assert read_captures(folder).spec.illuminant == "A"
    out = tmp_path / "calibration.yaml"
    calibrate_aps(folder, out)
    static = arrays(folder / "evs_static.npz")
    true = static.pop("signal_dn")
    maps = read_maps(out, "aps")
    signal, told = maps["evs_signal_dn_per_s"] * 10e-3, ~maps["evs_signal_uneven"]
    assert np.isfinite(signal).all()
    assert 0.6 < told.mean() < 1.0  # edges of patches are left out
    bright = told & (true > 20)
    assert np.median(signal[bright] / true[bright]) == pytest.approx(1, abs=0.005)
    assert np.quantile(np.abs(signal[bright] / true[bright] - 1), 0.9) < 0.03
    calibrate_evs(folder, tmp_path / "given.yaml")
    np.savez(folder / "evs_static.npz", **static)
    calibrate_evs(folder, out)
    given, from_frames = (read_calibration(file)["evs"] for file in (tmp_path / "given.yaml", out))
    for parameter in "ABC":
        first, second = given[parameter], from_frames[parameter]
        assert abs(first["value"] - second["value"]) < 3 * second["standard_error"]  # mostly the same pixels
    assert from_frames["goodness"]["chi2_per_dof"] < 1.5
    # each way in which that signal is missing is one clear message
    with pytest.raises(SpecError, match="calibrate frames of the same scene first"):
        calibrate_evs(folder, tmp_path / "none.yaml")
    text = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text("\n".join(x for x in text.splitlines() if not x.startswith("signal_ref")))
    with pytest.raises(SpecError, match="signal_reference: the signal is to be taken from the frames"):
        calibrate_evs(folder, out)
    (folder / "capture.yaml").write_text(text.replace("illuminant: A\n", ""))
    calibrate_aps(folder, tmp_path / "dark.yaml")
    with pytest.raises(SpecError, match="illuminant: no frame pixel has the filter of the event pixels"):
        calibrate_evs(folder, tmp_path / "dark.yaml")


@pytest.mark.slow
def test_intervals_cover_the_truth_of_sensors_of_a_kind(tmp_path):
    """100 virtual sessions, each with a sensor of its own: per-instant noise, thresholds apart for ON and OFF.

    Truth is the sensor file's, that of all sensors of a kind. The mean of 100 z² has a standard deviation of 0.14; a
    law with as few degrees leaves 0.55 to 1.6 with a chance of 4e-4 for four of them.
    """
    scores = []
    for seed in range(100):
        sensor = hr.load_sensor("eiger", {**BUSY, "device_seed": 9000 + seed}).crop(128, 128)
        bench = set_up(sensor, LIT_EXPOSURES_US)
        folder = tmp_path / str(seed)
        folder.mkdir()
        again = _Session(bench, seed, None)
        again.write_static(folder / "evs_static.npz", 3000)
        again.write_steps(folder / "evs_steps.npz", 50)
        _describe(bench, folder, "D65", seed, max(LIT_EXPOSURES_US))
        calibrate_evs(folder, tmp_path / "c.yaml")
        section = read_calibration(tmp_path / "c.yaml")["evs"]
        theta = 0.1515 / 0.00075
        true = {"A": theta * 1e-3 / 2.116e-4, "B": theta * 5e-3 / 2.116e-4, "C": 3.1e-5 / 2.116e-4, "D": 0.0}
        scores.append([(section[n]["value"] - true[n]) / section[n]["standard_error"] for n in "ABCD"])
        assert section["multi_start"]["lost"] == 0
        assert max(section["multi_start"]["largest_difference_in_standard_errors"][:4]) < 0.01
    square = np.mean(np.square(scores), axis=0)
    covered = np.mean(np.abs(scores) < 1.96, axis=0)
    assert np.all((square > 0.55) & (square < 1.6)), square
    assert np.all((covered >= 0.90) & (covered <= 0.99)), covered


def test_trials_are_counted_by_kind_bin_and_part(tmp_path):
    """Against loops over what each trial of each pixel did, drawn at random; parts are those of the last kind."""
    rng, shape, trials, parts = np.random.default_rng(2), (2, 3), np.array([5, 7, 12]), 4
    plan = lab_trials.TrialPlan(
        np.array([4.0, 9.0, 30.0]), np.array([0.2, -0.3, 0.0]), 800, np.array([0, 30, 90]), trials, parts
    )
    done, advanced, lights = [], [], []
    bench = lab_trials.TrialBench.__new__(lab_trials.TrialBench)
    bench.noise, bench.advance = SimpleNamespace(layout=SimpleNamespace(evs_shape=shape)), advanced.append
    bench._electrons = lambda signal_dn: signal_dn

    def trial(before, after, given):
        lights.append((before, after))
        done.append((rng.random(6) < 0.7, rng.integers(-1, 2, 6), rng.choice([-1, 1], 6)))
        return done[-1]

    bench._trial = trial
    bench.write(tmp_path / "t.npz", plan)
    calm, on, off, disturbed = (np.zeros((*size, 6), int) for size in ((3,), (3, 2), (3, 2), (4,)))
    kinds = np.repeat([0, 1, 2], trials)
    for number, (kind, (quiet, first, sign)) in enumerate(zip(kinds, done, strict=True)):
        for pixel in range(6):
            calm[kind, pixel] += quiet[pixel]
            if first[pixel] >= 0:
                (on if sign[pixel] > 0 else off)[kind, first[pixel], pixel] += 1
            if kind == 2 and (first[pixel] >= 0 or not quiet[pixel]):
                disturbed[(number - 12) // 3, pixel] += 1
    with np.load(tmp_path / "t.npz") as found:
        for name, wanted in (("n_calm", calm), ("n_on", on), ("n_off", off), ("bright_parts", disturbed)):
            np.testing.assert_array_equal(found[name], wanted.reshape(*wanted.shape[:-1], *shape))
        assert found["part_trials"] == 3 and found["part_us"] == 3 * (890 + 1)
    assert advanced == pytest.approx([890e-6] * 24)
    steps = [(4.0, 4 * np.exp(0.2)), (9.0, 9 * np.exp(-0.3)), (30.0, None)]
    assert [before for before, _ in lights] == [steps[kind][0] for kind in kinds]
    assert all(
        after == steps[kind][1] or after == pytest.approx(steps[kind][1])
        for kind, (_, after) in zip(kinds, lights, strict=True)
    )


def test_steps_of_a_plan_reach_parts_of_both_thresholds():
    """x = β1 I + β2: from each light, ln x₁/x₀ goes in equal steps from a quarter to 1.9 thresholds, up and down; where
    the light would end below a thousandth of itself the step is left out."""
    first = SimpleNamespace(beta1=0.04, beta2=0.9)
    spec = SimpleNamespace(
        noise_cutoff_hz=170.0, coefficients=[first], contrast_threshold_on=0.21, contrast_threshold_off=0.34
    )
    plans = lab_trials.plan_trials(SimpleNamespace(spec=spec), 6)
    steps = plans["evs_s_curve"]
    assert np.all(steps.trials == 6) and steps.signal_dn.size == steps.contrast.size == steps.trials.size
    before = 0.04 * steps.signal_dn + 0.9
    change = np.log((0.04 * steps.signal_dn * np.exp(steps.contrast) + 0.9) / before)
    for light in np.unique(steps.signal_dn):
        for sign, theta in ((1, 0.21), (-1, 0.34)):
            own = change[(steps.signal_dn == light) & (np.sign(steps.contrast) == sign)] * sign / theta
            assert own[0] == pytest.approx(0.25) and np.ptp(np.diff(own)) < 1e-9 and own[-1] <= 1.9 + 1e-9
            next_one = (0.04 * light + 0.9) * np.exp(sign * theta * (own[-1] + np.diff(own)[0]))
            assert own[-1] == pytest.approx(1.9) or (next_one - 0.9) / 0.04 < 1e-3 * light
    period_us = 1e6 / 170
    assert steps.settle_us == np.ceil(0.75 * period_us)
    assert steps.edges_us.tolist() == [0, np.ceil(0.03 * period_us), np.ceil(1.25 * period_us)]
    assert plans["evs_noise_rate"].edges_us.tolist() == [0, np.ceil(20 * period_us)]
