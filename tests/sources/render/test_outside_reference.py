"""The default mode against light worked out by hand, where no symmetry hides an exchange of axes, filters or places.

The audit of a run uses the same renderer with other random numbers. It cannot see that a filter sits at a wrong place
of the tile, or that the region lies elsewhere on the sensor: all values would be wrong alike. Here tile, region, camera
and lamp have no symmetry at all, and the expected electrons come from NumPy and colour-science alone.
"""

import colour
import numpy as np
from rendering import d65_irradiance, make_scene
from scipy import constants

import hesim_render as hr

#: Full sensor, its pixel and tile, and the region: columns, rows, first column and first row.
FULL_COLS, FULL_ROWS, PITCH_UM, FILL, QE = 60, 34, 6.5, 0.8, 0.55
TILE = ["RGe", "WBG"]
COLS, ROWS, X, Y = 24, 14, 9, 16
#: Lens, camera, wall and exposure; a lamp close to one side of the picture, and its level at the origin.
FOCAL_MM, F_NUMBER, GLASS, DISTANCE_M, EXPOSURE_US = 5.0, 2.8, 0.93, 1.3, 7000
ASIDE_M, LAMP_M, LUX, REFLECTANCE = (0.04, -0.07), (0.21, 0.13, 0.4), 240.0, 0.37
DIM = [380, 500, 720], [0.1, 0.3, 0.6]


def lopsided():
    """A sensor without symmetry."""
    filters = {
        name: {"camera": "Nikon 5100 (NPL)", "channel": name, "basis": "energy"} for name in ("red", "green", "blue")
    }
    roles = {
        "R": ("red", "aps"),
        "G": ("green", "aps"),
        "B": ("blue", "aps"),
        "W": ("dim", "aps"),
        "e": ("green", "evs"),
    }
    return hr.load_sensor("gen2", {
        "geometry": {"rows": FULL_ROWS, "cols": FULL_COLS, "pitch_um": PITCH_UM, "fill_factor": FILL},
        "tile": "\n".join(" ".join(row) for row in TILE) + "\n",
        "pixels": {letter: {"filter": name, "roles": [role]} for letter, (name, role) in roles.items()},
        "filters": {**filters, "dim": {"wavelength_nm": DIM[0], "value": DIM[1]}},
        "quantum_efficiency": QE, "lens.f_number": F_NUMBER, "lens.focal_length_mm": FOCAL_MM,
        "lens.transmittance": GLASS, "aps.exposure_us": EXPOSURE_US, "aps.full_well_e": 10**6,
    }).crop(COLS, ROWS, X, Y)  # fmt: skip


def expected_flux():
    """Electrons per second of each pixel of the region, [row, col], by Eq. 1 and the inverse square law."""
    grid, level = d65_irradiance(LUX)
    cameras = colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"]
    curves = {name: np.interp(grid, cameras.wavelengths, cameras.values[:, k], 0, 0)
              for k, name in enumerate(("red", "green", "blue"))}  # fmt: skip
    # curves per energy, with their own peak at 1: per photon they fall with the wavelength
    white = {"R": "red", "G": "green", "B": "blue", "e": "green"}
    photons = grid * 1e-9 / (constants.h * constants.c)
    magnification = FOCAL_MM * 1e-3 / (DISTANCE_M - FOCAL_MM * 1e-3)
    light_cone = np.pi / (1 + 4 * F_NUMBER**2 * (1 + magnification) ** 2)
    area = FILL * (PITCH_UM * 1e-6) ** 2
    per_radiance = {}
    for letter in "RGBeW":
        if letter == "W":
            electrons = QE * photons * np.interp(grid, *DIM, 0, 0)
        else:
            by_energy = curves[white[letter]]
            by_photon = by_energy / photons
            electrons = QE * by_energy / by_photon.max()
        per_radiance[letter] = area * light_cone * GLASS * np.trapezoid(electrons * level * REFLECTANCE / np.pi, grid)
    # places on the wall: the picture is upside down on the sensor, and row 0 is its top
    image_m = FOCAL_MM * 1e-3 * (1 + magnification)
    col, row = np.meshgrid(np.arange(COLS) + X + 0.5, np.arange(ROWS) + Y + 0.5)
    right = (col - FULL_COLS / 2) * PITCH_UM * 1e-6 / image_m
    up = -(row - FULL_ROWS / 2) * PITCH_UM * 1e-6 / image_m
    x, y = ASIDE_M[0] + right * DISTANCE_M, ASIDE_M[1] + up * DISTANCE_M
    square = (x - LAMP_M[0]) ** 2 + (y - LAMP_M[1]) ** 2 + LAMP_M[2] ** 2
    at_origin = np.sum(np.square(LAMP_M))
    falloff = (at_origin / square) ** 1.5  # cos θ/r², with cos θ = height/r
    letters = np.array(
        [list(TILE[(r + Y) % 2][(X % 3) :] + TILE[(r + Y) % 2][: X % 3]) * (COLS // 3) for r in range(ROWS)]
    )
    base = np.vectorize(per_radiance.__getitem__)(letters)
    return base * falloff / (1 + right**2 + up**2) ** 2, letters


def test_every_pixel_has_its_own_filter_place_and_light():
    scene = make_scene(
        objects=[{"name": "wall", "shape": "rectangle", "size_m": [3.0, 3.0, 0.0], "reflectance": REFLECTANCE}],
        light={"type": "point", "position_m": list(LAMP_M), "illuminance_lux": LUX},
        camera={"origin_m": [*ASIDE_M, DISTANCE_M], "target_m": [*ASIDE_M, 0.0]},
    )
    recording = hr.simulate(scene, lopsided(), duration_s=0.012, seed=3, clean=True, audit=False)
    assert recording.manifest["settings"]["mode"] == "change-driven"
    expected, letters = expected_flux()
    frame = recording.frames[0]
    assert ((letters != "e") == frame.valid).all()
    ratio = (frame.electrons_mean / (expected * EXPOSURE_US * 1e-6))[frame.valid]
    np.testing.assert_allclose(ratio, 1, atol=2e-3)
    # pixels that exchange their filters or their places differ by more than ten times this
    events = recording.event_truth.flux_mean_e_per_s
    np.testing.assert_allclose(events / expected[letters == "e"].reshape(events.shape), 1, atol=2e-3)
