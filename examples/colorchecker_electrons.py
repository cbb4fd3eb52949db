"""Electrons of the ColorChecker patches: rendered, and integrated by hand with the same spectra.

Run: python examples/colorchecker_electrons.py
"""

import numpy as np

import hesim_render as hr
from hesim_render.spectral import spectrum as spectra

sensor = hr.load_sensor("reference-bayer").crop(384, 256)
scene = hr.load_scene("flat-field", {"target.reflectance": {"colorchecker": "ISO 17321-1", "patch": 14}})  # green
recording = hr.simulate(scene, sensor, duration_s=0.02, seed=1, clean=True)
frame = recording.frames[0]

# A diffuse surface under illuminance E reflects L = ρ·E/π, in W m^-2 sr^-1 nm^-1.
irradiance = spectra.scale_to_lux(spectra.illuminant("D65"), 1000)
patch = list(spectra.colorchecker_reflectances().values())[13]
wavelength_nm = np.arange(380.0, 781.0)
radiance = patch.at(wavelength_nm) * irradiance.at(wavelength_nm) / np.pi

# The scene's camera sets focus, and so the magnification; the recording says what was used.
lens = recording.manifest["lens"]
sensor = hr.load_sensor("reference-bayer", {"lens.magnification": lens["magnification"]}).crop(384, 256)

print("filter   rendered e-   by hand e-")
centre = np.s_[112:144, 176:208]  # cos^4 is 1 there to within 0.1 %
for number, name in enumerate(sensor.layout.filters):
    here = sensor.layout.filter_index[centre] == number
    rendered = frame.electrons_mean[centre][here].mean()
    by_hand = hr.photocurrent(radiance, wavelength_nm, sensor, frame.exposure_us, filter=name)
    print(f"{name:<8} {rendered:11.1f}   {by_hand:10.1f}")
