"""Parts of the windowed engine on few pillars: bases of depths, carriers of blocks,
where a plan is missing.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens import propagate
from metalens.core import legendre
from metalens.propagate import PropagationCase, blocks, choice, operators, window

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900, 1 / 2500),
    (14.0, -8.5),
    0.6,
    (3, 4),
)
NODES = legendre.mapped_nodes(9, -5.365, 5.365), legendre.mapped_nodes(11, -7.4, 7.4)


def phases(case=CASE, nodes=NODES):
    """(depth, y, x) of sources at -z (0.21, -0.13, 1), less that of the middle of 1/z,
    by plain distances.
    """
    y, x = nodes[0][:, None], nodes[1]

    def path(inverse):
        z = 1 / inverse
        return np.sqrt((x + 0.21 * z) ** 2 + (y - 0.13 * z) ** 2 + z**2) - z * np.sqrt(
            1 + 0.21**2 + 0.13**2
        )

    middle = path((1 / 400 + 1 / 2500) / 2)
    return np.stack(
        [
            np.exp(2j * np.pi / 0.85 * (path(v) - middle))
            for v in case.inverse_depths_per_um
        ]
    )


def test_depths_are_sums_of_fields_that_are_orthonormal_under_the_weights_of_the_nodes():
    made = operators.depth_basis(CASE, NODES, 1e-9)
    weight = np.outer(
        legendre.gauss_legendre_nodes(9)[1], legendre.gauss_legendre_nodes(11)[1]
    )
    flat = made.basis.reshape(len(made.basis), -1)
    assert (flat * weight.ravel()) @ flat.conj().T == pytest.approx(
        np.eye(len(flat)), abs=1e-10
    )
    got = np.einsum("zb,byx->zyx", made.coefficients, made.basis)
    assert got == pytest.approx(
        phases(), abs=1e-7
    )  # paths of 1e4 rad in float64, and the tolerance
    size = np.linalg.svd((phases() * np.sqrt(weight)).reshape(3, -1), compute_uv=False)
    assert made.strength == pytest.approx(size / size[0], rel=1e-6)


def test_a_loose_tolerance_leaves_weak_fields_out():
    """Root mean square of what is left of all depths together, against the singular
    values.
    """
    weight = np.outer(
        legendre.gauss_legendre_nodes(9)[1], legendre.gauss_legendre_nodes(11)[1]
    )
    size = np.linalg.svd((phases() * np.sqrt(weight)).reshape(3, -1), compute_uv=False)
    tail = [np.sqrt((size[k:] ** 2).sum() / (size**2).sum()) for k in range(3)]
    assert tail[1] > 2 * tail[2]
    for tolerance, rank in (
        (1.01 * tail[1], 1),
        (0.99 * tail[1], 2),
        (1.01 * tail[2], 2),
        (0.99 * tail[2], 3),
    ):
        assert len(operators.depth_basis(CASE, NODES, tolerance).basis) == rank


def test_coefficients_that_move_are_those_of_the_basis():
    made = operators.depth_basis(CASE, NODES, 1e-9)
    sizes = SimpleNamespace(nodes=(9, 11))
    plan = SimpleNamespace(
        case=CASE, nodes_um=NODES, layout=SimpleNamespace(sizes=sizes), depths=made,
        tensors={"coefficients": torch.zeros(1, dtype=torch.complex128)},
    )  # fmt: skip
    moving = SimpleNamespace(
        tangents=torch.tensor([0.21, -0.13], dtype=torch.float64),
        inverse_depths=torch.tensor(CASE.inverse_depths_per_um, dtype=torch.float64),
    )
    got = window._coefficients(plan, moving).numpy()
    assert got == pytest.approx(made.coefficients, abs=1e-9)


@pytest.mark.parametrize(
    ("itemsize", "least", "scale"), [(4, 2e-8, 1.0), (8, 1e-11, 1.0), (8, 1e-11, 1e4)]
)
def test_a_carrier_is_a_polynomial_where_that_is_as_exact_as_asked(
    monkeypatch, itemsize, least, scale
):
    """An error put into one row of one block is refused from the limit on: in turns,
    and 5e-15 of the largest path.

    Of 35 000 waves that rounds to 1.8e-10, of which 4e-11 is there already.
    """
    case = replace(
        CASE,
        shape=(96, 41),
        pitch_um=scale * CASE.pitch_um,
        sensor_distance_um=scale * CASE.sensor_distance_um,
        inverse_depths_per_um=tuple(v / scale for v in CASE.inverse_depths_per_um),
        centre_um=(scale * 14.0, scale * -8.5),
    )
    real, reference = blocks._powers, 1 / 800 / scale
    x, y = case.pillars_um[1], case.pillars_um[0]
    limit = (
        least
        + 5e-15 * np.abs(blocks.carrier_turns(case, reference, x, y[:, None])).max()
    )
    for sign in (1, -1):
        for off, kept in ((0.7, True), (1.6, False)):

            def powers(case, reference, rows, x, order, off=off, sign=sign):
                out = real(
                    case, reference, rows, x, order
                )  # blocks of two rows: exact to rounding
                out[1, 0, 1] += sign * off * limit
                return out

            monkeypatch.setattr(blocks, "_powers", powers)
            found = blocks._carried(case, reference, 2, itemsize)
            assert found == kept


def test_rounding_of_long_paths_keeps_no_block_from_being_used():
    """A 10 mm lens, paths of 2600 waves: polynomials over two rows leave nothing but
    rounding, some units in the last
    place of the path, 4.5e-13 turns. Its standard deviation is what the estimate
    reckons with, within a factor of 8."""
    given = dict(
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=2e4,
        depths_um=[2e4],
        angle_rad=0.35,
    )
    case = propagate.make_case((25000, 25000), **given, window_um=10, samples=4)
    assert blocks._carried(case, 1 / 2e4, 2, 8)
    rows = blocks.AxisBlocks(25000, 64, 64)
    x, y = case.pillars_um[1][::2500], rows.middles_um(0.4)[[0, 40, -1], None, None]
    half = 63 / 2 * 0.4
    got = rows.along[:, None] ** np.arange(9) @ blocks._powers(
        case, 1 / 2e4, (y, half), x, 9
    )
    error = (
        (got - blocks.carrier_turns(case, 1 / 2e4, x, y + half * rows.along[:, None]))
        * 2
        * np.pi
    )
    assert 2 * np.pi * 4.5e-13 < np.abs(error).max() < 2 * np.pi * 12 * 4.5e-13
    made = blocks.ReferencePhase(case, 1 / 2e4, rows, 512).rounding_rad
    assert made / 8 < error.std() < made


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("tangents", "centre_um"),
    [((0.31, -0.06), (55.0, 3.0)), ((-0.05, 0.27), (-4.0, -61.0))],
)
@pytest.mark.parametrize("shape", [(30, 410), (380, 41)])
def test_the_rounding_of_a_carrier_is_that_of_its_longest_path(
    sign, tangents, centre_um, shape
):
    """A tenth of 5e-15 of it, in rad; the longest by plain distances over all pillars
    of a lens that is no square, with
    a window beside the axis: at the rim on one side of the axis and not on the other.
    """
    tangents, centre_um = (
        tuple(sign * v for v in pair) for pair in (tangents, centre_um)
    )
    case = replace(CASE, shape=shape, tangents=tangents, centre_um=centre_um)
    y, x = np.meshgrid(*case.pillars_um[::-1], indexing="xy")[::-1]
    z, d = 777.0, case.sensor_distance_um
    source = np.sqrt((x + z * tangents[0]) ** 2 + (y + z * tangents[1]) ** 2 + z**2)
    sensor = np.sqrt((x - centre_um[0]) ** 2 + (y - centre_um[1]) ** 2 + d**2)
    path = (
        source
        - z * np.sqrt(1 + np.hypot(*tangents) ** 2)
        + sensor
        - np.hypot(d, np.hypot(*centre_um))
    )
    want = 2 * np.pi * 5e-16 * np.abs(path).max() / 0.85
    made = blocks.ReferencePhase(
        case, 1 / 777.0, blocks.AxisBlocks(shape[0], 16, 16), 512
    ).rounding_rad
    assert made == pytest.approx(
        want, rel=0.02, abs=0
    )  # half a pillar more at the rim: 0.19 of 76 um


def test_both_corners_of_a_window_need_a_plan(monkeypatch):
    for missing in ((0, 0), (-1, -1)):
        asked = []

        def plan(one, tolerance, missing=missing, asked=asked):
            rows = choice.split_window(CASE, 1)
            asked.append(one)
            whole = one.samples == CASE.samples
            corner = (
                choice.split_window(CASE, 2)[missing[0]][missing[1]]
                if not whole
                else rows[0][0]
            )
            return None if one == corner else "plan"

        monkeypatch.setattr(choice, "_layout", plan)
        found = choice._windows(CASE, 1e-4)
        assert [len(row) for row in found] == [
            4,
            4,
            4,
        ]  # three rows of one sample, not two
