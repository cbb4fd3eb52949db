"""Eq. 1 against ISETCam's electron counts, against closed forms, and its derivative."""

from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from scipy import constants

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError, SpecError

DATA = Path(__file__).parents[1] / "data"


def isetcam_sensor(tmp_path):
    table = np.genfromtxt(DATA / "isetcam_colorchecker_d65_inputs.csv", delimiter=",", names=True)
    wavelength = table["wavelength_nm"]
    for channel in "RGB":
        quantum_efficiency = table[f"QE_{channel}"].tolist()
        rows = "\n".join(f"{w},{q!r}" for w, q in zip(wavelength.tolist(), quantum_efficiency, strict=True))
        (tmp_path / f"{channel}.csv").write_text(f"wavelength_nm,qe\n{rows}\n")
    (tmp_path / "imx363.yaml").write_text(
        """
schema_version: 1
name: imx363
description: the sensor of ISETCam's table
device_seed: 0
geometry: {rows: 4, cols: 4, pitch_um: 2.0}
tile: |
  R G
  G B
pixels:
  R: {filter: R, roles: [aps]}
  G: {filter: G, roles: [aps]}
  B: {filter: B, roles: [aps]}
filters: {R: R.csv, G: G.csv, B: B.csv}
quantum_efficiency: 1.0
lens: {f_number: 4.0, focal_length_mm: 4.38, magnification: -0.00322936, relative_illumination: none}
aps: {full_well_e: 6000, system_gain_dn_per_e: 0.16, bit_depth: 10, black_level_dn: 64, read_noise_e: 5,
      dark_current_e_per_s: 0, exposure_us: 10000, frame_rate_hz: 30, shutter: global}
"""
    )
    return hr.load_sensor(tmp_path / "imx363.yaml"), table, wavelength


def test_isetcam_colorchecker_electrons_to_1e6(tmp_path):
    sensor, table, wavelength = isetcam_sensor(tmp_path)
    expected = np.genfromtxt(DATA / "isetcam_colorchecker_d65_electrons.csv", delimiter=",", names=True)
    photons = np.stack([table[f"L_p{k}"] for k in range(1, 25)])
    radiance = photons * constants.h * constants.c / (wavelength * 1e-9)  # W m^-2 sr^-1 nm^-1
    for channel in "RGB":
        electrons = hr.photocurrent(radiance, wavelength, sensor, 10_000, filter=channel, quadrature="rectangle")
        np.testing.assert_allclose(electrons, expected[channel], rtol=1e-6)


def test_spectral_response_is_each_named_factor():
    sensor = hr.load_sensor("reference-mono")
    wavelength = np.array([399.0, 400.0, 550.0, 700.0, 701.0])
    solid_angle = np.pi / (1 + 4 * 4.0**2)
    expected = (5e-6) ** 2 * solid_angle * wavelength * 1e-9 / (constants.h * constants.c)
    expected[[0, -1]] = 0
    np.testing.assert_allclose(sensor.spectral_response(wavelength)["clear"], expected, rtol=1e-9)


def test_flat_radiance_equals_the_closed_form():
    sensor = hr.load_sensor("reference-mono").crop(8, 4)
    bands = np.array([380.0, 500.0, 620.0, 740.0])
    electrons = hr.photocurrent(np.full((4, 8, 4), 0.01), bands, sensor, 10_000)
    # ∫ λ dλ over 400-700 nm in closed form
    integral = 0.01 * (700.0**2 - 400.0**2) / 2 * 1e-9 / (constants.h * constants.c)
    expected = 25e-12 * np.pi / 65 * integral * 0.01
    np.testing.assert_allclose(electrons, expected, rtol=1e-6)


def test_trapezoid_rule_meets_a_fine_integral():
    sensor = hr.load_sensor("reference-bayer")
    bands = np.arange(370.0, 791.0, 15.0)
    radiance = np.random.default_rng(3).random(bands.size)
    fine = np.arange(380.0, 780.0005, 0.001)
    for name, response in sensor.responses.items():
        exact = np.trapezoid(response.at(fine) * np.interp(fine, bands, radiance), fine)
        ours = hr.photocurrent(radiance, bands, sensor, 1e6, filter=name)
        assert ours == pytest.approx(exact, rel=2e-4)


