"""Light that is moved by a shift that grows with the square of the place, sample by
sample, along unlike axes.
"""

import numpy as np
import pytest
import torch

from metalens.field.points import Samples, _move


def test_a_shift_of_the_second_order_is_that_of_its_form_at_every_sample():
    """s_j = d' A_j d / 2 and its divergence (A_x d)_x + (A_y d)_y, at three samples
    along x and two along y.
    """
    along_x, along_y = np.array([-3.1, 0.4, 2.2]), np.array([7.0, 8.9])
    forms = np.array([[[0.3, -0.7], [-0.7, 1.1]], [[-0.2, 0.5], [0.5, 0.9]]])
    ends = tuple(
        Samples(torch.empty(0), torch.tensor(line)) for line in (along_x, along_y)
    )
    got = _move(torch.tensor(forms), ends)
    assert got.shape == (3, 2, 3)
    for row, y in enumerate(along_y):
        for column, x in enumerate(along_x):
            place = np.array([x, y])
            want = [place @ form @ place / 2 for form in forms]
            want.append((forms[0] @ place)[0] + (forms[1] @ place)[1])
            assert got[:, row, column].numpy() == pytest.approx(want, rel=1e-12)
