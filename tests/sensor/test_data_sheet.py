"""Event pixels from a data sheet or from v2e's options: conversions by closed forms, and every mistake."""

import math

import numpy as np
import pytest
from scipy import constants, optimize

from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.noise_rates import events_per_period, noise_rates_hz, noise_sigma
from hesim_render.sensor.from_data_sheet import corner_of_latency_hz, electrons_per_s_lux, latency_us
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.files import data_folder, list_names
from hesim_render.spectral.spectrum import illuminant, photopic

IMX636 = (data_folder("sensors") / "imx636.yaml").read_text()
SHEET = "evs.data_sheet."
#: The same without what is said about single keys, some of which tests leave out.
BARE = IMX636[: IMX636.index("sources:")]


def corner_at(photoreceptor, lux):
    """Corner of a photoreceptor whose signal is in lux: a line from the dark to its largest value."""
    dark, largest = photoreceptor.min_cutoff_hz, photoreceptor.cutoff_hz
    return min(dark + (largest - dark) * lux / photoreceptor.signal_dn, largest)


def reset_pixel_rates(on, off, dead_periods, seed, pixels=400, periods=700, first=100, nodes=16, leak_periods=0.0):
    """Events per period of noisy pixels with a dead time, by simulation in NumPy from the law of the noise alone. Leak
    events, which are not counted, begin a dead time as well.
    """
    rng = np.random.default_rng(seed)
    pole = 2 * np.pi / np.sqrt(np.sqrt(2) - 1)
    lag = pole / nodes
    # the state (u, u'/a) of u'' + 2a u' + a² u = white noise: exp(a·A·t) of A = [[0, 1], [-1, -2]]
    step = np.exp(-lag) * np.array([[1 + lag, lag], [-lag, 1 - lag]])
    scale = np.sqrt(3 / (2 + (1 + lag) * np.exp(-lag)))
    fresh = scale * np.linalg.cholesky(np.eye(2) - step @ step.T)
    state = scale * rng.standard_normal((2, pixels))
    level, ready, events = state[0].copy(), np.full(pixels, -1.0), 0
    for node in range(periods * nodes):
        after = step @ state + fresh @ rng.standard_normal((2, pixels))
        u, w = state[0], after[0]
        released = (ready > 0) & (ready <= 1)
        level[released] = (u + (w - u) * ready)[released]
        fired = (ready <= 1) & ((w - level >= on) | (w - level <= -off))
        while fired.any():
            events += fired.sum() * (node >= first * nodes)
            threshold = np.where(w > level, on, -off)
            part = np.maximum((level + threshold - u)[fired] / (w - u)[fired], np.maximum(ready[fired], 0))
            ready[fired] = part + dead_periods * nodes
            again = fired & (ready <= 1)
            level[again] = (u + (w - u) * ready)[again]
            fired = again & ((w - level >= on) | (w - level <= -off))
        if leak_periods:
            leaks = (ready <= 1) & (rng.random(pixels) < leak_periods / nodes)
            ready[leaks] = 1 + dead_periods * nodes
        ready -= 1
        state = after
    return events / (pixels * (periods - first))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("on", "off", "dead_periods"),
    # not among the entries of the table: means 2.2 and 2.8, differences of 0 and 0.35, dead times between two entries
    [(2.2, 2.2, 0.08), (2.975, 2.625, 0.08), (1.2, 1.2, 0.45)],
)
def test_rates_of_noise_events_between_the_entries_of_the_table(on, off, dead_periods):
    simulated = reset_pixel_rates(on, off, dead_periods, seed=5)
    # at least 60,000 events, over-dispersed by less than 4: standard error below 1 %; interpolation may add 4 %
    assert float(events_per_period(on, off, dead_periods)) == pytest.approx(simulated, rel=0.06)


@pytest.mark.parametrize(
    ("thresholds", "dead_periods", "pixels", "times", "within"),
    # dead times between two entries and at one; the second thresholds differ by more than the first table has
    [((3.4, 4.2), 0.075, 1500, 1.2, 0.07), ((8.0, 3.0), 0.1, 1000, 3.0, 0.1)],
)
def test_leak_makes_noise_events_more_frequent(thresholds, dead_periods, pixels, times, within):
    """A leak event resets its pixel to a random level, with which noise events are more frequent for a while."""
    leak_periods = 0.03
    simulated = reset_pixel_rates(*thresholds, dead_periods, 5, pixels, 400, leak_periods=leak_periods)
    alone, leaking = (float(events_per_period(*thresholds, dead_periods, rate)) for rate in (0.0, leak_periods))
    assert leaking > times * alone
    # 3600 events or more: standard error below 3 %; interpolation adds 5 %
    assert leaking == pytest.approx(simulated, rel=within)
    of_both = noise_rates_hz(thresholds, 0.0, 1.0, 20.0, dead_periods / 20, 20 * leak_periods)
    assert sum(of_both) == pytest.approx(20 * leaking)
    # without a dead time leak events reset nothing
    assert events_per_period(*thresholds, 0.0, leak_periods) == events_per_period(*thresholds, 0.0)


