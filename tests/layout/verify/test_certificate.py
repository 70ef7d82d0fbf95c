"""The certificate of written files: against the direct sum over all shapes, and against
faults put in on purpose.
"""

import functools
import tempfile
from pathlib import Path

import numpy as np
import pytest

import layout
from layout.formats import job_files
from layout.pec import psf
from layout.process.process import EtchProfile, ExposureSettings, Process
from layout.verify.exposure import verify_exposure
from layout.verify.written_lens import LensRows
from metalens.cell import Cell
from metalens.core.errors import ProcessError
from metalens.fabrication import Bias
from metalens.lens.record import DiameterMap, Lens
from metalens.library import Proxy
from tests.referees import rims
from tests.referees.verified import verify

BEAM = {"alpha_um": 0.013, "beta_um": 24.0, "eta": 0.7}


def lens_map(n=61, pitch=0.4):
    axis = np.arange(n) - (n - 1) / 2
    d = np.random.default_rng(4).uniform(0.11, 0.29, (n, n))
    d[(axis - 3) ** 2 + axis[:, None] ** 2 > (n / 2.3) ** 2] = 0
    return DiameterMap(d, pitch)


@functools.cache
def written(process, furnished=True):
    """The mask as files: the plan, what a reader finds, and its dose table."""
    bare = layout.plan(lens_map(), process, furnished=furnished)
    known = process.exposure.corrected
    plan = layout.correct(bare, process.exposure) if known else bare
    with tempfile.TemporaryDirectory() as folder:
        layout.write_oasis(plan, Path(folder) / "m.oas")
        job_files.write_dose_table(plan, process, Path(folder) / "doses.csv")
        return (
            plan,
            layout.read_oasis(Path(folder) / "m.oas"),
            job_files.read_dose_table(Path(folder) / "doses.csv"),
        )


@pytest.mark.parametrize(
    "third",
    [
        {},
        {"gamma_um": 0.45, "nu": 0.12},
        {"alpha_um": 0.055},
        {"alpha_um": 0.03, "gamma_um": 0.16, "nu": 0.3},
    ],
)
def test_exposures_are_those_of_the_direct_sum(third):
    process = Process(exposure=ExposureSettings(**{**BEAM, **third}, correct=False))
    plan, content, table = written(process, furnished=False)
    found = verify(plan, content, table, process)
    centres = np.stack([found.x_um, found.y_um], -1)
    which = np.linspace(0, len(centres) - 1, 12).astype(int)
    point = psf.point_exposure(process.exposure)
    wide = found.drawn_nm * 1e-3
    dose = np.full(len(centres), table[1, 0])
    exact = rims.at_edges(centres, wide, dose, point, which=which)
    # interpolation on nodes and Gaussians of second moments: 5e-4; where a Gaussian is
    # about as wide as pillars, the error that the report states at its own samples
    error = np.abs(found.exposure[which] * 0.5 - exact).max()
    assert error < 5e-4 + 0.5 * found.report.error
    assert found.report.error < (0.015 if third.get("nu", 0) > 0.2 else 2e-3)


def test_a_corrected_mask_keeps_its_dose_to_size_and_its_diameters():
    process = Process(exposure=ExposureSettings(**BEAM, tolerance=0.008))
    plan, content, table = written(process)
    found = verify(plan, content, table, process)
    assert len(found.drawn_nm) == plan.counts()[1:].sum()
    assert np.abs(found.exposure[found.judged] - 1).max() < 0.008 + 2e-3
    assert found.report.worst_nm < 1.0
    assert found.report.ok
    test = found.exposure[~found.judged]
    assert (test.min(), test.max()) == (
        pytest.approx(0.8, abs=0.01),
        pytest.approx(1.2, abs=0.012),
    )


def test_a_single_dose_a_wrong_dose_and_a_missing_dose_are_found():
    plain = Process(exposure=ExposureSettings(**BEAM, correct=False))
    plan, content, table = written(plain)
    assert not verify(plan, content, table, plain).report.ok
    process = Process(exposure=ExposureSettings(**BEAM))
    plan, content, table = written(process)
    layer = max(k for k in table if k[0] == 1)
    more = verify(plan, content, {**table, layer: 1.05 * table[layer]}, process).report
    assert not more.ok
    assert more.worst_exposure > 0.03
    less = verify(
        plan, content, {k: v for k, v in table.items() if k != layer}, process
    ).report
    assert less.undosed == (layer,)
    assert not less.ok


