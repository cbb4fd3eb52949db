"""Seconds per simulated second of a moving scene, three ways at the same error, against the share that changes.

    python benchmarks/coherent.py [--scenes star,sweep,glass] [--activities 3,10,25,100] [--quality Q]
    python benchmarks/coherent.py --area

(a) `mi.render` with `specfilm`, once per tick; (b) the exact mode; (c) the coherent mode. 346×260 pixels, 800 Hz. In
all three Russian roulette is played from the sixteenth segment on. (c) alone sends paths to images of lamps in mirrors,
and does not sample an even sky beside a lamp.

(c) runs over two chunks of ticks, the second of which is timed; at quality 0.5, but glass at 2, for its caustics ask
for 1700 rays a pixel at 1. Its error is the rms over pixels, in units of each one's own event noise (3 % of the
signal), against a reference of 8192 rays a pixel, on one pixel in eight, in two ticks that are filled in for the most
part. (a) and (b) then get as many samples as bring their noise to that error, and one tick of each is timed at that
number. Their noise is measured from two independent pictures, so the floor that their error has besides (nothing
moves within a picture of (a), nor do objects within a slice of (b)) is not held against them; the error that they
reach is printed beside. Activity is the share of pixels whose flux changes by more than 1 % from one tick to the
next, at 256 rays with the same random numbers.

With `--area`: what (c) takes for eight chequered tiles that turn, and for the same eight of which four rest.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from hesim_render.renderer.coherent import CoherentFlux
from hesim_render.renderer.timed import TimedTracer

import hesim_render as hr
from hesim_render.renderer._mitsuba import mitsuba, spectrum_dict
from hesim_render.renderer.builder import build
from hesim_render.renderer.camera import place_camera
from hesim_render.renderer.flux import RenderedFlux, used_responses
from hesim_render.renderer.specfilm import camera_at, perspective_dict
from hesim_render.scene import Scene
from hesim_render.specs.scene import SceneSpec

TICK_US, WINDOW_US = 1250.0, 1000.0
CHUNK = 32
SENSOR = {
    "geometry.rows": 260,
    "geometry.cols": 346,
    "geometry.pitch_um": 4.0,
    "evs.tick_us": 1250,
    "evs.window_us": 1000,
    # ln-noise of 3 %, as of gen2
    "evs.coefficients": [{"beta1": 1e-3, "beta2": 5e-3, "beta3": 3.1e-5, "beta4": 2.116e-4, "beta5": 0.0}],
    "evs.shot_law": "linear",
    "evs.contrast_threshold_on": 0.2,
    "evs.contrast_threshold_off": 0.2,
}
#: How fast each scene has to move for about this share of its pixels, in per cent, to change. At 100 the star fills the
#: picture and turns by half a period a tick, everything in the sweep is finely chequered, and the glass and what is
#: around it stand between finely chequered walls, where the camera swings as well.
SPEEDS = {
    "star": {3: 0.05, 10: 1.7, 25: 7.0, 100: 40.0},
    "sweep": {3: 0.12, 10: 0.45, 25: 4.0, 100: 8.0},
    "glass": {3: 0.15, 10: 1.0, 25: 6.5, 100: 8.0},
}
#: Side of a check of the scenes in which everything changes; a pixel shows 5 mm of what is 2 m away.
FINE_M = 0.013


def star(speed: float) -> Scene:
    """A textured target that turns, half a turn per second at speed 1; it fills the picture from speed 40 on."""
    period = round(2e6 / speed)
    keys = [{"t_us": 0, "rotation_deg": 0}, {"t_us": period, "rotation_deg": -360}]
    changes: dict = {"motion": [{"object": "target", "repeat": True, "keyframes": keys}]}
    if speed >= SPEEDS["star"][100]:
        changes["camera.fit_margin"] = 1.8
    return hr.load_scene("rotating-star", changes)


def swing(speed: float, pivot: list[float]) -> dict:
    """A track of a camera, at speed 1 by 1.8 m/s and 32° per second."""
    half = round(5e5 / speed)
    keys = [
        {"t_us": 0, "translation_m": [-0.45, 0, 0], "rotation_axis": [0, 1, 0], "rotation_deg": -8},
        {"t_us": half, "translation_m": [0.45, 0.1, 0], "rotation_axis": [0, 1, 0], "rotation_deg": 8},
        {"t_us": 2 * half, "translation_m": [-0.45, 0, 0], "rotation_axis": [0, 1, 0], "rotation_deg": -8},
    ]
    return {"object": "camera", "pivot_m": pivot, "repeat": True, "keyframes": keys}


def sweep(speed: float) -> Scene:
    """A camera that goes past solids at several depths.

    From the speed of 100 % on, all of it is chequered so finely that edges go through nearly every pixel.
    """
    scene = hr.load_scene("camera-sweep", {"motion": [swing(speed, [0, 0.62, 1.75])]})
    if speed < SPEEDS["sweep"][100]:
        return scene
    spec = scene.spec.model_dump(exclude_unset=True)
    for solid in spec["objects"]:
        solid["reflectance"], solid["pattern"] = 0.7, 0.1
        solid["pattern_count"] = [round(max(solid["size_m"]) / FINE_M)] * 2
    return Scene(SceneSpec.model_validate(spec))


def glass(speed: float) -> Scene:
    """A glass ball, a rough-metal ball, a glossy box and a mirror, three of them moving on a chequered floor.

    From the speed of 100 % on the checks are fine, there are walls behind and opposite, and the camera swings.
    """
    everywhere = speed >= SPEEDS["glass"][100]

    def at(x: float, y: float, z: float, size: float) -> list[list[float]]:
        return [[size, 0, 0, x], [0, size, 0, y], [0, 0, size, z], [0, 0, 0, 1]]

    def grey(value: float) -> dict:
        return {"type": "uniform", "value": value}

    checks = {
        "type": "checkerboard",
        "color0": grey(0.6),
        "color1": grey(0.2),
        "to_uv": at(0, 0, 0, 2 / FINE_M if everywhere else 12.0),
    }
    shapes = {
        "floor": {
            "type": "rectangle",
            "to_world": [[2, 0, 0, 0], [0, 0, 2, 0], [0, -2, 0, 0], [0, 0, 0, 1]],
            "bsdf": {"type": "diffuse", "reflectance": checks},
        },
        "mirror": {
            "type": "rectangle",
            "to_world": at(0, 0.5, -1.0, 0.9),
            "bsdf": {"type": "conductor", "material": "none"},
        },
        "glass": {"type": "sphere", "to_world": at(-0.35, 0.25, 0.1, 0.22), "bsdf": {"type": "dielectric"}},
        "metal": {
            "type": "sphere",
            "to_world": at(0.4, 0.25, -0.2, 0.24),
            "bsdf": {"type": "roughconductor", "material": "none", "alpha": 0.15},
        },
        "box": {
            "type": "cube",
            "to_world": at(0.05, 0.15, 0.45, 0.13),
            "bsdf": {
                "type": "roughplastic",
                "diffuse_reflectance": {**checks, "to_uv": at(0, 0, 0, 12.0)} if everywhere else grey(0.35),
                "alpha": 0.1,
            },
        },
        "lamp": {
            "type": "rectangle",
            "to_world": [[0.5, 0, 0, 0.3], [0, 0, -0.5, 2.2], [0, 0.5, 0, 0.4], [0, 0, 0, 1]],
            "emitter": {"type": "area", "radiance": grey(0.02)},
        },
        "sky": {"type": "constant", "radiance": grey(0.002)},
    }

    def track(name: str, way: list[float], pivot: list[float]) -> dict:
        half = round(5e5 / speed)
        keys = [
            {"t_us": 0, "rotation_axis": [0, 1, 0], "rotation_deg": 0},
            {"t_us": half, "translation_m": way, "rotation_axis": [0, 1, 0], "rotation_deg": 90},
            {"t_us": 2 * half, "rotation_axis": [0, 1, 0], "rotation_deg": 180},
        ]
        return {"object": name, "pivot_m": pivot, "repeat": True, "keyframes": keys}

    motion = [
        track("glass", [0.3, 0, 0.2], [-0.35, 0.25, 0.1]),
        track("metal", [-0.2, 0, 0.1], [0.4, 0.25, -0.2]),
        track("box", [0.3, 0, 0], [0.05, 0.15, 0.45]),
    ]
    if everywhere:
        shapes["wall"] = {**shapes["floor"], "to_world": at(0, 0, -1.9, 2.0)}
        shapes["rear wall"] = {**shapes["floor"], "to_world": at(0, 0, 2.6, -2.0)}
        motion.append(swing(speed, [0, 0.7, 2.2]))
    spec = {
        "schema_version": 1,
        "name": "glass",
        "description": "glossy and transparent objects",
        "mitsuba": {"inline": shapes},
        "camera": {"origin_m": [0, 0.7, 2.2], "target_m": [0, 0.2, 0], "horizontal_fov_deg": 40},
        "max_depth": 6,
        "motion": motion,
    }
    return Scene(SceneSpec.model_validate(spec))


def tiles(moving: int) -> Scene:
    """Eight chequered tiles before a wall, the first of which turn."""
    places = [(0.11 * (k % 4 - 1.5), 0.11 * (k // 4 - 0.5)) for k in range(8)]
    tile = {
        "shape": "rectangle",
        "size_m": [0.07, 0.07, 0],
        "reflectance": 0.7,
        "pattern": 0.2,
        "pattern_count": [5, 5],
    }
    spec = {
        "schema_version": 1,
        "name": "tiles",
        "description": "eight tiles",
        "objects": [
            {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.3], "reflectance": 0.4},
            *({"name": f"tile{k}", "position_m": [x, y, 0], **tile} for k, (x, y) in enumerate(places)),
        ],
        "light": {"type": "directional", "direction": [0.3, 0, -1], "illuminance_lux": 2000},
        "camera": {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": 26},
        "motion": [
            {
                "object": f"tile{k}",
                "repeat": True,
                "keyframes": [{"t_us": 0, "rotation_deg": 0}, {"t_us": 400_000, "rotation_deg": 360}],
            }
            for k in range(moving)
        ],
    }
    return Scene(SceneSpec.model_validate(spec))


SCENES = {"star": star, "sweep": sweep, "glass": glass}
QUALITY = {"star": 0.5, "sweep": 0.5, "glass": 2.0}


def window(tick: int) -> tuple[float, float]:
    end = TICK_US * (tick + 1)
    return end - WINDOW_US, end


class Reference:
    """Converged flux of some pixels in some ticks, and the error of anything else against it."""

    def __init__(self, scene: Scene, sensor: hr.Sensor, ticks: list[int]) -> None:
        pixels = sensor.rows * sensor.cols
        self.pixel = np.sort(np.random.default_rng(0).choice(pixels, pixels // 8, replace=False)).astype(np.uint32)
        self.flux: dict[int, np.ndarray] = {}
        self._noise = sensor.evs
        self.variance = 0.0
        for tick in ticks:
            begin, end = (np.full(self.pixel.size, t) for t in window(tick))
            runs = []
            for seed in (1001, 1002):
                tracer = TimedTracer(scene, sensor, seed, used_responses(sensor))
                result = tracer.trace(self.pixel, begin, end, np.full(self.pixel.size, 4096))
                runs.append(0.5 * (result.half_a.astype(np.float64) + result.half_b))
            self.flux[tick] = 0.5 * (runs[0] + runs[1])
            self.variance += np.mean((0.5 * (runs[0] - runs[1]) / self._scale(tick)) ** 2) / len(ticks)

    def _scale(self, tick: int) -> np.ndarray:
        electrons = self.flux[tick] * WINDOW_US * 1e-6
        return self._noise.noise_equivalent_e(electrons, self.pixel) / (WINDOW_US * 1e-6)

    def square_noise(self, one: np.ndarray, other: np.ndarray, tick: int) -> float:
        """Mean variance of pictures of which these are two, in the same units."""
        return float(np.mean(((one - other)[self.pixel] / self._scale(tick)) ** 2)) / 2

    def square_error(self, flux: np.ndarray, tick: int) -> float:
        """Mean squared error of a whole picture in units of the event noise, the reference's own taken off."""
        off = (flux[self.pixel] - self.flux[tick]) / self._scale(tick)
        return max(float(np.mean(off**2)) - self.variance, 1e-12)


