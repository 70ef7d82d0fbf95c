"""Run a library sweep: rational curves t(D) at a few wavelengths and angles, polynomials
between them, single solves where neither meets the tolerance.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
from scipy.interpolate import BarycentricInterpolator
from scipy.ndimage import maximum_filter1d

from metalens.cell import Cell, Incidence, Polarization
from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.report import CommandConsole
from metalens.core.store import Provenance
from metalens.library import workers
from metalens.library.curve import ResponseCurve
from metalens.library.geometric_phase import solve_rotations
from metalens.library.record import PillarLibrary, Sweep, check_sweep
from metalens.library.workers import SweepJournal, SweepTask

Rows = dict[Incidence, Array]  # (3, diameter) complex: t, r, error estimate


def sweep(
    cell: Cell,
    settings: Sweep | None = None,
    *,
    wavelengths_um: tuple[float, ...] | None = None,
    console: CommandConsole | None = None,
    checkpoint: Path | None = None,
) -> PillarLibrary:
    """Compute a library: response over diameter at all wavelengths, angles and
    polarisations.

    Args:
        cell: unit cell with its materials, shape and lattice.
        settings: what the library holds.
        wavelengths_um: in place of those of the settings.
        console: where progress is shown.
        checkpoint: file for finished curves; an interrupted sweep resumes from it, with
            the same result.

    Raises:
        CellError, MaterialError: see :func:`metalens.library.record.check_sweep`.
    """
    settings = settings or Sweep()
    if wavelengths_um is not None:
        settings = dataclasses.replace(settings, wavelengths_um=wavelengths_um)
    check_sweep(cell, settings)
    run = _SweepRun(cell, settings.with_tolerance(cell), console, checkpoint)
    return run.library()


class _SweepRun:
    """The curves t(D) of a checked sweep, by plane wave."""

    def __init__(
        self,
        cell: Cell,
        sweep: Sweep,
        console: CommandConsole | None,
        checkpoint: Path | None,
    ) -> None:
        self.cell = cell
        self.sweep = sweep
        self.span = sweep.span_um(cell)
        self.console = console or CommandConsole(quiet=True)
        self.engine = workers.choose_engine(cell, sweep.engine)
        self.journal = SweepJournal(checkpoint, cell, sweep)
        self.curves: dict[Incidence, ResponseCurve] = {}

    def library(self) -> PillarLibrary:
        """Run the sweep: curves at a few wavelengths and angles, and polynomials
        between them.

        Rows with over 20 entries above the tolerance get a curve of their own. Single
        entries that are still above it are solved one by one.
        """
        sweep = self.sweep
        wavelengths = pick_nodes(sweep.wavelengths_um)
        angles = pick_nodes(sweep.angles_deg)
        self.solve(
            [
                self.wave(wavelength, angle, polarization)
                for angle in angles
                for polarization in sweep.polarizations
                for wavelength in wavelengths
            ],
            "curves",
        )
        diameters = np.linspace(*self.span, sweep.samples)
        rows = self.rows(diameters)
        inaccurate = [  # 20 entries: a curve takes about as many solves
            light
            for light, row in rows.items()
            if light not in self.curves and (row[2].real > sweep.bar).sum() > 20
        ]
        if inaccurate:
            self.solve(inaccurate, "more curves")
            rows = self.rows(diameters)
        points = self.points(diameters, rows)
        solved = self.journal.run(points, self.console, "entries one by one")
        for task, entries in zip(points, solved, strict=True):
            row = rows[task.light]
            index = np.searchsorted(diameters, entries.diameter_um)
            better = entries.error < row[2, index].real
            values = np.concatenate([entries.response.T, entries.error[None]])
            row[:, index[better]] = values[:, better]
        solve_count = sum(
            len(curve.nodes.diameter_um) for curve in self.curves.values()
        )
        solve_count += len(points)
        result = self.record(diameters, rows, solve_count)
        self.journal.finish()
        return result

    def wave(
        self, wavelength_um: float, angle_deg: float, polarization: Polarization
    ) -> Incidence:
        """Plane wave of an entry, with s and p written as x and y at normal incidence.

        The plane of incidence is along x: s is y, and p is x. Cells that respond
        equally to both use x for s as well.
        """
        if not angle_deg and polarization in ("s", "p"):
            along_y = polarization == "s" and not self.cell.is_isotropic
            polarization = "y" if along_y else "x"
        return Incidence(wavelength_um, math.radians(angle_deg), polarization)

    def solve(self, lights: list[Incidence], label: str) -> None:
        """Solve and store the curves of plane waves.

        Oblique light comes first: it takes several times as long as normal incidence.
        """
        waves = sorted(dict.fromkeys(lights), key=lambda light: -light.angle_rad)
        tasks = [
            SweepTask("curve", self.cell, wave, self.span, self.sweep.bar, self.engine)
            for wave in waves
        ]
        solved = self.journal.run(tasks, self.console, label)
        for wave, nodes in zip(waves, solved, strict=True):
            self.curves[wave] = workers.fit_curve(nodes, tolerance=self.sweep.bar)

    def rows(self, diameters: Array) -> Rows:
        """All rows of the sweep: those of the curves, then interpolated between
        wavelengths, then between angles (in sin²).
        """
        rows: Rows = {}
        resonances = {}
        for light, curve in self.curves.items():
            value, error = curve(diameters)
            rows[light] = np.stack([value[:, 0], value[:, 1], error])
            resonances[light] = curve.resonances(0.005)  # narrow ones only
        sweep = self.sweep
        for polarization in sweep.polarizations:
            for angle in sweep.angles_deg:
                family = {
                    wavelength_um: self.wave(wavelength_um, angle, polarization)
                    for wavelength_um in sweep.wavelengths_um
                }
                _interpolate_family(rows, family, resonances, diameters)
            for wavelength in sweep.wavelengths_um:
                family = {
                    math.sin(math.radians(angle_deg)) ** 2: self.wave(
                        wavelength, angle_deg, polarization
                    )
                    for angle_deg in sweep.angles_deg
                }
                _interpolate_family(rows, family, resonances, diameters)
        return rows

    def points(self, diameters: Array, rows: Rows) -> list[SweepTask]:
        """Tasks for the entries whose error bar exceeds the tolerance.

        Left out are those at the solver's finest discretisation, where a single solve
        has no less error.
        """
        tasks = []
        for light, row in rows.items():
            bar = self.sweep.bar
            misses = row[2].real > bar
            curve = self.curves.get(light)
            if curve and workers.is_at_finest_discretization(
                self.cell, curve.nodes.error, bar * workers.SOLVE_SHARE
            ):
                misses &= curve.solver_error(diameters) <= bar
            tasks += [
                SweepTask("point", self.cell, light, (diameter,), bar, self.engine)
                for diameter in diameters[misses].tolist()
            ]
        return tasks

    def record(self, diameters: Array, rows: Rows, solves: int) -> PillarLibrary:
        """The library of all rows.

        Args:
            diameters: (n,) um.
            rows: of every plane wave.
            solves: exact solves behind them.
        """
        sweep = self.sweep
        axes = sweep.polarizations, sweep.angles_deg, sweep.wavelengths_um
        shape = (*map(len, axes), len(diameters))
        table = np.empty((3, *shape), complex)
        resonances: list[tuple[float, ...]] = []
        for i, j, k in np.ndindex(*shape[:3]):
            light = self.wave(axes[2][k], axes[1][j], axes[0][i])
            table[:, i, j, k] = rows[light]
            if light in self.curves:
                resonances += [
                    (i, light.angle_rad, light.wavelength_um, *pole)
                    for pole in self.curves[light].resonances()
                ]
        t, r = table[0], table[1]
        text = config.dumps(self.cell) + "\n" + config.dumps(sweep)
        return PillarLibrary(
            self.cell,
            sweep,
            sweep.polarizations,
            np.radians(sweep.angles_deg),
            np.array(sweep.wavelengths_um),
            diameters,
            t,
            r,
            table[2].real.copy(),
            np.abs(t) ** 2 + np.abs(r) ** 2,
            np.array(resonances, float).reshape(-1, 5),
            self.engine,
            solves,
            provenance=Provenance(config=text),
        )


def pick_nodes(values: tuple[float, ...], count: int = 5) -> tuple[float, ...]:
    """The values to solve first: ``count`` Leja points, or all where that leaves out
    one at most.

    Each Leja point maximises the product of its distances to those before it. This
    keeps the error factor of the polynomial through them small everywhere.

    Args:
        values: rising.
        count: with five, three are left where :func:`interpolate_row` leaves out two.
    """
    if len(values) <= count + 1:
        return values
    x = np.array(values)
    chosen = [0, len(x) - 1]
    while len(chosen) < count:
        chosen.append(int(np.argmax(np.prod(np.abs(x[:, None] - x[chosen]), axis=1))))
    return tuple(values[i] for i in sorted(chosen))


def _interpolate_family(
    rows: Rows,
    family: dict[float, Incidence],
    resonances: dict[Incidence, Array],
    diameters: Array,
) -> None:
    """Add the missing rows of a family by polynomials through its rows, in place, where
    as many exist as :func:`pick_nodes` takes.

    Where a narrow resonance moves from one node to the next, the diameters that it
    passes get an error of 1: they must be solved.

    Args:
        rows: by plane wave; extended.
        family: {position: plane wave} along wavelength or sin² of the angle.
        resonances: (k, 2) narrow ones of each curve: diameter and half-width, um.
        diameters: (n,) um.
    """
    solved = {x: wave for x, wave in family.items() if wave in rows}
    if len(solved) < len(pick_nodes(tuple(family))):
        return
    nodes = np.array(list(solved))
    table = np.stack([rows[wave] for wave in solved.values()])
    for x, wave in family.items():
        if wave not in rows:
            row = interpolate_row(nodes, table, x)
            right = int(np.searchsorted(nodes, x))
            below, above = (
                resonances.get(solved[float(nodes[i])], np.empty((0, 2)))
                for i in (right - 1, right)
            )
            crossed = _crossed_by_resonances(below, above, diameters)
            row[2] = np.where(crossed, 1.0, row[2])
            rows[wave] = row


def _crossed_by_resonances(first: Array, second: Array, diameters: Array) -> Array:
    """(n,) mask of the diameters that narrow resonances may pass between two
    neighbouring nodes.

    A resonance moves to the closest one of the other node, if that is within 0.02 um;
    else it may move 0.02 um either way. Four half-widths are added.

    Args:
        first: (k, 2) diameter and half-width at one node, um.
        second: the same at the other.
        diameters: (n,) um.
    """
    mask = np.zeros(len(diameters), bool)
    reach_um = 0.02  # largest move from one node to the next
    for poles, others in ((first, second), (second, first)):
        for centre, width in poles:
            distance = np.abs(others[:, 0] - centre)
            low, high = centre - reach_um, centre + reach_um
            if distance.size and distance.min() < reach_um:
                low, high = sorted((centre, float(others[np.argmin(distance), 0])))
            mask |= (diameters >= low - 4 * width) & (diameters <= high + 4 * width)
    return mask


def interpolate_row(nodes: Array, table: Array, x: float) -> Array:
    """(3, diameter) row at ``x`` by the polynomial through all nodes: t, r, error
    estimate.

    The error of t is extrapolated from leave-out tests. The first change c1 is that of
    t by leaving out one node, the second c2 by leaving out another one as well. Each
    node is taken to reduce the error by c1 / c2: error = 3 c1 min(1, c1 / c2), plus the
    nodes' errors times |weight|. Changes are the largest of nine neighbouring
    diameters, as one alone may vanish by chance.

    Args:
        nodes: (m,) positions.
        table: (m, 3, diameter) rows at the nodes.
        x: position of the new row.
    """
    weights = _lagrange_weights(nodes, x)
    row: Array = np.tensordot(weights, table, 1)

    def without(*left_out: int) -> Array:
        kept = np.delete(np.arange(len(nodes)), left_out)
        return np.asarray(_lagrange_weights(nodes[kept], x) @ table[kept, 0])

    first_change = np.zeros(table.shape[2])
    second_change = np.zeros(table.shape[2])
    for k in range(len(nodes)):
        reduced = without(k)
        first_change = np.maximum(first_change, np.abs(reduced - row[0]))
        for j in range(k):
            change = np.abs(without(j, k) - reduced)
            second_change = np.maximum(second_change, change)
    first_change = maximum_filter1d(first_change, 9)
    second_change = maximum_filter1d(second_change, 9)
    gain = np.minimum(1.0, first_change / np.maximum(second_change, 1e-300))
    row[2] = 3 * gain * first_change + np.abs(weights) @ table[:, 2].real
    return row


def _lagrange_weights(nodes: Array, x: float) -> Array:
    """(m,) Lagrange weights at ``x``: values of the polynomials that are 1 at one node
    and 0 at the others.
    """
    return np.asarray(BarycentricInterpolator(nodes, np.eye(len(nodes)))(x))


def with_rotations(library: PillarLibrary) -> PillarLibrary:
    """``library`` with its best pillar solved at several turns, at the middle wavelength."""
    wavelength = float(library.wavelength_um[len(library.wavelength_um) // 2])
    turned = solve_rotations(
        library.cell,
        library.best_converting_um,
        wavelength,
        tolerance=library.sweep.bar,
    )
    return dataclasses.replace(library, turned=turned)
