"""The planner: the tolerances, depths and wavelengths that keep the whole gaze error of a run below a goal.

What no setting changes (the person, fixation, noise, the reader of a run) is the floor: a goal below it is refused, one
above it leaves the rest of the squares to the settings.

A pilot measures, for every setting of every knob alone, the gaze error it makes for each eye and the time it takes: an
estimator that believes in these optics reads images through those of the knob's finest setting. Errors of several knobs
add as vectors to first order; where they happen to cancel, that is not relied on. Times add by the structure of the
run. All combinations are compared, and the cheapest that meets the goal is taken. Everything is judged against the
finest setting of every knob.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from codesign.budget import task
from codesign.budget.entry import NONE, Entry, total
from codesign.budget.floor import allowance_rad
from codesign.budget.journal import Journal
from codesign.budget.task import TaskSetting, Views
from codesign.optics import Aperture, Numerics, Window, kernels
from metalens import design, library
from metalens.cell import Cell, Light
from metalens.design import Focus
from metalens.ground.arrays import Array
from metalens.ground.errors import ConfigError
from metalens.image import PsfBasis
from metalens.lens import Lens
from metalens.pillars import Sweep, engines

LEVELS: dict[str, tuple[float, ...]] = {  # coarsest first; the last of each is the finest
    "library_tolerance": (3e-2, 1e-2, 1e-3, 1e-4),
    "depth_count": (4, 6, 8, 12, 16, 24, 32, 48),
    "wavelength_count": (1, 2, 3, 4, 6, 8),
    "psf_tolerance": (3e-2, 1e-2, 1e-3, 1e-4, 1e-5),
    "kernel_tolerance": (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4),
    "diameter_step_nm": (20, 10, 5, 2, 1),
}
PILOT = Numerics(12, 1, 1e-4, 1e-4)  # of the other knobs while one is looked at
REFERENCE_DIAMETERS = 12
SETTLE_STEPS = 2  # of the estimator, which starts at the true state
CLASS_SECONDS = 0.003  # a class of pillars on a mask: polygons, exposure at its edges, one cell


@dataclass(frozen=True, slots=True)
class PlanConfig:
    """PLAN.toml: the lens and the run that is planned.

    stacks: PSF stacks that the run computes. frames: images that it forms.
    """

    aperture_mm: float = 1.0
    wavelength_nm: float = field(default=850.0, metadata={"above": 0})
    sensor_distance_mm: float = field(default=2.0, metadata={"above": 0})
    source_distance_mm: float = field(default=20.0, metadata={"above": 0})
    led_fwhm_nm: float = 0.0
    stacks: int = 200
    frames: int = 10_000
    cell: Cell = library.DEFAULT_CELL
    task: TaskSetting = field(default_factory=TaskSetting)

    def __post_init__(self) -> None:
        if not (0.02 <= self.aperture_mm <= 4 and self.stacks >= 1 and self.frames >= 1 and self.led_fwhm_nm >= 0):
            raise ConfigError(
                f"aperture_mm = {self.aperture_mm}, stacks = {self.stacks}, frames = {self.frames}: need 0.02 to 4 mm, "
                "and 1 or more of both"
            )

    @property
    def focus(self) -> Focus:
        """What the lens images onto what."""
        return Focus(self.wavelength_nm * 1e-3, self.sensor_distance_mm * 1e3, self.source_distance_mm * 1e3)


@dataclass(frozen=True, slots=True)
class Choice:
    """A setting of every knob."""

    library_tolerance: float
    depth_count: int
    wavelength_count: int
    psf_tolerance: float
    kernel_tolerance: float
    diameter_step_nm: float

    @property
    def numerics(self) -> Numerics:
        """Of the optics."""
        return Numerics(self.depth_count, self.wavelength_count, self.psf_tolerance, self.kernel_tolerance)


@dataclass(frozen=True, eq=False, slots=True)
class Pilot:
    """What was measured for every knob: errors (levels, scenes, 2) in rad, and seconds (levels,) that depend on it.

    floor: links that no setting changes: the person, fixation, noise, and the reader where a run was given.
    """

    levels: dict[str, tuple[float, ...]]
    errors: dict[str, Array]
    seconds: dict[str, Array]
    noise_rad: float
    spent_seconds: float
    floor: tuple[Entry, ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """The cheapest choice: its predicted gaze error and seconds, and those of everything at its finest."""

    goal_rad: float
    choice: Choice
    predicted_rad: float
    seconds: float
    finest_seconds: float
    met: bool


class Chain:
    """The run to plan: its lens, eyes, and pillars at every library tolerance, computed when first asked for."""

    def __init__(self, config: PlanConfig, say: Callable[[str], None] = lambda text: None) -> None:
        config = replace(config, task=replace(config.task, sensor_distance_um=config.focus.sensor_distance_um))
        self.config, self.say = config, say
        self.levels = dict(LEVELS) if config.led_fwhm_nm else LEVELS | {"wavelength_count": (1.0,)}
        self.finest = Choice(*(row[-1] for row in self.levels.values()))  # type: ignore[arg-type]
        self._libraries: dict[float, tuple[library.PillarLibrary, float]] = {}
        self.states = config.task.states
        self.eyes: Views = task.views(config.task, self.states)
        self.window = Window(*self.eyes.depths_um, config.task.pitch_um)
        self.lens = self._design()
        self.aperture = Aperture(self.lens)

    def library(self, tolerance: float) -> tuple[library.PillarLibrary, float]:
        """The library at a tolerance, and the processor seconds it took."""
        if tolerance not in self._libraries:
            start = time.perf_counter()
            waves = (self.config.wavelength_nm * 1e-3,)
            made = library.sweep(self.config.cell, Sweep(waves, tolerance=tolerance))
            self._libraries[tolerance] = made, time.perf_counter() - start
            self.say(f"library at {tolerance:g}: {made.solves} solves")
        return self._libraries[tolerance]

    def table(self, tolerance: float) -> Array:
        """t of the aperture's diameters in the library of this tolerance."""
        made, _ = self.library(tolerance)
        t = made.t[:, 0, 0].mean(0)
        d = self.aperture.diameter_um
        phase, level = np.unwrap(np.angle(t)), np.abs(t)
        return np.asarray(np.interp(d, made.diameter_um, level) * np.exp(1j * np.interp(d, made.diameter_um, phase)))

    def optics(self, table: Array, numerics: Numerics) -> PsfBasis:
        """Kernels of the lens with these pillars."""
        maps = self.aperture.maps(table)
        return kernels(self.lens, maps, numerics, self.window, fwhm_nm=self.config.led_fwhm_nm)

    def electrons(self, optics: PsfBasis) -> torch.Tensor:
        """Images of the eyes."""
        return task.electrons(self.eyes.anchor, optics, self.config.task)

    def read(self, images: torch.Tensor, believed: PsfBasis) -> torch.Tensor:
        """(scenes, unknowns) where the estimate of the eyes' states comes to rest, less the true ones."""
        return task.settle(images, believed, self.states, self.config.task, seen=self.eyes, steps=SETTLE_STEPS)

    def _design(self) -> Lens:
        made, _ = self.library(self.levels["library_tolerance"][0])
        focus, aperture_um = self.config.focus, self.config.aperture_mm * 1e3
        wanted = design.phase_of(None, focus, radius_um=aperture_um / 2)
        return design.make(
            wanted, focus, aperture_um=aperture_um, cell=made.cell, proxy=library.proxy_of(made), profile="hyperbolic"
        )[0]


