"""Error bars on hard cells drawn at random: how many lie below the error, and how wide
the bars are.

``python -m benchmarks hard_cells`` draws 1000 cells (an hour or two); ``python -m
benchmarks.studies.hard_cells
N [SEED [SECONDS]]`` fewer, without RCWA, at most that long for each kind and tolerance.
Two referees: finer meshes of
the modal engine, until their own estimate is a fifth of the bar that they judge (cases
that none reaches are counted
apart), and RCWA at its largest truncation, which shares no code: the answers must agree
within both bars.
"""

import math
import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks import Row
from metalens import modal, rcwa
from metalens.cell import Cell, Incidence, Index
from metalens.core.errors import CellError
from metalens.modal import LEVELS, case_of, refine_case
from metalens.modal.case import ModalCase

COUNT = 1000
SEED = 8023  # no factor of the estimate was chosen on its cells
FINER = 3  # first level of the referee
SHARE = 0.2  # of the bar, that the referee may be uncertain by
TOLERANCES = (1e-2, 1e-3)
Drawn = tuple[
    Cell, float, float, float, str
]  # cell, diameter, wavelength, angle, polarisation


def _any(
    rng: np.random.Generator, *, n: tuple[float, float] = (1.8, 3.8), k: float = 0.0
) -> dict[str, Index]:
    return {
        "pillar": Index(rng.uniform(*n), k),
        "substrate": Index(rng.uniform(1.3, 1.8)),
        "cover": Index(rng.uniform(1.0, 1.3)),
        "between": Index(rng.uniform(1.0, 1.3)),
    }


def _cutoff(rng: np.random.Generator) -> Drawn:
    """Within 1 % of the cutoff of an order of substrate or cover, on either side of it;
    half of them oblique.
    """
    about = _any(rng)
    n = about[str(rng.choice(["substrate", "cover"]))].n
    angle = float(rng.choice([0.0, rng.uniform(0.05, 0.4)]))
    pitch = rng.uniform(0.3, 0.6)
    offset = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -2)
    wavelength = pitch * (n + math.sin(angle)) * (1 + offset)
    return (
        Cell(pitch, rng.uniform(0.2, 1.0), **about),
        pitch * rng.uniform(0.25, 0.85),
        wavelength,
        angle,
        "s",
    )


def _resonant(rng: np.random.Generator) -> Drawn:
    """High index, slightly oblique: resonances that normal incidence does not excite
    are sharp.
    """
    pitch = rng.uniform(0.35, 0.42)
    cell = Cell(pitch, rng.uniform(0.5, 1.0), **_any(rng, n=(3.2, 3.8)))
    return (
        cell,
        pitch * rng.uniform(0.5, 0.85),
        0.85,
        rng.uniform(0.01, 0.15),
        str(rng.choice(["s", "p"])),
    )


def _shaped(
    low: float, high: float, heights: tuple[float, float], k: float
) -> Callable[[np.random.Generator], Drawn]:
    def draw(rng: np.random.Generator) -> Drawn:
        pitch = rng.uniform(0.3, 0.45)
        cell = Cell(
            pitch, rng.uniform(*heights), **_any(rng, k=k * 10 ** rng.uniform(-2, 0))
        )
        return cell, pitch * rng.uniform(low, high), rng.uniform(0.83, 0.95), 0.0, "x"

    return draw


def _many_waves(rng: np.random.Generator) -> Drawn:
    """High index and a wide pitch: more than two waves of the pillar's index across the
    cell, several orders.
    """
    pitch = rng.uniform(0.45, 0.6)
    cell = Cell(pitch, rng.uniform(0.2, 2.0), **_any(rng, n=(3.2, 3.8)))
    return (
        cell,
        pitch * rng.uniform(0.25, 0.85),
        pitch / rng.uniform(0.58, 0.78),
        0.0,
        "x",
    )


KINDS: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "at a cutoff": _cutoff,
    "at a resonance": _resonant,
    "nearly touching": _shaped(0.9, 0.985, (0.3, 0.9), 0.0),
    "thin": _shaped(0.05, 0.2, (0.3, 0.9), 0.0),
    "tall": _shaped(0.3, 0.8, (1.2, 2.5), 0.0),
    "absorbing": _shaped(0.2, 0.8, (0.3, 0.9), 1.0),
    "of many waves in a pitch": _many_waves,
}


def referee(case: ModalCase, bar: float) -> tuple[tuple[complex, complex], float]:
    """t and r on the coarsest of the finer meshes whose own estimate, the second value,
    is far below the bar.
    """
    for level in range(FINER, len(LEVELS)):
        found = refine_case(case, SHARE * bar, (level,))
        if found.converged:
            break
    return (found.t, found.r), found.t_error


def judged(
    kind: str,
    count: int,
    tolerance: float,
    seed: int,
    *,
    other_solver: bool,
    limit_s: float = math.inf,
) -> Row:
    """One row: bars below the error, and the median of bar over error; no cell is begun
    after ``limit_s``.
    """
    begun = time.perf_counter()
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    ratios, seconds, apart, refused, open_ = [], 0.0, 0, 0, 0
    for _ in range(count):
        if time.perf_counter() - begun > limit_s:
            break
        cell, diameter, wavelength, angle, polarization = KINDS[kind](rng)
        light = {"angle_rad": angle, "polarization": polarization}
        start = time.perf_counter()
        try:
            got = modal.solve(cell, diameter, wavelength, **light, tolerance=tolerance)
        except (
            CellError
        ):  # no zero order on one side, or elements that degenerate: refused, not wrong
            refused += 1
            continue
        seconds += time.perf_counter() - start
        want, doubt = referee(
            case_of(cell, diameter, Incidence(wavelength, angle, polarization)),
            got.t_error,
        )
        if doubt > SHARE * got.t_error:
            open_ += 1
        else:
            error = max(abs(got.t - want[0]), abs(got.r - want[1]))
            ratios.append((got.t_error + doubt) / max(error, 1e-12))
        if other_solver:
            against = rcwa.solve(cell, diameter, wavelength, **light, tolerance=1e-9)
            apart += (
                max(abs(against.t - got.t), abs(against.r - got.r))
                > against.t_error + got.t_error
            )
    below = int(np.count_nonzero(np.array(ratios) < 1))
    text = f"{below} of {len(ratios)} bars below the error, median bar {np.median(ratios):.1f} errors"
    text += f", {refused} refused" if refused else ""
    text += f", {open_} that no mesh decides" if open_ else ""
    text += f", {apart} outside both bars of RCWA" if other_solver else ""
    return Row(
        case=f"cells {kind}, tolerance {tolerance:g}, seed {seed}: {text}",
        method="modal",
        seconds=seconds / max(1, len(ratios)),
        error=1 / min(ratios, default=math.inf),
        against="largest error over bar, finer meshes"
        + (" and RCWA" if other_solver else ""),
        goal="0 below the error, median at most 4",
    )


def rows(
    count: int = COUNT,
    seed: int = SEED,
    limit_s: float = math.inf,
    *,
    other_solver: bool = True,
) -> list[Row]:
    """Every kind at every tolerance; ``count`` bars in all."""
    each = max(1, count // (len(KINDS) * len(TOLERANCES)))
    return [
        judged(kind, each, tol, seed, other_solver=other_solver, limit_s=limit_s)
        for kind in KINDS
        for tol in TOLERANCES
    ]


if __name__ == "__main__":
    from benchmarks.__main__ import table

    words = [int(word) for word in sys.argv[1:]]
    sys.stdout.write(table(rows(*words, other_solver=False)) + "\n")
