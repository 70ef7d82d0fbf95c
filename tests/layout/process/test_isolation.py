"""How alone a pillar stands, by the plain sum over its neighbours."""

import numpy as np
import pytest

from layout.process.isolation import isolation


@pytest.mark.parametrize(("pitch_um", "range_um"), [(0.41, 0.37), (0.3, 0.83)])
def test_isolation_is_the_share_of_weight_that_is_missing(pitch_um, range_um):
    rng = np.random.default_rng(7)
    present = rng.uniform(size=(23, 110)) > 0.4  # wider than one tile of 96
    present[:6, :7] = False
    reach = int(np.ceil(3 * range_um / pitch_um))
    step = np.arange(-reach, reach + 1) * pitch_um
    weight = np.exp(-(step[:, None] ** 2 + step**2) / range_um**2)
    weight[reach, reach] = 0.0
    around = np.pad(present, reach).astype(float)
    got = isolation(present, pitch_um, range_um)
    for y, x in ((0, 0), (5, 8), (12, 95), (13, 97), (22, 109), (7, 3)):
        stood = (around[y : y + 2 * reach + 1, x : x + 2 * reach + 1] * weight).sum()
        assert got[y, x] == pytest.approx(1 - stood / weight.sum(), abs=2e-6)  # float32
    assert isolation(np.ones((40, 40), bool), pitch_um, range_um)[15:25, 15:25].max() < 1e-6
    alone = np.zeros((31, 31), bool)
    alone[14, 17] = True
    assert isolation(alone, pitch_um, range_um)[14, 17] == pytest.approx(1.0)
