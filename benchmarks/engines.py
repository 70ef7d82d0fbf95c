"""Two engines that share no code, the modal method and RCWA, on cells drawn at random: do they agree within their bars?

``python -m benchmarks engines`` draws 200 cells of each kind (an hour); ``python -m benchmarks.engines N [KIND ...]``
prints the table of fewer. No times are taken.
"""

import math
import sys
from collections.abc import Callable

import numpy as np

from benchmarks import Row
from benchmarks.hard_cells import KINDS as HARD
from benchmarks.hard_cells import Drawn
from metalens import modal, rcwa
from metalens.cell import Cell, Index
from metalens.ground.errors import CellError

COUNT, SEED = 200, 6143  # the factors of RCWA at few orders were chosen on seed 5077
TOLERANCES = (1e-2, 2e-2)  # of the modal method and of RCWA


def _ordinary(oblique: bool) -> Callable[[np.random.Generator], Drawn]:
    """Cells as lenses have them, nothing looked for."""

    def draw(rng: np.random.Generator) -> Drawn:
        pitch, wavelength = rng.uniform(0.25, 0.5), rng.uniform(0.5, 1.2)
        about = [Index(rng.uniform(*ends)) for ends in ((1.9, 3.7), (1.35, 1.8), (1.0, 1.3), (1.0, 1.3))]
        cell = Cell(pitch, rng.uniform(0.3, 1.1), *about)
        angle = rng.uniform(0.02, 0.6) if oblique else 0.0
        return cell, pitch * rng.uniform(0.2, 0.85), wavelength, angle, str(rng.choice(["s", "p"])) if oblique else "x"

    return draw


KINDS = {"ordinary, normal": _ordinary(False), "ordinary, oblique": _ordinary(True), **HARD}


def compared(kind: str, count: int, seed: int = SEED) -> dict[str, float]:
    """Counts of one kind: cells, those that either engine refuses, those apart by more than both bars; medians."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    shares: list[float] = []
    bars: list[tuple[float, float]] = []
    refused = 0
    for _ in range(count):
        cell, diameter, wavelength, angle, polarization = KINDS[kind](rng)
        light = {"angle_rad": angle, "polarization": polarization}
        try:
            one = modal.solve(cell, diameter, wavelength, **light, tolerance=TOLERANCES[0])
            two = rcwa.solve(cell, diameter, wavelength, **light, tolerance=TOLERANCES[1])
        except CellError:  # no zero order on one side, or elements that degenerate: refused, not wrong
            refused += 1
            continue
        shares.append(abs(one.t - two.t) / (one.t_error + two.t_error))
        bars.append((one.t_error, two.t_error))
    return {
        "cells": len(shares),
        "refused": refused,
        "apart": int(np.count_nonzero(np.array(shares) > 1)),
        "largest_share_of_both_bars": max(shares, default=math.nan),
        "median_share_of_both_bars": float(np.median(shares)),
        "median_bar_modal": float(np.median([b[0] for b in bars])),
        "median_bar_rcwa": float(np.median([b[1] for b in bars])),
        "seed": seed,
    }


def rows(count: int = COUNT, kinds: tuple[str, ...] = tuple(KINDS)) -> list[Row]:
    """One row a kind."""
    return [_row(kind, compared(kind, count)) for kind in kinds]


def _row(kind: str, found: dict[str, float]) -> Row:
    text = f"{found['apart']} of {found['cells']} outside both bars, {found['refused']} refused"
    return Row(
        case=f"cells {kind}, seed {found['seed']}: {text}",
        method="modal and RCWA",
        seconds=math.nan,
        error=found["largest_share_of_both_bars"],
        against="largest |difference| over the sum of both bars",
        goal="below 1",
    )


if __name__ == "__main__":
    from benchmarks.__main__ import table

    sys.stdout.write(table(rows(int(sys.argv[1]), tuple(sys.argv[2:]) or tuple(KINDS))) + "\n")
