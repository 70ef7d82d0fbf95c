"""The error budget: entries of known changes, files, and refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest

from codesign.budget import links as budget
from codesign.budget import page as budget_page
from codesign.budget.entry import MEASURED, TOTAL, BudgetEntry, quadrature_total
from codesign.budget.prepared import BudgetInputs, prepare_device
from codesign.commands import budget as command_budget
from codesign.optics.numerics import (
    ImageWindow,
    OpticsNumerics,
    TabulatedLens,
    pixel_kernels,
    psf_difference,
)
from metalens import design
from metalens.cell.record import Cell, Index
from metalens.cell.shapes import Rectangle
from metalens.core.errors import ConfigError, LensError, StoreError
from metalens.design.profiles import Focus
from metalens.fabrication import Printed, Spread, of_process
from metalens.pillars.proxy import Proxy

CELL = Cell(pitch_um=0.30, height_um=0.7, pillar=Index(3.6))
FOCUS = Focus(0.85, 2000.0, 20_000.0)


@pytest.fixture(scope="module")
def lens():
    coefficients = np.polynomial.Chebyshev.interpolate(
        lambda d: 55 * d, 2, domain=[0.08, 0.21]
    ).coef[None]
    proxy = Proxy(coefficients, np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0)
    wanted = design.phase_of(None, FOCUS, radius_um=40.0)
    return design.make(
        wanted, FOCUS, aperture_um=80.0, cell=CELL, proxy=proxy, profile="hyperbolic"
    )[0]


def test_the_table_gives_the_phase_of_every_pillar(lens):
    aperture = TabulatedLens(lens)
    phase, level = aperture.maps(aperture.designed())
    built = lens.diameters.diameter_um > 0
    turn = np.angle(np.exp(1j * (phase.numpy() - lens.phase_rad())))[built]
    assert (
        np.abs(turn).max() < 55 * aperture.step_um
    )  # half a place of the table, in rad, and float32
    assert (level.numpy()[~built] == 0).all()
    assert aperture.share.sum() == pytest.approx(1)


def test_a_bias_moves_every_pillar_along_its_curve(lens):
    aperture = TabulatedLens(lens)
    built = lens.diameters.diameter_um > 0
    middle = (
        built & (lens.diameters.diameter_um > 0.09) & (lens.diameters.diameter_um < 0.2)
    )
    still, moved = (
        aperture.maps(aperture.designed(), bias_um=b)[0].numpy() for b in (None, 0.004)
    )
    change = np.angle(np.exp(1j * (moved - still)))[middle]
    assert change == pytest.approx(55 * 0.004, abs=2 * 55 * aperture.step_um)


def test_the_same_optics_do_not_differ_and_finer_ones_agree(lens):
    aperture, window = TabulatedLens(lens), ImageWindow(15e3, 30e3, 18.0)
    maps = aperture.maps(aperture.designed())
    found = [
        pixel_kernels(lens, maps, OpticsNumerics(n, 1, 1e-4, 1e-4), window)
        for n in (4, 8, 16)
    ]
    assert psf_difference(found[2], found[2], window) == 0
    coarse, fine = (psf_difference(f, found[2], window) for f in found[:2])
    assert (
        fine < coarse / 2
    )  # linear interpolation between depths: a quarter for twice the depths


def test_rounding_to_nothing_changes_nothing(lens):
    aperture = TabulatedLens(lens)
    table = aperture.designed()
    fine, coarse = (
        np.abs(aperture.rounded(table, s) - table).max() for s in (1e-6, 5e-3)
    )
    assert fine < 1e-3
    assert 0.05 < coarse < 55 * 2.6e-3  # half of 5 nm at 55 rad a um


def test_the_total_is_the_root_of_the_squares_of_what_counts():
    rows = [
        BudgetEntry("a", 3.0, math.nan, 3e-3, ""),
        BudgetEntry("b", math.nan, 1.0, 4e-3, ""),
        BudgetEntry("known", 7.0, 2.0, 9e-3, "", counted=False),
        BudgetEntry("reader", math.nan, math.nan, math.nan, ""),
    ]
    found = quadrature_total(rows)
    assert (found.phase_rad, found.psf, found.gaze_rad) == pytest.approx(
        (3.0, 1.0, 5e-3)
    )
    assert found.method.endswith("without reader")


def test_files_come_back_as_they_were(tmp_path):
    rows = [
        BudgetEntry("mask grid", 0.1, 0.2, 1e-4, "rounded", counted=False),
        BudgetEntry("sensor noise", math.nan, math.nan, 1e-3, "bound"),
    ]
    command_budget.save_budget(
        tmp_path / "b.h5", rows, command_budget.store.Provenance(config="x = 1\n")
    )
    assert [str(r) for r in command_budget.load_budget(tmp_path / "b.h5")] == [
        str(r) for r in rows
    ]
    with pytest.raises(StoreError):
        command_budget.load_budget(tmp_path / "absent.h5")
    assert "mask grid" in command_budget.budget_text(rows)
    budget_page.write_budget_page(
        tmp_path / "b.html", [*rows, BudgetEntry("all links", 0.1, 0.2, 1e-3, "sum")]
    )
    assert "sensor noise" in (tmp_path / "b.html").read_text(encoding="utf-8")


def test_a_budget_of_pillars_that_answer_x_and_y_apart_says_of_which_light_it_is(lens):
    assert command_budget.of_light(lens) == ""
    rectangles = replace(
        lens, cell=Cell(lens.cell.pitch_um, lens.cell.height_um, shape=Rectangle(0.6))
    )
    told = command_budget.of_light(rectangles)
    assert (
        told
        == "of light along x: these pillars (rectangle 1:0.6 on a square lattice) answer x and y apart"
    )


def test_spread_and_run_are_read_or_refused(tmp_path):
    (tmp_path / "p.toml").write_text(
        "[spread]\nbias_nm = 2.0\n[rules]\ndiameter_step_nm = 5\n"
    )
    assert of_process(tmp_path / "p.toml") == Printed(
        spread=Spread(bias_nm=2.0), diameter_step_nm=5.0
    )
    (tmp_path / "q.toml").write_text("[spread]\nbais_nm = 2.0\n")
    with pytest.raises(ConfigError, match="bias_nm"):
        of_process(tmp_path / "q.toml")


def test_the_sum_stands_beside_what_was_measured():
    rows = [
        BudgetEntry(MEASURED, math.nan, math.nan, 4e-3, "", counted=False),
        BudgetEntry(TOTAL, 0.0, 0.0, 5e-3, ""),
    ]
    assert command_budget.budget_summary(rows) == pytest.approx(
        {
            "gaze_error_deg": math.degrees(5e-3),
            "measured_deg": math.degrees(4e-3),
            "closure": 1.25,
        }
    )
    assert set(command_budget.budget_summary(rows[1:])) == {"gaze_error_deg"}


def test_a_budget_of_few_depths_is_refused():
    with pytest.raises(LensError, match="depths"):
        OpticsNumerics(depth_count=1)


@pytest.mark.slow
def test_the_whole_budget_of_a_small_lens(lens):
    given = BudgetInputs(OpticsNumerics(12, 1, 1e-3, 1e-2), mask=Printed(), draws=2)
    rows = list(budget.budget_entries(prepare_device(lens, given)))
    found = {r.link: r for r in rows}
    assert set(found) == {
        "subject and calibration", "fixation", "reader", "sensor noise", "field", "radiometry", "spectrum", "glass",
        "polarisation", "pillar solver and proxy", "neighbours", "mask grid", "process spread", "propagation",
        "depth sampling", "image kernels", "image tolerance", TOTAL,
    }  # fmt: skip
    assert math.isnan(found.pop("reader").gaze_rad)
    assert all(r.gaze_rad >= 0 and r.method for r in found.values())
    assert not found["field"].counted
    assert found["neighbours"].method.startswith(
        "rows of 6, 5 unlike pillars"
    )  # turned by more than this lens does
    # 2 nm of rounding: uniform within 1 nm, at 55 rad a um
    assert found["mask grid"].phase_rad == pytest.approx(55e-3 / math.sqrt(3), rel=0.2)
