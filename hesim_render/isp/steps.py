"""The steps of a pipeline file: one model per step, which calls the step's function."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import reading
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.isp import balance, chart, colour, fill, levels, tone
from hesim_render.isp.demosaicing import demosaic
from hesim_render.isp.denoise import denoise, reduce_noise
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.rows import row_offsets
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.specs.files import Strict
from hesim_render.spectral.transfer import Depth, Transfer, encode

Corners = Annotated[list[tuple[float, float]], Field(min_length=4, max_length=4)]


@dataclass
class Development:
    """An image on its way through a pipeline.

    Parameters
    ----------
    image : [row, col] before the demosaic, [row, col, channel] after it.
    camera : the camera that took it; steps without parameters of their own use those of the camera.
    tile : channel numbers of the current mosaic (holes get filled).
    illumination : relative illumination of the lens [row, col], if it is known.
    exposure_gain : gain of an automatic exposure, kept so that all frames of a recording get the same.
    noise : noise of the sensor at this frame's exposure, if it is known.
    span_dn : white minus black level, DN, once the image has black at 0 and white at 1.
    report : results of the steps (gains, ΔE2000).
    """

    image: NDArray
    camera: Camera
    tile: NDArray[np.int64]
    illumination: NDArray[np.float32] | None = None
    exposure_gain: float | None = None
    noise: FrameNoise | None = None
    span_dn: float | None = None
    report: dict[str, Any] | None = None

    def note(self, **result: Any) -> None:
        self.report = {**(self.report or {}), **result}


class MapFile(Strict):
    """A map in an NPY file, or a named array of an NPZ file, relative to the pipeline's file."""

    file: Path
    name: str | None = None

    @field_validator("file")
    @classmethod
    def _beside_the_pipeline(cls, given: Path, info: ValidationInfo) -> Path:
        return Path((info.context or {}).get("folder", Path())) / given

    def load(self) -> NDArray:
        """The array.

        Raises
        ------
        SpecError
            If it cannot be read.
        """
        with reading(self.file):
            is_archive = zipfile.is_zipfile(self.file)
        if not is_archive:
            return read_array(self.file, kinds="uif")
        if self.name is None:
            raise SpecError("holds several arrays: say which one by 'name'", file=self.file)
        return read_arrays(self.file, (self.name,), only=(self.name,), kinds="buif")[self.name]


class BlackLevel(Strict):
    """`levels.black_level`; by default with the levels of the camera."""

    step: Literal["black_level"]
    black_level_dn: float | None = None
    white_level_dn: float | None = None
    row_map: MapFile | None = None
    pixel_map: MapFile | None = None

    def run(self, state: Development) -> None:
        black = state.camera.black_level_dn if self.black_level_dn is None else self.black_level_dn
        white = state.camera.white_level_dn if self.white_level_dn is None else self.white_level_dn
        rows, pixels = (None if m is None else m.load() for m in (self.row_map, self.pixel_map))
        state.image = levels.black_level(state.image, black, white, rows, pixels)
        state.span_dn = white - black


class Fill(Strict):
    """`fill`: bad pixels, and positions without a value unless the demosaic interpolates them."""

    step: Literal["fill"]
    event_pixels: bool = False
    bad_pixels: MapFile | None = None

    def run(self, state: Development) -> None:
        if self.bad_pixels is not None:
            state.image = fill.fill_pixels(state.image, state.tile, self.bad_pixels.load().astype(bool))
        filled = state.camera.filled_tile
        if self.event_pixels and not np.array_equal(filled, state.tile):
            state.image = fill.fill_positions(state.image, state.tile, filled)
            state.tile = filled


class Denoise(Strict):
    """Correction by the sensor's maps, estimation of row offsets without a map, and `denoise.denoise` by its noise
    model.

    `strength` multiplies the standard deviation of the noise; at 0 only maps and rows are corrected. `row_std_dn` is
    the standard deviation over rows of offsets without a map, by default that of the noise model.
    """

    step: Literal["denoise"]
    strength: float = Field(1.0, ge=0, le=4)
    row_std_dn: float | None = Field(None, ge=0)

    def run(self, state: Development) -> None:
        noise, span = state.noise, state.span_dn
        if noise is None or span is None:
            raise SpecError("no noise model is known here; give one, or leave the step out", key="denoise")
        if noise.beta.shape[:2] != state.tile.shape:
            raise RangeError("tile of the noise model", noise.beta.shape[:2], f"the camera's {state.tile.shape}")
        saturated = state.image >= 1
        signal = noise.corrected(state.image * np.float32(span))
        row_std_dn = noise.unknown_rows_dn if self.row_std_dn is None else self.row_std_dn
        if row_std_dn > 0:
            offsets = row_offsets(signal, state.tile, noise, row_std_dn)
            state.note(row_offsets_rms_dn=float(np.sqrt(np.mean(offsets**2))))
            signal -= offsets[:, None]
        if self.strength > 0 and not noise.is_clean:
            signal = denoise(signal, state.tile, noise.times(self.strength), span, state.camera.white_balance)
        # a clipped sample has no offset and stays white
        state.image = np.where(saturated, np.maximum(signal / np.float32(span), 1), signal / np.float32(span))


class LensShading(Strict):
    """`levels.lens_shading` by the recording's own lens, by a map, or by cos⁴ of a focal length."""

    step: Literal["lens_shading"]
    map: MapFile | None = None
    focal_length_px: float | None = Field(None, gt=0)
    centre_px: tuple[float, float] | None = None

    def run(self, state: Development) -> None:
        if self.map is not None:
            illumination = self.map.load()
        elif self.focal_length_px is not None:
            illumination = levels.cos4_illumination(state.image.shape, self.focal_length_px, self.centre_px)
        elif state.illumination is not None:
            illumination = state.illumination
        else:
            raise SpecError("no lens is known here; give map or focal_length_px", key="lens_shading")
        state.image = levels.lens_shading(state.image, illumination)


