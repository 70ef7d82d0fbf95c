"""Micrograph on design: which pillar of the mask each measured one is, its error, and
the bias table of the process.
"""

import dataclasses
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
]  # drawn nm, made less drawn nm, its standard error, pillars
# scatter of the best place over that of the next best: below, the place is sure
_CLEAR = 0.7
_LEAST = 12  # pillars
OUTLIER = 4.0  # robust sigma
SCALE = 0.005  # of the lattice against the mask's: 1 nm on a pillar of 200


@dataclass(frozen=True, eq=False, slots=True)
class MaskOverlay:
    """Measured pillars beside the design.

    designed_nm, error_nm: (p,) nan where unknown. row, column: index of the pillar (0,
    0) of the lattice on the mask.
    site: (p, 2) row and column of every pillar on the mask. clearly: whether the place
    on the mask is beyond doubt.
    outlier: (p,) error beyond ``OUTLIER`` robust sigma.
    """

    designed_nm: Array
    error_nm: Array
    row: int
    column: int
    site: Array
    clearly: bool
    outlier: Array


def overlay_design(found: MeasuredDiameters, design: DiameterMap) -> MaskOverlay:
    """Lay measured pillars on the design: the shift of whole sites where design and
    measurement differ most evenly.

    A bias that is the same everywhere, or goes with the diameter, plays no part.
    The picture's +x is taken as the mask's, to half the angle between two rows of the
    lattice.

    Args:
        found: pillars of the micrograph.

    Raises:
        CaptureError: fewer than twelve good pillars, a lattice that is not the design's
            or lies across it, or more
            pillars than it has.
    """
    good = np.isfinite(found.diameter_nm)
    if good.sum() < _LEAST:
        raise CaptureError(
            f"{int(good.sum())} good pillars; need {_LEAST} or more to find them on the design"
        )
    on_mask = found.site @ _steps(found.lattice, design)
    first = on_mask.min(0)
    site = on_mask - first
    patch = np.zeros(site.max(0) + 1)
    mask = np.zeros_like(patch)
    patch[tuple(site[good].T)], mask[tuple(site[good].T)] = found.diameter_nm[good], 1.0
    drawn = np.asarray(design.diameter_um, float) * 1e3
    if (np.array(patch.shape) > drawn.shape).any():
        raise CaptureError(
            f"the picture holds {patch.shape} sites, the design {drawn.shape}"
        )
    for _ in range(
        2
    ):  # again without what went wrong: one fallen pillar is as much as all noise
        scatter = _scatter(patch, mask, drawn)
        row, column = (
            int(i) for i in np.unravel_index(int(np.argmin(scatter)), scatter.shape)
        )
        designed = drawn[site[:, 0] + row, site[:, 1] + column]
        designed = np.where(designed > 0, designed, np.nan)
        error = found.diameter_nm - designed
        middle = np.nanmedian(error)
        spread = 1.4826 * float(np.nanmedian(np.abs(error - middle)))
        outlier = np.nan_to_num(np.abs(error - middle), nan=0.0) > OUTLIER * max(
            spread, 0.5
        )
        mask[tuple(site[outlier].T)] = 0.0
    ordered = np.sort(scatter[np.isfinite(scatter)])
    sure = len(ordered) == 1 or float(ordered[0]) < _CLEAR * float(ordered[1])
    row, column = row - int(first[0]), column - int(first[1])
    return MaskOverlay(
        designed,
        error,
        row,
        column,
        on_mask + np.array([row, column]),
        bool(sure),
        outlier,
    )


def _steps(lattice: ImageLattice, design: DiameterMap) -> Array:
    """(2, 2) rows and columns of the mask's map that a step along j, and one along i,
    of a picture's lattice goes.
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
    long, expected = (np.linalg.norm(v, axis=1) for v in (vectors, steps * steps_um))
    one_cell = np.isclose(abs(np.linalg.det(steps)), 2 if design.lattice.centred else 1)
    if not one_cell or (np.abs(long - expected) > 0.05 * long).any():
        raise CaptureError(
            f"rows of this {kind} lattice do not lie in the picture as on the mask (+x right, +y down); turn it"
        )
    return np.asarray(steps, int)


def lattice_scale(
    found: MeasuredDiameters, pixel_nm: float, design: DiameterMap
) -> float:
    """Lattice constant in the picture over that of the mask: by how much the stated
    pixel is too large.

    Of the plane places (row, column) = origin + J (j, i) through the good pillars, sqrt
    |det J|, so that a scan
    stretched along one axis counts half. Masks are written true to scale to a few parts
    in a million, pixels of
    microscopes are known to some per cent. Accuracy: 4e-4 for five pillars a side.

    Args:
        found: pillars of the micrograph.
        pixel_nm: stated pixel, nm.
        design: what was drawn.
    """
    good = np.isfinite(found.diameter_nm)
    sites = np.column_stack([found.site[good], np.ones(int(good.sum()))])
    turn = np.linalg.lstsq(
        sites, np.column_stack([found.row[good], found.column[good]]), rcond=None
    )[0][:2]
    return float(np.sqrt(abs(np.linalg.det(turn)) / design.site_um2) * pixel_nm / 1e3)


def bias_table(laid: MaskOverlay, *, knots: int = 7) -> Table:
    """(drawn nm, made less drawn nm, its standard error, pillars) over equal shares of
    the pillars, outliers left out.

    Args:
        laid: the micrograph's pillars on the mask.
        knots: rows of the table at most.

    Raises:
        CaptureError: fewer than twelve pillars to take it from.
    """
    good = np.isfinite(laid.error_nm) & ~laid.outlier
    if good.sum() < _LEAST:
        raise CaptureError(
            f"{int(good.sum())} pillars on the design; need {_LEAST} or more for a bias table"
        )
    order = np.argsort(laid.designed_nm[good], kind="stable")
    drawn = laid.designed_nm[good][order]
    error = laid.error_nm[good][order]
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


def register_to_mask(found: MeasuredDiameters, laid: MaskOverlay) -> MeasuredDiameters:
    """The same pillars with the mask's own row and column as their site.

    Args:
        found: pillars of the micrograph.
        laid: the micrograph's pillars on the mask.
    """
    return dataclasses.replace(found, site=laid.site)


def _scatter(patch: Array, mask: Array, drawn: Array) -> Array:
    """Variance of the patch about a line in the drawn diameters at every shift; inf
    where no line of a process fits.

    Least squares of made = a + b drawn under the mask, b within a third of 1; inf too
    where a pillar has no design.
    """
    turned = (patch * mask)[::-1, ::-1]
    weight = mask[::-1, ::-1]
    count = mask.sum()

    def mean_of(one: Array, other: Array) -> Array:
        return np.asarray(signal.fftconvolve(one, other, mode="valid") / count)

    made = patch[mask > 0]
    level = mean_of(drawn, weight)
    spread = np.maximum(mean_of(drawn**2, weight) - level**2, 1e-9)
    together = mean_of(drawn, turned) - level * made.mean()
    slope = np.clip(together / spread, 2 / 3, 4 / 3)
    rest = made.var() - 2 * slope * together + slope**2 * spread
    there = mean_of((drawn > 0).astype(float), weight) > 1 - 0.5 / count
    return np.where(there, np.maximum(rest, 0), np.inf)
