"""Charts for resolution: edges, star, wedges, zone plate, and dead leaves with their autocovariance in closed form."""

from math import cos, pi, radians, sin, tan

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import SpecError
from hesim_render.specs.charts import (
    DeadLeavesTarget,
    EdgeFieldTarget,
    ResolutionWedgesTarget,
    SiemensStarTarget,
    SlantedEdgeTarget,
    ZonePlateTarget,
)
from hesim_render.targets.piece import (
    Picture,
    TargetPiece,
    around,
    box,
    patch_boxes,
    picture_piece,
    polygons_piece,
    require_texels,
)

#: Largest angle of one straight piece of the rim of a Siemens star; its sagitta is 4e-6 of the diameter.
_RIM_STEP_RAD = radians(0.5)
#: Texels per period of the finest rings of a zone plate. Between texels the reflectance is linear, so that at this
#: frequency the amplitude is too small by (π/24)²/3 = 0.6 % on average over places.
_TEXELS_PER_CYCLE = 24
#: Leaves drawn at a time.
_BATCH = 4096


def slanted_edge(target: SlantedEdgeTarget) -> list[TargetPiece]:
    """One edge through the centre, turned clockwise from the vertical: its upper end leans to the right."""
    w, h = target.width_m / 2, target.height_m / 2
    lean = tan(radians(target.angle_deg))
    ends = [(x, y) for x, y in ((-lean * h, -h), (lean * h, h)) if abs(x) <= w]
    if len(ends) == 2:
        (x0, _), (x1, _) = ends
        dark = [(-w, -h), (x0, -h), (x1, h), (-w, h)]
        light = [(x0, -h), (w, -h), (w, h), (x1, h)]
    else:  # with a large tilt the edge meets the left and right sides instead
        y = w / lean
        upper, lower = [(-w, -y), (w, y), (w, h), (-w, h)], [(-w, -h), (w, -h), (w, y), (-w, -y)]
        dark, light = (upper, lower) if lean > 0 else (lower, upper)
    return [
        polygons_piece("dark", target.dark.load(), [dark]),
        polygons_piece("light", target.light.load(), [light]),
    ]


def edge_field(target: EdgeFieldTarget) -> list[TargetPiece]:
    """Turned squares, each in a cell of its own."""
    cells = patch_boxes(target.rows, target.cols, target.width_m, target.height_m, 1.0)
    half = target.fill * min(target.width_m / target.cols, target.height_m / target.rows) / 2
    dark: list[ArrayLike] = []
    light: list[ArrayLike] = []
    for number, cell in enumerate(cells):
        angle = radians(-target.angle_deg[number % len(target.angle_deg)])
        turn = np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])
        square = np.array(box(-half, half, -half, half)) @ turn
        middle = np.array([(cell[0] + cell[1]) / 2, (cell[2] + cell[3]) / 2])
        dark.append(square + middle)
        limits = cell - np.repeat(middle, 2)
        light += [polygon + middle for polygon in map(np.asarray, around(square, *limits.tolist()))]
    return [polygons_piece("dark", target.dark.load(), dark), polygons_piece("light", target.light.load(), light)]


def siemens_star(target: SiemensStarTarget) -> list[TargetPiece]:
    """Sectors of a disc that fills the smaller side; the first dark one begins at the +x axis, counter-clockwise."""
    w, h = target.width_m / 2, target.height_m / 2
    radius = min(w, h)
    sectors = 2 * target.spokes
    per_sector = max(1, int(np.ceil(2 * pi / sectors / _RIM_STEP_RAD)))
    rim_angles = np.arange(sectors * per_sector + 1) * (2 * pi / (sectors * per_sector))
    dark: list[ArrayLike] = []
    light: list[ArrayLike] = []
    for sector in range(sectors):
        angles = rim_angles[sector * per_sector : (sector + 1) * per_sector + 1]
        rim = np.column_stack([np.cos(angles), np.sin(angles)]) * radius
        (dark if sector % 2 == 0 else light).append(np.vstack([[0.0, 0.0], rim]))
    corners = np.arctan2([h, h, -h, -h], [w, -w, -w, w]) % (2 * pi)
    outline = np.unique(np.concatenate([rim_angles[:-1], corners]))
    closed = np.append(outline, outline[0] + 2 * pi)
    for a, b in zip(closed[:-1], closed[1:], strict=True):
        # points between two rim points lie on the straight piece of the rim, so pieces do not overlap
        inner = [_on_rim(float(angle), rim_angles, radius) for angle in (a, b)]
        outer = [_on_rectangle(float(angle), w, h) for angle in (a, b)]
        light.append([inner[0], outer[0], outer[1], inner[1]])
    return [polygons_piece("dark", target.dark.load(), dark), polygons_piece("light", target.light.load(), light)]


