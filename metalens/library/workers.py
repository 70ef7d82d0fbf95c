"""Solvers of pillar cells, tasks of sweeps in worker processes, and their journal."""

import dataclasses
import functools
import importlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens import __version__
from metalens.cell import Cell, Incidence, Response, materials
from metalens.core import config, executor, store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, StoreError
from metalens.core.report import CommandConsole
from metalens.library import curve
from metalens.library.curve import ResponseCurve, SolvedNodes, starting_diameters

# shares of an entry's tolerance: for the solver, and for the rational fit
SOLVE_SHARE, FIT_SHARE = 0.5, 0.4

# indices in the starting diameters of a curve: 0.25, 0.63 and 1 of the span
PROBES = [4, 7, 12]


def choose_engine(cell: Cell, engine: str = "auto") -> str:
    """Solver of a cell: ``modal`` for round pillars on a square lattice (more precise,
    and faster where upright), ``rcwa`` for others.

    Args:
        cell: unit cell with its materials, shape and lattice.
        engine: what is asked for: auto, rcwa or modal.

    Raises:
        CellError: the modal engine for another cell.
    """
    if engine == "modal" and not cell.round:
        raise CellError(
            f"the modal engine takes round pillars on a square lattice, not {cell.described}: use 'rcwa'"
        )
    if engine == "auto":
        return "modal" if cell.round else "rcwa"
    return engine


def solve_to_tolerance(
    cell: Cell, light: Incidence, *, tolerance: float, engine: str
) -> Callable[[float], Response]:
    """Solver of the response at a diameter in um, refined until its own error estimate
    meets the tolerance.

    Args:
        cell: unit cell with its materials, shape and lattice.
        light: plane wave that comes.
        engine: auto, rcwa or modal.
    """
    return functools.partial(_solve, engine, cell, light, tolerance=tolerance)


def solver_at_common_discretization(
    cell: Cell,
    light: Incidence,
    span_um: tuple[float, float],
    *,
    tolerance: float,
    engine: str,
    meshes: int = 3,
) -> Callable[[float], Response]:
    """Solver on the coarsest common discretisation that meets the tolerance at three
    probe diameters; responses are cached.

    A curve over the span solves the probes anyhow. Elsewhere the error of coupled waves
    may exceed the tolerance (it is reported), but it has no jumps that a rational fit
    would take for resonances. Meshes of the modal method need to meet it at two of the
    probes only. Near a resonance, where the error is many times larger, the next mesh
    takes over. The jump is then the true error of the coarser mesh, about a tenth of
    its bar.

    Args:
        cell: unit cell with its materials, shape and lattice.
        light: plane wave that comes.
        span_um: (least, largest) size, um.
        tolerance: error of t that is asked for.
        engine: rcwa or modal.
        meshes: of the modal method: one for most diameters, and finer ones near a
            resonance.
    """
    if cell.height_um == 0 or (engine == "modal" and cell.sidewall_rad):
        return functools.cache(
            solve_to_tolerance(cell, light, tolerance=tolerance, engine=engine)
        )
    probes = np.array(starting_diameters(*span_um))[PROBES].tolist()
    if engine == "modal":
        from metalens.modal import LEVELS, case_of, refine_case

        def on_meshes(levels: Sequence[int]) -> Callable[[float], Response]:
            return lambda d: refine_case(case_of(cell, d, light), tolerance, levels)

        levels = range(1, len(LEVELS))
        for level in levels:
            on_mesh = on_meshes((level,))
            if sum(not on_mesh(probe).converged for probe in probes) <= 1:
                break
        return functools.cache(on_meshes(levels[level - 1 : level - 1 + meshes]))
    for solve in map(functools.cache, _rcwa_levels(cell, light, span_um[1], tolerance)):
        if all(solve(probe).converged for probe in probes):
            break
    return solve


def is_at_finest_discretization(cell: Cell, errors: Array, tolerance: float) -> bool:
    """Whether :func:`solver_at_common_discretization` took the finest one: a
    single solve of a pillar is then no better.

    Args:
        cell: unit cell with its materials, shape and lattice.
        errors: (n,) of t at the nodes of a curve, the starting diameters first.
        tolerance: error of t that is asked for.
    """
    return not cell.round and bool(errors[PROBES].max() > tolerance)


def _rcwa_levels(
    cell: Cell, light: Incidence, largest_um: float, tolerance: float
) -> list[Callable[[float], Response]]:
    """Solvers by coupled waves, fewest harmonics first.

    Args:
        largest_um: size that limits the harmonics of shapes that are not round.
        tolerance: of t; only decides whether a response has converged.
    """
    truncations: tuple[int, ...] = (6, 8, 10, 12, 14)
    if not cell.round:
        from metalens.rcwa import most_harmonics

        most = most_harmonics(
            cell, largest_um, angle_rad=light.angle_rad, azimuth_rad=light.azimuth_rad
        )
        truncations = (*range(6, most - 1, 2), most) if most > 6 else (most - 1, most)
    solve = functools.partial(_solve, "rcwa", cell, light, tolerance=tolerance)
    return [functools.partial(solve, harmonics=harmonics) for harmonics in truncations]