def test_mosaic_uses_each_pixels_filter_and_vignetting():
    sensor = hr.load_sensor("eiger").crop(16, 8, x=0, y=0)
    bands = np.arange(380.0, 781.0, 10.0)
    cube = np.random.default_rng(1).random((8, 16, bands.size))
    electrons = hr.photocurrent(cube, bands, sensor, 1000)
    for row, col, name in (
        (0, 0, "red"),
        (1, 1, "red"),
        (0, 2, "green"),
        (3, 3, "blue"),
        (6, 1, "green"),
        (1, 14, "green"),
    ):
        alone = hr.photocurrent(cube[row, col], bands, sensor, 1000, filter=name)
        assert electrons[row, col] == pytest.approx(alone * sensor.relative_illumination[row, col], rel=1e-6)


def test_drjit_agrees_and_differentiates():
    sensor = hr.load_sensor("eiger").crop(8, 4, x=16, y=8)  # a corner, where the lens takes light away
    bands = np.arange(380.0, 781.0, 20.0)
    cube = np.random.default_rng(2).random((4, 8, bands.size)).astype(np.float32)
    radiance = jit().TensorXf(cube)
    dr.enable_grad(radiance)
    electrons = hr.photocurrent(radiance, bands, sensor, 1000)
    np.testing.assert_allclose(electrons.numpy(), hr.photocurrent(cube, bands, sensor, 1000), rtol=1e-4)
    dr.backward(dr.sum(electrons, axis=None))
    # Eq. 1 is linear: the derivative is the response to a unit radiance in one band
    unit = np.zeros_like(cube)
    unit[2, 5, 9] = 1
    expected = hr.photocurrent(unit, bands, sensor, 1000)[2, 5]
    assert dr.grad(radiance).numpy()[2, 5, 9] == pytest.approx(expected, rel=1e-4)


def test_own_responses_are_those_of_the_sensor_where_they_are_the_same():
    """At 1 nm both integrals are the same; between coarse bands the exact one of two straight lines by SciPy."""
    from scipy.integrate import quad

    sensor = hr.load_sensor("eiger").crop(8, 4, x=16, y=8)  # a corner, where the lens takes light away
    bands = np.arange(360.0, 831.0)
    cube = np.random.default_rng(3).random((4, 8, bands.size))
    table = np.stack([sensor.spectral_response(bands)[name] for name in sensor.layout.filters])
    electrons = hr.photocurrent(cube, bands, sensor, 1000, responses=table)
    np.testing.assert_allclose(electrons, hr.photocurrent(cube, bands, sensor, 1000), rtol=1e-3)
    name = sensor.layout.filters[1]
    few, level, own = np.array([400.0, 430.0, 500.0]), np.array([1.0, 3.0, 2.0]), np.array([5.0, 1.0, 4.0])
    exact = quad(lambda nm: np.interp(nm, few, level) * np.interp(nm, few, own), 400, 500, points=[430])[0]
    assert hr.photocurrent(level, few, sensor, 1e6, filter=name, responses=own) == pytest.approx(exact, rel=1e-12)
    grid = np.array([400.0, 450.0, 500.0])
    rectangle = hr.photocurrent(level, grid, sensor, 1e6, filter=name, responses=own, quadrature="rectangle")
    assert rectangle == pytest.approx(50 * level @ own)
    two = hr.photocurrent(level[:2], grid[:2], sensor, 1e6, filter=name, responses=own[:2], quadrature="rectangle")
    assert two == pytest.approx(50 * level[:2] @ own[:2])


