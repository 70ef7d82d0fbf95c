"""The planner: the tolerances, depths and wavelengths that keep the whole gaze error of
a run below a goal.

What no setting changes (the person, fixation, noise, the reader of a run) is the floor:
a goal below it is refused, one
above it leaves the rest of the squares to the settings.

A pilot measures, for every setting of every knob alone, the gaze error it makes for
each eye and the time it takes: an
estimator that believes in these optics reads images through those of the knob's finest
setting. Images are true, over
field, depth and spectrum, or of one PSF a depth where PLAN.toml says so
(:mod:`codesign.budget.chain`). Errors of
several knobs add as vectors to first order; where they happen to cancel, that is not
relied on. Times add by the
structure of the run. All combinations are compared, and the cheapest that meets the
goal is taken. Everything is judged
against the finest setting of every knob.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from codesign.budget import task
from codesign.budget.chain import (
    LEVELS,
    PILOT,
    TRUE_LEVELS,
    Chain,
    Choice,
    Imaging,
    Optics,
    PlanConfig,
    TrueChoice,
    choice_of,
)
from codesign.budget.entry import NONE, Entry, total
from codesign.budget.floor import allowance_rad
from codesign.budget.journal import Journal
from codesign.budget.response import put_right
from metalens.cell import Light
from metalens.ground.arrays import Array
from metalens.image import Imager
from metalens.pillars import engines

REFERENCE_DIAMETERS = 12
CLASS_SECONDS = (
    0.003  # a class of pillars on a mask: polygons, exposure at its edges, one cell
)


@dataclass(frozen=True, eq=False, slots=True)
class Pilot:
    """What was measured for every knob: errors (levels, scenes, 2) in rad, and seconds
    (levels,) that depend on it.

    floor: links that no setting changes: the person, fixation, noise, and the reader
    where a run was given.
    nodes: of every tolerance of the true image: rows and columns of the field, depths,
    wavelengths.
    """

    levels: dict[str, tuple[float, ...]]
    errors: dict[str, Array]
    seconds: dict[str, Array]
    noise_rad: float
    spent_seconds: float
    floor: tuple[Entry, ...] = ()
    nodes: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """The cheapest choice: its predicted gaze error and seconds, and those of
    everything at its finest.
    """

    goal_rad: float
    choice: Choice | TrueChoice
    predicted_rad: float
    seconds: float
    finest_seconds: float
    met: bool


def pilot(
    chain: Chain, journal: Journal | None = None, *, floor: tuple[Entry, ...] = ()
) -> Pilot:
    """Measure every setting of every knob alone. The finest library is sampled at a few
    diameters, not computed.

    Args:
        journal: of the knobs that an interrupted run has measured. floor: see
            :class:`Pilot`.
    """
    start, journal = time.perf_counter(), journal or Journal()
    real, imaginary, solving = journal.part("exact", lambda: _listed(chain))
    exact = np.array(real) + 1j * np.array(imaginary)
    base = chain.optics(exact, chain.around)
    errors, seconds = {}, {}
    nodes: tuple[tuple[int, ...], ...] = ()
    for knob, levels in chain.levels.items():

        def measure(knob: str = knob) -> list[Any]:
            found: tuple[Array, ...]
            if knob == "library_tolerance":
                found = library_knob(chain, base, solving)
            elif knob == "diameter_step_nm":
                found = mask_knob(chain, base, exact)
            elif knob == "image_tolerance":
                found = image_knob(chain, exact)
            else:
                found = optics_knob(chain, exact, knob)
            return [part.tolist() for part in found]

        parts = journal.part(knob, measure)
        errors[knob], seconds[knob] = map(np.array, parts[:2])
        nodes = tuple(map(tuple, parts[2])) if parts[2:] else nodes
        chain.say(f"{knob}: {', '.join(f'{v:g}' for v in levels)}")
    noise = task.linear(chain.eyes, base, chain.config.task).noise_rad
    if floor and not any(entry.link == "sensor noise" for entry in floor):
        mean = noise * math.sqrt(math.pi) / 2  # rms to mean of a Gaussian in the plane
        floor = (
            *floor,
            Entry("sensor noise", NONE, NONE, mean, "one frame: Cramér-Rao bound"),
        )
    return Pilot(
        chain.levels, errors, seconds, noise, time.perf_counter() - start, floor, nodes
    )


def _listed(chain: Chain) -> list[Any]:
    """Real and imaginary parts of the exact table, and its seconds."""
    table, seconds = exact_table(chain)
    return [table.real.tolist(), table.imag.tolist(), seconds]


def exact_table(chain: Chain) -> tuple[Array, float]:
    """The designed table put right at a few diameters by the finest solver, and seconds
    of a whole sweep with it.
    """
    lens, tolerance = chain.lens, chain.levels["library_tolerance"][-1]
    low, high = lens.proxy.domain_um
    at = np.linspace(low, high, REFERENCE_DIAMETERS)
    light = Light(lens.wavelength_um)
    solve = engines.smooth(
        lens.cell,
        light,
        (low, high),
        tolerance=tolerance,
        engine=engines.choose(lens.cell),
    )
    start = time.perf_counter()
    t = np.array([solve(float(d)).t for d in at])
    each = (time.perf_counter() - start) / len(at)
    coarse = chain.table(chain.levels["library_tolerance"][0])
    there = np.interp(at, chain.aperture.diameter_um, np.arange(len(coarse)))
    ratio = t / coarse[np.rint(there).astype(int)]
    made, _ = chain.library(chain.levels["library_tolerance"][0])
    return put_right(
        coarse, chain.aperture.diameter_um, at, ratio
    ), each * 1.5 * made.solves


def library_knob(
    chain: Chain, truth: Optics, finest_seconds: float
) -> tuple[Array, Array]:
    """Whole sweeps at all but the finest tolerance."""
    coarse = chain.levels["library_tolerance"][:-1]
    errors = [
        misread(chain, truth, chain.optics(chain.table(tolerance), chain.around))
        for tolerance in coarse
    ]
    seconds = [*(chain.library(tolerance)[1] for tolerance in coarse), finest_seconds]
    return np.stack(
        [*errors, np.zeros((chain.config.task.scenes, 2))]
    ), np.maximum.accumulate(np.array(seconds))


def mask_knob(chain: Chain, believed: Optics, exact: Array) -> tuple[Array, Array]:
    """Rounding of the diameters; the cost is that of the classes on the mask."""
    errors, seconds = [], []
    span = float(
        np.ptp(chain.aperture.diameter_um[np.flatnonzero(chain.aperture.share)])
    )
    for step in chain.levels["diameter_step_nm"]:
        truth = chain.optics(chain.aperture.rounded(exact, step * 1e-3), chain.around)
        errors.append(misread(chain, truth, believed))
        seconds.append(CLASS_SECONDS * (span * 1e3 / step + 1))
    return np.stack(errors), np.array(seconds)


FIELD = {"depth_count": "depth_count", "wavelength_count": "wavelength_count", "psf_tolerance": "psf_tolerance",
         "kernel_tolerance": "basis_tolerance"}  # fmt: skip


def optics_knob(chain: Chain, table: Array, knob: str) -> tuple[Array, Array]:
    """Settings of the optics, against the finest of this knob; seconds of a stack, or
    of an image for the kernels.
    """
    made, seconds = [], []
    around = replace(PILOT, depth_count=48) if knob == "kernel_tolerance" else PILOT
    for level in chain.levels[knob]:
        value: Any = int(level) if knob.endswith("count") else level
        numerics = replace(around, **{FIELD[knob]: value})
        made.append(
            chain.optics(table, numerics)
        )  # plans the propagation, which a run does once
        if knob == "kernel_tolerance":
            seconds.append(
                _fastest(partial(chain.electrons, made[-1])) / chain.config.task.scenes
            )
        else:
            seconds.append(_fastest(partial(chain.optics, table, numerics)))
    errors = [misread(chain, made[-1], optics) for optics in made[:-1]]
    return np.stack(
        [*errors, np.zeros((chain.config.task.scenes, 2))]
    ), np.maximum.accumulate(np.array(seconds))


def image_knob(chain: Chain, table: Array) -> tuple[Array, Array, Array]:
    """Tolerances of the true image, against the finest; seconds of all PSFs and images
    of the run, and the nodes.
    """
    made: list[Optics] = []
    seconds, nodes = [], []
    for level in chain.levels["image_tolerance"]:
        made.append(
            chain.optics(table, level)
        )  # plans the field, which a run does once
        stack = _fastest(partial(chain.optics, table, level))
        image = _fastest(partial(chain.electrons, made[-1])) / chain.config.task.scenes
        seconds.append(chain.config.stacks * stack + chain.config.frames * image)
        nodes.append(nodes_of(made[-1]))
    errors = [misread(chain, made[-1], optics) for optics in made[:-1]]
    none = np.zeros((chain.config.task.scenes, 2))
    return (
        np.stack([*errors, none]),
        np.maximum.accumulate(np.array(seconds)),
        np.array(nodes),
    )


def nodes_of(optics: Optics) -> tuple[int, ...]:
    """Rows and columns of the field's nodes, depths, wavelengths of a true image."""
    if not isinstance(optics, Imager):
        raise TypeError("only a true image has nodes over the field")
    plan = optics.plan
    return len(plan.y_um), len(plan.x_um), len(plan.depths_um), len(plan.waves.weights)


