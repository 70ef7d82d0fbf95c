"""The job sheet and the order of fields by hand: places in um, charges in uC, hours at
1 nA.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.files import handover
from layout.mask import FieldPlan, Figure
from layout.process.process import Die, Exposure, Layers, Process

SPLIT = FieldPlan(
    np.array([-1, 3, 7, 12]),
    np.array([0, 4, 9, 11]),
    (12, 11),
    0.4,
    "floating",
    np.array([[5, 0, 7], [11, 13, 0], [2, 3, 4]]),
    6,
    0.0234,
    0.3,
)
PROCESS = Process(
    name="ours",
    layers=Layers(aperture=(22, 1)),
    exposure=Exposure(base_uC_cm2=270.0),
    die=Die(vernier_pitch_um=7.5, vernier_step_nm=60.0),
)


def test_fields_go_from_the_lower_left_and_every_other_row_backwards():
    """Borders at x = -2.2, -0.6, 1.4, 2.2 and y = -2.1, -0.9, 0.3, 1.8; two fields are
    empty.
    """
    want = [
        (1, -1.4, -1.5, 1.6, 1.2, 5),
        (2, 1.8, -1.5, 0.8, 1.2, 7),
        (3, 0.4, -0.3, 2.0, 1.2, 13),
        (4, -1.4, -0.3, 1.6, 1.2, 11),
        (5, -1.4, 1.05, 1.6, 1.5, 2),
        (6, 0.4, 1.05, 2.0, 1.5, 3),
        (7, 1.8, 1.05, 0.8, 1.5, 4),
    ]
    steps = handover.sequence(SPLIT)
    assert [(s.sequence, s.pillars) for s in steps] == [
        (row[0], row[5]) for row in want
    ]
    got = [[s.x_um, s.y_um, s.width_um, s.height_um] for s in steps]
    assert np.array(got) == pytest.approx(
        np.array([row[1:5] for row in want]), abs=1e-12
    )


def test_the_table_of_fields_has_tenths_of_a_nanometre(tmp_path):
    handover.write_fields(SPLIT, tmp_path / "f.csv")
    lines = (tmp_path / "f.csv").read_text().splitlines()
    assert lines[0] == "sequence,x_um,y_um,width_um,height_um,pillars"
    assert lines[4] == "4,-1.4000,-0.3000,1.6000,1.2000,11"
    assert len(lines) == 8


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def plan(figures=(), standing=None):
    """Units of 2 nm. Three pillars of 0.12 um2 in two pieces, five of 0.06 and two of
    0.2; figures beside them.
    """
    classes = [
        SimpleNamespace(
            polygons=[box(0, 0, 200, 100), box(0, 100, 100, 200)], layer=(1, 0)
        ),
        SimpleNamespace(polygons=[box(-50, -75, 50, 75)], layer=(1, 1)),
        SimpleNamespace(polygons=[box(0, 0, 500, 100)], layer=(1, 0)),
    ]
    doses = {(1, 0): 1.25, (1, 1): 0.8, (22, 0): 1.5, (3, 0): 1.1}
    return SimpleNamespace(
        name="TOP",
        unit_nm=2.0,
        doses=doses,
        classes=classes,
        counts=lambda: np.array([40, 3, 5, 2]),
        figures=figures,
        standing=standing,
        layer_names={(1, 0): "thin", (22, 0): "opening"},
    )


LARGE = Figure("APERTURE", {(22, 0): (box(0, 0, 60_000, 50_000),)})  # 120 x 100 um
TIMES = Figure(
    "MARKS",
    {
        (3, 0): (box(0, 0, 5000, 500), box(2000, 500, 2400, 3500)),
        (3, 1): (box(0, 9000, 700, 9900),),
    },
)


def test_charges_are_doses_times_areas_in_square_centimetres():
    """Base 270 uC/cm2: (0.76 x 1.25 + 0.3 x 0.8 + (10 + 4.8) x 1.1) um2 and 12 000 um2
    x 1.5.
    """
    areas = handover.areas_um2(plan((LARGE, TIMES)))
    found = handover.charge_uC(areas, plan((LARGE, TIMES)).doses, PROCESS)
    assert found["pillars"] == pytest.approx(
        (0.76 * 1.25 + 0.3 * 0.8 + 14.8 * 1.1) * 270e-8, rel=1e-12
    )
    assert found["aperture"] == pytest.approx(12_000 * 1.5 * 270e-8, rel=1e-12)
    areas = handover.areas_um2(plan((LARGE, TIMES)))
    assert areas == pytest.approx(
        {(1, 0): 0.76, (1, 1): 0.3, (22, 0): 12_000, (3, 0): 14.8, (3, 1): 2.52},
        rel=1e-12,
    )


def test_marks_are_whole_shapes_by_their_middles_from_the_lower_left_on():
    """Two boxes that touch are one mark of 10 x 7 um; a box with a hole is one; rows by
    whole um.
    """
    ring = (
        box(20_000, 0, 21_000, 100),
        box(20_000, 100, 20_100, 1000),
        box(20_900, 100, 21_000, 1000),
    )
    ring = (*ring, box(20_000, 1000, 21_000, 1300))
    row = (
        box(30_000, 200, 31_000, 700),
        box(-4000, 200, -3000, 1200),
        box(25_000, 200, 26_000, 900),
    )
    marks = Figure("MARKS", {**TIMES.polygons, (5, 0): (*row, *ring)})
    label = Figure("LABEL", {(4, 0): (box(-900, -900, -800, -700),)})
    first = [
        (-7.0, 1.4, 2.0, 2.0),
        (41.0, 1.3, 2.0, 2.6),
        (51.0, 1.1, 2.0, 1.4),
        (61.0, 0.9, 2.0, 1.0),
    ]
    want = [*first, (5.0, 3.5, 10.0, 7.0), (0.7, 18.9, 1.4, 1.8)]
    assert np.array(handover.marks_um(plan((marks, label)))) == pytest.approx(
        np.array(want), abs=1e-12
    )
    other = plan((label,), standing=plan((TIMES,)))  # of a negative tone: of what stays
    assert np.array(handover.marks_um(other)) == pytest.approx(
        np.array(want[4:]), abs=1e-12
    )
    assert handover.marks_um(plan((label,))) == []


def test_the_sheet_says_charges_hours_and_fields_in_their_units():
    """0.0486 uC at 1 nA take 48.6 s."""
    verniers = Figure("VERNIERS", {(3, 0): (box(0, 0, 9, 9),)})
    text = handover.job_sheet(
        plan((LARGE, TIMES, verniers)),
        PROCESS,
        SPLIT,
        {"b.oas": 7, "a.gds": 1_234_567},
        "ok",
    )
    lines = text.splitlines()
    assert lines[0] == "JOB SHEET  mask TOP  process 'ours'  tone positive"
    assert lines[4].split() == ["a.gds", "1,234,567", "bytes"]
    assert lines[5].split() == ["b.oas", "7", "bytes"]
    assert "top cell TOP, 2 nm; coordinates in um below" in text
    assert "base dose 270 uC/cm2" in text
    assert "Step aperture: charge 0.0486 uC (0.0135 h at 1 nA" in text
    assert "Step pillars: charge 4.717e-05 uC (1.31e-05 h at 1 nA" in text
    doses = [
        line.split()
        for line in lines
        if line.startswith("  ") and "/" in line and "." in line
    ]
    assert ["1/0", "1.250000", "337.500", "0.8", "thin"] in doses
    assert ["22/0", "1.500000", "405.000", "12,000.0", "opening"] in doses
    assert ["1/1", "0.800000", "216.000", "0.3"] in doses
    assert "Write fields: 7 (floating), in the order of fields.csv" in text
    assert "at most 2.000 x 1.500 um" in text
    assert "least distance 23.4 nm" in text
    assert "  (5.000, 3.500); 10.000 x 7.000" in text
    assert "pillars 7.5 um, aperture 60 nm longer from bar to bar" in text
    assert "n x 60 nm to the right of the pillars" in text
    assert "erniers" not in handover.job_sheet(plan((LARGE,)), PROCESS, SPLIT, {}, "ok")


@pytest.mark.parametrize(("base", "hours"), [(268.99, "0.0134"), (269.01, "0.0135")])
def test_hours_at_a_nanoampere_are_charges_by_3600_s(base, hours):
    """18 000 um2 of dose 1: 1.8e-4 uC for each uC/cm2, 0.18 s."""
    process = Process(
        layers=Layers(aperture=(22, 1)), exposure=Exposure(base_uC_cm2=base)
    )
    assert f"({hours} h at 1 nA" in handover.job_sheet(
        plan((LARGE,)), process, SPLIT, {}, "ok"
    )
