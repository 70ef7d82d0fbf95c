"""Tasks of sweeps, solves of curves or of some diameters, as JSON types alone; the
journal that keeps those done.
"""

import dataclasses
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from metalens import __version__
from metalens.cell import Cell, Incidence, Response, materials
from metalens.core import config, executor, store
from metalens.core.errors import StoreError
from metalens.core.report import Console
from metalens.library import curve as reduced
from metalens.library.curve import ResponseCurve, SolvedNodes
from metalens.library.engines import (
    solve_to_tolerance,
    solvers_at_common_discretization,
)

SOLVE_SHARE, FIT_SHARE = (
    0.5,
    0.4,
)  # of an entry's tolerance: for the solver, and for the rational fit
Task = dict[str, Any]
Result = dict[str, Any]


def curves_task(
    cell: Cell,
    lights: Sequence[Incidence],
    span_um: tuple[float, float],
    *,
    tolerance: float,
    engine: str,
) -> Task:
    """Exact solves of one curve t(D) a light, chosen adaptively
    (:func:`metalens.library.curve.sample_adaptively`).

    Lights of one wavelength and direction share the mesh, and the homogeneous modes at
    the diameters that every curve begins with.

    Args:
        cell: unit cell with its materials, shape and lattice.
        lights: plane waves that come.
        span_um: (least, largest) size, um.
        tolerance: error of t that is asked for.
        engine: auto, rcwa or modal.
    """
    return _task("curves", cell, lights, tolerance, engine) | {"span_um": list(span_um)}


def points_task(
    cell: Cell,
    light: Incidence,
    diameters_um: list[float],
    *,
    tolerance: float,
    engine: str,
) -> Task:
    """Exact solves at given diameters, each refined to the tolerance.

    Args:
        cell: unit cell with its materials, shape and lattice.
        light: plane wave that comes.
        diameters_um: sizes to solve, um.
        engine: auto, rcwa or modal.
    """
    return _task("points", cell, [light], tolerance, engine) | {
        "diameters_um": diameters_um
    }


def jones_task(
    cell: Cell, size_um: float, wavelength_um: float, *, tolerance: float, reach: int
) -> Task:
    """Both polarisations of one pillar at normal incidence, at a fixed truncation; the
    result has a row an element.

    Args:
        cell: unit cell with its materials, shape and lattice.
        size_um: of the pillar along x, um.
        wavelength_um: vacuum wavelength, um.
        tolerance: error of t that is asked for.
        reach: largest diffraction order along an axis.
    """
    light = Incidence(wavelength_um)
    return _task("jones", cell, [light], tolerance, "rcwa") | {
        "size_um": size_um,
        "harmonics": reach,
    }


def run_task(task: Task) -> Result:
    """Do one task; the result holds only JSON types."""
    cell = config.loads(task["cell"], Cell, where="task")
    lights = [Incidence(*one) for one in task["lights"]]
    if task["kind"] == "jones":
        return _solve_jones(cell, task["size_um"], lights[0], task["harmonics"])
    about: dict[str, Any] = {"tolerance": task["tolerance"], "engine": task["engine"]}
    if task["kind"] == "points":
        solve = solve_to_tolerance(cell, lights[0], **about)
        return _listed(task["diameters_um"], [solve(d) for d in task["diameters_um"]])
    low, high = task["span_um"]
    about["tolerance"] *= SOLVE_SHARE
    solves = solvers_at_common_discretization(cell, lights, (low, high), **about)
    for diameter in reduced.starting_diameters(
        low, high
    ):  # every curve begins with them: one after the other they share modes
        for solve in solves:
            solve(diameter)
    curves: list[Result] = []
    for solve in solves:  # later ones take diameters of those before, where these serve
        known = [d for one in curves for d in one["diameter_um"]]
        nodes = reduced.sample_adaptively(
            solve,
            low,
            high,
            tolerance=FIT_SHARE * task["tolerance"],
            cheaper_um=np.array(known),
        )
        diameters = nodes.diameter_um.tolist()
        ends = {"converged": nodes.converged, "reason": nodes.reason}
        curves.append(_listed(diameters, [solve(d) for d in diameters]) | ends)
    return {"curves": curves}


