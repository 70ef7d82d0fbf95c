"""Derivatives of the Jones matrices: differences of the same truncation, the modal
method, closed forms, invariants.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Film, Index, Lattice, Layer
from metalens.cell.shapes import (
    Cross,
    Ellipse,
    Polygon,
    Rectangle,
    RegularPolygon,
    Ring,
    Square,
)
from metalens.core.errors import CellError
from metalens.rcwa import any_shape, pattern
from metalens.rcwa.problem import cell_problem
from metalens.rcwa.rates import verb
from metalens.rcwa.rates.parameters import parameter_motion, pillar_parameters
from metalens.rcwa.rates.truncated import solve_with_rates

WAVE = 0.73
ABOUT = {
    "height_um": 0.53,
    "pillar": Index(2.7),
    "substrate": Index(1.45),
    "cover": Index(1.0),
    "between": Index(1.1),
}
LOSSY = ABOUT | {"pillar": Index(2.7, 0.03), "substrate": Index(1.45, 0.02)}
LAYERS = (Layer(0.1, 0.03, Index(1.6)), Layer(0.43, coat=Index(1.9), coat_um=0.012))
FILMS = {
    "under": (Film(Index(1.9), 0.07), Film(Index(1.6), 0.05)),
    "over": (Film(Index(1.3), 0.11),),
}
TRIANGLE = Polygon(((-0.5, -0.3), (0.5, -0.3), (0.0, 0.6)))
HEXAGONAL, OBLONG = Lattice("hexagonal"), Lattice("rectangular", 1.3)
SLANT = {"angle_rad": 0.2, "azimuth_rad": 0.4}
CASES = {
    "square at normal incidence": (Cell(0.41, shape=Square(), **ABOUT), {}),
    "rectangle in its mirrors": (
        Cell(0.41, shape=Rectangle(0.6), lattice=OBLONG, **ABOUT),
        {"angle_rad": 0.15},
    ),
    "rectangle between films": (
        Cell(0.41, shape=Rectangle(0.6, 0.2), **ABOUT, **FILMS),
        SLANT,
    ),
    "triangle": (Cell(0.41, shape=TRIANGLE, **ABOUT), {}),
    "ring": (Cell(0.41, shape=Ring(0.4), lattice=HEXAGONAL, **LOSSY), SLANT),
    "cross": (Cell(0.41, shape=Cross(0.4, 0.3), lattice=OBLONG, **LOSSY), {}),
    "coated ellipse in layers": (
        Cell(0.41, shape=Ellipse(0.7, 0.2), layers=LAYERS, **ABOUT),
        SLANT,
    ),
    "pentagonal hole": (
        Cell(0.41, shape=RegularPolygon(5, 0.1, hole=True), layers=LAYERS, **ABOUT),
        SLANT,
    ),
    "tilted rectangle": (
        Cell(0.41, shape=Rectangle(0.7), sidewall_rad=0.04, **ABOUT),
        {},
    ),
    "tilted layers": (
        Cell(
            0.41,
            shape=TRIANGLE,
            lattice=OBLONG,
            sidewall_rad=-0.03,
            layers=LAYERS,
            **LOSSY,
        ),
        SLANT,
    ),
}


def varied(cell, size_um, name, x):
    """(cell, size) with one number changed, told by its name alone."""
    if name == "size_um":
        return cell, size_um + x
    if name == "grow_um":
        layers = tuple(
            dataclasses.replace(one, grow_um=one.grow_um + x) for one in cell.sections
        )
        return dataclasses.replace(cell, layers=layers), size_um
    return _set(cell, name.split("."), x), size_um


def _set(record, path, x):
    if isinstance(record, float):
        return record + x
    if isinstance(record, tuple):
        at = "xy".index(path[0]) if path[0] in ("x", "y") else int(path[0])
        return (*record[:at], _set(record[at], path[1:], x), *record[at + 1 :])
    changed = {path[0]: _set(getattr(record, path[0]), path[1:], x)}
    if isinstance(record, Cell) and path[0] == "layers":
        changed["height_um"] = sum(layer.height_um for layer in changed["layers"])
    return dataclasses.replace(record, **changed)


@pytest.fixture
def one_normal_field(monkeypatch):
    """One field of normals for all, with every symmetry: any has the same limit, and
    the usual one is sampled.
    """
    own, fixed = pattern.normal_tables, (Ellipse(1.0).outline(0.24),)
    monkeypatch.setattr(
        pattern,
        "normal_tables",
        lambda outlines, cell, reach, *_: own(fixed, cell, reach),
    )


def both(cell, size_um, **about):
    found = rcwa.jones(cell, size_um, WAVE, **about)
    return np.stack([found.t, found.r])


def differenced(at, step):
    """Of fourth order."""
    ends = [at(k * step) - at(-k * step) for k in (1, 2)]
    return (8 * ends[0] - ends[1]) / (12 * step)


TOLD = {  # numbers of the costly cases
    "coated ellipse in layers": [
        "size_um",
        "grow_um",
        "layers.0.grow_um",
        "layers.1.coat_um",
        "layers.1.coat.n",
    ],
    "pentagonal hole": [
        "size_um",
        "shape.angle_rad",
        "layers.0.height_um",
        "layers.1.coat_um",
        "between.n",
    ],
    "tilted rectangle": ["shape.ratio", "shape.angle_rad", "height_um", "sidewall_rad"],
    "tilted layers": [
        "size_um",
        "shape.corners.2.y",
        "sidewall_rad",
        "layers.0.height_um",
        "layers.0.material.n",
    ],
}


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_the_differences_of_the_same_truncation(case, one_normal_field):
    """The steps leave 1e-8 of the largest, at resonances 1e-7; a term that is left out,
    1e-3 or more.
    """
    cell, light = CASES[case]
    about = light | {"harmonics": 1 if cell.sidewall_rad else 2}
    found = rcwa.jones_derivatives(cell, 0.25, WAVE, **about, by=TOLD.get(case))
    assert (
        np.abs(
            np.stack([found.jones.t, found.jones.r]) - both(cell, 0.25, **about)
        ).max()
        < 1e-12
    )
    for name, rate in found.by.items():
        if name == "sidewall_rad" and not cell.sidewall_rad:
            continue  # the next test
        want = differenced(
            lambda x, name=name: both(*varied(cell, 0.25, name, x), **about), 3e-5
        )
        assert np.abs(np.stack([rate.t, rate.r]) - want).max() < 1e-6 * max(
            np.abs(want).max(), 0.1
        ), name


@pytest.mark.parametrize(
    "case", ["square at normal incidence", "rectangle between films"]
)
def test_an_upright_wall_knows_what_a_tilt_would_do(case, one_normal_field):
    """Tilted walls by collocation: its 1e-9 of t are 1e-6 of a difference over 1 mrad,
    whose own order leaves 1e-6.
    """
    cell, light = CASES[case]
    rate = rcwa.jones_derivatives(
        cell, 0.25, WAVE, **light, harmonics=1, by=["sidewall_rad"]
    ).by["sidewall_rad"]
    about = light | {"harmonics": 1, "tolerance": 1e-8}
    want = differenced(
        lambda x: both(*varied(cell, 0.25, "sidewall_rad", x), **about), 1e-3
    )
    assert np.abs(np.stack([rate.t, rate.r]) - want).max() < 1e-5 * np.abs(want).max()


def test_what_the_last_stage_of_a_tilted_wall_changes_is_told_of_every_derivative(
    one_normal_field,
):
    """By differences of values with two and with three stages, too few for either; none
    of an upright wall.
    """
    cell, _ = CASES["tilted rectangle"]

    def values(stages, x):
        moved = dataclasses.replace(cell, height_um=cell.height_um + x)
        return solve_with_rates(
            cell_problem(moved, 0.25, WAVE, 0.15, 0.1), 1, stages, {}
        ).both

    this = cell_problem(cell, 0.25, WAVE, 0.15, 0.1)
    motions = {
        "height_um": parameter_motion(
            pillar_parameters(cell, 0.25, WAVE)["height_um"], WAVE
        )
    }
    few, more = (
        differenced(lambda x, count=count: values(count, x), 3e-5) for count in (2, 3)
    )
    told = verb._left_by_collocation(this, motions, 3, 1)
    assert told == {"height_um": pytest.approx(np.abs(more - few).max(), rel=1e-5)}
    assert verb._left_by_collocation(this, motions, 0, 1) == {"height_um": 0.0}


def test_round_pillars_have_the_derivatives_of_the_modal_method():
    """Its central differences: both ends lie on one mesh and err alike."""
    cell, light = Cell(0.41, **ABOUT), {"angle_rad": 0.2}
    names = ("size_um", "height_um", "pillar.n", "grow_um")
    found = rcwa.jones_derivatives(cell, 0.2, WAVE, **light, harmonics=6, by=names).by
    index, step = cell.pillar.n, 4e-4
    changed = {
        "size_um": lambda x: (cell, 0.2 + x),
        "height_um": lambda x: (
            dataclasses.replace(cell, height_um=cell.height_um + x),
            0.2,
        ),
        "pillar.n": lambda x: (dataclasses.replace(cell, pillar=Index(index + x)), 0.2),
    }
    for place, polarization in enumerate("sp"):
        for name, at in changed.items():
            high, low = (
                modal.solve(
                    *at(side * step),
                    WAVE,
                    polarization=polarization,
                    tolerance=1e-4,
                    **light,
                ).t
                for side in (1, -1)
            )
            exact = (high - low) / (2 * step)
            left = abs(found[name].t[place, place] - exact)
            assert left < found[name].error, (name, polarization)
            # 6 orders: 3.5 %; 8 orders: below 2 %
            assert left < 0.05 * abs(exact), (name, polarization)
    apart = np.abs(found["grow_um"].t - found["size_um"].t).max()
    assert apart < 1e-9 * np.abs(found["size_um"].t).max()


def test_power_keeps_and_so_does_what_it_changes_by():
    """No loss, one order on either side: every column of (t, r) keeps its length."""
    found = rcwa.jones_derivatives(
        CASES["rectangle between films"][0], 0.25, WAVE, **SLANT, harmonics=3
    )
    value = np.concatenate([found.jones.t, found.jones.r])
    for name, rate in found.by.items():
        change = np.concatenate([rate.t, rate.r])
        flow = (np.conj(value) * change).real.sum(axis=0)
        assert np.abs(flow).max() < 1e-9 * np.abs(change).max(), name


def test_turning_what_looks_alike_changes_nothing_and_mirrors_leave_only_the_mixing():
    angle = "shape.angle_rad"
    circle = rcwa.jones_derivatives(
        Cell(0.41, shape=Ellipse(1.0), **ABOUT),
        0.2,
        WAVE,
        **SLANT,
        harmonics=3,
        by=[angle],
    )
    assert np.abs(circle.by[angle].t).max() < 1e-12
    square = rcwa.jones_derivatives(
        Cell(0.41, shape=Square(), **ABOUT), 0.2, WAVE, harmonics=3, by=[angle]
    )
    assert np.abs(np.diag(square.by[angle].t)).max() < 1e-12
    assert (
        np.abs(square.by[angle].t).max() < 1e-2
    )  # four-fold: no mixing, but for the samples of the normals
    longer = rcwa.jones_derivatives(
        Cell(0.41, shape=Rectangle(0.6), **ABOUT), 0.25, WAVE, harmonics=3, by=[angle]
    )
    rate = longer.by[angle].t
    assert np.abs(np.diag(rate)).max() < 1e-12 < 0.1 < abs(rate[0, 1])


def test_a_pillar_that_moves_as_a_whole_changes_straight_light_within_the_errors():
    """Its normals are held, and so the sum over the corners is 0 in the limit alone.
    Their size is the size.
    """
    found = rcwa.jones_derivatives(CASES["triangle"][0], 0.25, WAVE, harmonics=6).by
    for axis in "xy":
        parts = [found[f"shape.corners.{i}.{axis}"] for i in range(3)]
        assert np.abs(sum(part.t for part in parts)).max() < min(
            0.15, sum(part.error for part in parts)
        )
        assert max(np.abs(part.t).max() for part in parts) > 1
    scaled = sum(
        TRIANGLE.corners[i]["xy".index(a)] * found[f"shape.corners.{i}.{a}"].t
        for i in range(3)
        for a in "xy"
    )
    assert found["size_um"].t * 0.25 == pytest.approx(scaled, rel=1e-8, abs=1e-9)


def test_parts_of_a_pillar_add_up():
    whole = Cell(0.41, shape=Rectangle(0.6, 0.2), **ABOUT)
    cut = dataclasses.replace(whole, layers=(Layer(0.2), Layer(0.33)))
    one = rcwa.jones_derivatives(whole, 0.25, WAVE, **SLANT, harmonics=3).by
    two = rcwa.jones_derivatives(cut, 0.25, WAVE, **SLANT, harmonics=3).by
    for name in set(one) & set(two):
        assert two[name].t == pytest.approx(one[name].t, rel=1e-8, abs=1e-8)
        assert two[name].error == pytest.approx(one[name].error, rel=1e-6)
    for i in (0, 1):
        assert two[f"layers.{i}.height_um"].r == pytest.approx(
            one["height_um"].r, rel=1e-8
        )
    grown = two["layers.0.grow_um"].t + two["layers.1.grow_um"].t
    assert grown == pytest.approx(one["grow_um"].t, rel=1e-8)


def test_a_pillar_of_what_is_around_it_is_a_film():
    """All modes coincide in pairs and more; t of a film in closed form, its index the
    mean that the pillar fills.
    """
    cell = Cell(0.41, shape=Rectangle(0.6), **(ABOUT | {"pillar": Index(1.1)}))
    found = rcwa.jones_derivatives(cell, 0.25, WAVE, harmonics=3, tolerance=1e-3).by

    def film(n, height_um):
        phase = 2 * math.pi * n * height_um / WAVE
        below, above = 1.45, 1.0
        first, last = (below - n) / (below + n), (n - above) / (n + above)
        through = 4 * below * n / ((below + n) * (n + above)) * np.exp(1j * phase)
        return (
            through / (1 + first * last * np.exp(2j * phase)) * math.sqrt(above / below)
        )

    by_n = differenced(lambda x: film(1.1 + x, 0.53), 1e-3)
    by_height = differenced(lambda x: film(1.1, 0.53 + x), 1e-3)
    assert np.diag(found["height_um"].t) == pytest.approx([by_height] * 2, rel=1e-9)
    assert np.diag(found["pillar.n"].t + found["between.n"].t) == pytest.approx(
        [by_n] * 2, rel=1e-9
    )
    assert np.abs(found["size_um"].t).max() < 1e-9


def test_errors_hold_what_finer_truncations_change():
    for cell, light in (
        CASES["rectangle in its mirrors"],
        (Cell(0.41, shape=Cross(0.4), **LOSSY), {}),
    ):
        coarse, fine = (
            rcwa.jones_derivatives(cell, 0.3, WAVE, **light, harmonics=m).by
            for m in (5, 8)
        )
        for name, rate in coarse.items():
            left = max(
                np.abs(rate.t - fine[name].t).max(), np.abs(rate.r - fine[name].r).max()
            )
            assert left < rate.error, name
    assert (
        rcwa.jones_derivatives(cell, 0.3, WAVE, harmonics=1).by["size_um"].error
        == math.inf
    )  # nothing to compare


def test_an_error_is_what_truncations_moved_as_that_of_t_and_what_a_stage_fewer_changes():
    """Each truncation asked for by itself; of a tilted wall with and without the last
    stage, at the least of them.
    """
    upright = CASES["square at normal incidence"][0]
    tilted = dataclasses.replace(upright, sidewall_rad=0.05)
    for cell, most, names in (
        (upright, 4, ("size_um", "pillar.n")),
        (tilted, 2, ("height_um",)),
    ):
        this = cell_problem(cell, 0.3, WAVE, 0.0, 0.0)
        climb = any_shape.truncation_sequence(this, most, collocated=cell is tilted)
        about = {"by": names, "tolerance": 1e-2}
        parts = [
            rcwa.jones_derivatives(cell, 0.3, WAVE, **about, harmonics=reach).by
            for reach in climb.reaches
        ]
        assert len(parts) > 1
        stages = any_shape.choose_stages(this, climb, 1e-2)[0]
        assert (stages > 0) is (cell is tilted)
        for name in names:
            history = [np.stack([one[name].t, one[name].r]) for one in parts]
            want = climb.crowded * any_shape.estimate_error(history, most, climb.before)
            if stages:
                moves = {
                    name: parameter_motion(
                        pillar_parameters(cell, 0.3, WAVE)[name], WAVE
                    )
                }
                ends = [
                    solve_with_rates(this, climb.reaches[0], count, moves).by[name]
                    for count in (stages - 1, stages)
                ]
                left = np.abs(ends[1] - ends[0]).max()
                assert left > 0
                want += left
            assert parts[-1][name].error == pytest.approx(want, rel=1e-9)


def test_one_truncation_alone_tells_nothing_of_a_derivative_s_error():
    """|t| is at most 1, which bounds the error of a value that nothing is compared
    with; no such bound has its rate.
    """
    cell = CASES["square at normal incidence"][0]
    found = rcwa.jones_derivatives(cell, 0.3, WAVE, harmonics=1, by=["size_um"])
    assert found.by["size_um"].error == math.inf
    assert 0 < found.jones.t_error < math.inf


def test_a_film_of_no_thickness_can_have_some():
    """One-sided differences of fourth order over 1 nm: 1e-8 and their own order."""

    def at(thickness_um):
        cell = Cell(
            0.41,
            shape=Square(),
            under=(Film(Index(1.9), 0.07), Film(Index(2.2), thickness_um)),
            **ABOUT,
        )
        found = rcwa.jones(cell, 0.25, WAVE, harmonics=1)
        return cell, np.stack([found.t, found.r])

    rate = rcwa.jones_derivatives(
        at(0.0)[0], 0.25, WAVE, harmonics=1, by=["under.1.thickness_um"]
    ).by
    rate = rate["under.1.thickness_um"]
    parts = [
        weight * at(1e-3 * k)[1] for k, weight in enumerate((-25, 48, -36, 16, -3))
    ]
    assert (
        np.abs(np.stack([rate.t, rate.r]) - sum(parts) / 12e-3).max()
        < 1e-6 * np.abs(rate.t).max()
    )
    assert np.abs(rate.t).max() > 1


def test_a_number_without_a_point_is_a_number_and_a_count_of_sides_is_none():
    whole, plain = (pillar_parameters(Cell(0.41, shape=shape, **ABOUT), 0.15, WAVE) for shape in
                    (Rectangle(2, 0), Rectangle(2.0, 0.0)))  # fmt: skip
    assert set(whole) == set(plain) > {"shape.ratio", "shape.angle_rad"}
    assert whole["shape.ratio"].moved(1e-3).cell.shape == Rectangle(2.001)
    pentagon = pillar_parameters(
        Cell(0.41, shape=RegularPolygon(5), **ABOUT), 0.15, WAVE
    )
    assert {name for name in pentagon if name.startswith("shape.")} == {
        "shape.angle_rad"
    }


def test_what_has_no_derivative_is_told_by_its_name():
    cell = Cell(0.41, shape=Ring(0.4), **ABOUT)
    with pytest.raises(
        CellError,
        match=r"no number 'ratio' in this cell; it has size_um, .*shape.ratio",
    ):
        rcwa.jones_derivatives(cell, 0.25, WAVE, by=["ratio"])
    closing = dataclasses.replace(cell, layers=(Layer(0.53, grow_um=0.4 * 0.25),))
    with pytest.raises(
        CellError, match=r"no derivative by size_um: an outline that is just losing"
    ):
        rcwa.jones_derivatives(closing, 0.25, WAVE)
    widest = dataclasses.replace(cell, shape=Rectangle(100.0))
    with pytest.raises(
        CellError,
        match=r"no derivative by shape.ratio: .* 0.01 to 100 \(or ask for others alone",
    ):
        rcwa.jones_derivatives(widest, 0.003, WAVE, harmonics=1)
    assert set(
        rcwa.jones_derivatives(widest, 0.003, WAVE, harmonics=1, by=["size_um"]).by
    ) == {"size_um"}
