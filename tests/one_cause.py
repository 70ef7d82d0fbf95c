"""Two causes that nobody knows, each one row, added before anything else is loaded;
then all five readers are asked.

Run as a script by ``test_one_cause.py``, in a process of its own: the table is read
once.
"""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from metalens.made import causes

LEAN, LOSS = "bias_c_nm", "absorption"


def _with_loss(cell, amount, wavelength_um):
    n = causes.index(cell.pillar, wavelength_um)
    return dataclasses.replace(cell, pillar=causes.Index(n.real, n.imag + amount))


def _by_loss(guide):
    """n + ik: an absorption is an index turned by i."""
    return 1j * causes._by_index(guide)


causes.CAUSES = (
    *causes.CAUSES,
    causes._widens(
        LEAN, "bias that grows as u rho²", 10.0, 15.0, ((1, 3, 0), (1, 1, 2)), drawn=causes.Drawn("lean_nm", 2.5)
    ),
    causes.Cause(
        LOSS, "extinction coefficient of the pillars", 1e-3, 2e-3, -5e-3, 5e-3,
        causes.Answers(_by_loss, _with_loss, 1e-3), free=False, drawn=causes.Drawn("absorption", 1e-3),
    ),
)  # fmt: skip

sys.path[:0] = [
    str(Path(__file__).parent / "codesign"),
    str(Path(__file__).parent / "characterize"),
]


def fit():
    """The derivative of the expected frames by each new cause is that of their
    difference.
    """
    import bench_lens as b

    from characterize.model import (
        PARAMETERS,
        PLACE,
        ForwardModel,
        Known,
        Setting,
        vector,
    )

    assert [PARAMETERS[PLACE[name]].sigma for name in (LEAN, LOSS)] == [10.0, 2e-3]
    depths = np.array([380.0, 800.0])
    rows = np.vstack([b.RESPONSE.coefficients, np.zeros((5, 2)), [[-4.0, -20.0]]])
    response = dataclasses.replace(b.RESPONSE, coefficients=rows)
    model = ForwardModel(
        b.lens(), Setting(depths, np.zeros((2, 2)), np.ones(2), 1.5, 24, 24), response
    )
    x = vector(
        {
            "log_gain": 10.0,
            "bias_x_nm": 2.0,
            "height_nm": -8.0,
            Known(LEAN, 3.0).name: 3.0,
            LOSS: 7e-4,
        }
    )
    for name, step in ((LEAN, 0.1), (LOSS, 1e-4)):
        up, down = x.copy(), x.copy()
        up[PLACE[name]] += step
        down[PLACE[name]] -= step
        want = (model.images(up)[0] - model.images(down)[0]) / (2 * step)
        got = model.images(x, [name])[1][0]
        assert np.abs(want).max() > 0
        assert (
            np.abs(got - want).max() < 2e-2 * np.abs(want).max()
        )  # operators of derivatives are cut at 3e-3


def mask_study():
    """Phase of a lens whose bias grows as u rho², whose square is 1/8 on the disc; loss
    takes light and no phase.
    """
    import made_lens as m

    from layout.process import Process
    from layout.study import tolerance
    from layout.study.sensitivity import Sensitivities

    lens, d = m.small(), np.linspace(0.08, 0.32, 5)
    rates = np.zeros((9, 5), complex)
    rates[8] = -6.0
    study = tolerance.analyse(
        lens,
        Process(),
        sens=Sensitivities(d, rates, 0.0),
        depths_um=(2500.0,),
        draws=10,
    )
    effects = {e.cause: e for e in study.effects}
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    slope = lens.proxy.dphase_ddiameter(built, 0.85)
    want = 2.5e-3 * math.sqrt((slope**2).mean() / 8)
    assert effects["lean_nm"].deviation == 2.5
    assert effects["lean_nm"].phase_rad == pytest.approx(
        want, rel=0.03
    )  # 64 places on the disc
    assert effects["absorption"].phase_rad == pytest.approx(0, abs=1e-12)
    assert effects["absorption"].strehl == pytest.approx(
        math.exp(2 * 6.0 * 1e-3) - 1, rel=0.01
    )


