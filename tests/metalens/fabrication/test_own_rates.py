"""Pillars by their own shape: derivatives of ln t against differences of the same
truncation.
"""

import dataclasses

import numpy as np
import pytest

from metalens.cell import Cell, Index, Layer
from metalens.cell.shapes import Circle, Rectangle
from metalens.fabrication import (
    ResponseError,
    inapplicable_names,
    names_of_kind,
    own_rates,
    solved_rates,
)
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy
from metalens.rcwa import jones, solve_truncation

WAVE, SIZE, RATIO, ANGLE = 0.85, 0.23, 0.62, 0.2
CELL = Cell(
    0.4,
    0.57,
    Index(2.6),
    Index(1.45),
    Index(1.1),
    Index(1.05),
    shape=Rectangle(RATIO, ANGLE),
)
ROUND = dataclasses.replace(CELL, shape=Circle())
ROWS = names_of_kind(ResponseError)


def lens(cell=CELL, *, hand="", tilted_light=False):
    phase = np.array([[4.6, 4.2, 0.5]])
    level = np.array([[0.83, 0.02]])
    most = 0.2 if tilted_light else 0.0
    phase, level = (table[None] if tilted_light else table for table in (phase, level))
    proxy = Proxy(phase, level, (0.1, 0.3), (0.85, 0.85), 0.0, 0.0, max_angle_rad=most)
    sizes = np.full((3, 4), 0.2)
    turns = {"angle_rad": np.full((3, 4), 0.3)} if hand else {}
    return Lens(
        DiameterMap(sizes, 0.4, **turns),
        cell,
        proxy,
        WAVE,
        150.0,
        1500.0,
        "map",
        hand=hand,
    )


def changed(name, x):
    """(cell, size) with so much more of one cause, in um, rad or 1."""
    if name == "height_nm":
        return dataclasses.replace(CELL, height_um=CELL.height_um + x), SIZE
    if name == "index":
        return dataclasses.replace(CELL, pillar=Index(2.6 + x)), SIZE
    if name == "turn_deg":
        return dataclasses.replace(CELL, shape=Rectangle(RATIO, ANGLE + x)), SIZE
    width = SIZE + (name == "width_nm") * x
    length = RATIO * SIZE + (name == "length_nm") * x
    return dataclasses.replace(CELL, shape=Rectangle(length / width, ANGLE)), width


@pytest.fixture
def few_orders(monkeypatch):
    """Three harmonics and walls of few steps, where a solve takes milliseconds."""
    monkeypatch.setattr(solved_rates, "_TRUNCATIONS", (2, 3))
    monkeypatch.setattr(solved_rates, "_WALL_STEP_RAD", 5e-5)


# of the Jones matrix: the mean of both polarisations, left-handed light that leaves
# right-handed (light along x: the layered pillars below)
SEEN = {
    "of any kind": ({"tilted_light": True}, lambda j: (j[0, 0] + j[1, 1]) / 2),
    "left": (
        {"hand": "left"},
        lambda j: (j[0, 0] - j[1, 1] - 1j * (j[0, 1] + j[1, 0])) / 2,
    ),
}


@pytest.fixture(scope="module")
def changed_jones():
    """Jones matrices of pillars 2 nm, 2 mrad or 2e-3 of index to either side of the
    design, at nine harmonics: finer than the derivatives' own, normals sampled anew.
    """
    step, ends = 2e-3, {}
    for name in ("height_nm", "index", "turn_deg", "width_nm", "length_nm"):
        ends[name] = [changed(name, x) for x in (step, -step)]
    ends["grown"] = [
        (dataclasses.replace(CELL, layers=(Layer(CELL.height_um, x),)), SIZE)
        for x in (step, -step)
    ]
    ends["wider"] = [(CELL, SIZE + x) for x in (step, -step)]
    return step, {
        name: [solve_truncation(*end, WAVE, harmonics=9).t for end in both]
        for name, both in ends.items()
    }


