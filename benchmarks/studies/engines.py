"""Two engines that share no code, the modal method and RCWA, on cells drawn at random:
do they agree within their bars?

``python -m benchmarks engines`` draws 200 round pillars of each kind (an hour);
``python -m benchmarks.studies.engines N
[KIND ...]`` prints the table of fewer. t and r are compared, phases included. RCWA
takes few orders, fixed: its bars
are then wide, but the orders that a tolerance asks of strange cells take minutes. No
times are taken.
"""

import math
import sys
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks import Row
from benchmarks.studies.hard_cells import KINDS as HARD
from benchmarks.studies.hard_cells import Drawn
from metalens import modal, rcwa
from metalens.cell import Cell, Index
from metalens.core.errors import CellError

COUNT, SEED = 200, 9203  # no factor of either was chosen on its cells
TOLERANCE = 1e-2  # of the modal method
HARMONICS = {False: 10, True: 8}  # of RCWA, by whether the light is oblique


def _ordinary(oblique: bool) -> Callable[[np.random.Generator], Drawn]:
    """Cells as lenses have them, nothing looked for."""

    def draw(rng: np.random.Generator) -> Drawn:
        pitch = rng.uniform(0.25, 0.5)
        wavelength = rng.uniform(0.5, 1.2)
        about = [
            Index(rng.uniform(*ends))
            for ends in ((1.9, 3.7), (1.35, 1.8), (1.0, 1.3), (1.0, 1.3))
        ]
        cell = Cell(pitch, rng.uniform(0.3, 1.1), *about)
        angle = rng.uniform(0.02, 0.6) if oblique else 0.0
        return (
            cell,
            pitch * rng.uniform(0.2, 0.85),
            wavelength,
            angle,
            str(rng.choice(["s", "p"])) if oblique else "x",
        )

    return draw


def _any(
    *,
    angle: tuple[float, float] = (0.0, 0.0),
    rarer: float = 0.0,
    waves: tuple[float, float] = (0.4, 2.6),
    heights: tuple[float, float] = (0.05, 6.0),
    low_contrast: bool = False,
) -> Callable[[np.random.Generator], Drawn]:
    """Cells far beyond those of lenses. angle: in rad. rarer: share of discs of the
    rarer medium.

    waves: of the denser medium in a pitch. heights: in pitches, evenly over their
    logarithm.
    """

    def draw(rng: np.random.Generator) -> Drawn:
        pitch, thin = rng.uniform(0.2, 1.0), rng.uniform(1.0, 2.2)
        dense = (
            thin * math.sqrt(rng.uniform(1.02, 2.0))
            if low_contrast
            else rng.uniform(thin, 4.2)
        )
        about = [
            Index(dense),
            Index(rng.uniform(1.2, 2.2)),
            Index(rng.uniform(1.0, 1.8)),
            Index(thin),
        ]
        if rng.uniform() < rarer:
            about = [about[3], *about[1:3], about[0]]
        height = pitch * float(np.exp(rng.uniform(*np.log(heights))))
        where = rng.uniform(*angle), str(rng.choice(["s", "p"]))
        cell = Cell(pitch, height, *about)
        wavelength = pitch * dense / rng.uniform(*waves)
        return (
            cell,
            pitch * rng.uniform(0.04, 0.97),
            wavelength,
            *(where if where[0] else (0.0, "x")),
        )

    return draw


KINDS = {
    "ordinary, normal": _ordinary(False),
    "ordinary, oblique": _ordinary(True),
    **HARD,
    "of any media": _any(),
    "of the rarer medium": _any(rarer=1.0),
    "of low contrast": _any(low_contrast=True),
    "low": _any(heights=(0.01, 0.25)),
    "very tall": _any(heights=(6.0, 20.0)),
    "of many orders": _any(waves=(2.0, 3.6)),
    "in any oblique light": _any(angle=(0.01, 0.6), rarer=0.2),
    "in steep light": _any(angle=(0.6, 1.4), rarer=0.2),
}


def compared(kind: str, count: int, seed: int = SEED) -> dict[str, float]:
    """Counts of one kind: cells, those that either engine refuses, those apart by more
    than both bars; medians.
    """
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    shares: list[float] = []
    bars: list[tuple[float, float]] = []
    refused = 0
    for _ in range(count):
        cell, diameter, wavelength, angle, polarization = KINDS[kind](rng)
        turned = float(rng.integers(4) * math.pi / 2) if angle else 0.0
        light = {
            "angle_rad": angle,
            "azimuth_rad": turned,
            "polarization": polarization,
        }
        try:
            one = modal.solve(cell, diameter, wavelength, **light, tolerance=TOLERANCE)
            two = rcwa.solve(
                cell, diameter, wavelength, **light, harmonics=HARMONICS[angle > 0]
            )
        except (
            CellError
        ):  # no zero order on one side, or elements that degenerate: refused, not wrong
            refused += 1
            continue
        apart = max(abs(one.t - two.t), abs(one.r - two.r))
        shares.append(apart / (one.t_error + two.t_error))
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


def rows(count: int = COUNT, kinds: tuple[str, ...] = tuple(KINDS)) -> Iterator[Row]:
    """One row a kind, each as soon as it is found."""
    for kind in kinds:
        yield _row(kind, compared(kind, count))


def _row(kind: str, found: dict[str, float]) -> Row:
    text = f"{found['apart']} of {found['cells']} outside both bars, {found['refused']} refused"
    text += f", median bars {found['median_bar_modal']:.2g} and {found['median_bar_rcwa']:.2g}"
    return Row(
        case=f"cells {kind}, seed {found['seed']}: {text}",
        method="modal and RCWA",
        seconds=math.nan,
        error=found["largest_share_of_both_bars"],
        against="largest |difference| of t and r over the sum of both bars",
        goal="below 1",
    )


if __name__ == "__main__":
    from benchmarks.__main__ import table

    sys.stdout.write(
        table(list(rows(int(sys.argv[1]), tuple(sys.argv[2:]) or tuple(KINDS)))) + "\n"
    )