def exact_tick(scene: Scene, sensor: hr.Sensor, samples: int, tick: int) -> tuple[np.ndarray, float]:
    """(b): both halves of the picture of one tick, and its time; slices are rendered one by one as a run does it."""
    flux = RenderedFlux(scene, sensor, samples=samples, seed=5)
    pixels = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)

    def picture(number: int) -> np.ndarray:
        begin, end = window(number)
        bounds = np.concatenate([[begin], flux.slice_edges_us(begin, end), [end]])
        total = np.zeros((2, pixels.size))
        for a, b in zip(bounds[:-1], bounds[1:], strict=True):
            total += np.array(flux.mean_flux(pixels, a, b), dtype=np.float64) * (b - a) / (end - begin)
        return total

    picture(tick - 1)  # compiles
    start = time.perf_counter()
    halves = picture(tick)
    return halves, time.perf_counter() - start


def specfilm_tick(scene: Scene, sensor: hr.Sensor, spp: int, tick: int, seed: int = 0) -> tuple[np.ndarray, float]:
    """(a): mi.render at the middle of one tick, in passes of 256 samples where there are more."""
    mi = mitsuba()
    responses = used_responses(sensor)
    built = build(mi, scene.spec, responses)
    view = place_camera(scene.spec, sensor, built.mitsuba_sensor())
    film = {
        "type": "specfilm",
        "width": sensor.cols,
        "height": sensor.rows,
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "channel_000": spectrum_dict(next(iter(view.sensor.responses.values()))),
    }
    passes = max(1, -(-spp // 256))
    scale = scene.spec.mitsuba.radiance_scale if scene.spec.mitsuba else 1.0

    def picture(number: int) -> np.ndarray:
        middle = sum(window(number)) / 2
        built.pose(middle)
        camera = mi.load_dict(perspective_dict(mi, view, camera_at(scene, view, middle), film))
        images = [
            np.array(
                mi.render(
                    built.scene,
                    sensor=camera,
                    integrator=built.integrator,
                    spp=-(-spp // passes),
                    seed=97 * number + k + seed,
                )
            )[:, :, 0]
            for k in range(passes)
        ]
        return (np.mean(images, axis=0) * view.sensor.relative_illumination * scale).ravel()

    picture(tick - 1)
    start = time.perf_counter()
    image = picture(tick)
    return image, time.perf_counter() - start


def activity(scene: Scene, sensor: hr.Sensor, ticks: list[int]) -> float:
    """Share of pixels that change by more than 1 % per tick."""
    tracer = TimedTracer(scene, sensor, 5, used_responses(sensor))
    pixels = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)[::4]
    shares = []
    for tick in ticks:
        flux = []
        for number in (tick, tick + 1):
            begin, end = (np.full(pixels.size, t) for t in window(number))
            result = tracer.trace(pixels, begin, end, np.full(pixels.size, 256))
            flux.append(result.half_a.astype(np.float64) + result.half_b)
        shares.append(np.mean(np.abs(flux[1] - flux[0]) > 0.01 * np.maximum(flux[0], 1e-9)))
    return float(np.mean(shares))


def coherent(scene: Scene, sensor: hr.Sensor, quality: float, ticks: list[int]) -> tuple[dict, float, CoherentFlux]:
    """(c): pictures of some ticks, and seconds per tick of the second chunk."""
    source = CoherentFlux(scene, sensor, quality, seed=5)
    pixels = sensor.layout.evs_pixel.ravel()
    begin, end = np.array([window(tick) for tick in range(2 * CHUNK + 1)]).T
    kept, start = {}, 0.0
    for number, (half_a, half_b) in enumerate(source.flux_of_windows(pixels, begin, end)):
        if number == CHUNK:
            start = time.perf_counter()
        if number in ticks:
            kept[number] = 0.5 * (np.array(half_a, dtype=np.float64) + np.array(half_b))
    return kept, (time.perf_counter() - start) / CHUNK, source


def needed(first: int, square_noise: float, target: float, power: float) -> int:
    """Samples that bring squared noise to a target, from that of `first`; even."""
    return max(2, 2 * round(first * (square_noise / target) ** (1 / power) / 2))


def compare(name: str, wanted: int, quality: float) -> None:
    scene = SCENES[name](SPEEDS[name][wanted])
    sensor = place_camera(scene.spec, hr.load_sensor("reference-mono", SENSOR), None).sensor
    ticks = [CHUNK + 11, CHUNK + 24]
    share = activity(scene, sensor, ticks)
    reference = Reference(scene, sensor, ticks)
    pictures, seconds_c, source = coherent(scene, sensor, quality, ticks)
    target = float(np.mean([reference.square_error(pictures[tick], tick) for tick in ticks]))
    tick = ticks[0]
    halves, _ = exact_tick(scene, sensor, 16, tick)
    # stratified: squared noise was seen to fall by n^-1.2 or faster
    spp_b = needed(16, reference.square_noise(*halves, tick) / 2, target, 1.2)
    halves, seconds_b = exact_tick(scene, sensor, spp_b, tick)
    error_b = reference.square_error(halves.mean(axis=0), tick) ** 0.5
    images = [specfilm_tick(scene, sensor, 64, tick, seed)[0] for seed in (0, 10_000)]
    spp_a = needed(64, reference.square_noise(*images, tick), target, 1.0)
    image, seconds_a = specfilm_tick(scene, sensor, spp_a, tick)
    error_a = reference.square_error(image, tick) ** 0.5
    per_second = 1e6 / TICK_US
    rendered = 1 - source.audit.skipped / (sensor.rows * sensor.cols * 2 * CHUNK)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(
        f"{name:6s} {100 * share:5.1f} %  error {target**0.5:.3f} | "
        f"(a) {seconds_a * per_second:8.0f} s/s {spp_a:5d} spp {error_a:.3f} | "
        f"(b) {seconds_b * per_second:7.0f} s/s {spp_b:4d} spp {error_b:.3f} | "
        f"(c) {seconds_c * per_second:6.0f} s/s | a/c {seconds_a / seconds_c:6.1f}  b/c {seconds_b / seconds_c:5.1f} | "
        f"rendered {100 * rendered:.1f} % audit <= {100 * source.audit.bound:.2f} % | peak {peak_gb:.2f} GB",
        flush=True,
    )


def compare_area(quality: float) -> None:
    """Seconds of (c) for all tiles moving and for half of them."""
    seconds = []
    for moving in (8, 4):
        scene = tiles(moving)
        sensor = place_camera(scene.spec, hr.load_sensor("reference-mono", SENSOR), None).sensor
        share = activity(scene, sensor, [CHUNK + 11, CHUNK + 24])
        _, per_tick, source = coherent(scene, sensor, quality, [])
        seconds.append(per_tick * 1e6 / TICK_US)
        rendered = 1 - source.audit.skipped / (sensor.rows * sensor.cols * 2 * CHUNK)
        print(
            f"{moving} tiles turn: {100 * share:.1f} % change, {seconds[-1]:.0f} s/s, rendered {100 * rendered:.1f} %"
        )
    print(f"half the area takes 1/{seconds[0] / seconds[1]:.2f} of the time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--activities", default="3,10,25,100")
    parser.add_argument("--quality", type=float, help="instead of each scene's own")
    parser.add_argument("--area", action="store_true")
    options = parser.parse_args()
    if options.area:
        compare_area(options.quality or QUALITY["star"])
        return
    for name in options.scenes.split(","):
        for wanted in options.activities.split(","):
            compare(name, int(wanted), options.quality or QUALITY[name])


if __name__ == "__main__":
    main()