def pilot(chain: Chain, journal: Journal | None = None, *, floor: tuple[Entry, ...] = ()) -> Pilot:
    """Measure every setting of every knob alone. The finest library is sampled at a few diameters, not computed.

    Args:
        journal: of the knobs that an interrupted run has measured. floor: see :class:`Pilot`.
    """
    start, journal = time.perf_counter(), journal or Journal()
    real, imaginary, solving = journal.part("exact", lambda: _listed(chain))
    exact = np.array(real) + 1j * np.array(imaginary)
    base = chain.optics(exact, PILOT)
    errors, seconds = {}, {}
    for knob, levels in chain.levels.items():

        def measure(knob: str = knob) -> list[Any]:
            if knob == "library_tolerance":
                found = _library_knob(chain, base, solving)
            elif knob == "diameter_step_nm":
                found = _mask_knob(chain, base, exact)
            else:
                found = _optics_knob(chain, exact, knob)
            return [part.tolist() for part in found]

        errors[knob], seconds[knob] = map(np.array, journal.part(knob, measure))
        chain.say(f"{knob}: {', '.join(f'{v:g}' for v in levels)}")
    noise = task.linear(chain.eyes, base, chain.config.task).noise_rad
    if floor and not any(entry.link == "sensor noise" for entry in floor):
        mean = noise * math.sqrt(math.pi) / 2  # rms to mean of a Gaussian in the plane
        floor = (*floor, Entry("sensor noise", NONE, NONE, mean, "one frame: Cramér-Rao bound"))
    return Pilot(chain.levels, errors, seconds, noise, time.perf_counter() - start, floor)