def test_the_table_meets_the_published_relation_of_noise_and_rate():
    # fit of Graça and Delbruck 2021, their Fig. 3 as v2e has it: θ/Vn against x = log10(R_ON/f3dB)
    def graca(x):
        return 10 ** (-0.0026 * x**3 - 0.036 * x**2 - 0.1949 * x + 0.321)

    found = {}
    for theta in (2.0, 3.0, 4.0):
        on, off = noise_rates_hz((theta, theta), 0.0, 1.0, 1.0, 0.05)
        assert on == pytest.approx(off)
        found[theta] = graca(math.log10(on)) / theta
    # the two meet at three σ; the published curve is flatter, as it is of pixels whose poles are not equal
    assert found[3.0] == pytest.approx(1.0, abs=0.05)
    assert 1.15 < found[2.0] < 1.3 and 0.85 < found[4.0] < 0.99


def test_level_crossings_are_not_the_rate_of_a_pixel_that_resets():
    pole_hz = 1 / math.sqrt(math.sqrt(2) - 1)  # crossings of zero per period, Rice
    for theta, least, most in ((3.0, 4, 9), (4.0, 15, 60)):
        rice = 2 * pole_hz * math.exp(-(theta**2) / 2)
        assert least < float(events_per_period(theta, theta, 0.05)) / rice < most


def test_noise_is_the_inverse_of_its_rate():
    for rate_hz in (0.01, 1.0, 30.0):
        for mismatch, dead_s in ((0.0, 1e-3), (0.2, 1e-3), (0.1, 0.0)):
            sigma = noise_sigma(rate_hz, (0.2, 0.3), mismatch, 150.0, dead_s)
            on, off = noise_rates_hz((0.2, 0.3), mismatch, sigma, 150.0, dead_s)
            assert on + off == pytest.approx(rate_hz, rel=1e-4)
            assert on > off  # ON needs more events for the same way
    assert noise_rates_hz((0.2, 0.2), 0.1, 0.0, 150.0, 0.0) == (0.0, 0.0)
    # spread thresholds give more events than equal ones: 1 + u⁴ m²/4 or more
    assert sum(noise_rates_hz((0.2, 0.2), 0.2, 0.05, 150.0, 1e-3)) > 1.3 * sum(
        noise_rates_hz((0.2, 0.2), 0.0, 0.05, 150.0, 1e-3)
    )


def test_the_mean_over_pixels_has_the_rare_ones_of_low_threshold():
    rng = np.random.default_rng(2)
    for mismatch, sigmas in ((0.25, 4.0), (0.1, 5.0)):
        on, off = sigmas * np.maximum(1 + mismatch * rng.standard_normal((2, 400_000)), 0.05)
        drawn = events_per_period(on, off, 0.08)
        quadrature = sum(noise_rates_hz((sigmas, sigmas), mismatch, 1.0, 1.0, 0.08))
        # standard error of the mean of the draws below 0.5 %
        assert drawn.std() / math.sqrt(drawn.size) < 0.005 * drawn.mean()
        assert quadrature == pytest.approx(drawn.mean(), rel=0.02)


def test_electrons_per_lux_by_an_independent_sum():
    spec = read_sensor("imx636")
    wavelength_nm = np.arange(360.0, 830.5, 0.5)
    light = illuminant("LED-B2").at(wavelength_nm)
    watts = light / (683.002 * np.trapezoid(light * photopic().at(wavelength_nm), wavelength_nm))
    clear = np.interp(wavelength_nm, [380, 400, 420, 650, 690, 720], [0, 0.5, 1, 1, 0.5, 0])
    photons = watts * wavelength_nm * 1e-9 / (constants.h * constants.c)
    expected = (4.86e-6) ** 2 * 0.77 * 0.7 * np.trapezoid(clear * photons, wavelength_nm)
    flux = electrons_per_s_lux(spec, "clear", illuminant("LED-B2"))
    assert flux == pytest.approx(expected, rel=2e-4)
    # one DN of the file's signal is one lux
    reference = spec.evs.signal_reference
    assert reference.k_dn_per_e * reference.t_ref_us * 1e-6 * expected == pytest.approx(1.0, rel=2e-4)


def test_a_latency_is_that_of_two_equal_poles():
    for theta, step in ((0.2, 0.69), (0.1, 0.11), (0.2, 5.0)):
        corner_hz = corner_of_latency_hz(250.0, theta, step)
        pole = 2 * np.pi * corner_hz / np.sqrt(np.sqrt(2) - 1)
        reached = step * (1 - (1 + pole * 250e-6) * np.exp(-pole * 250e-6))
        assert reached == pytest.approx(theta, rel=1e-9)
        assert latency_us(corner_hz, theta, step) == pytest.approx(250.0)


