"""Tasks of sweeps in worker processes, and the journal that keeps those done."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens import __version__
from metalens.cell import Cell, Incidence, materials
from metalens.core import config, executor, store
from metalens.core.errors import StoreError
from metalens.core.report import CommandConsole
from metalens.library import curve, engines
from metalens.library.curve import ResponseCurve, SolvedNodes

# shares of an entry's tolerance: for the solver, and for the rational fit
SOLVE_SHARE, FIT_SHARE = 0.5, 0.4


@dataclass(frozen=True, slots=True)
class SweepTask:
    """Exact solves of one cell.

    kind: ``curve``: t(D) over a range of sizes, at sizes that are chosen adaptively
        (:func:`metalens.library.curve.sample_adaptively`). ``points``: the sizes
        themselves, each refined to the tolerance. ``jones``: both polarisations of one
        size at a fixed truncation; its rows are xx, xy, yx, yy (the polarisation that
        leaves, then that comes).
    light: plane wave that comes.
    sizes_um: (least, largest) of a curve; else the sizes.
    tolerance: of t.
    engine: rcwa or modal.
    harmonics: largest diffraction order along an axis, of ``jones``.
    """

    kind: Literal["curve", "points", "jones"]
    cell: Cell
    light: Incidence
    sizes_um: tuple[float, ...]
    tolerance: float
    engine: str = "rcwa"
    harmonics: int = 0


def run_task(task: SweepTask) -> SolvedNodes:
    """Solve a task: four rows of t and r of ``jones``, else a row per size."""
    cell, light = task.cell, task.light
    if task.kind == "jones":
        from metalens.rcwa import jones

        size = task.sizes_um[0]
        solution = jones(cell, size, light.wavelength_um, harmonics=task.harmonics)
        response = np.stack([solution.t.ravel(), solution.r.ravel()], 1)
        return SolvedNodes(np.full(4, size), response, np.full(4, solution.t_error))
    if task.kind == "points":
        solve = engines.solve_to_tolerance(
            cell, light, tolerance=task.tolerance, engine=task.engine
        )
        return SolvedNodes.of(task.sizes_um, [solve(d) for d in task.sizes_um])
    low, high = task.sizes_um
    solve = engines.solver_at_common_discretization(
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
