"""Run a library sweep: one rational curve t(D) for every wavelength, angle and
polarisation, on all cores.
"""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np

from metalens.cell import Cell, Incidence
from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.report import Console
from metalens.core.store import Provenance
from metalens.library import engines, few_nodes, workers
from metalens.library.curve import ResponseCurve
from metalens.library.few_nodes import Rows
from metalens.library.geometric_phase import solve_rotations
from metalens.library.record import PillarLibrary, Sweep, check_sweep
from metalens.library.workers import Result, SweepJournal, Task

AROUND = (
    -3.0,
    -1.0,
    -0.3,
    0.3,
    1.0,
    3.0,
)  # half-widths from a resonance where diameters are added
FINEST_UM = 1e-4  # resonances narrower than this cannot be printed, and are not sampled
MOST_ADDED = 400
POINTS = 8  # entries a task when solved one by one
WORTH_A_CURVE = 20  # entries above the tolerance: a curve takes about as many solves


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
    settings = settings.settled(cell)
    return _run(cell, settings, console=console, checkpoint=checkpoint)


def _run(
    cell: Cell, sweep: Sweep, *, console: Console | None, checkpoint: Path | None
) -> PillarLibrary:
    """The library of a sweep that was checked.

    Curves are solved at a few wavelengths and angles first; those that polynomials
    between them do not give within the tolerance are solved too, and single entries
    that are still above it one by one.
    """
    console = console or Console(quiet=True)
    engine = engines.choose_engine(cell, sweep.engine)  # type: ignore[arg-type]
    journal = SweepJournal(checkpoint, cell, sweep)
    span = sweep.span_um(cell)
    normal = few_nodes.ALIKE if cell.alike else few_nodes.UNLIKE

    def solved(lights: list[Incidence], label: str) -> dict[Incidence, ResponseCurve]:
        groups = _together(lights, engines.has_upright_walls(cell, engine))
        tasks = [
            workers.curves_task(cell, some, span, tolerance=sweep.bar, engine=engine)
            for some in groups
        ]
        results = journal.run(tasks, console, label)
        made = [
            curve
            for one in results
            for curve in workers.solve_curves(one, tolerance=sweep.bar)
        ]
        return dict(zip(itertools.chain(*groups), made, strict=True))

    first = few_nodes.sweep_plane_waves(
        sweep,
        few_nodes.pick_nodes(sweep.wavelengths_um),
        few_nodes.pick_nodes(sweep.angles_deg),
        normal,
    )
    curves = solved(first, "curves")
    diameters = _diameters(span, sweep.samples, list(curves.values()))
    rows = {light: _evaluate(curve, diameters) for light, curve in curves.items()}
    full = few_nodes.complete_sweep(sweep, rows, _poles(curves), diameters, normal)
    weak = [
        light
        for light, row in full.items()
        if light not in curves and _misses(row, sweep).sum() > WORTH_A_CURVE
    ]
    if weak:
        more = solved(weak, "more curves")
        curves |= more
        rows |= {light: _evaluate(curve, diameters) for light, curve in more.items()}
        full = few_nodes.complete_sweep(sweep, rows, _poles(curves), diameters, normal)
    extra = _points(cell, sweep, engine, diameters, full, curves)
    for task, result in zip(
        extra, journal.run(extra, console, "entries one by one"), strict=True
    ):
        _replace(full[Incidence(*task["lights"][0])], diameters, result)
    solves = sum(len(c.nodes.diameter_um) for c in curves.values()) + sum(
        len(t["diameters_um"]) for t in extra
    )
    made = _library(cell, sweep, (engine, solves), diameters, curves, full, normal)
    journal.finish()
    return made


def _together(lights: list[Incidence], share: bool) -> list[list[Incidence]]:
    """Where lights of one wavelength and direction share their work, these in one task,
    else each in its own.

    Oblique light comes first: it takes several times as long as normal incidence, which
    then fills the end.
    """
    groups: dict[object, list[Incidence]] = {}
    for one in sorted(lights, key=lambda light: -light.angle_rad):
        groups.setdefault(
            (one.wavelength_um, one.angle_rad) if share else one, []
        ).append(one)
    return list(groups.values())


