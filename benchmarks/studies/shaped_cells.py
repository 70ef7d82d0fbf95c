"""Error bars of cells that are no plain round pillars on a square lattice, drawn at
random: do any lie below the error?

``python -m benchmarks shaped_cells`` draws 16 cells of each kind (an hour); ``python -m
benchmarks.studies.shaped_cells N [SEED
[KIND ...]]`` another number. The referee is the same Fourier method at truncations that
no bar has seen (orders within
``FINEST``), the mean of the last three with their spread as its doubt; ``make
bench-peers`` compares shapes with fmmax,
which shares no code. No times are taken.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import Row
from metalens import rcwa
from metalens.cell import Cell, Index, Lattice, Layer
from metalens.cell.shapes import (
    Circle,
    Cross,
    Ellipse,
    Rectangle,
    RegularPolygon,
    Ring,
    Square,
)
from metalens.core.arrays import Array
from metalens.core.errors import CellError

COUNT, SEED = 16, 7411
FINEST = {
    4: 19,
    2: 13,
}  # orders of the referee, by the number of mirrors that the light leaves
LAST = 3  # truncations that are averaged
TOLERANCE = 2e-2
LEAST_GAP = 0.005  # of the pitch


@dataclass(frozen=True, slots=True)
class Drawn:
    """A cell, its size and a plane wave."""

    cell: Cell
    size_um: float
    wavelength_um: float
    angle_rad: float = 0.0
    azimuth_rad: float = 0.0

    def jones(self, **how: Any) -> rcwa.JonesResponse:
        """By coupled waves; how: tolerance or harmonics."""
        light = {"angle_rad": self.angle_rad, "azimuth_rad": self.azimuth_rad}
        return rcwa.jones(self.cell, self.size_um, self.wavelength_um, **light, **how)


def _about(
    rng: np.random.Generator, n: tuple[float, float] = (1.9, 3.7), k: float = 0.0
) -> dict[str, Index]:
    return {
        "pillar": Index(rng.uniform(*n), k),
        "substrate": Index(rng.uniform(1.35, 1.75)),
        "cover": Index(rng.uniform(1.0, 1.3)),
        "between": Index(rng.uniform(1.0, 1.3)),
    }


def _plain(
    shape: Callable[[np.random.Generator], object], **more: object
) -> Callable[[np.random.Generator], Drawn]:
    """Cells as lenses have them, of a shape, at normal incidence."""

    def draw(rng: np.random.Generator) -> Drawn:
        pitch = rng.uniform(0.25, 0.45)
        cell = Cell(
            pitch, rng.uniform(0.3, 1.0), **_about(rng), shape=shape(rng), **more
        )  # type: ignore[arg-type]
        return Drawn(
            cell, fitting(cell, pitch * rng.uniform(0.25, 0.85)), _longer(cell, rng)
        )

    return draw


def _longer(cell: Cell, rng: np.random.Generator) -> float:
    """A wavelength at which no order but zero propagates."""
    most = max(cell.substrate.n, cell.cover.n)  # type: ignore[union-attr]
    return float(
        most * cell.pitch_um / cell.lattice.least_order * rng.uniform(1.08, 1.8)
    )


def fitting(cell: Cell, size_um: float, gap: float = 0.04) -> float:
    """The size, or a smaller one whose widest section leaves a gap, over the pitch."""
    tilt = abs(math.tan(cell.sidewall_rad)) * cell.height_um
    grow = max(layer.grow_um + 2 * layer.coat_um for layer in cell.sections) + tilt
    while cell.gap_um(size_um, grow_um=max(grow, 0.0)) < gap * cell.pitch_um:
        size_um *= 0.95
    return size_um


def _layered(rng: np.random.Generator) -> Drawn:
    """Pedestal, pillar with a coat, residual mask."""
    pitch = rng.uniform(0.28, 0.45)
    heights = rng.uniform(0.05, 0.15), rng.uniform(0.3, 0.7), rng.uniform(0.03, 0.1)
    layers = (
        Layer(
            heights[0],
            grow_um=rng.uniform(0.0, 0.06),
            material=Index(rng.uniform(1.4, 2.0)),
        ),
        Layer(heights[1], coat_um=0.012, coat=Index(rng.uniform(1.5, 2.2))),
        Layer(
            heights[2],
            grow_um=-rng.uniform(0.0, 0.03),
            material=Index(rng.uniform(1.5, 3.0), 0.1),
        ),
    )
    shape = rng.choice(np.array([Circle(), Square(), Rectangle(0.7)], dtype=object))
    cell = Cell(pitch, sum(heights), **_about(rng), shape=shape, layers=layers)
    return Drawn(
        cell, fitting(cell, pitch * rng.uniform(0.35, 0.7)), _longer(cell, rng)
    )


def _touching(rng: np.random.Generator) -> Drawn:
    """Rectangles and ellipses that leave half to three hundredths of the pitch."""
    pitch, ratio = rng.uniform(0.25, 0.4), rng.uniform(0.4, 0.95)
    shape = Rectangle(ratio) if rng.uniform() < 0.5 else Ellipse(ratio)
    cell = Cell(pitch, rng.uniform(0.3, 0.8), **_about(rng), shape=shape)
    return Drawn(cell, pitch * (1 - rng.uniform(LEAST_GAP, 0.03)), _longer(cell, rng))


def _thin(rng: np.random.Generator) -> Drawn:
    pitch = rng.uniform(0.3, 0.45)
    shape = Rectangle(rng.uniform(0.3, 1.0)) if rng.uniform() < 0.5 else Square()
    cell = Cell(pitch, rng.uniform(0.4, 1.0), **_about(rng), shape=shape)
    return Drawn(cell, pitch * rng.uniform(0.08, 0.22), _longer(cell, rng))


def _tall(rng: np.random.Generator) -> Drawn:
    pitch = rng.uniform(0.28, 0.4)
    cell = Cell(
        pitch,
        rng.uniform(1.2, 2.5),
        **_about(rng),
        shape=Rectangle(rng.uniform(0.5, 0.95)),
    )
    return Drawn(cell, pitch * rng.uniform(0.3, 0.8), _longer(cell, rng))


def _resonant(rng: np.random.Generator) -> Drawn:
    """High index, slightly oblique: resonances that normal incidence does not excite
    are sharp.
    """
    pitch = rng.uniform(0.35, 0.42)
    cell = Cell(
        pitch,
        rng.uniform(0.5, 1.0),
        **_about(rng, (3.2, 3.8)),
        shape=Rectangle(rng.uniform(0.6, 0.95)),
    )
    return Drawn(
        cell, pitch * rng.uniform(0.5, 0.85), 0.85, float(rng.uniform(0.01, 0.15))
    )


def _cutoff(rng: np.random.Generator) -> Drawn:
    """Within 1 % of the cutoff of the first orders of substrate or cover, on either
    side of it.
    """
    about, pitch = _about(rng), rng.uniform(0.3, 0.6)
    n = about[str(rng.choice(["substrate", "cover"]))].n
    cell = Cell(
        pitch, rng.uniform(0.2, 1.0), **about, shape=Ellipse(rng.uniform(0.5, 0.95))
    )
    offset = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -2)
    return Drawn(cell, pitch * rng.uniform(0.3, 0.85), float(pitch * n * (1 + offset)))


def _absorbing(rng: np.random.Generator) -> Drawn:
    pitch = rng.uniform(0.28, 0.42)
    about = _about(rng, k=float(10 ** rng.uniform(-2, 0)))
    cell = Cell(pitch, rng.uniform(0.3, 0.8), **about, shape=RegularPolygon(6))
    return Drawn(cell, pitch * rng.uniform(0.3, 0.8), _longer(cell, rng))


HEXAGONAL = Lattice("hexagonal")
KINDS: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "rectangles": _plain(lambda rng: Rectangle(rng.uniform(0.3, 0.95))),
    "ellipses": _plain(lambda rng: Ellipse(rng.uniform(0.3, 0.95))),
    "rings": _plain(lambda rng: Ring(rng.uniform(0.25, 0.75))),
    "crosses": _plain(lambda rng: Cross(rng.uniform(0.25, 0.6))),
    "in layers": _layered,
    "hexagonal lattice": _plain(lambda rng: Circle(), lattice=HEXAGONAL),
    "rectangular lattice": _plain(
        lambda rng: Circle(), lattice=Lattice("rectangular", 1.3)
    ),
    "nearly touching": _touching,
    "thin": _thin,
    "tall": _tall,
    "at a resonance": _resonant,
    "at a cutoff": _cutoff,
    "absorbing": _absorbing,
}


def draws(kind: str, count: int, seed: int) -> list[Drawn]:
    """Cells of a kind; what overlaps or has no zero order is drawn again."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    found: list[Drawn] = []
    while len(found) < count:
        one = KINDS[kind](rng)
        try:
            one.jones(harmonics=1)
        except CellError:
            continue
        found.append(one)
    return found


