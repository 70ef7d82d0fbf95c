"""Light on the nodes of pupils that are dark in places, of few depths and of many, by
its formula; powers by parts.
"""

import numpy as np
import pytest

from metalens.field import compiled

draw = np.random.default_rng(41)


@pytest.mark.parametrize("few", [1, 2, 4, 5, 6])
def test_light_on_dark_and_bright_nodes_is_the_formula(few):
    """weight exp(2πi (turns + Σ mix paths)) of each depth: five mixtures go in one
    pass, other numbers one by one. Rows
    that begin and end in the dark, with a dark node inside, one that is lit at its ends
    alone, and one without light.
    Sines of float32: 2e-7 of weights of 3."""
    weight = draw.uniform(0.5, 3, (5, 9))
    weight[0, :2], weight[0, 7:], weight[0, 4] = 0, 0, 0
    weight[1, 1:8] = 0
    weight[2] = 0
    weight[3, 1:] = 0
    turns, paths = draw.uniform(-40, 40, (5, 9)), draw.uniform(-900, 900, (few, 5, 9))
    mix = draw.normal(size=(3, few))
    got = compiled.phasors(weight, turns, paths, mix)
    assert got.shape == (3, 5, 9)
    assert got.dtype == np.complex64
    phase = turns + np.einsum("df,fyx->dyx", mix, paths)
    assert got == pytest.approx(weight * np.exp(2j * np.pi * phase), abs=1.5e-6)
    assert (got[:, weight == 0] == 0).all()


def test_powers_are_squares_of_both_parts():
    field = np.array([[3 + 4j, -5j], [2.5, -1 - 1j], [0, 0.5 - 0.25j]], np.complex64)
    assert compiled.power(field).tolist() == [[25.0, 25.0], [6.25, 2.0], [0.0, 0.3125]]


@pytest.mark.parametrize("depths", [1, 2, 3, 4, 7])
def test_sheets_between_depths_take_the_polynomial_through_their_nodes(depths):
    """Weights that are a power of the node's number come back at any place between: of
    a cubic where there are four
    nodes or more. Places at nodes and at both ends; a dark pixel takes nothing from
    where it lies."""
    high, wide, rank = 3, 4, 2
    order = min(3, depths - 1)
    nodes = np.arange(depths, dtype=np.float32)
    table = np.stack([nodes**order, 2.0 + 0 * nodes], 1)  # (depths, rank)
    tables = np.ascontiguousarray(
        np.repeat(table[:, :, None], high * wide, axis=2), np.float32
    )
    energy = np.repeat((1 + 0.5 * nodes)[:, None], high * wide, axis=1).astype(
        np.float32
    )
    if depths == 1:
        energy[:] = 1.0
    place = draw.uniform(0, depths - 1, (1, 1, high, wide)).astype(np.float32)
    place[0, 0, 0, :3] = 0.0, depths - 1, (depths - 1) // 2
    content = draw.uniform(0.2, 1, place.shape).astype(np.float32)
    content[0, 0, 2, 3] = 0
    for lit in (True, False):
        out = np.full((high, rank, 1, wide), np.nan, np.float32)
        compiled.weigh(
            content, place, np.array([[0, 0]]), (tables, energy), lit, 0, out
        )
        at = place[0, 0].astype(float)
        level = (1 + 0.5 * at if depths > 1 else 1.0) if lit else 1.0
        want = content[0, 0] * level
        assert out[:, 0, 0] == pytest.approx(
            want * (at**order if depths > 1 else 1.0), rel=3e-5, abs=3e-5
        )
        assert out[:, 1, 0] == pytest.approx(2 * want * np.ones_like(at), rel=3e-5)
