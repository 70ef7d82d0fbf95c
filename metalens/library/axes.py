"""Libraries over two sizes, the width and length of a rectangle or the axes of an
ellipse: Jones matrices of every pair, an error bar on each.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter

from metalens.cell import Cell, Incidence
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ConfigError, DomainError
from metalens.core.report import Console
from metalens.core.store import Provenance, typed_reader
from metalens.library import rational
from metalens.library.record import Sweep, check_light
from metalens.library.workers import SweepJournal, Task

KIND = "axes-library"
FIT_SHARE = 0.1  # of the tolerance: residual of the rational fits


FIRST, MOST = 7, 19  # nodes along an axis: to begin with, and at most
SOLVER_SHARE = 0.6  # of the tolerance, for the solver


@dataclass(frozen=True, eq=False, slots=True)
class AxesLibrary:
    """Transmission of one pillar cell over the size along x and the size along y, at
    normal incidence.

    Power-normalised, exp(-iwt), light from the substrate, phase from the plane of the
    pillar's foot to that of its top, as :class:`metalens.cell.response.Response` has
    it. The sizes are those before the turn of the shape.

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

    Args:
        cell: unit cell with its materials, shape and lattice.

    Raises:
        ConfigError: no ranges. CellError: another shape than rectangle or ellipse, one
            with a ratio of its own, pillars that touch; and as
            :func:`metalens.library.check_sweep`.
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
    """Whether exchanging the sizes exchanges x and y: equal ranges, on a square
    lattice, not turned.

    Args:
        cell: unit cell with its materials, shape and lattice.
        sweep: settings of the library.
    """
    quarter = getattr(cell.shape, "angle_rad", 0.0) / (math.pi / 2)
    return (
        cell.lattice.kind == "square"
        and sweep.diameters_um == sweep.lengths_um
        and quarter == round(quarter)
    )


def save(path: str | Path, library: AxesLibrary) -> None:
    """Write a library file (kind ``axes-library``).

    Args:
        path: target, replaced atomically.
    """
    store.save_record(path, KIND, library)


@typed_reader
def load(path: str | Path) -> AxesLibrary:
    """Read a library over two sizes.

    Args:
        path: of the file.

    Raises:
        StoreError: not such a file; DomainError: its arrays do not fit together.
    """
    return store.load_record(path, KIND, AxesLibrary)


