"""Libraries over two sizes, the width and length of a rectangle or the axes of an
ellipse: Jones matrices of every pair, an error bar on each.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import maximum_filter

from metalens.cell import Cell, Incidence
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ConfigError, DomainError
from metalens.core.report import CommandConsole
from metalens.core.store import Provenance, typed_reader
from metalens.library import curve
from metalens.library.curve import SolvedNodes
from metalens.library.record import Sweep, check_light
from metalens.library.workers import FIT_SHARE, SOLVE_SHARE, SweepJournal, SweepTask

KIND = "axes-library"


@dataclass(frozen=True, eq=False, slots=True)
class AxesLibrary:
    """Transmission of one pillar cell over the size along x and the size along y, at
    normal incidence.

    Power-normalised, exp(-iwt), light from the substrate, phase from the plane of the
    pillar's foot to that of its top, as in :class:`metalens.cell.response.Response`.
    The sizes are those before the turn of the shape.

    cell, sweep: what was computed.
    wavelength_um: (w,) vacuum wavelengths.
    x_um, y_um: (m,) and (n,) sizes, evenly spaced with one step.
    t: (w, m, n, 2, 2) Jones matrices; the last axis is the incident polarisation (x,
        y), the one before it the outgoing one.
    t_error: (w, m, n) estimate of the largest |t - exact| of the four elements, not
        below the true error: solver and interpolation.
    held_out: (k, 5) pairs of sizes that were solved but not interpolated: index of the
        wavelength, x, y, largest |interpolated - solved| on one truncation, error bar.
    solves: number of exact solves behind the entries.
    harmonics: orders of the truncation, the same for all entries.
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
        """Refuse arrays that do not fit together, and values that are not finite."""
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
        """(w, m, n) mask: the error bar meets the tolerance. The others are the
        excluded bands of resonances.
        """
        return np.asarray(self.t_error <= self.sweep.bar)

    @property
    def missed(self) -> int:
        """Number of held-out pairs whose error exceeds their error bar."""
        return int(np.count_nonzero(self.held_out[:, 3] > self.held_out[:, 4]))

    def at(self, wavelength_um: float) -> int:
        """Index of a wavelength; nothing is interpolated between wavelengths.

        Raises:
            DomainError: the library does not hold it.
        """
        return tabulated_index(self.wavelength_um, wavelength_um)


def tabulated_index(wavelengths_um: Array, wavelength_um: float) -> int:
    """Index of a wavelength in a table.

    Args:
        wavelengths_um: (w,) of the table.
        wavelength_um: wanted, um.

    Raises:
        DomainError: the table does not hold it.
    """
    places = np.flatnonzero(np.abs(wavelengths_um - wavelength_um) <= 1e-9)
    if not len(places):
        available = ", ".join(f"{w:g}" for w in wavelengths_um)
        raise DomainError(
            f"wavelength {wavelength_um:g} um: the table of two sizes holds {available} um; sweep it there too"
        )
    return int(places[0])


def cell_of_sizes(cell: Cell, x_um: float, y_um: float) -> Cell:
    """The cell with a pillar of ``x_um`` by ``y_um``: the ratio of its shape is y / x.

    Raises:
        CellError: a shape that has one size.
    """
    shape = cell.shape
    if not isinstance(shape, Rectangle | Ellipse):
        raise CellError(
            f"lengths_um: a {shape.name} has one size; need a rectangle or an ellipse"
        )
    return dataclasses.replace(
        cell, shape=dataclasses.replace(shape, ratio=y_um / x_um)
    )


