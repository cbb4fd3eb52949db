"""A sensor with another filter set: tile, filters and roles are exchanged, pixels, lens and noise stay."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.filter_set import FilterSetSpec, PaletteSpec
from hesim_render.specs.sensor import Role, SensorSpec
from hesim_render.spectral.spectrum import Spectrum, summed


def with_filter_set(sensor: Sensor, filters: FilterSetSpec, palette: PaletteSpec) -> Sensor:
    """The whole sensor with the tile and the filters of a set.

    Rows and columns are rounded down to whole tiles. A measured noise polynomial or event coefficients of single
    positions belong to the old tile, and are refused.

    Parameters
    ----------
    sensor : supplies geometry, lens and noise models.
    filters : the set.
    palette : spectra of its filters, and perhaps another quantum efficiency.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.studies import with_filter_set
    >>> from hesim_render.specs.filter_set import read_filter_set, read_palette
    >>> sensor = with_filter_set(hr.load_sensor("reference-bayer"), read_filter_set("ryyb"), read_palette("dyes"))
    >>> sensor.name, sorted(sensor.responses)
    ('reference-bayer with ryyb', ['blue', 'red', 'yellow'])

    Returns
    -------
    The sensor, with its own lens and all rows and columns read out.

    Raises
    ------
    SpecError
        If set and sensor do not fit: a filter that the palette lacks, event pixels on a sensor without events, noise of
        single tile positions.
    """
    spec = sensor.spec
    what = f"filter set {filters.name!r} on sensor {spec.name!r}"
    roles = {role for pixel in filters.pixels.values() for role in pixel.roles}
    if "aps" in roles and spec.aps is None:
        raise SpecError(f"{what}: the set has frame pixels, and the sensor has no 'aps' section")
    if "evs" in roles and spec.evs is None:
        raise SpecError(f"{what}: the set has event pixels, and the sensor has no 'evs' section")
    if spec.noise is not None or (spec.aps is not None and spec.aps.beta is not None):
        raise SpecError(f"{what}: the sensor's noise was measured for the positions of its own tile")
    if "evs" in roles and spec.evs is not None and len(spec.evs.coefficients) > 1:
        raise SpecError(f"{what}: the sensor's event coefficients are those of the positions of its own tile")
    try:
        spectra = filters.spectra(palette)
    except ValueError as error:
        raise SpecError(f"{what}: {error}") from None
    tile = filters.tile.split("\n")
    geometry = spec.geometry
    data = spec.model_dump(exclude={"sources", "assumptions", "noise"})
    data |= {
        "name": f"{spec.name} with {filters.name}",
        "description": filters.description,
        "tile": filters.tile,
        "pixels": {letter: pixel.model_dump() for letter, pixel in filters.pixels.items()},
        "filters": {name: each.model_dump() for name, each in spectra.items()},
        "evs_grid": None if filters.evs_grid is None else filters.evs_grid.model_dump(),
        "geometry": geometry.model_copy(
            update={
                "rows": geometry.rows // len(tile) * len(tile),
                "cols": geometry.cols // len(tile[0]) * len(tile[0]),
            }
        ).model_dump(),
    }
    if palette.quantum_efficiency is not None:
        data["quantum_efficiency"] = palette.quantum_efficiency.model_dump()
    if "aps" not in roles:
        data["aps"] = None
    if "evs" not in roles:
        data |= {"evs": None, "evs_grid": None}
    elif data["evs"]["signal_reference"]["filter"] not in data["filters"]:
        data["evs"]["signal_reference"]["filter"] = "own"
    try:
        return Sensor.from_spec(SensorSpec.model_validate(data), sensor.file)
    except ValueError as error:
        text = str(error.errors()[0]["msg"]) if hasattr(error, "errors") else str(error)
        raise SpecError(f"{what}: {text.removeprefix('Value error, ').splitlines()[0]}") from None


def filters_of(sensor: Sensor, role: Role) -> list[str]:
    """Filters of the pixels of a role, in the order of the sensor file."""
    spec = sensor.spec
    used = {spec.pixels[spec.tile_rows[i][j]].filter for i, j in spec.positions(role)}
    return [name for name in spec.filters if name in used]


def mixing(sensor: Sensor, filters: Sequence[str], role: Role, crosstalk: float) -> NDArray[np.float64]:
    """Share of each filter of the sensor in the electrons of the pixels behind some filters, in an even light.

    With crosstalk c a pixel keeps 1 − c of its own electrons and gets c/4 from each of its four neighbours. Shares are
    averaged over the positions of the tile that have the filter and the role: [filter, filter of the sensor].

    Parameters
    ----------
    sensor : supplies the tile.
    filters : of the pixels.
    role : of the pixels.
    crosstalk : c.
    """
    spec = sensor.spec
    index = {name: k for k, name in enumerate(spec.filters)}
    tile = np.array([[index[spec.pixels[letter].filter] for letter in row] for row in spec.tile_rows])
    own = np.eye(len(index))[tile]
    around = sum(np.roll(own, shift, axis) for shift in (1, -1) for axis in (0, 1))
    mixed = (1 - crosstalk) * own + crosstalk / 4 * around
    positions = spec.positions(role)
    return np.array(
        [np.mean([mixed[i, j] for i, j in positions if tile[i, j] == index[name]], axis=0) for name in filters]
    )


def effective_responses(sensor: Sensor, filters: Sequence[str], role: Role, crosstalk: float) -> list[Spectrum]:
    """Response of the pixels behind each filter in an even light, with the light that crosstalk brings.

    Parameters
    ----------
    sensor, filters, role, crosstalk : as for `mixing`.

    Returns
    -------
    e⁻/s per W m⁻² sr⁻¹ nm⁻¹, one for each filter.
    """
    if crosstalk == 0:
        return [sensor.responses[name] for name in filters]
    result = []
    for shares in mixing(sensor, filters, role, crosstalk):
        parts = [
            sensor.responses[name].scaled(float(share))
            for name, share in zip(sensor.spec.filters, shares, strict=True)
            if share > 0
        ]
        result.append(summed(*parts))
    return result