def _listed(chain: Chain) -> list[Any]:
    """Real and imaginary parts of the exact table, and its seconds."""
    table, seconds = _exact(chain)
    return [table.real.tolist(), table.imag.tolist(), seconds]


def _exact(chain: Chain) -> tuple[Array, float]:
    """The designed table put right at a few diameters by the finest solver, and seconds of a whole sweep with it."""
    lens, tolerance = chain.lens, chain.levels["library_tolerance"][-1]
    low, high = lens.proxy.domain_um
    at = np.linspace(low, high, REFERENCE_DIAMETERS)
    light = Light(lens.wavelength_um)
    solve = engines.smooth(lens.cell, light, (low, high), tolerance=tolerance, engine=engines.choose(lens.cell))
    start = time.perf_counter()
    t = np.array([solve(float(d)).t for d in at])
    each = (time.perf_counter() - start) / len(at)
    coarse = chain.table(chain.levels["library_tolerance"][0])
    there = np.interp(at, chain.aperture.diameter_um, np.arange(len(coarse)))
    ratio = t / coarse[np.rint(there).astype(int)]
    change = [
        np.interp(chain.aperture.diameter_um, at, part) for part in (np.log(np.abs(ratio)), np.unwrap(np.angle(ratio)))
    ]
    made, _ = chain.library(chain.levels["library_tolerance"][0])
    return coarse * np.exp(change[0] + 1j * change[1]), each * 1.5 * made.solves


def _library_knob(chain: Chain, truth: PsfBasis, finest_seconds: float) -> tuple[Array, Array]:
    """Whole sweeps at all but the finest tolerance."""
    coarse = chain.levels["library_tolerance"][:-1]
    errors = [_misread(chain, truth, chain.optics(chain.table(tolerance), PILOT)) for tolerance in coarse]
    seconds = [*(chain.library(tolerance)[1] for tolerance in coarse), finest_seconds]
    return np.stack([*errors, np.zeros_like(errors[0])]), np.maximum.accumulate(np.array(seconds))


def _mask_knob(chain: Chain, believed: PsfBasis, exact: Array) -> tuple[Array, Array]:
    """Rounding of the diameters; the cost is that of the classes on the mask."""
    errors, seconds = [], []
    span = float(np.ptp(chain.aperture.diameter_um[np.flatnonzero(chain.aperture.share)]))
    for step in chain.levels["diameter_step_nm"]:
        truth = chain.optics(chain.aperture.rounded(exact, step * 1e-3), PILOT)
        errors.append(_misread(chain, truth, believed))
        seconds.append(CLASS_SECONDS * (span * 1e3 / step + 1))
    return np.stack(errors), np.array(seconds)


FIELD = {"depth_count": "depth_count", "wavelength_count": "wavelength_count", "psf_tolerance": "psf_tolerance",
         "kernel_tolerance": "basis_tolerance"}  # fmt: skip


