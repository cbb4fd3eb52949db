"""The lens and the pixel aperture: from radiance in the scene to photo-electrons per second."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import M_PER_UM, MM_PER_M, photons_per_joule
from hesim_render.mosaic.layout import Layout
from hesim_render.specs.lens import IlluminationTable
from hesim_render.specs.sensor import SensorSpec
from hesim_render.spectral.spectrum import INTEGRATION_STEP_NM, Spectrum, constant, merged_grid


@dataclass(frozen=True)
class Lens:
    """A lens in use: all optical parameters of a pixel's flux besides those of the pixel itself.

    Parameters
    ----------
    f_number : N.
    focal_length_mm : f, mm.
    magnification : m (only |m| matters); the image distance is f (1 + |m|).
    axis_mm : point where the optical axis meets the chip (the principal point), relative to the centre of the full
        sensor, mm: to the right and downwards in the image.
    off : effects of the lens that are switched off, such as ``distortion`` (`LensSpec.without`).
    """

    f_number: float
    focal_length_mm: float
    magnification: float
    axis_mm: tuple[float, float] = (0.0, 0.0)
    off: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        spec: SensorSpec,
        *,
        f_number: float | None = None,
        focal_length_mm: float | None = None,
        focus_distance_m: float | None = None,
        off: Iterable[str] = (),
    ) -> "Lens":
        """The lens of a sensor file, with a scene's own f-number, focal length and focus distance.

        A thin lens focused at distance d from its entrance pupil has |m| = f / (d − f).
        """
        focal = focal_length_mm or spec.lens.focal_length_mm
        magnification = spec.lens.magnification
        if magnification == "focus":
            distance = None if focus_distance_m is None else focus_distance_m * MM_PER_M
            magnification = 0.0 if distance is None or distance <= focal else focal / (distance - focal)
        return cls(f_number or spec.lens.f_number, focal, abs(float(magnification)), off=frozenset(off))

    @property
    def solid_angle_sr(self) -> float:
        """G = π / (1 + 4 N² (1 + |m|)²), so that image irradiance is E = G·τ·V·L (ISETCam's form of the
        camera equation; π/4N² is 1.6 % higher at f/4 and m = 0)."""
        return pi / (1 + 4 * self.f_number**2 * (1 + self.magnification) ** 2)

    @property
    def image_distance_mm(self) -> float:
        """Image distance f (1 + |m|), mm."""
        return self.focal_length_mm * (1 + self.magnification)

    @property
    def working_f_number(self) -> float:
        """N (1 + |m|): the image distance over the diameter of the pupil."""
        return self.f_number * (1 + self.magnification)

    @property
    def pupil_radius_m(self) -> float:
        """Half of f/N, m."""
        return self.focal_length_mm / (2 * self.f_number * MM_PER_M)

    @property
    def focus_distance_m(self) -> float:
        """Distance from the pupil to the plane in focus, f (1 + 1/|m|), m; infinite at m = 0."""
        if self.magnification == 0:
            return inf
        return self.focal_length_mm * (1 + 1 / self.magnification) / MM_PER_M


def pixel_centres_mm(layout: Layout) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Position of pixel centres on the chip from the full sensor's centre.

    Returns
    -------
    x_mm [col], to the right in the image; y_mm [row], downwards in the image.
    """
    geometry = layout.spec.geometry
    pitch_mm = geometry.pitch_um * 1e-3
    x = (layout.col0 + np.arange(layout.cols) + 0.5 - geometry.cols / 2) * pitch_mm
    y = (layout.row0 + np.arange(layout.rows) + 0.5 - geometry.rows / 2) * pitch_mm
    return x, y


def relative_illumination(layout: Layout, lens: Lens) -> NDArray[np.float32]:
    """V(x) at every pixel centre, [row, col]: cos⁴ of the chief ray's angle, a table, or 1."""
    row, col = np.ogrid[layout.row0 : layout.row0 + layout.rows, layout.col0 : layout.col0 + layout.cols]
    return relative_illumination_at(layout.spec, lens, row, col)


def relative_illumination_at(
    spec: SensorSpec, lens: Lens, row: NDArray[np.integer], col: NDArray[np.integer]
) -> NDArray[np.float32]:
    """V(x) at the centres of pixels of the full sensor, in the shape of `row` and `col` together."""
    geometry, kind = spec.geometry, spec.lens.without(lens.off).relative_illumination
    pitch_mm = geometry.pitch_um * 1e-3
    x, y = (
        (place + 0.5 - count / 2) * pitch_mm - axis
        for place, count, axis in zip((col, row), (geometry.cols, geometry.rows), lens.axis_mm, strict=True)
    )
    squared = x**2 + y**2
    if isinstance(kind, IlluminationTable):
        return np.interp(np.sqrt(squared), kind.image_height_mm, kind.illumination_rel).astype(np.float32)
    if kind == "none":
        return np.ones(squared.shape, dtype=np.float32)
    # not `** -2`, which takes ten times as long
    return np.reciprocal(np.square(1 + squared / lens.image_distance_mm**2)).astype(np.float32)


def response(spec: SensorSpec, filter_name: str, lens: Lens) -> Spectrum:
    """P_c(λ)·C_f(λ) of Eq. 1 on the optical axis, e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹, on a grid of 1 nm or finer.

    A_pix · FF · G · τ_lens(λ) · C_f(λ) · η(λ) · λ/(h c).
    """
    geometry = spec.geometry
    area_m2 = (geometry.pitch_um * M_PER_UM) ** 2
    electrons_per_photon = spec.filter_response(filter_name)
    # multiply by λ on the refined grid, because the product is not linear between the table's own points
    grid = merged_grid(
        electrons_per_photon, constant(1.0, *electrons_per_photon.support_nm), step_nm=INTEGRATION_STEP_NM
    )
    scale = area_m2 * geometry.fill_factor * lens.solid_angle_sr
    return Spectrum(grid, scale * electrons_per_photon.at(grid) * photons_per_joule(grid))
