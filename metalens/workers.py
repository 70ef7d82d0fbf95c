"""Worker processes for sweeps: tasks and results travel as JSON lines, one BLAS thread a worker.

Workers are fresh interpreters that run this module, so a caller's script needs no main guard and no state is shared.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import Any

from metalens import config, errors, reduced
from metalens.cell import Cell
from metalens.engines import Light, precise, smooth
from metalens.errors import CellError, MetalensError
from metalens.response import Response

SOLVE_SHARE, FIT_SHARE = 0.5, 0.4  # of an entry's tolerance: for the solver, and for the rational fit
Task = dict[str, Any]
Result = dict[str, Any]
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}


def curve_task(cell: Cell, light: Light, span_um: tuple[float, float], *, tolerance: float, engine: str) -> Task:
    """Exact solves of one curve t(D), chosen adaptively (:func:`metalens.reduced.explore`)."""
    return _task("curve", cell, light, tolerance, engine) | {"span_um": list(span_um)}


def points_task(cell: Cell, light: Light, diameters_um: list[float], *, tolerance: float, engine: str) -> Task:
    """Exact solves at given diameters, each refined to the tolerance."""
    return _task("points", cell, light, tolerance, engine) | {"diameters_um": diameters_um}


def work(task: Task) -> Result:
    """Do one task; the result holds only JSON types."""
    cell = config.loads(task["cell"], Cell, where="task")
    light = Light(*task["light"])
    about: dict[str, Any] = {"tolerance": task["tolerance"], "engine": task["engine"]}
    if task["kind"] == "points":
        solve = precise(cell, light, **about)
        return _listed(task["diameters_um"], [solve(d) for d in task["diameters_um"]])
    low, high = task["span_um"]
    solve = smooth(cell, light, (low, high), **(about | {"tolerance": SOLVE_SHARE * task["tolerance"]}))
    made: dict[float, Response] = {}

    def remembered(diameter_um: float) -> Response:
        if diameter_um not in made:
            made[diameter_um] = solve(diameter_um)
        return made[diameter_um]

    nodes = reduced.explore(remembered, low, high, tolerance=FIT_SHARE * task["tolerance"])
    order = nodes.diameter_um.tolist()
    return _listed(order, [made[d] for d in order]) | {"converged": nodes.converged, "reason": nodes.reason}


def run(tasks: list[Task], *, processes: int | None = None) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as it is done, on all cores.

    Raises:
        MetalensError: what a task raised, of the same class; CellError: a worker ended without an answer.
    """
    count = min(processes or cores(), len(tasks))
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    done: queue.SimpleQueue[tuple[int, Result]] = queue.SimpleQueue()
    for i in range(len(tasks)):
        waiting.put(i)
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            worker = stack.enter_context(_worker())
            threading.Thread(target=_feed, args=(worker, tasks, waiting, done), daemon=True).start()
        for _ in tasks:
            i, result = done.get()
            if "refused" in result:
                raise getattr(errors, result["refused"], CellError)(result["message"])
            yield i, result


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _worker() -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", "from metalens.workers import serve; serve()"]
    path = os.pathsep.join(p for p in sys.path if p)
    worker = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
        start_new_session=True,
    )
    try:
        yield worker
    finally:
        worker.kill()
        worker.wait()
        for pipe in (worker.stdin, worker.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def _feed(worker: "subprocess.Popen[str]", tasks: list[Task], waiting: Any, done: Any) -> None:
    """Give a worker one task after the other (a thread of the parent)."""
    with contextlib.suppress(queue.Empty, ValueError):
        while True:
            i = waiting.get_nowait()
            try:
                worker.stdin.write(json.dumps(tasks[i]) + "\n")  # type: ignore[union-attr]
                worker.stdin.flush()  # type: ignore[union-attr]
                answer = worker.stdout.readline()  # type: ignore[union-attr]
            except OSError as error:
                answer = json.dumps({"refused": "CellError", "message": f"a worker process failed: {error}"})
            lost = {"refused": "CellError", "message": f"a worker process ended early (status {worker.poll()})"}
            done.put((i, json.loads(answer) if answer else lost))


def serve() -> None:
    """The loop of a worker: one JSON task a line in, one JSON result a line out."""
    for line in sys.stdin:
        try:
            result = work(json.loads(line))
        except MetalensError as error:
            result = {"refused": type(error).__name__, "message": str(error)}
        try:
            sys.stdout.write(json.dumps(result) + "\n")
            sys.stdout.flush()
        except BrokenPipeError:  # whoever asked was killed: nobody is left to tell
            os._exit(1)


def _task(kind: str, cell: Cell, light: Light, tolerance: float, engine: str) -> Task:
    wave = [light.wavelength_um, light.angle_rad, light.polarization]
    return {"kind": kind, "cell": config.dumps(cell), "light": wave, "tolerance": tolerance, "engine": engine}


def _listed(diameters_um: Iterable[float], made: list[Response]) -> Result:
    return {
        "diameter_um": list(diameters_um),
        "t": [[m.t.real, m.t.imag] for m in made],
        "r": [[m.r.real, m.r.imag] for m in made],
        "error": [m.t_error for m in made],
        "energy": [m.energy for m in made],
    }