def _solve(
    engine: str, cell: Cell, light: Incidence, diameter_um: float, **settings: float
) -> Response:
    """Response of one pillar by ``modal`` or ``rcwa``, imported on use.

    Args:
        engine: modal or rcwa.
        cell: unit cell.
        light: plane wave that comes.
        diameter_um: of the pillar.
        settings: keywords of the solver.
    """
    solver = importlib.import_module(f"metalens.{engine}")
    response: Response = solver.solve(
        cell,
        diameter_um,
        light.wavelength_um,
        angle_rad=light.angle_rad,
        azimuth_rad=light.azimuth_rad,
        polarization=light.polarization,
        **settings,
    )
    return response


@dataclass(frozen=True, slots=True)
class SweepTask:
    """Exact solves of one cell.

    kind: ``curve``: t(D) over a range of sizes, at sizes that are chosen adaptively
        (:func:`metalens.library.curve.sample_adaptively`). ``point``: one size, refined
        to the tolerance. ``jones``: both polarisations of one size at a fixed
        truncation; its rows are xx, xy, yx, yy (the polarisation that leaves, then that
        comes).
    light: plane wave that comes.
    sizes_um: (least, largest) of a curve; else the size.
    tolerance: of t.
    engine: rcwa or modal.
    harmonics: largest diffraction order along an axis, of ``jones``.
    """

    kind: Literal["curve", "point", "jones"]
    cell: Cell
    light: Incidence
    sizes_um: tuple[float, ...]
    tolerance: float
    engine: str = "rcwa"
    harmonics: int = 0


def run_task(task: SweepTask) -> SolvedNodes:
    """Solve a task: four rows of t and r of ``jones``, else a row per size."""
    cell, light = task.cell, task.light
    size = task.sizes_um[0]
    if task.kind == "jones":
        from metalens.rcwa import jones

        solution = jones(cell, size, light.wavelength_um, harmonics=task.harmonics)
        response = np.stack([solution.t.ravel(), solution.r.ravel()], 1)
        return SolvedNodes(np.full(4, size), response, np.full(4, solution.t_error))
    if task.kind == "point":
        solve = solve_to_tolerance(
            cell, light, tolerance=task.tolerance, engine=task.engine
        )
        return SolvedNodes.of([size], [solve(size)])
    low, high = task.sizes_um
    solve = solver_at_common_discretization(
        cell,
        light,
        (low, high),
        tolerance=SOLVE_SHARE * task.tolerance,
        engine=task.engine,
    )
    tolerance = FIT_SHARE * task.tolerance
    return curve.sample_adaptively(solve, low, high, tolerance=tolerance)


def fit_curve(solved: SolvedNodes, *, tolerance: float) -> ResponseCurve:
    """Rational curve t(D) through the solves of a task of kind ``curve``.

    Args:
        solved: of the task.
        tolerance: that the task had.
    """
    return curve.fit_response_curve(solved, tolerance=FIT_SHARE * tolerance)


def material_files(of: object) -> Iterator[Path]:
    """Files that the materials in a record are read from, nested records and tuples
    included.

    Args:
        of: a cell, film, material name, or tuple of them.
    """
    if isinstance(of, str):
        if of not in materials.NAMES and Path(of).is_file():
            yield Path(of)
    elif dataclasses.is_dataclass(of):
        for field in dataclasses.fields(of):
            yield from material_files(getattr(of, field.name))
    elif isinstance(of, tuple):
        for part in of:
            yield from material_files(part)


class SweepJournal:
    """Finished tasks as JSON lines in a file, so that interrupted work can be resumed.

    The first line names the work: its settings and the SHA-256 of its material files.
        The journal of other work is replaced; a damaged or truncated line is dropped.

    Args:
        path: of the journal; None keeps nothing.
        about: records of settings that the tasks follow from.

    Raises:
        StoreError: a file that is no journal stands there; later, that a file of a
            material was replaced.
    """

    def __init__(self, path: Path | None, *about: Any) -> None:
        self._path = path
        self._known: dict[str, SolvedNodes] = {}
        self._read = {str(file): store.sha256(file) for file in material_files(about)}
        if path is not None:
            title = json.dumps([__version__, *map(config.dumps, about), self._read])
            for line in store.open_journal(path, title):
                self._know(line)

    def _know(self, line: str) -> None:
        """Store the solves of a journal line; a damaged line is ignored."""
        try:
            task, row = json.loads(line)
            self._known[str(task)] = SolvedNodes.from_json(row)
        except (ValueError, TypeError, KeyError, RecursionError):
            return

    def run(
        self, tasks: list[SweepTask], console: CommandConsole, label: str
    ) -> list[SolvedNodes]:
        """Solves of the tasks in order; those in the journal are not computed again.

        Args:
            tasks: what is solved, in parallel.
            console: where progress is shown.
            label: names the tasks in the progress.

        Raises:
            StoreError: a file of a material was changed meanwhile.
        """
        keys = list(map(repr, tasks))
        pending = [i for i, key in enumerate(keys) if key not in self._known]
        if pending and len(pending) < len(tasks):
            console.say(
                f"{label}: {len(tasks) - len(pending)} of {len(tasks)} were done before"
            )
        stream = executor.run_parallel(run_task, [tasks[i] for i in pending])
        for i, solved in console.track(stream, total=len(pending), label=label):
            for file, digest in self._read.items():  # workers read them anew
                if store.sha256(file) != digest:
                    raise StoreError(f"{file} was changed or replaced: run again")
            self._known[keys[pending[i]]] = solved
            if self._path is not None:
                row = [keys[pending[i]], solved.to_json()]
                store.append_line(self._path, json.dumps(row))
        return [self._known[key] for key in keys]

    def finish(self) -> None:
        """Remove the journal of complete work."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
