"""The ``aps`` section of a sensor file: frame pixels and their noise."""

from typing import Literal

from pydantic import Field, PositiveInt, model_validator

from hesim_render.specs.event_pixels import TelegraphSpec
from hesim_render.specs.files import Strict

#: Smallest slope of a bent signal up to full scale; the light would not follow from the signal below.
_LEAST_SLOPE = 0.05


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
    def _check(self) -> "ApsSpec":
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