def _fastest(work: Callable[[], object]) -> float:
    """Seconds of the faster of two calls."""
    spent = []
    for _ in range(2):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return min(spent)


def misread(chain: Chain, truth: Optics, believed: Optics) -> Array:
    """(scenes, 2) error of the gaze that an estimator reads from images through optics
    other than it believes in.
    """
    return np.asarray(chain.read(chain.electrons(truth), believed)[:, :2].numpy())


def choose(measured: Pilot, goal_rad: float, config: PlanConfig) -> Plan:
    """The cheapest combination whose predicted error, with the floor, meets the goal;
    the finest where none does.

    Raises:
        ConfigError: the goal is not above the floor.
    """
    allowed = allowance_rad(goal_rad, measured.floor)
    names = list(measured.levels)
    grids = np.meshgrid(
        *(np.arange(len(measured.levels[n])) for n in names), indexing="ij"
    )
    places = np.stack([g.ravel() for g in grids], 1)
    summed = np.sum(
        [measured.errors[n][places[:, i]] for i, n in enumerate(names)], axis=0
    )
    vector = (summed**2).sum(-1).mean(-1)
    apart = np.sum(
        [
            (measured.errors[n] ** 2).sum(-1).mean(-1)[places[:, i]]
            for i, n in enumerate(names)
        ],
        axis=0,
    )
    error = np.sqrt(np.maximum(vector, apart))
    cost = cost_s(measured, places, names, config)
    good = np.flatnonzero(error <= allowed)
    best = int(good[cost[good].argmin()]) if len(good) else len(places) - 1
    choice = choice_of(
        names, [measured.levels[n][k] for n, k in zip(names, places[best], strict=True)]
    )
    predicted = math.hypot(float(error[best]), total(list(measured.floor)).gaze_rad)
    return Plan(
        goal_rad, choice, predicted, float(cost[best]), float(cost[-1]), bool(len(good))
    )


def cost_s(
    measured: Pilot, places: Array, names: list[str], config: PlanConfig
) -> Array:
    """Seconds of the run: a library, the stacks (times of the knobs multiply), the
    images, the mask.
    """
    column = {n: measured.seconds[n][places[:, i]] for i, n in enumerate(names)}
    if "image_tolerance" in column:
        return np.asarray(np.sum([*column.values()], axis=0))
    pilot_stack = {
        n: measured.seconds[n][_place(measured, n)]
        for n in ("depth_count", "wavelength_count", "psf_tolerance")
    }
    stack = column["depth_count"]
    for n in ("wavelength_count", "psf_tolerance"):
        stack = stack * column[n] / pilot_stack[n]
    return np.asarray(
        column["library_tolerance"]
        + config.stacks * stack
        + config.frames * column["kernel_tolerance"]
        + column["diameter_step_nm"]
    )


def _place(measured: Pilot, knob: str) -> int:
    return measured.levels[knob].index(getattr(PILOT, knob))


__all__ = [
    "LEVELS", "PILOT", "TRUE_LEVELS", "Chain", "Choice", "Imaging", "Pilot", "Plan", "PlanConfig", "TrueChoice",
    "choose", "nodes_of", "pilot",
]  # fmt: skip