def test_the_coefficients_have_the_figures_of_the_sheet():
    evs = read_sensor("imx636").evs
    assert evs.contrast_threshold_on == pytest.approx(math.log(1.25))
    # 2.5 % of contrast at 25 % is 0.02 in ln units
    assert evs.threshold_mismatch_rel * math.log(1.25) == pytest.approx(0.02)
    (beta,) = evs.coefficients
    assert (beta.beta1, beta.beta2, beta.beta5) == (1.0, 0.08, 0.0)
    # shot noise of light and dark current: σ² of 5 lx over that of 20 lx is (20 + L0)/(5 + L0)
    variance = {lux: (beta.beta3**2 * lux + beta.beta4**2) / (lux + 0.08) ** 2 for lux in (5.0, 20.0)}
    assert variance[5.0] / variance[20.0] == pytest.approx(20.08 / 5.08)
    assert evs.photoreceptor.filters_noise and evs.noise_cutoff_hz == 60
    assert evs.photoreceptor.min_cutoff_hz == pytest.approx(corner_at(evs.photoreceptor, 5) * 0.08 / 5.08)


def test_noise_that_the_corner_limits_has_the_rate_of_the_sheet():
    """At 5 lx the corner leaves 60 of 90 Hz, and of the variance the same part."""
    evs = read_sensor("imx636", {SHEET + "noise_cutoff_hz": 90}).evs
    (beta,) = evs.coefficients
    variance = (beta.beta3**2 * 5 + beta.beta4**2) / 5.08**2
    corner_hz = corner_at(evs.photoreceptor, 5)
    share = corner_hz / 90
    assert 0.6 < share < 0.7
    noise = noise_sigma(10.0 - 0.1, (math.log(1.25),) * 2, evs.threshold_mismatch_rel, corner_hz, 500e-6, 0.1)
    assert variance * share == pytest.approx(noise**2, rel=1e-4)


def two_rates(tmp_path, first, second):
    file = tmp_path / "mine.yaml"
    file.write_text(BARE)
    changes = {
        SHEET + "speed": [], SHEET + "dark_lux": None, SHEET + "noise_cutoff_hz": 150,
        SHEET + "background": [{"lux": lux, "rate_hz": rate_hz} for lux, rate_hz in (first, second)],
    }  # fmt: skip
    return read_sensor(file, changes)


def test_two_background_rates_tell_the_dark_current(tmp_path):
    (beta,) = two_rates(tmp_path, (50, 0.5), (2, 4.0)).evs.coefficients
    theta, spread = (math.log(1.25),) * 2, read_sensor("imx636").evs.threshold_mismatch_rel
    for lux, rate_hz in ((50.0, 0.5), (2.0, 4.0)):
        sigma = math.sqrt(beta.beta3**2 * lux + beta.beta4**2) / (lux + beta.beta2)
        assert sum(noise_rates_hz(theta, spread, sigma, 150.0, 500e-6, 0.1)) == pytest.approx(rate_hz - 0.1, rel=1e-3)
    assert beta.beta4**2 == pytest.approx(beta.beta3**2 * beta.beta2)


def test_v2e_options_keep_their_meaning():
    evs = read_sensor("v2e-noisy").evs
    assert (evs.contrast_threshold_on, evs.contrast_threshold_off, evs.leak_rate_hz) == (0.2, 0.2, 0.1)
    assert evs.threshold_mismatch_rel == pytest.approx(0.05 / 0.2)
    assert evs.refractory_period_us is None and evs.photoreceptor.cutoff_hz == 30
    for grey in (0, 77, 255):  # v2e's own law
        assert corner_at(evs.photoreceptor, 100 * grey / 255) == pytest.approx(30 * (grey + 20) / 275)
    (beta,) = evs.coefficients
    for lux, rate_hz in ((0.0, 5.0), (100.0, 1.25)):  # white has a quarter of the noise of the dark
        sigma = (beta.beta3 * lux + beta.beta4) / (lux + beta.beta2)
        assert sum(noise_rates_hz((0.2, 0.2), 0.25, sigma, 30.0, 0.0)) == pytest.approx(rate_hz, rel=1e-3)
    clean = read_sensor("v2e-clean").evs
    assert clean.photoreceptor is None and clean.leak_rate_hz == 0
    assert clean.coefficients[0].beta3 == clean.coefficients[0].beta4 == 0
    assert clean.threshold_mismatch_rel == pytest.approx(0.1)


