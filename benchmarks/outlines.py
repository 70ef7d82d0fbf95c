"""Masks of pillars that are not round, or not on a square lattice: time a placement
beside that of round ones.

    python -m benchmarks outlines

A lens of 0.6 mm with free-form sizes is planned, checked, written and read back; the
error is how many places, cells or
outlines differ from the plan.
"""

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import layout
from benchmarks import Row
from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Ellipse, Rectangle, RegularPolygon, Square
from metalens.design import make
from metalens.design.profiles import Focus
from metalens.ground.arrays import Array
from metalens.lens import Lens
from metalens.proxy import Proxy

APERTURE_UM, REPEATS, GOAL = 600.0, 3, 2.0
ROUND = Cell(pitch_um=0.40, pillar=Index(3.6))
KINDS = {
    "round, square lattice": ROUND,
    "squares turned by 30°": replace(ROUND, shape=Square(angle_rad=math.pi / 6)),
    "rectangles 1 : 0.6 turned by 20°": replace(
        ROUND, shape=Rectangle(ratio=0.6, angle_rad=math.pi / 9)
    ),
    "ellipses 1 : 0.7": replace(ROUND, shape=Ellipse(ratio=0.7)),
    "hexagons": replace(ROUND, shape=RegularPolygon(sides=6)),
    "square holes": replace(ROUND, shape=Square(hole=True)),
    "round, hexagonal lattice": replace(ROUND, lattice=Lattice("hexagonal")),
    "round, rectangular lattice 1 : 1.2": replace(
        ROUND, lattice=Lattice("rectangular", ratio=1.2)
    ),
}


def lens_of(cell: Cell) -> Lens:
    """Free-form sizes from 140 to 235 nm, whatever the pillars would do: masks do not
    ask.
    """
    slope = np.polynomial.Chebyshev.interpolate(
        lambda d: 67 * d, 2, domain=[0.14, 0.235]
    ).coef[None]
    proxy = Proxy(slope, np.array([[0.9]]), (0.14, 0.235), (0.85, 0.85), 0.0, 0.0)

    def phase(x_um: Array, y_um: Array) -> Array:
        u, v = x_um / 300, y_um[:, None] / 300
        return 40 * (u**3 + v**3) + 25 * np.sin(7 * u - 4 * v) - 60 * (u**2 + v**2)

    return make(
        phase,
        Focus(0.85, 2000.0, math.inf),
        aperture_um=APERTURE_UM,
        cell=cell,
        proxy=proxy,
    )[0]


def rows() -> Iterator[Row]:
    """A row a kind and format; the goal is the time a placement over that of round
    pillars.
    """
    process, base = layout.Process(), dict[str, float]()
    with tempfile.TemporaryDirectory() as folder:
        for kind, cell in KINDS.items():
            lens = lens_of(cell)
            for form, write, read in (
                ("OASIS", layout.write_oasis, layout.read_oasis),
                ("GDSII", layout.write_gdsii, layout.read_gdsii),
            ):
                path, best = Path(folder) / f"mask.{form}", math.inf
                for _ in range(REPEATS):
                    start = time.perf_counter()
                    mask = layout.plan(lens, process, furnished=False)
                    ok = layout.check_plan(mask, process.rules).ok
                    write(mask, path)
                    same = layout.compare(mask, read(path))
                    best = min(best, time.perf_counter() - start)
                count = int((lens.diameters.diameter_um > 0).sum())
                each = best / count * 1e9
                times = each / base.setdefault(form, each)
                yield Row(
                    f"{kind}, {count:,} placements", f"plan, check, write and read back {form}", best,
                    float(not same.ok), f"as planned; rules {'kept' if ok else 'broken'}; {each:.0f} ns a placement", 2,
                    goal=f"{times:.2f}x round (asked {GOAL:g}x): {times <= GOAL}",
                )  # fmt: skip
