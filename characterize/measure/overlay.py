"""Registration of a micrograph to the mask: the drawn pillar of each measured pillar,
its error, and the bias table of the process.
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from characterize.measure.lattice import ImageLattice
from characterize.measure.sem import MeasuredDiameters
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.lens import DiameterMap

Table = list[
    tuple[float, float, float, int]
]  # drawn nm, measured less drawn nm, its standard error, pillars
# scatter at the best place over that at the next best, below which it is clear
_CLEAR = 0.7
_LEAST = 12  # least number of good pillars
OUTLIER = 4.0  # error of an outlier, robust sigma
SCALE = 0.005  # largest scale error of the lattice: 1 nm on a pillar of 200


@dataclass(frozen=True, eq=False, slots=True)
class MaskOverlay:
    """Measured pillars registered to the mask.

    designed_nm, error_nm: (p,) drawn diameter, and measured less drawn; nan where
    unknown.
    row, column: place on the mask of the lattice's pillar (0, 0).
    site: (p, 2) row and column of every pillar on the mask.
    clearly: whether the place is unambiguous.
    outlier: (p,) error beyond ``OUTLIER`` robust sigma.
    """

    designed_nm: Array
    error_nm: Array
    row: int
    column: int
    site: Array
    clearly: bool
    outlier: Array


def overlay_design(measured: MeasuredDiameters, design: DiameterMap) -> MaskOverlay:
    """Place of a micrograph on the mask: the shift by whole sites at which measured
    diameters scatter least about a line in the drawn ones.

    A constant bias, or one proportional to the diameter, does not matter. The picture's
    +x is taken as the mask's, to half the angle between two rows of the lattice.

    Args:
        measured: pillars of the micrograph.
        design: drawn diameters.

    Raises:
        CaptureError: fewer than twelve good pillars, a lattice that is not the design's
            or lies across it, or more
            pillars than it has.
    """
    good = np.isfinite(measured.diameter_nm)
    if good.sum() < _LEAST:
        raise CaptureError(
            f"{int(good.sum())} good pillars; need {_LEAST} or more to find them on the design"
        )
    on_mask = measured.site @ site_steps(measured.lattice, design)
    first = on_mask.min(0)
    site = on_mask - first
    patch = np.zeros(site.max(0) + 1)
    weight = np.zeros_like(patch)
    patch[tuple(site[good].T)] = measured.diameter_nm[good]
    weight[tuple(site[good].T)] = 1.0
    drawn = np.asarray(design.diameter_um, float) * 1e3
    if (np.array(patch.shape) > drawn.shape).any():
        raise CaptureError(
            f"the picture holds {patch.shape} sites, the design {drawn.shape}"
        )
    for _ in range(
        2
    ):  # the second time without outliers: one fallen pillar outweighs all noise
        scatter = _scatter(patch, weight, drawn)
        row, column = (
            int(i) for i in np.unravel_index(int(np.argmin(scatter)), scatter.shape)
        )
        designed = drawn[site[:, 0] + row, site[:, 1] + column]
        designed = np.where(designed > 0, designed, np.nan)
        error = measured.diameter_nm - designed
        median = np.nanmedian(error)
        spread = 1.4826 * float(np.nanmedian(np.abs(error - median)))
        outlier = np.nan_to_num(np.abs(error - median), nan=0.0) > OUTLIER * max(
            spread, 0.5
        )
        weight[tuple(site[outlier].T)] = 0.0
    ordered = np.sort(scatter[np.isfinite(scatter)])
    is_clear = len(ordered) == 1 or float(ordered[0]) < _CLEAR * float(ordered[1])
    row, column = row - int(first[0]), column - int(first[1])
    return MaskOverlay(
        designed,
        error,
        row,
        column,
        on_mask + np.array([row, column]),
        bool(is_clear),
        outlier,
    )


def site_steps(lattice: ImageLattice, design: DiameterMap) -> Array:
    """(2, 2) steps in rows and columns of the mask: of lattice index j, then of i.

    The picture's vectors are scaled to the mask's cell area and rounded to whole sites.

    Args:
        lattice: of the picture.
        design: what was drawn.

    Raises:
        CaptureError: another kind of lattice, or rows that lie across the mask's.
    """
    kind = design.lattice.kind
    if lattice.kind != kind:
        raise CaptureError(
            f"the picture shows a {lattice.kind} lattice, the design is {kind}"
        )
    vectors = np.stack([lattice.b, lattice.a])
    steps_um = np.array(design.steps_um[::-1])
    vectors = vectors * np.sqrt(design.site_um2 / abs(np.linalg.det(vectors)))
    steps = np.rint(vectors / steps_um)
    lengths, expected_lengths = (
        np.linalg.norm(vector, axis=1) for vector in (vectors, steps * steps_um)
    )
    one_cell = np.isclose(abs(np.linalg.det(steps)), 2 if design.lattice.centred else 1)
    if not one_cell or (np.abs(lengths - expected_lengths) > 0.05 * lengths).any():
        raise CaptureError(
            f"rows of this {kind} lattice do not lie in the picture as on the mask (+x right, +y down); turn it"
        )
    return np.asarray(steps, int)


def lattice_scale(
    measured: MeasuredDiameters, pixel_nm: float, design: DiameterMap
) -> float:
    """Lattice constant in the picture over that of the mask: the factor by which the
    stated pixel is too large.

    It is sqrt |det J| of a least-squares fit (row, column) = origin + J (j, i) to the
    good pillars, over the mask's. Masks are true to parts in a million, pixels of
    microscopes to per cent. Accuracy: 4e-4 for five pillars a side.

    Args:
        measured: pillars of the micrograph.
        pixel_nm: stated pixel, nm.
        design: what was drawn.
    """
    good = np.isfinite(measured.diameter_nm)
    sites = np.column_stack([measured.site[good], np.ones(int(good.sum()))])
    jacobian = np.linalg.lstsq(
        sites, np.column_stack([measured.row[good], measured.column[good]]), rcond=None
    )[0][:2]
    return float(
        np.sqrt(abs(np.linalg.det(jacobian)) / design.site_um2) * pixel_nm / 1e3
    )


def bias_table(overlay_fit: MaskOverlay, *, knots: int = 7) -> Table:
    """Rows (drawn nm, measured less drawn nm, its standard error, pillars) over groups
    of equally many pillars by drawn diameter, without outliers.

    Args:
        overlay_fit: the micrograph's pillars on the mask.
        knots: rows of the table at most.

    Raises:
        CaptureError: fewer than twelve pillars to take it from.
    """
    good = np.isfinite(overlay_fit.error_nm) & ~overlay_fit.outlier
    if good.sum() < _LEAST:
        raise CaptureError(
            f"{int(good.sum())} pillars on the design; need {_LEAST} or more for a bias table"
        )
    order = np.argsort(overlay_fit.designed_nm[good], kind="stable")
    drawn = overlay_fit.designed_nm[good][order]
    error = overlay_fit.error_nm[good][order]
    rows = []
    for part in np.array_split(
        np.arange(len(drawn)), max(1, min(knots, len(drawn) // 6))
    ):
        spread = float(error[part].std(ddof=1))  # of six pillars at least
        rows.append(
            (
                float(drawn[part].mean()),
                float(error[part].mean()),
                spread / len(part) ** 0.5,
                len(part),
            )
        )
    return rows


def _scatter(patch: Array, mask: Array, drawn: Array) -> Array:
    """Variance of measured diameters about a line in the drawn ones, at every shift of
    the patch on the design; inf where a pillar lies off the design.

    Least squares of measured = a + b drawn, b limited to 2/3 to 4/3, by convolutions.

    Args:
        patch: (j, i) measured diameters in nm, 0 without one.
        mask: (j, i) 1 where measured, else 0.
        drawn: (y, x) drawn diameters in nm, 0 without a pillar.
    """
    flipped = (patch * mask)[::-1, ::-1]
    weight = mask[::-1, ::-1]
    count = mask.sum()

    def mean_of(map_values: Array, kernel: Array) -> Array:
        return np.asarray(signal.fftconvolve(map_values, kernel, mode="valid") / count)

    measured = patch[mask > 0]
    level = mean_of(drawn, weight)
    spread = np.maximum(mean_of(drawn**2, weight) - level**2, 1e-9)
    covariance = mean_of(drawn, flipped) - level * measured.mean()
    slope = np.clip(covariance / spread, 2 / 3, 4 / 3)
    variance = measured.var() - 2 * slope * covariance + slope**2 * spread
    all_drawn = mean_of((drawn > 0).astype(float), weight) > 1 - 0.5 / count
    return np.where(all_drawn, np.maximum(variance, 0), np.inf)