class WhiteBalance(Strict):
    """`balance.white_balance` with gains of the camera, given gains, grey world, or a ColorChecker's grey patches."""

    step: Literal["white_balance"]
    method: Literal["camera", "given", "grey_world", "chart"] = "camera"
    gains: list[float] | None = None
    corners: Corners | None = None
    clip: bool = True

    def run(self, state: Development) -> None:
        gains = self._gains(state)
        state.note(white_balance=[float(gain) for gain in gains])
        state.image = balance.white_balance(state.image, state.tile, gains, self.clip)

    def _gains(self, state: Development) -> list[float]:
        if self.method == "camera":
            return state.camera.white_balance
        if self.method == "grey_world":
            return balance.grey_world(state.image, state.tile)
        if self.method == "given":
            if self.gains is None:
                raise SpecError("is required by method given", key="white_balance.gains")
            return self.gains
        if self.corners is None:
            raise SpecError("is required by method chart", key="white_balance.corners")
        return balance.from_neutral(chart.patch_means(_by_channel(state), self.corners)[chart.NEUTRAL])


def _by_channel(state: Development) -> NDArray[np.float32]:
    """A mosaic as [row, col, channel] with NaN where a channel has no sample."""
    periods = zip(state.image.shape, state.tile.shape, strict=True)
    channel = state.tile[np.ix_(*(np.arange(size) % period for size, period in periods))]
    count = len(state.camera.channels)
    return np.where(channel[..., None] == np.arange(count), state.image[..., None], np.float32(np.nan))


class Demosaic(Strict):
    """`demosaicing.demosaic`."""

    step: Literal["demosaic"]
    method: Literal["guided", "linear"] = "guided"

    def run(self, state: Development) -> None:
        state.image = demosaic(state.image, state.tile, self.method)


class NoiseReduction(Strict):
    """`denoise.reduce_noise`."""

    step: Literal["noise_reduction"]
    luma: float = Field(0.005, ge=0)
    chroma: float = Field(0.02, ge=0)
    radius_px: int = Field(3, ge=1, le=50)

    def run(self, state: Development) -> None:
        state.image = reduce_noise(state.image, self.luma, self.chroma, self.radius_px)


class ColourMatrix(Strict):
    """`colour.colour_matrix` with the camera's matrix, a given one, or one fitted to a ColorChecker in the image."""

    step: Literal["colour_matrix"]
    method: Literal["camera", "given", "chart"] = "camera"
    matrix: list[list[float]] | None = None
    corners: Corners | None = None
    illuminant: str = "D65"

    def run(self, state: Development) -> None:
        matrix = state.camera.matrix
        if self.method == "given":
            if self.matrix is None:
                raise SpecError("is required by method given", key="colour_matrix.matrix")
            matrix = self.matrix
        elif self.method == "chart":
            if self.corners is None:
                raise SpecError("is required by method chart", key="colour_matrix.corners")
            from hesim_render.spectral import spectrum as spectra

            reference = chart.reference_linear_srgb(spectra.illuminant(self.illuminant))
            result = colour.fit_srgb_matrix(chart.patch_means(state.image, self.corners), reference)
            matrix = result.matrix
            state.note(matrix=matrix, mean_delta_e_2000=result.mean_delta_e, max_delta_e_2000=result.max_delta_e)
        state.image = colour.colour_matrix(state.image, matrix)


class ToneExposure(Strict):
    """`tone.exposure`: a given gain, or (``auto``) the one that brings the brightest half percent to white."""

    step: Literal["exposure"]
    gain: float = Field(1.0, gt=0)
    auto: bool = False
    percentile: float = Field(99.5, gt=0, le=100)
    level: float = Field(0.95, gt=0)

    def run(self, state: Development) -> None:
        gain = self.gain
        if self.auto:
            if state.exposure_gain is None:
                state.exposure_gain = tone.auto_gain(state.image, self.percentile, self.level)
            gain *= state.exposure_gain
        state.note(exposure_gain=gain)
        state.image = tone.exposure(state.image, gain)


class Tone(Strict):
    """`tone.tone_global` or `tone.tone_local`."""

    step: Literal["tone"]
    method: Literal["global", "local"] = "global"
    white: float = Field(4.0, gt=0)
    compression: float = Field(0.6, gt=0, le=1)
    detail: float = Field(1.0, ge=0, le=4)
    radius_px: int = Field(16, ge=1, le=500)

    def run(self, state: Development) -> None:
        if self.method == "global":
            state.image = tone.tone_global(state.image, self.white)
        else:
            state.image = tone.tone_local(state.image, self.compression, self.detail, self.radius_px)


class Encode(Strict):
    """`transfer.encode`; by default with the transfer of the camera."""

    step: Literal["encode"]
    transfer: Transfer | None = None
    gamma: float | None = Field(None, gt=0)
    depth: Depth = 8

    def run(self, state: Development) -> None:
        curve = self.transfer or state.camera.transfer
        state.image = encode(state.image, curve, self.gamma or state.camera.gamma, self.depth)


Step = Annotated[
    BlackLevel
    | Fill
    | Denoise
    | LensShading
    | WhiteBalance
    | Demosaic
    | NoiseReduction
    | ColourMatrix
    | ToneExposure
    | Tone
    | Encode,
    Field(discriminator="step"),
]
#: Place of a step: on the mosaic (before the demosaic) or on the picture (after it).
ON_MOSAIC = (BlackLevel, Fill, Denoise, LensShading, WhiteBalance)
#: Steps that may precede denoise, because after them the sensor's noise model still holds.
BEFORE_DENOISE = (BlackLevel, Fill)
