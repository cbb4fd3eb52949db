"""What stratified rays gain: error of n rays over what the pilot says of their scatter, on scenes of change_driven.py.

    python benchmarks/allocation.py [--scenes star,sweep,glass] [--pixels 3000]

`renderer.options.Tuning` has factor · n^-power of the fit, `matt_gain` of star and sweep, `path_gain` of glass; the
factor is larger than the fit, for a pilot of 16 rays knows scatter less well than the 64 of this script. The scenes of
`tests/sources/render/test_hidden_scenes.py` and `tests/support/random_scenes.py` judge it.

Of random pixels that scatter, in windows of 1 ms (events) and 10 ms (exposures): the truth is the mean of six traces of
4096 rays, errors are pooled over pixels before they are divided.
"""

from __future__ import annotations

import argparse

import numpy as np
from change_driven import SCENES, SENSOR, SPEEDS

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows

RAYS = (16, 64, 256, 1024)


def ratios(name: str, activity: int, length_us: float, pixels: int) -> list[float]:
    """Error over scatter for each number of rays."""
    scene = SCENES[name](SPEEDS[name][activity])
    sensor = place_camera(scene.spec, hr.load_sensor("reference-mono", SENSOR), None).sensor
    tracer = ChangeDrivenFlux(scene, sensor, seed=5)._tracer
    rng = np.random.default_rng(1)
    full = sensor.layout.full_index.ravel()
    pixel = np.sort(rng.choice(full, min(full.size, 4 * pixels), replace=False))
    window, zero = Windows(np.array([20_000.0]), np.array([20_000.0 + length_us])), np.zeros(pixel.size, np.int64)
    pilot = tracer.pilot(pixel, zero, window, 64, 1.0)
    controlled = pilot.controlled_scatter <= pilot.plain_scatter
    scatter, flux = (
        np.where(controlled, pilot.controlled_scatter, pilot.plain_scatter),
        np.where(controlled, pilot.controlled, pilot.plain),
    )
    # what has an error that counts: half a per cent of the flux in a single ray
    some = np.flatnonzero(scatter > 0.005 * np.maximum(flux, 1e-9))
    some = rng.permutation(some)[:pixels]
    unit = 0.01 * flux[some]

    def traced(rays: int, repeat: int) -> np.ndarray:
        count = np.full(some.size, rays)
        told = tracer.trace(pixel[some], zero[some], window, count, controlled[some], Stream.AUDIT, repeat=repeat)
        return told.mean.astype(np.float64)

    truth = np.mean([traced(4096, repeat) for repeat in range(6)], axis=0)
    spread = np.sqrt(np.mean((scatter[some] / unit) ** 2))
    errors = [np.sqrt(np.mean(((traced(rays, 100 + rays) - truth) / unit) ** 2)) for rays in RAYS]
    return [float(error / spread) for error in errors]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="star,sweep,glass")
    parser.add_argument("--pixels", type=int, default=3000)
    options = parser.parse_args()
    print(f"{'scene':14s} {'window':>7s}  " + "".join(f"{rays:>8d}" for rays in RAYS) + "   factor power")
    for name in options.scenes.split(","):
        for activity in (3, 10, 25):
            for length_us in (1000.0, 10_000.0):
                found = ratios(name, activity, length_us, options.pixels)
                power, factor = np.polyfit(np.log(RAYS), np.log(found), 1)
                told = "".join(f"{value:8.4f}" for value in found)
                fit = f"{np.exp(factor):.2f}  {-power:.2f}"
                print(f"{name:9s} {activity:3d} % {length_us / 1000:4.0f} ms  {told}   {fit}")


if __name__ == "__main__":
    main()
