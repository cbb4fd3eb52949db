"""The renderer that a run asks for, or that its scene needs."""

from itertools import count

import numpy as np

from hesim_render.core.workers import Workers
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.change_driven.flux import QUALITY, ChangeDrivenFlux
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.renderer import SceneRenderer, flickering
from hesim_render.sources.render.scene.builder import NeedsExactMode
from hesim_render.sources.scene import Scene

#: Default rays per pixel in the exact mode. A static scene is rendered once for the whole run,
#: a moving one once per slice.
STATIC_SAMPLES = 64
MOVING_SAMPLES = 16


def scene_renderer(
    scene: Scene,
    sensor: Sensor,
    seed: int,
    quality: float | None = None,
    samples: int | None = None,
    exact: bool = False,
    workers: Workers | None = None,
) -> SceneRenderer:
    """The renderer of a scene: change-driven, unless the exact mode is asked for or the scene needs it.

    Parameters
    ----------
    scene : with lights in absolute units (`in_absolute_light`).
    sensor, seed, quality, samples, exact : as for `simulate`.
    workers : processes that render in the default mode, from `part_worker.start`; None renders in this one.

    Raises
    ------
    NeedsExactMode
        If a quality is asked for, and the scene can only be rendered in the exact mode.
    """
    window_us = sensor.spec.evs.window_us if sensor.spec.evs is not None else 1.0
    because: str | None = None
    if not exact and samples is None:
        # workers know the parts of the light by their numbers
        wanted, parts = QUALITY if quality is None else quality, count()
        try:
            return flickering(
                scene,
                lambda part, light: ChangeDrivenFlux(
                    part, sensor, wanted, seed=seed, light=light, workers=workers, part=next(parts)
                ),
                window_us,
            )
        except NeedsExactMode as error:
            if quality is not None:
                text = f"{error}; such a scene needs the exact mode: give a number of rays (--samples) in place of"
                raise NeedsExactMode(f"{text} a quality") from None
            because = str(error)
    rays = samples if samples is not None else MOVING_SAMPLES if scene.spec.moves else STATIC_SAMPLES
    return flickering(
        scene, lambda part, _: RenderedFlux(part, sensor, samples=rays, seed=seed, because=because), window_us
    )


def camera_used(view: View) -> dict[str, object]:
    """Pose at rest and field of view of the camera in use, as plain values, whether scene or sensor set them."""
    left, right, top, bottom = view.region_mm
    ends = (view.direction(x, (top + bottom) / 2) for x in (left, right))
    across = np.diff([np.arctan(x / -z) for x, _, z in ends])[0]
    pose = view.camera_to_world
    return {
        "origin_m": pose[:3, 3].tolist(),
        "forward": (-pose[:3, 2]).tolist(),
        "up": pose[:3, 1].tolist(),
        "horizontal_fov_deg": float(np.degrees(across)),
        "near_m": float(view.near_m),
    }
