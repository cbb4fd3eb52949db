"""Seconds per simulated second of a moving scene, three ways, and what the default mode is worth against a reference.

    python benchmarks/change_driven.py [--scenes star,sweep,glass] [--activities 3,10,25,100] [--quality Q]
                                       [--ticks 32] [--pixels 200] [--size 346x260] [--no-timing]
    python benchmarks/change_driven.py --area

(a) `mi.render` with `specfilm`, once per tick; (b) the exact mode; (c) the default mode, change-driven. 346×260 pixels,
800 Hz.

(c) is judged in random pixels, each in a tick of its own, drawn from all ticks, the first ones too: half of the pairs
evenly, half of those pixels that change. The truth is `WindowReference`: Mitsuba's cameras and films, averaged over
instants; its error is asked to be a fifth of the wish, and printed. Errors are in units of each pixel's own event
noise: rms, median, 95 % and 99 % quantiles of the true ones beside those that the run states for the same pairs. Events
are those of some changing pixels in all ticks. A missed event is one of the reference that exceeds its threshold by
more than three stated standard errors and that no event of the run in the tick before, that tick or the tick after is
like.

(a) and (b) get as many samples as bring their noise to the true rms of (c) over all pixels, and one tick of each is
timed at that number. Nothing moves within a picture of (a), nor do objects within a slice of (b), which is not held
against them. Activity is the share of pixels whose flux changes by more than 1 % from one tick to the next, at 256 rays
with the same random numbers.

With `--area`: what (c) takes for eight chequered tiles that turn, and for the same eight of which four rest.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

import hesim_render as hr
from hesim_render.mosaic.schedule import tick_blocks
from hesim_render.sources.render.audit.compare import compare_ticks
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.exact import RenderedFlux, used_responses
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, spectrum_dict
from hesim_render.sources.scene import Scene
from hesim_render.specs.scene import SceneSpec

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from mitsuba_reference import WindowReference
from mitsuba_specfilm import camera_at, perspective_dict

TICK_US, WINDOW_US = 1250.0, 1000.0
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


def event_noise(sensor: hr.Sensor, flux: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """One standard deviation of the noise of event pixels, e⁻/s."""
    seconds = WINDOW_US * 1e-6
    position = np.zeros(np.shape(pixel), np.int64)
    return sensor.evs.noise_equivalent_e(flux * seconds, position) / seconds


class Run:
    """(c): all event pixels in all ticks, and how long it took."""

    def __init__(self, scene: Scene, sensor: hr.Sensor, quality: float, ticks: int) -> None:
        self.source = ChangeDrivenFlux(scene, sensor, quality, seed=5)
        spec = self.source.sensor.spec.evs
        blocks = list(tick_blocks(spec, 0.0, ticks * TICK_US))
        self.windows = np.concatenate([np.stack([b.begin_us[b.wanted], b.end_us[b.wanted]], 1) for b in blocks])
        flux, error, start = [], [], time.perf_counter()
        for sample in self.source.flux_of_blocks(sensor.layout.evs_pixel.ravel(), blocks):
            flux.append(0.5 * (np.array(sample.half_a, np.float64) + np.array(sample.half_b)))
            error.append(np.array(sample.error, np.float64))
        self.seconds_per_tick = (time.perf_counter() - start) / len(flux)
        self.flux, self.error = np.array(flux), np.array(error)
        counts = self.source.counts
        self.rendered = counts.pairs / max(1, counts.values)


def quantiles(values: np.ndarray) -> str:
    size = np.abs(values)
    parts = np.quantile(size, [0.5, 0.95, 0.99])
    return f"rms {np.sqrt(np.mean(size**2)):.3f} median {parts[0]:.3f} p95 {parts[1]:.3f} p99 {parts[2]:.3f}"


def judge(run: Run, scene: Scene, sensor: hr.Sensor, quality: float, pixels: int) -> float:
    """Print true and stated errors of random pairs, and events missed and too many; the true rms."""
    rng = np.random.default_rng(3)
    reference, every = WindowReference(scene, sensor), sensor.layout.evs_pixel.ravel()
    unit = event_noise(reference.sensor, run.flux, every)
    busy = np.flatnonzero(np.ptp(run.flux, axis=0) > quality * unit.mean(axis=0))
    place = rng.integers(0, every.size, pixels)
    if busy.size:
        place[pixels // 2 :] = rng.choice(busy, pixels - pixels // 2)
    tick = rng.integers(0, len(run.windows), pixels)
    deviation, stated, own = np.zeros(pixels), run.error[tick, place] / unit[tick, place], np.zeros(pixels)
    for number in np.unique(tick):
        these = np.flatnonzero(tick == number)
        wanted = 0.2 * quality * unit[number, place[these]]
        found = reference.flux(run.windows[number], every[place[these]], wanted, seed=1)
        deviation[these] = (run.flux[number, place[these]] - found.flux[0]) / unit[number, place[these]]
        own[these] = found.stderr[0] / unit[number, place[these]]
    evenly, changing = slice(0, pixels // 2), slice(pixels // 2, None)
    print(f"   true error, all pixels:      {quantiles(deviation[evenly])}")
    print(f"   stated,     all pixels:      {quantiles(stated[evenly])}")
    print(f"   true error, changing pixels: {quantiles(deviation[changing])}")
    print(f"   stated,     changing pixels: {quantiles(stated[changing])}")
    off = np.mean(np.abs(deviation) > 3 * quality)
    print(f"   of the reference: {quantiles(own)}; off by more than {3 * quality:g}: {100 * off:.2f} %", flush=True)
    print_events(run, reference, rng.choice(busy, min(busy.size, max(4, pixels // 20)), replace=False), unit, quality)
    return float(np.sqrt(np.mean(deviation[evenly] ** 2)))


def print_events(run: Run, reference: WindowReference, place: np.ndarray, unit: np.ndarray, quality: float) -> None:
    """Events of some pixels in all ticks, noise-free."""
    if place.size == 0:
        print("   nothing changes: no events")
        return
    noise, layout = reference.sensor.evs, reference.sensor.layout
    found = reference.flux(run.windows, layout.evs_pixel.ravel()[place], 0.2 * quality * unit[:, place], seed=2)
    own, error = run.flux[:, place], run.error[:, place]
    level, truth, above = (noise.log_signal(f, place) for f in (own, found.flux, own + error))
    maps = noise.threshold_on_map, noise.threshold_off_map
    thresholds = tuple(np.broadcast_to(m, layout.evs_shape).ravel()[place].astype(np.float64) for m in maps)
    counted = compare_ticks(level, truth, above - level, thresholds, np.ones(len(own), np.bool_))
    true, total = counted.true.sum(), counted.in_run.sum()
    print(
        f"   events of {place.size} pixels: {true:.0f} true, {total:.0f} found, {counted.missed.sum():.0f} missed, "
        f"{counted.extra.sum():.0f} extra, {counted.flips.sum():.0f} within three stated errors of a threshold",
        flush=True,
    )


def square_noise(one: np.ndarray, other: np.ndarray, sensor: hr.Sensor) -> float:
    """Mean variance of pictures of which these are two, over the square of the noise."""
    unit = event_noise(sensor, 0.5 * (one + other), np.arange(one.size))
    return float(np.mean(((one - other) / unit) ** 2)) / 2


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
    source = RenderedFlux(scene, sensor, samples=256, seed=5)
    pixels = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)[::8]
    shares = []
    for tick in ticks:
        flux = []
        for number in (tick, tick + 1):
            middle = sum(window(number)) / 2
            halves = source.mean_flux(pixels, middle, middle)
            flux.append(sum(np.array(half, np.float64) for half in halves))
        shares.append(np.mean(np.abs(flux[1] - flux[0]) > 0.01 * np.maximum(flux[0], 1e-9)))
    return float(np.mean(shares))


def needed(first: int, square_noise: float, target: float, power: float) -> int:
    """Samples that bring squared noise to a target, from that of `first`; even."""
    return max(2, 2 * round(first * (square_noise / target) ** (1 / power) / 2))


def compare(name: str, wanted: int, quality: float, options: argparse.Namespace) -> None:
    scene = SCENES[name](SPEEDS[name][wanted])
    cols, rows = options.size
    given = hr.load_sensor("reference-mono", {**SENSOR, "geometry.cols": cols, "geometry.rows": rows})
    sensor = place_camera(scene.spec, given, None).sensor
    share = activity(scene, sensor, [11, options.ticks - 2])
    print(f"{name}, {100 * share:.1f} % of the pixels change from tick to tick, quality {quality:g}", flush=True)
    Run(scene, sensor, quality, options.ticks)  # kernels are compiled
    run = Run(scene, sensor, quality, options.ticks)
    target = judge(run, scene, sensor, quality, options.pixels)
    per_second, peak_gb = 1e6 / TICK_US, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(f"   (c) {run.seconds_per_tick * per_second:.0f} s/s, {100 * run.rendered:.1f} % of the pairs rendered, "
          f"{run.source.rays_traced / 1e6:.1f} M rays, peak {peak_gb:.2f} GB", flush=True)  # fmt: skip
    if options.no_timing:
        return
    tick = options.ticks // 2
    halves, _ = exact_tick(scene, sensor, 16, tick)
    # stratified: squared noise was seen to fall by n^-1.2 or faster
    spp_b = needed(16, square_noise(*halves, sensor) / 2, target**2, 1.2)
    _, seconds_b = exact_tick(scene, sensor, spp_b, tick)
    images = [specfilm_tick(scene, sensor, 64, tick, seed)[0] for seed in (0, 10_000)]
    spp_a = needed(64, square_noise(*images, sensor), target**2, 1.0)
    _, seconds_a = specfilm_tick(scene, sensor, spp_a, tick)
    print(
        f"   at the same rms: (a) {seconds_a * per_second:.0f} s/s with {spp_a} spp, "
        f"(b) {seconds_b * per_second:.0f} s/s with {spp_b} spp; "
        f"a/c {seconds_a / run.seconds_per_tick:.1f}  b/c {seconds_b / run.seconds_per_tick:.1f}",
        flush=True,
    )


def compare_area(quality: float, options: argparse.Namespace) -> None:
    """Seconds of (c) for all tiles moving and for half of them."""
    seconds = []
    for moving in (8, 4):
        scene = tiles(moving)
        sensor = place_camera(scene.spec, hr.load_sensor("reference-mono", SENSOR), None).sensor
        Run(scene, sensor, quality, options.ticks)
        run = Run(scene, sensor, quality, options.ticks)
        seconds.append(run.seconds_per_tick * 1e6 / TICK_US)
        print(
            f"{moving} tiles turn: {seconds[-1]:.0f} s/s, {100 * run.rendered:.1f} % of the pairs rendered", flush=True
        )
    print(f"half the area takes 1/{seconds[0] / seconds[1]:.2f} of the time")


def _size(text: str) -> tuple[int, int]:
    cols, rows = text.split("x")
    return int(cols), int(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--activities", default="3,10,25,100")
    parser.add_argument("--quality", type=float, help="instead of each scene's own")
    parser.add_argument(
        "--ticks", type=int, default=32, help="of a run; two blocks of 16 or more for a time without compiling"
    )
    parser.add_argument("--pixels", type=int, default=200, help="pairs that are judged")
    parser.add_argument("--size", type=_size, default=(346, 260), help="of the sensor")
    parser.add_argument("--no-timing", action="store_true", help="leave (a) and (b) out")
    parser.add_argument("--area", action="store_true")
    options = parser.parse_args()
    if options.area:
        compare_area(options.quality or QUALITY["star"], options)
        return
    for name in options.scenes.split(","):
        for wanted in options.activities.split(","):
            compare(name, int(wanted), options.quality or QUALITY[name], options)


if __name__ == "__main__":
    main()
