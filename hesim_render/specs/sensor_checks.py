"""Consistency checks of a sensor file: tile, pixels, roles, filters and their wavelengths."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.specs.event_pixels import EvsSpec
from hesim_render.spectral.spectrum import RENDERABLE_NM, Spectrum, constant, coverage

if TYPE_CHECKING:
    from hesim_render.specs.sensor import SensorSpec

#: Largest part of a response outside the wavelengths that can be rendered.
_LOST = 1e-3


def sensor_problems(spec: "SensorSpec") -> Iterator[str]:
    """All inconsistencies; each begins with its dotted key."""
    result = list(_tile(spec))
    if not result:  # otherwise the roles are not known
        result += _roles(spec)
    result += _filters(spec)
    if result:  # a missing section is reported once, not again for each reference to it
        yield from result
        return
    for group in ("sources", "assumptions"):
        for key in getattr(spec, group):
            if not _has_key(spec, key):
                yield f"{group}.{key}: there is no such key in this file"


def _tile(spec: "SensorSpec") -> Iterator[str]:
    rows = spec.tile_rows
    drawn = dict.fromkeys("".join(rows))
    for letter in drawn:
        if letter not in spec.pixels:
            yield f"tile: the letter {letter!r} is not defined under 'pixels'"
    for letter, pixel in spec.pixels.items():
        if len(letter) != 1:
            yield f"pixels: {letter!r} must be a single letter"
        if pixel.filter not in spec.filters:
            known = ", ".join(spec.filters)
            yield (
                f"pixels.{letter}.filter: no filter {pixel.filter!r}; defined are {known}"
                f"{did_you_mean(pixel.filter, spec.filters)}"
            )
    if spec.geometry.rows % len(rows) or spec.geometry.cols % len(rows[0]):
        yield (
            f"geometry: {spec.geometry.rows}×{spec.geometry.cols} pixels are not a whole number of "
            f"{len(rows)}×{len(rows[0])} tiles"
        )


def _roles(spec: "SensorSpec") -> Iterator[str]:
    aps, evs = spec.positions("aps"), spec.positions("evs")
    for role, positions, section in (("aps", aps, spec.aps), ("evs", evs, spec.evs)):
        if bool(positions) != (section is not None):
            must = "be given" if positions else "be absent"
            yield f"the tile has {len(positions)} {role} positions, so '{role}' must {must}"
    if spec.aps is not None and spec.aps.beta is not None:
        shape = [[len(cell) for cell in row] for row in spec.aps.beta]
        if shape != [[6] * len(spec.tile_rows[0])] * len(spec.tile_rows):
            yield "aps.beta: expected 6 coefficients for every position of the tile"
    if spec.evs is None:
        return
    if spec.evs_grid is None:
        yield "evs_grid is required where the tile has event pixels"
    elif spec.evs_grid.rows_per_tile * spec.evs_grid.cols_per_tile != len(evs):
        grid = f"{spec.evs_grid.rows_per_tile}×{spec.evs_grid.cols_per_tile}"
        yield f"evs_grid: {grid} does not hold the tile's {len(evs)} event pixels"
    if not isinstance(spec.evs, EvsSpec):
        return  # the rest follows from a data sheet
    if len(spec.evs.coefficients) not in (1, len(evs)):
        yield f"evs.coefficients: expected 1 entry or {len(evs)}, one per event position"
    reference = spec.evs.signal_reference.filter
    if reference != "own" and reference not in spec.filters:
        yield f"evs.signal_reference.filter: no filter {reference!r}{did_you_mean(reference, spec.filters)}"


def _filters(spec: "SensorSpec") -> Iterator[str]:
    said: set[str] = set()
    quantum_efficiency = spec.quantum_efficiency.load()
    if quantum_efficiency.values.min() < 0 or quantum_efficiency.values.max() > 1:
        yield "quantum_efficiency must lie in [0, 1] electrons per photon"
        return
    transmittance = spec.lens.transmittance.load().values
    if transmittance.min() < 0 or transmittance.max() > 1.0 + 1e-9:
        yield "lens.transmittance must lie in [0, 1]"
        return
    for name, filter_ in spec.filters.items():
        values = filter_.load().values
        if values.min() < 0 or values.max() > 1.0 + 1e-9:
            yield f"filters.{name}: transmittance must lie in [0, 1]"
            continue
        try:
            response = spec.filter_response(name)
        except SpecError as error:
            if str(error) not in said:  # the same error of all filters is reported once
                yield f"filters.{name}: with quantum efficiency and lens, {error}"
            said.add(str(error))
            continue
        if response.values.max() <= 0:
            yield f"filters.{name}: filter, quantum efficiency and lens share no wavelength"
        else:
            yield from _outside(name, response)


def unused(spec: "SensorSpec") -> Iterator[tuple[str, str]]:
    """Letters that are not in the tile and filters without a pixel: their keys, and how to correct the file."""
    drawn = set("".join(spec.tile_rows))
    for letter in spec.pixels:
        if letter not in drawn:
            yield f"pixels.{letter}", "no pixel of the tile has this letter; draw it there, or remove it here"
    used = {pixel.filter for letter, pixel in spec.pixels.items() if letter in drawn}
    if spec.evs is not None:
        used.add(spec.evs.signal_reference.filter)
    for name in spec.filters:
        if name not in used:
            yield f"filters.{name}", "no pixel has this filter; give it to one under 'pixels', or remove it here"


def _outside(name: str, response: Spectrum) -> Iterator[str]:
    """The problem that too much of a response lies outside the wavelengths that can be rendered, with the side."""
    (low, high), (first, last) = RENDERABLE_NM, response.support_nm
    if coverage(constant(1.0, low, high), response) >= 1 - _LOST:
        return
    below = 1 - coverage(constant(1.0, low, max(last, high)), response)
    above = 1 - coverage(constant(1.0, min(first, low), high), response)
    # both sides together exceed `_LOST`
    cuts = [cut for cut, share in (("an ultraviolet", below), ("an infrared", above)) if share > _LOST / 2]
    yield (
        f"filters.{name}: more than {_LOST:.1%} of the response lies outside {low:g}-{high:g} nm, which cannot be "
        f"rendered; add {' and '.join(cuts)} cut"
    )


def _has_key(spec: BaseModel, dotted: str) -> bool:
    node: Any = spec
    for key in dotted.split("."):
        if isinstance(node, BaseModel):
            node = getattr(node, key) if key in type(node).model_fields else None
        elif isinstance(node, dict):
            node = node.get(key)
        else:
            node = None
        if node is None:
            return False
    return True