def referee(one: Drawn) -> tuple[Array, float]:
    """t of finer truncations, and its doubt."""
    last = FINEST[2 if one.angle_rad else 4]
    found = one.jones(harmonics=last)
    t = np.concatenate([found.earlier, found.t[None]])[-LAST:]
    return t.mean(axis=0), float(np.abs(t - t.mean(axis=0)).max())


def judged(kind: str, count: int, seed: int) -> Row:
    """One row: bars below the error, and the median of bar over error."""
    ratios = []
    for one in draws(kind, count, seed):
        got = one.jones(tolerance=TOLERANCE)
        want, doubt = referee(one)
        ratios.append(
            (got.t_error + doubt) / max(float(np.abs(got.t - want).max()), 1e-12)
        )
    below = int(np.count_nonzero(np.array(ratios) < 1))
    text = f"{below} of {len(ratios)} bars below the error, median bar {np.median(ratios):.1f} errors"
    return Row(
        case=f"cells, {kind}, tolerance {TOLERANCE:g}, seed {seed}: {text}",
        method="RCWA",
        seconds=math.nan,
        error=1 / min(ratios),
        against="largest error over bar, finer truncations",
        goal="0 below the error, median at most 4",
    )


def rows(
    count: int = COUNT, seed: int = SEED, kinds: tuple[str, ...] = tuple(KINDS)
) -> list[Row]:
    """Every kind."""
    return [judged(kind, count, seed) for kind in kinds]


if __name__ == "__main__":
    from benchmarks.__main__ import table

    numbers = [int(word) for word in sys.argv[1:3]]
    sys.stdout.write(
        table(rows(*numbers, *([tuple(sys.argv[3:])] if sys.argv[3:] else []))) + "\n"
    )  # type: ignore[arg-type]
