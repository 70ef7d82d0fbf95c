"""Tasks of sweeps, as JSON types alone, so that a journal can keep them: solves of one curve or of some diameters."""

from collections.abc import Iterable, Iterator
from typing import Any

from metalens.cell import Cell, Light, Response
from metalens.ground import config, executor
from metalens.pillars import curve as reduced
from metalens.pillars.engines import precise, smooth

SOLVE_SHARE, FIT_SHARE = 0.5, 0.4  # of an entry's tolerance: for the solver, and for the rational fit
Task = dict[str, Any]
Result = dict[str, Any]


def curve_task(cell: Cell, light: Light, span_um: tuple[float, float], *, tolerance: float, engine: str) -> Task:
    """Exact solves of one curve t(D), chosen adaptively (:func:`metalens.pillars.curve.explore`)."""
    return _task("curve", cell, light, tolerance, engine) | {"span_um": list(span_um)}


def points_task(cell: Cell, light: Light, diameters_um: list[float], *, tolerance: float, engine: str) -> Task:
    """Exact solves at given diameters, each refined to the tolerance."""
    return _task("points", cell, light, tolerance, engine) | {"diameters_um": diameters_um}


def jones_task(cell: Cell, size_um: float, wavelength_um: float, *, tolerance: float, reach: int) -> Task:
    """Both polarisations of one pillar at normal incidence, at a fixed truncation; the result has a row an element."""
    light = Light(wavelength_um)
    return _task("jones", cell, light, tolerance, "rcwa") | {"size_um": size_um, "harmonics": reach}


def work(task: Task) -> Result:
    """Do one task; the result holds only JSON types."""
    cell = config.loads(task["cell"], Cell, where="task")
    light = Light(*task["light"])
    if task["kind"] == "jones":
        return _both_polarizations(cell, task["size_um"], light, task["harmonics"])
    about: dict[str, Any] = {"tolerance": task["tolerance"], "engine": task["engine"]}
    if task["kind"] == "points":
        solve = precise(cell, light, **about)
        return _listed(task["diameters_um"], [solve(d) for d in task["diameters_um"]])
    low, high = task["span_um"]
    solve = smooth(cell, light, (low, high), **(about | {"tolerance": SOLVE_SHARE * task["tolerance"]}))
    nodes = reduced.explore(solve, low, high, tolerance=FIT_SHARE * task["tolerance"])
    order = nodes.diameter_um.tolist()
    return _listed(order, [solve(d) for d in order]) | {"converged": nodes.converged, "reason": nodes.reason}


def _both_polarizations(cell: Cell, size_um: float, light: Light, reach: int) -> Result:
    """Rows xx, xy, yx, yy: the polarisation that leaves, then that comes."""
    from metalens.rcwa import jones

    found = jones(cell, size_um, light.wavelength_um, harmonics=reach)
    rows = zip(found.t.ravel().tolist(), found.r.ravel().tolist(), [0, 1, 0, 1], strict=True)
    made = [Response(t, r, found.t_error, found.orders, float(found.energy[k]), "rcwa", True, "") for t, r, k in rows]
    return _listed([size_um] * 4, made)


def run(tasks: list[Task], *, processes: int | None = None) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as it is done, on all cores or a cluster.

    Raises:
        MetalensError: what a task raised, of the same class; WorkerError: a worker died.
    """
    return executor.run(work, tasks, processes=processes)


def _task(kind: str, cell: Cell, light: Light, tolerance: float, engine: str) -> Task:
    wave = [light.wavelength_um, light.angle_rad, light.polarization, light.azimuth_rad]
    return {"kind": kind, "cell": config.dumps(cell), "light": wave, "tolerance": tolerance, "engine": engine}


def _listed(diameters_um: Iterable[float], made: list[Response]) -> Result:
    return {
        "diameter_um": list(diameters_um),
        "t": [[m.t.real, m.t.imag] for m in made],
        "r": [[m.r.real, m.r.imag] for m in made],
        "error": [m.t_error for m in made],
        "energy": [m.energy for m in made],
    }
