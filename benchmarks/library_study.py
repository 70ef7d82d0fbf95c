"""Error bars on held-out diameters, with the real engine: ``python -m
benchmarks.library_study [FILE]``.

Curves t(D) as a sweep makes them, judged at random diameters by a reference on a finer
mesh: "good" at least, and finer
than the curve's. The reference is itself a rational curve, of a tolerance a hundred
times finer, held against direct
solves at diameters it never saw. Finished curves are kept in the file: an interrupted
study goes on where it stopped.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from metalens.cell.light import Light
from metalens.cell.record import Cell, Index
from metalens.cell.response import Response
from metalens.ground.arrays import Array
from metalens.modal.case import case_of
from metalens.modal.engine import evaluate
from metalens.modal.ladder import RUNGS
from metalens.pillars import curve as reduced
from metalens.pillars import workers
from metalens.pillars.curve import Curve, Nodes
from metalens.pillars.engines import smooth
from metalens.pillars.record import DEFAULT_CELL

FILE = Path(__file__).parent / "results" / "library_study.json"
HELD_OUT = 2500  # diameters a curve
DIRECT = 12  # direct solves that judge a reference
HARD = Cell(0.40, 0.7, Index(3.6), Index(1.4525), Index(1.0), Index(1.0))
CURVES = (
    ("0.40 um cell, all resonances", HARD, Light(0.85), (0.08, 0.32), 1e-3),
    ("0.30 um cell", DEFAULT_CELL, Light(0.85), (0.06, 0.205), 1e-3),
    ("0.30 um cell", DEFAULT_CELL, Light(0.85), (0.06, 0.205), 1e-4),
    (
        "0.30 um cell, 10 degrees p",
        DEFAULT_CELL,
        Light(0.85, float(np.radians(10)), "p"),
        (0.06, 0.205),
        1e-3,
    ),
)


def made(
    cell: Cell, light: Light, span: tuple[float, float], tolerance: float
) -> tuple[Curve, int]:
    """A curve as the workers of a sweep make it, and the place of its mesh in the
    ladder.
    """
    solve = smooth(
        cell, light, span, tolerance=workers.SOLVE_SHARE * tolerance, engine="modal"
    )
    nodes = reduced.explore(solve, *span, tolerance=workers.FIT_SHARE * tolerance)
    mesh = [f"mesh {rung.name}" for rung in RUNGS].index(solve(span[1]).reason)
    return reduced.curve(nodes, tolerance=workers.FIT_SHARE * tolerance), mesh


def finer(cell: Cell, light: Light, largest_um: float, mesh: int) -> Any:
    """t and r on a finer mesh than that of ``mesh`` for the largest diameter."""
    used, good = (
        RUNGS[mesh].choice(largest_um / cell.pitch_um).plan,
        [rung.name for rung in RUNGS].index("good"),
    )
    rung = next(
        rung for rung in RUNGS[max(mesh + 1, good) :] if rung.choice(1.0).plan != used
    )

    def at(diameter_um: float) -> Response:
        case = case_of(cell, diameter_um, light)
        found = evaluate(case, rung.choice(case.rho).plan, weak=rung.weak)
        error = rung.error(found, case.rho)
        t, r = complex(found.matrix[1, 0]), complex(found.matrix[0, 0])
        return Response(
            t, r, error, found.unknowns, found.energy, "modal", True, rung.name
        )

    return at


def judged(
    name: str, cell: Cell, light: Light, span: tuple[float, float], tolerance: float
) -> dict[str, Any]:
    """One curve against its reference."""
    start = time.process_time()
    curve, mesh = made(cell, light, span, tolerance)
    seconds = time.process_time() - start
    exact = finer(cell, light, span[1], mesh)
    nodes = reduced.explore(exact, *span, tolerance=tolerance / 100)
    reference = reduced.curve(silent(nodes), tolerance=tolerance / 100)
    random = np.random.default_rng(5)
    few = random.uniform(*span, DIRECT)
    own = max(
        abs(exact(float(d)).t - t)
        for d, t in zip(few, reference(few)[0][:, 0], strict=True)
    )
    held = random.uniform(*span, HELD_OUT)
    value, estimate = curve(held)
    error = np.abs(value[:, 0] - reference(held)[0][:, 0])
    return {
        "name": name,
        "tolerance": tolerance,
        "mesh": RUNGS[mesh].name,
        "solves": len(curve.nodes.diameter_um),
        "cpu_seconds": seconds,
        "reference_solves": len(nodes.diameter_um),
        "reference_mesh_error": float(nodes.error.max()),
        "reference_fit_error": own,
        "held_out": HELD_OUT,
        "within": int((error <= estimate).sum()),
        "largest_error": float(error.max()),
        "largest_estimate": float(estimate.max()),
        "median_ratio": float(np.median(estimate / np.maximum(error, 1e-300))),
    }


def silent(nodes: Nodes) -> Nodes:
    """The nodes without their own errors: the reference's are reported apart."""
    errors: Array = 0 * nodes.error
    return Nodes(
        nodes.diameter_um,
        nodes.response,
        errors,
        nodes.energy,
        nodes.converged,
        nodes.reason,
    )


def main(file: Path) -> None:
    found: list[dict[str, Any]] = (
        json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    )
    done = {(item["name"], item["tolerance"]) for item in found}
    for name, cell, light, span, tolerance in CURVES:
        if (name, tolerance) not in done:
            found.append(judged(name, cell, light, span, tolerance))
            file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    total, within = (
        sum(item["held_out"] for item in found),
        sum(item["within"] for item in found),
    )
    for item in found:
        print(
            f"{item['name']}, {item['tolerance']:g}: {item['within']} of {item['held_out']} within their estimate,"
        )
        print(
            f"    largest error {item['largest_error']:.1e}, largest estimate {item['largest_estimate']:.1e},"
        )
        print(
            f"    median estimate over error {item['median_ratio']:.1f}, {item['solves']} solves"
        )
    print(
        f"{within} of {total} held-out diameters within their estimate ({100 * within / total:.2f} %)"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
