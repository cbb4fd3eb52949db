"""Scenes that the default mode cannot render, because paths between surfaces do not describe them."""

from __future__ import annotations

from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.builder import BuiltScene
from hesim_render.sources.render.scene.mitsuba_version import number_of


class NeedsExactMode(SpecError):
    """The scene needs the exact mode: paths between resting and rigidly moving surfaces do not describe it."""


def require_paths(built: BuiltScene) -> None:
    """Refuse scenes that paths between surfaces do not describe."""
    if built.exact_because is not None:
        raise NeedsExactMode(built.exact_because)
    name = built.integrator.class_name()
    if name == "DirectIntegrator":
        for kind in ("emitter_samples", "bsdf_samples"):
            if number_of(built.integrator, kind) == 0:
                raise NeedsExactMode(f"integrator 'direct': with {kind} 0 it leaves light out")
    elif name != "PathIntegrator":
        raise NeedsExactMode(f"integrator {name!r} follows more than paths between surfaces")
    if built.integrator.hide_emitters:
        raise NeedsExactMode("the integrator hides lights that are seen directly")