@pytest.mark.parametrize(
    "third", [{}, pytest.param({"gamma_um": 0.45, "nu": 0.03}, marks=pytest.mark.slow)]
)
def test_the_edges_of_marks_and_labels_are_judged(third):
    process = Process(exposure=ExposureSettings(**BEAM, **third))
    plan, content, table = written(process)
    found = verify(plan, content, table, process).report
    assert found.ok  # the tolerance of the correction is what a certificate wants
    assert set(found.edges.layer.tolist()) == {3, 4}
    labels = sorted(k for k in table if k[0] == 4)
    label = labels[len(labels) // 2]
    wrong = verify(plan, content, {**table, label: 0.9 * table[label]}, process).report
    assert not wrong.ok
    assert wrong.edges.exposure[wrong.edges.layer == 4].min() < 0.95
    assert wrong.edges.shift_nm[wrong.edges.layer == 4].min() < -0.3


@pytest.mark.parametrize(
    ("alpha_um", "beta_um", "eta"),
    [
        (0.0503, 33.42, 0.2),  # a soft core: 1 nm asks for more than 1 %
        pytest.param(0.01, 12.0, 1.2, marks=pytest.mark.slow),  # more classes than 64
        # drawn at random between 4 and 60 nm, 2.5 and 60 um, 0.2 and 1.5
        pytest.param(0.0224, 5.89, 0.25, marks=pytest.mark.slow),
        pytest.param(0.0042, 33.15, 1.39, marks=pytest.mark.slow),
        pytest.param(0.0207, 25.4, 0.91, marks=pytest.mark.slow),
        pytest.param(0.009, 9.58, 0.24, marks=pytest.mark.slow),
    ],
)
def test_any_double_gaussian_gets_as_many_doses_and_pieces_as_its_certificate_needs(
    alpha_um, beta_um, eta
):
    process = Process(
        exposure=ExposureSettings(
            alpha_um=float(alpha_um), beta_um=float(beta_um), eta=float(eta)
        )
    )
    plan, content, table = written(process)
    found = verify_exposure(content, plan, table, process)
    assert found.ok, (found.worst_exposure, found.worst_nm)
    assert (
        sum(len(p) for figure in plan.figures for p in figure.polygons.values())
        < 40_000
    )


def test_without_a_point_exposure_nothing_is_verified():
    plan, content, table = written(Process(), furnished=False)
    with pytest.raises(ProcessError, match="alpha_um, beta_um, eta"):
        verify(plan, content, table, Process())


def test_bias_of_lone_pillars_is_in_what_is_made():
    process = Process(
        exposure=ExposureSettings(**BEAM),
        bias=Bias(isolated_nm=-12.0),
        etch=EtchProfile(sidewall_deg=1.0),
    )
    source = lens_map()
    plan, content, table = written(process)
    found = verify(plan, content, table, process)
    lens = found.layer == 1
    made = found.made_nm[lens]
    size = source.diameter_um.shape[0]
    column, row = (
        np.rint(v[lens] / 0.4 + (size - 1) / 2).astype(int)
        for v in (found.x_um, found.y_um)
    )
    off = made - 1e3 * source.diameter_um[row, column]
    # step of 2 nm, 1 nm of exposure, isolation of a Gaussian on pixels beside sums over
    # sites
    assert np.abs(off).max() < 2.5
    assert np.abs(off).mean() < 0.8


def test_the_lens_as_made_is_the_designed_one_within_what_the_process_rounds():
    process = Process(exposure=ExposureSettings(**BEAM))
    plan, content, table = written(process)
    proxy = Proxy(
        np.array([[3.0, 3.0]]),
        np.array([[0.95]]),
        (0.08, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    designed = Lens(
        lens_map(), Cell(0.4), proxy, 0.85, 500.0, float("inf"), "hyperbolic"
    )
    rows = LensRows(plan)
    verify_exposure(content, plan, table, process, keep=rows.take)
    made = rows.lens(designed)
    d, want = made.diameters.diameter_um, designed.diameters.diameter_um
    assert np.array_equal(d > 0, want > 0)
    # 1 nm of the step, 1 nm of the exposure
    assert np.abs(d - want)[want > 0].max() < 2.1e-3
    assert made.profile == "as-written"
