"""Our solvers against fmmax and meent, independent codes (run where they are installed: ``make test-peers``)."""

import numpy as np
import pytest

from benchmarks import rcwa as bench
from metalens import modal, rcwa

pytestmark = pytest.mark.peers


@pytest.mark.parametrize("diameter_um", [0.1, 0.2, 0.3])
def test_both_codes_agree_within_their_truncation_errors(diameter_um):
    pytest.importorskip("fmmax")
    cell = bench.CELLS[0.85]
    theirs = complex(bench.fmmax_solver(cell, 0.85, 9)(diameter_um))
    ours = rcwa.solve(cell, diameter_um, 0.85, harmonics=9)
    assert np.abs(theirs - ours.t) < ours.t_error + 2e-2  # fmmax with 249 orders: 1.2e-2 off on these pillars


def meent_amplitude(diameter_um, reach):
    """Zero-order t of meent, power-normalised, exp(-iwt): its own sign of time and an empty layer set the scale."""
    meent = pytest.importorskip("meent")
    cell, wavelength_um, points = bench.CELLS[0.85], 0.85, 100
    x = (np.arange(points) + 0.5) / points * cell.pitch_um - cell.pitch_um / 2
    outside = np.hypot(x[:, None], x) - diameter_um / 2
    permittivity = 1 + (3.6**2 - 1) * 0.5 * (1 - np.tanh(outside * 1600 / cell.pitch_um))
    solved = meent.call_mee(
        backend=0,
        pol=0,
        n_top=1.4525,
        n_bot=1.0,
        theta=0.0,
        phi=0.0,
        period=(cell.pitch_um, cell.pitch_um),
        wavelength=wavelength_um,
        ucell=np.sqrt(permittivity)[None],
        thickness=(cell.height_um,),
        fto=(reach, reach),
        enhanced_dfs=False,
        type_complex=np.complex128,
    ).conv_solve()
    return np.conj(solved.res.T_s[reach, reach])


@pytest.mark.parametrize(("diameter_um", "within"), [(0.128, 0.04), (0.2, 0.08)])
def test_meent_agrees_within_its_truncation_error(diameter_um, within):
    """Orders up to 5 on a raster of 4 nm: 2e-2 and 5e-2 off, which its own steps from 5 to 7 orders do not show."""
    r = (1.4525 - 1) / (1.4525 + 1)
    empty = np.sqrt(1 - r**2) * np.exp(2j * np.pi * 0.7 / 0.85)
    theirs = meent_amplitude(diameter_um, 5) * empty / meent_amplitude(-1.0, 1)
    assert np.abs(theirs - modal.solve(bench.CELLS[0.85], diameter_um, 0.85, tolerance=1e-4).t) < within
