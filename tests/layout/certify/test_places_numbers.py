"""Pillars strip by strip from bottom to top, of two unlike lattices, against all of
them at once.
"""

import dataclasses

import numpy as np
import pytest

from layout.certify import places
from layout.certify.places import OnLattices, strip_of
from layout.mask import Lattice

RNG = np.random.default_rng(5)
CENTRES = np.array([[0.01, -0.02], [0.003, 0.004]])
KINDS = np.array([-1, 0, -1, 1])  # class 2 is passed over


def lattices():
    """Rows 900 and 700 apart, in units of half a nm, of unlike widths; one begins lower
    and ends higher.
    """
    first = Lattice.of(
        "A",
        RNG.integers(0, 4, (40, 5)).astype(np.uint8),
        pitch=800,
        x0=-1600,
        y0=17_000,
    )
    other = Lattice.of(
        "B", RNG.integers(0, 4, (11, 7)).astype(np.uint8), pitch=640, x0=9000, y0=20_001
    )
    return dataclasses.replace(first, row_pitch=900), dataclasses.replace(
        other, row_pitch=700
    )


def every(both):
    """{(x, y, kind)} of all pillars, rounded to a millionth of a um."""
    found = []
    for lattice in both:
        for (row, column), made in np.ndenumerate(lattice.whole()):
            if KINDS[made] >= 0:
                x, y = (
                    lattice.x0 + column * lattice.pitch,
                    lattice.y0 - row * lattice.down,
                )
                dx, dy = CENTRES[KINDS[made]]
                found.append(
                    (round(x * 5e-4 + dx, 6), round(y * 5e-4 + dy, 6), int(KINDS[made]))
                )
    return sorted(found)


def told(part):
    return [
        (round(float(x), 6), round(float(y), 6), int(k))
        for x, y, k in zip(*part, strict=True)
    ]


@pytest.mark.parametrize("rows", [1, 3, 8, 50])
def test_every_pillar_stands_in_one_strip(rows):
    both = lattices()
    made = OnLattices(both, KINDS, CENTRES, 0.5, 0, rows * 900)
    assert made.box_um == pytest.approx(
        (-0.8, (17_000 - 39 * 900) * 5e-4, (9000 + 6 * 640) * 5e-4, 20_001 * 5e-4)
    )
    assert made.height_um == pytest.approx(rows * 0.45)
    assert made.strips == (20_001 - (17_000 - 39 * 900)) // (rows * 900) + 1
    parts = [told(made.part(k, k + 1)) for k in range(made.strips)]
    assert sorted(one for part in parts for one in part) == every(both)
    assert sorted(told(made.part(-2, made.strips + 3))) == every(both)
    for number, part in enumerate(parts):
        sites = np.array([y - CENTRES[kind][1] for _, y, kind in part])
        assert (strip_of(made, sites + 1e-7) == number).all()
    beyond = strip_of(made, np.array([made.box_um[1] - 9, made.box_um[3] + 9]))
    assert beyond.tolist() == [0, made.strips - 1]


def test_strips_hold_some_sites_of_the_widest_lattice_and_eight_rows_at_least(
    monkeypatch,
):
    monkeypatch.setattr(places, "_SITES", 91)
    both = lattices()
    about = {"unit_nm": 0.5, "count": 0}
    assert (
        OnLattices.of(both, KINDS, CENTRES, **about).height == 13 * 900
    )  # 91 sites of 7 columns
    monkeypatch.setattr(places, "_SITES", 30)
    assert OnLattices.of(both, KINDS, CENTRES, **about).height == 8 * 900