def _optics_knob(chain: Chain, table: Array, knob: str) -> tuple[Array, Array]:
    """Settings of the optics, against the finest of this knob; seconds of a stack, or of an image for the kernels."""
    made, seconds = [], []
    around = replace(PILOT, depth_count=48) if knob == "kernel_tolerance" else PILOT
    for level in chain.levels[knob]:
        value: Any = int(level) if knob.endswith("count") else level
        numerics = replace(around, **{FIELD[knob]: value})
        made.append(chain.optics(table, numerics))  # plans the propagation, which a run does once
        if knob == "kernel_tolerance":
            seconds.append(_fastest(partial(chain.electrons, made[-1])) / chain.config.task.scenes)
        else:
            seconds.append(_fastest(partial(chain.optics, table, numerics)))
    errors = [_misread(chain, made[-1], optics) for optics in made[:-1]]
    return np.stack([*errors, np.zeros((chain.config.task.scenes, 2))]), np.maximum.accumulate(np.array(seconds))


def _fastest(work: Callable[[], object]) -> float:
    """Seconds of the faster of two calls."""
    spent = []
    for _ in range(2):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return min(spent)


def _misread(chain: Chain, truth: PsfBasis, believed: PsfBasis) -> Array:
    """(scenes, 2) error of the gaze that an estimator reads from images through optics other than it believes in."""
    return np.asarray(chain.read(chain.electrons(truth), believed)[:, :2].numpy())


def choose(measured: Pilot, goal_rad: float, config: PlanConfig) -> Plan:
    """The cheapest combination whose predicted error, with the floor, meets the goal; the finest where none does.

    Raises:
        ConfigError: the goal is not above the floor.
    """
    allowed = allowance_rad(goal_rad, measured.floor)
    names = list(measured.levels)
    grids = np.meshgrid(*(np.arange(len(measured.levels[n])) for n in names), indexing="ij")
    places = np.stack([g.ravel() for g in grids], 1)
    summed = np.sum([measured.errors[n][places[:, i]] for i, n in enumerate(names)], axis=0)
    vector = (summed**2).sum(-1).mean(-1)
    apart = np.sum([(measured.errors[n] ** 2).sum(-1).mean(-1)[places[:, i]] for i, n in enumerate(names)], axis=0)
    error = np.sqrt(np.maximum(vector, apart))
    cost = _cost(measured, places, names, config)
    good = np.flatnonzero(error <= allowed)
    best = int(good[cost[good].argmin()]) if len(good) else len(places) - 1
    values: list[Any] = [measured.levels[n][k] for n, k in zip(names, places[best], strict=True)]
    values = [int(v) if n.endswith("count") else v for n, v in zip(names, values, strict=True)]
    predicted = math.hypot(float(error[best]), total(list(measured.floor)).gaze_rad)
    return Plan(goal_rad, Choice(*values), predicted, float(cost[best]), float(cost[-1]), bool(len(good)))


def _cost(measured: Pilot, places: Array, names: list[str], config: PlanConfig) -> Array:
    """Seconds of the run: a library, the stacks (times of the knobs multiply), the images, the mask."""
    column = {n: measured.seconds[n][places[:, i]] for i, n in enumerate(names)}
    pilot_stack = {
        n: measured.seconds[n][_place(measured, n)] for n in ("depth_count", "wavelength_count", "psf_tolerance")
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


def achieved(chain: Chain, choice: Choice, truth: torch.Tensor) -> float:
    """Gaze error, rad, of the estimator that believes in the optics of ``choice``.

    Args:
        truth: images (scenes, pixels) of the eyes through the finest optics with the mask of ``choice``; see
            :func:`reality`.
    """
    optics = chain.optics(chain.table(choice.library_tolerance), choice.numerics)
    return task.gaze_rms(chain.read(truth, optics))


def reality(chain: Chain, diameter_step_nm: float) -> torch.Tensor:
    """Images of the eyes through the finest optics, pillars as the mask has them."""
    exact = chain.table(chain.finest.library_tolerance)
    return chain.electrons(chain.optics(chain.aperture.rounded(exact, diameter_step_nm * 1e-3), chain.finest.numerics))
