"""Which of two filter sets tells colours apart better at the same exposure? No renderer needed.

Any radiance cube will do; here it is the 24 ColorChecker patches under an LED.

Run: python examples/filter_study.py
"""

import numpy as np

import hesim_render as hr
from hesim_render.spectral import spectrum as spectra

wavelength_nm = np.arange(380.0, 781.0, 1.0)
light = spectra.scale_to_lux(spectra.illuminant("LED-B3"), 200)
radiance = np.array([patch.at(wavelength_nm) for patch in spectra.colorchecker_reflectances().values()])
radiance *= light.at(wavelength_nm) / np.pi  # W m^-2 sr^-1 nm^-1, [patch, band]


def patch_electrons(sensor):
    """Electrons of every patch through every filter in 10 ms, [patch, filter]."""
    return np.stack(
        [hr.photocurrent(radiance, wavelength_nm, sensor, 10_000, filter=name) for name in sensor.layout.filters],
        axis=-1,
    )


def separability(electrons):
    """Smallest distance between two patches in units of their shot noise."""
    difference = electrons[:, None] - electrons[None]
    variance = electrons[:, None] + electrons[None]
    distance = np.sqrt((difference**2 / variance).sum(axis=-1))
    return distance[~np.eye(len(electrons), dtype=bool)].min()


measured = hr.load_sensor("reference-bayer")
gaussian = hr.load_sensor(
    "reference-bayer",
    {
        "filters.red": {"peak_nm": 610, "fwhm_nm": 60},
        "filters.green": {"peak_nm": 540, "fwhm_nm": 60},
        "filters.blue": {"peak_nm": 470, "fwhm_nm": 60},
    },
)
for label, sensor in (("Nikon 5100 curves", measured), ("Gaussians, 60 nm", gaussian)):
    electrons = patch_electrons(sensor)
    print(f"{label}: white patch {electrons[18].round().astype(int)} e-, least distance {separability(electrons):.1f}")
