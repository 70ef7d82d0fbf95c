"""Where a library is sampled, which entries are solved again, and what a stretch leaves
out: numbers made by hand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Light
from metalens.cell.shapes import Square
from metalens.ground.errors import DomainError
from metalens.pillars import few_nodes, stretch, sweep
from metalens.pillars.curve import Curve, Nodes, starts
from metalens.pillars.record import DEFAULT_CELL, Sweep


def curve_with(*poles):
    return SimpleNamespace(resonances=lambda: np.array(poles, float).reshape(-1, 2))


def test_diameters_are_even_and_denser_around_what_is_narrow():
    """Steps of 5 nm: half-widths above 0.1 and below 15 nm are followed at 0.3, 1 and 3
    of them to both sides.
    """
    made = sweep._diameters(
        (0.1, 0.2),
        21,
        [curve_with((0.1314, 0.004), (0.15, 0.016)), curve_with((0.17, 0.00009))],
    )
    added = [0.1314 + s * 0.004 for s in (-3, -1, -0.3, 0.3, 1, 3)]
    assert made == pytest.approx(
        np.sort([*np.linspace(0.1, 0.2, 21), *added]), abs=1e-12
    )
    edge = sweep._diameters(
        (0.1, 0.2), 21, [curve_with((0.1011, 0.0011), (0.199, 0.0149))]
    )
    inside = [0.1011 + s * 0.0011 for s in (-0.3, 0.3, 1, 3)] + [
        0.199 + s * 0.0149 for s in (-3, -1, -0.3)
    ]
    assert edge == pytest.approx(
        np.sort([*np.linspace(0.1, 0.2, 21), *inside]), abs=1e-6
    )  # ends are not passed
    many = [(0.1 + 0.0001 * k, 0.0002) for k in range(1, 999)]
    wide = sweep._diameters((0.1, 0.2), 21, [curve_with(*many)])
    added = sorted(
        {
            round(c + s * w, 6)
            for c, w in many
            for s in sweep.AROUND
            if 0.1 < c + s * w < 0.2
        }
    )
    kept = added[:: math.ceil(len(added) / 400)]
    assert wide == pytest.approx(
        np.unique([*np.linspace(0.1, 0.2, 21), *kept]), abs=1e-6
    )


def test_entries_above_the_tolerance_are_solved_eight_at_a_time():
    settings = Sweep(wavelengths_um=(0.85,), samples=20, tolerance=0.02)
    d = np.linspace(0.1, 0.2, 24)
    error = np.full(24, 0.02)
    bad = [1, 4, 5, 6, 9, 10, 11, 15, 16, 20]
    error[bad] = 0.0201
    rows = {
        Light(0.85): np.stack([d, d, error]).astype(complex),
        Light(0.9): np.stack([d, d, 0 * d]).astype(complex),
    }
    tasks = sweep._points(DEFAULT_CELL, settings, "modal", d, rows, {})
    assert [task["diameters_um"] for task in tasks] == [
        d[bad[:8]].tolist(),
        d[bad[8:]].tolist(),
    ]
    assert all(task["lights"] == [[0.85, 0.0, "x", 0.0]] for task in tasks)


def test_entries_are_left_where_the_finest_truncation_cannot_do_better():
    """Of squares whose probes missed half of the tolerance; where either node is good,
    interpolation is to blame.
    """
    square = Cell(0.36, shape=Square())
    settings, d, light = (
        Sweep(samples=20, tolerance=0.02),
        np.linspace(0.1, 0.2, 24),
        Light(0.85),
    )
    rows = {light: np.stack([d, d, np.full(24, 0.03)]).astype(complex)}
    nodes = np.array(starts(0.1, 0.2))
    solver = np.where(
        nodes > 0.14, 0.021, 0.011
    )  # the first node above lies at 0.15, the last below at 0.1371

    def tasks(cell, errors):
        held = Nodes(nodes, np.ones((13, 2)), errors, np.ones(13), True, "")
        made = sweep._points(
            cell, settings, "rcwa", d, rows, {light: Curve(held, None, (), 0.02)}
        )
        return [one for task in made for one in task["diameters_um"]]

    assert tasks(square, solver) == [one for one in d.tolist() if one < 0.15]
    assert tasks(square, np.where(nodes > 0.14, 0.0099, 0.021)) == [
        one for one in d.tolist() if one > 0.1371
    ]
    assert (
        tasks(square, np.full(13, 0.0099)) == d.tolist()
    )  # coarser orders serve the probes: finer ones are there
    assert (
        tasks(DEFAULT_CELL, solver) == d.tolist()
    )  # round pillars by themselves climb higher


def test_lights_share_a_task_where_they_share_modes_and_oblique_ones_come_first():
    normal, s, p, other = (
        Light(0.85, 0.0, "x"),
        Light(0.85, 0.1, "s"),
        Light(0.85, 0.1, "p"),
        Light(0.84, 0.2, "s"),
    )
    assert sweep._together([normal, s, other, p], True) == [[other], [s, p], [normal]]
    assert sweep._together([normal, s, other, p], False) == [
        [other],
        [s],
        [p],
        [normal],
    ]


def test_single_solves_stand_where_they_are_better():
    d = np.array([0.1, 0.12, 0.15])
    row = np.array([[1, 2j, 3], [0.1, 0.2, 0.3], [0.05, 0.02, 0.04]], complex)
    result = {
        "diameter_um": [0.12, 0.15],
        "t": [[0.5, 0.6], [0.7, -0.8]],
        "r": [[0.01, 0.02], [-0.03, 0.04]],
        "error": [0.02, 0.039],
    }
    sweep._replace(row, d, result)
    want = np.array(
        [[1, 2j, 0.7 - 0.8j], [0.1, 0.2, -0.03 + 0.04j], [0.05, 0.02, 0.039]]
    )
    assert row == pytest.approx(want)


def test_a_library_holds_every_light_at_its_place():
    """Two angles and two wavelengths; at 0 one light answers for both polarisations."""
    settings = Sweep(
        wavelengths_um=(0.8, 0.9), angles_deg=(0.0, 7.0), samples=20, tolerance=0.02
    )
    normal = few_nodes.ALIKE
    d, rows = np.array([0.1, 0.2, 0.25]), {}
    rng = np.random.default_rng(3)
    for wave in (0.8, 0.9):
        for angle in (0.0, 7.0):
            for kind in ("s", "p"):
                light = few_nodes.light(wave, angle, kind, normal)
                t, r = rng.uniform(0.1, 0.6, (2, 3)) * np.exp(
                    1j * rng.uniform(0, 6, (2, 3))
                )
                rows[light] = np.stack([t, r, rng.uniform(0, 0.01, 3)])
    lit = few_nodes.light(0.9, 7.0, "p", normal)
    made = sweep._library(
        DEFAULT_CELL,
        settings,
        ("modal", 77),
        d,
        {lit: curve_with((0.13, 0.002))},
        rows,
        normal,
    )
    for i, kind in enumerate(("s", "p")):
        for j, angle in enumerate((0.0, 7.0)):
            for k, wave in enumerate((0.8, 0.9)):
                row = rows[few_nodes.light(wave, angle, kind, normal)]
                assert np.array_equal(made.t[i, j, k], row[0])
                assert np.array_equal(made.r[i, j, k], row[1])
                assert np.array_equal(made.t_error[i, j, k], row[2].real)
                assert made.energy[i, j, k] == pytest.approx(
                    np.abs(row[0]) ** 2 + np.abs(row[1]) ** 2
                )
    assert made.resonances == pytest.approx(
        np.array([[1, math.radians(7), 0.9, 0.13, 0.002]])
    )
    assert made.angle_rad == pytest.approx([0, math.radians(7)])
    assert (made.engine, made.solves) == ("modal", 77)


D = np.linspace(0.10, 0.40, 61)  # 5 nm apart


def library(level=None, phase=None, poles=()):
    """Two polarisations, two angles, two wavelengths; all pass 0.9 of the amplitude and
    turn by 20 rad per um.
    """
    turn = (
        20 * (D - 0.1)
        + 2.0
        + np.array([0.0, 2.0])[:, None]
        + np.array([0.0, 1.7])[:, None, None]
    )
    shape = (2, 2, 2, 61)
    t = np.broadcast_to(0.9 * np.exp(1j * turn), shape).copy()
    t[1] *= np.exp(0.02j)
    if level is not None:
        t[1, 0, 1] *= level
    if phase is not None:
        t[0, 1, 0] *= np.exp(1j * phase)
    bars = np.full(shape, 1e-4)
    narrow = np.array(poles, float).reshape(-1, 5)
    return SimpleNamespace(
        cell=DEFAULT_CELL, diameter_um=D, t=t, t_error=bars, resonances=narrow
    )


def cut(**about):
    return stretch.stretch(
        library(**about), least_transmission=0.7, least_half_width_um=0.004
    )


def test_a_clean_library_is_one_stretch_with_its_phases_unwrapped_along_every_axis():
    made = cut()
    assert made.diameter_um == pytest.approx(D)
    assert made.notes == ()
    slope = 20 * (D - 0.1) + 2.01  # the mean of both polarisations
    offsets = made.phase - slope
    assert np.ptp(offsets, axis=-1).max() < 1e-9
    # angles of 4, 3.7 and 5.7 rad are beyond half a turn: neighbours are followed
    # across the seam
    assert offsets[:, 1, 0] - offsets[:, 0, 0] == pytest.approx([2.0] * 2)
    assert offsets[1, :, 0] - offsets[0, :, 0] == pytest.approx([1.7] * 2)
    assert made.level == pytest.approx(np.full((2, 2, 61), 0.9 * math.cos(0.01)))
    assert made.polarization_spread == pytest.approx(0.9 * math.sin(0.01))


def test_dark_diameters_of_any_light_cut_the_stretch():
    level = np.ones(61)
    level[21] = 0.77  # 0.693 of amplitude
    level[30] = 0.79  # 0.711
    made = cut(level=level)
    assert made.diameter_um == pytest.approx(D[22:])
    assert made.notes == (f"cut at {D[22]:.4f} um: |t| falls to 0.69, below 0.7",)
    level[:] = 1
    level[0] = level[60] = 0.7
    ends = cut(level=level)
    assert ends.diameter_um == pytest.approx(D[1:60])
    assert [note[:14] for note in ends.notes] == ["cut at 0.1050 ", "cut at 0.3950 "]


def test_a_falling_phase_takes_both_ends_of_the_fall():
    phase = np.zeros(61)
    phase[40:] = -0.12  # 0.1 rad a step: falls from 39 to 40
    made = cut(phase=phase)
    assert made.diameter_um == pytest.approx(D[:39])
    assert made.notes[0].startswith(f"cut at {D[38]:.4f} um: the phase falls")


@pytest.mark.parametrize(
    ("centre", "width", "gone"),
    [
        (0.2512, 0.0039, range(29, 32)),
        (0.2512, 0.0041, ()),
        (0.2512, 0.00001, (30, 31)),
        (0.41, 0.001, ()),
    ],
)
def test_narrow_resonances_are_cut_with_two_half_widths(centre, width, gone):
    """0.2512 lies between entries 30 and 31; 2 x 3.9 nm reach 0.2434 to 0.2590: entries
    29 to 31; 0.41 is outside.
    """
    bad = stretch._faults(library(poles=[(0, math.radians(4), 0.85, centre, width)]), D, library().t,
                          np.unwrap(np.angle(library().t), axis=-1), 0.7, 0.004)[3:]  # fmt: skip
    found = np.flatnonzero(np.any([mask for mask, _ in bad], axis=0)) if bad else []
    assert list(found) == list(gone)
    if bad:
        assert f"half-width {1e3 * width:.2g} nm (0.85 um, 4 deg)" in bad[0][1]


def test_the_stretch_of_most_phase_wins_over_the_longer_one_and_short_ones_are_none():
    level, phase = np.ones(61), np.zeros(61)
    level[35] = 0.5
    phase[36:] = np.arange(25) * 0.3  # 0.4 rad a step beyond: 24 x 0.4 against 34 x 0.1
    many = library(level=level)
    many.t = many.t * np.exp(1j * phase)
    made = stretch.stretch(many, least_transmission=0.7, least_half_width_um=0.004)
    assert made.diameter_um == pytest.approx(D[36:])
    level[:] = np.where(np.arange(61) % 12 == 0, 0.5, 1)  # 11 in a row
    with pytest.raises(DomainError, match=r"no 12 diameters .*\|t\| falls to 0\.45"):
        cut(level=level)
    level[:] = np.where(np.arange(61) % 13 == 0, 0.5, 1)  # 12 in a row
    assert len(cut(level=level).diameter_um) == 12
    level[:] = np.where(np.arange(61) % 12 == 0, 0.5, 1)
    level[24] = 1.0
    assert cut(level=level).diameter_um == pytest.approx(D[13:36])
    within = stretch.stretch(
        library(),
        least_transmission=0.7,
        least_half_width_um=0.004,
        within_um=(0.12, 0.2),
    )
    assert within.diameter_um == pytest.approx(D[4:21])
