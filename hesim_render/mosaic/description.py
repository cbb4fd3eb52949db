"""Description of a sensor's RAW frames for pictures and files: tile, levels, colours.

A `Mosaic` is plain data. The manifest of a recording contains it, so that a recording can be
shown and exported without the sensor file it was made with.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.colorimetry import responses_to, tristimulus, xyz_to_linear_srgb
from hesim_render.spectral.spectrum import Spectrum, constant, integrate_product

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

#: CFA colour codes of TIFF/EP and DNG 1.7, tag CFAPattern, by the thirds of the visible band that pass.
_CODES = {"R": 0, "G": 1, "B": 2, "GB": 3, "RB": 4, "RG": 5, "RGB": 6}
COLOUR_NAMES = ("red", "green", "blue", "cyan", "magenta", "yellow", "white")
_THIRDS_NM = {"R": (580.0, 700.0), "G": (500.0, 580.0), "B": (400.0, 500.0)}


class Mosaic(BaseModel):
    """Tile and colour of a sensor's RAW frames; row 0, column 0 of a frame is tile position (0, 0).

    Parameters
    ----------
    sensor : name of the sensor.
    tile_filter : filter name of each tile position, [tile_row][tile_col].
    tile_aps, tile_evs : which positions give frames, events; same shape.
    cfa_code : DNG colour code of each filter (0 red, 1 green, 2 blue, 3 cyan, 4 magenta, 5 yellow, 6 white).
    bit_depth, black_level_dn, white_level_dn : levels of the RAW data; white is where a pixel saturates.
    system_gain_dn_per_e : K.
    channels : filters of the frame pixels, the order of the matrices' columns and rows below.
    neutral : response of each channel to a white surface under the scene's light, largest 1.
    camera_to_srgb : [3][channel], from channels divided by `neutral` to linear sRGB; rows sum to 1.
    xyz_to_camera : [channel][3], from CIE 1931 XYZ (D65) to channels; the DNG ColorMatrix.
    f_number, focal_length_mm : the lens in use.
    pitch_um : distance of neighbouring pixels, µm; None in recordings of earlier versions, as the next.
    noise_profile : S and O of the variance S·x + O, x from 0 at the black to 1 at the white level; None without noise.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sensor: str
    tile_filter: list[list[str]]
    tile_aps: list[list[bool]]
    tile_evs: list[list[bool]]
    cfa_code: dict[str, int]
    bit_depth: int = Field(ge=1, le=16)
    black_level_dn: float
    white_level_dn: int = Field(ge=0, le=65535)
    system_gain_dn_per_e: PositiveFloat
    channels: list[str]
    neutral: list[float]
    camera_to_srgb: list[list[float]]
    xyz_to_camera: list[list[float]]
    f_number: PositiveFloat
    focal_length_mm: PositiveFloat
    pitch_um: PositiveFloat | None = None
    noise_profile: tuple[PositiveFloat, PositiveFloat] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Mosaic":
        tables: list[list[list[Any]]] = [self.tile_filter, self.tile_aps, self.tile_evs]
        if not all(map(_is_even, tables)) or len({np.shape(table) for table in tables}) != 1:
            raise ValueError("tile_filter: it, tile_aps and tile_evs must be tables of one size, of at least one pixel")
        for name in {name for row in self.tile_filter for name in row}:
            if not 0 <= self.cfa_code.get(name, -1) < len(COLOUR_NAMES):
                raise ValueError(f"cfa_code: expected a code from 0 to {len(COLOUR_NAMES) - 1} for filter {name!r}")
        with_frames = {name for names, aps in zip(self.tile_filter, self.tile_aps, strict=True)
                       for name, has in zip(names, aps, strict=True) if has}  # fmt: skip
        count = len(self.channels)
        if not count or len(set(self.channels)) != count or not with_frames <= set(self.channels):
            raise ValueError(f"channels: expected each of {', '.join(sorted(with_frames)) or 'the filters'} once")
        if len(self.neutral) != count or min(self.neutral) < 0 or max(self.neutral) <= 0:
            raise ValueError(f"neutral: expected {count} numbers of 0 or more, one per channel, not all 0")
        for key, shape in (("camera_to_srgb", (3, count)), ("xyz_to_camera", (count, 3))):
            table = getattr(self, key)
            if not _is_even(table) or np.shape(table) != shape:
                raise ValueError(f"{key}: expected {shape[0]} rows of {shape[1]} numbers")
        if self.white_level_dn <= self.black_level_dn:
            raise ValueError("white_level_dn: must be above black_level_dn")
        return self

    @property
    def tile_shape(self) -> tuple[int, int]:
        return len(self.tile_filter), len(self.tile_filter[0])

    @property
    def tile_code(self) -> NDArray[np.uint8]:
        """DNG colour code of each tile position."""
        return np.array([[self.cfa_code[name] for name in row] for row in self.tile_filter], dtype=np.uint8)

    @property
    def tile_channel(self) -> NDArray[np.int8]:
        """Number of each tile position's channel, -1 where the position gives no frame value."""
        number = {name: k for k, name in enumerate(self.channels)}
        rows = zip(self.tile_filter, self.tile_aps, strict=True)
        return np.array(
            [[number[name] if aps else -1 for name, aps in zip(*row, strict=True)] for row in rows], dtype=np.int8
        )

    @property
    def is_mono(self) -> bool:
        """True if all pixels of the tile have the same filter."""
        return len({name for row in self.tile_filter for name in row}) == 1

    def tiled(self, tile: NDArray, shape: tuple[int, ...]) -> NDArray:
        """A tile repeated over an image of `shape` [row, col]."""
        rows, cols = np.ogrid[: shape[0], : shape[1]]
        return tile[rows % tile.shape[0], cols % tile.shape[1]]