def budget():
    """The entry of draws of the process: the phase that the lean alone gives."""
    import made_lens as m
    from process_entry import process_entry

    from metalens.made import Spread

    lens = m.small()
    entry = process_entry(lens, Spread.only(lean_nm=4.0), draws=60)
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    slope = lens.proxy.dphase_ddiameter(built, 0.85)
    want = 4e-3 * math.sqrt((slope**2).mean() / 8)
    assert entry.phase_rad == pytest.approx(
        want, rel=4 / math.sqrt(2 * 60)
    )  # four sigma of 60 normal draws


def training():
    """Light lost to the haze of a lean; and the PSFs of a made lens, pillar by pillar."""
    import made_lens as m
    import torch

    from characterize.model import state, vector
    from codesign.optics import LensError, LensErrors, MadeLens, stack
    from codesign.optics.lens_errors import variance_rad2
    from metalens.made import transmission

    small = dataclasses.replace(
        m.OPTICS, spread=LensErrors(lean_nm=8.0, absorption=1e-3)
    )
    assert set(small.spread.draw(torch.Generator().manual_seed(1)).amounts) >= {
        "lean_nm",
        "absorption",
    }
    plain = stack.stack(small, torch.zeros(0)).intensity.sum((1, 2))
    variance = variance_rad2(LensError({"lean_nm": 30.0}).state())
    bent = stack.hazy(small, stack.stack(small, torch.zeros(0)).intensity, variance)
    lost = 1 - math.exp(-7.797e-4 * 900 / 8)
    window = (small.window_samples * small.sample_um) ** 2 / (math.pi * 60.0**2)
    torch.testing.assert_close(
        bent.sum((1, 2)), (1 - lost) * plain + lost * window, rtol=3e-4, atol=0
    )

    made, known = (
        MadeLens(m.small(), m.OPTICS),
        state(vector({LEAN: 6.0, LOSS: 2e-3, "bias_y_nm": -3.0})),
    )
    d = m.small().diameters
    u, v = d.x_um / d.radius_um, d.y_um[:, None] / d.radius_um
    grown = d.diameter_um + 6e-3 * u * (u**2 + v**2) - 3e-3 * v
    t = (
        transmission(m.PROXY, made.response, grown, 0.85, known.answers())
        * made._carrier
        * (d.diameter_um > 0)
    )
    side, cells = made._block, made._gathered(known)
    whole = side * (len(t) // side)
    sums = (
        t[:whole, :whole].reshape(whole // side, side, whole // side, side).sum((1, 3))
    )
    counts = (
        (d.diameter_um[:whole, :whole] > 0)
        .reshape(whole // side, side, whole // side, side)
        .sum((1, 3))
    )
    want = np.where(counts > 0, sums / np.maximum(counts, 1), 0)
    # half a step of the table, 5e-6 um, at 6 pi / 0.24 = 79 rad/um, times |t| of 0.9
    assert np.abs(cells[: len(want), : len(want)] - want).max() < 3.6e-4


def correction():
    """The corrected map takes the lean off every pillar; the table gives the phase of
    the loss nothing to mend.
    """
    import made_lens as m

    from characterize.model import vector
    from codesign.adapt import correction as next_mask
    from metalens.made import Bias, sensitivity

    lens = m.small()
    plan = next_mask.propose(
        lens,
        vector({LEAN: 4.0, "bias_nm": 2.0}),
        response=sensitivity(lens),
        old=Bias(),
    )
    d = lens.diameters
    u, v = d.x_um / d.radius_um, d.y_um[:, None] / d.radius_um
    change = (plan.lens.diameters.diameter_um - d.diameter_um)[d.diameter_um > 0]
    want = (-4e-3 * u * (u**2 + v**2))[d.diameter_um > 0]
    inside = (d.diameter_um[d.diameter_um > 0] > 0.085) & (
        d.diameter_um[d.diameter_um > 0] < 0.315
    )
    assert np.abs(change - want)[inside].max() < 1e-6  # float32 diameters
    assert np.ptp(want) > 5e-3
    assert np.allclose(plan.bias_nm, 2.0, atol=1e-9)


if __name__ == "__main__":
    for reader in (fit, mask_study, budget, training, correction):
        reader()
        sys.stdout.write(f"{reader.__name__}\n")