@dataclass(frozen=True, eq=False, slots=True)
class InterpolatedTable:
    """value: (p, q, components) at the places asked for; doubt: (p, q), of the
    interpolation alone.
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
    """t at all pairs of places.

    Args:
        nodes: (m,) and (n,) rising sizes along x and y; values: (m, n, components)
            there.
        places: (p,) and (q,) sizes, within the nodes, evenly spaced.
        tolerance: of t; sets the residual of the rational fits.
    """
    (x, y), (at_x, at_y) = nodes, places
    first = _interpolate_in_turn(x, y, values, at_x, at_y, tolerance)
    second = _interpolate_in_turn(
        y, x, values.swapaxes(0, 1), at_y, at_x, tolerance
    ).swapaxes(0, 1)
    difference = np.abs(first - second).max(axis=-1)
    row, column = _rival_nodes(len(x)), _rival_nodes(len(y))
    rival = _interpolate_in_turn(
        x[row], y[column], values[np.ix_(row, column)], at_x, at_y, tolerance
    )
    difference = np.maximum(
        difference, np.abs(rival - (first + second) / 2).max(axis=-1)
    )
    reach = [_half_gap(node, place) for node, place in ((x, at_x), (y, at_y))]
    difference = maximum_filter(
        difference, size=[2 * n + 1 for n in reach], mode="nearest"
    )
    return InterpolatedTable(
        (first + second) / 2, np.asarray(difference + 0.05 * tolerance)
    )


def _rival_nodes(count: int) -> Array:
    """Places of the nodes of the rival: one in four inner ones is left out."""
    place = np.arange(count)
    return np.asarray(place[(place % 4 != 2) | (place == count - 1)])


def _half_gap(nodes: Array, places: Array) -> int:
    """Places within half the mean distance of nodes."""
    if len(places) < 2:
        return 0
    return math.ceil(
        float(np.diff(nodes).mean()) / 2 / abs(float(places[1] - places[0]))
    )


def _interpolate_in_turn(
    x: Array, y: Array, values: Array, at_x: Array, at_y: Array, tolerance: float
) -> Array:
    """Along x on every line of nodes, then along y: (p, q, components)."""
    lines = [
        rational.fit_rational_aaa(x, values[:, k], tolerance=FIT_SHARE * tolerance)(
            at_x
        )
        for k in range(len(y))
    ]
    along = np.stack(lines, axis=1)
    return np.stack(
        [
            rational.fit_rational_aaa(y, line, tolerance=FIT_SHARE * tolerance)(at_y)
            for line in along
        ]
    )


class SolvedPillar(NamedTuple):
    """One pillar: (2, 2) Jones matrix and its error bar."""

    t: Array
    error: float


class _Nodes:
    """Exact solves of one wavelength, by pair of sizes; where the sizes may be
    exchanged half of them follow.
    """

    def __init__(
        self,
        cell: Cell,
        sweep: Sweep,
        wavelength_um: float,
        reach: int,
        journal: SweepJournal,
    ) -> None:
        self._cell, self._wavelength, self._reach, self._journal = (
            cell,
            wavelength_um,
            reach,
            journal,
        )
        self.swaps, self._tolerance = is_exchange_symmetric(cell, sweep), sweep.bar
        self._known: dict[tuple[float, float], SolvedPillar] = {}
        self.solves = 0

    def solve(
        self, pairs: list[tuple[float, float]], console: Console, label: str
    ) -> list[SolvedPillar]:
        """Of every pair."""
        left = list(
            dict.fromkeys(
                self._first(pair)
                for pair in pairs
                if self._first(pair) not in self._known
            )
        )
        light = (Incidence(self._wavelength),)
        tasks = [
            Task(
                "jones",
                cell_of_sizes(self._cell, x, y),
                light,
                (x,),
                self._tolerance,
                harmonics=self._reach,
            )
            for x, y in left
        ]
        for pair, (made,) in zip(
            left, self._journal.run(tasks, console, label), strict=True
        ):
            t = made.response[:, 0].reshape(2, 2)
            self._known[pair] = SolvedPillar(t, float(made.error.max()))
        self.solves += len(left)
        return [self._of(pair) for pair in pairs]

    def _first(self, pair: tuple[float, float]) -> tuple[float, float]:
        return (max(pair), min(pair)) if self.swaps else pair

    def _of(self, pair: tuple[float, float]) -> SolvedPillar:
        found = self._known[self._first(pair)]
        return (
            found
            if self._first(pair) == pair
            else SolvedPillar(found.t[::-1, ::-1], found.error)
        )

    def grid(
        self, x: Array, y: Array, console: Console, label: str
    ) -> tuple[Array, Array]:
        """(m, n, 4) Jones matrices and (m, n) error bars on all pairs of nodes."""
        made = self.solve([(float(a), float(b)) for a in x for b in y], console, label)
        shape = len(x), len(y)
        return np.array([one.t for one in made]).reshape(*shape, 4), np.array(
            [one.error for one in made]
        ).reshape(shape)


def sweep_two_sizes(
    cell: Cell,
    settings: Sweep,
    *,
    console: Console | None = None,
    checkpoint: Path | None = None,
) -> AxesLibrary:
    """Compute a library over two sizes.

    Args:
        settings: ``diameters_um`` and ``lengths_um`` are the ranges along x and y,
            ``samples`` the entries along the longer of them. console, checkpoint: as
            for :func:`metalens.library.sweep`.
        cell: unit cell with its materials, shape and lattice.

    Accuracy: the bar of an entry adds the truncation error of the solver, carried as a
        small shift of the sizes, and the disagreement of interpolations, scaled by what
        twelve pairs held out show; ``held_out`` tells how far off they and twelve more
        are.

    Raises:
        ConfigError, CellError, MaterialError: see :func:`check_axes_sweep`.
    """
    check_axes_sweep(cell, settings)
    settings = settings.with_tolerance(cell)
    console = console or Console(quiet=True)
    journal = SweepJournal(checkpoint, cell, settings)
    places = size_entries(settings)
    reach = _choose_truncation(cell, settings)
    t, error, held, solves = [], [], [], 0
    for index, wavelength in enumerate(settings.wavelengths_um):
        nodes = _Nodes(cell, settings, wavelength, reach, journal)
        x, y = _choose_lines(nodes, settings, console)
        values, bars = nodes.grid(x, y, console, "pillars")
        made = interpolate_table((x, y), values, places, tolerance=settings.bar)
        judged = _held_out(nodes, places, made.value, made.doubt, console)
        # half of the pairs held out scale the bars, the other half judges them
        wide = max(0.5, 2 * float((judged[::2, 2] / judged[::2, 3]).max()))
        bar = np.minimum(
            wide * made.doubt + _solver_error((x, y), bars, places, made.value), 2.0
        )
        row, column = _held_out_places(places)
        judged[:, 3] = bar[row, column]
        t.append(made.value.reshape(*made.doubt.shape, 2, 2))
        error.append(bar)
        held.append(np.insert(judged, 0, index, axis=1))
        solves += nodes.solves
    axes = np.array(settings.wavelengths_um), *places
    about = Provenance(config=config.dumps(cell) + "\n" + config.dumps(settings))
    found = np.concatenate(held)
    library = AxesLibrary(
        cell, settings, *axes, np.array(t), np.array(error), found, solves, reach, about
    )
    journal.finish()
    return library


def size_entries(sweep: Sweep) -> tuple[Array, Array]:
    """Evenly spaced sizes along x and y, with one step; the shorter range may end
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
    return np.minimum(x, spans[0][1]), np.minimum(
        y, spans[1][1]
    )  # the last one, to rounding


