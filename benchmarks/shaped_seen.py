"""Whether bars of coupled waves could be tighter where the truncation sees the smallest
feature of a cell.

``python -m benchmarks shaped_seen`` draws some cells of each kind of ``shaped_cells``
and judges two bars at 7 and 9
orders by finer truncations: the one that ``rcwa.jones`` gives, and one of the last six
moves, 1.5 sum (m / n)^3
|t_m - t_(m-1)|, which is half as wide and lay below the error of a thin ring. Results
are sorted by the orders that fit
into the narrowest wall, gap or hollow. What decides is printed: the largest share of
its bar that an error takes, over
the median share. No bar of that form, whatever its factor, is both never below the
error and in the median less than so
many errors wide. A rule of geometry would help if that number fell where features are
seen.

It does not (``results/shaped_seen.json``): where two and more orders fit in, the number
is the largest, 11 for the
moves, and a bar of theirs lies below the error (1.2). So the bars stay as wide as they
are.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import Row
from benchmarks.shaped_cells import KINDS, Drawn, draws
from metalens.ground.arrays import Array

COUNT, SEED = 6, 3607
ORDERS = (7, 9)  # of the bars that are judged
FINEST = {False: 15, True: 12}  # of the referee, at normal and at oblique incidence
SEEN = (
    0.0,
    0.5,
    1.0,
    2.0,
    math.inf,
)  # orders times the narrowest feature over the pitch
CLEAR = 2.0  # results whose error is at least this many doubts of the referee count


@dataclass(frozen=True, slots=True)
class Judged:
    """One result. seen: orders in its narrowest feature. kept, moved: its error over
    the bar and over that of moves.
    """

    seen: float
    kept: float
    moved: float


def narrowest(one: Drawn) -> float:
    """Least wall, gap or hollow, in pitches."""
    return (
        min(one.cell.gap_um(one.size_um), *one.cell.outline(one.size_um).spans_um)
        / one.cell.pitch_um
    )


def moves(t: list[Array], reach: int) -> float:
    """Of truncations up to ``reach`` orders: 1.5 sum (m / reach)³ |t_m - t_(m-1)|."""
    steps = [float(np.abs(b - a).max()) for a, b in itertools.pairwise(t)]
    share = np.arange(reach - len(steps) + 1, reach + 1) / reach
    return 1.5 * float(share**3 @ steps)


def judge(one: Drawn) -> Iterator[Judged]:
    """Both bars at each of ``ORDERS``, where the referee is sharp enough."""
    found = one.jones(harmonics=FINEST[bool(one.angle_rad)])
    last = np.concatenate([found.earlier, found.t[None]])[-3:]
    want, doubt = last.mean(axis=0), float(np.abs(last - last.mean(axis=0)).max())
    for reach in ORDERS:
        got = one.jones(harmonics=reach)
        error = float(np.abs(got.t - want).max())
        if error > CLEAR * doubt:
            bar = moves([*got.earlier, got.t], reach)
            yield Judged(narrowest(one) * reach, error / got.t_error, error / bar)


def rows(count: int = COUNT, seed: int = SEED) -> Iterator[Row]:
    """A row of each bar for each interval of ``SEEN``, and for all."""
    found = [
        result
        for kind in KINDS
        for one in draws(kind, count, seed)
        for result in judge(one)
    ]
    for low, high in (*itertools.pairwise(SEEN), (0.0, math.inf)):
        some = [result for result in found if low <= result.seen < high]
        for name, shares in (
            ("as given", [r.kept for r in some]),
            ("of the moves", [r.moved for r in some]),
        ):
            if len(shares) > 2:
                yield _row(
                    f"{low:g} to {high:g} orders in the narrowest feature",
                    name,
                    np.array(shares),
                )


def _row(case: str, name: str, shares: Array) -> Row:
    least = shares.max() / np.median(shares)
    told = f"{len(shares)} results, median bar {1 / np.median(shares):.1f} errors; none that holds below {least:.1f}"
    return Row(
        f"{case}: {told}",
        f"bar {name}",
        math.nan,
        float(shares.max()),
        "largest error over bar",
        goal="4",
    )