def test_gradients_with_respect_to_radiance_and_responses():
    """Against central differences of a cost that is not linear, on a float64 copy: 1e-3 of the gradient's norm."""
    sensor = hr.load_sensor("eiger").crop(8, 4, x=16, y=8)  # a corner, where the lens takes light away
    bands = np.array([400.0, 420.0, 470.0, 530.0, 600.0, 640.0, 700.0])
    rng = np.random.default_rng(4)
    cube = rng.uniform(0.5, 1.5, (4, 8, bands.size))
    table = rng.uniform(0.5, 1.5, (len(sensor.layout.filters), bands.size)) * 1e3

    def cost(radiance, responses):
        electrons = hr.photocurrent(radiance, bands, sensor, 10_000, responses=responses)
        return float(np.sum(np.log(electrons) ** 2))

    def central(values, of):
        found = np.empty(values.size)
        for k in range(values.size):
            step = np.zeros(values.size)
            step[k] = 1e-5 * values.ravel()[k]
            ends = [of(values + sign * step.reshape(values.shape)) for sign in (1, -1)]
            found[k] = (ends[0] - ends[1]) / (2 * step[k])
        return found.reshape(values.shape)

    tensors = [jit().TensorXf(values.astype(np.float32)) for values in (cube, table)]
    dr.enable_grad(*tensors)
    electrons = hr.photocurrent(tensors[0], bands, sensor, 10_000, responses=tensors[1])
    np.testing.assert_allclose(
        electrons.numpy(), hr.photocurrent(cube, bands, sensor, 10_000, responses=table), rtol=1e-5
    )
    dr.backward(dr.sum(dr.square(dr.log(electrons)), axis=None))
    for tensor, expected in (
        (tensors[0], central(cube, lambda values: cost(values, table))),
        (tensors[1], central(table, lambda values: cost(cube, values))),
    ):
        assert np.linalg.norm(dr.grad(tensor).numpy() - expected) < 1e-3 * np.linalg.norm(expected)
    # responses alone, with light from NumPy
    alone = jit().TensorXf(table.astype(np.float32))
    dr.enable_grad(alone)
    dr.backward(dr.sum(hr.photocurrent(cube, bands, sensor, 10_000, responses=alone), axis=None))
    expected = central(table, lambda values: hr.photocurrent(cube, bands, sensor, 10_000, responses=values).sum())
    assert np.linalg.norm(dr.grad(alone).numpy() - expected) < 1e-3 * np.linalg.norm(expected)


def test_bad_input_is_refused():
    sensor = hr.load_sensor("reference-mono").crop(8, 4)
    with pytest.raises(SpecError, match="do not cover the response"):
        hr.photocurrent(np.ones((4, 8, 3)), [450, 550, 650], sensor, 1000)
    with pytest.raises(RangeError, match="last axis of 3 bands"):
        hr.photocurrent(np.ones((4, 8, 4)), [400, 550, 700], sensor, 1000)
    with pytest.raises(RangeError, match=r"\(4, 8, 2\)"):
        hr.photocurrent(np.ones((8, 4, 2)), [400, 700], sensor, 1000)
    with pytest.raises(RangeError, match="exposure_us"):
        hr.photocurrent(np.ones((4, 8, 2)), [400, 700], sensor, -1)
    with pytest.raises(RangeError, match=r"responses.shape is \(1, 3\)"):
        hr.photocurrent(np.ones((4, 8, 2)), [400, 700], sensor, 1, responses=np.ones((1, 3)))
    with pytest.raises(SpecError, match="evenly spaced"):
        hr.photocurrent(np.ones(3), [400, 500, 700], sensor, 1, filter=sensor.layout.filters[0],
                        quadrature="rectangle", responses=np.ones(3))  # fmt: skip


def test_signals_of_event_pixels_are_scaled_from_their_own_filter_to_that_of_the_reference():
    """Under flat light: ∫ response of the reference / ∫ own response, for each position of `eiger`'s four filters."""
    sensor = hr.load_sensor("eiger", {"evs.signal_reference.filter": "green"})
    grid = np.arange(300.0, 1200.0, 0.25)
    total = {name: np.trapezoid(values, grid) for name, values in sensor.spectral_response(grid).items()}
    positions = sensor.spec.positions("evs")
    own = [sensor.spec.pixels[sensor.spec.tile_rows[i][j]].filter for i, j in positions]
    assert len(set(own)) > 2
    np.testing.assert_allclose(sensor.evs.signal_scale, [total["green"] / total[name] for name in own], rtol=2e-3)
    np.testing.assert_array_equal(hr.load_sensor("eiger").evs.signal_scale, 1)
