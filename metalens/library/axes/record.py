"""The library over two sizes: Jones matrices of every pair of sizes, an error bar on
each, and what is left out.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from metalens.cell import Cell
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.core import records
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ConfigError, DomainError
from metalens.core.reading import typed_reader
from metalens.core.store import Provenance
from metalens.library.record import Sweep, check_light

KIND = "axes-library"


@dataclass(frozen=True, eq=False, slots=True)
class AxesLibrary:
    """Transmission of one pillar cell over the size along x and the size along y, at
    normal incidence.

    Power-normalised, exp(-iwt), light from the substrate, phase from the plane of the
    pillar's foot to that of its top,
    as :class:`metalens.cell.response.Response` has it. The sizes are those before the
    turn of the shape.

    cell, sweep: what was computed.
    wavelength_um: (w,). x_um: (m,), y_um: (n,) sizes, evenly spaced with one step.
    t: (w, m, n, 2, 2) Jones matrices; last axis: polarisation that comes (x, y), the
    one before: that leaves.
    t_error: (w, m, n) estimate of the largest |t - exact| of the four elements, not
    below the true error: solver and
        interpolation.
    held_out: (k, 5) pairs of sizes that were solved but not interpolated: index of the
    wavelength, x, y, largest
        |interpolated - solved| on one truncation, error bar of the entry.
    solves: behind the entries. harmonics: orders of the truncation, the same for all
    entries.
    """

    cell: Cell
    sweep: Sweep
    wavelength_um: Array
    x_um: Array
    y_um: Array
    t: Array
    t_error: Array
    held_out: Array
    solves: int
    harmonics: int
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        shape = (len(self.wavelength_um), len(self.x_um), len(self.y_um))
        if self.t.shape != (*shape, 2, 2) or self.t_error.shape != shape:
            raise DomainError(
                f"library t has shape {self.t.shape}, t_error {self.t_error.shape}; need {shape} and 2 x 2"
            )
        for name in ("t", "t_error"):
            if not np.isfinite(getattr(self, name)).all():
                raise DomainError(f"library {name} holds values that are not finite")

    @property
    def usable(self) -> Array:
        """(w, m, n) whether the error bar meets the tolerance; the others are the
        excluded bands of resonances.
        """
        return np.asarray(self.t_error <= self.sweep.bar)

    @property
    def missed(self) -> int:
        """Held-out pairs whose error lies above its bar."""
        return int(np.count_nonzero(self.held_out[:, 3] > self.held_out[:, 4]))

    def at(self, wavelength_um: float) -> int:
        """Place of a wavelength.

        Raises:
            DomainError: the library does not hold it (nothing is interpolated between
                wavelengths).
        """
        found = np.flatnonzero(np.abs(self.wavelength_um - wavelength_um) <= 1e-9)
        if not len(found):
            held = ", ".join(f"{w:g}" for w in self.wavelength_um)
            raise DomainError(
                f"wavelength {wavelength_um:g} um: this library holds {held} um; sweep it there too"
            )
        return int(found[0])


def cell_of_sizes(cell: Cell, x_um: float, y_um: float) -> Cell:
    """The cell whose pillar of size ``x_um`` is ``y_um`` long along its other axis."""
    shape = cell.shape
    if not isinstance(shape, Rectangle | Ellipse):
        raise CellError(
            f"lengths_um: a {shape.name} has one size; need a rectangle or an ellipse"
        )
    return dataclasses.replace(
        cell, shape=dataclasses.replace(shape, ratio=y_um / x_um)
    )


def check_axes_sweep(cell: Cell, sweep: Sweep) -> None:
    """Refuse a sweep over two sizes that cannot be computed, before anything is
    computed.

    Raises:
        ConfigError: no ranges. CellError: another shape than rectangle or ellipse, one
            with a ratio of its own, pillars
            that touch; and as :func:`metalens.library.record.check_sweep`.
    """
    spans = size_ranges(sweep)
    if getattr(cell_of_sizes(cell, 1.0, 1.0).shape, "ratio", 1.0) != getattr(
        cell.shape, "ratio", 1.0
    ):
        raise CellError(
            "cell.shape.ratio: both sizes are swept (diameters_um, lengths_um); leave ratio out"
        )
    for x, y in itertools.product(*spans):
        if not 0.01 <= y / x <= 100:
            raise CellError(
                f"sizes {x:g} by {y:g} um: need sides within a factor of 100"
            )
        if cell_of_sizes(cell, x, y).gap_um(x) <= 0:
            raise CellError(
                f"a {cell.shape.kind} of {x:g} by {y:g} um touches its neighbour on a pitch of {cell.pitch_um:g} um; "
                "keep diameters_um and lengths_um smaller"
            )
    check_light(cell, sweep)


def size_ranges(sweep: Sweep) -> tuple[tuple[float, float], tuple[float, float]]:
    """(least, largest) size along x and along y.

    Raises:
        ConfigError: not both are given.
    """
    if sweep.diameters_um is None or sweep.lengths_um is None:
        raise ConfigError(
            "a library over two sizes needs diameters_um (along x) and lengths_um (along y)"
        )
    return sweep.diameters_um, sweep.lengths_um


def is_exchange_symmetric(cell: Cell, sweep: Sweep) -> bool:
    """Whether exchanging the sizes exchanges x and y: both ranges alike, on a square
    lattice, not turned.
    """
    quarter = getattr(cell.shape, "angle_rad", 0.0) / (math.pi / 2)
    return (
        cell.lattice.kind == "square"
        and sweep.diameters_um == sweep.lengths_um
        and quarter == round(quarter)
    )


def save(path: str | Path, library: AxesLibrary) -> None:
    """Write a library file (kind ``axes-library``)."""
    records.save_record(path, KIND, library)


@typed_reader
def load(path: str | Path) -> AxesLibrary:
    """Read a library over two sizes.

    Raises:
        StoreError: not such a file; DomainError: its arrays do not fit together.
    """
    return records.load_record(path, KIND, AxesLibrary)