def _is_even(table: list[list[Any]]) -> bool:
    """Whether all rows are of one length, at least 1."""
    return bool(table) and bool(table[0]) and len({len(row) for row in table}) == 1


def cfa_code(response: Spectrum) -> int:
    """DNG colour code nearest to a filter: the thirds of the visible band that it passes.

    A third passes where its mean response reaches half of the largest of the three (400-500,
    500-580, 580-700 nm). Seven codes cannot tell multispectral filters apart; the manifest names them.
    """
    means = {name: integrate_product(response, constant(1.0, *band)) / (band[1] - band[0])
             for name, band in _THIRDS_NM.items()}  # fmt: skip
    largest = max(means.values())
    return _CODES["".join(name for name in "RGB" if means[name] >= 0.5 * largest)] if largest > 0 else 6


def describe(sensor: "Sensor", light: Spectrum | None = None) -> Mosaic:
    """The mosaic of a sensor under a light (relative spectral power; default D65)."""
    spec = sensor.spec
    rows = spec.tile_rows
    tile_filter = [[spec.pixels[letter].filter for letter in row] for row in rows]
    tile_aps = [["aps" in spec.pixels[letter].roles for letter in row] for row in rows]
    tile_evs = [["evs" in spec.pixels[letter].roles for letter in row] for row in rows]
    used = {name for row in tile_filter for name in row}
    seen = {name for names, aps in zip(tile_filter, tile_aps, strict=True)
            for name, has in zip(names, aps, strict=True) if has}  # fmt: skip
    channels = [name for name in spec.filters if name in seen] or [name for name in spec.filters if name in used]
    neutral, to_srgb, from_xyz = _colour_matrices([sensor.responses[name] for name in channels], light)
    aps = spec.aps
    top = 2**aps.bit_depth - 1 if aps else 1
    return Mosaic(
        sensor=spec.name,
        tile_filter=tile_filter,
        tile_aps=tile_aps,
        tile_evs=tile_evs,
        cfa_code={name: cfa_code(sensor.responses[name]) for name in spec.filters if name in used},
        bit_depth=aps.bit_depth if aps else 1,
        black_level_dn=aps.black_level_dn if aps else 0.0,
        white_level_dn=min(top, round(aps.black_level_dn + aps.system_gain_dn_per_e * aps.full_well_e)) if aps else 1,
        system_gain_dn_per_e=aps.system_gain_dn_per_e if aps else 1.0,
        channels=channels,
        neutral=neutral,
        camera_to_srgb=to_srgb,
        xyz_to_camera=from_xyz,
        f_number=sensor.lens.f_number,
        focal_length_mm=sensor.lens.focal_length_mm,
        pitch_um=spec.geometry.pitch_um,
    )


def _colour_matrices(
    responses: list[Spectrum], light: Spectrum | None
) -> tuple[list[float], list[list[float]], list[list[float]]]:
    """Neutral, camera → linear sRGB, and XYZ → camera, by least squares over the 24 ColorChecker patches.

    The first two are for `light`, whose white maps to sRGB's white (Bradford adaptation); the third is for D65.
    """
    daylight = spectra.illuminant("D65")
    light = light or daylight
    neutral = responses_to(light, [constant(1.0)], responses)[0]
    if neutral.max() <= 0:  # light and sensor have no wavelength in common: nothing to balance
        light, neutral = daylight, responses_to(daylight, [constant(1.0)], responses)[0]
    patches = list(spectra.colorchecker_reflectances().values())
    white_d65 = tristimulus(daylight, [constant(1.0)])[0]
    if len(responses) == 1:
        return [1.0], [[1.0], [1.0], [1.0]], [(1.0 / np.full(3, white_d65.sum())).tolist()]
    camera = responses_to(light, patches, responses) / neutral
    xyz = tristimulus(light, patches)
    white = tristimulus(light, [constant(1.0)])[0]
    target = xyz_to_linear_srgb(xyz, white)
    # fit differences to the first channel, so that rows sum to 1 and neutral stays neutral
    free = _least_squares(camera[:, 1:] - camera[:, :1], target - camera[:, :1])
    to_srgb = np.vstack([1.0 - free.sum(axis=0), free]).T
    camera_d65 = responses_to(daylight, patches, responses)
    from_xyz = _least_squares(tristimulus(daylight, patches) / white_d65[1], camera_d65 / camera_d65.max())
    return (neutral / neutral.max()).tolist(), to_srgb.tolist(), from_xyz.T.tolist()


def _least_squares(inputs: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The solution to 12 decimals: further ones depend on the build of LAPACK, and with them the bytes of manifests."""
    return np.round(np.linalg.lstsq(inputs, target, rcond=None)[0], 12)