def _choose_truncation(cell: Cell, sweep: Sweep) -> int:
    """The least truncation whose bars meet the solver's share at four probes, or the
    largest there is.
    """
    from metalens.rcwa import jones, most_harmonics

    (x0, x1), (y0, y1) = size_ranges(sweep)
    shares = ((0.31, 0.74), (0.66, 0.36), (0.87, 0.93), (0.52, 0.11))
    sizes = [(x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a, b in shares]
    most = most_harmonics(cell_of_sizes(cell, *sizes[0]), sizes[0][0])
    for reach in range(min(5, most), most):
        wanted = SOLVER_SHARE * sweep.bar
        about = {"tolerance": wanted, "harmonics": reach}
        if all(
            jones(cell_of_sizes(cell, x, y), x, wavelength, **about).converged  # type: ignore[arg-type]
            for x, y in sizes
            for wavelength in sweep.wavelengths_um
        ):
            return reach
    return most


def _choose_lines(nodes: _Nodes, sweep: Sweep, console: Console) -> tuple[Array, Array]:
    """Nodes along x and y: Chebyshev's, and lines between them where the interpolations
    disagree most.
    """
    spans = size_ranges(sweep)
    angle = np.pi * np.arange(FIRST) / (FIRST - 1)
    lines = [(low + high) / 2 - (high - low) / 2 * np.cos(angle) for low, high in spans]
    look = np.linspace(*spans[0], 61), np.linspace(*spans[1], 61)
    for made, span in zip(lines, spans, strict=True):
        made[[0, -1]] = span
    while True:
        x, y = lines
        values, _ = nodes.grid(x, y, console, "pillars")
        doubt = interpolate_table((x, y), values, look, tolerance=sweep.bar).doubt
        above = (doubt > (1 - SOLVER_SHARE) * sweep.bar).mean()
        # a few pairs in a hundred may lie near resonances
        if above <= 0.03 or len(x) >= MOST:
            return x, y
        some = np.minimum(doubt, 10 * sweep.bar)  # a resonance is not chased for ever
        profiles = [some.mean(axis=1), some.mean(axis=0)]
        if nodes.swaps:
            profiles = [profiles[0] + profiles[1]] * 2
        lines = [_add_lines(*pair) for pair in zip(lines, look, profiles, strict=True)]


def _add_lines(lines: Array, look: Array, profile: Array) -> Array:
    """Nodes with some more, in the gaps over which the doubt adds up to most."""
    for _ in range(2):
        gaps = [
            float(profile[(look > a) & (look < b)].sum())
            for a, b in itertools.pairwise(lines)
        ]
        worst = int(np.argmax(gaps))
        lines = np.insert(lines, worst + 1, (lines[worst] + lines[worst + 1]) / 2)
    return lines


def _held_out(
    nodes: _Nodes,
    places: tuple[Array, Array],
    value: Array,
    doubt: Array,
    console: Console,
) -> Array:
    """(k, 4) x, y, error and doubt of the interpolation at the entries that are held
    out.
    """
    row, column = _held_out_places(places)
    pairs = [
        (float(places[0][i]), float(places[1][j]))
        for i, j in zip(row, column, strict=True)
    ]
    exact = np.array([one.t.ravel() for one in nodes.solve(pairs, console, "held out")])
    missed = np.abs(value[row, column] - exact).max(axis=1)
    return np.column_stack([np.array(pairs), missed, doubt[row, column]])


def _held_out_places(places: tuple[Array, Array]) -> tuple[Array, Array]:
    """Entries that spread over the plane (Roberts's sequence)."""
    growth = 1.324717957244746  # its cube is itself plus one
    steps = np.outer(np.arange(1, 25), [1 / growth, 1 / growth**2])
    shares = np.mod(steps + 0.5, 1)
    row, column = (
        np.minimum((shares[:, k] * len(places[k])).astype(int), len(places[k]) - 1)
        for k in (0, 1)
    )
    return row, column


def _solver_error(
    nodes: tuple[Array, Array], bars: Array, places: tuple[Array, Array], value: Array
) -> Array:
    """(p, q) error of the solver between the nodes: a small shift of the sizes, so it
    grows with the slope of t.
    """
    steep = np.zeros(value.shape[:2])
    for axis in (0, 1):
        rise = np.abs(np.gradient(value, places[axis], axis=axis)).max(axis=-1)
        steep = np.hypot(steep, rise)
    steep += 2 / (places[0][-1] - places[0][0])
    place = [
        np.interp(n, p, np.arange(len(p))) for n, p in zip(nodes, places, strict=True)
    ]
    at = np.stack(np.meshgrid(*place, indexing="ij"))
    shift = bars / map_coordinates(steep, at, order=1)
    corner = np.maximum.reduce(
        [shift[:-1, :-1], shift[1:, :-1], shift[:-1, 1:], shift[1:, 1:]]
    )
    cell = [
        np.clip(np.searchsorted(n, p, side="right") - 1, 0, len(n) - 2)
        for n, p in zip(nodes, places, strict=True)
    ]
    return np.asarray(corner[cell[0][:, None], cell[1]] * steep)
