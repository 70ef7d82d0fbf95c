"""Write fields cut no pillar; what stitching costs the focus, by the square of its
error and the variance of ramps.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from layout.mask import fields
from layout.process.process import Process, WriteField
from layout.study import stitching
from metalens.cell.record import Cell
from metalens.core.errors import ProcessError
from metalens.fabrication import Bias
from metalens.lens.record import DiameterMap, Lens
from metalens.library.proxy import Proxy

PROXY = Proxy(
    np.array([[3.3, 3.3, 0.2]]),
    np.array([[0.9, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)


def numbers_of(plan, row, column):
    """Fields of sites, counted along x first."""
    across = np.searchsorted(plan.columns, column, side="right") - 1
    down = np.searchsorted(plan.rows, row, side="right") - 1
    return down * (len(plan.columns) - 1) + across


def process(size_um, mode="floating", stitching_nm=20.0):
    return Process(write_field=WriteField(size_um, mode, stitching_nm))


def hyperbolic(n=201, distance_um=200.0, source_um=2000.0):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r = np.hypot(x, x[:, None])
    path = np.sqrt(r**2 + distance_um**2) + np.sqrt(r**2 + source_um**2)
    wanted = np.remainder(-2 * np.pi / 0.85 * path, 2 * np.pi)
    table = np.linspace(0.1, 0.3, 401)
    phase = PROXY.phase_rad(table, 0.85)
    diameter = np.interp(wanted, phase - phase[0], table)
    diameters = DiameterMap(np.where(r < n * 0.2, diameter, 0), 0.4)
    return Lens(diameters, Cell(0.4), PROXY, 0.85, distance_um, source_um, "hyperbolic")


@settings(max_examples=50)
@given(
    n=st.integers(1, 60), m=st.integers(1, 60), size=st.floats(2, 40), mode=st.sampled_from(["floating", "shift"]),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_no_border_cuts_a_pillar_and_every_pillar_has_one_field(n, m, size, mode, seed):
    rng = np.random.default_rng(seed)
    d = np.where(rng.random((n, m)) < 0.7, rng.uniform(0.05, 0.39, (n, m)), 0)
    d[rng.integers(n), rng.integers(m)] = 0.3
    diameters = DiameterMap(d, 0.4)
    plan = fields.split_write_fields(diameters, process(size, mode))
    rows, columns = np.nonzero(d)
    for positions, borders, index in (
        (diameters.x_um, plan.x_um, columns),
        (diameters.y_um, plan.y_um, rows),
    ):
        away = abs(positions[index][:, None] - borders)
        assert (
            away - d[rows, columns][:, None] / 2
        ).min() >= plan.clearance_um - 0.51e-3  # half a step, halved
        assert plan.clearance_um > 0
        assert np.diff(borders).max() <= size + 1e-9
    number = numbers_of(plan, rows, columns)
    counted = np.zeros(d.shape, int)
    for k, block in enumerate(plan.blocks()):
        counted[block] += 1
        inside = np.zeros(d.shape, bool)
        inside[block] = True
        assert (inside[rows, columns] == (number == k)).all()
    assert (counted[rows, columns] == 1).all()
    assert plan.used == len(np.unique(number))


def test_floating_fields_are_as_few_and_as_equal_as_can_be():
    plan = fields.split_write_fields(
        DiameterMap(np.full((250, 101), 0.2), 0.4), process(40.0)
    )
    assert np.diff(plan.rows).tolist() == [83, 83, 84]
    assert np.diff(plan.columns).tolist() == [50, 51]


def test_a_fixed_raster_is_shifted_to_the_gaps_and_keeps_its_period():
    plan = fields.split_write_fields(
        DiameterMap(np.full((250, 250), 0.2), 0.4), process(30.1, "shift")
    )
    assert set(np.diff(plan.rows).tolist()) == {75}
    assert plan.y_um[0] <= -50
    assert plan.y_um[-1] >= 50


def test_a_field_below_the_pitch_is_refused():
    with pytest.raises(ProcessError, match="smaller than the pitch"):
        fields.split_write_fields(hyperbolic(21).diameters, process(0.3))


def test_the_loss_is_what_the_variance_of_the_ramps_says():
    # 1 - S = variance over the pillars of k delta (sin of the angle to the focus + to
    # the source)
    lens, chosen = hyperbolic(), process(30.0)
    plan = fields.split_write_fields(lens.diameters, chosen)
    report = stitching.simulate_stitching(lens, plan, chosen, draws=400, seed=2)
    x, y = lens.diameters.x_um, lens.diameters.y_um[:, None]
    r2 = x**2 + y**2
    sine = 1 / np.sqrt(r2 + 200.0**2) + 1 / np.sqrt(r2 + 2000.0**2)
    ramp = 2 * np.pi / 0.85 * np.stack([x * sine, y * sine])
    weight = lens.transmission() / np.sqrt(1 + r2 / 200**2) ** 2
    number = numbers_of(plan, *np.indices(r2.shape))
    rng = np.random.default_rng(2)
    want = []
    for _ in range(400):
        offset = rng.uniform(-1, 1, (number.max() + 1, 2)) * 0.02
        phase = offset[number, 0] * ramp[0] + offset[number, 1] * ramp[1]
        mean = np.average(phase, weights=weight)
        # a common tilt only moves the spot: take out the best plane
        a = (
            np.stack([ramp[0].ravel(), ramp[1].ravel()], 1)
            * np.sqrt(weight.ravel())[:, None]
        )
        plane = np.linalg.lstsq(
            a, ((phase - mean) * np.sqrt(weight)).ravel(), rcond=None
        )[0]
        want.append(
            np.average(
                (phase - mean - plane[0] * ramp[0] - plane[1] * ramp[1]) ** 2,
                weights=weight,
            )
        )
    # sampled peak, two sets of 400 draws
    assert 1 - report.strehl.mean() == pytest.approx(np.mean(want), rel=0.2)


def test_the_clearance_is_that_of_what_is_drawn():
    bias = dataclasses.replace(
        process(30.0), bias=Bias(table_nm=((50.0, -20.0), (400.0, -20.0)))
    )
    plan = fields.split_write_fields(DiameterMap(np.full((40, 43), 0.25), 0.4), bias)
    drawn_um = float(bias.written_diameter_nm(250.0)) * 1e-3
    assert drawn_um > 0.269  # drawn wider by what the process takes
    # half a diameter step, halved
    assert plan.clearance_um == pytest.approx((0.4 - drawn_um) / 2, abs=0.5e-3)
