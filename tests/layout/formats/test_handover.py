"""Write fields in their order, areas, charges and marks of the job sheet: by counting,
and by both tones together.
"""

import csv
import dataclasses

import numpy as np
import pytest

import layout
from layout.formats import job_files
from layout.formats.library import library_of
from layout.mask import fields
from layout.process.process import DieSettings, ExposureSettings, Process, WriteField
from metalens.lens.record import DiameterMap

PROCESS = Process(
    exposure=ExposureSettings(base_uC_cm2=370.0), write_field=WriteField(7.3)
)


def lens_map():
    """Asymmetric, with a hole that leaves one field empty."""
    d = np.random.default_rng(5).uniform(0.11, 0.29, (61, 47))
    d[20:45, 10:40] = 0
    return DiameterMap(d, 0.4)


@pytest.fixture(scope="module")
def made():
    return layout.plan(lens_map(), PROCESS), fields.split_write_fields(
        lens_map(), PROCESS
    )


def test_fields_go_row_by_row_and_back_and_hold_every_pillar_once(made, tmp_path):
    source, split = lens_map(), made[1]
    steps = job_files.field_sequence(split)
    assert len(steps) == split.used < split.pillars.size
    rows = [[s for s in steps if s.y_um == y] for y in sorted({s.y_um for s in steps})]
    assert [s for row in rows for s in row] == steps
    for n, row in enumerate(rows):
        x = [s.x_um for s in row]
        assert x == sorted(x, reverse=bool(n % 2))
    i, j = np.nonzero(source.diameter_um)
    x, y = source.x_um[j], source.y_um[i]
    for s in steps:
        inside = (abs(x - s.x_um) < s.width_um / 2) & (
            abs(y - s.y_um) < s.height_um / 2
        )
        assert inside.sum() == s.pillars > 0
    assert sum(s.pillars for s in steps) == len(i)
    job_files.write_fields(steps, tmp_path / "fields.csv")
    with open(tmp_path / "fields.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [int(line["pillars"]) for line in lines] == [s.pillars for s in steps]
    assert float(lines[3]["x_um"]) == pytest.approx(steps[3].x_um, abs=1e-4)


def test_areas_of_both_tones_are_the_die():
    total = []
    for tone in ("positive", "negative"):
        plan = layout.plan(lens_map(), dataclasses.replace(PROCESS, tone=tone))
        areas = library_of(plan).areas_um2()
        total.append(
            sum(area for layer, area in areas.items() if layer[0] in (1, 3, 4, 5, 6))
        )
        die = areas[10, 0]
    assert sum(total) == pytest.approx(die, rel=1e-12)
    lens = (
        float(
            (
                np.pi
                / 4
                * PROCESS.written_diameter_nm(lens_map().diameter_um * 1e3) ** 2
            ).sum()
        )
        * 1e-6
    )
    positive = library_of(layout.plan(lens_map(), PROCESS, furnished=False)).areas_um2()
    # steps of 2 nm average out, polygons to 1e-3
    assert positive[1, 0] == pytest.approx(lens, rel=2e-3)


def test_the_charge_is_dose_times_area(made):
    plan = made[0]
    areas = library_of(plan).areas_um2()
    want = (
        sum(areas[layer] * dose for layer, dose in plan.doses.items() if layer[0] != 2)
        * 1e-8
        * 370.0
    )
    found = job_files.charge_uC(areas, plan.doses, PROCESS)
    assert found["pillars"] == pytest.approx(want, rel=1e-12)
    assert found["aperture"] == pytest.approx(areas[2, 0] * 1e-8 * 370.0, rel=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"tone": "negative"},
        {"exposure": ExposureSettings(alpha_um=0.01, beta_um=8, eta=0.7)},
    ],
)
def test_marks_stand_in_the_corners_whatever_the_tone_and_the_doses(change):
    process = dataclasses.replace(
        PROCESS, die=DieSettings(mark_um=80.0, mark_width_um=4.0), **change
    )
    plan = layout.plan(lens_map(), process)
    if process.exposure.corrected:
        plan = layout.correct(plan, process.exposure)
    marks = job_files.marks_um(plan)
    crosses = [m for m in marks if m[2:] == (80.0, 80.0)]
    assert len(marks) == 9  # four crosses, coarse and fine, and the F
    assert len(crosses) == 4
    assert {(np.sign(x), np.sign(y)) for x, y, *_ in crosses} == {
        (-1, -1),
        (1, -1),
        (-1, 1),
        (1, 1),
    }
    half = (
        max(
            abs(p).max()
            for f in plan.figures
            if f.name == "OUTLINE"
            for p in f.polygons[10, 0]
        )
        * 1e-3
    )
    assert all(
        max(abs(x), abs(y)) == pytest.approx(half - 50 - 10 - 40, abs=0.01)
        for x, y, *_ in crosses
    )


def test_a_dose_table_that_an_editor_saved_is_read(tmp_path):
    path = tmp_path / "doses.csv"
    path.write_text(
        "layer,datatype,relative_dose\n7,3,1.375\n2,0,0.9\n", encoding="utf-8-sig"
    )
    assert job_files.read_dose_table(path) == {(7, 3): 1.375, (2, 0): 0.9}
