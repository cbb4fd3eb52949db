"""Split a scene by the waveforms of its lights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hesim_render.sources.scene import Scene
from hesim_render.specs.light import WaveformSpec
from hesim_render.specs.target import lamps_of
from hesim_render.spectral.waveform import Waveform


def light_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    """The scene once per different waveform, lit only by the lights with that waveform; lights without one come first.

    A scene without flicker is one part, the scene itself. A level of a Mitsuba scene holds for all of its light
    together, so it must already be converted to a factor (`in_absolute_light`).
    """
    own = scene.spec.mitsuba
    if own is not None:
        assert not own.has_level
        return _mitsuba_parts(scene)
    shining: list[Any] = [*scene.spec.lights, *scene.spec.lamps]
    flickering = [_flicker(light.waveform) for light in shining]
    if not any(flickering):
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different(flickering):
        lit = [
            light.model_copy(update={"waveform": None}) if has == kind else light.unlit()
            for light, has in zip(shining, flickering, strict=True)
        ]
        if any(light.is_lit for light in lit):
            parts.append((kind.load() if kind else None, _with_lights(scene, lit)))
    return parts or [(None, scene)]


def _flicker(spec: WaveformSpec | None) -> WaveformSpec | None:
    """A waveform that changes, or None."""
    return None if spec is None or spec.load().is_constant else spec


def _different(kinds: Sequence[WaveformSpec | None]) -> list[WaveformSpec | None]:
    """Each waveform once, None first."""
    result: list[WaveformSpec | None] = [None] if None in kinds else []
    for kind in kinds:
        if kind not in result:
            result.append(kind)
    return result


def _with_lights(scene: Scene, lit: Sequence[Any]) -> Scene:
    """The scene with other lights: its own, then the target if that shines, then its objects that shine."""
    left = iter(lit)
    update: dict[str, Any] = {"light": tuple(next(left) for _ in scene.spec.lights)}
    if lamps_of(scene.spec.target) is not None:
        update["target"] = next(left)
    update["objects"] = [
        item if item.emission is None else item.model_copy(update={"emission": next(left)})
        for item in scene.spec.objects
    ]
    return Scene(scene.spec.model_copy(update=update))


def _mitsuba_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    own = scene.spec.mitsuba
    assert own is not None
    named = {name: spec for name, spec in own.waveforms.items() if _flicker(spec) is not None}
    if not named:
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different([None, *named.values()]):
        lights = (
            {"unlit": (*own.unlit, *named)}
            if kind is None
            else {"lit": tuple(name for name, spec in named.items() if spec == kind and own.may_shine(name))}
        )
        part = own.model_copy(update={"waveforms": {}, **lights})
        parts.append((kind.load() if kind else None, Scene(scene.spec.model_copy(update={"mitsuba": part}))))
    return parts