def _poles(curves: dict[Incidence, ResponseCurve]) -> dict[Incidence, Array]:
    return {light: curve.resonances() for light, curve in curves.items()}


def _misses(row: Array, sweep: Sweep) -> Array:
    return np.asarray(row[2].real > sweep.bar)


def _evaluate(curve: ResponseCurve, diameters: Array) -> Array:
    value, error = curve(diameters)
    return np.stack([value[:, 0], value[:, 1], error])


def _diameters(
    span: tuple[float, float], samples: int, curves: list[ResponseCurve]
) -> Array:
    """Even samples, and more where t turns fast: around every resonance, on its own
    scale.
    """
    low, high = span
    even = np.linspace(low, high, samples)
    sharp = np.concatenate([curve.resonances() for curve in curves])
    wide = 3 * (even[1] - even[0])  # well sampled already
    sharp = sharp[(sharp[:, 1] > FINEST_UM) & (sharp[:, 1] < wide)]
    added = (sharp[:, :1] + np.array(AROUND) * sharp[:, 1:]).ravel()
    added = np.unique(np.round(added[(added > low) & (added < high)], 6))
    return np.unique(
        np.concatenate([even, added[:: max(1, math.ceil(len(added) / MOST_ADDED))]])
    )


def _points(
    cell: Cell,
    sweep: Sweep,
    engine: str,
    diameters: Array,
    full: Rows,
    curves: dict[Incidence, ResponseCurve],
) -> list[Task]:
    """Tasks for the entries whose error bar is above the tolerance, but where a solve
    by itself is no better.
    """
    tasks = []
    for light, row in full.items():
        misses = _misses(row, sweep)
        if light in curves and engines.is_at_finest_discretization(
            cell, curves[light].nodes.error, sweep.bar * workers.SOLVE_SHARE
        ):
            misses &= curves[light].solver_error(diameters) <= sweep.bar
        bad = diameters[misses].tolist()
        for start in range(0, len(bad), POINTS):
            some = bad[start : start + POINTS]
            tasks.append(
                workers.points_task(
                    cell, light, some, tolerance=sweep.bar, engine=engine
                )
            )
    return tasks


def _replace(row: Array, diameters: Array, result: Result) -> None:
    """Put single solves in place of the curve's values where their error is less."""
    places: list[int] = np.searchsorted(
        diameters, np.array(result["diameter_um"])
    ).tolist()
    for place, t, r, error in zip(
        places, result["t"], result["r"], result["error"], strict=True
    ):
        if error < row[2, place].real:
            row[:, place] = complex(*t), complex(*r), error


def _library(
    cell: Cell,
    sweep: Sweep,
    effort: tuple[str, int],
    diameters: Array,
    curves: dict[Incidence, ResponseCurve],
    full: Rows,
    normal: few_nodes.Normal,
) -> PillarLibrary:
    shape = (
        len(sweep.polarizations),
        len(sweep.angles_deg),
        len(sweep.wavelengths_um),
        len(diameters),
    )
    t, r, error = np.empty(shape, complex), np.empty(shape, complex), np.empty(shape)
    resonances = []
    for i, j, k in np.ndindex(*shape[:3]):
        light = few_nodes.plane_wave(
            sweep.wavelengths_um[k], sweep.angles_deg[j], sweep.polarizations[i], normal
        )
        row = full[light]
        t[i, j, k], r[i, j, k], error[i, j, k] = row[0], row[1], row[2].real
        if light in curves:
            poles = curves[light].resonances()
            resonances += [
                (i, light.angle_rad, light.wavelength_um, *pole) for pole in poles
            ]
    return PillarLibrary(
        cell,
        sweep,
        sweep.polarizations,
        np.radians(sweep.angles_deg),
        np.array(sweep.wavelengths_um),
        diameters,
        t,
        r,
        error,
        np.abs(t) ** 2 + np.abs(r) ** 2,
        np.array(resonances, float).reshape(-1, 5),
        *effort,
        provenance=Provenance(config=config.dumps(cell) + "\n" + config.dumps(sweep)),
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