@pytest.mark.parametrize(
    "light", ["left", pytest.param("of any kind", marks=pytest.mark.slow)]
)
def test_derivatives_are_the_differences_of_the_light_that_the_proxy_is_of(
    light, changed_jones
):
    """Truncation leaves 4 % between seven and nine harmonics; sampled normals 0.1."""
    about, seen = SEEN[light]
    found = own_rates(lens(**about), np.array([SIZE]))
    step, ends = changed_jones

    def slope(name):
        more, less = (np.log(seen(t)) for t in ends[name])
        return (more - less) / (2 * step)

    for name in ("height_nm", "index", "turn_deg", "width_nm", "length_nm"):
        within = 0.06 * abs(slope(name)) + 0.1
        assert abs(found.rates[ROWS.index(name), 0] - slope(name)) < within, name
    want = slope("grown") - slope("wider")
    assert abs(found.edges[0] - want) < 0.06 * abs(want) + 0.15
    assert abs(found.edges[0]) > 0.1 * abs(slope("wider"))


def test_round_pillars_keep_their_form_as_their_edges_move(few_orders):
    found = own_rates(lens(ROUND), np.array([SIZE]))
    assert not found.edges.any()
    assert not found.rates[
        [ROWS.index(name) for name in ("width_nm", "length_nm", "turn_deg")]
    ].any()


def in_layers(x=0.0):
    """Foot and pillar of its own material, 3 to 4, a spacer between them and a residual
    mask on top.
    """
    layers = (
        Layer(0.21 + 3 / 7 * x, grow_um=0.02),
        Layer(0.04, material=Index(1.5)),
        Layer(0.28 + 4 / 7 * x),
        Layer(0.05, grow_um=-0.015, material=Index(1.9)),
    )
    return dataclasses.replace(ROUND, height_um=0.58 + x, layers=layers)


def on_films(pedestal_um=0.0, cap_um=0.0):
    """Two films under the pillar, 2 to 1, and one on it."""
    layers = (
        Layer(0.06 + 2 / 3 * pedestal_um, grow_um=0.03, material=Index(1.7)),
        Layer(0.03 + 1 / 3 * pedestal_um, material=Index(2.1)),
        Layer(0.41),
        Layer(0.05 + cap_um, grow_um=-0.015, material=Index(1.9, 0.02)),
    )
    return dataclasses.replace(
        ROUND, height_um=0.55 + pedestal_um + cap_um, layers=layers
    )


@pytest.mark.parametrize(
    ("made", "changed_by", "row"),
    [
        (in_layers, "x", "height_nm"),
        (on_films, "pedestal_um", "pedestal_nm"),
        (on_films, "cap_um", "cap_nm"),
    ],
)
def test_a_height_is_that_of_the_films_that_it_is_of(made, changed_by, row, few_orders):
    """Of the pillar's own material, the films under it or those on it: differences of
    cells written out by hand, over 0.1 nm: their order leaves 1e-6.
    """
    found = own_rates(lens(made()), np.array([SIZE]))
    ends = (made(**{changed_by: x}) for x in (1e-4, -1e-4))
    more, less = (np.log(jones(e, SIZE, WAVE, harmonics=3).t[0, 0]) for e in ends)
    assert found.rates[ROWS.index(row), 0] == pytest.approx(
        (more - less) / 2e-4, rel=1e-4
    )


def test_a_pillar_has_a_pedestal_and_a_cap_where_films_of_another_material_are():
    assert inapplicable_names(dataclasses.replace(on_films(), shape=CELL.shape)) == ()
    layered = dataclasses.replace(in_layers(), shape=CELL.shape)
    assert inapplicable_names(layered) == ("pedestal_nm",)
    assert inapplicable_names(CELL) == ("pedestal_nm", "cap_nm")
    bare = dataclasses.replace(
        CELL, height_um=0.3, layers=(Layer(0.3, material=Index(1.9)),)
    )  # nothing is its own
    assert inapplicable_names(bare) == ("pedestal_nm", "cap_nm")


def test_a_pillar_cut_into_two_sections_answers_as_the_whole(few_orders):
    cut = dataclasses.replace(CELL, layers=(Layer(0.2), Layer(CELL.height_um - 0.2)))
    whole, parts = (own_rates(lens(cell), np.array([SIZE])) for cell in (CELL, cut))
    for name in ("height_nm", "index", "width_nm", "length_nm", "turn_deg"):
        row = ROWS.index(name)
        assert parts.rates[row] == pytest.approx(whole.rates[row], rel=1e-9), name
    assert parts.edges == pytest.approx(whole.edges, rel=1e-9)
