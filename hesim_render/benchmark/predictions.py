"""Results of a user for the tasks of a benchmark: a folder of arrays or pictures, one file for each item."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.guard import WholeFile, inside, reading
from hesim_render.core.npz import read_array

#: Formats of grey and of RGB pictures, as FFmpeg decodes PNG, and those to which they are unpacked here.
_PNG = {"gray": "gray", "gray16be": "gray16le", "rgb24": "rgb24", "rgb48be": "rgb48le"}


class Predictions:
    """A folder ``TASK/CLIP/000000.npy``, or ``.png`` where results are in DN; see `evaluate_benchmark` for the numbers.

    Parameters
    ----------
    folder : the folder.
    tasks, clips : names that its folders may have.

    Raises
    ------
    SpecError
        If it is missing or empty, or has a folder that is no task or no clip.
    """

    def __init__(self, folder: str | Path, tasks: Collection[str], clips: Collection[str]) -> None:
        self._root = Path(folder).expanduser()
        if not self._root.is_dir():
            raise SpecError("no such folder", file=folder)
        self._waiting = {
            path.relative_to(self._root).as_posix()
            for path in self._root.glob("*/*/*")
            if path.suffix in (".npy", ".png")
        }
        if not self._waiting:
            raise SpecError("has no results; expected TASK/CLIP/000000.npy or .png", file=folder)
        for name in sorted(self._waiting):
            task, clip, _ = name.split("/")
            for given, known, what in ((task, tasks, "task"), (clip, clips, "clip of these")):
                if given not in known:
                    raise SpecError(f"{given!r} is no {what}{did_you_mean(given, known)}", file=self._root / name)

    def read(
        self, task: str, clip: str, item: int, shape: tuple[int, ...], full_scale_dn: int | None = None
    ) -> NDArray[np.float64] | None:
        """The result for an item; None where there is none.

        A PNG of 16 bits holds DN, as `export` writes them; in one of 8 bits, 255 is the full scale.

        Parameters
        ----------
        task, clip, item : as in the scores.
        shape : that it must have.
        full_scale_dn : largest DN; None where results are not in DN, so that a picture has no unit.

        Raises
        ------
        SpecError
            If it is no array of numbers of this shape.
        """
        stem = f"{task}/{clip}/{item:06d}"
        names = [name for name in (f"{stem}.npy", f"{stem}.png") if name in self._waiting]
        if not names:
            return None
        path = inside(self._root, names[0])
        if len(names) > 1:
            raise SpecError("has a .png beside it; leave one of the two out", file=path)
        values = _picture(path, shape, full_scale_dn) if path.suffix == ".png" else read_array(path)
        if values.dtype.kind not in "biuf" or values.shape != shape:
            expected = f"numbers {list(shape)}"
            raise SpecError(f"holds {values.dtype} {list(values.shape)}; expected {expected}", file=path)
        self._waiting.discard(names[0])
        return values.astype(np.float64)

    @property
    def unused(self) -> list[str]:
        """Files that belong to no item that was scored, in order."""
        return sorted(self._waiting)


def _picture(path: Path, shape: tuple[int, ...], full_scale_dn: int | None) -> NDArray[np.float64]:
    """A grey or RGB PNG of 8 or 16 bits, DN."""
    import av

    if full_scale_dn is None:
        raise SpecError("a picture has no unit in this task; give an .npy file", file=path)
    WholeFile(path).checked()
    with reading(path, "as a PNG picture"), av.open(str(path), format="png_pipe") as container:
        stream = container.streams.video[0]
        given = f"a PNG of {stream.height} rows, {stream.width} columns, format {stream.pix_fmt}"
        if (stream.height, stream.width) != shape[:2] or stream.pix_fmt not in _PNG:
            expected = (
                f"{'grey' if len(shape) == 2 else 'RGB'} of 8 or 16 bits, {list(shape)}, without alpha or palette"
            )
            raise SpecError(f"holds {given}; expected {expected}", file=path)
        values = next(container.decode(stream)).to_ndarray(format=_PNG[stream.pix_fmt])
    scale = full_scale_dn / 255 if values.dtype == np.uint8 else 1.0
    return values.astype(np.float64) * scale
