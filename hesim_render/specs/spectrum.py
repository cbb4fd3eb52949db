"""A spectrum in a file."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from hesim_render.core.errors import SpecError
from hesim_render.specs.files import InFolder, Strict
from hesim_render.spectral import physical
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, product

_Wavelength = Annotated[float, Field(ge=100, le=3000)]
_Density = Annotated[float, Field(ge=0, le=20)]


class DyeSpec(Strict):
    """A dye: absorbance as a sum of bands [peak nm, FWHM nm, density] and edges [nm, width nm, density]."""

    bands: list[tuple[_Wavelength, Annotated[float, Field(gt=0, le=2000)], _Density]] = []
    edges: list[tuple[_Wavelength, Annotated[float, Field(ge=-500, le=500)], _Density]] = []

    @model_validator(mode="after")
    def _check(self) -> "DyeSpec":
        if any(width == 0 for _, width, _ in self.edges):
            raise ValueError("edges: the width of an edge must not be 0")
        return self


class ThinFilmSpec(Strict):
    """A stack of thin films without absorption; its first layer is that on the side of the light."""

    layers: list[tuple[Annotated[float, Field(ge=1, le=6)], Annotated[float, Field(gt=0, le=1e5)]]] = Field(
        min_length=1, max_length=400, description="refractive index and thickness in nm of each layer"
    )
    incidence: float = Field(1.0, ge=1, le=6, description="refractive index in front")
    substrate: float = Field(1.52, ge=1, le=6, description="refractive index behind")
    angle_deg: float = Field(0.0, ge=0, lt=90)


#: Keys of a spectrum, exactly one of which it has.
_SOURCES = (
    "flat", "csv", "illuminant", "colorchecker", "camera", "wavelength_nm", "blackbody_k", "peak_nm", "dye",
    "thin_film", "silicon_depth_um", "product",
)  # fmt: skip


class SpectrumSpec(InFolder):
    """One spectrum, from exactly one of the sources below, times `scale`.

    A bare number in a file means ``{flat: number}``; a bare string means ``{illuminant: name}``,
    or ``{csv: file}`` where it ends in ``.csv``.
    """

    flat: float | None = Field(None, description="the same value everywhere")
    band_nm: tuple[float, float] | None = Field(None, description="limits of `flat`, nm; zero outside")
    csv: str | None = Field(None, description="CSV file, relative to this file")
    column: str | int | None = Field(None, description="column of `csv`: header or 1-based number")
    illuminant: str | None = Field(None, description="relative spectral power by name, as D65 or LED-B3")
    colorchecker: str | None = Field(None, description="data set of measured ColorChecker reflectances")
    patch: str | int | None = Field(None, description="patch of `colorchecker`: name or 1-24")
    camera: str | None = Field(None, description="measured camera sensitivity by name")
    channel: str | None = Field(None, description="channel of `camera`")
    basis: Literal["energy", "quantum"] = Field(
        "quantum",
        description="'energy': the table is a response per watt; it is divided by λ and normalised to its peak",
    )
    wavelength_nm: list[float] | None = Field(None, description="grid of `value`, nm, increasing")
    value: list[float] | None = Field(None, description="values on `wavelength_nm`")
    blackbody_k: float | None = Field(None, gt=0, description="Planck radiator of this temperature")
    peak_nm: float | None = Field(None, description="centre of a Gaussian")
    fwhm_nm: float | None = Field(None, gt=0, description="full width at half maximum of that Gaussian")
    dye: DyeSpec | None = Field(None, description="transmittance of a dye by its absorbance")
    thin_film: ThinFilmSpec | None = Field(None, description="transmittance of a stack of thin films")
    silicon_depth_um: float | None = Field(
        None, gt=0, le=1e4, description="quantum efficiency of a silicon layer of this depth"
    )
    surface: Literal["coated", "bare"] = Field("coated", description="of the silicon: no reflection, or that in air")
    product: "list[SpectrumSpec] | None" = Field(None, min_length=2, max_length=20, description="of several spectra")
    scale: float = Field(1.0, description="multiplies all values")
    _table: tuple[tuple[float, ...], tuple[float, ...]] | None = PrivateAttr(None)  # the table of `csv`, read once

    @model_validator(mode="before")
    @classmethod
    def _shorthand(cls, data: Any) -> Any:
        if isinstance(data, int | float) and not isinstance(data, bool):
            return {"flat": float(data)}
        if isinstance(data, str):
            return {"csv": data} if data.endswith(".csv") else {"illuminant": data}
        return data

    @model_validator(mode="after")
    def _one_source(self) -> "SpectrumSpec":
        given = [name for name in _SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"a spectrum needs exactly one of {', '.join(_SOURCES)}; found {', '.join(given) or 'none'}"
            )
        needs = {"colorchecker": "patch", "camera": "channel", "wavelength_nm": "value", "peak_nm": "fwhm_nm"}
        partner = needs.get(given[0])
        if partner and getattr(self, partner) is None:
            raise ValueError(f"'{given[0]}' needs '{partner}' beside it")
        try:
            self.load()
        except SpecError as error:
            raise ValueError(str(error)) from None
        return self

    @model_serializer(mode="wrap")
    def _self_contained(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A dump (and so a hash) holds the numbers of a CSV file, not its name."""
        data = handler(self)
        if self.csv is not None:
            table = self._source()
            data |= {"csv": None, "column": None}
            data |= {"wavelength_nm": table.wavelength_nm.tolist(), "value": table.values.tolist()}
        return data

    def load(self) -> Spectrum:
        """The spectrum itself.

        Raises
        ------
        SpecError
            If a name or file is unknown or a table is malformed.
        """
        spectrum = self._source()
        if self.basis == "energy":
            quantum = spectrum.values / spectrum.wavelength_nm
            spectrum = Spectrum(spectrum.wavelength_nm, quantum / quantum.max())
        return spectrum.scaled(self.scale) if self.scale != 1.0 else spectrum

    def _source(self) -> Spectrum:
        if self.flat is not None:
            return spectra.constant(self.flat, *(self.band_nm or (300.0, 1100.0)))
        if self.csv is not None:
            if self._table is None:
                result = spectra.read_csv(self.folder / self.csv, self.column)
                self._table = tuple(result.wavelength_nm.tolist()), tuple(result.values.tolist())
            return Spectrum(np.array(self._table[0]), np.array(self._table[1]))
        if self.illuminant is not None:
            return spectra.illuminant(self.illuminant)
        if self.colorchecker is not None:
            chart = spectra.colorchecker_reflectances(self.colorchecker)
            if isinstance(self.patch, int):
                if not 1 <= self.patch <= len(chart):
                    raise SpecError(f"patch {self.patch} does not exist; patches are 1 to {len(chart)}")
                return list(chart.values())[self.patch - 1]
            if self.patch not in chart:
                raise SpecError(f"no patch {self.patch!r}; patches are {', '.join(chart)}")
            return chart[str(self.patch)]
        if self.camera is not None:
            return spectra.camera_sensitivity(self.camera, str(self.channel))
        if self.wavelength_nm is not None:
            return Spectrum(np.array(self.wavelength_nm), np.array(self.value))
        if self.product is not None:
            return product(*(part.load() for part in self.product))
        return self._computed()

    def _computed(self) -> Spectrum:
        if self.dye is not None:
            return physical.dye_transmittance(self.dye.bands, self.dye.edges)
        if self.thin_film is not None:
            film = self.thin_film
            indices, thicknesses = zip(*film.layers, strict=True)
            return physical.thin_film_transmittance(
                indices, thicknesses, film.incidence, film.substrate, film.angle_deg
            )
        if self.silicon_depth_um is not None:
            return physical.silicon_quantum_efficiency(self.silicon_depth_um, self.surface)
        if self.blackbody_k is not None:
            return physical.blackbody(self.blackbody_k)
        assert self.peak_nm is not None and self.fwhm_nm is not None
        return physical.gaussian_band(self.peak_nm, self.fwhm_nm)