def check_axes_sweep(cell: Cell, sweep: Sweep) -> None:
    """Refuse a sweep over two sizes that cannot be computed.

    Args:
        cell: unit cell with its materials, shape and lattice.
        sweep: settings of the library.

    Raises:
        ConfigError: no ranges.
        CellError: another shape than rectangle or ellipse, one with a ratio of its own,
            pillars that touch; and as :func:`metalens.library.check_sweep`.
    """
    spans = size_ranges(sweep)
    if cell_of_sizes(cell, 1.0, 1.0) != cell:
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

    Args:
        sweep: settings of the library.

    Raises:
        ConfigError: not both are given.
    """
    if sweep.diameters_um is None or sweep.lengths_um is None:
        raise ConfigError(
            "a library over two sizes needs diameters_um (along x) and lengths_um (along y)"
        )
    return sweep.diameters_um, sweep.lengths_um


def is_exchange_symmetric(cell: Cell, sweep: Sweep) -> bool:
    """Whether exchanging the sizes exchanges x and y: equal ranges on a square lattice,
    and a shape turned by a multiple of 90 degrees.

    Args:
        cell: unit cell with its materials, shape and lattice.
        sweep: settings of the library.
    """
    quarter_turns = getattr(cell.shape, "angle_rad", 0.0) / (math.pi / 2)
    return (
        cell.lattice.kind == "square"
        and sweep.diameters_um == sweep.lengths_um
        and quarter_turns == round(quarter_turns)
    )


def save_axes_library(path: str | Path, library: AxesLibrary) -> None:
    """Write a library file (kind ``axes-library``).

    Args:
        path: target, replaced atomically.
    """
    store.save_record(path, KIND, library)


@typed_reader
def load_axes_library(path: str | Path) -> AxesLibrary:
    """Read a library over two sizes.

    Args:
        path: of the file.

    Raises:
        StoreError: not such a file; DomainError: its arrays do not fit together.
    """
    return store.load_record(path, KIND, AxesLibrary)


@dataclass(frozen=True, eq=False, slots=True)
class InterpolatedTable:
    """t interpolated at pairs of sizes.

    value: (p, q, components). doubt: (p, q) error estimate of the interpolation alone.
    """

    value: Array
    doubt: Array


def interpolate_table(
    nodes: tuple[Array, Array],
    values: Array,
    places: tuple[Array, Array],
    *,
    tolerance: float,
) -> InterpolatedTable:
    """t at all pairs of places by rational interpolation, and its error estimate.

    The value is the mean of two orders: along x then y, and along y then x. The
    estimate is the largest change between the orders, or against an interpolation with
    a quarter of the nodes left out. It is spread over half a node spacing, and 0.05
    ``tolerance`` is added.

    Args:
        nodes: (m,) and (n,) rising sizes along x and y, um.
        values: (m, n, components) at the nodes.
        places: (p,) and (q,) sizes, within the nodes, evenly spaced, um.
        tolerance: of t; sets the residual of the rational fits.
    """
    (x, y), (at_x, at_y) = nodes, places
    x_then_y = _interpolate_in_turn(x, y, values, at_x, at_y, tolerance)
    y_then_x = _interpolate_in_turn(
        y, x, values.swapaxes(0, 1), at_y, at_x, tolerance
    ).swapaxes(0, 1)
    difference = np.abs(x_then_y - y_then_x).max(axis=-1)
    rows, columns = _sparser_nodes(len(x)), _sparser_nodes(len(y))
    sparser = _interpolate_in_turn(
        x[rows], y[columns], values[np.ix_(rows, columns)], at_x, at_y, tolerance
    )
    mean = (x_then_y + y_then_x) / 2
    difference = np.maximum(difference, np.abs(sparser - mean).max(axis=-1))
    half_gaps = [_half_gap(node, place) for node, place in ((x, at_x), (y, at_y))]
    difference = maximum_filter(
        difference, size=[2 * count + 1 for count in half_gaps], mode="nearest"
    )
    return InterpolatedTable(mean, np.asarray(difference + 0.05 * tolerance))


def _sparser_nodes(count: int) -> Array:
    """Indices of the nodes with one in four of the inner ones left out."""
    index = np.arange(count)
    return np.asarray(index[(index % 4 != 2) | (index == count - 1)])


def _half_gap(nodes: Array, places: Array) -> int:
    """Number of places within half the mean spacing of the nodes."""
    if len(places) < 2:
        return 0
    return math.ceil(
        float(np.diff(nodes).mean()) / 2 / abs(float(places[1] - places[0]))
    )


def _interpolate_in_turn(
    x: Array, y: Array, values: Array, at_x: Array, at_y: Array, tolerance: float
) -> Array:
    """(p, q, components) rational interpolation along x on every line of nodes, then
    along y on every line of places.

    Args:
        x: (m,) nodes.
        y: (n,) nodes.
        values: (m, n, components).
        at_x: (p,) places.
        at_y: (q,) places.
        tolerance: of t.
    """
    residual = curve.FIT_SHARE * FIT_SHARE * tolerance
    fits = [
        curve.fit_rational_aaa(x, values[:, k], tolerance=residual)(at_x)
        for k in range(len(y))
    ]
    columns = np.stack(fits, axis=1)
    return np.stack(
        [curve.fit_rational_aaa(y, line, tolerance=residual)(at_y) for line in columns]
    )


class _Nodes:
    """Exact solves of one wavelength by pair of sizes, each solved once; where the
    sizes may be exchanged, half of them follow by symmetry.

    known: {pair: (5,) Jones matrix xx, xy, yx, yy, and error bar}.
    """

    def __init__(
        self,
        cell: Cell,
        sweep: Sweep,
        wavelength_um: float,
        reach: int,
        run: Callable[[list[SweepTask], str], list[SolvedNodes]],
    ) -> None:
        self._cell = cell
        self._light = Incidence(wavelength_um)
        self._reach = reach
        self._run = run
        self.swaps = is_exchange_symmetric(cell, sweep)
        self._tolerance = sweep.bar
        self.known: dict[tuple[float, float], Array] = {}

    def solve(self, pairs: Array, label: str) -> tuple[Array, Array]:
        """(n, 4) Jones matrices and (n,) error bars of every pair; new pairs are solved
        in parallel.

        Args:
            pairs: (n, 2) sizes along x and y, um.
            label: names the pairs in the progress.
        """
        # by symmetry, the larger size is solved first
        solved = -np.sort(-pairs, axis=1) if self.swaps else pairs
        keys = [(float(x), float(y)) for x, y in solved]
        new = [key for key in dict.fromkeys(keys) if key not in self.known]
        tasks = [
            SweepTask(
                "jones",
                cell_of_sizes(self._cell, x, y),
                self._light,
                (x,),
                self._tolerance,
                harmonics=self._reach,
            )
            for x, y in new
        ]
        for key, nodes in zip(new, self._run(tasks, label), strict=True):
            self.known[key] = np.append(nodes.response[:, 0], nodes.error.max())
        rows = np.array([self.known[key] for key in keys])
        swapped = (solved != pairs).any(axis=1)
        rows[swapped, :4] = rows[swapped, 3::-1]  # exchanges x and y of t
        return rows[:, :4], rows[:, 4].real

    def grid(self, x: Array, y: Array) -> tuple[Array, Array]:
        """(m, n, 4) Jones matrices and (m, n) error bars of all pairs of nodes.

        Args:
            x: (m,) sizes, um.
            y: (n,) sizes, um.
        """
        pairs = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        t, error = self.solve(pairs.reshape(-1, 2), "pillars")
        return t.reshape(*pairs.shape[:2], 4), error.reshape(pairs.shape[:2])


def sweep_two_sizes(
    cell: Cell,
    settings: Sweep,
    *,
    console: CommandConsole | None = None,
    checkpoint: Path | None = None,
) -> AxesLibrary:
    """Compute a library over two sizes, by exact solves on a grid of nodes and rational
    interpolation between them.

    Args:
        cell: unit cell with its materials, shape and lattice.
        settings: ``diameters_um`` and ``lengths_um`` are the ranges along x and y,
            ``samples`` the entries along the longer of them.
        console: where progress is shown.
        checkpoint: as for :func:`metalens.library.sweep`.

    Accuracy: the bar of an entry adds two parts. One is the truncation error of the
        solver, carried as a small shift of the sizes. The other is the disagreement of
        interpolations, scaled by the errors of twelve held-out pairs; ``held_out``
        lists them and twelve more.

    Raises:
        ConfigError, CellError, MaterialError: see :func:`check_axes_sweep`.
    """
    check_axes_sweep(cell, settings)
    settings = settings.with_tolerance(cell)
    journal = SweepJournal(checkpoint, cell, settings)
    output = console or CommandConsole(quiet=True)
    places = size_entries(settings)
    reach = _choose_truncation(cell, settings)
    t = []
    error = []
    held_out = []
    solves = 0
    for index, wavelength in enumerate(settings.wavelengths_um):
        nodes = _Nodes(
            cell,
            settings,
            wavelength,
            reach,
            lambda tasks, label: journal.run(tasks, output, label),
        )
        x, y = _choose_lines(nodes, settings)
        values, bars = nodes.grid(x, y)
        table = interpolate_table((x, y), values, places, tolerance=settings.bar)
        pairs = _held_out(nodes, places, table)
        # half of the held-out pairs scale the bars, the other half tests them
        scale = max(0.5, 2 * float((pairs[::2, 2] / pairs[::2, 3]).max()))
        bar = np.minimum(
            scale * table.doubt + _solver_error((x, y), bars, places, table.value), 2.0
        )
        row, column = _held_out_places(places)
        pairs[:, 3] = bar[row, column]
        t.append(table.value.reshape(*table.doubt.shape, 2, 2))
        error.append(bar)
        held_out.append(np.insert(pairs, 0, index, axis=1))
        solves += len(nodes.known)
    provenance = Provenance(config=config.dumps(cell) + "\n" + config.dumps(settings))
    library = AxesLibrary(
        cell,
        settings,
        np.array(settings.wavelengths_um),
        *places,
        np.array(t),
        np.array(error),
        np.concatenate(held_out),
        solves,
        reach,
        provenance,
    )
    journal.finish()
    return library


def size_entries(sweep: Sweep) -> tuple[Array, Array]:
    """(x, y) evenly spaced sizes with one common step, um; the shorter range may end
    before its largest size.

    Args:
        sweep: settings with both ranges.
    """
    spans = size_ranges(sweep)
    step = max(high - low for low, high in spans) / (sweep.samples - 1)
    x, y = (
        low + step * np.arange(int((high - low) / step + 1e-9) + 1)
        for low, high in spans
    )
    # rounding may carry the last size past the range
    return np.minimum(x, spans[0][1]), np.minimum(y, spans[1][1])


def _choose_truncation(cell: Cell, sweep: Sweep) -> int:
    """Least number of harmonics whose error bars meet the solver's share of the
    tolerance at four probe sizes; the largest possible one where none does.
    """
    from metalens.rcwa import jones, most_harmonics

    (x0, x1), (y0, y1) = size_ranges(sweep)
    probes = ((0.31, 0.74), (0.66, 0.36), (0.87, 0.93), (0.52, 0.11))
    sizes = [(x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a, b in probes]
    most = most_harmonics(cell_of_sizes(cell, *sizes[0]), sizes[0][0])
    for harmonics in range(min(5, most), most):
        target = SOLVE_SHARE * sweep.bar
        options = {"tolerance": target, "harmonics": harmonics}
        if all(
            jones(cell_of_sizes(cell, x, y), x, wavelength, **options).converged  # type: ignore[arg-type]
            for x, y in sizes
            for wavelength in sweep.wavelengths_um
        ):
            return harmonics
    return most


def _choose_lines(
    nodes: _Nodes, sweep: Sweep, counts: tuple[int, ...] = (7, 13, 19)
) -> tuple[Array, Array]:
    """(x, y) nodes: Chebyshev points of the least of ``counts`` at which at most 3 % of
    the pairs exceed the interpolation's share of the tolerance, else of the last.

    Args:
        nodes: solver of the wavelength.
        sweep: settings with both ranges.
        counts: of nodes along an axis; those of degree 6 are among those of 12 and 18.
    """
    spans = size_ranges(sweep)
    grid = np.linspace(*spans[0], 61), np.linspace(*spans[1], 61)
    for count in counts:
        unit = -np.cos(np.pi * np.arange(count) / (count - 1))
        # rounded, so that nodes of two levels are equal
        x, y = (np.round(low + (high - low) * (unit + 1) / 2, 9) for low, high in spans)
        values, _ = nodes.grid(x, y)
        doubt = interpolate_table((x, y), values, grid, tolerance=sweep.bar).doubt
        # a few pairs in a hundred may lie near resonances
        if (doubt > FIT_SHARE * sweep.bar).mean() <= 0.03:
            break
    return x, y


def _held_out(
    nodes: _Nodes, places: tuple[Array, Array], table: InterpolatedTable
) -> Array:
    """(k, 4) x and y in um, error, and error estimate of the interpolation at the
    held-out entries, which are solved but not interpolated.

    Args:
        nodes: solver of the wavelength.
        places: (p,) and (q,) sizes of the library, um.
        table: interpolated at these.
    """
    rows, columns = _held_out_places(places)
    pairs = np.column_stack([places[0][rows], places[1][columns]])
    exact, _ = nodes.solve(pairs, "held out")
    error = np.abs(table.value[rows, columns] - exact).max(axis=1)
    return np.column_stack([pairs, error, table.doubt[rows, columns]])


def _held_out_places(places: tuple[Array, Array]) -> tuple[Array, Array]:
    """(24,) rows and columns of entries spread evenly over the plane: Roberts's R2
    sequence, frac(1/2 + k / g) and frac(1/2 + k / g²) with g³ = g + 1.
    """
    g = 1.324717957244746
    steps = np.outer(np.arange(1, 25), [1 / g, 1 / g**2])
    shares = np.mod(steps + 0.5, 1)
    rows, columns = (
        np.minimum((shares[:, k] * len(places[k])).astype(int), len(places[k]) - 1)
        for k in (0, 1)
    )
    return rows, columns


def _solver_error(
    nodes: tuple[Array, Array], bars: Array, places: tuple[Array, Array], value: Array
) -> Array:
    """(p, q) error of the solver between the nodes, carried as a small shift of the
    sizes: it grows with the slope of t.

    Each node's shift is its error bar over the slope. A place takes the largest shift
    of the four nodes around it, times its own slope.

    Args:
        nodes: (m,) and (n,) sizes, um.
        bars: (m, n) error bars of the solver at the nodes.
        places: (p,) and (q,) sizes, um.
        value: (p, q, components) interpolated t.
    """
    slope = np.zeros(value.shape[:2])
    for axis in (0, 1):
        derivative = np.abs(np.gradient(value, places[axis], axis=axis)).max(axis=-1)
        slope = np.hypot(slope, derivative)
    slope += 2 / (places[0][-1] - places[0][0])  # of a curve without features
    slope_at_nodes = RectBivariateSpline(*places, slope, kx=1, ky=1)(*nodes)
    shift = bars / slope_at_nodes
    largest_shift = sliding_window_view(shift, (2, 2)).max(axis=(2, 3))
    row, column = (
        np.digitize(size, node[1:-1]) for node, size in zip(nodes, places, strict=True)
    )
    return np.asarray(largest_shift[row[:, None], column] * slope)
