"""Which solver takes a pillar cell, and one whose error changes smoothly with the
diameter.
"""

import functools
import importlib
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from metalens.cell import Cell, Incidence, Response
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.library.curve import FIRST, starting_diameters

# indices in the starting diameters of a curve: 0.25, 0.63 and 1 of the span
PROBES = [4, 7, FIRST - 1]
# modal meshes of a curve: one for most diameters, and finer ones near a resonance
MESHES = 3
Engine = Literal["auto", "rcwa", "modal"]


def choose_engine(cell: Cell, engine: Engine = "auto") -> str:
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
    return functools.partial(_solve, engine, cell, light, {"tolerance": tolerance})


def solver_at_common_discretization(
    cell: Cell,
    light: Incidence,
    span_um: tuple[float, float],
    *,
    tolerance: float,
    engine: str,
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
    """
    if cell.height_um == 0 or (engine == "modal" and cell.sidewall_rad):
        return functools.cache(
            solve_to_tolerance(cell, light, tolerance=tolerance, engine=engine)
        )
    probes = np.array(starting_diameters(*span_um))[PROBES].tolist()
    if engine == "modal":
        from metalens.modal import LEVELS, case_of, refine_case

        def on_meshes(levels: range) -> Callable[[float], Response]:
            return lambda d: refine_case(case_of(cell, d, light), tolerance, levels)

        levels = range(1, len(LEVELS))
        for level in levels:
            on_mesh = on_meshes(range(level, level + 1))
            if sum(not on_mesh(probe).converged for probe in probes) <= 1:
                break
        return functools.cache(on_meshes(levels[level - 1 : level - 1 + MESHES]))
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
    settings = {"tolerance": tolerance}
    return [
        functools.partial(
            _solve, "rcwa", cell, light, settings | {"harmonics": harmonics}
        )
        for harmonics in truncations
    ]


def _solve(
    engine: str,
    cell: Cell,
    light: Incidence,
    settings: dict[str, Any],
    diameter_um: float,
) -> Response:
    """Response of one pillar by ``modal`` or ``rcwa``, imported on use.

    Args:
        engine: modal or rcwa.
        cell: unit cell.
        light: plane wave that comes.
        settings: keywords of the solver.
        diameter_um: of the pillar.
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
