"""The sensor file: geometry, tile, filters, lens, APS and EVS parameters.

Units are in the key names. ``sources`` and ``assumptions`` say, for every figure, where it comes
from or why it was assumed.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveInt, field_validator, model_validator
from ruamel.yaml.comments import CommentedMap

from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.specs.calibrated import apply_calibration, with_intervals
from hesim_render.specs.calibration import NoiseFile, NoisePart
from hesim_render.specs.data_sheet import DataSheetSpec, V2eSpec
from hesim_render.specs.defects import EventDefectSpec, TelegraphSpec
from hesim_render.specs.doubts import doubts
from hesim_render.specs.files import Strict, load_yaml, locate, validate
from hesim_render.specs.from_data_sheet import derive, placeholders
from hesim_render.specs.leak import LeakSpec
from hesim_render.specs.lens import LensSpec
from hesim_render.specs.photoreceptor import PhotoreceptorSpec
from hesim_render.specs.problems import line_of
from hesim_render.specs.sensor_checks import sensor_problems, unused
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.spectrum import Spectrum, product

Role = Literal["aps", "evs"]

#: Smallest threshold if a change gives one event per threshold that it contains.
_LEAST_THRESHOLD = 1e-4
#: Smallest slope of a bent signal up to full scale; the light could not be told from the signal below.
_LEAST_SLOPE = 0.05


class GeometrySpec(Strict):
    rows: int = Field(ge=1, le=65_535)
    cols: int = Field(ge=1, le=65_535)
    pitch_um: float = Field(ge=0.1, le=1e5)
    fill_factor: float = Field(1.0, ge=1e-6, le=1)
    crosstalk: float = Field(0.0, ge=0, le=0.5, description="part of a pixel's electrons its 4 neighbours collect")


class PixelSpec(Strict):
    """One letter of the tile."""

    filter: str
    roles: list[Role] = Field(min_length=1)


class EvsGridSpec(Strict):
    """How event pixels are numbered: each tile holds rows × cols of them, taken in reading order.

    The k-th event pixel of tile (i, j) has event coordinates y = i·rows_per_tile + k // cols_per_tile
    and x = j·cols_per_tile + k % cols_per_tile.
    """

    rows_per_tile: PositiveInt
    cols_per_tile: PositiveInt


class InterferenceSpec(Strict):
    """A sine over the picture with a new phase in each frame, such as the pick-up of a clock."""

    cycles_per_row: float = Field(ge=-0.5, le=0.5, description="periods from row to row")
    cycles_per_col: float = Field(ge=-0.5, le=0.5, description="periods from column to column")
    rms_dn: float = Field(ge=0, le=65_535)


class ApsSpec(Strict):
    """Frames: N_e = min(Poisson((1 + PRNU) I_e + D Δt), full well) + N(0, σ_r²); DN = clip(round(K N_e + N_FP))."""

    full_well_e: float = Field(ge=1e-3, le=1e12)
    system_gain_dn_per_e: float = Field(ge=1e-9, le=1e6)
    bit_depth: int = Field(ge=1, le=16)
    black_level_dn: float = Field(ge=0)
    read_noise_e: float = Field(ge=0, le=1e6)
    read_noise_correlation: float = Field(
        0.0, ge=-0.45, le=0.45, description="of a pixel's read noise with that of the next one in its row"
    )
    dark_current_e_per_s: float = Field(ge=0, le=1e9)
    dark_current_nonuniformity_rel: float = Field(
        0.0, ge=0, le=100, description="std / mean of a gamma law over pixels"
    )
    dark_current_doubling_c: float | None = Field(
        None, ge=2, le=1000, description="warming that doubles the dark current"
    )
    dark_current_reference_c: float | None = Field(
        None, ge=-100, le=125, description="temperature dark_current_e_per_s holds at; default temperature_c"
    )
    temperature_c: float | None = Field(None, ge=-100, le=125, description="of the sensor; default the reference's")
    prnu_rel: float = Field(0.0, ge=0, lt=0.3)
    dsnu_e: float = Field(0.0, ge=0, le=1e6, description="std over pixels of the fixed offset N_BLC, in electrons")
    row_offset_std_dn: float = Field(0.0, ge=0, le=65_535, description="std over rows of the fixed offset N_row")
    row_noise_dn: float = Field(0.0, ge=0, le=65_535, description="temporal: std of what a row gets anew in each frame")
    column_offset_std_dn: float = Field(0.0, ge=0, le=65_535, description="std over columns of the fixed offset N_col")
    column_noise_dn: float = Field(
        0.0, ge=0, le=65_535, description="temporal: std of what a column gets anew in each frame"
    )
    nonlinearity: list[float] | None = Field(
        None,
        min_length=1,
        max_length=3,
        description="n0, n1, n2: the signal E = K·electrons becomes E (1 + n0 + n1 u + n2 u²), u = E/full scale",
    )
    interference: list[InterferenceSpec] = Field([], max_length=64, description="periodic patterns of the read-out")
    residual_noise_dn: float = Field(0.0, ge=0, le=65_535, description="N_res: extra Gaussian temporal noise")
    telegraph: TelegraphSpec | None = Field(None, description="pixels that jump between two levels; default none")
    law: Literal["poisson", "gaussian"] = "poisson"
    exposure_us: PositiveInt
    frame_rate_hz: float = Field(ge=1e-4, le=1e6)
    shutter: Literal["rolling", "global"]
    line_time_us: float = Field(0.0, ge=0, le=1e6)
    beta: list[list[list[float]]] | None = Field(
        None,
        description="[tile_row][tile_col][6] variance polynomial in 1, I, t, I², I·t, t² (DN, s), ADC variance "
        "excluded; replaces read, shot and dark noise of the physical form",
    )

    @model_validator(mode="after")
    def _check(self) -> ApsSpec:
        if self.shutter == "rolling" and self.line_time_us == 0:
            raise ValueError("a rolling shutter needs line_time_us above 0")
        if self.black_level_dn >= 2**self.bit_depth - 1:
            raise ValueError(f"black_level_dn {self.black_level_dn:g} does not fit into {self.bit_depth} bits")
        if self.exposure_us > 1e6 / self.frame_rate_hz:
            raise ValueError(
                f"exposure_us {self.exposure_us} is longer than a frame period of {1e6 / self.frame_rate_hz:.0f} µs"
            )
        if self.nonlinearity is not None:
            n0, n1, n2 = (*self.nonlinearity, 0.0, 0.0)[:3]
            # slope 1 + n0 + 2 n1 u + 3 n2 u² at both ends and at its extreme between them
            places = [0.0, 1.0] + ([-n1 / (3 * n2)] if n2 != 0 and 0 < -n1 / (3 * n2) < 1 else [])
            if not min(1 + n0 + 2 * n1 * u + 3 * n2 * u * u for u in places) >= _LEAST_SLOPE:
                raise ValueError(
                    f"nonlinearity {self.nonlinearity}: the signal must rise with the light up to full scale, with a "
                    f"slope of at least {_LEAST_SLOPE:g}"
                )
        if self.excess_temperature_c != 0:
            if self.dark_current_doubling_c is None:
                raise ValueError(
                    f"temperature_c {self.temperature_c:g} is not dark_current_reference_c "
                    f"{self.dark_current_reference_c:g}: dark_current_doubling_c is needed"
                )
            if self.beta is not None:
                raise ValueError("beta holds at the temperature it was measured at: leave temperature_c out")
        return self

    @property
    def excess_temperature_c(self) -> float:
        """Temperature above that of the dark-current figure."""
        if self.temperature_c is None or self.dark_current_reference_c is None:
            return 0.0
        return self.temperature_c - self.dark_current_reference_c

    @property
    def dark_current_growth(self) -> float:
        """Dark current at `temperature_c` over that of the reference: 2^((T − T_ref)/doubling)."""
        if self.dark_current_doubling_c is None:
            return 1.0
        return 2.0 ** (self.excess_temperature_c / self.dark_current_doubling_c)

    @property
    def dark_current_now_e_per_s(self) -> float:
        """Mean dark current at `temperature_c`."""
        return self.dark_current_e_per_s * self.dark_current_growth


class SignalReferenceSpec(Strict):
    """Unit of the EVS signal: I = k · Φ · t_ref, in DN of this exposure seen through `filter`."""

    k_dn_per_e: float = Field(ge=1e-9, le=1e6)
    t_ref_us: float = Field(ge=1e-3, le=1e9)
    filter: str = Field(
        "own",
        description="'own', or a filter: Φ is then scaled by the ratio of responses to an equal-energy light",
    )


class EvsCoefficients(Strict):
    """Noise of one event position: x = β1 I + β2, s² from β3 (shot), β4 (dark), β5 (their correlation)."""

    beta1: float = Field(ge=0, le=1e9, description="V/DN, slope of the voltage map")
    beta2: float = Field(ge=1e-12, le=1e9, description="V, V_PD: the photodiode's baseline voltage")
    beta3: float = Field(ge=0, le=1e9, description="shot noise: V/DN for the linear law, V/√DN for the sqrt law")
    beta4: float = Field(ge=0, le=1e9, description="V, dark-current shot noise")
    beta5: float = Field(0.0, ge=-1, le=1, description="correlation of the two")


class EvsSpec(Strict):
    """Events: compare ΔV = ln x₁/x₀ + noise with θ₊ and θ₋ (ln units)."""

    reference: Literal["previous_sample", "last_event"]
    tick_us: int | None = Field(None, ge=1, le=10**9, description="period of the fixed comparisons (previous_sample)")
    window_us: int = Field(ge=1, le=10**9, description="integration window that ends at each sample")
    contrast_threshold_on: float = Field(ge=1e-9, le=100)
    contrast_threshold_off: float = Field(ge=1e-9, le=100)
    threshold_mismatch_std: float = Field(0.0, ge=0, lt=0.5, description="std over pixels of θ, relative")
    threshold_hardware_v: float | None = Field(None, ge=1e-9, le=1e6, description="Θ; β0 = θ/Θ where it is known")
    signal_reference: SignalReferenceSpec
    coefficients: list[EvsCoefficients] = Field(min_length=1, description="one for all, or one per event position")
    shot_law: Literal["linear", "sqrt"]
    noise_mode: Literal["per_instant", "independent"] = "per_instant"
    leak_rate_hz: float = Field(0.0, ge=0, le=1e6, description="Poisson process of ON events, per pixel")
    leak: LeakSpec | None = Field(None, description="in place of leak_rate_hz: which process the leak is")
    photoreceptor_cutoff_hz: float | None = Field(None, ge=1e-3, le=1e6, description="noise bandwidth (last_event)")
    photoreceptor: PhotoreceptorSpec | None = Field(None, description="bandwidth of the signal; default unlimited")
    data_sheet: DataSheetSpec | None = Field(None, description="figures that the values above follow from")
    v2e: V2eSpec | None = Field(None, description="options of v2e that they follow from")
    defects: EventDefectSpec | None = Field(None, description="stuck, hot and flickering pixels; default none")
    refractory_period_us: int | None = Field(
        None, ge=1, le=10**9, description="no event so long after a pixel's last one"
    )
    readout_max_events_per_s: float | None = Field(
        None, ge=1e-3, le=1e12, description="events beyond are lost; default no limit"
    )
    readout_buffer_events: int | None = Field(
        None, ge=1, le=10**12, description="that can wait for the read-out; default what it takes in tick_us or 1 ms"
    )

    @model_validator(mode="after")
    def _check(self) -> EvsSpec:
        if self.reference == "previous_sample":
            if self.tick_us is None:
                raise ValueError("reference 'previous_sample' needs tick_us")
            if self.window_us > self.tick_us:
                raise ValueError(f"window_us {self.window_us} is longer than tick_us {self.tick_us}")
        elif self.photoreceptor_cutoff_hz is None:
            raise ValueError("reference 'last_event' needs photoreceptor_cutoff_hz, the bandwidth of its noise")
        for key in ("contrast_threshold_on", "contrast_threshold_off"):
            # a change of several thresholds gives as many events in this mode
            if self.reference == "last_event" and getattr(self, key) < _LEAST_THRESHOLD:
                raise ValueError(f"{key} must be at least {_LEAST_THRESHOLD:g} with reference 'last_event'")
        if self.refractory_period_us is not None and self.reference != "last_event":
            raise ValueError("refractory_period_us belongs to reference 'last_event'; a fixed tick has none")
        if self.photoreceptor is not None and self.photoreceptor.filters_noise:
            if self.reference != "last_event":
                raise ValueError("photoreceptor.filters_noise belongs to reference 'last_event'")
            if (self.photoreceptor_cutoff_hz or 0.0) > self.photoreceptor.cutoff_hz:
                raise ValueError("photoreceptor_cutoff_hz is above photoreceptor.cutoff_hz, which filters the noise")
        if self.data_sheet is not None and self.v2e is not None:
            raise ValueError("data_sheet and v2e say the same in two ways: leave one of them out")
        if (self.data_sheet or self.v2e) is not None and self.reference != "last_event":
            raise ValueError("data_sheet and v2e describe asynchronous pixels: they need reference 'last_event'")
        if self.leak is not None and self.leak_rate_hz > 0:
            raise ValueError("leak and leak_rate_hz (or leak_hz of a data sheet) say the same: leave one of them out")
        if self.leak is not None and self.leak.process == "drift" and self.reference != "last_event":
            raise ValueError(
                "leak.process 'drift' moves the reference of asynchronous pixels, reference 'last_event'; a fixed tick "
                "has process 'poisson'"
            )
        if self.readout_buffer_events is not None and self.readout_max_events_per_s is None:
            raise ValueError("readout_buffer_events needs readout_max_events_per_s")
        follows_light = self.photoreceptor is not None and self.photoreceptor.follows_light
        if follows_light and any(entry.beta1 == 0 for entry in self.coefficients):
            raise ValueError("photoreceptor.follows_light needs beta1 above 0: without it there is no signal")
        return self


def tile_text(value: Any) -> str:
    """The drawing of a tile: one line of letters per row, without blanks.

    Raises
    ------
    ValueError
        If it is no text, or its rows differ in length.
    """
    if not isinstance(value, str):
        raise ValueError("the tile is drawn as text, one letter a pixel, one line a row")
    rows = ["".join(line.split()) for line in value.strip().splitlines()]
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError("every line of the tile must hold the same number of letters")
    return "\n".join(rows)


class SensorSpec(Strict):
    """A whole sensor file."""

    schema_version: Literal[1]
    name: str = Field(min_length=1)
    description: str
    device_seed: int = Field(ge=0, lt=2**64)
    geometry: GeometrySpec
    tile: str
    pixels: dict[str, PixelSpec] = Field(min_length=1)
    evs_grid: EvsGridSpec | None = None
    filters: dict[str, SpectrumSpec] = Field(min_length=1, description="C_f(λ), transmittance")
    quantum_efficiency: SpectrumSpec = Field(description="η(λ), electrons per photon")
    lens: LensSpec
    aps: ApsSpec | None = None
    evs: EvsSpec | None = None
    noise: NoiseFile | None = Field(None, description="a calibration.yaml whose values replace the file's own")
    sources: dict[str, str] = {}
    assumptions: dict[str, str] = {}

    @field_validator("tile", mode="before")
    @classmethod
    def _tile_shape(cls, value: Any) -> str:
        return tile_text(value)

    @property
    def tile_rows(self) -> list[str]:
        """The tile, one string of letters per row."""
        return self.tile.split("\n")

    def positions(self, role: Role) -> list[tuple[int, int]]:
        """Tile positions that have `role`, in reading order."""
        return [
            (i, j)
            for i, row in enumerate(self.tile_rows)
            for j, letter in enumerate(row)
            if role in self.pixels[letter].roles
        ]

    def filter_response(self, name: str) -> Spectrum:
        """τ_lens · C_f · η of a filter: electrons per photon that reaches the lens."""
        return product(self.filters[name].load(), self.quantum_efficiency.load(), self.lens.transmittance.load())

    @model_validator(mode="after")
    def _check(self) -> SensorSpec:
        if problems := list(sensor_problems(self)):
            raise ValueError("\n".join(problems))
        return self


def read_sensor(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> SensorSpec:
    """A sensor file, by shipped name or path, with dotted `overrides` applied before validation.

    The calibration that ``noise`` names, relative to the file (to the working directory where it is an
    override), replaces the file's own values first: overrides have the last word.

    Raises
    ------
    SpecError
        With file, line and key of all that is wrong. A letter or filter of the file that no pixel uses is an error; one
        that no pixel uses after `overrides` is a `HesimWarning`, as is a value that no sensor has (`doubts`).
    """
    file = locate(name_or_path, "sensors")
    data, changes = load_yaml(file), dict(overrides or {})
    if "pixels" not in data and {"target", "objects", "light", "camera", "mitsuba"} & set(data):
        raise SpecError("is a scene file; expected a sensor file", file=file)
    folder = Path.cwd() if "noise" in changes else file.parent
    given, calibration = changes.pop("noise", data.get("noise")), None
    of_noise = {key.removeprefix("noise."): changes.pop(key) for key in list(changes) if key.startswith("noise.")}
    if given is not None or of_noise:
        given = {"file": given} if isinstance(given, str) else given
        if not isinstance(given, Mapping) or not isinstance(given.get("file"), str):
            raise SpecError("expected the path of a calibration.yaml", file=file, key="noise")
        data.pop("noise", None)
        own = {name: dict(data[name]) for name in ("aps", "evs") if isinstance(data.get(name), Mapping)}
        _read(data, file, changes)
        noise = validate(NoisePart, {"noise": {**given, **of_noise, "folder": folder}}, file, {}).noise
        calibration = noise.read()
        noise = with_intervals(own, noise, calibration)
        apply_calibration(data, noise, calibration)
        data["noise"] = {**dict(noise), "folder": folder}
    spec = validate(SensorSpec, data, file, changes) if calibration is not None else _read(data, file, changes)
    if spec.noise is not None and calibration is not None:
        spec.noise.keep_maps(calibration)  # read the maps now: the sensor needs no file afterwards
    problems = [SpecError(text, file=file, line=line_of(data, key.split(".")), key=key) for key, text in unused(spec)]
    if problems and not changes:
        raise SpecError.together(problems)
    for problem in problems:  # after an override this may be intended: the replaced part stays in the file
        warnings.warn(str(problem), HesimWarning, stacklevel=3)
    for key, text in doubts(spec):
        known = None if key in changes else line_of(data, key.split("."))
        warnings.warn(str(SpecError(text, file=file, line=known, key=key)), HesimWarning, stacklevel=3)
    return spec


def _read(data: CommentedMap, file: Path, changes: Mapping[str, Any]) -> SensorSpec:
    """Check the content of a file and replace a data sheet by what follows from it, in place."""
    derived = placeholders(data, changes, file)
    spec = validate(SensorSpec, data, file, changes)
    if derived:
        derive(data, spec, file)
        spec = validate(SensorSpec, data, file, changes)
    return spec
