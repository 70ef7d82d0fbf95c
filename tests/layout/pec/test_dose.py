"""Proximity correction against closed forms for one pillar and a wide lattice, and
against the exact direct sum.
"""

import dataclasses

import numpy as np
import pytest

from layout.pec import correct as dose
from layout.pec.bodies import NONE
from layout.pec.psf import PointExposure, point_exposure, rim_of_own_disc
from layout.process.process import ExposureSettings, Process
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap
from tests.referees.rims import at_edges

PITCH = 0.4


POINT = {"alpha_um": 0.01, "beta_um": 31.0, "eta": 0.6}  # a 100 kV beam on fused silica


def process(**options):
    return Process(
        exposure=ExposureSettings(**(({} if "csv" in options else POINT) | options))
    )


def ragged_patch(n=57, seed=1):
    """A round patch of mixed diameters with a hole and a bay: no symmetry."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    diameter = np.round(rng.uniform(0.1, 0.3, (n, n)), 3)
    present = (
        (np.hypot(x, y) < n / 2)
        & (np.hypot(x - 9, y + 5) > 5)
        & ~((x > 15) & (abs(y - 3) < 4))
    )
    return DiameterMap(np.where(present, diameter, 0), PITCH)


def exact_edges(written, result, point, count=12):
    rows, columns = np.nonzero(written.diameter_um)
    centres = np.stack([columns, rows], -1) * written.pitch_um
    which = np.unique(np.linspace(0, len(rows) - 1, count).astype(int))
    given = np.append(result.factors, np.zeros(256 - len(result.factors)))[
        result.classes[rows, columns]
    ]
    return at_edges(
        centres,
        written.diameter_um[rows, columns],
        given,
        point,
        which=which,
        rim_points=12,
    )


def test_one_pillar_gets_the_dose_that_its_own_edge_needs():
    one = np.zeros((5, 5))
    one[2, 2] = 0.2
    settings = process(alpha_um=0.02, beta_um=10.0, eta=0.5)
    result = dose.correct(DiameterMap(one, PITCH), settings)
    own = (rim_of_own_disc(0.2, 0.02) + 0.5 * rim_of_own_disc(0.2, 10.0)) / 1.5
    assert result.factors == pytest.approx([0.5 / own], rel=1e-4)
    assert result.needed == 1
    assert (result.classes != NONE).sum() == 1


def test_a_pillar_wider_than_six_um_keeps_its_diameter():
    """67 000 entries of 0.1 nm: its own edge is that of a wide area, less what the rim
    bends.
    """
    one = np.zeros((3, 4))
    one[1, 2] = 6.7
    result = dose.correct(
        DiameterMap(one, 6.8), process(alpha_um=0.9, beta_um=60.0, eta=0.5)
    )
    own = (rim_of_own_disc(6.7, 0.9) + 0.5 * rim_of_own_disc(6.7, 60.0)) / 1.5
    assert result.factors == pytest.approx([0.5 / own], rel=1e-4)


def test_deep_inside_equal_pillars_the_background_is_their_density():
    settings = process(
        alpha_um=0.01, beta_um=3.0, eta=0.6, tolerance=1e-3, maximum_classes=255
    )
    result = dose.correct(DiameterMap(np.full((101, 101), 0.24), PITCH), settings)
    density = np.pi / 4 * 0.24**2 / PITCH**2
    own = rim_of_own_disc(0.24, 0.01) / 1.6
    want = 0.5 / (
        own + 0.6 / 1.6 * density
    )  # the edge is 6.7 beta away; the lattice sum has no ripple
    assert result.factors[result.classes[50, 50]] == pytest.approx(
        float(want), rel=1.2e-3
    )  # half a class


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
    settings = process(
        alpha_um=alpha_um, beta_um=beta_um, eta=0.7, tolerance=0.01, **third
    )
    result = dose.correct(written, settings)
    edges = exact_edges(written, result, result.point)
    assert abs(edges / 0.5 - 1).max() < 0.01 + result.error + 1e-4
    assert result.met
    assert result.after.worst <= 0.01
    assert result.before.worst > 10 * result.after.rms


def test_the_error_it_reports_is_the_distance_from_the_exact_sum():
    written = ragged_patch()
    settings = process(
        alpha_um=0.01, beta_um=0.35, eta=0.7
    )  # a background as fine as the lattice: the hard case
    result = dose.correct(written, settings, samples=24)
    edges = exact_edges(written, result, result.point, count=24)
    assert abs(edges / 0.5 - 1).max() <= result.after.worst + result.error + 1e-4
    assert 1e-5 < result.error < 0.05


def test_a_measured_function_is_corrected_like_the_formula_it_was_made_from(tmp_path):
    written = ragged_patch()
    truth = PointExposure(np.array([0.012, 0.3, 4.0]), np.array([0.6, 0.1, 0.3]))
    radius = np.geomspace(0.003, 16, 140)
    table = tmp_path / "psf.csv"
    rows = zip(radius.tolist(), (3.3 * truth.density(radius)).tolist(), strict=True)
    table.write_text(
        "radius_um,energy\n" + "\n".join(f"{r},{v}" for r, v in rows), encoding="utf-8"
    )
    result = dose.correct(written, process(csv=table, tolerance=0.01))
    edges = exact_edges(written, result, truth)
    spread = edges / edges.mean() - 1
    assert (
        abs(spread).max() < 0.01 + 0.015
    )  # dose classes, and 1 % of energy that the fit puts elsewhere
    assert len(result.point.widths_um) > 3


def test_fewer_classes_than_needed_are_used_and_said():
    written = ragged_patch()
    wanted = process(alpha_um=0.01, beta_um=6.0, tolerance=0.004)
    full, few = (
        dose.correct(written, wanted),
        dose.correct(
            written,
            dataclasses.replace(
                wanted, exposure=dataclasses.replace(wanted.exposure, maximum_classes=4)
            ),
        ),
    )
    assert full.met
    assert not few.met
    assert full.needed == few.needed > 4 == len(few.factors)
    assert full.after.worst < 0.004 < few.after.worst < few.before.worst


def test_every_pillar_has_a_class_and_no_other_site():
    written = ragged_patch()
    result = dose.correct(written, process())
    assert ((result.classes != NONE) == (written.diameter_um > 0)).all()
    assert result.classes[result.classes != NONE].max() < len(result.factors)
    assert result.dose_uC_cm2 == pytest.approx(300 * result.factors)


def test_the_uniformity_with_one_dose_is_that_of_the_exact_sum():
    written = ragged_patch(25)
    settings = process(alpha_um=0.01, beta_um=5.0, eta=0.7)
    result = dose.correct(written, settings)
    rows, columns = np.nonzero(written.diameter_um)
    centres, diameter = (
        np.stack([columns, rows], -1) * PITCH,
        written.diameter_um[rows, columns],
    )
    point = point_exposure(settings.exposure)
    edges = at_edges(
        centres,
        diameter,
        np.ones(len(rows)),
        point,
        which=np.arange(len(rows)),
        rim_points=8,
    )
    mean = np.average(edges, weights=diameter**2)
    assert result.before.worst == pytest.approx(abs(edges / mean - 1).max(), rel=2e-3)
    assert result.before.rms == pytest.approx(
        np.sqrt(np.mean((edges / mean - 1) ** 2)), rel=2e-3
    )
    given = result.factors[result.classes[rows, columns]]
    edges = at_edges(
        centres, diameter, given, point, which=np.arange(len(rows)), rim_points=8
    )
    left = np.sqrt(np.mean((edges / 0.5 - 1) ** 2))
    assert result.after.rms == pytest.approx(
        left, rel=0.1
    )  # what the background moves by with the classes is added


def test_refusals():
    written = ragged_patch(21)
    with pytest.raises(ProcessError, match="negative"):
        dose.correct(written, Process(tone="negative"))
    with pytest.raises(ProcessError, match="too wide"):
        dose.correct(written, process(alpha_um=0.4))
    with pytest.raises(ProcessError, match="nothing to expose"):
        dose.correct_table(
            np.zeros((4, 4), np.uint16), np.array([0.0, 0.1]), PITCH, process()
        )
