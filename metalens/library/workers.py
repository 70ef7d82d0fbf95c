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
from metalens.core.report import Console
from metalens.library import curve, engines
from metalens.library.curve import ResponseCurve, SolvedNodes

# of an entry's tolerance: for the solver, and for the rational fit
SOLVE_SHARE, FIT_SHARE = 0.5, 0.4


@dataclass(frozen=True, slots=True)
class Task:
    """Exact solves of one cell.

    kind: ``curves``: one curve t(D) a light over a range of sizes, at sizes that are
        chosen adaptively (:func:`metalens.library.curve.sample_adaptively`); lights of
        one wavelength and direction share the mesh, and the homogeneous modes of equal
        sizes. ``points``: the sizes themselves, each refined to the tolerance.
        ``jones``: both polarisations of one size at a fixed truncation; its rows are
        xx, xy, yx, yy (the polarisation that leaves, then that comes).
    lights: plane waves that come.
    sizes_um: (least, largest) of curves; else the sizes.
    tolerance: of t.
    engine: rcwa or modal.
    harmonics: largest diffraction order along an axis, of ``jones``.
    """

    kind: Literal["curves", "points", "jones"]
    cell: Cell
    lights: tuple[Incidence, ...]
    sizes_um: tuple[float, ...]
    tolerance: float
    engine: str = "rcwa"
    harmonics: int = 0


def run_task(task: Task) -> list[SolvedNodes]:
    """The solves of a task: a curve a light, or one set of rows."""
    cell, light = task.cell, task.lights[0]
    about: dict[str, Any] = {"tolerance": task.tolerance, "engine": task.engine}
    if task.kind == "jones":
        from metalens.rcwa import jones

        size = task.sizes_um[0]
        found = jones(cell, size, light.wavelength_um, harmonics=task.harmonics)
        response = np.stack([found.t.ravel(), found.r.ravel()], 1)
        return [SolvedNodes(np.full(4, size), response, np.full(4, found.t_error))]
    if task.kind == "points":
        solve = engines.solve_to_tolerance(cell, light, **about)
        made = [solve(d) for d in task.sizes_um]
        response = np.array([(one.t, one.r) for one in made])
        error = np.array([one.t_error for one in made])
        return [SolvedNodes(np.array(task.sizes_um), response, error)]
    low, high = task.sizes_um
    about["tolerance"] *= SOLVE_SHARE
    solves = engines.solvers_at_common_discretization(
        cell, task.lights, (low, high), **about
    )
    for diameter in curve.starting_diameters(low, high):
        for solve in solves:  # one after the other they share modes
            solve(diameter)
    curves: list[SolvedNodes] = []
    for solve in solves:  # later ones take diameters of those before, where these serve
        known = np.concatenate([np.empty(0), *(one.diameter_um for one in curves)])
        tolerance = FIT_SHARE * task.tolerance
        curves.append(
            curve.sample_adaptively(
                solve, low, high, tolerance=tolerance, cheaper_um=known
            )
        )
    return curves


def fit_curves(solved: list[SolvedNodes], *, tolerance: float) -> list[ResponseCurve]:
    """The curves t(D) through the solves of a task of curves.

    Args:
        solved: of the task.
        tolerance: that the task had.
    """
    return [
        curve.fit_response_curve(one, tolerance=FIT_SHARE * tolerance) for one in solved
    ]


def material_files(of: object) -> Iterator[Path]:
    """Files that the materials anywhere in a record (a cell, a film, a tuple of names)
    are read from.
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
    """Finished tasks as JSON lines in a file, so that interrupted work goes on where it
    stopped.

    The first line names the work: its settings and what the files of its materials
    hold. The journal of other work is begun afresh, a line that is damaged or cut short
    is dropped.

    Args:
        path: None keeps nothing. about: records of settings that the tasks follow from.

    Raises:
        StoreError: a file that is no journal stands there; later, that a file of a
            material was replaced.
    """

    def __init__(self, path: Path | None, *about: Any) -> None:
        self._path = path
        self._known: dict[str, list[SolvedNodes]] = {}
        self._read = {str(file): store.sha256(file) for file in material_files(about)}
        if path is not None:
            title = json.dumps([__version__, *map(config.dumps, about), self._read])
            for line in store.open_journal(path, title):
                self._know(line)

    def _know(self, line: str) -> None:
        """The solves of a line; a damaged one is dropped: its task is done again."""
        try:
            task, rows = json.loads(line)
            self._known[str(task)] = [SolvedNodes.from_json(row) for row in rows]
        except (ValueError, TypeError, KeyError, RecursionError):
            return

    def run(
        self, tasks: list[Task], console: Console, label: str
    ) -> list[list[SolvedNodes]]:
        """Solves of the tasks in order; those in the journal are not computed again."""
        keys = list(map(repr, tasks))
        left = [i for i, key in enumerate(keys) if key not in self._known]
        if left and len(left) < len(tasks):
            console.say(
                f"{label}: {len(tasks) - len(left)} of {len(tasks)} were done before"
            )
        stream = executor.run_parallel(run_task, [tasks[i] for i in left])
        for i, solved in console.track(stream, total=len(left), label=label):
            for file, before in self._read.items():  # workers read them anew
                if store.sha256(file) != before:
                    raise StoreError(f"{file} was changed or replaced: run again")
            self._known[keys[left[i]]] = solved
            if self._path is not None:
                row = [keys[left[i]], [one.to_json() for one in solved]]
                store.append_line(self._path, json.dumps(row))
        return [self._known[key] for key in keys]

    def finish(self) -> None:
        """The work is complete: its journal is no longer needed."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
