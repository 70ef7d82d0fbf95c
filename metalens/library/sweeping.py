"""Run a library sweep: rational curves t(D) at a few wavelengths and angles, polynomials
between them, single solves where neither meets the tolerance.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter1d

from metalens.cell import Cell, Incidence, Polarization
from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.report import Console
from metalens.core.store import Provenance
from metalens.library import engines, workers
from metalens.library.curve import ResponseCurve
from metalens.library.geometric_phase import solve_rotations
from metalens.library.record import PillarLibrary, Sweep, check_sweep
from metalens.library.workers import SweepJournal, Task

Rows = dict[Incidence, Array]  # (3, diameter) complex: t, r, error estimate
POINTS = 8  # entries a task when solved one by one
NODES = 5  # values of an axis that are solved first, where it has more than six


def sweep(
    cell: Cell,
    settings: Sweep | None = None,
    *,
    wavelengths_um: tuple[float, ...] | None = None,
    console: Console | None = None,
    checkpoint: Path | None = None,
) -> PillarLibrary:
    """Compute a library.

    Args:
        settings: what it holds; wavelengths_um: instead of those of the settings.
        console: where progress is shown.
        checkpoint: file for finished curves; a sweep that was interrupted goes on from
            it, to the same result.
        cell: unit cell with its materials, shape and lattice.

    Raises:
        CellError, MaterialError: see :func:`metalens.library.record.check_sweep`.
    """
    settings = settings or Sweep()
    if wavelengths_um is not None:
        settings = dataclasses.replace(settings, wavelengths_um=wavelengths_um)
    check_sweep(cell, settings)
    work = _SweepRun(cell, settings.with_tolerance(cell), console, checkpoint)
    return work.library()


class _SweepRun:
    """The curves of a sweep that was checked, by plane wave."""

    def __init__(
        self, cell: Cell, sweep: Sweep, console: Console | None, checkpoint: Path | None
    ) -> None:
        self.cell, self.sweep, self.span = cell, sweep, sweep.span_um(cell)
        self.console = console or Console(quiet=True)
        self.engine = engines.choose_engine(cell, sweep.engine)  # type: ignore[arg-type]
        self.journal = SweepJournal(checkpoint, cell, sweep)
        self.curves: dict[Incidence, ResponseCurve] = {}

    def library(self) -> PillarLibrary:
        """Curves are solved at a few wavelengths and angles first; those that
        polynomials between them do not give within the tolerance are solved too, and
        single entries that are still above it one by one.
        """
        sweep = self.sweep
        nodes = pick_nodes(sweep.wavelengths_um), pick_nodes(sweep.angles_deg)
        self.solve(
            [
                self.wave(wavelength, angle, polarization)
                for angle in nodes[1]
                for polarization in sweep.polarizations
                for wavelength in nodes[0]
            ],
            "curves",
        )
        diameters = _diameters(self.span, sweep.samples, list(self.curves.values()))
        rows = self.rows(diameters)
        weak = [  # a curve takes some twenty solves
            light
            for light, row in rows.items()
            if light not in self.curves and self.misses(row).sum() > 20
        ]
        if weak:
            self.solve(weak, "more curves")
            rows = self.rows(diameters)
        points = self.points(diameters, rows)
        solved = self.journal.run(points, self.console, "entries one by one")
        for task, (made,) in zip(points, solved, strict=True):
            row = rows[task.lights[0]]
            place = np.searchsorted(diameters, made.diameter_um)
            better = made.error < row[2, place].real
            values = np.concatenate([made.response.T, made.error[None]])
            row[:, place[better]] = values[:, better]
        count = sum(len(one.nodes.diameter_um) for one in self.curves.values())
        count += sum(len(task.sizes_um) for task in points)
        found = self.record(diameters, rows, count)
        self.journal.finish()
        return found

    def wave(
        self, wavelength_um: float, angle_deg: float, polarization: Polarization
    ) -> Incidence:
        """The plane wave of an entry. At normal incidence s and p are x and y: of cells
        that respond equally to both x alone, of others s is y (the plane of incidence is
        along x).
        """
        if not angle_deg and polarization in ("s", "p"):
            along_y = polarization == "s" and not self.cell.alike
            polarization = "y" if along_y else "x"
        return Incidence(wavelength_um, math.radians(angle_deg), polarization)

    def solve(self, lights: list[Incidence], label: str) -> None:
        """Add the curves of some plane waves.

        Those of one wavelength and direction share their work in one task where the
        solver can. Oblique light comes first: it takes several times as long as normal
        incidence, which then fills the end.
        """
        share = engines.has_upright_walls(self.cell, self.engine)
        groups: dict[object, list[Incidence]] = {}
        for one in sorted(dict.fromkeys(lights), key=lambda light: -light.angle_rad):
            key = (one.wavelength_um, one.angle_rad) if share else one
            groups.setdefault(key, []).append(one)
        about = self.sweep.bar, self.engine
        tasks = [
            Task("curves", self.cell, tuple(group), self.span, *about)
            for group in groups.values()
        ]
        for task, solved in zip(
            tasks, self.journal.run(tasks, self.console, label), strict=True
        ):
            made = workers.fit_curves(solved, tolerance=self.sweep.bar)
            self.curves |= dict(zip(task.lights, made, strict=True))

    def misses(self, row: Array) -> Array:
        """Entries of a row whose error is above the tolerance."""
        return np.asarray(row[2].real > self.sweep.bar)

    def rows(self, diameters: Array) -> Rows:
        """All rows of the sweep: those of the curves, then between wavelengths, then
        between angles.
        """
        rows: Rows = {}
        sharp = {}
        for light, curve in self.curves.items():
            value, error = curve(diameters)
            rows[light] = np.stack([value[:, 0], value[:, 1], error])
            sharp[light] = curve.resonances(0.005)  # between nodes it shows at neither
        sweep = self.sweep
        for polarization in sweep.polarizations:
            for angle in sweep.angles_deg:
                family = {
                    w: self.wave(w, angle, polarization) for w in sweep.wavelengths_um
                }
                _interpolate_family(rows, family, sharp, diameters)
            for wavelength in sweep.wavelengths_um:
                family = {
                    math.sin(math.radians(a)) ** 2: self.wave(
                        wavelength, a, polarization
                    )
                    for a in sweep.angles_deg
                }
                _interpolate_family(rows, family, sharp, diameters)
        return rows

    def points(self, diameters: Array, rows: Rows) -> list[Task]:
        """Tasks for the entries whose error bar is above the tolerance, but where a
        solve by itself is no better.
        """
        tasks = []
        for light, row in rows.items():
            misses, bar = self.misses(row), self.sweep.bar
            curve = self.curves.get(light)
            if curve and engines.is_at_finest_discretization(
                self.cell, curve.nodes.error, bar * workers.SOLVE_SHARE
            ):
                misses &= curve.solver_error(diameters) <= bar
            bad = diameters[misses].tolist()
            for start in range(0, len(bad), POINTS):
                some = tuple(bad[start : start + POINTS])
                tasks.append(
                    Task("points", self.cell, (light,), some, bar, self.engine)
                )
        return tasks

    def record(self, diameters: Array, rows: Rows, solves: int) -> PillarLibrary:
        """The library of all rows."""
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


def _diameters(
    span: tuple[float, float], samples: int, curves: list[ResponseCurve]
) -> Array:
    """Even samples, and more where t turns fast: around every resonance, on its own
    scale.
    """
    low, high = span
    most = 400  # diameters that are added
    even = np.linspace(low, high, samples)
    sharp = np.concatenate([curve.resonances() for curve in curves])
    wide = 3 * (even[1] - even[0])  # well sampled already
    # resonances narrower than 0.1 nm cannot be printed, and are not sampled
    sharp = sharp[(sharp[:, 1] > 1e-4) & (sharp[:, 1] < wide)]
    half_widths = np.array([-3.0, -1.0, -0.3, 0.3, 1.0, 3.0])
    added = (sharp[:, :1] + half_widths * sharp[:, 1:]).ravel()
    added = np.unique(np.round(added[(added > low) & (added < high)], 6))
    return np.unique(
        np.concatenate([even, added[:: max(1, math.ceil(len(added) / most))]])
    )


def pick_nodes(values: tuple[float, ...]) -> tuple[float, ...]:
    """The values to solve first: all of a few, else five Leja points.

    Each is where the product of the distances to those before it is largest, which
    keeps that product, the factor of the error of the polynomial through them, small
    everywhere.
    """
    if len(values) <= NODES + 1:
        return values
    x = np.array(values)
    chosen = [0, len(x) - 1]
    while len(chosen) < NODES:
        chosen.append(int(np.argmax(np.prod(np.abs(x[:, None] - x[chosen]), axis=1))))
    return tuple(values[i] for i in sorted(chosen))


def _interpolate_family(
    rows: Rows,
    family: dict[float, Incidence],
    sharp: dict[Incidence, Array],
    diameters: Array,
) -> None:
    """Add the rows of a family (position: light) that are missing, where at least five
    are there.

    Where a narrow resonance moves from one node to the next, the diameters it passes
    have an error of 1: they must be solved.
    """
    have = {x: wave for x, wave in family.items() if wave in rows}
    if len(have) < NODES:
        return
    nodes = np.array(list(have))
    table = np.stack([rows[wave] for wave in have.values()])
    for x, wave in family.items():
        if wave not in rows:
            row = interpolate_row(nodes, table, x)
            right = int(np.searchsorted(nodes, x))
            first, second = (
                sharp.get(have[float(nodes[i])], np.empty((0, 2)))
                for i in (right - 1, right)
            )
            passed = _crossed_by_resonances(first, second, diameters)
            row[2] = np.where(passed, 1.0, row[2])
            rows[wave] = row


def _crossed_by_resonances(first: Array, second: Array, diameters: Array) -> Array:
    """Mask of the diameters that narrow resonances may pass between two neighbouring
    nodes.
    """
    mask = np.zeros(len(diameters), bool)
    moves_um = 0.02  # at most, from one node to the next
    for here, there in ((first, second), (second, first)):
        for centre, width in here:
            gap = np.abs(there[:, 0] - centre)
            end = (
                float(there[np.argmin(gap), 0])
                if gap.size and gap.min() < moves_um
                else None
            )
            low, high = (
                (centre - moves_um, centre + moves_um)
                if end is None
                else sorted((centre, end))
            )
            mask |= (diameters >= low - 4 * width) & (diameters <= high + 4 * width)
    return mask


def interpolate_row(nodes: Array, table: Array, x: float) -> Array:
    """(3, diameter) row at ``x`` by the polynomial through all nodes.

    The error is extrapolated. Leaving out one node changes the row by the error of the
    next lower degree, leaving out two by that of the degree below; where the second is
    less than the first by some factor, the polynomial through all nodes is better by
    that factor again. Changes are taken as the largest of neighbouring diameters, as
    any one may vanish by chance; the result is trebled, and the errors of the nodes are
    added as they enter.

    nodes: (m,). table: (m, 3, diameter).
    """
    weights = lagrange_weights(nodes, x)
    row: Array = np.tensordot(weights, table, 1)
    one, two = np.zeros(table.shape[2]), np.zeros(table.shape[2])
    for k in range(len(nodes)):
        keep = np.arange(len(nodes)) != k
        without = np.tensordot(lagrange_weights(nodes[keep], x), table[keep, 0], 1)
        one = np.maximum(one, np.abs(without - row[0]))
        for j in range(k):
            fewer = keep & (np.arange(len(nodes)) != j)
            two = np.maximum(
                two,
                np.abs(
                    np.tensordot(lagrange_weights(nodes[fewer], x), table[fewer, 0], 1)
                    - without
                ),
            )
    one, two = (maximum_filter1d(change, 9) for change in (one, two))
    gain = np.minimum(1.0, one / np.maximum(two, 1e-300))
    row[2] = 3 * gain * one + np.abs(weights) @ table[:, 2].real
    return row


def lagrange_weights(nodes: Array, x: float) -> Array:
    """(m,) weights of the values at the nodes in the polynomial through them at ``x``."""
    ratio = (x - nodes[None, :]) / (
        nodes[:, None] - nodes[None, :] + np.eye(len(nodes))
    )
    return np.asarray(
        np.prod(np.where(np.eye(len(nodes), dtype=bool), 1.0, ratio), axis=1)
    )


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