def solve_curves(result: Result, *, tolerance: float) -> list[ResponseCurve]:
    """The curves t(D) of a finished task of curves, one a light.

    Args:
        result: of the task.
        tolerance: that the task had.
    """
    made = []
    for one in result["curves"]:
        t, r = (np.array(one[name]) @ (1, 1j) for name in ("t", "r"))
        nodes = SolvedNodes(
            np.array(one["diameter_um"]),
            np.stack([t, r], 1),
            np.array(one["error"]),
            np.array(one["energy"]),
            one["converged"],
            one["reason"],
        )
        made.append(reduced.fit_response_curve(nodes, tolerance=FIT_SHARE * tolerance))
    return made


def _solve_jones(cell: Cell, size_um: float, light: Incidence, reach: int) -> Result:
    """Rows xx, xy, yx, yy: the polarisation that leaves, then that comes."""
    from metalens.rcwa import jones

    found = jones(cell, size_um, light.wavelength_um, harmonics=reach)
    return {
        "diameter_um": [size_um] * 4,
        "t": _pairs(found.t.ravel()),
        "r": _pairs(found.r.ravel()),
        "error": [found.t_error] * 4,
        "energy": [float(found.energy[k]) for k in (0, 1, 0, 1)],
    }


def run_tasks(
    tasks: list[Task], *, processes: int | None = None
) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as it is done, on all cores.

    Args:
        tasks: as the functions above make them.
        processes: workers; None: one a core.

    Raises:
        MetalensError: what a task raised, of the same class; WorkerError: a worker
            died.
    """
    return executor.run_parallel(run_task, tasks, processes=processes)


def _task(
    kind: str, cell: Cell, lights: Sequence[Incidence], tolerance: float, engine: str
) -> Task:
    waves = [
        [one.wavelength_um, one.angle_rad, one.polarization, one.azimuth_rad]
        for one in lights
    ]
    return {
        "kind": kind,
        "cell": config.dumps(cell),
        "lights": waves,
        "tolerance": tolerance,
        "engine": engine,
    }


def _listed(diameters_um: Iterable[float], made: list[Response]) -> Result:
    return {
        "diameter_um": list(diameters_um),
        "t": _pairs(m.t for m in made),
        "r": _pairs(m.r for m in made),
        "error": [m.t_error for m in made],
        "energy": [m.energy for m in made],
    }


def _pairs(values: Iterable[complex]) -> list[list[float]]:
    return [[float(v.real), float(v.imag)] for v in values]


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


def _entry(line: str) -> tuple[str, Result] | None:
    """(task, result) of a line of a journal; None for one that is damaged: its task is
    done again.
    """
    try:
        task, result = json.loads(line)
        for one in result.get("curves", [result]):
            columns = [np.array(one[name]) for name in ("t", "r")]
            columns += [np.array(one[name]) for name in ("diameter_um", "error")]
            if {len(column) for column in columns} != {len(one["energy"])}:
                return None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return str(task), result


class SweepJournal:
    """Finished tasks as JSON lines beside the output, so that interrupted work goes on
    where it stopped.

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
        self._known: dict[str, Result] = {}
        self._read = {file: store.sha256(file) for file in material_files(about)}
        if path is not None:
            read = {str(file): digest for file, digest in self._read.items()}
            title = json.dumps([__version__, *map(config.dumps, about), read])
            self._known = dict(
                filter(None, map(_entry, store.open_journal(path, title)))
            )

    def run(self, tasks: list[Task], console: Console, label: str) -> list[Result]:
        """Results of the tasks in order; those in the journal are not computed again."""
        keys = [json.dumps(task, sort_keys=True) for task in tasks]
        left = [i for i, key in enumerate(keys) if key not in self._known]
        if left and len(left) < len(tasks):
            console.say(
                f"{label}: {len(tasks) - len(left)} of {len(tasks)} were done before"
            )
        stream = run_tasks([tasks[i] for i in left])
        for i, result in console.track(stream, total=len(left), label=label):
            self._keep(keys[left[i]], result)
        return [self._known[key] for key in keys]

    def _keep(self, key: str, result: Result) -> None:
        for file, before in self._read.items():  # workers read them anew
            if store.sha256(file) != before:
                raise StoreError(f"{file} was changed or replaced: run again")
        self._known[key] = result
        if self._path is not None:
            store.append_line(self._path, json.dumps([key, result]))

    def finish(self) -> None:
        """The work is complete: its journal is no longer needed."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
