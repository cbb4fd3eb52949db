"""The dead-leaves texture, and its autocovariance in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.specs.charts import DeadLeavesTarget
from hesim_render.targets.piece import Picture, TargetPiece, picture_piece, require_texels

#: Leaves drawn at a time.
_BATCH = 4096


def dead_leaves(target: DeadLeavesTarget) -> list[TargetPiece]:
    """Discs that hide each other, from the front to the back, until nothing is left uncovered.

    A texel has the grey of the front-most disc over its centre [cao2010]. Discs fall evenly on the target widened by
    the largest radius, so that the texture is the same everywhere.

    Raises
    ------
    SpecError
        If the picture would be too large.
    """
    texel = target.width_m / target.texels_across
    rows = int(np.ceil(target.height_m / texel))
    require_texels(rows, target.texels_across, "target.texels_across")
    values = leaves_picture(
        rows,
        target.texels_across,
        target.radius_min_m / texel,
        target.radius_max_m / texel,
        (target.reflectance_min, target.reflectance_max),
        target.seed,
    )
    height_part = target.height_m / (rows * texel)  # the lowest row of texels may stand over
    picture = Picture(values[..., None], "grey", interpolation="nearest")
    return [picture_piece("leaves", picture, target.width_m, target.height_m, (0.0, 1.0, 1.0 - height_part, 1.0))]


def leaves_picture(
    rows: int, cols: int, radius_min: float, radius_max: float, greys: tuple[float, float], seed: int
) -> NDArray[np.float32]:
    """A dead-leaves texture, float32 [rows, cols].

    Parameters
    ----------
    rows, cols : size, texels.
    radius_min, radius_max : limits of the radii, texels; their density is proportional to r⁻³.
    greys : limits of the uniform law of the greys.
    seed : seed of the texture.
    """
    generator = np.random.default_rng(seed)
    picture = np.zeros((rows, cols), dtype=np.float32)
    free = np.ones((rows, cols), dtype=bool)
    left = rows * cols
    while left:
        u = generator.random(_BATCH)
        # the distribution function of r⁻³ is linear in r⁻²
        radius = (radius_min**-2 - u * (radius_min**-2 - radius_max**-2)) ** -0.5
        x = generator.uniform(-radius_max, cols + radius_max, _BATCH)
        y = generator.uniform(-radius_max, rows + radius_max, _BATCH)
        grey = generator.uniform(*greys, _BATCH).astype(np.float32)
        for k in range(_BATCH):
            first_col, last_col = max(0, int(x[k] - radius[k])), min(cols, int(x[k] + radius[k]) + 2)
            first_row, last_row = max(0, int(y[k] - radius[k])), min(rows, int(y[k] + radius[k]) + 2)
            if first_col >= last_col or first_row >= last_row:
                continue
            part = free[first_row:last_row, first_col:last_col]
            if not part.any():
                continue
            row, col = np.ogrid[first_row:last_row, first_col:last_col]
            new = part & ((col + 0.5 - x[k]) ** 2 + (row + 0.5 - y[k]) ** 2 < radius[k] ** 2)
            picture[first_row:last_row, first_col:last_col][new] = grey[k]
            part[new] = False
            left -= int(np.count_nonzero(new))
    return picture
