"""Derivatives of small truncations by differences: films, layers with coats, tilted
walls, mirrors that are broken.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.cell import Cell, Film, Index, Lattice, Layer
from metalens.cell.shapes import Ellipse, Polygon, Rectangle
from metalens.rcwa import any_shape, pattern
from metalens.rcwa.problem import cell_problem
from metalens.rcwa.rates import coupling, regions, solved, tables, truncated, verb
from metalens.rcwa.rates.parameters import parameter_motion, pillar_parameters
from tests.metalens.rcwa.rates.test_jones_derivatives import differenced, varied

WAVE, SIZE = 0.73, 0.25
ABOUT = {
    "height_um": 0.53,
    "pillar": Index(2.7, 0.03),
    "substrate": Index(1.45),
    "between": Index(1.1),
}
LAYERS = (Layer(0.1, 0.03, Index(1.6)), Layer(0.43, coat=Index(1.9), coat_um=0.012))
FILMS = {
    "under": (Film(Index(1.9), 0.07), Film(Index(1.6), 0.05)),
    "over": (Film(Index(1.3), 0.11),),
}
TRIANGLE = Polygon(((-0.5, -0.3), (0.5, -0.3), (0.0, 0.6)))
OBLONG = Lattice("rectangular", 1.3)
CASES = {
    "mirrors": (Cell(0.41, shape=Rectangle(0.6), lattice=OBLONG, **ABOUT), (0.0, 0.0)),
    "one mirror": (Cell(0.41, shape=TRIANGLE, **ABOUT), (0.0, 0.0)),
    "films and layers": (
        Cell(0.41, shape=TRIANGLE, layers=LAYERS, **FILMS, **ABOUT),
        (0.2, 0.4),
    ),
    "half turn": (
        Cell(0.41, shape=Ellipse(0.7, 0.2), layers=LAYERS, **ABOUT),
        (0.0, 0.0),
    ),
    "tilted": (
        Cell(
            0.41,
            shape=TRIANGLE,
            lattice=OBLONG,
            sidewall_rad=0.04,
            over=FILMS["over"],
            **ABOUT,
        ),
        (0.0, 0.0),
    ),
}
ASKED = {
    "mirrors": ["size_um", "shape.angle_rad", "sidewall_rad"],
    "one mirror": ["height_um", "shape.corners.1.x", "pillar.n"],
    "films and layers": ["under.1.thickness_um", "over.0.thickness_um", "layers.1.coat_um", "between.n"],
    "half turn": ["shape.angle_rad", "layers.1.coat.n"],
    "tilted": ["shape.corners.2.y", "sidewall_rad", "height_um", "over.0.thickness_um"],
}  # fmt: skip


@pytest.fixture
def one_normal_field(monkeypatch):
    """One field of normals for all: any has the same limit, and derivatives hold it."""
    own, fixed = pattern.normal_tables, (Ellipse(1.0).outline(0.24),)
    monkeypatch.setattr(
        pattern,
        "normal_tables",
        lambda outlines, cell, reach, *_: own(
            fixed, Cell(0.41, lattice=cell.lattice), reach
        ),
    )


def values(cell, size_um, light, stages, reach=1):
    return truncated.solve_with_rates(
        cell_problem(cell, size_um, WAVE, *light), reach, stages, {}
    )


@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_the_least_truncation_are_its_differences(
    case, one_normal_field
):
    """The steps leave 1e-8 of the largest. A tilt of an upright wall is told by steep
    collocation of six stages.
    """
    cell, light = CASES[case]
    stages = 2 if cell.sidewall_rad else 0
    reach = (
        2 if case == "mirrors" else 1
    )  # orders along the axes alone turn no light from x to y
    known = pillar_parameters(cell, SIZE, WAVE)
    motions = {name: parameter_motion(known[name], WAVE) for name in ASKED[case]}
    found = truncated.solve_with_rates(
        cell_problem(cell, SIZE, WAVE, *light), reach, stages, motions
    )
    plain = any_shape.jones(
        cell, SIZE, WAVE, angle_rad=light[0], azimuth_rad=light[1], harmonics=reach
    )
    if not stages:
        assert found.both == pytest.approx(np.stack([plain.t, plain.r]), abs=1e-12)
    for name, got in found.by.items():
        upright = name == "sidewall_rad" and not stages
        step, few = (1e-3, 6) if upright else (3e-5, stages)

        def at(x, name=name, few=few):
            return values(*varied(cell, SIZE, name, x), light, few, reach).both

        want = differenced(at, step)
        # of a tilt over 1 mrad: its own order 1e-6, and what collocation of an upright
        # wall leaves
        assert np.abs(got - want).max() < (1e-5 if upright else 1e-6) * max(
            np.abs(want).max(), 0.1
        ), name
        assert np.abs(want).max() > 1e-3


def test_energy_is_the_power_of_all_orders_that_leave():
    """One without loss; with it what t and r of the zero order have, where no other
    propagates.
    """
    clear = dataclasses.replace(CASES["films and layers"][0], pillar=Index(2.7))
    assert values(clear, SIZE, (0.2, 0.4), 0).energy == pytest.approx(
        [1.0, 1.0], abs=1e-12
    )
    lossy = values(CASES["one mirror"][0], SIZE, (0.0, 0.0), 0)
    assert lossy.energy == pytest.approx(
        (np.abs(lossy.both) ** 2).sum(axis=(0, 1)), abs=1e-12
    )
    assert (lossy.energy < 0.999).all()


def test_an_error_is_how_far_derivatives_moved_from_truncation_to_truncation():
    cell = Cell(0.41, shape=Rectangle(0.6), **ABOUT)
    this = cell_problem(cell, SIZE, WAVE, 0.0, 0.0)
    climb = any_shape.truncation_sequence(this, 2)
    move = {
        "height_um": parameter_motion(
            pillar_parameters(cell, SIZE, WAVE)["height_um"], WAVE
        )
    }
    history = [
        truncated.solve_with_rates(this, reach, 0, move).by["height_um"]
        for reach in climb.reaches
    ]
    assert len(history) == 2
    found = verb.jones_derivatives(
        cell, SIZE, WAVE, harmonics=2, by=["height_um"], tolerance=1e-2
    )
    want = climb.crowded * any_shape.estimate_error(history, 2, climb.before)
    assert found.by["height_um"].error == pytest.approx(want, rel=1e-9)
    assert np.stack(
        [found.by["height_um"].t, found.by["height_um"].r]
    ) == pytest.approx(history[-1], rel=1e-9)
    alone = verb.jones_derivatives(cell, SIZE, WAVE, harmonics=1, by=["height_um"])
    assert alone.by["height_um"].error == math.inf
    assert found.jones.t == pytest.approx(
        any_shape.jones(cell, SIZE, WAVE, harmonics=2).t, abs=1e-12
    )


def test_an_error_holds_what_a_stage_more_of_a_tilted_wall_changes():
    cell = Cell(0.41, shape=Rectangle(0.6), sidewall_rad=0.05, **ABOUT)
    this, move = (
        cell_problem(cell, SIZE, WAVE, 0.0, 0.0),
        {
            "height_um": parameter_motion(
                pillar_parameters(cell, SIZE, WAVE)["height_um"], WAVE
            )
        },
    )
    few, more = (
        truncated.solve_with_rates(this, 1, stages, move).by["height_um"]
        for stages in (1, 2)
    )
    left = float(np.abs(few - more).max())
    assert verb._left_by_collocation(this, move, 2, 1) == {
        "height_um": pytest.approx(left, rel=1e-9)
    }
    assert left > 0
    assert verb._left_by_collocation(this, move, 0, 1) == {"height_um": 0.0}


def test_sections_are_told_at_foot_and_top_or_at_eight_nodes():
    upright, tilted = CASES["mirrors"][0], CASES["tilted"][0]
    assert truncated.sampled_heights(upright) == (0.0, 1.0)
    nodes = (1 - np.cos(np.pi * (2 * np.arange(8) + 1) / 16)) / 2
    assert truncated.sampled_heights(tilted) == pytest.approx(nodes)
    layer = tilted.sections[0]
    for share in (0.0, 0.25, 1.0):
        got = (
            truncated.slab_at(tilted, (layer, 0.01), SIZE, WAVE, share)
            .outlines[0]
            .area_um2
        )
        wider = 0.01 - (share - 0.5) * 2 * math.tan(0.04) * 0.53
        assert got == pytest.approx(
            tilted.outline(SIZE, grow_um=wider).area_um2, rel=1e-9
        )


def test_a_change_that_keeps_the_mirrors_does_not_couple_their_classes():
    """Of width or index; a turn has nothing but the coupling."""
    cell, light = CASES["mirrors"]
    this = cell_problem(cell, SIZE, WAVE, *light)
    classes = [
        solved.solve_adjoint_class(this, operations, 2, 0)
        for operations in this.classes
    ]
    slabs = [
        truncated.slab_at(cell, (cell.sections[0], 0.0), SIZE, WAVE, share)
        for share in (0.0, 1.0)
    ]
    known = pillar_parameters(cell, SIZE, WAVE)
    for name, within in (
        ("size_um", True),
        ("pillar.n", True),
        ("shape.angle_rad", False),
    ):
        rates = parameter_motion(known[name], WAVE).numbers[0]
        table = tables.coefficient_rates(
            slabs[0], cell, classes[0].space.reach, rates[0]
        )
        for i, rows in enumerate(classes):
            for j, columns in enumerate(classes):
                pair = coupling.ClassCoupling(rows, columns, 0, cell, slabs)
                rate = pair.rate([table, None])
                assert rate.shape == (2, 1, 1)
                assert bool(np.abs(rate).max() > 1e-6) is ((i == j) is within), (
                    name,
                    i,
                    j,
                )


def test_numbers_of_a_section_change_its_coefficients_as_differences_say():
    """Outlines first, then permittivities from the inside out: a coated triangle, with
    unlike rates of all of them.
    """
    cell = CASES["films and layers"][0]
    slab = truncated.slab_at(cell, (cell.layers[1], 0.0), SIZE, WAVE, 0.5)
    assert tables.section_parameters(slab)[-3:] == pytest.approx(
        [(2.7 + 0.03j) ** 2, 1.9**2, 1.1**2]
    )
    for name in (
        "size_um",
        "layers.1.coat_um",
        "shape.corners.0.y",
        "layers.1.coat.n",
        "between.n",
        "pillar.n",
    ):
        one = pillar_parameters(cell, SIZE, WAVE)[name]
        rates = parameter_motion(one, WAVE).numbers[1]
        got = tables.coefficient_rates(slab, cell, (2, 3), (rates[0] + rates[1]) / 2)

        def at(x, one=one):
            now = one.moved(x)
            moved = truncated.slab_at(
                now.cell, (now.cell.layers[1], now.grow_um), now.size_um, WAVE, 0.5
            )
            return np.stack(
                pattern.permittivity_coefficients(moved, now.cell, (2, 3))
            ).astype(complex)

        want = differenced(at, 1e-5)
        assert np.stack(got) == pytest.approx(want, abs=1e-7 * np.abs(want).max()), name


def test_fields_beside_others_and_upside_down():
    rng = np.random.default_rng(3)
    one, other = (
        regions.RegionFields(
            rng.normal(size=(2, k)), rng.normal(size=(2, k)), rng.normal(size=(3, 4, k))
        )
        for k in (2, 3)
    )
    both = one.beside(other)
    for name in ("up", "down", "ends"):
        parts = getattr(one, name), getattr(other, name)
        assert getattr(both, name).tolist() == np.concatenate(parts, axis=-1).tolist()
    turned = one.upside_down
    assert (turned.up.tolist(), turned.down.tolist()) == (
        one.down.tolist(),
        one.up.tolist(),
    )
    assert turned.ends[0, :2].tolist() == one.ends[2, :2].tolist()
    assert turned.ends[2, 2:].tolist() == (-one.ends[0, 2:]).tolist()
