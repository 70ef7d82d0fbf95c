"""Parts of a made lens's PSFs by hand: pillars gathered to cells, cells on nodes,
harmonics on samples, waves.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from characterize.model import process_state_of
from characterize.model.parameters import NAMES, parameter_vector
from codesign.optics import built
from metalens.fabrication import Sensitivity, transmission
from metalens.image import Pupil, coordinates
from metalens.lens import DiameterMap
from tests.codesign import made_lens as m

GATHER = getattr(
    built._gather, "py_func", built._gather
)  # as written: a place beyond the table is an error


def test_cells_hold_the_mean_of_their_pillars_with_the_bias_where_each_stands():
    """5 x 7 pillars in blocks of 3; bias 0.01 + 0.004 u - 0.002 v + 0.003 uv + 0.005 u²
    of a table by place.
    """
    rng = np.random.default_rng(4)
    diameter = rng.uniform(0.1, 0.3, (5, 7)).astype(np.float32)
    diameter[1, 2], diameter[3:, 3:6] = 0, 0  # one pillar is missing, and all of a cell
    carrier = np.exp(2j * np.pi * rng.random((5, 7))).astype(np.complex64)
    u, v = np.linspace(-0.9, 0.8, 7), np.linspace(-0.5, 1.0, 5)
    bias = np.array([[0.01, -0.002, 0.0], [0.004, 0.003, 0.0], [0.005, 0.0, 0.0]])
    low, step = 0.05, 1e-3
    table = np.exp(1j * np.arange(400) / 50).astype(np.complex64)
    got = GATHER(
        diameter, carrier, table, np.empty(0, complex), low, step, u, v, bias, 3
    )
    assert got.shape == (2, 3)
    for row, column in np.ndindex(2, 3):
        terms = []
        for i, j in np.ndindex(5, 7):
            if (i // 3, j // 3) == (row, column) and diameter[i, j] > 0:
                x, y = u[j], v[i]
                wide = (
                    diameter[i, j]
                    + 0.01
                    + 0.004 * x
                    - 0.002 * y
                    + 0.003 * x * y
                    + 0.005 * x * x
                )
                terms.append(table[round((wide - low) / step)] * carrier[i, j])
        want = np.mean(terms) if terms else 0.0
        assert got[row, column] == pytest.approx(want, abs=1e-6)
    assert got[1, 1] == 0
    assert GATHER(
        diameter[:, :6],
        carrier[:, :6],
        table,
        np.empty(0, complex),
        low,
        step,
        u[:6],
        v,
        bias,
        3,
    ).shape == (2, 2)


def test_empty_cells_take_the_nearest_filled_one():
    cells = np.array([[0, 0, 2 + 1j, 0], [0, 3j, 0, 0], [0, 0, 0, 5.0]])
    filled = built._filled(cells)
    assert filled[cells != 0].tolist() == cells[cells != 0].tolist()
    assert filled[2, 0] == 3j
    assert filled[0, 3] == 2 + 1j
    assert filled[1, 3] == 5.0


def test_a_lens_keeps_what_is_made_and_leaves_its_bench():
    x = np.arange(1.0, len(NAMES) + 1)
    kept = built.of_lens(x)
    for name, before, after in zip(NAMES, x, kept, strict=True):
        assert after == (
            before if name in built.OF_LENS else parameter_vector()[NAMES.index(name)]
        )
    assert "distance_um" in built.OF_LENS


def test_harmonics_of_a_period_are_integrated_over_samples_up_to_half_their_rate():
    """Waves of the period come out as their mean over each sample, those beyond half a
    wave a sample not at all, the
    last in part."""
    lens = built.MadeLens(m.small(), m.OPTICS)
    pupil = Pupil(60.2, 300.0, 0.85, 64)
    period, sample = pupil.period_um, 3.0
    edge = period / (2 * sample)
    harmonics, columns = lens._samples(pupil)
    assert harmonics == math.floor(edge + 0.5) + 1
    place = (np.arange(11) - 5) * sample
    for at, order in enumerate(range(-harmonics + 1, harmonics)):
        f, share = order / period, min(1.0, max(0.0, edge - abs(order) + 0.5))
        ends = [
            np.exp(2j * np.pi * f * (place + side * sample / 2)) for side in (1, -1)
        ]
        mean = (ends[0] - ends[1]) / (2j * np.pi * f * sample) if order else np.ones(11)
        assert columns[:, at].numpy() == pytest.approx(share * mean, abs=2e-6)


@pytest.mark.parametrize(("sample_um", "nodes"), [(3.0, 64), (30.0, 202)])
def test_nodes_hold_the_window_twice_and_sixty_four_at_least(sample_um, nodes):
    """15 samples (four are spare) by the direction cosine of the rim, 0.18995 at half a
    pitch beyond the last pillar,
    over the wavelength: 100.6 to either side."""
    lens = built.MadeLens(m.small(), dataclasses.replace(m.OPTICS, sample_um=sample_um))
    pupil = lens._pupil(310.0)
    assert pupil.radius_um == lens.design.diameters.radius_um + 0.2
    assert pupil.edge == pytest.approx(0.18995, abs=1e-5)
    assert pupil.nodes == nodes
    assert pupil.sensor_distance_um == 310.0


def test_a_wave_of_another_distance_is_the_design_s_defocused():
    """exp(ik (√(r² + d'²) - d' - √(r² + d²) + d)) within the rim, nothing beyond."""
    lens = built.MadeLens(m.small(), m.OPTICS)
    plain, moved = lens.wave(), lens.wave(parameter_vector({"distance_um": 7.0}))
    x, y = (c.numpy() for c in coordinates(lens._pupil(300.0)))
    r = np.hypot(x, y)
    inside = np.abs(plain) > 0
    assert np.array_equal(inside, np.abs(moved) > 0)
    assert (r[inside] < 62).all()
    assert inside.sum() == pytest.approx(
        math.pi / 4 * inside.size, rel=0.05
    )  # nodes across the aperture
    assert (
        abs(plain.sum()) > 0.97 * np.abs(plain).sum()
    )  # of the design itself all focusing phase is off
    assert np.median(np.abs(plain[inside])) == pytest.approx(
        0.9, abs=0.05
    )  # the level of the pillars
    paths = np.hypot(r, 307.0) - 307.0 - np.hypot(r, 300.0) + 300.0
    turned = plain[inside] * np.exp(2j * np.pi / 0.85 * paths[inside])
    assert moved[inside] == pytest.approx(turned, abs=1e-6)


def oblong():
    """A lens of 31 x 20 um whose pillars stand on half of it, and its cells of 6
    pillars: 13 x 9.
    """
    sizes = np.random.default_rng(6).uniform(0.1, 0.3, (51, 78))
    sizes[:, :40] = 0.0
    sizes[20:30, :3] = 0.2
    lens = dataclasses.replace(m.small(), diameters=DiameterMap(sizes, 0.4))
    return built.MadeLens(lens, m.OPTICS)


def test_cells_hold_the_pillars_as_made_by_the_response_that_is_given():
    """Pillar by pillar: bias at its own place over the rim, heights by a response that
    is not the one of the index.
    Half a step of the table is 5e-6 um of some 60 rad/um."""
    design, response = (
        oblong().design,
        Sensitivity(np.array([[-0.2 + 9j, 50j], [3j, 12j], [1.5j, 6j]]), 0.17),
    )
    lens = built.MadeLens(design, m.OPTICS, response=response)
    known = process_state_of(
        parameter_vector(
            {"bias_nm": 4.0, "bias_x_nm": 3.0, "bias_y_nm": -17.0, "height_nm": -8.0}
        )
    )
    d = design.diameters
    rim = d.radius_um
    u, v = np.meshgrid(d.x_um / rim, d.y_um / rim)
    grown = d.diameter_um + 4e-3 + 3e-3 * u - 17e-3 * v
    t = transmission(
        design.proxy, response, grown.ravel(), design.wavelength_um, known.answers()
    ).reshape(grown.shape)
    light = np.where(d.diameter_um > 0, t * lens._carrier, 0)
    got = lens._gathered(known)
    assert got.shape == (9, 13)
    for row, column in np.ndindex(9, 13):
        cell = np.s_[6 * row : 6 * row + 6, 6 * column : 6 * column + 6]
        stands = max(int((d.diameter_um[cell] > 0).sum()), 1)
        assert got[row, column] == pytest.approx(light[cell].sum() / stands, abs=5e-4)


CELL_Y, CELL_X = (
    (np.arange(9)[:, None] * 6 + 2.5 - 25.0) * 0.4,
    (np.arange(13) * 6 + 2.5 - 38.5) * 0.4,
)


def test_nodes_take_what_lies_straight_between_the_middles_of_cells():
    """A field that grows evenly comes out as it is at any place; beyond the last
    middles as there.
    """
    cells = (3 + 0.2 * CELL_X - 0.1 * CELL_Y) + 1j * (2 - 0.3 * CELL_X + 0.7 * CELL_Y)
    y, x = np.array([[-8.7, 0.4], [3.3, 9.1]]), np.array([[-13.0, 11.2], [2.9, -0.4]])
    got = oblong()._on_nodes(cells, x, y)
    assert got == pytest.approx(
        (3 + 0.2 * x - 0.1 * y) + 1j * (2 - 0.3 * x + 0.7 * y), abs=1e-12
    )
    assert oblong()._on_nodes(
        cells, np.array([99.0]), np.array([-99.0])
    ) == pytest.approx(cells[:1, -1], abs=1e-12)


def test_the_lens_plane_lies_on_its_cells_and_bends_as_the_lens_was_bent():
    """The same evenly growing field, now at rays; coma along x of 0.3 rad rms: 0.3 √8
    (3 r³ - 2 r) cos.
    """
    lens, known = oblong(), parameter_vector({"coma_x_rad": 0.3})
    cells = (3 + 0.2 * CELL_X - 0.1 * CELL_Y) + 1j * (2 - 0.3 * CELL_X + 0.7 * CELL_Y)
    rim = lens.design.diameters.radius_um
    assert rim == pytest.approx(0.4 * math.hypot(25.0, 38.5))
    y, x = (
        torch.tensor([-8.7, 3.3, 0.9]).double(),
        torch.tensor([-13.0, 2.9, 9.4]).double(),
    )
    u, v = x.numpy() / rim, y.numpy() / rim
    want = (3 + 0.2 * x - 0.1 * y) + 1j * (2 - 0.3 * x + 0.7 * y)
    flat = lens._plane(parameter_vector(), cells)
    assert flat.added_rad is None
    assert flat.radius_um == pytest.approx(rim + 0.2)
    assert flat.factor(x, y, 0.85, 0.0).numpy() == pytest.approx(want.numpy(), abs=2e-6)
    bent = np.exp(0.3j * math.sqrt(8) * (3 * (u**2 + v**2) - 2) * u)
    assert lens._plane(known, cells).factor(x, y, 0.85, 0.0).numpy() == pytest.approx(
        want.numpy() * bent, abs=3e-6
    )
    assert lens._plane(
        known, np.where(np.abs(cells) > 0, cells, 0)
    ).half_um == pytest.approx((13 * 1.2, 9 * 1.2))


def test_every_row_of_a_lens_has_the_phase_of_its_focus_off():
    """Rows are taken 128 at a time; here 301: exp(-i phase) with -k (√(r² + d²) + √(r²
    + s²)) on them all.
    """
    lens = built.MadeLens(m.small(), m.OPTICS)
    d = lens.design.diameters
    r2 = d.x_um**2 + d.y_um[:, None] ** 2
    path = np.sqrt(r2 + 300.0**2) - 300.0 + np.sqrt(r2 + 3000.0**2) - 3000.0
    turn = lens._carrier * np.exp(-2j * np.pi / 0.85 * path)
    assert turn == pytest.approx(
        np.full(turn.shape, turn[150, 150]), abs=2e-4
    )  # complex64 of some 100 rad


def test_without_parameters_a_lens_is_the_design():
    lens = built.MadeLens(m.small(), m.OPTICS)
    known = parameter_vector({"bias_nm": 9.0, "distance_um": 5.0, "spherical_rad": 0.3})
    plain = lens.stack().intensity
    assert torch.equal(plain, lens.stack(parameter_vector()).intensity)
    assert built.psf_error(lens.stack(known), lens.stack()) > 0.01
