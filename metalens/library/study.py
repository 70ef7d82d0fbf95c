"""Which pillar cell to take: over pitch, height and wavelength, how much phase do
printable pillars cover smoothly?
"""

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from metalens.cell import Cell, Incidence, Material, index
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ConfigError
from metalens.core.report import CommandConsole
from metalens.library.curve import ResponseCurve
from metalens.library.fit import find_faults, find_runs
from metalens.library.proxy import MOST_ERROR
from metalens.library.record import PLAIN, Sweep, check_light
from metalens.library.workers import SweepJournal, SweepTask, choose_engine, fit_curve


@dataclass(frozen=True, slots=True)
class CellStudy:
    """What is compared.

    pitches_um, heights_um, wavelengths_um: every combination.
    pillar: material of the pillars, on the substrate and under the cover of
        :class:`metalens.cell.Cell`.
    cell: any cell in its place: substrate, cover, shape, lattice, films, wall and
        material of every pillar; its pitch and height are those compared, and
        "diameter" is the size of its shape. Light is along x, at normal incidence.
    min_diameter_um, min_gap_um: what can be printed: the least width of a shape, and
        between two.
    least_transmission: |t| below this ends a smooth stretch.
    least_half_width_um: so does a resonance narrower than this.
    tolerance: error of t, up to 0.1; diameters whose error bar is above half of |t| end
        a stretch.
    """

    pitches_um: tuple[float, ...] = (
        0.28,
        0.29,
        0.30,
        0.31,
        0.32,
        0.34,
        0.36,
        0.38,
        0.40,
        0.42,
        0.45,
    )
    heights_um: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    wavelengths_um: tuple[float, ...] = (0.85, 0.94)
    pillar: Material = PLAIN
    min_diameter_um: float = field(default=0.08, metadata={"above": 0})
    min_gap_um: float = 0.06
    least_transmission: float = 0.8
    least_half_width_um: float = 0.005
    tolerance: float = field(default=3e-3, metadata={"above": 0})
    cell: Cell | None = None

    def __post_init__(self) -> None:
        """Refuse settings that contradict each other or leave no printable pillar."""
        if self.cell is not None and self.pillar != PLAIN:
            raise ConfigError(
                "pillar and cell are both given: a cell has its own material; give pillar inside cell"
            )
        if self.tolerance > MOST_ERROR:
            raise ConfigError(
                f"tolerance = {self.tolerance}: need an error of t above 0 and up to {MOST_ERROR:g}"
            )
        if min(self.pitches_um) <= self.min_diameter_um + self.min_gap_um:
            raise ConfigError(
                f"pitches_um holds {min(self.pitches_um)}: no pillar of {self.min_diameter_um} um fits with a gap of "
                f"{self.min_gap_um} um"
            )

    def at(self, pitch_um: float, height_um: float) -> Cell:
        """One cell of the study.

        Where the pillar has layers, those of its own material take the height.

        Raises:
            CellError: a height that the films of other materials fill.
        """
        base = self.cell or Cell(pitch_um, pillar=self.pillar)
        return replace(base.at_height(height_um), pitch_um=pitch_um)


@dataclass(frozen=True, slots=True)
class CellVerdict:
    """Result of one cell at one wavelength, on its longest smooth run of diameters.

    turns: of phase that the run covers.
    from_um, to_um: its diameters.
    least_transmission: smallest |t| on it.
    mean_power: mean |t|² over it, weighted evenly in phase.
    ends: what bounds it above.
    max_angle_deg: of incidence in air up to which no diffraction order propagates, in
        substrate or cover.
    error: largest error estimate of t on it.
    """

    pitch_um: float
    height_um: float
    wavelength_um: float
    turns: float
    from_um: float
    to_um: float
    least_transmission: float
    mean_power: float
    ends: str
    max_angle_deg: float
    error: float


def run_study(
    study: CellStudy,
    console: CommandConsole | None = None,
    *,
    journal: SweepJournal | None = None,
) -> list[CellVerdict]:
    """Verdicts on every combination, wavelength by wavelength, from one rational curve
    t(D) each, solved on all cores.

    Args:
        study: what is compared.
        console: where progress is shown.
        journal: of the curves that an interrupted run has solved; the verdicts are the
            same.

    Raises:
        CellError: a pitch at which diffraction orders propagate in the cover; it is
            named, with the largest that has none. Sizes that do not fit.
        MaterialError: unknown, or a wavelength outside the range of a material of the
            cell.
    """
    for wavelength, pitch in itertools.product(study.wavelengths_um, study.pitches_um):
        check_light(
            study.at(pitch, study.heights_um[0]), Sweep(wavelengths_um=(wavelength,))
        )
    combinations = itertools.product(
        study.wavelengths_um, study.heights_um, study.pitches_um
    )
    cases = [
        (study.at(pitch, height), wavelength)
        for wavelength, height, pitch in combinations
    ]
    tasks = [
        SweepTask(
            "curve",
            cell,
            Incidence(wavelength),
            _span(study, cell),
            study.tolerance,
            choose_engine(cell),
        )
        for cell, wavelength in cases
    ]
    journal = journal or SweepJournal(None)
    verdicts = []
    solutions = journal.run(tasks, console or CommandConsole(quiet=True), "cells")
    for case, solved in zip(cases, solutions, strict=True):
        curve = fit_curve(solved, tolerance=study.tolerance)
        verdicts.append(judge_cell(study, *case, curve))
    return verdicts


