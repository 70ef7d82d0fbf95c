"""Reference values of hard pillars: ``python -m benchmarks.studies.modal_reference [FILE]`` (an
hour on one core).

Each value is the mean of both forms on the finer of two unrelated meshes, its
uncertainty the distance to the mean
on the other. Entries already in the file are kept unless they were made on coarser
meshes than are asked for now, so an
interrupted run goes on where it stopped.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Index
from metalens.modal.case import case_of
from metalens.modal.mesh import MeshPlan, build_mesh
from metalens.modal.solver import solve_on_mesh
from metalens.modal.spaces import select_functions

FILE = Path(__file__).parents[1] / "results" / "reference_pillars.json"
FINEST = MeshPlan(7, 7, (0.05, 0.3), (0.7,), core=0.55)
FINE = MeshPlan(6, 7, (0.15,), core=0.55)
BOTH = MeshPlan(5, 6, (0.15,), core=0.5)
OTHER = MeshPlan(5, 5, (0.15,), (0.7,), core=0.55)
NORMAL = (FINEST, FINE)
OBLIQUE = (BOTH, OTHER)
NOT_ENOUGH = (
    (0.272, 5.0),
    (0.272, 10.0),
    (0.272, 20.0),
    (0.2, 20.0),
)  # diameters and angles for the finest meshes
PAPER = Cell(0.40, 0.7, Index(3.6), Index(1.4525), Index(1.0), Index(1.0))
NIR = Cell(0.40, 0.7, Index(3.6), Index(1.4513), Index(1.0), Index(1.0))
DISPUTED = Cell(0.418, 0.7, Index(3.698, 0.0086), Index(1.4513), Index(1.0), Index(1.0))
Wanted = tuple[str, Cell, float, float, float, str, tuple[MeshPlan, MeshPlan]]


def absorbing(k: float) -> Cell:
    return Cell(0.40, 0.7, Index(3.6, k), Index(1.4525), Index(1.0), Index(1.0))


def wanted() -> list[Wanted]:
    """Name, cell, diameter, wavelength, angle in degrees, polarisation, the two meshes."""
    out: list[Wanted] = []
    for d, name in (
        (0.08, "thin"),
        (0.128, "128"),
        (0.2, "200"),
        (0.1937, "dip"),
        (0.272, "272"),
        (0.302, "flank"),
    ):
        out.append((name, PAPER, d, 0.85, 0.0, "x", NORMAL))
    out.append(("wide", PAPER, 0.32, 0.85, 0.0, "x", NORMAL))
    out.append(("needle", PAPER, 0.01, 0.85, 0.0, "x", NORMAL))
    for d in (0.15, 0.2, 0.25):
        out.append(("940", NIR, d, 0.94, 0.0, "x", NORMAL))
        out.append(("disputed", DISPUTED, d, 0.94, 0.0, "x", NORMAL))
    for k in (0.1, 3.0):
        out.append((f"absorbing {k:g}", absorbing(k), 0.2, 0.85, 0.0, "x", NORMAL))
    out.append(("nearly touching", PAPER, 0.39, 0.85, 0.0, "x", NORMAL))
    for height in (50.0, 1000.0):
        out.append(
            (
                f"{height:g} um tall",
                replace(PAPER, height_um=height),
                0.2,
                0.85,
                0.0,
                "x",
                NORMAL,
            )
        )
    for angle in (5.0, 10.0, 20.0):
        for d in (0.2, 0.272, 0.128):
            for polarization in "ps":
                name = (
                    "dark mode"
                    if (angle, d, polarization) == (5.0, 0.272, "p")
                    else "oblique"
                )
                plans = NORMAL if (d, angle) in NOT_ENOUGH else OBLIQUE
                out.append((name, PAPER, d, 0.85, angle, polarization, plans))
    return out


def entry(
    name: str, cell: Cell, d: float, wavelength: float, angle: float, p: str, plans: Any
) -> dict[str, Any]:
    """Solve one case on both meshes."""
    case = case_of(cell, d, Incidence(wavelength, float(np.deg2rad(angle)), p))
    finer, other = (solve_on_mesh(case, plan) for plan in plans)
    t, r = finer.matrix[1, 0], finer.matrix[0, 0]
    return {
        "name": name,
        "cell": {
            "pitch_um": cell.pitch_um,
            "height_um": cell.height_um,
            **{
                part: [getattr(cell, part).n, getattr(cell, part).k]
                for part in ("pillar", "substrate", "cover", "between")
            },
        },
        "diameter_um": d,
        "wavelength_um": wavelength,
        "angle_deg": angle,
        "polarization": p,
        "t": [t.real, t.imag],
        "r": [r.real, r.imag],
        "uncertainty": float(np.abs(finer.matrix - other.matrix).max()),
        "unknowns": [finer.unknowns // 2, other.unknowns // 2],
        "half_difference": [finer.half_difference, other.half_difference],
    }


def unknowns(plan: MeshPlan, angle: float) -> int:
    """Of one form on a mesh, mean of both."""
    wall, phase = build_mesh(plan).vector_wall, 0.1 if angle else None
    if phase is None:
        return len(select_functions(wall, electric=False, half_phase_rad=None)[0])
    return (
        sum(
            len(select_functions(wall, electric=electric, half_phase_rad=phase)[0])
            for electric in (True, False)
        )
        // 2
    )


def identity(item: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(
        item[key]
        for key in ("name", "diameter_um", "wavelength_um", "angle_deg", "polarization")
    )


def main(file: Path) -> None:
    document: dict[str, Any] = {
        "about": "Zero-order t and r of round pillars, power-normalised, exp(-iwt), phases from foot to top, light "
        "from the substrate; angles in vacuum. Mean of the electric and magnetic forms of metalens.modal on the finer "
        "of two meshes; uncertainty: largest distance of the scattering matrices of the two meshes.",
        "made_by": "python -m benchmarks.studies.modal_reference",
        "entries": [],
    }
    if file.exists():
        document["entries"] = json.loads(file.read_text(encoding="utf-8"))["entries"]
    done = {identity(item): at for at, item in enumerate(document["entries"])}
    for name, cell, d, wavelength, angle, p, plans in wanted():
        at = done.get((name, d, wavelength, angle, p))
        if at is not None and document["entries"][at]["unknowns"][0] >= unknowns(
            plans[0], angle
        ):
            continue
        start = time.perf_counter()
        item = entry(name, cell, d, wavelength, angle, p, plans)
        if at is None:
            document["entries"].append(item)
        else:
            document["entries"][at] = item
        file.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        print(
            f"{name:16s} {d:.4f} {angle:4.1f} {p}  +-{item['uncertainty']:.1e}  {time.perf_counter() - start:.0f} s"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