def _on_rim(angle: float, rim_angles: NDArray, radius: float) -> tuple[float, float]:
    step = rim_angles[1] - rim_angles[0]
    middle = (np.floor(angle / step + 1e-9) + 0.5) * step
    reach = radius * cos(step / 2) / cos(angle - middle)
    return reach * cos(angle), reach * sin(angle)


def _on_rectangle(angle: float, half_width: float, half_height: float) -> tuple[float, float]:
    c, s = cos(angle), sin(angle)
    reach = min(half_width / max(abs(c), 1e-12), half_height / max(abs(s), 1e-12))
    return reach * c, reach * s


def resolution_wedges(target: ResolutionWedgesTarget) -> list[TargetPiece]:
    """Two wedges, each in a half of the target.

    Raises
    ------
    SpecError
        If a wedge is wider than its half.
    """
    half, height = target.width_m / 2, target.height_m
    stripes = 2 * target.lines - 1
    room = min(half, height)
    widest = max(target.line_wide_m, target.line_narrow_m) * stripes
    if widest >= 0.95 * room:
        raise SpecError(
            f"line_wide_m: {target.lines} lines of {target.line_wide_m:g} m are wider than the {0.95 * room:g} m for "
            "a wedge",
            key="target.line_wide_m",
        )
    dark, light = _wedge(half, height, target.line_wide_m, target.line_narrow_m, target.lines)
    # the right wedge is the left one turned clockwise, so that its lines are level
    other_dark, other_light = _wedge(height, half, target.line_wide_m, target.line_narrow_m, target.lines)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    shift = np.array([half / 2, 0.0])
    return [
        polygons_piece("dark", target.dark.load(), [p - shift for p in dark] + [p @ turn + shift for p in other_dark]),
        polygons_piece(
            "light", target.light.load(), [p - shift for p in light] + [p @ turn + shift for p in other_light]
        ),
    ]


def _wedge(
    width: float, height: float, wide: float, narrow: float, lines: int
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Dark lines and light rest of a wedge in a rectangle about the origin; the lines become narrower upwards."""
    stripes = 2 * lines - 1
    top = 0.45 * height
    at = np.arange(stripes + 1) - stripes / 2
    below, above = at * wide, at * narrow
    dark: list[NDArray[np.float64]] = []
    light: list[NDArray[np.float64]] = []
    for k in range(stripes):
        corners = [(below[k], -top), (below[k + 1], -top), (above[k + 1], top), (above[k], top)]
        (dark if k % 2 == 0 else light).append(np.array(corners))
    w, h = width / 2, height / 2
    light += [
        np.array([(-w, -top), (below[0], -top), (above[0], top), (-w, top)]),
        np.array([(below[-1], -top), (w, -top), (w, top), (above[-1], top)]),
        np.array(box(-w, w, -h, -top)),
        np.array(box(-w, w, top, h)),
    ]
    return dark, light


def zone_plate(target: ZonePlateTarget) -> list[TargetPiece]:
    """Sinusoidal rings as a picture with square texels.

    Raises
    ------
    SpecError
        If the picture would be too large.
    """
    # the finest rings are in the corners: their frequency is that of the side times the ratio of the distances
    w, h = target.width_m, target.height_m
    finest = target.cycles * float(np.hypot(w, h)) / w
    cols = int(np.ceil(_TEXELS_PER_CYCLE * finest))
    rows = int(np.ceil(cols * h / w))
    require_texels(rows, cols, "target.cycles")
    x = (np.arange(cols) + 0.5) / cols - 0.5
    y = (0.5 - (np.arange(rows) + 0.5) / rows) * h / w
    phase = 2 * pi * target.cycles * (x[None, :] ** 2 + y[:, None] ** 2)
    middle = (target.reflectance_max + target.reflectance_min) / 2
    values = middle + (target.reflectance_max - target.reflectance_min) / 2 * np.cos(phase)
    return [picture_piece("rings", Picture(values.astype(np.float32)[..., None], "grey"), w, h)]


def dead_leaves(target: DeadLeavesTarget) -> list[TargetPiece]:
    """Discs that occlude each other, from the front to the back, until nothing is left uncovered.

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
