"""A sensor ready to use: its specification, read-out region, lens and both noise models."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.calibration.measured import MeasuredMaps
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.html import table
from hesim_render.core.plain import PlainState
from hesim_render.core.yaml_file import read_yaml
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.measured import measured_part, require_region
from hesim_render.sensor import lens as optics
from hesim_render.sensor.lens import Lens
from hesim_render.sensor.reading import read_sensor_file
from hesim_render.specs.files import locate
from hesim_render.specs.lens import LensSpec
from hesim_render.specs.problems import line_of
from hesim_render.specs.sensor import SensorSpec
from hesim_render.spectral.spectrum import Spectrum, constant, integrate_product


@dataclass(frozen=True, repr=False)
class Sensor(PlainState):
    """One sensor file over one read-out region.

    A sensor holds everything that its file and the maps of a calibration say. A pickle or a copy of it needs none of
    these files.

    Parameters
    ----------
    layout : region, tile and event grid; `layout.spec` is the content of the sensor file.
    lens : the lens in use (a scene may replace f-number, focal length and focus).
    file : name or path that the sensor was loaded from, for error messages; empty where there is none.

    Examples
    --------
    A crop sees what those pixels of the full sensor see. The noise formulas are attributes:

    >>> import hesim_render as hr
    >>> sensor = hr.load_sensor("reference-mono").crop(64, 48)
    >>> sensor
    <Sensor 'reference-mono': 64x48+480+488 of 1024x1024 px; events on 64x48 px; f/4, 16 mm>
    >>> gain, read = sensor.spec.aps.system_gain_dn_per_e, sensor.spec.aps.read_noise_e
    >>> dark_e = sensor.spec.aps.dark_current_now_e_per_s * 0.01
    >>> round(float(sensor.aps.variance_dn2(1000.0, exposure_us=10_000)) / (gain**2 * (1000 + read**2 + dark_e)), 9)
    1.0
    """

    layout: Layout
    lens: Lens
    file: str = field(default="", compare=False)

    @classmethod
    def from_spec(cls, spec: SensorSpec, file: str = "", maps: MeasuredMaps | None = None) -> "Sensor":
        """The whole sensor that a specification describes, with its own lens.

        Parameters
        ----------
        spec : validated content of a sensor file.
        file : name or path of that file, for error messages.
        maps : of the calibration that it names.

        Returns
        -------
        The sensor, with all rows and columns read out.
        """
        return cls(Layout.full(spec, maps), Lens.of(spec), file)

    def __repr__(self) -> str:
        layout, geometry, lens = self.layout, self.spec.geometry, self.lens
        parts = [f"{layout.cols}x{layout.rows}+{layout.col0}+{layout.row0} of {geometry.cols}x{geometry.rows} px"]
        if self.spec.evs is not None:
            parts.append(f"events on {layout.evs_shape[1]}x{layout.evs_shape[0]} px")
        if self.spec.aps is None:
            parts.append("no frames")
        parts.append(f"f/{lens.f_number:g}, {lens.focal_length_mm:g} mm")
        return f"<Sensor {self.name!r}: {'; '.join(parts)}>"

    def _repr_html_(self) -> str:
        rows = [("sensor", self.name), ("description", self.spec.description), ("read out", repr(self)[1:-1])]
        return table(("", ""), rows)

    @property
    def spec(self) -> SensorSpec:
        """Validated content of the sensor file."""
        return self.layout.spec

    @property
    def name(self) -> str:
        """Name of the sensor, from its file."""
        return self.spec.name

    @property
    def rows(self) -> int:
        """Rows of the read-out region, px."""
        return self.layout.rows

    @property
    def cols(self) -> int:
        """Columns of the read-out region, px."""
        return self.layout.cols

    def crop(self, width_px: int, height_px: int, x: int | None = None, y: int | None = None) -> "Sensor":
        """The same sensor with a smaller read-out region (width first, as in 512x384).

        The region always starts at a whole tile. Device maps and random numbers belong to the full sensor's pixels,
        so a crop gives the values that the full sensor gives there.

        Parameters
        ----------
        width_px, height_px : size of the region, px; whole tiles.
        x, y : its first column and row inside the current region, px; default: the region is centred.

        Returns
        -------
        The cropped sensor.

        Raises
        ------
        RangeError
            If the region does not fit or is not made of whole tiles.
        """
        return replace(self, layout=self.layout.crop(width_px, height_px, x, y))

    def with_lens(self, **changes: float | None) -> "Sensor":
        """The same sensor with another lens.

        Parameters
        ----------
        changes : `f_number`, `focal_length_mm` or `focus_distance_m`, see `Lens.of`.

        Returns
        -------
        The sensor with the new lens.
        """
        return replace(self, lens=Lens.of(self.spec, **changes, off=self.lens.off))

    def without(self, terms: Iterable[str]) -> "Sensor":
        """The same sensor with effects of its lens switched off.

        Parameters
        ----------
        terms : such as ``lens.distortion`` (`LENS_TERMS`).

        Returns
        -------
        The sensor; this one if nothing is listed.
        """
        off = frozenset(term.removeprefix("lens.") for term in terms)
        return replace(self, lens=replace(self.lens, off=self.lens.off | off)) if off else self

    @property
    def calibrated_part(self) -> "Sensor":
        """The sensor over the region that its calibration has measured; itself where there is no calibration."""
        return replace(self, layout=measured_part(self.layout))

    @property
    def optics(self) -> LensSpec:
        """The lens of the sensor file, without the effects that are switched off."""
        return self.spec.lens.without(self.lens.off)

    def lens_error(self, message: str, key: str) -> SpecError:
        """An error about a key of the lens, with the file, and the line where the file has the key.

        Parameters
        ----------
        message : what is wrong.
        key : dotted key in the sensor file.

        Returns
        -------
        The error, to be raised.
        """
        if not self.file:
            return SpecError(message, key=key)
        try:
            file = locate(self.file, "sensors")
            return SpecError(message, file=file, line=line_of(read_yaml(file), key.split(".")), key=key)
        except SpecError:
            return SpecError(message, file=self.file, key=key)

    @cached_property
    def responses(self) -> dict[str, Spectrum]:
        """P_c·C_f of Eq. 1 for each filter, on the optical axis: e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹."""
        return {name: optics.response(self.spec, name, self.lens) for name in self.spec.filters}

    def spectral_response(self, wavelength_nm: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """P_c(λ)·C_f(λ) of Eq. 1 for each filter.

        P_c(λ)·C_f(λ) = A_pix·FF·G·τ·C_f·η·λ/(hc) on the optical axis, with G = π/(1 + 4N²(1 + |m|)²).

        Parameters
        ----------
        wavelength_nm : wavelengths, any shape, nm.

        Returns
        -------
        {filter: array like wavelength_nm}, in e⁻/s per W m⁻² sr⁻¹ nm⁻¹.
        """
        return {name: response.at(wavelength_nm) for name, response in self.responses.items()}

    @cached_property
    def relative_illumination(self) -> NDArray[np.float32]:
        """Relative illumination V(x) of every pixel, [row, col]."""
        return optics.relative_illumination(self.layout, self.lens)

    @cached_property
    def aps(self) -> ApsNoise:
        """Noise model of the frame pixels.

        Raises
        ------
        SpecError
            If the sensor has no frame pixels, or its measured maps do not cover the read-out region.
        """
        if self.spec.aps is None:
            raise SpecError(f"sensor {self.name!r} has no frame pixels")
        require_region(self.layout)
        return ApsNoise(self.spec.aps, self.layout, self.spec.device_seed)

    @cached_property
    def evs(self) -> EvsNoise:
        """Noise model of the event pixels.

        Raises
        ------
        SpecError
            If the sensor has no event pixels, or its measured maps do not cover the read-out region.
        """
        if self.spec.evs is None:
            raise SpecError(f"sensor {self.name!r} has no event pixels")
        require_region(self.layout)
        return EvsNoise(self.spec.evs, self.layout, self.spec.device_seed, self._signal_scale)

    @property
    def _signal_scale(self) -> NDArray[np.float64]:
        """For each event position: response of the signal reference's filter over the position's own response."""
        assert self.spec.evs is not None
        reference = self.spec.evs.signal_reference.filter
        positions = self.spec.positions("evs")
        if reference == "own":
            return np.ones(len(positions))
        flat = constant(1.0)
        total = {name: integrate_product(response, flat) for name, response in self.responses.items()}
        own = [self.spec.pixels[self.spec.tile_rows[i][j]].filter for i, j in positions]
        return np.array([total[reference] / total[name] for name in own])


def load_sensor(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> Sensor:
    """Load a shipped sensor by name (``hesim-render info sensors``), or a sensor file by path.

    Parameters
    ----------
    name_or_path : name of a shipped sensor, or path of a YAML file.
    overrides : dotted keys and their values, applied before validation (``aps.exposure_us``).

    Examples
    --------
    >>> import hesim_render as hr
    >>> hr.load_sensor("eiger", {"aps.exposure_us": 2000}).spec.aps.exposure_us
    2000

    Returns
    -------
    The sensor, with all rows and columns read out.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    spec, maps = read_sensor_file(name_or_path, overrides)
    return Sensor.from_spec(spec, str(name_or_path), maps)


def as_sensor(given: Sensor | str | Path) -> Sensor:
    """A sensor as it is, or loaded by its name or path.

    Raises
    ------
    RangeError
        If something else is given.
    SpecError
        If the file is not valid.
    """
    if isinstance(given, str | Path):
        return load_sensor(given)
    if not isinstance(given, Sensor):
        raise RangeError("sensor", given, "a sensor from load_sensor, a name, or the path of a sensor file")
    return given
