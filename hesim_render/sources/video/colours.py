"""Meaning of a video's numbers: transfer, primaries, YUV matrix and range, from its tags or given."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.spectral.transfer import InputTransfer

Primaries = Literal["bt709", "bt2020", "p3", "smpte170m", "bt470bg"]
YuvMatrix = Literal["rgb", "bt709", "bt601", "bt2020", "smpte240m"]
Range = Literal["full", "limited"]

#: Codes of ITU-T H.273 as files carry them: transfer (with its gamma), primaries and matrix.
_TRANSFER_OF_CODE: dict[int, tuple[InputTransfer, float | None]] = {
    1: ("bt709", None), 4: ("gamma", 2.2), 5: ("gamma", 2.8), 6: ("bt709", None), 8: ("linear", None),
    13: ("srgb", None), 14: ("bt709", None), 15: ("bt709", None), 16: ("pq", None), 18: ("hlg", None),
}  # fmt: skip
_PRIMARIES_OF_CODE: dict[int, Primaries] = {
    1: "bt709", 5: "bt470bg", 6: "smpte170m", 7: "smpte170m", 9: "bt2020", 12: "p3",
}  # fmt: skip
_MATRIX_OF_CODE: dict[int, YuvMatrix] = {
    0: "rgb", 1: "bt709", 5: "bt601", 6: "bt601", 7: "smpte240m", 9: "bt2020",
}  # fmt: skip
_RANGE_OF_CODE: dict[int, Range] = {1: "limited", 2: "full"}
#: K_R and K_B of each matrix, H.273 table 4.
_WEIGHTS = {
    "bt709": (0.2126, 0.0722), "bt601": (0.299, 0.114), "bt2020": (0.2627, 0.0593), "smpte240m": (0.212, 0.087),
}  # fmt: skip
#: Chromaticities (x, y) of red, green and blue, H.273 table 2; white is D65 in all.
_CHROMATICITIES = {
    "bt709": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    "bt2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "p3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "smpte170m": ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),
    "bt470bg": ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06)),
}
_D65 = (0.3127, 0.3290)
_GAMMA = 2.2


@dataclass(frozen=True)
class ColourTags:
    """Known properties of a video's colours; None is unknown.

    Parameters
    ----------
    transfer, gamma : from picture values to linear light, see `hesim_render.spectral.transfer.decode`.
    primaries : primaries of the RGB values.
    matrix : from YUV to RGB; ``rgb`` if the file holds RGB.
    range : full range of the codes, or 16 to 235 (of 8 bits).
    """

    transfer: InputTransfer | None = None
    gamma: float | None = None
    primaries: Primaries | None = None
    matrix: YuvMatrix | None = None
    range: Range | None = None

    @classmethod
    def of_codes(cls, transfer: int, primaries: int, matrix: int, range: int, file: str) -> "ColourTags":
        """Tags from the codes of ITU-T H.273 that video files hold.

        Raises
        ------
        SpecError
            For a code without a formula here; the message says what can be given instead.
        """
        for name, code, known in (
            ("transfer", transfer, {*_TRANSFER_OF_CODE, 0, 2}),
            ("primaries", primaries, {*_PRIMARIES_OF_CODE, 0, 2}),
            ("matrix", matrix, {*_MATRIX_OF_CODE, 2}),
            ("range", range, {*_RANGE_OF_CODE, 0}),
        ):
            if code not in known:
                raise SpecError(f"{name} code {code} of ITU-T H.273 is not supported", file=file)
        curve, gamma = _TRANSFER_OF_CODE.get(transfer, (None, None))
        return cls(
            curve, gamma, _PRIMARIES_OF_CODE.get(primaries), _MATRIX_OF_CODE.get(matrix), _RANGE_OF_CODE.get(range)
        )

    def with_given(self, **given: Any) -> "ColourTags":
        """The tags with given values in place of the file's; None keeps the file's value."""
        changes = {name: value for name, value in given.items() if value is not None}
        if "transfer" in changes and "gamma" not in changes:
            changes["gamma"] = None
        tags = replace(self, **changes)
        return replace(tags, gamma=_GAMMA) if tags.transfer == "gamma" and tags.gamma is None else tags

    def require(self, names: Sequence[str], file: str) -> None:
        """Raise `SpecError` that lists which of `names` are not known, and how to give them."""
        choices = {
            "transfer": "srgb, bt709, gamma, linear, pq or hlg",
            "primaries": "bt709, bt2020, p3, smpte170m or bt470bg",
            "matrix": "bt709, bt601, bt2020, smpte240m or rgb",
            "range": "limited or full",
        }
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise SpecError(
                f"colour tags are missing: {', '.join(missing)}; give them "
                f"({'; '.join(f'{name}: {choices[name]}' for name in missing)})",
                file=file,
            )

    def as_dict(self) -> dict[str, str | float | None]:
        return asdict(self)


def yuv_to_rgb(matrix: YuvMatrix) -> NDArray[np.float64]:
    """[3][3], from Y (0 to 1), Cb and Cr (−½ to ½) to R'G'B'; ITU-T H.273 equations 38 to 43."""
    red, blue = _WEIGHTS[matrix]
    green = 1 - red - blue
    return np.array(
        [
            [1, 0, 2 * (1 - red)],
            [1, -2 * blue * (1 - blue) / green, -2 * red * (1 - red) / green],
            [1, 2 * (1 - blue), 0],
        ]
    )


def code_scale(bits: int, range: Range, chroma: bool = False) -> tuple[float, float]:
    """(offset, scale): value = (code - offset) · scale; luma and RGB 0 to 1, chroma −½ to ½ (H.273 eqs. 20 to 30)."""
    top, unit = 2**bits - 1, 2.0 ** (bits - 8)
    if chroma:
        return 128 * unit, (1 / top if range == "full" else 1 / (224 * unit))
    return (0.0, 1 / top) if range == "full" else (16 * unit, 1 / (219 * unit))


def to_linear_srgb(primaries: Primaries) -> NDArray[np.float64]:
    """[3][3], linear RGB of these primaries to linear sRGB (BT.709 primaries); white stays white."""
    return np.asarray(np.linalg.solve(_rgb_to_xyz("bt709"), _rgb_to_xyz(primaries)), dtype=np.float64)


def _rgb_to_xyz(primaries: Primaries) -> NDArray[np.float64]:
    """SMPTE RP 177: columns are the primaries' XYZ, scaled so that they add up to white."""
    columns = np.array([(x / y, 1.0, (1 - x - y) / y) for x, y in (*_CHROMATICITIES[primaries], _D65)]).T
    return np.asarray(columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3]))
