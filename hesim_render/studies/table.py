"""A table of results: named columns, and files of it.

What the columns of a study are called in tables for people, and which of them know the noise.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import OutputError, RangeError, did_you_mean
from hesim_render.core.output import free_place, replacing

#: Value of a cell: None where a figure has no meaning.
Cell = str | float | int | bool | None


class Table:
    """Rows with named columns, much as a data frame.

    Parameters
    ----------
    rows : dictionaries; columns are in the order in which they first occur, and cells that a row lacks are None.

    Examples
    --------
    >>> from hesim_render.studies import Table
    >>> table = Table([{"set": "rggb", "ysnr": 30.0}, {"set": "ryyb", "ysnr": 34.0}])
    >>> len(table), table.columns, table["ysnr"].tolist()
    (2, ['set', 'ysnr'], [30.0, 34.0])
    >>> table.where(set="ryyb").row(0)
    {'set': 'ryyb', 'ysnr': 34.0}
    """

    def __init__(self, rows: Iterable[Mapping[str, Cell]]) -> None:
        self._rows = [dict(row) for row in rows]
        self._columns = list(dict.fromkeys(name for row in self._rows for name in row))

    @property
    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(self._columns)

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[dict[str, Cell]]:
        return (self.row(number) for number in range(len(self)))

    def __repr__(self) -> str:
        return f"<Table: {len(self)} rows of {len(self._columns)} columns>"

    def __getitem__(self, column: str) -> NDArray:
        """A column: float64 with NaN for None where all others are numbers, else objects.

        Raises
        ------
        RangeError
            If there is no such column.
        """
        self._require(column)
        cells = [row.get(column) for row in self._rows]
        if all(cell is None or (isinstance(cell, int | float) and not isinstance(cell, bool)) for cell in cells):
            return np.array([math.nan if cell is None else cell for cell in cells], dtype=np.float64)
        return np.array(cells, dtype=object)

    def row(self, number: int) -> dict[str, Cell]:
        """One row with all columns; negative numbers count from the end."""
        return {name: self._rows[number].get(name) for name in self._columns}

    def where(self, **cells: Cell) -> "Table":
        """The rows whose cells have given values, as a new table.

        Parameters
        ----------
        cells : wanted value of each named column.

        Raises
        ------
        RangeError
            If there is no such column.
        """
        for name in cells:
            self._require(name)
        return Table(row for row in self if all(row[name] == wanted for name, wanted in cells.items()))

    def to_csv(self) -> str:
        """The table as CSV text (RFC 4180); numbers keep all digits, None is empty."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self._columns)
        for row in self:
            writer.writerow(
                ["" if cell is None else repr(cell) if isinstance(cell, float) else cell for cell in row.values()]
            )
        return text.getvalue()

    def to_json(self, **more: Any) -> str:
        """The table as JSON text: a list of rows under ``rows``, beside `more` entries; infinities become texts."""
        return json.dumps({**more, "columns": self._columns, "rows": [_plain(row) for row in self]}, indent=1) + "\n"

    def to_pandas(self) -> Any:
        """The table as a pandas data frame.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise OutputError("pandas is not installed; use to_csv or the columns themselves") from None
        return pandas.DataFrame({name: self[name] for name in self._columns})

    def write(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the table as a file, whole or not at all; the end of its name tells the kind.

        Parameters
        ----------
        path : ends in ``.csv``, ``.json`` or ``.parquet``.
        overwrite : replace a file that is there.

        Raises
        ------
        OutputError
            If the kind is unknown, the file cannot be written, or pyarrow is missing for a Parquet file.
        """
        target = free_place(path, overwrite)
        kind = target.suffix.lower()
        if kind not in (".csv", ".json", ".parquet"):
            raise OutputError(f"{path}: a table is written as .csv, .json or .parquet")
        with replacing(target) as unfinished:
            if kind == ".parquet":
                self._write_parquet(unfinished)
            else:
                unfinished.write_text(self.to_csv() if kind == ".csv" else self.to_json(), encoding="utf-8")
        return target

    def _write_parquet(self, path: Path) -> None:
        if not has_parquet():
            raise OutputError("Parquet files need pyarrow: pip install pyarrow")
        import pyarrow
        from pyarrow import parquet

        parquet.write_table(pyarrow.table({name: [row[name] for row in self] for name in self._columns}), path)

    def _require(self, column: str) -> None:
        if column not in self._columns:
            raise RangeError("column", column, f"one of the table's{did_you_mean(column, self._columns)}")


def has_parquet() -> bool:
    """True if Parquet files can be written."""
    import importlib.util

    return importlib.util.find_spec("pyarrow") is not None


def _plain(row: Mapping[str, Cell]) -> dict[str, Cell]:
    return {
        name: str(cell) if isinstance(cell, float) and not math.isfinite(cell) else cell for name, cell in row.items()
    }


#: Figures with the noise of their row: the matrix is that of the least squared error at this light and exposure.
NOISE_AWARE = {
    "ysnr_noise_aware": "YSNR", "ysnr_noise_aware_simulated": "YSNR simulated", "snr10_lux_noise_aware": "SNR10, lx",
    "delta_e_mean_noise_aware": "ΔE2000", "delta_e_noisy_noise_aware_simulated": "ΔE2000 of noisy pixels",
    "noise_amplification_noise_aware": "amplification",
}  # fmt: skip
#: The same with the matrix of colour, which is fitted without noise.
NOISE_FREE = {
    "ysnr": "YSNR", "ysnr_simulated": "YSNR simulated", "snr10_lux": "SNR10, lx",
    "delta_e_noisy_simulated": "ΔE2000 of noisy pixels", "noise_amplification": "amplification",
}  # fmt: skip
#: Levels.
LEVELS = {"white_saturation": "white / saturation", "dynamic_range_db": "DR, dB"}
#: What the words mean.
NOTE = (
    "Noise-aware: with the matrix of the least squared error, noise of this light and exposure included; the fair one "
    "to compare filter sets. Noise-free: with the matrix of the least colour error, fitted as if there was no noise. "
    "CLIPPED: a perfect white is above saturation; closed forms do not know that, simulated figures do. These "
    "also have intervals: `noise: {repeats: 8}` in the file of the study adds them."
)


def level_text(row: Mapping[str, Cell], text: str) -> str:
    """The text of ``white_saturation``, with a flag where a perfect white clips."""
    return f"{text} CLIPPED" if row.get("white_clipped") else text
