"""Measure the spatial frequency response of a simulated camera on a slanted edge, and compare with its parts.

Run: python examples/measure_mtf.py
"""

import numpy as np

import hesim_render as hr
from hesim_render.measure import measure_mtf

sensor = hr.load_sensor("reference-quiet").crop(256, 192)
scene = hr.load_scene("slanted-edge", {"light.illuminance_lux": 300})
rec = hr.simulate(scene, sensor, duration_s=0.02, seed=3)
response = measure_mtf(rec, region=(78, 20, 100, 150))

# the pixel is a square, the lens a Gaussian blur: both along the normal of the edge, which is turned by `angle`
angle = np.radians(scene.spec.target.angle_deg)
frequency = response.frequency_cy_per_px
blur_px = sensor.spec.lens.psf_fwhm_um / (8 * np.log(2)) ** 0.5 / sensor.spec.geometry.pitch_um
expected = np.sinc(frequency * np.cos(angle)) * np.sinc(frequency * np.sin(angle))
expected *= np.exp(-2 * (np.pi * blur_px * frequency) ** 2)
print("cycles/px  measured  closed form")
for at in (0.1, 0.2, 0.3, 0.4, 0.5):
    k = int(np.argmin(np.abs(frequency - at)))
    print(f"{frequency[k]:9.3f}{response.mtf[k]:10.3f}{expected[k]:13.3f}")
