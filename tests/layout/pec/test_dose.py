"""Proximity correction against closed forms for one pillar and a wide lattice, and
against the exact direct sum.
"""

import dataclasses

import numpy as np
import pytest

import layout
from layout.pec.psf import PointExposure, point_exposure, rim_of_own_disc
from layout.process.process import ExposureSettings, Process
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap
from tests.referees.rims import at_edges

PITCH = 0.4


POINT = {"alpha_um": 0.01, "beta_um": 31.0, "eta": 0.6}  # a 100 kV beam on fused silica


def exposure(**options):
    return ExposureSettings(**(({} if "csv" in options else POINT) | options))


def corrected(written, settings):
    """(y, x) dose of each pillar, NaN where there is none, and the plan."""
    plan = layout.plan(written, Process(), furnished=False)
    made = layout.correct(plan, settings)
    table = np.array([np.nan, *(one.dose for one in made.classes)])
    return table[made.lattices[0].whole()[::-1]], made


def ragged_patch(n=57, seed=1):
    """A round patch of mixed diameters with a hole and a bay: no symmetry."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    diameter = 2e-3 * rng.integers(50, 150, (n, n))
    present = (
        (np.hypot(x, y) < n / 2)
        & (np.hypot(x - 9, y + 5) > 5)
        & ~((x > 15) & (abs(y - 3) < 4))
    )
    return DiameterMap(np.where(present, diameter, 0), PITCH)


def exact_edges(written, dose, point, count=12):
    rows, columns = np.nonzero(written.diameter_um)
    centres = np.stack([columns, rows], -1) * written.pitch_um
    which = np.unique(np.linspace(0, len(rows) - 1, count).astype(int))
    return at_edges(
        centres,
        written.diameter_um[rows, columns],
        dose[rows, columns],
        point,
        which=which,
        rim_points=12,
    )


@pytest.mark.parametrize(
    ("size_um", "pitch_um", "alpha_um", "beta_um"),
    [(0.2, PITCH, 0.02, 10.0), (6.7, 6.8, 0.9, 60.0)],
)
def test_one_pillar_gets_the_dose_that_its_own_edge_needs(
    size_um, pitch_um, alpha_um, beta_um
):
    """That of a wide area, less what the rim bends."""
    one = np.zeros((5, 4))
    one[2, 1] = size_um
    settings = exposure(alpha_um=alpha_um, beta_um=beta_um, eta=0.5)
    dose, _ = corrected(DiameterMap(one, pitch_um), settings)
    rims = [rim_of_own_disc(size_um, width) for width in (alpha_um, beta_um)]
    assert dose[2, 1] == pytest.approx(0.75 / (rims[0] + 0.5 * rims[1]), rel=1e-4)
    assert np.isfinite(dose).sum() == 1


def test_deep_inside_equal_pillars_the_background_is_their_density():
    settings = exposure(
        alpha_um=0.01, beta_um=3.0, eta=0.6, tolerance=1e-3, maximum_classes=255
    )
    dose, _ = corrected(DiameterMap(np.full((101, 101), 0.24), PITCH), settings)
    density = np.pi / 4 * 0.24**2 / PITCH**2
    own = rim_of_own_disc(0.24, 0.01) / 1.6
    # the edge is 6.7 beta away; the lattice sum has no ripple
    want = 0.5 / (own + 0.6 / 1.6 * density)
    assert dose[50, 50] == pytest.approx(float(want), rel=1.2e-3)  # half a class


@pytest.mark.parametrize(
    ("alpha_um", "beta_um", "third"),
    [
        (0.01, 1.5, {}),
        (0.04, 1.5, {}),
        (0.01, 6.0, {}),
        (0.04, 6.0, {"gamma_um": 0.8, "nu": 0.3}),
    ],
)
def test_corrected_edges_are_even_by_the_exact_sum(alpha_um, beta_um, third):
    """Sums over sites alone, over nodes alone, and over both."""
    written = ragged_patch()
    settings = exposure(
        alpha_um=alpha_um, beta_um=beta_um, eta=0.7, tolerance=0.01, **third
    )
    dose, _ = corrected(written, settings)
    edges = exact_edges(written, dose, point_exposure(settings))
    # the tolerance, and Gaussians of matched second moment for near neighbours
    assert abs(edges / 0.5 - 1).max() < 0.01 + 1e-3


def test_a_measured_function_is_corrected_like_the_formula_it_was_made_from(tmp_path):
    written = ragged_patch()
    truth = PointExposure(np.array([0.012, 0.3, 4.0]), np.array([0.6, 0.1, 0.3]))
    radius = np.geomspace(0.003, 16, 140)
    table = tmp_path / "psf.csv"
    rows = zip(radius.tolist(), (3.3 * truth.density(radius)).tolist(), strict=True)
    table.write_text(
        "radius_um,energy\n" + "\n".join(f"{r},{v}" for r, v in rows), encoding="utf-8"
    )
    dose, _ = corrected(written, exposure(csv=table, tolerance=0.01))
    edges = exact_edges(written, dose, truth)
    spread = edges / edges.mean() - 1
    # dose classes, and 1 % of energy that the fit puts elsewhere
    assert abs(spread).max() < 0.01 + 0.015


def test_fewer_doses_than_needed_are_used_where_the_writer_holds_no_more():
    written = ragged_patch()
    wanted = exposure(alpha_um=0.01, beta_um=6.0, tolerance=0.004)
    few = dataclasses.replace(wanted, maximum_classes=4)
    numbers, errors = [], []
    for settings in (wanted, few):
        dose, _ = corrected(written, settings)
        numbers.append(len(np.unique(dose[np.isfinite(dose)])))
        edges = exact_edges(written, dose, point_exposure(settings), count=60)
        errors.append(abs(edges / 0.5 - 1).max())
    assert numbers[0] > 4 == numbers[1]
    assert errors[0] < 0.004 + 1e-3 < errors[1]


def test_every_pillar_has_a_dose_and_no_other_site():
    written = ragged_patch()
    dose, _ = corrected(written, exposure())
    assert (np.isfinite(dose) == (written.diameter_um > 0)).all()


def test_what_cannot_be_corrected_is_refused():
    written = ragged_patch(21)
    negative = layout.plan(written, Process(tone="negative"), furnished=False)
    with pytest.raises(ProcessError, match="negative"):
        layout.correct(negative, exposure())
    with pytest.raises(ProcessError, match="too wide"):
        corrected(written, exposure(alpha_um=0.4))
