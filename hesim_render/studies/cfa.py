"""The study of filter sets: one row of figures for each combination of a study's file.

Of event pixels there are contrast sensitivity, noise rate, and steps between surfaces.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import NUMPY
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs import formulas
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.study import Equal, NamedLight, StudySpec, SurfacesSpec
from hesim_render.spectral.colorimetry import delta_e_ab, lab
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies.candidate import Seen, seen_by, sensor_candidates
from hesim_render.studies.colour_error import to_srgb
from hesim_render.studies.colour_noise import GREY
from hesim_render.studies.colour_samples import ColourSamples, reflectance_set, reflectances_of
from hesim_render.studies.noise_figures import electrons, exposure_for, light_throughput, noise_figures, white_rate
from hesim_render.studies.table import Cell, Table
from hesim_render.targets.opened_cube import CubeFile

#: Most pictures of demosaiced patterns that a study keeps.
MOST_PICTURES = 48
#: Pairs of surfaces with at most this difference of L*, and at least this one of colour, are isoluminant.
_SAME_LIGHTNESS, _OTHER_COLOUR = 5.0, 20.0


@dataclass(frozen=True, eq=False)
class StudyResult:
    """Results of a study.

    Parameters
    ----------
    table : a row for each combination.
    seen : each candidate under each light, for drawings.
    pictures : captions and pictures of the demosaiced patterns, linear sRGB.
    """

    table: Table
    seen: list[Seen]
    pictures: list[tuple[str, NDArray[np.float32]]]


def run_study(spec: StudySpec, progress: Progress | None = None) -> StudyResult:
    """All figures of a study.

    Parameters
    ----------
    spec : the study.
    progress : called with (done, total, what).

    Returns
    -------
    A row for each combination of sensor, filter set, crosstalk, surfaces, illuminant, illuminance, exposure and kind of
    equality.

    Raises
    ------
    SpecError
        If a file is not valid, or parts of the study do not fit together.
    """
    tried = sensor_candidates(spec)
    total = len(tried) * len(spec.surfaces) * len(spec.illuminants)
    reference = light_throughput(tried[0].sensor)
    rows: list[dict[str, Cell]] = []
    every: list[Seen] = []
    pictures: list[tuple[str, NDArray[np.float32]]] = []
    number = 0
    for item in spec.surfaces:
        # matrices are fitted to the reflectances; of a cube, to the ColorChecker
        named = reflectance_set("colorchecker") if item.reflectances is None else reflectances_of(item)
        chart, cube = list(named.values()), _cube(item, spec)
        for light in spec.illuminants:
            spectrum = light.spectrum.load()
            group = []
            for k, candidate in enumerate(tried):
                if progress is not None:
                    progress(number + k / 2, total, f"{candidate.set_name} on {candidate.sensor_name}")
                group.append(seen_by(spec, candidate, item.label, light.name, spectrum, chart))
            figures = [{}] * len(group) if cube is None else _of_cube(item, cube, group, light)
            for k, (seen, more) in enumerate(zip(group, figures, strict=True)):
                if progress is not None:
                    progress(number + (len(tried) + k) / 2, total, f"{seen.candidate.set_name}: noise and details")
                rows += _rows(spec, seen, spectrum, chart, more, reference, pictures)
            every += group
            number += len(tried)
    return StudyResult(Table(rows), every, pictures)


def _cube(item: SurfacesSpec, spec: StudySpec) -> CubeFile | None:
    """The cube of surfaces, where its colours are wanted."""
    if item.reflectances is not None or "colour" not in spec.figures:
        return None
    from hesim_render.studies.cube_colour import open_surfaces

    return open_surfaces(item)


def _of_cube(item: SurfacesSpec, cube: CubeFile, group: Sequence[Seen], light: NamedLight) -> list[dict[str, Cell]]:
    """Figures of a cube for each candidate."""
    from hesim_render.studies.cube_colour import cube_figures

    matrices = [each.colour.matrix for each in group if each.colour is not None]
    return list(cube_figures(item, cube, [each.candidate.responses for each in group], matrices, light))


def _rows(
    spec: StudySpec, seen: Seen, spectrum: Spectrum, chart: list[Spectrum], more: dict[str, Cell], reference: float,
    pictures: list[tuple[str, NDArray[np.float32]]],
) -> Iterator[dict[str, Cell]]:  # fmt: skip
    candidate = seen.candidate
    for lux in spec.illuminance_lux:
        rate = white_rate(candidate.responses, spectrum, lux)
        event_rate = white_rate(candidate.event_responses, spectrum, lux)
        events: dict[str, Cell] = {}
        if "events" in spec.figures and seen.events is not None:
            events |= tile_event_figures(
                candidate.sensor, candidate.event_filters, event_rate, seen.events.camera, seen.samples
            )
        aps = candidate.sensor.spec.aps
        if aps is None:  # event pixels have no exposure
            combinations: list[tuple[float, Equal]] = [(0.0, "exposure")]
        else:
            combinations = list(product(spec.exposures_us or [aps.exposure_us], spec.equal))
        for nominal_us, equal in combinations:
            row: dict[str, Cell] = {
                "surfaces": seen.surfaces, "illuminant": seen.light_name, "illuminance_lux": lux,
                "sensor": candidate.sensor_name, "filter_set": candidate.set_name,
                "crosstalk": candidate.crosstalk, "equal": equal,
            }  # fmt: skip
            if aps is not None:
                exposure_us = exposure_for(equal, candidate.sensor, nominal_us, rate, reference, spec.white_fill)
                row |= {"nominal_exposure_us": nominal_us, "exposure_us": exposure_us}
            row |= seen.row | more
            if aps is not None and "noise" in spec.figures:
                row |= noise_figures(spec, seen, spectrum, chart, rate, lux, exposure_us)
            if aps is not None and "demosaic" in spec.figures:
                result, picture = _detail(spec, seen, spectrum, rate, lux, exposure_us)
                row |= result
                if len(pictures) < MOST_PICTURES:
                    text = f"{candidate.set_name}, {seen.light_name}, {lux:g} lx, equal {equal}"
                    pictures.append((text, picture))
            yield row | events


def _detail(
    spec: StudySpec, seen: Seen, light: Spectrum, rate: NDArray[np.float64], lux: float, exposure_us: float
) -> tuple[dict[str, Cell], NDArray[np.float32]]:
    """Figures of patterns after demosaicing, and their picture."""
    from hesim_render.studies.demosaic_figures import demosaic_figures

    assert seen.colour is not None
    sensor = seen.candidate.sensor
    every = [sensor.responses[name] for name in sensor.spec.filters]
    return demosaic_figures(
        sensor, light, to_srgb(seen.colour.matrix, seen.samples.white_xyz), electrons(rate, exposure_us),
        electrons(white_rate(every, light, lux), exposure_us), exposure_us, seen.candidate.crosstalk,
        spec.noise.repeats, spec.noise.seed,
    )  # fmt: skip


def tile_event_figures(
    sensor: Sensor,
    filters: list[str],
    white_e_per_s: NDArray[np.float64],
    channels: NDArray[np.float64],
    samples: ColourSamples,
) -> dict[str, float | None]:
    """Figures of the event pixels of a tile.

    Parameters
    ----------
    sensor : with event pixels.
    filters : of the event pixels.
    white_e_per_s : [filter], electrons per second of a pixel on a perfect white.
    channels : [surface, filter], response to each surface over that to white.
    samples : the surfaces' colours.

    Returns
    -------
    ``event_contrast_on``: relative rise of the light on an 18 % grey card at which an event is as likely as not, the
    mean over the event pixels of the tile; ``event_noise_rate_hz``: events of one pixel on that card without any
    change, leak included (None for asynchronous pixels, where no closed form holds); ``event_seen``: probability that
    at least one event pixel of the tile tells when one surface replaces another, the mean over pairs;
    ``event_seen_isoluminant``: the same for pairs that differ in colour (ΔE*ab above 20), but hardly in lightness
    (ΔL* below 5), None if there are no such pairs.
    """  # fmt: skip
    spec, evs = sensor.spec.evs, sensor.evs
    assert spec is not None
    per_window = white_e_per_s * (spec.window_us * S_PER_US)
    tile = sensor.spec.tile_rows
    where = [filters.index(sensor.spec.pixels[tile[i][j]].filter) for i, j in sensor.spec.positions("evs")]
    theta_on, theta_off = spec.contrast_threshold_on, spec.contrast_threshold_off
    spread_on, spread_off = (spec.threshold_mismatch_rel * theta for theta in (theta_on, theta_off))
    contrast, rate, missed = [], [], np.ones((len(channels), len(channels)))
    for position, column in enumerate(where):
        k = evs.table.each(itemgetter(position))
        grey = GREY * per_window[column]
        signal = k.slope * grey
        contrast.append(np.expm1(theta_on) * (1 + k.base / signal) if signal > 0 else np.inf)
        if spec.tick_us is not None:
            _, variance = formulas.log_level(k, np.asarray(grey), spec.shot_law, NUMPY)
            on = formulas.exceedance(theta_on, np.sqrt(2 * variance + spread_on**2))
            off = formulas.exceedance(theta_off, np.sqrt(2 * variance + spread_off**2))
            rate.append(float(on + off) / (spec.tick_us * S_PER_US) + evs.leak_rate_hz)
        level, variance = formulas.log_level(k, channels[:, column] * per_window[column], spec.shot_law, NUMPY)
        change = level[None, :] - level[:, None]
        sigma2 = variance[None, :] + variance[:, None]
        on = formulas.exceedance(theta_on - change, np.sqrt(sigma2 + spread_on**2))
        off = formulas.exceedance(theta_off + change, np.sqrt(sigma2 + spread_off**2))
        missed *= 1 - np.minimum(on + off, 1)
    seen = 1 - missed
    pairs = ~np.eye(len(channels), dtype=bool)
    colours = lab(samples.xyz, samples.white_xyz)
    same = np.abs(colours[:, None, 0] - colours[None, :, 0]) < _SAME_LIGHTNESS
    isoluminant = pairs & same & (delta_e_ab(colours[:, None], colours[None]) > _OTHER_COLOUR)
    return {
        "event_contrast_on": float(np.mean(contrast)),
        "event_noise_rate_hz": float(np.mean(rate)) if rate else None,
        "event_seen": float(seen[pairs].mean()) if pairs.any() else None,
        "event_seen_isoluminant": float(seen[isoluminant].mean()) if isoluminant.any() else None,
    }
