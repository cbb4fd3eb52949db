"""Colour profile of a camera: the ISP undoes it, an inverse pipeline applies it.

channel = (matrix⁻¹ · linear RGB) / white balance        DN = black + channel · (white - black)
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator, model_validator

from hesim_render.core.errors import RangeError
from hesim_render.mosaic.description import Mosaic
from hesim_render.specs.files import Strict, read_spec
from hesim_render.spectral import transfer as curves
from hesim_render.spectral.transfer import Transfer

#: Stands in a tile where a position gives no frame value.
NO_VALUE = "."


class Camera(Strict):
    """Tile, levels, white balance, matrix and transfer of a camera.

    Parameters
    ----------
    channels : names of the colours, in the order of `white_balance` and of the columns of `matrix`.
    tile : channel name of each position, [tile_row][tile_col]; ``.`` where there is no frame value. In a file
        also as text: one line per row, names separated by spaces.
    stands_for : as `tile`: the channel that a position without a value is filled with. Default: the channel
        of its 2×2 cell (a hole in a quad cell).
    black_level_dn, white_level_dn : levels of RAW data, DN; a pixel saturates at the white level.
    white_balance : gain of each channel that makes white equal in all channels.
    matrix : [3][channel], from balanced channels to linear RGB.
    transfer, gamma : from linear RGB to the values of the picture.
    """

    channels: list[str] = Field(min_length=1)
    tile: list[list[str]]
    stands_for: list[list[str]] | None = None
    black_level_dn: float = 0.0
    white_level_dn: float
    white_balance: list[float]
    matrix: list[list[float]]
    transfer: Transfer = "srgb"
    gamma: float = Field(2.2, gt=0)

    @field_validator("tile", "stands_for", mode="before")
    @classmethod
    def _rows_of_text(cls, given: Any) -> Any:
        return [line.split() for line in given.splitlines() if line.strip()] if isinstance(given, str) else given

    @model_validator(mode="after")
    def _consistent(self) -> "Camera":
        count = len(self.channels)
        if len(set(self.channels)) != count or NO_VALUE in self.channels:
            raise ValueError(f"channels: names must differ, and {NO_VALUE!r} is not a name")
        for key, tile in (("tile", self.tile), ("stands_for", self.stands_for)):
            if tile is None:
                continue
            if not tile or not tile[0] or len({len(row) for row in tile}) > 1:
                raise ValueError(f"{key}: rows must be of one length, at least 1")
            for name in {name for row in tile for name in row} - {*self.channels, NO_VALUE}:
                raise ValueError(f"{key}: {name!r} is not one of the channels {', '.join(self.channels)}")
        if self.stands_for is not None and np.shape(self.stands_for) != np.shape(self.tile):
            raise ValueError("stands_for: must have the shape of tile")
        for name in set(self.channels) - {name for row in self.tile for name in row}:
            raise ValueError(f"tile: channel {name!r} does not occur")
        if self.white_level_dn <= self.black_level_dn:
            raise ValueError("white_level_dn: must be above black_level_dn")
        if len(self.white_balance) != count or min(self.white_balance) <= 0:
            raise ValueError(f"white_balance: expected {count} positive gains, one per channel")
        if np.shape(self.matrix) != (3, count):
            raise ValueError(f"matrix: expected 3 rows of {count} numbers")
        return self

    @classmethod
    def of(cls, mosaic: Mosaic) -> "Camera":
        """The camera that the mosaic of a recording describes. Balance and matrix are those for the light of the scene.

        Parameters
        ----------
        mosaic : from `Recording.mosaic`.

        Returns
        -------
        The camera.

        Raises
        ------
        RangeError
            If the sensor has no frame pixels.
        """
        names = [
            [name if aps else NO_VALUE for name, aps in zip(*rows, strict=True)]
            for rows in zip(mosaic.tile_filter, mosaic.tile_aps, strict=True)
        ]
        seen = {name for row in names for name in row if name != NO_VALUE}
        if not seen:
            raise RangeError("sensor", mosaic.sensor, "one with frame pixels")
        cells = _cell_channels(names)
        stands_for = [
            [name if name in seen else cells[i][j] for j, name in enumerate(row)]
            for i, row in enumerate(mosaic.tile_filter)
        ]
        neutral = np.array(mosaic.neutral)
        return cls(
            channels=mosaic.channels,
            tile=names,
            stands_for=stands_for,
            black_level_dn=mosaic.black_level_dn,
            white_level_dn=mosaic.white_level_dn,
            white_balance=(neutral.max() / np.maximum(neutral, 1e-3 * neutral.max())).tolist(),
            matrix=mosaic.camera_to_srgb,
        )

    @property
    def tile_channel(self) -> NDArray[np.int64]:
        """Channel number of each tile position, [tile_row, tile_col]; -1 where there is no frame value."""
        return self._numbers(self.tile)

    @property
    def filled_tile(self) -> NDArray[np.int64]:
        """As `tile_channel` after holes are filled; -1 remains where no channel is known."""
        return self._numbers(self.stands_for if self.stands_for is not None else _cell_channels(self.tile))

    def _numbers(self, tile: list[list[str]]) -> NDArray[np.int64]:
        return np.array([[-1 if name == NO_VALUE else self.channels.index(name) for name in row] for row in tile])

    def to_linear(self, channels: ArrayLike) -> NDArray[np.float64]:
        """Linear RGB of channel values.

        Parameters
        ----------
        channels : [..., channel], black 0, saturation 1.

        Returns
        -------
        [..., 3], linear RGB.
        """
        return np.asarray(channels) * self.white_balance @ np.array(self.matrix).T

    def from_linear(self, linear: ArrayLike) -> NDArray[np.float64]:
        """Channel values of linear RGB, the inverse of `to_linear`; not clipped.

        Parameters
        ----------
        linear : [..., 3], linear RGB.

        Returns
        -------
        [..., channel], black 0, saturation 1.

        Raises
        ------
        RangeError
            If the camera does not have three channels that the matrix can tell apart.
        """
        matrix = np.array(self.matrix)
        if matrix.shape != (3, 3) or np.linalg.cond(matrix) > 1e6:
            raise RangeError("matrix", self.matrix, "one of 3x3 that can be inverted")
        return np.asarray(linear) @ np.linalg.inv(matrix).T / self.white_balance

    def decode(self, picture: ArrayLike) -> NDArray[np.float64]:
        """Linear RGB of picture values.

        Parameters
        ----------
        picture : values in [0, 1], any shape.

        Returns
        -------
        Linear values, same shape.
        """
        return curves.decode(picture, self.transfer, self.gamma)


def _cell_channels(tile: list[list[str]]) -> list[list[str]]:
    """The tile with holes replaced by the channel that the rest of their 2×2 cell agrees on, if it does."""
    out = [list(row) for row in tile]
    for i, j in np.argwhere(np.array(tile) == NO_VALUE):
        top, left = i // 2 * 2, j // 2 * 2
        cell = {name for row in tile[top : top + 2] for name in row[left : left + 2]} - {NO_VALUE}
        if len(cell) == 1:
            out[i][j] = cell.pop()
    return out


def load_camera(file: str | Path) -> Camera:
    """Read a camera from a YAML file.

    Parameters
    ----------
    file : the file.

    Returns
    -------
    The camera.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    return read_spec(Camera, Path(file))