def _span(study: CellStudy, cell: Cell) -> tuple[float, float]:
    """(least, largest) printable size of a cell, um.

    Raises:
        CellError: there is none.
    """
    low = cell.size_um(study.min_diameter_um, study.min_gap_um)
    high = cell.widest_um(study.min_gap_um)
    if low >= high:
        raise CellError(
            f"pitch {cell.pitch_um:g} um, {cell.described}: a gap of {study.min_gap_um:g} um leaves sizes up to "
            f"{high:g} um, min_diameter_um = {study.min_diameter_um:g} takes {low:.4g} um"
        )
    return low, high


def judge_cell(
    study: CellStudy, cell: Cell, wavelength_um: float, curve: ResponseCurve
) -> CellVerdict:
    """Verdict on one curve: the run of sizes without a fault that covers most phase.

    Faults are those of :func:`metalens.library.fit.find_faults`, at 600 sizes.

    Args:
        study: what is compared.
        cell: unit cell with its materials, shape and lattice.
        wavelength_um: of the curve, um.
    """
    nodes = curve.nodes.diameter_um
    d = np.linspace(nodes.min(), nodes.max(), 600)
    value, error = curve(d)
    level = np.abs(value[:, 0])
    # the wider an opening, the less phase: its sign is changed
    phase = np.unwrap(np.angle(value[:, 0])) * (-1 if cell.shape.hole else 1)
    faults = find_faults(
        d,
        value[:, 0],
        error,
        least_transmission=study.least_transmission,
        hole=cell.shape.hole,
        resonances=[
            (*pole, wavelength_um, 0.0)
            for pole in curve.resonances(study.least_half_width_um)
        ],
    )
    run = max(
        find_runs(~np.any([fault.mask for fault in faults], axis=0)),
        key=lambda candidate: phase[candidate.stop - 1] - phase[candidate.start],
        default=slice(0, 0),
    )
    start, stop = run.start, run.stop
    reasons = [
        fault.reason for fault in faults if stop < len(d) and fault.mask[stop]
    ] or ["the printable range"]
    return CellVerdict(
        cell.pitch_um,
        cell.height_um,
        wavelength_um,
        float(phase[stop - 1] - phase[start]) / math.tau if stop > start else 0.0,
        float(d[start]),
        float(d[max(start, stop - 1)]),
        float(level[run].min(initial=1.0)),
        _mean_over_phase(phase[run], level[run] ** 2),
        " and ".join(dict.fromkeys(reasons)),
        max_angle_deg(cell, wavelength_um),
        float(error[run].max(initial=0.0)),
    )


def max_angle_deg(cell: Cell, wavelength_um: float) -> float:
    """Angle of incidence in air up to which only the zero order propagates on either
    side, deg.

    sin(angle) = wavelength / row spacing - largest n.

    Args:
        cell: whose substrate and cover count.
        wavelength_um: vacuum wavelength, um.
    """
    n = max(
        index(material, wavelength_um).real for material in (cell.substrate, cell.cover)
    )
    sine = cell.lattice.least_order * wavelength_um / cell.pitch_um - n
    return math.degrees(math.asin(min(1.0, max(0.0, sine))))


def _mean_over_phase(phase: Array, power: Array) -> float:
    """Mean of the power over the phase, by the trapezoidal rule; 0 below two samples."""
    if len(phase) < 2:
        return 0.0
    return float(np.trapezoid(power, phase) / (phase[-1] - phase[0]))


def best_cell(verdicts: list[CellVerdict]) -> tuple[float, float] | None:
    """(pitch, height) in um of the lowest pillars that cover a full turn at every
    wavelength; None where no cell does.

    Among pitches of equal height, the one with most turns at its worst wavelength.

    Args:
        verdicts: of all cells and wavelengths of a study.
    """
    turns: dict[tuple[float, float], float] = {}
    for v in verdicts:
        cell = v.pitch_um, v.height_um
        turns[cell] = min(v.turns, turns.get(cell, math.inf))
    covering = [cell for cell in turns if turns[cell] >= 1]
    return min(covering, key=lambda cell: (cell[1], -turns[cell]), default=None)
