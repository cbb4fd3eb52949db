"""A hyperspectral cube through a study of filter sets, and as a moving image in front of a sensor.

The cube beside this script is a rendered ColorChecker, 60×40 pixels, 380-780 nm in steps of 20 nm, radiance under D65.
Any other cube will do.

Run: python examples/cube_study.py [cube]
"""

import sys
from pathlib import Path

import hesim_render as hr

cube = sys.argv[1] if len(sys.argv) > 1 else str(Path(__file__).with_name("colorchecker-cube.exr"))

study = {
    "schema_version": 1,
    "name": "one cube, three filter sets",
    "sensors": ["reference-bayer"],
    "filter_sets": ["rggb", "ryyb", "cygm"],
    "surfaces": [{"cube": cube, "quantity": "radiance", "beyond": "hold"}],
    "figures": ["colour"],
}
for row in hr.study(study):
    print(f"{row['filter_set']}: mean ΔE2000 {row['delta_e_cube_mean']:.2f}, 95 % {row['delta_e_cube_p95']:.2f}")

sensor = hr.load_sensor("reference-mono").crop(120, 80)
options = {"quantity": "radiance", "beyond": "hold", "pan_px_per_s": (400, 0), "rotation_deg_per_s": 20}
rec = hr.simulate_cube(cube, sensor, duration_s=0.1, **options)
print(f"{len(rec.frames)} frames, {len(rec.events)} events")