def test_changes_reach_the_sheet_and_have_the_last_word():
    assert read_sensor("imx636", {SHEET + "threshold_on_percent": 50}).evs.contrast_threshold_on == pytest.approx(
        math.log(1.5)
    )
    wider = read_sensor("imx636", {"geometry.pitch_um": 9.72}).evs.signal_reference.k_dn_per_e
    assert wider == pytest.approx(read_sensor("imx636").evs.signal_reference.k_dn_per_e / 4)
    changed = read_sensor("imx636", {"evs.leak_rate_hz": 7.0, "evs.coefficients.0.beta4": 0.5}).evs
    assert changed.leak_rate_hz == 7.0 and changed.coefficients[0].beta4 == 0.5


@pytest.mark.parametrize(
    ("old", "new", "key", "text"),
    [
        ("    dark_lux: 0.08\n", "", "evs.data_sheet", "needs dark_lux"),
        ("threshold_on_percent: 25", "threshold_on_percent: 0", SHEET + "threshold_on_percent", "greater than"),
        ("threshold_on_percent: 25", "threshold_on: 25", SHEET + "threshold_on", "did you mean"),
        ("rate_hz: 10}", "rate_hz: 0.05}", SHEET + "background", "background includes the leak"),
        ("rate_hz: 10}", "rate_hz: 1000}", "evs.data_sheet", "at most"),
        ("lux: 1000, latency_us: 100}", "lux: 1000, latency_us: 2}", "evs.data_sheet", "as fast as the light"),
        ("lux: 1000, latency_us: 100}", "lux: 1000, latency_us: 5000}", "evs.data_sheet", "not fall"),
        ("latency_us: 100}", "latency_us: 100, bandwidth_hz: 3}", SHEET + "speed.0", "not both"),
        ("speed_step_percent: 100", "speed_step_percent: 20", "evs.data_sheet", "more than the threshold of 25 %"),
        ("noise_cutoff_hz: 60", "noise_cutoff_hz: 5000", "evs.data_sheet", "above the pixel's"),
        ("  window_us: 1\n", "  window_us: 1\n  leak_rate_hz: 1\n", "evs.leak_rate_hz", "follows from data_sheet"),
        ("reference: last_event", "reference: previous_sample\n  tick_us: 100", "evs", "asynchronous pixels"),
        ("light: LED-B2", "light: {peak_nm: 900, fwhm_nm: 1}", "evs.data_sheet", "lux"),
    ],
)
def test_mistakes_in_a_sheet_name_file_line_and_key(old, new, key, text, tmp_path):
    assert IMX636.count(old) >= 1
    file = tmp_path / "mine.yaml"
    file.write_text(IMX636.replace(old, new, 1))
    with pytest.raises(SpecError) as caught:
        read_sensor(file)
    problem = caught.value.problems[0] if caught.value.problems else caught.value
    assert str(problem).startswith(f"{file}:{problem.line}: ") and text in str(problem)
    assert problem.key is not None and problem.key.startswith(key)


def test_rates_that_no_shot_noise_has_are_refused(tmp_path):
    with pytest.raises(SpecError, match="do not follow shot noise"):
        two_rates(tmp_path, (5, 10.0), (50, 20.0))


@pytest.mark.parametrize("name", list_names("sensors"))
def test_every_sheet_that_ships_gives_its_own_rates(name):
    evs = read_sensor(name).evs
    if evs is None or evs.data_sheet is None:
        return
    sheet, (beta,) = evs.data_sheet, evs.coefficients
    for level in sheet.background:
        corner_hz = corner_at(evs.photoreceptor, level.lux)
        share = min(corner_hz / evs.noise_cutoff_hz, 1)
        sigma = math.sqrt((beta.beta3**2 * level.lux + beta.beta4**2) * share) / (level.lux + beta.beta2)
        on, off = noise_rates_hz(
            (evs.contrast_threshold_on, evs.contrast_threshold_off), evs.threshold_mismatch_rel, sigma,
            share * evs.noise_cutoff_hz, evs.refractory_period_us * 1e-6, sheet.leak_hz,
        )  # fmt: skip
        assert on + off + sheet.leak_hz == pytest.approx(level.rate_hz, rel=1e-3)
    # the step that crosses the threshold after the stated time, solved and not by the inverse formula
    for speed in sheet.speed:
        if speed.latency_us is not None:
            bright = speed.lux * (1 + sheet.speed_step_percent / 100)
            corner_hz = corner_at(evs.photoreceptor, bright)
            pole = 2 * np.pi * corner_hz / np.sqrt(np.sqrt(2) - 1) * 1e-6
            change = math.log((bright + beta.beta2) / (speed.lux + beta.beta2))
            found = optimize.brentq(
                lambda t, a=pole, s=change: s * (1 - (1 + a * t) * np.exp(-a * t)) - evs.contrast_threshold_on, 0, 1e7
            )
            assert found == pytest.approx(speed.latency_us, rel=1e-3)
