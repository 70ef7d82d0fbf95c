"""The certificate of written files: against the direct sum over all shapes, and against faults put in on purpose."""

import numpy as np
import pytest

import layout
from layout.certify import certify
from layout.dose import exposure
from layout.files import doses
from layout.mask import build
from layout.process.process import Exposure, Process
from metalens.ground.errors import ProcessError
from metalens.lens.record import DiameterMap

BEAM = {"alpha_um": 0.013, "beta_um": 24.0, "eta": 0.7}


def lens_map(n=61, pitch=0.4):
    axis = np.arange(n) - (n - 1) / 2
    d = np.random.default_rng(4).uniform(0.11, 0.29, (n, n))
    d[(axis - 3) ** 2 + axis[:, None] ** 2 > (n / 2.3) ** 2] = 0
    return DiameterMap(d, pitch)


def written(tmp_path, process, **options):
    """The mask as files: what a reader finds, and its dose table."""
    plan = build.prepare(lens_map(), process, **options).plan
    layout.write_oasis(plan, tmp_path / "m.oas")
    doses.write(plan, process, tmp_path / "doses.csv")
    return plan, layout.read_oasis(tmp_path / "m.oas"), doses.read(tmp_path / "doses.csv")


@pytest.mark.parametrize("third", [{}, {"gamma_um": 0.45, "nu": 0.12}])
def test_exposures_are_those_of_the_direct_sum(tmp_path, third):
    process = Process(exposure=Exposure(**BEAM, **third, correct=False))
    _, content, table = written(tmp_path, process, furnished=False)
    found = certify(content, table, process)
    centres = np.stack([found.x_um, found.y_um], -1)
    which = np.linspace(0, len(centres) - 1, 12).astype(int)
    point = exposure.point_exposure(process.exposure)
    wide, dose = found.drawn_nm * 1e-3, np.full(len(centres), table[1, 0])
    exact = exposure.at_edges(centres, wide, dose, point, which=which)
    assert found.exposure[which] * 0.5 == pytest.approx(exact, rel=2e-3)  # neighbours as Gaussians of their moment


def test_a_corrected_mask_keeps_its_dose_to_size_and_its_diameters(tmp_path):
    process = Process(exposure=Exposure(**BEAM, tolerance=0.008))
    plan, content, table = written(tmp_path, process)
    found = certify(content, table, process)
    assert len(found.drawn_nm) == plan.counts()[1:].sum()
    assert found.worst_exposure < 0.008 + 2e-3
    assert found.worst_nm < 1.0
    assert found.ok
    test = found.exposure[~found.judged]
    assert (test.min(), test.max()) == (pytest.approx(0.8, abs=0.01), pytest.approx(1.2, abs=0.012))


def test_a_single_dose_a_wrong_dose_and_a_missing_dose_are_found(tmp_path):
    plain = Process(exposure=Exposure(**BEAM, correct=False))
    _, content, table = written(tmp_path, plain)
    assert not certify(content, table, plain).ok
    process = Process(exposure=Exposure(**BEAM))
    _, content, table = written(tmp_path, process)
    layer = max(k for k in table if k[0] == 1)
    more = certify(content, {**table, layer: 1.05 * table[layer]}, process)
    assert not more.ok
    assert more.worst_exposure > 0.03
    less = certify(content, {k: v for k, v in table.items() if k != layer}, process)
    assert less.undosed == (layer,)
    assert not less.ok


def test_without_a_point_exposure_nothing_is_certified(tmp_path):
    _, content, table = written(tmp_path, Process(), furnished=False)
    with pytest.raises(ProcessError, match="alpha_um, beta_um, eta"):
        certify(content, table, Process())
